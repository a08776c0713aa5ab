"""Measure the speed of sampling: batching, padding, and methods against each other.

Methods are compared in time and in the number of denoised frames.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, replace
from functools import partial
from pathlib import Path
from statistics import median

from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track
from rich.table import Table

import stmc
from stmc.cli.commands import command
from stmc.cli.shared_settings import OnModel
from stmc.composing import Run, find_method
from stmc.evaluation.results.naming import method_row
from stmc.settings.records import setting


@dataclass(frozen=True, kw_only=True)
class Settings(OnModel):
    """Settings of `stmc benchmark`."""

    timelines: str = setting(MISSING, "file of timelines, such as MTT.txt")
    method: str = setting("stmc", "method to measure; stmc_paper: STMC as published")
    baselines: tuple[Mapping, ...] = setting(
        ({"method": "sinc", "model": "${model}"},), "methods to compare with, each with its model"
    )
    batch: int = setting(32, "number of timelines per batch", at_least=1)
    steps: int = setting(10, "denoising steps", at_least=1)
    repeats: int = setting(3, "repetitions of every measurement; the median is reported", at_least=1)


@command("benchmark", Settings, ("timelines",))
def main(config: DictConfig) -> None:
    baselines = [(baseline.method, baseline.model) for baseline in config.baselines]
    places = {config.model, *(place for _, place in baselines)}
    models = {place: stmc.load(place, device=config.device) for place in places}
    model = models[config.model]
    timelines = stmc.Timeline.read_all(Path(config.timelines).expanduser())
    chosen = timelines[: config.batch]

    def sample_motions(
        model: stmc.Model,
        timelines: stmc.Timeline | Sequence[stmc.Timeline],
        seed: int,
        method: str = config.method,
    ) -> list[stmc.Motion]:
        return model.generate(timelines, seed=seed, steps=config.steps, method=method, clean_feet=False)

    rows = []
    for _ in track(range(config.repeats), "Repeats"):
        alone, apart = clock(lambda: [sample_motions(model, one, seed)[0] for seed, one in enumerate(chosen)])
        batch, together = clock(lambda: sample_motions(model, chosen, 0))
        spent = [clock(partial(sample_motions, models[place], chosen, 0, name))[0] for name, place in baselines]
        rows.append((alone / batch, *(batch / seconds for seconds in spent)))
    difference = max(float((a.joints - b.joints).abs().max()) for a, b in zip(apart, together, strict=True))
    works = [
        (
            f"{method_row(name).label}, {place or 'the bundled model'}",
            poses_denoised(models[place], chosen, name, config.steps),
        )
        for name, place in [(config.method, config.model), *baselines]
    ]
    plans = model.plans(timelines)
    table = Table("measured", "value", title=f"{len(chosen)} timelines, {config.steps} steps, {model.device}")
    own = method_row(config.method).label
    names = [f"time of {own} / {method_row(name).label}, {place or 'the bundled model'}" for name, place in baselines]
    for name, ratios in zip(["time per timeline, alone / in the batch", *names], zip(*rows, strict=True), strict=True):
        table.add_row(name, f"{median(ratios):.2f}")
    for name, work in works:
        table.add_row(f"pose-wise denoising steps for each frame and step, {name}", f"{work:.2f}")
    table.add_row("largest difference of a joint, batch against alone", f"{difference:.1e} m")
    table.add_row(f"padding, all {len(timelines)} timelines at once", f"{model.guided(plans).padding:.1%}")
    table.add_row(f"padding, batches of {config.batch}", f"{batched_padding(model, plans, config.batch):.1%}")
    Console().print(table)


def clock(run) -> tuple[float, list[stmc.Motion]]:
    """Time a call and return seconds and result; results are on the CPU, so an accelerator has finished by then."""
    start = time.perf_counter()
    motions = run()
    return time.perf_counter() - start, motions


def poses_denoised(model: stmc.Model, timelines: list[stmc.Timeline], method: str, steps: int) -> float:
    """Count how often a frame is denoised per step, on average.

    This is FlowMDM's measure of efficiency (section 4.2) and independent of the machine. Overlapping crops,
    transitions, a second take and guidance add to it.
    """
    chosen, predictors = find_method(method), []

    def record_calls(make):
        def call(*given, **settings):
            predictors.append(make(*given, **settings))
            return predictors[-1]

        return call

    def sample(run: Run):
        return chosen.sample(
            replace(run, guided=record_calls(run.guided), guided_sequences=record_calls(run.guided_sequences))
        )

    motions = model.generate(timelines, steps=steps, method=replace(chosen, sample=sample), clean_feet=False)
    return sum(each.frames_denoised for each in predictors) / (steps * sum(motion.frames for motion in motions))


def batched_padding(model: stmc.Model, plans: list[stmc.Plan], size: int) -> float:
    """Return the mean padding of the batches in which sampling would arrange these plans."""
    batches = [plans[start : start + size] for start in range(0, len(plans), size)]
    return sum(model.guided(batch).padding for batch in batches) / len(batches)
