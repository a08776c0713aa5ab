"""Makes run directories of published checkpoints: `python scripts/import_checkpoint.py source=PATH output=runs/mdm`."""

import hydra
from omegaconf import DictConfig
from rich.console import Console

from stmc.published import convert
from stmc.run import CARD, CONFIG
from stmc.run.configs import read_config


@hydra.main(config_path="../configs", config_name="import_checkpoint", version_base="1.3")
def main(config: DictConfig) -> None:
    try:
        folder = convert(config.source, config.output, config.statistics, config.text_model)
    except (ValueError, OSError) as error:
        raise SystemExit(str(error)) from error
    Console().print((folder / CARD).read_text(encoding="utf-8"), markup=False)
    hint = f": try python scripts/sample.py model={folder}" if "denoiser" in read_config(folder / CONFIG) else ""
    Console().print(f"in {folder}{hint}", markup=False)


if __name__ == "__main__":
    main()
