"""Commands: a function, the record of its settings, and the configuration that Hydra composes for it."""

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

from stmc.cli.arguments import Arguments, parse_arguments
from stmc.cli.config_folder import find_configs
from stmc.cli.config_parts import check_plugins, check_trust, describe_part, record_of_part, resolve_config
from stmc.cli.dispatch import SHORT
from stmc.cli.exit_codes import run_guarded
from stmc.cli.help import format_help
from stmc.settings.records import SettingError, defaults, field_infos, record_of

Config = Any
"""A configuration composed by Hydra: an OmegaConf `DictConfig`."""


@dataclass(frozen=True)
class Command:
    """A function as a command. A call parses arguments, checks settings, runs the function and returns an exit code."""

    name: str
    settings: type
    """The record whose fields are the settings."""
    function: Callable[[Any], object]
    positional: tuple[str, ...] = ()
    """Names of the settings that positional arguments set, in order."""
    takes_record: bool = False
    """Whether the function receives the record of settings; otherwise it receives the composed configuration."""

    def __call__(self, arguments: Sequence[str] | None = None) -> int:
        """Run the command with `arguments` (by default those of the process) and return its exit code."""
        return run_guarded(functools.partial(self.run, sys.argv[1:] if arguments is None else arguments))

    def run(self, arguments: Sequence[str]) -> None:
        """Run the command with `arguments`; failures raise exceptions."""
        parsed = parse_arguments(arguments, self.settings, self.parts, self.positional)
        if parsed.help:
            sys.stdout.write(self.explain(parsed))
        elif parsed.multirun:
            with self._initialise_hydra(parsed) as (name, overrides):
                hydra = GlobalHydra.instance().hydra
                assert hydra is not None  # it is initialised here
                hydra_config = hydra.config_loader.load_configuration(name, overrides, RunMode.MULTIRUN).hydra
                check_plugins(OmegaConf.to_container(hydra_config), "hydra")
                hydra.multirun(name, functools.partial(_job, self.name), overrides)
        elif parsed.show:
            sys.stdout.write(OmegaConf.to_yaml(self.compose_config(parsed)))
        else:
            self.begin(self.compose_config(parsed))

    def begin(self, config: Config) -> None:
        """Check a configuration and run the command with it."""
        settings = self.check(config)
        _log(self.function.__module__)
        if config.get("threads"):
            import torch  # not at the top: help and invalid settings do without

            torch.set_num_threads(config.threads)
        self.function(settings if self.takes_record else config)

    def compose_config(self, parsed: Arguments) -> Config:
        """Compose the requested configuration; the user's own folder takes precedence over ours."""
        with self._initialise_hydra(parsed) as (name, overrides):
            config = self.add_defaults(compose(name, overrides))
            check_trust(config, overrides)
            return config

    def add_defaults(self, config: Config) -> Config:
        """Add the defaults of settings that the user's own configuration leaves out."""
        with open_dict(config):
            for setting, value in defaults(self.settings).items():
                config.setdefault(setting, "???" if value is MISSING else value)
        return config

    @contextmanager
    def _initialise_hydra(self, parsed: Arguments) -> Iterator[tuple[str, list[str]]]:
        """Initialise Hydra with the configuration folders; yield the configuration's name and the overrides."""
        folder, ours = parsed.folder or find_configs(), find_configs()
        if not folder.is_dir():
            raise SettingError(f"--config-dir {folder} is not a folder")
        name = parsed.name or self.name
        if not any((place / f"{name}.yaml").is_file() for place in (folder, ours)):
            raise SettingError(f"--config-name {name}: {folder / name}.yaml does not exist")
        with _in_front(folder), initialize_config_dir(str(ours), job_name=self.name, version_base="1.3"):
            yield name, [*parsed.overrides]

    def check(self, config: Config) -> Any:
        """Return the record of the settings, without groups of parts.

        Raises `SettingError` for missing, unknown or invalid settings, before anything is loaded.
        """
        if missing := sorted(_missing(OmegaConf.to_container(config))):
            fields = field_infos(self.settings)
            described = [f"{name}= ({fields[name].help})" if name in fields else f"{name}=" for name in missing]
            raise SettingError(f"missing: {', '.join(described)}")
        values = resolve_config(config)
        return record_of(self.settings, {name: value for name, value in values.items() if name not in self.parts})

    def explain(self, parsed: Arguments) -> str:
        """Return the text that `--help` prints for the requested parts."""
        text = self.function.__globals__.get("__doc__") or ""
        name = next((short for short, script in SHORT.items() if script == self.name), self.name)
        return format_help(name, text, self.settings, self.positional, self.parts, self._tables(parsed))

    def _tables(self, parsed: Arguments) -> dict[str, tuple[type, dict[str, Any]]]:
        """Return the records that nested parts describe, with their configured values."""
        within = {part: part.replace("/", ".") for part in self.parts if "/" in part}
        if not within:
            return {}
        with self._initialise_hydra(parsed) as (name, overrides):
            config = compose(name, overrides)
        records = {part: record_of_part(config, place) for part, place in within.items()}
        return {part: (record, describe_part(config, within[part])) for part, record in records.items() if record}

    @cached_property
    def parts(self) -> dict[str, tuple[str, list[str]]]:
        """Groups of the configuration, each with its default choice and all choices."""
        return dict(_groups(find_configs(), self.name, ""))


class _OwnFolder(SearchPathPlugin):
    """Hydra plug-in that searches the user's configuration folder before ours.

    `hydra.searchpath` does not suffice: Hydra looks for the primary configuration before it reads that setting.
    """

    folder: ClassVar[Path | None] = None

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        if self.folder is not None:
            search_path.prepend("command-line", f"file://{self.folder}", "main")


@contextmanager
def _in_front(folder: Path) -> Iterator[None]:
    """Make Hydra search `folder` first within this context."""
    Plugins.instance().register(_OwnFolder)
    _OwnFolder.folder = folder.resolve()
    try:
        yield
    finally:
        _OwnFolder.folder = None


def _groups(folder: Path, name: str, within: str) -> Iterator[tuple[str, tuple[str, list[str]]]]:
    """Yield the groups of the configuration `name` and, recursively, those of the chosen options."""
    config: Any = OmegaConf.load(folder / f"{name}.yaml")
    listed = config.get("defaults", [])
    chosen = [next(iter(each.items())) for each in listed if OmegaConf.is_dict(each)]
    for group, one in chosen:
        if not group.startswith("override "):
            yield f"{within}{group}", (one, sorted(path.stem for path in folder.glob(f"{within}{group}/*.yaml")))
            yield from _groups(folder, f"{within}{group}/{one}", f"{within}{group}/")


def _missing(value: Any, name: str = "") -> Iterator[str]:
    """Yield the names of values that are `???`. Unlike OmegaConf, does not follow interpolations to such values."""
    if isinstance(value, (dict, list)):
        for key, each in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _missing(each, f"{name}.{key}" if name else str(key))
    elif value == "???":
        yield name


def command(
    name: str, settings: type, positional: tuple[str, ...] = (), takes_record: bool = False
) -> Callable[[Callable[[Any], object]], Command]:
    """Decorate a function as a command: `@command("sample", Sample, ("timeline",))`.

    Args:
        name: Name of the command and of its configuration.
        settings: Record of its settings.
        positional: Names of the settings that positional arguments set, in order.
        takes_record: Whether the function receives the record; otherwise it receives the composed configuration.
    """
    return lambda function: Command(name, settings, function, positional, takes_record)


def _job(name: str, config: Config) -> None:
    """Run one of many jobs. A launcher may start it on another machine, where the module's name finds the command."""
    command: Command = import_module(f"stmc.cli.{name}").main
    check_trust(config, HydraConfig.get().overrides.task)
    command.begin(command.add_defaults(config))


def _log(script: str) -> None:
    """Print log messages of the library and the command (checkpoints, validation) to stderr."""
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(asctime)s %(message)s"))
    for name in {"stmc", script}:
        logger = logging.getLogger(name)
        if not logger.hasHandlers():
            logger.addHandler(handler)
            logger.setLevel(logging.INFO)
