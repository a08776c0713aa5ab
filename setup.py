"""What pyproject.toml cannot say: the wheel carries configs/ inside the package, as stmc.configs, though the folder
stands beside it here."""

from setuptools import find_packages, setup

setup(packages=[*find_packages(include=["stmc*"]), "stmc.configs"], package_dir={"stmc.configs": "configs"})
