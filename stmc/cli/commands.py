"""A command: a function, the record of its settings, and the configuration that Hydra composes for it."""

from __future__ import annotations

import functools
import logging
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, dataclass
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar

from hydra import compose, initialize_config_dir
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.plugins.search_path_plugin import SearchPathPlugin
from hydra.types import RunMode
from omegaconf import OmegaConf, open_dict

from stmc.cli.arguments import Asked, read
from stmc.cli.config_folder import find_configs
from stmc.cli.config_parts import check_plugins, check_trust, described, record_of_part
from stmc.cli.exit_codes import guarded
from stmc.cli.help import explanation
from stmc.settings.records import SettingError, defaults, field_infos, record_of

Config = Any
"""What Hydra composes: an OmegaConf `DictConfig`."""


SHORT = {"import": "import_checkpoint"}
"""Commands that are not called like their scripts."""


@dataclass(frozen=True)
class Command:
    """What `command` makes of a function. A call is the whole way: arguments, checks, the function, an exit code."""

    name: str
    settings: type
    """The record whose fields are the settings."""
    function: Callable[[Any], object]
    positional: tuple[str, ...] = ()
    """The settings that plain arguments are, in order."""
    takes_record: bool = False
    """Whether the function is given the record; else it is given what Hydra composes."""

    def __call__(self, arguments: Sequence[str] | None = None) -> int:
        """Runs the command with what was typed behind it, and returns its exit code."""
        return guarded(functools.partial(self.run, sys.argv[1:] if arguments is None else arguments))

    def run(self, arguments: Sequence[str]) -> None:
        """As calling, but what goes wrong is an exception."""
        asked = read(arguments, self.settings, self.parts, self.positional)
        if asked.help:
            sys.stdout.write(self.explain(asked))
        elif asked.multirun:
            with self._found(asked) as (name, overrides):
                hydra = GlobalHydra.instance().hydra
                asked_of_hydra = hydra.config_loader.load_configuration(name, overrides, RunMode.MULTIRUN).hydra
                check_plugins(OmegaConf.to_container(asked_of_hydra), "hydra")
                hydra.multirun(name, functools.partial(_job, self.name), overrides)
        elif asked.show:
            sys.stdout.write(OmegaConf.to_yaml(self.composed(asked)))
        else:
            self.begin(self.composed(asked))

    def begin(self, config: Config) -> None:
        """Checks a configuration, and runs the command with it."""
        settings = self.check(config)
        _log(self.function.__module__)
        if config.get("threads"):
            import torch  # not above: help and refused settings do without

            torch.set_num_threads(config.threads)
        self.function(settings if self.takes_record else config)

    def composed(self, asked: Asked) -> Config:
        """The configuration as asked for; the user's own folder wins over ours."""
        with self._found(asked) as (name, overrides):
            config = self.completed(compose(name, overrides))
            check_trust(config, overrides)
            return config

    def completed(self, config: Config) -> Config:
        """With the settings that a configuration of the user's own may leave out."""
        with open_dict(config):
            for setting, value in defaults(self.settings).items():
                config.setdefault(setting, "???" if value is MISSING else value)
        return config

    @contextmanager
    def _found(self, asked: Asked) -> Iterator[tuple[str, list[str]]]:
        """Where Hydra finds the configuration: its name and the overrides, as long as Hydra looks there."""
        folder, ours = asked.folder or find_configs(), find_configs()
        if not folder.is_dir():
            raise SettingError(f"--config-dir {folder} is not a folder")
        name = asked.name or self.name
        if not any((place / f"{name}.yaml").is_file() for place in (folder, ours)):
            raise SettingError(f"--config-name {name}: {folder / name}.yaml does not exist")
        with _in_front(folder), initialize_config_dir(str(ours), job_name=self.name, version_base="1.3"):
            yield name, [*asked.overrides]

    def check(self, config: Config) -> Any:
        """The record of the settings, groups of parts left out. Raises `SettingError` for settings that are missing,
        unknown or do not fit, before anything is loaded."""
        if missing := sorted(_missing(OmegaConf.to_container(config))):
            told = field_infos(self.settings)
            meant = [f"{name}= ({told[name].help})" if name in told else f"{name}=" for name in missing]
            raise SettingError(f"needed: {', '.join(meant)}")
        values = OmegaConf.to_container(config, resolve=True)
        return record_of(self.settings, {name: value for name, value in values.items() if name not in self.parts})

    def explain(self, asked: Asked) -> str:
        """The help that `--help` prints, for the parts that are asked for."""
        told = self.function.__globals__.get("__doc__") or ""
        name = next((short for short, script in SHORT.items() if script == self.name), self.name)
        return explanation(name, told, self.settings, self.positional, self.parts, self._tables(asked))

    def _tables(self, asked: Asked) -> dict[str, tuple[type, dict[str, Any]]]:
        """The records that parts within parts describe, and the values that the configuration gives."""
        within = {part: part.replace("/", ".") for part in self.parts if "/" in part}
        if not within:
            return {}
        with self._found(asked) as (name, overrides):
            config = compose(name, overrides)
        records = {part: record_of_part(config, place) for part, place in within.items()}
        return {part: (record, described(config, within[part])) for part, record in records.items() if record}

    @cached_property
    def parts(self) -> dict[str, tuple[str, list[str]]]:
        """The groups that the configuration is composed of, each with the one chosen by default, and all of them."""
        return dict(_groups(find_configs(), self.name, ""))


class _OwnFolder(SearchPathPlugin):
    """Hydra's hook for folders of configurations: the user's own comes in front of ours.

    `hydra.searchpath` would not do: Hydra looks for a command's own configuration before it reads that setting.
    """

    folder: ClassVar[Path | None] = None

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        if self.folder is not None:
            search_path.prepend("command-line", f"file://{self.folder}", "main")


@contextmanager
def _in_front(folder: Path) -> Iterator[None]:
    """Lets Hydra, once it is initialised, look into `folder` first."""
    Plugins.instance().register(_OwnFolder)
    _OwnFolder.folder = folder.resolve()
    try:
        yield
    finally:
        _OwnFolder.folder = None


def _groups(folder: Path, name: str, within: str) -> Iterator[tuple[str, tuple[str, list[str]]]]:
    """The groups that the configuration `name` chooses from, and those that the chosen ones choose from."""
    listed = OmegaConf.load(folder / f"{name}.yaml").get("defaults", [])
    chosen = [next(iter(each.items())) for each in listed if OmegaConf.is_dict(each)]
    for group, one in chosen:
        if not group.startswith("override "):
            yield f"{within}{group}", (one, sorted(path.stem for path in folder.glob(f"{within}{group}/*.yaml")))
            yield from _groups(folder, f"{within}{group}/{one}", f"{within}{group}/")


def _missing(value: Any, name: str = "") -> Iterator[str]:
    """The names of what is `???`. Unlike OmegaConf's own, it takes values that follow from such ones as they stand."""
    if isinstance(value, (dict, list)):
        for key, each in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _missing(each, f"{name}.{key}" if name else str(key))
    elif value == "???":
        yield name


def command(
    name: str, settings: type, positional: tuple[str, ...] = (), takes_record: bool = False
) -> Callable[[Callable[[Any], object]], Command]:
    """Makes a command of a function of its composed configuration, or, if it `takes_record`, of the record of its
    settings: `@command("sample", Sample, ("timeline",))`.

    `name` is that of its configuration, too; plain arguments are the settings `positional`.
    """
    return lambda function: Command(name, settings, function, positional, takes_record)


def _job(name: str, config: Config) -> None:
    """One of many runs. A launcher may start it in another process or on another machine: there the command is found by
    the name of its script."""
    command: Command = import_module(f"stmc.cli.{name}").main
    check_trust(config, HydraConfig.get().overrides.task)
    command.begin(command.completed(config))


def _log(script: str) -> None:
    """What the library and the script tell as they go (checkpoints, validation) appears on stderr, a line each."""
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(asctime)s %(message)s"))
    for name in {"stmc", script}:
        logger = logging.getLogger(name)
        if not logger.hasHandlers():
            logger.addHandler(handler)
            logger.setLevel(logging.INFO)
