"""Compare methods, samplers and settings on a benchmark: `stmc evaluate experiment=comparison`.

The command writes to the output folder `results.jsonl` (one record per run), `about.json` (the settings shared by all
runs), and for every experiment a table as text and LaTeX, and a figure.
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
from typing import Any, get_args

import torch
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

import stmc
from stmc.cli.commands import command
from stmc.cli.config_parts import build_part
from stmc.cli.shared_settings import OnDevice, Sharded, Threaded
from stmc.composing import find_method, resolve_settings
from stmc.composing.sampling import Sampling
from stmc.evaluation.benchmarks import Benchmark
from stmc.evaluation.benchmarks.samples import Samples
from stmc.evaluation.results import Result, read_results, write_results
from stmc.evaluation.results.naming import REAL
from stmc.evaluation.results.result_records import SETTINGS, Setting
from stmc.io.files import lock_folder, write_text, write_whole
from stmc.model import Precision
from stmc.run import BUNDLED_EVALUATOR, bundled, fingerprint
from stmc.settings.records import record_of, setting
from stmc.settings.shards import Incomplete, Shard, describe_shards


@dataclass(frozen=True, kw_only=True)
class Settings(OnDevice, Threaded, Sharded):
    """Settings of `stmc evaluate`."""

    models: Mapping = setting(
        {"MDM-SMPL": None}, "run directories by their names in the tables (null: the bundled model)"
    )
    evaluator: str | None = setting(None, "run directory; null: the bundled one")
    output: str = setting("outputs/evaluation", "folder for all experiments on one benchmark; they share their runs")
    seeds: tuple[int, ...] = setting((0, 1, 2), "seeds; each one is a separate run", at_least=0)
    batch: int = setting(50, "timelines per batch; an interrupted run loses at most one batch", at_least=1)
    precision: str = setting(
        "bf16", "precision of the denoiser; bf16 is fast on some processors", choices=get_args(Precision)
    )
    trusted: tuple[str, ...] = setting(
        (), "your own packages that define parts of models, or methods such as mylab.rules.mine"
    )

    def __post_init__(self) -> None:
        Shard.read(self.shard)


PATIENCE = math.inf
"""Maximum seconds to wait for another process that measures a run."""


@command("evaluate", Settings, ("output",))
def main(config: DictConfig) -> None:
    """Run everything that the output lacks, then write the table and the figure of the experiment."""
    console, folder, shard = Console(), Path(config.output).expanduser(), Shard.read(config.shard)
    models = {
        name: stmc.load(place, device=config.device, precision=config.precision, trusted=config.trusted)
        for name, place in config.models.items()
    }
    settings = list(dict.fromkeys(choose_settings(config.experiment, models, tuple(config.trusted))))
    for part in ("table", *(["figure"] if config.experiment.figure else [])):
        build_part(config, f"experiment.{part}")  # fail now rather than after the runs
    benchmark = build_benchmark(config)
    with lock_folder(folder, PATIENCE):
        begin(folder, describe_output(config))
    runs = [Run(benchmark, models.get(each.denoiser), each, seed, folder) for seed in config.seeds for each in settings]
    with Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
        TimeRemainingColumn(), console=console, disable=shard.number not in (1, None),
    ) as progress:  # fmt: skip
        task = progress.add_task("Runs", total=len(runs))
        for run in runs:
            if (run.setting, run.seed) not in read_records(folder):
                sample(run, shard, config, progress)
                if not run.samples.missing(run.order):  # else the lock would only delay other processes
                    measure(run)
            progress.advance(task)
    conclude(runs, shard, config, console)


def build_benchmark(config: DictConfig) -> Benchmark:
    """Build the benchmark, with `config.evaluator` unless it has its own, and with its judge if it names one."""
    load = partial(stmc.load_evaluator, device=config.device, trusted=config.trusted)
    given: dict[str, Any] = {"judge": load(judge)} if (judge := config.benchmark.get("judge")) else {}
    benchmark = build_part(config, "benchmark", **given)
    return benchmark() if "evaluator" in config.benchmark else benchmark(evaluator=load(config.evaluator))


def choose_settings(
    experiment: DictConfig, models: dict[str, stmc.Model], trusted: tuple[str, ...]
) -> Iterator[Setting]:
    """Yield all combinations of an experiment, without settings that do not apply and with the models' defaults.

    Settings of a method, and then of a model, replace those of all. Methods that need a text for every frame run with
    networks that accept it only. Raises `SettingError` for unknown names and invalid values.
    """
    methods = {name: find_method(name, trusted) for name in experiment.methods}
    if experiment.real:
        yield Setting(REAL)
    for (name, model), method in itertools.product(models.items(), methods):
        own = experiment.of_methods.get(method, {}), experiment.of_models.get(name, {})
        if model.network.per_frame_text or not methods[method].per_frame_text:
            for each in combinations({**experiment.settings, **own[0], **own[1]}):
                yield Setting(method, name, resolve_settings(each, methods[method], model.own_sampling))


def combinations(settings: Mapping) -> list[Sampling]:
    """Return every combination of the values of the settings."""
    return [
        record_of(Sampling, dict(zip(settings, values, strict=True)))
        for values in itertools.product(*settings.values())
    ]


def describe_output(config: DictConfig) -> dict:
    """Return the conditions that all runs of an output folder share."""
    own = "evaluator" in config.benchmark
    return {
        "models": {name: fingerprint(place) for name, place in config.models.items()},
        "evaluator": None if own else fingerprint(config.evaluator or bundled(BUNDLED_EVALUATOR)),
        "benchmark": OmegaConf.to_container(config.benchmark, resolve=True),
        "precision": config.precision,
        "versions": {"stmc": stmc.__version__, "torch": torch.__version__, "python": platform.python_version()},
    }


def begin(folder: Path, conditions: dict) -> None:
    """Store the shared conditions of the results. Raises `ValueError` if earlier results had other conditions."""
    path = folder / "about.json"
    if path.exists():
        before = json.loads(path.read_text(encoding="utf-8"))
        known = {name: value for name, value in conditions["models"].items() if name in before["models"]}
        if different := [
            key
            for key in conditions
            if (
                known.items() - before[key].items()
                if key == "models"
                else _without_nulls(before.get(key)) != _without_nulls(conditions[key])
            )
        ]:
            raise ValueError(f"{folder} holds results of another {different[0]} ({path}); choose another output folder")
        conditions = conditions | {"models": before["models"] | conditions["models"]}
    write_text(path, json.dumps(conditions, indent=1) + "\n")


def _without_nulls(condition: Any) -> Any:
    """Leave out settings that are null: an earlier version, which did not have them, behaved as with null."""
    return {k: v for k, v in condition.items() if v is not None} if isinstance(condition, dict) else condition


@dataclass(frozen=True)
class Run:
    """One record to be: a setting with a seed. Real motion has no model and nothing to sample."""

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
        """The indices of the timelines, longest first: shards are balanced, and memory runs out early if at all."""
        return sorted(range(len(self.timelines)), key=lambda number: -self.timelines[number].duration)

    @property
    def samples(self) -> Samples:
        """The store of motions until the run is complete."""
        name = "_".join(str(self.setting.value(name)) for name in SETTINGS) + f"_{self.seed}"
        place = self.folder / "unfinished" / re.sub(r"[^\w.-]+", "_", name)
        return Samples(place, 0 if self.model is None else self.model.fps)


def read_records(folder: Path) -> dict[tuple[Setting, int], Result]:
    """Read the records that exist so far, from any process."""
    path = folder / "results.jsonl"
    return {(each.setting, each.seed): each for each in read_results(path)} if path.exists() else {}


def sample(run: Run, shard: Shard, config: DictConfig, progress: Progress) -> None:
    """Sample the missing motions of a shard.

    In bf16 a motion depends slightly on its batch, so incomplete batches are sampled whole.

    Args:
        run: The run that the motions belong to.
        shard: The shard to complete.
        config: Configuration of the command.
        progress: Progress bar, which shows the shard as a task.
    """
    own = shard.of(run.order)
    missing = set(run.samples.missing(own))
    task = progress.add_task(f"{run.setting.denoiser}, {run.setting.method}, seed {run.seed}", total=len(own))
    for start in range(0, len(own), config.batch):
        batch = own[start : start + config.batch]
        lacking = [number for number in batch if number in missing]
        numbers = batch if lacking and config.precision == "bf16" else lacking
        if numbers:
            motions, seconds = generate(run, numbers, config)
            for number, motion in zip(numbers, motions, strict=True):
                if number in missing:
                    run.samples.write(number, motion, seconds)
        progress.advance(task, len(batch))
    progress.remove_task(task)


def generate(run: Run, numbers: list[int], config: DictConfig) -> tuple[list[stmc.Motion], float | None]:
    """Sample motions, each with its own seed; return them, and seconds per motion on an accelerator.

    Times on a CPU would rather reflect its other load.
    """
    assert run.model is not None  # recorded motion has no timelines to sample
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
    """Add the run's record once all its motions exist, unless another process did; return the missing indices."""
    with lock_folder(run.folder, PATIENCE):
        results = read_records(run.folder)
        if (run.setting, run.seed) in results:
            return []
        if missing := run.samples.missing(run.order):
            return missing
        write_results([*results.values(), compute_result(run)], run.folder / "results.jsonl")
        run.samples.remove()
        return []


def compute_result(run: Run) -> Result:
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
    """Report complete results, or list missing ones. Raises `Incomplete` if only completeness was to be checked."""
    missing: Counter[Shard] = Counter()
    for run in runs:
        missing.update(shard.count_missing(run.order, measure(run)))
    if not missing:
        results = read_records(runs[0].folder)
        report([results[run.setting, run.seed] for run in runs], config, console)
        return
    message = f"{config.output}: motions are missing of {describe_shards(missing)}"
    if shard.number is None:
        raise Incomplete(f"{message}; run these shards, or omit shard= to sample all missing motions")
    console.print(f"shard {shard} is complete; {message}", markup=False, soft_wrap=True)


def report(results: list[Result], config: DictConfig, console: Console) -> None:
    """Write the table as text and LaTeX, and the figure, beside the records."""
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
