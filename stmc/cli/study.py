"""Make a perceptual study of two methods: `stmc study FOLDER_A FOLDER_B TIMELINES`."""

from __future__ import annotations

from dataclasses import MISSING, dataclass
from pathlib import Path

from omegaconf import DictConfig
from rich.console import Console

import stmc
from stmc.cli.commands import command
from stmc.evaluation.study import StudyError, design, read_pairs, survey_page
from stmc.io.files import write_text
from stmc.settings.records import setting


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of `stmc study`."""

    first: str = setting(MISSING, "folder of sampled motions of the method under study")
    second: str = setting(MISSING, "folder of sampled motions of the other method, of the same timelines")
    timelines: str = setting(MISSING, "file of the timelines of both folders")
    names: tuple[str | None, ...] = setting(
        (None, None), "names of the two methods in the analysis; null: their folders' names"
    )
    output: str = setting("outputs/study", "folder for the study: surveys/ for raters, key.json for the analysis")
    size: int = setting(10, "pairs per survey, not counting three warm-ups and two honeypots", at_least=1)
    seed: int = setting(0, "seed of the surveys", at_least=0)


@command("study", Settings, ("first", "second", "timelines"))
def main(config: DictConfig) -> None:
    folder = Path(config.output).expanduser()
    surveys = write_study(config, folder)
    console = Console()
    console.print(f"{surveys} surveys in {folder.resolve() / 'surveys'}: give each rater one of the pages")
    console.print(f"the answer key is {folder.resolve() / 'key.json'}: keep it to yourself")


def write_study(config: DictConfig, folder: Path) -> int:
    """Write the pages, then the key; return the number of pages."""
    if (folder / "key.json").exists():
        raise StudyError(f"{folder} already holds a study, and its answers need its key; choose another output folder")
    first, second = (Path(config[side]).expanduser() for side in ("first", "second"))
    pairs = read_pairs(first, second, stmc.Timeline.read_all(Path(config.timelines).expanduser()))
    names = (config.names[0] or first.name, config.names[1] or second.name)
    surveys, key = design(pairs, names, config.seed, config.size)
    for number, survey in enumerate(surveys, start=1):
        write_text(folder / "surveys" / f"survey_{number:02d}.html", survey_page(survey))
    key.write(folder / "key.json")
    return len(surveys)
