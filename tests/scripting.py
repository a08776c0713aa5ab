"""The scripts without a process each: as modules, with their configs."""

from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

ROOT = Path(__file__).parents[1]


def loaded(script: str) -> ModuleType:
    """A script of its own, not yet run."""
    spec = spec_from_file_location(f"{script}_script", ROOT / "scripts" / f"{script}.py")
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def configured(name: str, *overrides: object) -> DictConfig:
    """A config as the command line would compose it."""
    with initialize_config_dir(str(ROOT / "configs"), version_base="1.3"):
        return compose(name, overrides=[str(override) for override in overrides])


def run(script: str, config_name: str, *overrides: object) -> None:
    """A script's main function, in this process."""
    loaded(script).main.function(configured(config_name, *overrides))
