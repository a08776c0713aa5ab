"""Convert a published checkpoint into a run directory: `stmc import PATH runs/mdm`."""

from __future__ import annotations

from dataclasses import MISSING, dataclass

from omegaconf import DictConfig
from rich.console import Console

from stmc.cli.commands import command
from stmc.run import CARD, CONFIG
from stmc.run.configs import read_config
from stmc.run.published import convert
from stmc.settings.records import setting


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of `stmc import`."""

    source: str = setting(
        MISSING,
        "run directory of STMC or TMR, model….pt of MDM or FlowMDM (beside args.json), or folder of MotionDiffuse",
    )
    output: str = setting(MISSING, "run directory to write")
    statistics: str | None = setting(
        None,
        "folder with HumanML3D's Mean.npy and Std.npy (MDM, FlowMDM), BABEL's rfeats_mean.pt and rfeats_std.pt "
        "(FlowMDM), or mean.pt and std.pt (TMR); null: the files that come with the weights",
    )
    text_model: str | None = setting(
        None, "folder or hub name of the text encoder's weights; null: the published weights on the hub"
    )


@command("import_checkpoint", Settings, ("source", "output"))
def main(config: DictConfig) -> None:
    folder = convert(config.source, config.output, config.statistics, config.text_model)
    Console().print((folder / CARD).read_text(encoding="utf-8"), markup=False)
    hint = f": try stmc sample model={folder}" if "denoiser" in read_config(folder / CONFIG) else ""
    Console().print(f"in {folder}{hint}", markup=False)
