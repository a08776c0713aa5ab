"""Samples motions of timelines: `python scripts/sample.py timeline=PATH`. Every setting is in configs/sample.yaml."""

import json
import re
from functools import partial
from importlib.resources import files
from pathlib import Path

import hydra
import stmc
import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

SAMPLERS = ("ddpm", "ddim", "dpm_solver")
FORMATS = ("npz", "bvh", "html")
DECIDING = ("model", "seed", "method", "sampler", "spread", "steps", "guidance", "overlap")


@hydra.main(config_path="../configs", config_name="sample", version_base="1.3")
def main(config: DictConfig) -> None:
    console = Console()
    check(config)
    source = Path(config.timeline).expanduser() if config.timeline else files("stmc") / "assets/timelines/walk_and_wave.json"
    jobs = waiting(list(named(stmc.Timeline.read_all(Path(source)), Path(source).stem)), config)
    if not jobs:
        console.print(f"every motion is in {config.output} already")
        return
    device = ("cuda" if torch.cuda.is_available() else "cpu") if config.device == "auto" else config.device
    model, batch = stmc.load(config.model, device=device), max(1, config.batch)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console) as progress:
        task = progress.add_task("Motions", total=len(jobs))
        while jobs:
            try:
                motions = generate(model, jobs[:batch], config, progress)
            except torch.OutOfMemoryError:
                if batch == 1:
                    raise
                torch.cuda.empty_cache()
                batch = batch // 2
                console.print(f"not enough memory: {batch} timelines at a time from here on")
                continue
            for job, motion in zip(jobs[:batch], motions, strict=True):
                save(motion, *job, config)
                progress.advance(task)
            jobs = jobs[batch:]
    console.print(f"motions in {Path(config.output).resolve()}: open an .html in a browser, a .bvh in Blender")


def check(config: DictConfig) -> None:
    """Refuses what would fail only after minutes of sampling."""
    if config.sampler not in SAMPLERS:
        raise SystemExit(f"sampler={config.sampler}: choose from {', '.join(SAMPLERS)}")
    unknown = set(config.formats) - set(FORMATS)
    if unknown or not config.formats:
        raise SystemExit(f"formats={list(config.formats)}: choose from {', '.join(FORMATS)}")
    if config.samples < 1:
        raise SystemExit(f"samples={config.samples}: at least 1")


def named(timelines: list[stmc.Timeline], stem: str):
    """Each timeline with a file name that is its own: its name, or the file's with a number."""
    taken = set()
    for number, timeline in enumerate(timelines):
        base = timeline.name or (stem if len(timelines) == 1 else f"{stem}_{number:04d}")
        base = re.sub(r"[^\w.-]+", "_", base).strip("._") or f"{stem}_{number:04d}"
        name = base if base not in taken else f"{base}_{number:04d}"
        taken.add(name)
        yield name, timeline


def waiting(timelines: list[tuple[str, stmc.Timeline]], config: DictConfig) -> list[tuple[str, stmc.Timeline, int]]:
    """The samples that are not on disk yet, or were made otherwise; the longest first, so that memory runs out early."""
    jobs = [
        (f"{name}_{seed}", timeline, seed)
        for name, timeline in timelines
        for seed in range(config.seed, config.seed + config.samples)
    ]
    return sorted((job for job in jobs if not finished(*job, config)), key=lambda job: -job[1].duration)


def record(timeline: stmc.Timeline, seed: int, config: DictConfig) -> dict:
    """What a motion depends on."""
    settings = {key: config[key] for key in DECIDING} | {"seed": seed}
    return settings | {"timeline": str(timeline), "version": stmc.__version__}


def finished(name: str, timeline: stmc.Timeline, seed: int, config: DictConfig) -> bool:
    folder = Path(config.output)
    try:
        made = json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
    except (FileNotFoundError, json.JSONDecodeError):
        return False
    return made == record(timeline, seed, config) and all((folder / f"{name}.{kind}").exists() for kind in config.formats)


def generate(model: stmc.Model, jobs: list, config: DictConfig, progress: Progress) -> list[stmc.Motion]:
    sampler = getattr(stmc, config.sampler)
    total = config.steps or model.schedule.steps
    with_bar = partial(progress.track, total=total, description=f"Denoising {len(jobs)}")
    motions = model.generate(
        [timeline for _, timeline, _ in jobs],
        seed=[seed for _, _, seed in jobs],
        guidance=config.guidance,
        overlap=config.overlap,
        steps=config.steps,
        sampler=partial(sampler, spread=config.spread) if config.sampler == "ddpm" else sampler,
        method=config.method,
        track=with_bar,
    )
    progress.remove_task(progress.task_ids[-1])
    return motions


def save(motion: stmc.Motion, name: str, timeline: stmc.Timeline, seed: int, config: DictConfig) -> None:
    """The motion's files, then the record that says they are complete."""
    folder = Path(config.output)
    folder.mkdir(parents=True, exist_ok=True)
    for kind in config.formats:
        path = folder / f"{name}.{kind}"
        if kind == "html":
            temporary = path.with_name(f".{path.name}")
            temporary.write_text(stmc.page(motion, timeline, title=name), encoding="utf-8")
            temporary.replace(path)
        else:
            stmc.write(motion, path)
    done = folder / f".{name}.json"
    done.write_text(json.dumps(record(timeline, seed, config), indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    done.replace(folder / f"{name}.json")


if __name__ == "__main__":
    main()
