"""Where the scripts and their configurations lie: inside the package once it is installed, beside it in a checkout."""

import sys
from importlib import import_module
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

PACKAGE = Path(__file__).resolve().parents[1]


def place(name: str) -> Path:
    """The folder of "scripts" or "configs"."""
    inside = PACKAGE / name
    return inside if inside.is_dir() else PACKAGE.parent / name


def load_script(name: str) -> ModuleType:
    """A script as a module: installed, or of the checkout that this package lies in."""
    module_name = f"stmc.scripts.{name}"
    if find_spec("stmc.scripts") is not None:
        return import_module(module_name)
    spec = spec_from_file_location(module_name, place("scripts") / f"{name}.py")
    module = sys.modules[module_name] = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
