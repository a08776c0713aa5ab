"""What pyproject.toml cannot say: the wheel carries scripts/ and configs/ inside the package, as stmc.scripts and
stmc.configs, though they stand beside it here."""

from setuptools import find_packages, setup

setup(
    packages=[*find_packages(include=["stmc*"]), "stmc.scripts", "stmc.configs"],
    package_dir={"stmc.scripts": "scripts", "stmc.configs": "configs"},
)
