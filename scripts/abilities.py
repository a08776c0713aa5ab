"""Measures what a model can do, by the geometry of its samples: `python scripts/abilities.py model=RUN`."""

import json
from pathlib import Path

import hydra
import numpy as np
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

import stmc
from stmc.benchmarks.ability import abilities, mean_speed
from stmc.data.cache import Cache
from stmc.files import write_text, write_whole
from stmc.metrics import kinematics
from stmc.viewing import pictures


@hydra.main(config_path="../configs", config_name="abilities", version_base="1.3")
def main(config: DictConfig) -> None:
    model, folder = stmc.load(config.model, device=config.device, precision=config.precision), Path(config.output)
    folder.mkdir(parents=True, exist_ok=True)
    results = {}
    with Progress() as progress:
        task = progress.add_task("Sampling", total=len(config.noise_scales) * len(abilities()))
        for scale in config.noise_scales:
            for ability in abilities():
                motions = model.generate(
                    [ability.timeline] * config.samples,
                    seed=config.seed,
                    guidance=config.guidance,
                    overlap=config.overlap,
                    steps=config.steps,
                    noise_scale=scale,
                )
                results.setdefault(ability.name, {})[scale] = measured(ability, motions)
                figure = partial(pictures(motions[0], ability.timeline).savefig, format="png", dpi=80)
                write_whole(folder / f"{ability.name.replace(' ', '_')}_{scale}.png", figure)
                progress.advance(task)
    if config.cache:
        results["real"] = real(Cache.read(Path(config.cache)), model)
    write_text(folder / "abilities.json", json.dumps(results, indent=1) + "\n")
    report(results, config.noise_scales)


def measured(ability, motions) -> dict[str, float]:
    """Share of motions that show the ability, and what else they tell."""
    return {
        "shown": float(np.mean([ability.shown(motion) for motion in motions])),
        "expected": ability.expected,
        "speed": float(np.mean([mean_speed(motion) for motion in motions])),
        "turn": float(np.degrees(np.mean([kinematics.turn(motion) for motion in motions]))),
        "sliding_cm": 100 * float(np.nanmean([kinematics.foot_sliding(motion) for motion in motions])),
        "diversity_cm": 100 * kinematics.diversity(motions),
    }


def real(cache: Cache, model: stmc.Model) -> dict[str, float]:
    """Foot sliding of the test split's real clips, by content."""
    contents = {}
    for clip in cache.clips:
        if clip.split == "test":
            motion = model.representation.decode(cache.features[clip.start : clip.end], cache.fps, model.skeleton)
            contents.setdefault(clip.content, []).append(100 * kinematics.foot_sliding(motion))
    return {content: float(np.nanmean(values)) for content, values in sorted(contents.items())}


def report(results: dict, noise_scales: list[str]) -> None:
    columns = ("shown", "m/s", "°", "slide cm", "div cm")
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


if __name__ == "__main__":
    main()
