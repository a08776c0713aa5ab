"""Prepare a data set for training: `stmc prepare SOURCE data=bandai`, where SOURCE is an archive or a folder.

HumanML3D on AMASS needs more: `stmc prepare AMASS data=humanml3d annotations=FOLDER body=SMPLH`. Run the same command
again to resume.
"""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass, replace
from inspect import Parameter
from pathlib import Path

from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track

from stmc.cli.commands import command
from stmc.cli.config_parts import build_part, signature_of_part
from stmc.data.cache import fresh
from stmc.data.preparation import Preparation
from stmc.data.report import TEXT, lines, write_report
from stmc.io.files import locked
from stmc.settings.records import SettingError, setting

PLACES = ("source", "annotations", "body")
"""Where the things are that data sets are prepared from; each needs some of them."""

TOLD = 20
"""Skipped clips that are named on the screen; the report names all."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of `stmc prepare`."""

    source: str | None = setting(None, "archive or folder of the recordings; each data set has its own layout")
    annotations: str | None = setting(None, "folder of the texts of AMASS's recordings")
    body: str | None = setting(None, "SMPL-H's folder, for the joints as published; null: the default skeleton's")
    folder: str = setting("${data.folder}", "where the prepared data goes")
    trusted: tuple[str, ...] = setting((), "packages of your own that prepare a data set")
    workers: int | None = setting(None, "processes; null: one per core", at_least=1, at_most=1024)


@command("prepare", Settings, ("source", "folder"))
def main(config: DictConfig) -> None:
    folder, preparation = Path(config.folder).expanduser(), described(config)
    preparation.check()
    with locked(folder):
        prepare(preparation, folder, config.workers or os.cpu_count(), Console())


def prepare(preparation: Preparation, folder: Path, workers: int, console: Console) -> None:
    """Fills the folder: the report first, since the cache says that all is there."""
    scratch, inputs = folder / "pieces", preparation.fingerprint()
    if fresh(folder, inputs):
        shutil.rmtree(scratch, ignore_errors=True)  # a run may have been killed on its last step
        console.print(f"{folder} is up to date")
        return
    cache = preparation.prepared(
        scratch, workers, lambda pieces, total: track(pieces, "Preparing", total=total, console=console)
    )
    report = lines(write_report(cache, folder))
    replace(cache, fingerprint=inputs).write(folder)
    shutil.rmtree(scratch, ignore_errors=True)
    for name, why in cache.skipped[:TOLD]:
        console.print(f"[yellow]skipped[/] {name}: {why}", highlight=False)
    for line in report:
        console.print(line, highlight=False)
    hours = len(cache.features) / cache.fps / 3600
    made = f"{len(cache.clips)} clips with their mirror images, {hours:.1f} hours, in {folder}"
    console.print(f"{made}; {len(cache.skipped)} skipped: all are named in {TEXT}")


def described(config: DictConfig) -> Preparation:
    """The data set with the places that were given. Raises `SettingError` for one that is missing or does
    not belong to it."""
    given = {name: config[name] for name in PLACES if config[name] is not None}
    known = signature_of_part(config, "data.preparation").parameters
    missing = [
        name for name in PLACES if name in known and known[name].default is Parameter.empty and name not in given
    ]
    foreign = [name for name in given if name not in known]
    if missing or foreign:
        told = [f"{name}= is missing" for name in missing] + [f"{name}= does not belong to it" for name in foreign]
        raise SettingError(f"{', '.join(told)}; --help lists the settings that name the parts of a data set")
    return build_part(config, "data.preparation", **given)
