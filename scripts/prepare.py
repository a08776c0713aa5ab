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
    total = bandai.CLIPS if source.is_file() else sum(1 for _ in source.rglob("*.bvh"))
    clips = bandai.read_clips(source, config.fps, config.workers or os.cpu_count())
    try:
        cache = bandai.gather(track(clips, "Clips", total=total, console=console), config.fps, inputs)
    except ValueError as error:
        raise SystemExit(f"source={source}: {error}") from error
    cache.write(folder)
    for name, why in cache.skipped:
        console.print(f"[yellow]skipped[/] {name}: {why}")
    hours = len(cache.features) / config.fps / 3600
    made = f"{len(cache.clips)} clips with their mirror images, {hours:.1f} hours, in {folder}"
    console.print(f"{made}; {len(cache.skipped)} skipped")


if __name__ == "__main__":
    main()
