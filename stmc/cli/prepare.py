"""Prepare a data set for training: `stmc prepare SOURCE data=bandai`, where SOURCE is an archive or a folder.

HumanML3D on AMASS needs more folders: `stmc prepare AMASS data=humanml3d annotations=FOLDER body=SMPLH`. Run the same
command again to resume.
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
from stmc.data.cache import is_current
from stmc.data.preparation import Preparation
from stmc.data.report import TEXT, lines, write_report
from stmc.io.files import lock_folder
from stmc.settings.records import SettingError, setting

INPUTS = ("source", "annotations", "body")
"""Settings that name the inputs of a data set; each data set needs some of them."""
MAX_PRINTED = 20
"""Maximum number of skipped clips to print; the report lists all."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of `stmc prepare`."""

    source: str | None = setting(None, "archive or folder of the recordings; each data set has its own layout")
    annotations: str | None = setting(None, "folder of the text annotations of AMASS")
    body: str | None = setting(None, "folder of SMPL-H, for joints as published; null: joints of the default skeleton")
    folder: str = setting("${data.folder}", "folder for the prepared data")
    trusted: tuple[str, ...] = setting((), "your own packages that prepare a data set")
    workers: int | None = setting(None, "number of processes; null: one per core", at_least=1, at_most=1024)


@command("prepare", Settings, ("source", "folder"))
def main(config: DictConfig) -> None:
    folder, preparation = Path(config.folder).expanduser(), build_preparation(config)
    preparation.check()
    with lock_folder(folder):
        prepare(preparation, folder, config.workers or os.cpu_count() or 1, Console())


def prepare(preparation: Preparation, folder: Path, workers: int, console: Console) -> None:
    """Fill the folder; write the report first, since the cache marks the folder as complete."""
    scratch, inputs = folder / "pieces", preparation.fingerprint()
    if is_current(folder, inputs):
        shutil.rmtree(scratch, ignore_errors=True)  # an earlier run may have been killed at its last step
        console.print(f"{folder} is up to date")
        return
    cache = preparation.prepared(
        scratch, workers, lambda pieces, total: track(pieces, "Preparing", total=total, console=console)
    )
    report = lines(write_report(cache, folder))
    replace(cache, fingerprint=inputs).write(folder)
    shutil.rmtree(scratch, ignore_errors=True)
    for name, why in cache.skipped[:MAX_PRINTED]:
        console.print(f"[yellow]skipped[/] {name}: {why}", highlight=False)
    for line in report:
        console.print(line, highlight=False)
    hours = len(cache.features) / cache.fps / 3600
    made = f"{len(cache.clips)} clips with their mirror images, {hours:.1f} hours, in {folder}"
    console.print(f"{made}; {len(cache.skipped)} skipped, listed in {TEXT}")


def build_preparation(config: DictConfig) -> Preparation:
    """Build the preparation of the data set. Raises `SettingError` for an input that is missing or does not apply."""
    given = {name: config[name] for name in INPUTS if config[name] is not None}
    known = signature_of_part(config, "data.preparation").parameters
    missing = [
        name for name in INPUTS if name in known and known[name].default is Parameter.empty and name not in given
    ]
    foreign = [name for name in given if name not in known]
    if missing or foreign:
        errors = [f"{name}= is missing" for name in missing] + [f"{name}= does not apply" for name in foreign]
        raise SettingError(f"{', '.join(errors)} to this data set; --help lists the inputs of data sets")
    return build_part(config, "data.preparation", **given)
