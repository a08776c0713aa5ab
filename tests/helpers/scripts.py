"""The scripts, without a process each as modules with their configs, or in one of their own."""

import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

ROOT = Path(__file__).parents[2]


def loaded(script: str) -> ModuleType:
    """A script of its own, not yet run."""
    return import_module(f"stmc.cli.{script}")


def configured(name: str, *overrides: object) -> DictConfig:
    """A config as the command line would compose it."""
    with initialize_config_dir(str(ROOT / "configs"), version_base="1.3"):
        return compose(name, overrides=[str(override) for override in overrides])


def run(script: str, config_name: str, *overrides: object) -> None:
    """A script's main function, in this process."""
    command, config = loaded(script).main, configured(config_name, *overrides)
    command.function(command.check(config) if command.takes_record else config)


def script(name: str, *settings: object, folder: Path, check: bool = True) -> subprocess.CompletedProcess:
    """Runs a script with its output in one stream, in a folder where it must leave nothing."""
    command = [sys.executable, str(ROOT / "scripts" / f"{name}.py"), *map(str, settings)]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "COLUMNS": "200"}
    folder.mkdir(exist_ok=True)
    done = subprocess.run(
        command, cwd=folder, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False
    )
    assert not check or done.returncode == 0, done.stdout
    return done
