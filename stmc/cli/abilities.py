"""Measure what a model can do, by the geometry of its samples: `stmc abilities model=RUN`."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, get_args

import numpy as np
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

import stmc
from stmc.cli.commands import command
from stmc.cli.shared_settings import OnModel
from stmc.data.cache import Cache, read_caches
from stmc.diffusion import NoiseScale
from stmc.evaluation.benchmarks.ability import abilities
from stmc.evaluation.metrics.action_measures import mean_speed
from stmc.io.extras import require
from stmc.io.files import write_text, write_whole
from stmc.model import Precision
from stmc.motion import kinematics
from stmc.settings.records import setting


@dataclass(frozen=True, kw_only=True)
class Settings(OnModel):
    """Settings of `stmc abilities`."""

    samples: int = setting(32, "number of motions of each ability", at_least=2)
    seed: int = setting(0, "seed of the first motion", at_least=0)
    guidance: float | int | None = setting(
        None, "classifier-free guidance scale; null: the model's default", at_least=0
    )
    overlap: float | int = setting(0.5, "length of transitions", unit="s", at_least=0)
    steps: int | None = setting(None, "denoising steps; null: as many as in training", at_least=1)
    noise_scales: tuple[str, ...] = setting(
        ("std", "variance"), "scales of DDPM's noise to compare", choices=get_args(NoiseScale)
    )
    cache: tuple[str, ...] = setting(
        (), "folders of prepared data whose test split gives the foot sliding of real motion"
    )
    output: str = setting("outputs/abilities", "folder for pictures and numbers")
    precision: str = setting(
        "bf16", "precision of the denoiser; bf16 is fast on some processors", choices=get_args(Precision)
    )


@command("abilities", Settings, ("model", "output"))
def main(config: DictConfig) -> None:
    require("matplotlib")
    model, folder = stmc.load(config.model, device=config.device, precision=config.precision), Path(config.output)
    folder.mkdir(parents=True, exist_ok=True)
    settings = {name: config[name] for name in ("seed", "guidance", "overlap", "steps")}
    results: dict[str, dict[str, Any]] = {}
    with Progress() as progress:
        task = progress.add_task("Sampling", total=len(config.noise_scales) * len(abilities()))
        for scale in config.noise_scales:
            for ability in abilities():
                motions = model.generate(
                    [ability.timeline] * config.samples, noise_scale=scale, clean_feet=False, **settings
                )
                results.setdefault(ability.name, {})[scale] = measure_motions(ability, motions)
                figure = partial(stmc.film_strip(motions[0], ability.timeline).savefig, format="png", dpi=80)
                write_whole(folder / f"{ability.name.replace(' ', '_')}_{scale}.png", figure)
                progress.advance(task)
    if config.cache:
        results["real"] = measure_real_sliding(read_caches(list(config.cache)), model)
    write_text(folder / "abilities.json", json.dumps(results, indent=1) + "\n")
    print_report(results, config.noise_scales)


def measure_motions(ability, motions) -> dict[str, float]:
    """Measure motions: success rate, expected rate, speed (m/s), turn (degrees), foot sliding and diversity (cm)."""
    return {
        "shown": float(np.mean([ability.shown(motion) for motion in motions])),
        "expected": ability.expected,
        "speed": float(np.mean([mean_speed(motion) for motion in motions])),
        "turn": float(np.degrees(np.mean([kinematics.turn(motion) for motion in motions]))),
        "sliding_cm": 100 * float(np.nanmean([kinematics.foot_sliding(motion) for motion in motions])),
        "diversity_cm": 100 * kinematics.diversity(motions),
    }


def measure_real_sliding(cache: Cache, model: stmc.Model) -> dict[str, float]:
    """Measure the foot sliding of the test split's real clips, in cm by content."""
    contents: dict[str, list[float]] = {}
    for clip in cache.clips:
        if clip.split == "test":
            motion = model.representation.decode(cache.features[clip.start : clip.end], cache.fps, model.skeleton)
            contents.setdefault(clip.content, []).append(100 * kinematics.foot_sliding(motion))
    return {content: float(np.nanmean(values)) for content, values in sorted(contents.items())}


def print_report(results: dict, noise_scales: list[str]) -> None:
    """Print the table of the results."""
    columns = ("success", "m/s", "°", "slide cm", "div cm")
    table = Table("", "expected", *(f"{column}, {scale}" for scale in noise_scales for column in columns))
    for name, rows in results.items():
        if name == "real":
            continue
        cells = [
            text
            for scale in noise_scales
            for row in [rows[scale]]
            for text in (
                f"{row['shown']:.0%}", f"{row['speed']:.2f}", f"{row['turn']:.0f}", f"{row['sliding_cm']:.2f}",
                f"{row['diversity_cm']:.1f}",
            )
        ]  # fmt: skip
        table.add_row(name, f"{rows[noise_scales[0]]['expected']:.0%}", *cells)
    Console().print(table)
    for content, value in results.get("real", {}).items():
        Console().print(f"real {content}: feet slide {value:.2f} cm per frame of contact")
