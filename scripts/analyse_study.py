"""What raters prefer: `python scripts/analyse_study.py study=outputs/study answers=FOLDER`.

Every setting is in configs/analyse_study.yaml.
"""

import json
from pathlib import Path

import hydra
from omegaconf import DictConfig

from stmc.files import write_text
from stmc.study import Analysis, Key, StudyError, analyse, read_answers


@hydra.main(config_path="../configs", config_name="analyse_study", version_base="1.3")
def main(config: DictConfig) -> None:
    folder = Path(config.study).expanduser()
    try:
        analysis = analysed(folder, Path(config.answers).expanduser())
    except (ValueError, OSError) as error:
        raise SystemExit(str(error)) from error
    contents = {"txt": analysis.text(), "json": json.dumps(analysis.data(), indent=1, ensure_ascii=False) + "\n"}
    for kind, content in contents.items():
        write_text(folder / f"analysis.{kind}", content)
    print(analysis.text(), end="")


def analysed(folder: Path, answers: Path) -> Analysis:
    """Of every answer file in a folder."""
    key = Key.read(folder / "key.json")
    paths = sorted(answers.glob("*.json"))
    if not paths:
        raise StudyError(f"{answers} has no answer files (.json)")
    return analyse(key, read_answers(paths, key))


if __name__ == "__main__":
    main()
