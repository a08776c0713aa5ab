"""Draw the frames that one frame attends to at each denoising step of FlowMDM (its Fig. 2): blue early, red late.

`stmc attention runs/flow_humanml3d` writes the figure and its numbers, and prints the mean distance between the frame
and the frames that it attends to.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import MISSING, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track
from rich.table import Table

import stmc
from stmc.cli.commands import command
from stmc.cli.shared_settings import OnDevice, Threaded
from stmc.denoisers import recorded_attention
from stmc.io.files import write_whole
from stmc.settings.records import SettingError, setting

TABLE_STEPS = 5
"""Number of steps in the table, from the first to the last."""


@dataclass(frozen=True, kw_only=True)
class Settings(OnDevice, Threaded):
    """Settings of `stmc attention`."""

    model: str = setting(MISSING, "run directory of a model with FlowMDM's network")
    timeline: str = setting("walk forwards # 0 # 6", "timeline to sample, as text # start # end; a single track")
    frame: int | None = setting(None, "index of the attending frame; null: the middle one", at_least=0)
    ape_steps: float | int | None = setting(
        1.0,
        "noisiest steps with absolute positions; 1: all, as in the paper's figure; null: the model's default",
        unit="share of steps", at_least=0, at_most=1,
    )  # fmt: skip
    steps: int | None = setting(None, "denoising steps; null: the model's default", at_least=1)
    guidance: float | int | None = setting(None, "classifier-free guidance scale; null: the model's default", above=0)
    seed: int = setting(0, "seed of the motion", at_least=0)
    output: str = setting("outputs/attention", "folder for attention.png and attention.npz")


@command("attention", Settings, ("model", "output"))
def main(config: DictConfig) -> None:
    from stmc.evaluation.results.composition_charts import attention_curves  # not above: it comes with an extra

    console, folder = Console(), Path(config.output).expanduser()
    model = stmc.load(config.model, device=config.device)
    scores, frame = record_scores(model, config, console)
    distance = (scores * np.abs(np.arange(scores.shape[1]) - frame)).sum(axis=1)
    figure = attention_curves(scores, frame)
    write_whole(folder / "attention.png", partial(figure.savefig, format="png", dpi=150))
    write_whole(folder / "attention.npz", partial(save_arrays, scores=scores, frame=frame, distance=distance))
    console.print(distance_table(distance, frame))
    console.print(f"{folder / 'attention.png'}, {folder / 'attention.npz'}", markup=False, soft_wrap=True)


def record_scores(
    model: stmc.Model, config: DictConfig, console: Console
) -> tuple[Float[np.ndarray, "steps frames"], int]:
    """Record the attention of one frame to all frames at every step, noisiest first, with its text; return the frame.

    Raises `SettingError` for a frame beyond the end, and for a timeline that needs several tracks or several calls of
    the denoiser per step.
    """
    timeline = stmc.Timeline.parse(config.timeline)
    frames = timeline.frames(model.fps)
    frame = frames // 2 if config.frame is None else config.frame
    if len(timeline.tracks) > 1:
        raise SettingError(f"the timeline has {len(timeline.tracks)} tracks; this command needs a single one")
    if frame >= frames:
        raise SettingError(f"frame={frame}: the last frame of the timeline is {frames - 1}")
    given = {name: config[name] for name in ("steps", "guidance", "ape_steps") if config[name] is not None}
    steps = 0

    def watched(order: Iterable[Any], total: int) -> Iterable[Any]:
        nonlocal steps
        steps += total
        return track(order, "Steps", total=total, console=console)

    with recorded_attention(model.network, slice(frame, frame + 1)) as calls:
        model.generate(timeline, seed=config.seed, method="flow_mdm", progress=watched, clean_feet=False, **given)
    if len(calls) != steps:
        raise SettingError(
            f"the timeline is too long: {len(calls)} calls of the denoiser for {steps} steps, not one per step"
        )
    return torch.stack([each[0, 0] for each in calls]).numpy(), frame


def save_arrays(path: Path, **arrays: Any) -> None:
    """Write arrays without the suffix that NumPy would append to a temporary name."""
    with path.open("wb") as file:
        np.savez_compressed(file, **arrays)


def distance_table(distance: Float[np.ndarray, " steps"], frame: int) -> Table:
    """Return a table of the mean distance at a few steps."""
    rows = Table("step", "mean distance, frames", title=f"Attention of frame {frame}")
    for step in dict.fromkeys(np.linspace(0, len(distance) - 1, TABLE_STEPS).round().astype(int).tolist()):
        rows.add_row(f"{step + 1} of {len(distance)}", f"{distance[step]:.1f}")
    return rows
