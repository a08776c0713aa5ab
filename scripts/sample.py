"""Samples motions of timelines: `python scripts/sample.py timeline=PATH`. Every setting is in configs/sample.yaml."""

import json
import re
from collections.abc import Iterator
from functools import partial
from importlib.resources import files
from itertools import chain, count
from pathlib import Path
from typing import Any, get_args

import hydra
import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

import stmc
from stmc.composing import find_method
from stmc.files import write_text
from stmc.model import Precision
from stmc.run import fingerprint
from stmc.sampling import Sampling
from stmc.settings import about, record_of

FORMATS = ("npz", "bvh", "html")
TIMES = (TimeElapsedColumn(), TimeRemainingColumn())
DECIDING = ("seed", "method", "precision", *about(Sampling))
Job = tuple[str, stmc.Timeline, int]
"""A motion to be: its files' name, its timeline, its seed."""


@hydra.main(config_path="../configs", config_name="sample", version_base="1.3")
def main(config: DictConfig) -> None:
    console = Console()
    try:
        check(config)
        source = Path(config.timeline or str(files("stmc") / "assets/timelines/walk_and_wave.json")).expanduser()
        timelines = list(named(stmc.Timeline.read_all(source), source.stem))
        made_by = fingerprint(config.model)
        jobs = waiting(timelines, config, made_by)
        if not jobs:
            console.print(f"every motion is in {config.output} already")
            return
        model = stmc.load(config.model, device=config.device, precision=config.precision)
        model.settings(find_method(config.method, config.trusted), **sampling(config))
        model.plans([timeline for _, timeline, _ in jobs], config.overlap)  # what cannot be planned fails now
    except (ValueError, OSError) as error:
        raise SystemExit(str(error)) from error
    with Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), *TIMES, console=console
    ) as progress:
        for job, motion in sampled(model, jobs, config, progress):
            save(motion, *job, config, made_by)
    console.print(f"motions in {Path(config.output).resolve()}: open an .html in a browser, a .bvh in Blender")


def check(config: DictConfig) -> None:
    """Refuses what would fail only after minutes of sampling."""
    if config.precision not in get_args(Precision):
        raise SystemExit(f"precision={config.precision}: choose from {', '.join(get_args(Precision))}")
    find_method(config.method, config.trusted)
    sampling(config)
    if not config.formats or set(config.formats) - set(FORMATS):
        raise SystemExit(f"formats={list(config.formats)}: choose from {', '.join(FORMATS)}")
    for key in ("samples", "batch"):
        if config[key] < 1:
            raise SystemExit(f"{key}={config[key]}: at least 1")


def sampling(config: DictConfig) -> dict[str, Any]:
    """The settings of `Sampling` that are said."""
    return dict(record_of(Sampling, {name: config[name] for name in about(Sampling)}).given)


def named(timelines: list[stmc.Timeline], stem: str) -> Iterator[tuple[str, stmc.Timeline]]:
    """Each timeline with a file name that is its own: its name, or the file's with a number."""
    taken = set()
    for number, timeline in enumerate(timelines):
        base = timeline.name or (stem if len(timelines) == 1 else f"{stem}_{number:04d}")
        base = re.sub(r"[^\w.-]+", "_", base).strip("._") or f"{stem}_{number:04d}"
        names = chain([base], (f"{base}_{again:04d}" for again in count(number)))
        name = next(name for name in names if name not in taken)
        taken.add(name)
        yield name, timeline


def waiting(timelines: list[tuple[str, stmc.Timeline]], config: DictConfig, made_by: str) -> list[Job]:
    """The samples that are not on disk, or were made otherwise; the longest first, so that memory runs out early."""
    jobs = [
        (f"{name}_{seed}", timeline, seed)
        for name, timeline in timelines
        for seed in range(config.seed, config.seed + config.samples)
    ]
    missing = [job for job in jobs if not finished(*job, config, made_by)]
    return sorted(missing, key=lambda job: -job[1].duration)


def record(timeline: stmc.Timeline, seed: int, config: DictConfig, made_by: str) -> dict:
    """What a motion depends on."""
    prompts = [[prompt.text, prompt.start, prompt.end, sorted(prompt.parts)] for prompt in timeline.prompts]
    settings = {key: config[key] for key in DECIDING} | {"seed": seed, "model": made_by}
    return settings | {"prompts": prompts, "version": stmc.__version__}


def finished(name: str, timeline: stmc.Timeline, seed: int, config: DictConfig, made_by: str) -> bool:
    folder = Path(config.output).expanduser()
    try:
        made = json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
    except (FileNotFoundError, json.JSONDecodeError):
        return False
    files_there = all((folder / f"{name}.{kind}").exists() for kind in config.formats)
    return files_there and made == record(timeline, seed, config, made_by)


def sampled(
    model: stmc.Model, jobs: list[Job], config: DictConfig, progress: Progress
) -> Iterator[tuple[Job, stmc.Motion]]:
    """Every job with its motion; in smaller batches where the memory does not suffice."""
    batch, done, task = config.batch, 0, progress.add_task("Motions", total=len(jobs))
    while done < len(jobs):
        chosen = jobs[done : done + batch]
        try:
            motions = generate(model, chosen, config, progress)
        except torch.OutOfMemoryError:
            if batch == 1:
                raise
            torch.cuda.empty_cache()
            batch = min(batch, len(chosen)) // 2 or 1
            progress.console.print(f"not enough memory: {batch} timelines at a time from here on")
            continue
        for job, motion in zip(chosen, motions, strict=True):
            yield job, motion
            progress.advance(task)
        done += len(chosen)


def generate(model: stmc.Model, jobs: list[Job], config: DictConfig, progress: Progress) -> list[stmc.Motion]:
    task = progress.add_task(f"Denoising {len(jobs)}")
    try:
        return model.generate(
            [timeline for _, timeline, _ in jobs],
            seed=[seed for _, _, seed in jobs],
            method=find_method(config.method, config.trusted),
            progress=partial(progress.track, task_id=task),
            **sampling(config),
        )
    finally:
        progress.remove_task(task)


def save(motion: stmc.Motion, name: str, timeline: stmc.Timeline, seed: int, config: DictConfig, made_by: str) -> None:
    """The motion's files, then the record that says they are complete."""
    folder = Path(config.output).expanduser()
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.json").unlink(missing_ok=True)
    for kind in config.formats:
        if kind == "html":
            write_text(folder / f"{name}.html", stmc.page(motion, timeline, title=name))
        else:
            stmc.write(motion, folder / f"{name}.{kind}")
    done = json.dumps(record(timeline, seed, config, made_by), indent=1, ensure_ascii=False) + "\n"
    write_text(folder / f"{name}.json", done)


if __name__ == "__main__":
    main()
