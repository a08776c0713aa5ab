"""Compare methods, samplers and settings on a benchmark: `stmc evaluate experiment=comparison`.

The output folder gets `results.jsonl` (a record per run), `about.json` (the settings that all runs share), and for
every experiment a table as text and LaTeX, and a figure.
"""

from __future__ import annotations

import itertools
import json
import math
import platform
import re
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import get_args

import torch
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

import stmc
from stmc.cli.commands import command
from stmc.cli.config_parts import build_part
from stmc.cli.shared_settings import OnDevice, Sharded, Threaded
from stmc.composing import find_method, settled
from stmc.composing.sampling import Sampling
from stmc.evaluation.benchmarks import Benchmark
from stmc.evaluation.benchmarks.samples import Samples
from stmc.evaluation.results import Result, read_results, write_results
from stmc.evaluation.results.naming import REAL
from stmc.evaluation.results.result_records import SETTINGS, Setting
from stmc.io.files import locked, write_text, write_whole
from stmc.model import Precision
from stmc.run import BUNDLED_EVALUATOR, bundled, fingerprint
from stmc.settings.records import record_of, setting
from stmc.settings.shards import Incomplete, Shard, listed


@dataclass(frozen=True, kw_only=True)
class Settings(OnDevice, Threaded, Sharded):
    """Settings of `stmc evaluate`."""

    models: Mapping = setting({"MDM-SMPL": None}, "names for the tables: run directories (null: the bundled model)")
    evaluator: str | None = setting(None, "run directory; null: the bundled one")
    output: str = setting(
        "outputs/evaluation", "folder of all experiments on one benchmark: what one has run, the others need not"
    )
    seeds: tuple[int, ...] = setting((0, 1, 2), "each is a run of its own", at_least=0)
    batch: int = setting(50, "timelines at a time; a killed run loses at most so many", at_least=1)
    precision: str = setting("bf16", "of the denoiser; bf16 is fast on some processors", choices=get_args(Precision))
    trusted: tuple[str, ...] = setting(
        (), "packages of your own that models are made of, or methods named of, as in mylab.rules.mine"
    )

    def __post_init__(self) -> None:
        Shard.asked(self.shard)


PATIENCE = math.inf
"""Seconds to wait for another process that measures: it ends."""


@command("evaluate", Settings, ("output",))
def main(config: DictConfig) -> None:
    """Runs whatever is not in the output yet, then writes the tables and the figure of all that was asked for."""
    console, folder, shard = Console(), Path(config.output).expanduser(), Shard.asked(config.shard)
    models = {
        name: stmc.load(place, device=config.device, precision=config.precision, trusted=config.trusted)
        for name, place in config.models.items()
    }
    settings = list(dict.fromkeys(chosen(config.experiment, models, tuple(config.trusted))))
    for part in ("table", *(["figure"] if config.experiment.figure else [])):
        build_part(config, f"experiment.{part}")  # what cannot be drawn fails now
    benchmark = prepared(config)
    with locked(folder, PATIENCE):
        begin(folder, about(config))
    runs = [Run(benchmark, models.get(each.denoiser), each, seed, folder) for seed in config.seeds for each in settings]
    with Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
        TimeRemainingColumn(), console=console, disable=shard.number not in (1, None),
    ) as progress:  # fmt: skip
        task = progress.add_task("Runs", total=len(runs))
        for run in runs:
            if (run.setting, run.seed) not in recorded(folder):
                sample(run, shard, config, progress)
                if not run.samples.missing(run.order):  # or else others need not wait
                    measure(run)
            progress.advance(task)
    conclude(runs, shard, config, console)


def prepared(config: DictConfig) -> Benchmark:
    """The benchmark, judged by `config.evaluator` unless it brings an evaluator of its own."""
    benchmark = build_part(config, "benchmark")
    if "evaluator" in config.benchmark:
        return benchmark()
    return benchmark(evaluator=stmc.load_evaluator(config.evaluator, device=config.device, trusted=config.trusted))


def chosen(experiment: DictConfig, models: dict[str, stmc.Model], trusted: tuple[str, ...]) -> Iterator[Setting]:
    """All combinations of an experiment, each with what does not apply to it left out, and the model's own where the
    experiment leaves it open. A method that needs a text for every frame is of such networks alone. Raises
    `SettingError` for unknown names and values that do not fit."""
    methods = {name: find_method(name, trusted) for name in experiment.methods}
    asked = {name: combinations({**experiment.settings, **experiment.of_methods.get(name, {})}) for name in methods}
    if experiment.real:
        yield Setting(REAL)
    for (name, model), method in itertools.product(models.items(), methods):
        if model.network.per_frame_text or not methods[method].per_frame_text:
            for each in asked[method]:
                yield Setting(method, name, settled(each, methods[method], model.own_sampling))


def combinations(settings: Mapping) -> list[Sampling]:
    """Every combination of the values of the settings."""
    return [
        record_of(Sampling, dict(zip(settings, values, strict=True)))
        for values in itertools.product(*settings.values())
    ]


def about(config: DictConfig) -> dict:
    """What every run of an output shares, beside its settings."""
    own = "evaluator" in config.benchmark
    return {
        "models": {name: fingerprint(place) for name, place in config.models.items()},
        "evaluator": None if own else fingerprint(config.evaluator or bundled(BUNDLED_EVALUATOR)),
        "benchmark": OmegaConf.to_container(config.benchmark, resolve=True),
        "precision": config.precision,
        "versions": {"stmc": stmc.__version__, "torch": torch.__version__, "python": platform.python_version()},
    }


def begin(folder: Path, told: dict) -> None:
    """Keeps what the results are made with. Raises `ValueError` where they were made with something else: they do not
    compare."""
    path = folder / "about.json"
    if path.exists():
        before = json.loads(path.read_text(encoding="utf-8"))
        known = {name: value for name, value in told["models"].items() if name in before["models"]}
        if different := [
            key
            for key in told
            if (known.items() - before[key].items() if key == "models" else before.get(key) != told[key])
        ]:
            raise ValueError(f"{folder} holds results with another {different[0]} ({path}); choose another output")
        told = told | {"models": before["models"] | told["models"]}
    write_text(path, json.dumps(told, indent=1) + "\n")


@dataclass(frozen=True)
class Run:
    """What becomes one record: a setting with a seed. Real motion has no model, and nothing to sample."""

    benchmark: Benchmark
    model: stmc.Model | None
    setting: Setting
    seed: int
    folder: Path

    @cached_property
    def timelines(self) -> list[stmc.Timeline]:
        """The timelines to sample; none for recorded motion."""
        return [] if self.model is None else self.benchmark.timelines(self.setting.method)

    @cached_property
    def order(self) -> list[int]:
        """The numbers of the timelines, the longest first: shares are alike, and memory runs out early."""
        return sorted(range(len(self.timelines)), key=lambda number: -self.timelines[number].duration)

    @property
    def samples(self) -> Samples:
        """Where the motions wait for the others."""
        name = "_".join(str(self.setting.value(name)) for name in SETTINGS) + f"_{self.seed}"
        place = self.folder / "unfinished" / re.sub(r"[^\w.-]+", "_", name)
        return Samples(place, 0 if self.model is None else self.model.fps)


def recorded(folder: Path) -> dict[tuple[Setting, int], Result]:
    """The records that are there by now, whoever made them."""
    path = folder / "results.jsonl"
    return {(each.setting, each.seed): each for each in read_results(path)} if path.exists() else {}


def sample(run: Run, shard: Shard, config: DictConfig, progress: Progress) -> None:
    """Makes the share's motions that are not there yet. In bf16 a motion depends, a bit, on its batch, so there a batch
    is made whole although only some of its motions are missing."""
    own = shard.of(run.order)
    missing = set(run.samples.missing(own))
    task = progress.add_task(f"{run.setting.denoiser}, {run.setting.method}, seed {run.seed}", total=len(own))
    for start in range(0, len(own), config.batch):
        batch = own[start : start + config.batch]
        lacking = [number for number in batch if number in missing]
        made = batch if lacking and config.precision == "bf16" else lacking
        if made:
            motions, seconds = generated(run, made, config)
            for number, motion in zip(made, motions, strict=True):
                if number in missing:
                    run.samples.write(number, motion, seconds)
        progress.advance(task, len(batch))
    progress.remove_task(task)


def generated(run: Run, numbers: list[int], config: DictConfig) -> tuple[list[stmc.Motion], float | None]:
    """The motions, each with its own seed, and on an accelerator the seconds that one took: those of a CPU say more of
    its other work."""
    began = time.perf_counter()
    motions = run.model.generate(
        [run.timelines[number] for number in numbers],
        seed=[run.seed * len(run.timelines) + number for number in numbers],
        method=find_method(run.setting.method, config.trusted),
        joints_from=run.benchmark.joints_from,
        clean_feet=False,
        **run.setting.sampling.given,
    )
    return motions, None if run.model.device.type == "cpu" else (time.perf_counter() - began) / len(motions)


def measure(run: Run) -> list[int]:
    """Adds the run's record where all motions are there, whoever made them, and nobody else has. Returns the numbers of
    those that are not."""
    with locked(run.folder, PATIENCE):
        results = recorded(run.folder)
        if (run.setting, run.seed) in results:
            return []
        if missing := run.samples.missing(run.order):
            return missing
        write_results([*results.values(), measured(run)], run.folder / "results.jsonl")
        run.samples.remove()
        return []


def measured(run: Run) -> Result:
    """Measure the samples of a run."""
    motions, seconds = [], []
    for number in range(len(run.timelines)):
        motion, spent = run.samples.read(number)
        motions.append(motion)
        seconds += [] if spent is None else [spent]
    real = run.setting.method == REAL
    scores = run.benchmark.real(run.seed) if real else run.benchmark.measured(run.setting.method, motions, run.seed)
    times = {"seconds": math.fsum(seconds) / len(seconds)} if seconds else {}
    found = scores._replace(metrics=scores.metrics | times)
    return Result(seed=run.seed, **found._asdict(), **vars(run.setting))


def conclude(runs: list[Run], shard: Shard, config: DictConfig, console: Console) -> None:
    """The tables once everything is there; else what is missing. Raises `Incomplete` where nothing else was asked."""
    missing: Counter[Shard] = Counter()
    for run in runs:
        missing.update(shard.lacking(run.order, measure(run)))
    if not missing:
        results = recorded(runs[0].folder)
        report([results[run.setting, run.seed] for run in runs], config, console)
        return
    told = f"{config.output}: motions are missing of {listed(missing)}"
    if shard.number is None:
        raise Incomplete(f"{told}; ask for these, or without shard= for all that is missing")
    console.print(f"share {shard} is made; {told}", markup=False, soft_wrap=True)


def report(results: list[Result], config: DictConfig, console: Console) -> None:
    """The table as text and LaTeX, and the figure, beside the records."""
    folder = Path(config.output).expanduser()
    table = build_part(config, "experiment.table")(results)
    name = config.experiment.name
    for kind, content in (("txt", table.text()), ("tex", table.latex())):
        write_text(folder / f"{name}.{kind}", content)
    if config.experiment.figure:
        figure = build_part(config, "experiment.figure")(results)
        write_whole(folder / f"{name}.png", partial(figure.savefig, format="png", dpi=150))
    console.print(table.text(), highlight=False, markup=False, soft_wrap=True)
    console.print(f"records, table and figure in {folder.resolve()}")
