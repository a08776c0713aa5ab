"""Prepares a data set for training: `python scripts/prepare.py data=bandai source=ARCHIVE_OR_FOLDER`.

`data=humanml3d source=AMASS annotations=FOLDER body=SMPLH`, and others: see configs/data. Asked again after it was
killed, it goes on where it was.
"""

import os
import shutil
from dataclasses import replace
from pathlib import Path

import hydra
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track

from stmc.data.cache import fresh
from stmc.data.preparation import Preparation
from stmc.data.report import TEXT, lines, write_report

TOLD = 20
"""Skipped clips that are named on the screen; the report names all."""


@hydra.main(config_path="../configs", config_name="prepare", version_base="1.3")
def main(config: DictConfig) -> None:
    console, folder = Console(), Path(config.folder).expanduser()
    preparation = described(config)
    try:
        preparation.check()
        inputs = preparation.fingerprint()
        if fresh(folder, inputs):
            console.print(f"{folder} is up to date")
            return
        scratch = folder / "pieces"
        cache = preparation.prepared(
            scratch,
            config.workers or os.cpu_count(),
            lambda pieces, total: track(pieces, "Preparing", total=total, console=console),
        )
    except (ValueError, OSError) as error:
        raise SystemExit(str(error)) from error
    replace(cache, fingerprint=inputs).write(folder)
    shutil.rmtree(scratch, ignore_errors=True)
    for name, why in cache.skipped[:TOLD]:
        console.print(f"[yellow]skipped[/] {name}: {why}", highlight=False)
    for line in lines(write_report(cache, folder)):
        console.print(line, highlight=False)
    hours = len(cache.features) / cache.fps / 3600
    made = f"{len(cache.clips)} clips with their mirror images, {hours:.1f} hours, in {folder}"
    console.print(f"{made}; {len(cache.skipped)} skipped: all are named in {TEXT}")


def described(config: DictConfig) -> Preparation:
    """The data set with the places that were given; `SystemExit` says which is missing or does not belong to it."""
    given = {name: config[name] for name in ("source", "annotations", "body") if config[name] is not None}
    try:
        return instantiate(config.data.preparation, **given)
    except InstantiationException as error:
        raise SystemExit(f"this data set is prepared from other things: {error.__cause__}") from error


if __name__ == "__main__":
    main()
