"""Measure the speed of sampling: batching, padding, methods against each other, and ours against the published loop.

Methods are compared in time and in the number of denoised frames.

    stmc benchmark MTT.txt          batches of a file's timelines
    stmc benchmark edit=true        an edit in the studio, stage by stage
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, cast, get_args

import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track
from rich.table import Table

import stmc
from stmc.cli.commands import command
from stmc.cli.shared_settings import OnModel
from stmc.composing import Method, Run, find_method
from stmc.evaluation.published_sampling import published_loop
from stmc.evaluation.results.naming import method_row
from stmc.evaluation.roofline import Roofline, measure_roofline
from stmc.io.extras import require
from stmc.io.files import write_text
from stmc.model import Precision
from stmc.settings.records import SettingError, setting

Sampling = Callable[[], list[stmc.Motion]]
"""A call that samples motions."""

Row = tuple[str, str]
"""The name and the value of a measurement."""


@dataclass(frozen=True, kw_only=True)
class Settings(OnModel):
    """Settings of `stmc benchmark`."""

    timelines: str | None = setting(None, "file of timelines, such as MTT.txt; null: measure the `edit` alone")
    method: str = setting("stmc", "method to measure; stmc_paper: STMC as published")
    baselines: tuple[Mapping, ...] = setting(
        ({"method": "sinc", "model": "${model}"},), "methods to compare with, each with its model"
    )
    batch: int = setting(32, "number of timelines per batch", at_least=1)
    steps: int = setting(10, "denoising steps", at_least=1)
    published: bool = setting(
        False, "also measure the published loop (fp32, two calls a step over all crops, padded to the longest)"
    )
    roofline: bool = setting(False, "also measure a step beside this processor's peak of matrix products and bandwidth")
    edit: bool = setting(
        False, "also measure edits in the studio, `repeats` of each kind: the time of each stage, and denoised crops"
    )
    precision: str = setting(
        "fp32", "precision of the denoiser; bf16 is fast on some processors", choices=get_args(Precision)
    )
    repeats: int = setting(3, "repetitions of every measurement; the median is reported", at_least=1)
    output: str | None = setting(None, ".json file of the printed numbers; null: none")

    def __post_init__(self) -> None:
        if self.timelines is None and not self.edit:
            raise SettingError("missing: timelines= (file of timelines), or edit=true to measure edits alone")


@command("benchmark", Settings, ("timelines",))
def main(config: DictConfig) -> None:
    precision = cast(Precision, config.precision)  # one of its choices
    model, console, results = stmc.load(config.model, device=config.device, precision=precision), Console(), {}
    if config.timelines is not None:
        title, rows = measure_batches(config, model)
        console.print(print_table(("measured", "value"), rows, title))
        results["batches"] = {"title": title} | dict(rows)
    if config.edit:
        results["edits"] = measure_edits(config, model, console)
    if config.output is not None:
        write_text(Path(config.output).expanduser(), json.dumps(results, indent=1, ensure_ascii=False) + "\n")


def print_table(columns: Sequence[str], rows: Sequence[Sequence[str]], title: str) -> Table:
    """Return rows as a printable table."""
    table = Table(*columns, title=title)
    for row in rows:
        table.add_row(*row)
    return table


def measure_batches(config: DictConfig, model: stmc.Model) -> tuple[str, list[Row]]:
    """Measure batches of the file's timelines; return the title and the rows of the table."""
    timelines = stmc.Timeline.read_all(Path(config.timelines).expanduser())
    chosen = timelines[: config.batch]
    rows = measure_methods(config, model, chosen)
    if config.published:
        rows += measure_published(config, model, chosen)
    if model.device.type != "cpu":
        rows += measure_accelerator(model, stmc.load(config.model), partial(sample_batch, config, timelines=chosen))
    if config.roofline:
        rows += describe_roofline(measure_roofline(model, model.plans(chosen)))
    plans = model.plans(timelines)
    rows += [
        (f"padding, all {len(timelines)} timelines at once", f"{model.guided(plans).padding:.1%}"),
        (f"padding, batches of {config.batch}", f"{batched_padding(model, plans, config.batch):.1%}"),
    ]
    return f"{len(chosen)} timelines, {config.steps} steps, {model.device}", rows


def measure_edits(config: DictConfig, model: stmc.Model, console: Console) -> dict[str, Any]:
    """Measure edits in the studio, print their tables, and return their numbers."""
    require("starlette", "uvicorn")
    from stmc.cli.edit_tables import describe_edits  # not above: the studio comes with an extra
    from stmc.evaluation.edit_profile import list_edits, profile_edits

    show_progress = partial(track, description="Edits", console=console)
    with tempfile.TemporaryDirectory() as folder:
        profile = profile_edits(model, Path(folder), config.steps, list_edits(config.repeats), show_progress)
    for title, columns, rows in describe_edits(profile):
        console.print(print_table(columns, rows, title))
    return asdict(profile)


def sample_batch(
    config: DictConfig,
    model: stmc.Model,
    timelines: stmc.Timeline | Sequence[stmc.Timeline],
    seed: int = 0,
    method: str | Method | None = None,
) -> list[stmc.Motion]:
    """Sample timelines with the measured settings; a method of None is the measured one.

    Prompts are read as they are, as the published loop reads them.
    """
    method = config.method if method is None else method
    return model.generate(timelines, seed=seed, steps=config.steps, method=method, clean_feet=False, restate_from=1)


def measure_methods(config: DictConfig, model: stmc.Model, chosen: Sequence[stmc.Timeline]) -> list[Row]:
    """Measure the batch against its timelines alone and against the baselines, in time and in denoised poses.

    Args:
        config: Settings of the command.
        model: Measured model.
        chosen: Timelines of the batch.
    """
    models = {config.model: model}
    for baseline in config.baselines:
        if baseline.model not in models:
            models[baseline.model] = stmc.load(baseline.model, device=config.device, precision=model.precision)
    methods = [(config.method, config.model), *((baseline.method, baseline.model) for baseline in config.baselines)]
    sample, ratios = partial(sample_batch, config), []
    for _ in track(range(config.repeats), "Repeats"):
        alone, apart = clock(lambda: [sample(model, one, seed)[0] for seed, one in enumerate(chosen)])
        batch, together = clock(lambda: sample(model, chosen))
        spent = [clock(partial(sample, models[place], chosen, 0, name))[0] for name, place in methods[1:]]
        ratios.append((alone / batch, *(batch / seconds for seconds in spent)))
    labels = [f"{method_row(name).label}, {place or 'the bundled model'}" for name, place in methods]
    own = method_row(config.method).label
    names = ["time per timeline, alone / in the batch", *(f"time of {own} / {label}" for label in labels[1:])]
    times = [(name, f"{median(each):.2f}") for name, each in zip(names, zip(*ratios, strict=True), strict=True)]
    counts = [
        (
            f"pose-wise denoising steps for each frame and step, {label}",
            f"{poses_denoised(models[place], list(chosen), name, config.steps):.2f}",
        )
        for label, (name, place) in zip(labels, methods, strict=True)
    ]
    furthest = furthest_joint(apart, together)
    return [*times, *counts, ("largest difference of a joint, batch against alone", f"{furthest:.1e} m")]


def measure_published(config: DictConfig, model: stmc.Model, chosen: Sequence[stmc.Timeline]) -> list[Row]:
    """Measure `stmc_paper` against the published loop in fp32, for one timeline and for the batch.

    Args:
        config: Settings of the command.
        model: Measured model.
        chosen: Timelines of the batch.
    """
    published, rows = published_loop(stmc.load(config.model, device=config.device)), []
    for size in sorted({1, len(chosen)}):
        sample = partial(sample_batch, config, model, chosen[:size])
        ratio, difference = compare(
            partial(sample, method=published), partial(sample, method="stmc_paper"), config.repeats
        )
        name = f"time of the published loop in fp32 / stmc_paper in {model.precision}, batch {size}"
        rows += [
            (name, f"{ratio:.2f}"),
            (f"largest difference of a joint between them, batch {size}", f"{difference:.1e} m"),
        ]
    return rows


def compare(slow: Sampling, fast: Sampling, repeats: int) -> tuple[float, float]:
    """Return the median ratio of the times of two samplings, run in turns, and the largest distance of their joints.

    Args:
        slow: Sampling whose time is divided.
        fast: Sampling to divide by.
        repeats: Number of repetitions of both.
    """
    ratios = []
    for _ in track(range(repeats), "Published loop"):
        (slower, theirs), (faster, ours) = clock(slow), clock(fast)
        ratios.append(slower / faster)
    return median(ratios), furthest_joint(theirs, ours)


def measure_accelerator(
    model: stmc.Model, reference: stmc.Model, sample: Callable[[stmc.Model], list[stmc.Motion]]
) -> list[Row]:
    """Measure a batch in seconds and bytes, and its difference to the same batch on the CPU in fp32.

    Args:
        model: Model on an accelerator.
        reference: The same model on the CPU.
        sample: Call that samples the batch with a model.
    """
    if model.device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(model.device)
    seconds, motions = clock(lambda: sample(model))
    rows = [("time of the batch", f"{seconds:.2f} s")]
    if model.device.type == "cuda":
        rows.append(("largest memory of the batch", f"{torch.cuda.max_memory_allocated(model.device) / 1e9:.2f} GB"))
    difference = furthest_joint(motions, sample(reference))
    return [
        *rows,
        (f"largest difference of a joint, {model.precision} here against fp32 on the CPU", f"{difference:.1e} m"),
    ]


def describe_roofline(roofline: Roofline) -> list[Row]:
    """Name and format the numbers of a roofline."""
    bound = (
        "matrix products" if roofline.flops / roofline.peak_flops >= roofline.moved / roofline.bandwidth else "memory"
    )
    return [
        ("a step: matrix products", f"{roofline.flops / 1e9:.1f} GFLOP"),
        ("a step: memory read and written by its operations", f"{roofline.moved / 1e9:.2f} GB"),
        ("this processor: matrix products", f"{roofline.peak_flops / 1e9:.0f} GFLOP/s"),
        ("this processor: memory", f"{roofline.bandwidth / 1e9:.1f} GB/s"),
        (f"a step: fraction of its time that {bound} at the processor's peak would take", f"{roofline.efficiency:.0%}"),
    ]


def furthest_joint(some: Sequence[stmc.Motion], others: Sequence[stmc.Motion]) -> float:
    """Return the largest difference of a joint's coordinate between motions in pairs, in metres."""
    return max(float((a.joints - b.joints).abs().max()) for a, b in zip(some, others, strict=True))


def clock(run: Sampling) -> tuple[float, list[stmc.Motion]]:
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
