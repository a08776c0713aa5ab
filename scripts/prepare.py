"""Prepares the Bandai Namco motion dataset for training: `python scripts/prepare.py source=ARCHIVE_OR_FOLDER`."""

import os
from pathlib import Path

import hydra
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track

from stmc.data import bandai
from stmc.data.cache import fingerprint, fresh


@hydra.main(config_path="../configs", config_name="prepare", version_base="1.3")
def main(config: DictConfig) -> None:
    console = Console()
    source, folder = Path(config.source).expanduser(), Path(config.folder).expanduser()
    if not source.exists():
        raise SystemExit(f"source={source} does not exist; it should be the dataset's .tar.xz or its unpacked folder")
    inputs = fingerprint(bandai.inputs(source), [config.fps])
    if fresh(folder, inputs):
        console.print(f"{folder} is up to date")
        return
    clips = bandai.read_clips(source, config.fps, config.workers or os.cpu_count())
    cache = bandai.gather(track(clips, "Clips", total=bandai.CLIPS, console=console), config.fps, inputs)
    cache.write(folder)
    for name, why in cache.skipped:
        console.print(f"[yellow]skipped[/] {name}: {why}")
    hours = len(cache.features) / config.fps / 3600
    console.print(f"{len(cache.clips)} clips with their mirror images, {hours:.1f} hours, in {folder}; {len(cache.skipped)} skipped")


if __name__ == "__main__":
    main()
