"""Write STMC's baselines for other tools: `stmc baselines MTT.txt outputs/mtt`.

`NAME_onetext.txt` joins all prompts of a timeline into one text. `NAME_singletrack.txt` holds the consecutive texts
that DiffCollage composes. Both keep the order of the timelines (STMC, section 4.3).
"""

from __future__ import annotations

from dataclasses import MISSING, dataclass
from pathlib import Path

from omegaconf import DictConfig
from rich.console import Console

import stmc
from stmc.cli.commands import command
from stmc.settings.records import setting


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of `stmc baselines`."""

    timelines: str = setting(MISSING, "file of timelines (.txt or .json)")
    output: str = setting("outputs/baselines", "folder to write the two files to")
    fps: float | int = setting(20, "frames per second of the other tool; no segment is shorter than a frame", above=0)
    longest: float | int = setting(9.8, "longest motion that the other tool can generate, in seconds", above=0)


@command("baselines", Settings, ("timelines", "output"))
def main(config: DictConfig) -> None:
    source, folder = Path(config.timelines).expanduser(), Path(config.output).expanduser()
    timelines = stmc.Timeline.read_all(source)
    for name, baseline in (
        ("onetext", [stmc.one_text(timeline, config.longest) for timeline in timelines]),
        ("singletrack", [stmc.single_track(timeline, config.fps) for timeline in timelines]),
    ):
        stmc.Timeline.write_all(baseline, folder / f"{source.stem}_{name}.txt")
        Console().print(f"{len(baseline)} timelines in {folder / f'{source.stem}_{name}.txt'}", markup=False)
