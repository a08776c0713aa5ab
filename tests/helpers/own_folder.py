"""Somebody else's package as the pages under docs/extending tell how to write one, and the wheel it is used with."""

import re
import subprocess
import sys
from pathlib import Path
from shutil import copytree

from helpers.motions import walking
from helpers.scripts import ROOT

import stmc

PAGES = ROOT / "docs" / "extending"


def write_package(folder: Path) -> Path:
    """`mylab`: a data set, a network, a method, a benchmark, and their configurations."""
    package = folder / "mylab"
    pages = [("data.md", "py"), ("data.md", "yaml"), ("denoiser.md", "yaml"), ("method.md", "python")]
    pages += [("benchmark.md", "python"), ("benchmark.md", "yaml")]
    printed = {name: text for each in pages for name, text in blocks(*each).items()}
    [network] = [
        text for text in re.findall(r"^```python\n(.*?)^```$", page("denoiser.md"), re.S | re.M) if "class Tiny" in text
    ]
    printed["nets.py"] = network.partition("\n\ntiny = ")[0] + "\n"
    for name, text in (printed | {"__init__.py": ""}).items():
        (package / name).parent.mkdir(parents=True, exist_ok=True)
        (package / name).write_text(text, encoding="utf-8")
    return package


def page(name: str) -> str:
    return (PAGES / name).read_text("utf-8")


def blocks(name: str, language: str) -> dict[str, str]:
    """The blocks of a page that say in their first line which file of the package they are."""
    found = re.findall(rf"^```{language}\n# mylab/(\S+)\n(.*?)^```$", page(name), re.S | re.M)
    return dict(found)


def write_recordings(folder: Path) -> Path:
    """Walks, the tenth of which is for validation, as the page on data sets names them."""
    folder.mkdir()
    for number in range(5, 11):
        stmc.write(walking(2.5, 30.0, speed=0.8 + 0.1 * number), folder / f"walk_{number:02d}.npz")
    return folder


def install_wheel(folder: Path) -> Path:
    """Builds the wheel of this checkout and installs it alone; returns where."""
    source, place = folder / "source", folder / "installed"
    for name in ("stmc", "scripts", "configs"):
        copytree(ROOT / name, source / name)
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        (source / name).write_bytes((ROOT / name).read_bytes())
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "-q"]
    build = [*pip, "wheel", "--no-deps", "--no-build-isolation", "-w", str(folder), str(source)]
    subprocess.run(build, check=True)
    [wheel] = folder.glob("*.whl")
    subprocess.run([*pip, "install", "--no-deps", "--target", str(place), str(wheel)], check=True)
    return place
