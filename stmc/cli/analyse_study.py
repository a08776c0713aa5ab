"""Report what the raters of a study prefer: `stmc analyse_study FOLDER study=outputs/study`."""

from __future__ import annotations

import json
from dataclasses import MISSING, dataclass
from pathlib import Path

from omegaconf import DictConfig

from stmc.cli.commands import command
from stmc.evaluation.study import Analysis, Key, StudyError, analyse, read_answers
from stmc.io.files import write_text
from stmc.settings.records import setting


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of `stmc analyse-study`."""

    answers: str = setting(MISSING, "folder of the answer files that raters sent back")
    study: str = setting("outputs/study", "folder of the study, with key.json; receives analysis.txt and analysis.json")


@command("analyse_study", Settings, ("answers", "study"))
def main(config: DictConfig) -> None:
    folder = Path(config.study).expanduser()
    analysis = analyse_folder(folder, Path(config.answers).expanduser())
    contents = {"txt": analysis.text(), "json": json.dumps(analysis.data(), indent=1, ensure_ascii=False) + "\n"}
    for kind, content in contents.items():
        write_text(folder / f"analysis.{kind}", content)
    print(analysis.text(), end="")


def analyse_folder(folder: Path, answers: Path) -> Analysis:
    """Analyse all answer files of a folder. Raises `StudyError` if there are none."""
    key = Key.read(folder / "key.json")
    paths = sorted(answers.glob("*.json"))
    if not paths:
        raise StudyError(f"{answers} has no answer files (.json)")
    return analyse(key, read_answers(paths, key))
