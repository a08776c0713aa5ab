"""Compares methods, samplers and settings on a benchmark: `python scripts/evaluate.py experiment=comparison`.

Every setting is in configs/evaluate.yaml. The output holds `results.jsonl` (a record per run), `about.json` (what all
of them were made with), and every experiment's table as text and LaTeX, and its figure.
"""

import itertools
import json
import platform
import re
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from shutil import rmtree
from typing import get_args

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from safetensors.torch import load_file, save_file

import stmc
from stmc.benchmarks import Benchmark
from stmc.commands import command
from stmc.commands.shared import OnDevice, Threaded
from stmc.composing import find_method, settled
from stmc.files import remove_leftovers, write_text, write_whole
from stmc.model import Precision
from stmc.results import Result, read_results, write_results
from stmc.results.naming import REAL
from stmc.results.records import SETTINGS, Setting
from stmc.run import BUNDLED_EVALUATOR, bundled, fingerprint
from stmc.sampling import Sampling
from stmc.settings import record_of, setting


@dataclass(frozen=True, kw_only=True)
class Settings(OnDevice, Threaded):
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


@command("evaluate", Settings, ("output",))
def main(config: DictConfig) -> None:
    """Runs whatever is not in the output yet, then writes the tables and the figure of all that was asked for."""
    console, folder = Console(), Path(config.output).expanduser()
    if config.threads:
        torch.set_num_threads(config.threads)
    evaluator = stmc.load_evaluator(config.evaluator, device=config.device, trusted=config.trusted)
    models = {
        name: stmc.load(place, device=config.device, precision=config.precision, trusted=config.trusted)
        for name, place in config.models.items()
    }
    settings = list(dict.fromkeys(chosen(config.experiment, models, tuple(config.trusted))))
    benchmark = instantiate(config.benchmark)(evaluator=evaluator)
    remove_leftovers(folder)
    results = begun(folder, about(config))
    with Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
        TimeRemainingColumn(), console=console,
    ) as progress:  # fmt: skip
        runs = [(setting, seed) for seed in config.seeds for setting in settings]
        task = progress.add_task("Runs", total=len(runs))
        for setting, seed in runs:
            if not any(result.setting == setting and result.seed == seed for result in results):
                results.append(run(benchmark, models, setting, seed, config, progress))
                write_results(results, folder / "results.jsonl")
            progress.advance(task)
    report([result for result in results if (result.setting, result.seed) in runs], config, console)


def chosen(experiment: DictConfig, models: dict[str, stmc.Model], trusted: tuple[str, ...]) -> Iterator[Setting]:
    """All combinations of an experiment, each with what does not apply to it left out, and the model's own where the
    experiment leaves it open. A method that needs a text for every frame is of such networks alone. Raises
    `SettingError` for unknown names and values that do not fit."""
    methods = {name: find_method(name, trusted) for name in experiment.methods}
    grid = itertools.product(*experiment.settings.values())
    combinations = [record_of(Sampling, dict(zip(experiment.settings, values, strict=True))) for values in grid]
    if experiment.real:
        yield Setting(REAL)
    for (name, model), method, asked in itertools.product(models.items(), methods, combinations):
        if model.network.per_frame_text or not methods[method].per_frame_text:
            yield Setting(method, name, settled(asked, methods[method], model.own_sampling))


def about(config: DictConfig) -> dict:
    """What every run of an output shares, beside its settings."""
    return {
        "models": {name: fingerprint(place) for name, place in config.models.items()},
        "evaluator": fingerprint(config.evaluator or bundled(BUNDLED_EVALUATOR)),
        "benchmark": OmegaConf.to_container(config.benchmark, resolve=True),
        "precision": config.precision,
        "versions": {"stmc": stmc.__version__, "torch": torch.__version__, "python": platform.python_version()},
    }


def begun(folder: Path, told: dict) -> list[Result]:
    """The results that are there. Raises `ValueError` where they were made with something else: they do not compare."""
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
    return read_results(folder / "results.jsonl") if (folder / "results.jsonl").exists() else []


def run(
    benchmark: Benchmark,
    models: dict[str, stmc.Model],
    setting: Setting,
    seed: int,
    config: DictConfig,
    progress: Progress,
) -> Result:
    """One record: sampled and measured. Seconds per motion are recorded on an accelerator alone: those of a CPU say
    more of its other work."""
    if setting.method == REAL:
        scores, seconds = benchmark.real(seed), {}
    else:
        motions, seconds = sampled(benchmark, models[setting.denoiser], setting, seed, config, progress)
        scores = benchmark.measured(setting.method, motions, seed)
        rmtree(unfinished(setting, seed, config))
    return Result(seed=seed, metrics=scores.metrics | seconds, curves=scores.curves, **vars(setting))


def sampled(
    benchmark: Benchmark,
    model: stmc.Model,
    setting: Setting,
    seed: int,
    config: DictConfig,
    progress: Progress,
) -> tuple[list[stmc.Motion], dict[str, float]]:
    """A motion for each of the benchmark's timelines, and on an accelerator the seconds that one took, of those that
    were not there yet."""
    timelines = benchmark.timelines(setting.method)
    order = sorted(range(len(timelines)), key=lambda number: -timelines[number].duration)
    parts = unfinished(setting, seed, config)
    motions, spent, made = {}, 0.0, 0
    task = progress.add_task(f"{setting.denoiser}, {setting.method}, seed {seed}", total=len(order))
    for start in range(0, len(order), config.batch):
        numbers = order[start : start + config.batch]
        path = parts / f"{config.batch}_{start}.safetensors"
        if not path.exists():
            seeds = [seed * len(timelines) + number for number in numbers]
            began = time.perf_counter()
            chosen = [timelines[number] for number in numbers]
            method = find_method(setting.method, config.trusted)
            batch = model.generate(
                chosen, seed=seeds, method=method, joints_from=benchmark.joints_from, **setting.sampling.given
            )
            spent, made = spent + time.perf_counter() - began, made + len(batch)
            write_whole(path, partial(save_file, packed(batch)))
        motions |= dict(zip(numbers, unpacked(load_file(path), model.fps), strict=True))
        progress.advance(task, len(numbers))
    progress.remove_task(task)
    timed = made and model.device.type != "cpu"
    return [motions[number] for number in range(len(timelines))], {"seconds": spent / made} if timed else {}


def unfinished(setting: Setting, seed: int, config: DictConfig) -> Path:
    """Where the motions of a run wait for the others."""
    name = "_".join(str(setting.value(name)) for name in SETTINGS) + f"_{seed}"
    return Path(config.output).expanduser() / "unfinished" / re.sub(r"[^\w.-]+", "_", name)


PACKED = ("rotations", "translation", "joints")


def packed(motions: list[stmc.Motion]) -> dict[str, torch.Tensor]:
    return {f"{n}.{name}": getattr(each, name).contiguous() for n, each in enumerate(motions) for name in PACKED}


def unpacked(values: dict[str, torch.Tensor], fps: float) -> list[stmc.Motion]:
    count = len(values) // len(PACKED)
    return [stmc.Motion(*(values[f"{number}.{name}"] for name in PACKED), fps) for number in range(count)]


def report(results: list[Result], config: DictConfig, console: Console) -> None:
    """The table as text and LaTeX, and the figure, beside the records."""
    folder = Path(config.output).expanduser()
    table = instantiate(config.experiment.table)(results)
    name = config.experiment.name
    for kind, content in (("txt", table.text()), ("tex", table.latex())):
        write_text(folder / f"{name}.{kind}", content)
    if config.experiment.figure:
        figure = instantiate(config.experiment.figure)(results)
        write_whole(folder / f"{name}.png", partial(figure.savefig, format="png", dpi=150))
    console.print(table.text(), highlight=False, markup=False, soft_wrap=True)
    console.print(f"records, table and figure in {folder.resolve()}")


if __name__ == "__main__":
    sys.exit(main())
