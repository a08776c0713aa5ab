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
from stmc.denoisers import FlowMdm
from stmc.diffusion import SAMPLERS
from stmc.files import write_text, write_whole
from stmc.model import OWN_LATE, Precision
from stmc.representation import JointsFrom
from stmc.results import Result, read_results, write_results
from stmc.results.naming import ALONE, METHODS, REAL
from stmc.results.records import Setting
from stmc.run import BUNDLED_EVALUATOR, bundled, fingerprint
from stmc.settings import setting


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


@command("evaluate", Settings, ("output",))
def main(config: DictConfig) -> None:
    """Runs whatever is not in the output yet, then writes the tables and the figure of all that was asked for."""
    console, folder = Console(), Path(config.output).expanduser()
    if config.threads:
        torch.set_num_threads(config.threads)
    evaluator = stmc.load_evaluator(config.evaluator, device=config.device)
    models = {
        name: stmc.load(place, device=config.device, precision=config.precision)
        for name, place in config.models.items()
    }
    settings = list(dict.fromkeys(chosen(config.experiment, models)))
    benchmark = instantiate(config.benchmark)(judge=evaluator)
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


def chosen(experiment: DictConfig, models: dict[str, stmc.Model]) -> Iterator[Setting]:
    """All combinations of an experiment, each with what does not apply to it left out, and the model's own where the
    experiment leaves it open. FlowMDM's own method is of its networks alone. Raises `ValueError` for unknown names."""
    for name, given, choices in (
        ("methods", experiment.methods, [name for name in METHODS if name != REAL]),
        ("settings.sampler", experiment.settings.sampler, SAMPLERS),
    ):
        if unknown := [each for each in given if each not in choices]:
            raise ValueError(f"experiment.{name}: unknown {unknown[0]!r}; choose from {', '.join(choices)}")
    if experiment.real:
        yield Setting(REAL, "", *[None] * (len(Setting._fields) - 2))
    grid = itertools.product(*experiment.settings.values())
    combinations = [dict(zip(experiment.settings, values, strict=True)) for values in grid]
    for (name, model), method, values in itertools.product(models.items(), experiment.methods, combinations):
        flow = isinstance(model.denoiser, FlowMdm)
        if method == "flow_mdm" and not flow:
            continue
        own = {
            "steps": model.schedule.steps,
            "guidance": model.guidance,
            "spread": model.spread,
            "late": model.late,
            "absolute": round(1 - model.denoiser.absolute_from / model.schedule.steps, 6) if flow else None,
        }
        values = {key: own.get(key) if value is None else value for key, value in values.items()}
        if values["sampler"] != "ddpm":
            values["spread"] = None
        if method not in OWN_LATE:
            values["late"] = None
        if not flow:
            values["absolute"] = None
        if method in (ALONE, "one_text", "sinc", "flow_mdm"):
            values["overlap"] = None
        yield Setting(method, name, **values)


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
    return Result(seed=seed, metrics=scores.metrics | seconds, curves=scores.curves, **setting._asdict())


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
            batch = generated(model, setting, [timelines[number] for number in numbers], seeds, benchmark.joints_from)
            spent, made = spent + time.perf_counter() - began, made + len(batch)
            write_whole(path, partial(save_file, packed(batch)))
        motions |= dict(zip(numbers, unpacked(load_file(path), model.fps), strict=True))
        progress.advance(task, len(numbers))
    progress.remove_task(task)
    timed = made and model.device.type != "cpu"
    return [motions[number] for number in range(len(timelines))], {"seconds": spent / made} if timed else {}


def unfinished(setting: Setting, seed: int, config: DictConfig) -> Path:
    """Where the motions of a run wait for the others."""
    name = "_".join(str(value) for value in (*setting, seed))
    return Path(config.output).expanduser() / "unfinished" / re.sub(r"[^\w.-]+", "_", name)


def generated(
    model: stmc.Model, setting: Setting, timelines: list[stmc.Timeline], seeds: list[int], joints_from: JointsFrom
) -> list[stmc.Motion]:
    sampler = SAMPLERS[setting.sampler]
    if setting.absolute is not None:
        model.denoiser.absolute_from = round((1 - setting.absolute) * model.schedule.steps)
    return model.generate(
        timelines,
        seed=seeds,
        guidance=setting.guidance,
        overlap=setting.overlap or 0.0,
        steps=setting.steps,
        sampler=partial(sampler, spread=setting.spread) if setting.spread else sampler,
        method="stmc" if setting.method == ALONE else setting.method,
        late=setting.late or 0.0,
        joints_from=joints_from,
    )


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
