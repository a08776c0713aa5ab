"""Makes a perceptual study of two methods: `python scripts/study.py first=FOLDER second=FOLDER timelines=PATH`.

Every setting is in configs/study.yaml.
"""

from pathlib import Path

import hydra
from omegaconf import DictConfig
from rich.console import Console

import stmc
from stmc.files import write_text
from stmc.study import StudyError, design, read_pairs, survey_page


@hydra.main(config_path="../configs", config_name="study", version_base="1.3")
def main(config: DictConfig) -> None:
    folder = Path(config.output).expanduser()
    try:
        surveys = made(config, folder)
    except (ValueError, OSError) as error:
        raise SystemExit(str(error)) from error
    console = Console()
    console.print(f"{surveys} surveys in {folder.resolve() / 'surveys'}: give each rater one of the pages")
    console.print(f"the answer key is {folder.resolve() / 'key.json'}: keep it to yourself")


def made(config: DictConfig, folder: Path) -> int:
    """Writes the pages, then the key; how many pages."""
    if (folder / "key.json").exists():
        raise StudyError(f"{folder} holds a study already, whose key its answers need; choose another output")
    first, second = (Path(config[side]).expanduser() for side in ("first", "second"))
    pairs = read_pairs(first, second, stmc.Timeline.read_all(Path(config.timelines).expanduser()))
    names = (config.names[0] or first.name, config.names[1] or second.name)
    surveys, key = design(pairs, names, config.seed, config.size)
    for number, survey in enumerate(surveys, start=1):
        write_text(folder / "surveys" / f"survey_{number:02d}.html", survey_page(survey))
    key.write(folder / "key.json")
    return len(surveys)


if __name__ == "__main__":
    main()
