"""Sample motions of timelines: files to animate with, and pages to look at.

    stmc sample timelines.json outputs/       every timeline of a file
    stmc sample "walk # 0 # 4" outputs/       one timeline: text # start # end, in seconds, # body parts

Run the same command again to resume: motions that are complete, and made with the same settings, are kept.
"""

from __future__ import annotations

import json
import sys
import time
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import cast, get_args

import torch
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

import stmc
from stmc.cli.character_settings import read_settings_character
from stmc.cli.commands import command
from stmc.cli.sample_folder import CHOICES, FORMATS, Job, MotionFolder, default_formats
from stmc.cli.shared_settings import OnModel, Sharded
from stmc.composing import find_method
from stmc.composing.sampling import Sampling
from stmc.diffusion.tensors import resolve_device
from stmc.editing.generate_request import GenerateRequest, names
from stmc.evaluation.verification import Missed, find_missed
from stmc.io.filenames import distinct_names
from stmc.io.files import probe, remove_leftovers, sha256
from stmc.model import Precision
from stmc.run import fingerprint
from stmc.settings.records import SettingError, as_in, quote, setting
from stmc.settings.shards import Incomplete, Shard, describe_shards
from stmc.timeline import PromptWarning, advise_prompt
from stmc.viewing.exports import EXPORTS

EXAMPLE = "'walk # 0 # 4'"
"""An example of a typed timeline."""
TIMES = (TimeElapsedColumn(), TimeRemainingColumn())
BATCH_SIZES = {"cpu": 8, "cuda": 64}
"""Timelines per batch. A GPU is faster with many; a CPU is not, and small batches reach the disk sooner."""
LOG_SECONDS = 30
"""Interval between lines about the steps where the output is not a terminal, in seconds."""


@dataclass(frozen=True, kw_only=True)
class Settings(Sampling, OnModel, Sharded):
    """Settings of `stmc sample`."""

    timeline: str | None = setting(
        None, ".json or .txt file of timelines, or one timeline as text; null: the bundled example"
    )
    output: str = setting("outputs", "folder of the motions")
    method: str = as_in(GenerateRequest, "method")
    keep: str | None = as_in(GenerateRequest, "keep", None)
    change: tuple[str, ...] = as_in(GenerateRequest, "change")
    constraints: str | None = as_in(GenerateRequest, "constraints", None)
    samples: int = setting(1, "motions of each timeline; their seeds count up from `seed`", at_least=1, at_most=100_000)
    seed: int = as_in(GenerateRequest, "seeds", 0)
    formats: tuple[str, ...] | None = setting(
        None,
        "files of each motion; null: npz, bvh and html, or npz, html and the character's own: glb, vrm, bvh or csv",
        choices=CHOICES,
    )
    character: str | None = setting(
        None,
        "your .glb, .gltf, .vrm or .bvh, or a robot's .xml (MJCF) or .urdf: files of glb, vrm, bvh and csv show it",
    )
    joint_map: str | None = setting(None, ".yaml that corrects which joint of the character is which")
    clean_feet: bool = as_in(GenerateRequest, "clean_feet")
    fps: float | int | None = setting(
        None, "frame rate of the files; null: the model's, and 50 for robots", above=0, at_most=1000
    )
    precision: str = setting("fp32", "of the denoiser; bf16 is faster on some processors", choices=get_args(Precision))
    batch: int | None = setting(None, "timelines at a time; null: 8 on a CPU, 64 on a GPU", at_least=1)
    trusted: tuple[str, ...] = setting((), "your own packages that hold classes of the model, or the `method`")
    suggest_parts: bool = setting(False, "suggest body parts for prompts that list none, and print them")
    json: bool = setting(False, "print a line of JSON on stdout for each motion, and everything else on stderr")

    def __post_init__(self) -> None:
        super().__post_init__()
        Shard.read(self.shard)
        find_method(self.method, self.trusted)


@command("sample", Settings, ("timeline", "output"), takes_record=True)
def main(settings: Settings) -> None:
    console = Console(stderr=settings.json, soft_wrap=True, highlight=False)
    check(settings)
    character = read_settings_character(settings.character, settings.joint_map, settings.formats, console)
    folder, shard = open_folder(settings, character), Shard.read(settings.shard)
    everything = read_jobs(settings, folder, console)
    wanted = everything if shard.number is None else shard.of(everything)
    missing = {job.name for job in wanted if not folder.is_finished(job)}
    if missing and shard.number is None:
        lacking = shard.count_missing([job.name for job in everything], missing)
        raise Incomplete(f"{settings.output}: motions are missing of {describe_shards(lacking)}")
    if not missing:
        console.print(f"every motion{name_shard(shard)} is in {folder.path.resolve()} already", markup=False)
        return
    precision = cast(Precision, settings.precision)  # one of its choices
    model = stmc.load(settings.model, device=settings.device, precision=precision, trusted=settings.trusted)
    size = settings.batch or BATCH_SIZES.get(model.device.type, 1)
    make(model, folder, wanted, missing, size, console, settings.json)
    console.print(f"motions{name_shard(shard)} in {folder.path.resolve()}{hint(folder.formats)}", markup=False)


def make(
    model: stmc.Model,
    folder: MotionFolder,
    wanted: list[Job],
    missing: set[str],
    size: int,
    console: Console,
    as_json: bool,
) -> None:
    """Sample the missing motions in batches, and write each as soon as it is ready."""
    sampling = model.check(wanted[0].request)
    model.plans([job.timeline for job in wanted], sampling.overlap)  # timelines without a plan fail before sampling
    folder.check_lengths(wanted, model.fps)
    timelines = [job.timeline for job in wanted if job.name in missing]
    doubtful = model.doubtful(timelines)
    for prompt in doubtful:
        advise_prompt(prompt.advice, prompt.known)
    print_own_words(model, timelines, sampling.restate_from, console)
    warnings.simplefilter("ignore", PromptWarning)  # `sample` would repeat the warnings
    probe(folder.path)
    remove_leftovers(folder.path)
    with progress_bars(console) as progress:
        task = progress.add_task("Motions", total=len(missing))
        for number, (job, motion) in enumerate(sample_missing(model, wanted, missing, size, progress), start=1):
            missed = find_missed(model, job.timeline, motion)
            paths = folder.save(motion, job, [*doubtful, *missed])
            report(job, motion, paths, f"{number} of {len(missing)}", missed, as_json, progress.console)
            progress.advance(task)


def print_own_words(
    model: stmc.Model, timelines: Sequence[stmc.Timeline], confidence: float | int | None, console: Console
) -> None:
    """Print the prompts that the model reads in words of its own, each once."""
    texts = [prompt.text for timeline in timelines for prompt in timeline.prompts]
    for each in model.recognise(texts):
        read = each.read_from(confidence)
        if read != each.text:
            console.print(f"{quote(each.text)} is read as {quote(read)}", markup=False)


def hint(formats: Sequence[str]) -> str:
    """Name the programs that open the less familiar of these formats, for a message; empty if there are none."""
    programs: dict[str, list[str]] = {}
    for each in EXPORTS:
        if each.opened_in and each.name in formats:
            programs.setdefault(each.opened_in, []).append(each.suffix)
    hints = [f"{' or '.join(suffixes)} in {program}" for program, suffixes in programs.items()]
    return f": open {', '.join(hints)}" if hints else ""


def name_shard(shard: Shard) -> str:
    """Name the shard for a message; empty if there is only one."""
    return "" if shard.count == 1 or shard.number is None else f" of share {shard}"


def check(settings: Settings) -> None:
    """Raise `SettingError` for formats whose packages are missing, and for devices that this machine lacks."""
    if settings.formats == ():
        raise SettingError(f"formats=[]: choose from {', '.join(CHOICES)}")
    resolve_device(settings.device)
    for each in EXPORTS:
        if each.name in (settings.formats or FORMATS) and each.check is not None:
            try:
                each.check()
            except ModuleNotFoundError as error:
                raise SettingError(f"formats={each.name}: {error}") from None


def open_folder(settings: Settings, character: stmc.Character | None = None) -> MotionFolder:
    """Return the output folder of the settings, without creating it."""
    made_by = {"model": fingerprint(settings.model), "precision": settings.precision}
    files = {name: getattr(settings, name) for name in ("character", "joint_map")}
    made_by |= {name: sha256(Path(path).expanduser())[:16] for name, path in files.items() if path is not None}
    formats = default_formats(character) if settings.formats is None else settings.formats
    return MotionFolder(Path(settings.output).expanduser(), formats, settings.fps, made_by, character)


def read_jobs(settings: Settings, folder: MotionFolder, console: Console) -> list[Job]:
    """Return a job for every requested motion. The longest come first, so that a lack of memory shows early."""
    timelines, stem = read_timelines(settings.timeline)
    if settings.suggest_parts:
        print_suggestions(timelines, console)
        timelines = [stmc.with_suggested_parts(each) for each in timelines]
    stem = stem or folder.free_name(timelines[0])
    found = distinct_names((timeline.name or (stem if len(timelines) == 1 else "") for timeline in timelines), stem)
    seeds = range(settings.seed, settings.seed + settings.samples)
    pairs = [(name, timeline, seed) for name, timeline in zip(found, timelines, strict=True) for seed in seeds]
    pairs.sort(key=lambda pair: -pair[1].duration)
    request = request_of(settings, [timeline for _, timeline, _ in pairs], [seed for *_, seed in pairs])
    return [Job(f"{name}_{seed}", each) for (name, _, seed), each in zip(pairs, request.split(), strict=True)]


def request_of(settings: Settings, timelines: Sequence[stmc.Timeline], seeds: Sequence[int]) -> GenerateRequest:
    """Return the request for motions of these timelines and seeds.

    Raises `SettingError` for files that cannot be read.
    """
    values = {name: getattr(settings, name) for name in names() if hasattr(settings, name)}
    if settings.constraints is not None:
        values["constraints"] = stmc.read_constraints(settings.constraints)
    return GenerateRequest.read(values | {"timelines": timelines, "seeds": seeds}, stmc.read, settings.trusted)


def read_timelines(timeline: str | None) -> tuple[list[stmc.Timeline], str | None]:
    """Return the timelines of a file and a default name, or a typed timeline and None."""
    if timeline is not None and "#" in timeline and not Path(timeline).expanduser().exists():
        return [stmc.Timeline.parse(timeline.replace("\\n", "\n"))], None
    path = Path(timeline or str(files("stmc") / "assets/timelines/walk_jump_sit.json")).expanduser()
    if timeline is not None and not path.suffix and "/" not in timeline and not path.exists():
        raise SettingError(f"timeline={quote(timeline)}: no such file; with its seconds it is a timeline: {EXAMPLE}")
    return list(stmc.Timeline.read_all(path)), path.stem


def print_suggestions(timelines: list[stmc.Timeline], console: Console) -> None:
    """Print the suggested body parts of every prompt that lists none, once per text."""
    for text in dict.fromkeys(prompt.text for each in timelines for prompt in each.prompts if not prompt.parts):
        console.print(f"suggested for {quote(text)}: {stmc.suggest_parts(text)}", markup=False)


def sample_missing(
    model: stmc.Model, wanted: list[Job], missing: set[str], size: int, progress: Progress
) -> Iterator[tuple[Job, stmc.Motion]]:
    """Yield every missing job with its motion, in batches of `size`, which halves when memory runs out.

    The batches are those of a run from scratch. In bf16 a motion depends slightly on its batch, so a batch is sampled
    whole even if only some of its motions are missing.
    """
    done = 0
    while done < len(wanted):
        batch = wanted[done : done + size]
        chosen = [job for job in batch if job.name in missing]
        made = batch if chosen and model.precision == "bf16" else chosen
        try:
            motions = generate(model, made, progress) if made else []
        except torch.OutOfMemoryError:
            if size == 1:
                raise
            torch.cuda.empty_cache()
            size = min(size, len(batch)) // 2 or 1
            progress.console.print(f"not enough memory: {size} timelines at a time from here on")
            continue
        yield from ((job, motion) for job, motion in zip(made, motions, strict=True) if job.name in missing)
        done += len(batch)


def generate(model: stmc.Model, batch: list[Job], progress: Progress) -> list[stmc.Motion]:
    """Generate the motions of a batch of jobs."""
    task = progress.add_task(f"Denoising {len(batch)}")
    try:
        request = GenerateRequest.joined([job.request for job in batch])
        return model.sample(request, partial(track_steps, progress=progress, task=task, of=len(batch)))
    finally:
        progress.remove_task(task)


def track_steps(steps: Iterable, total: int, progress: Progress, task: TaskID, of: int) -> Iterator:
    """Yield the denoising steps; show a bar on a terminal, and print a line now and then elsewhere."""
    last = time.monotonic()
    progress.reset(task, total=total)
    for number, step in enumerate(steps, start=1):
        yield step
        progress.advance(task)
        if not progress.console.is_terminal and time.monotonic() - last > LOG_SECONDS:
            progress.console.print(f"denoising {of}: step {number} of {total}")
            last = time.monotonic()


@contextmanager
def progress_bars(console: Console) -> Iterator[Progress]:
    """Show progress bars on a terminal; elsewhere only printed lines appear."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), *TIMES)
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        yield progress


def report(
    job: Job,
    motion: stmc.Motion,
    paths: list[Path],
    place: str,
    missed: Sequence[Missed],
    as_json: bool,
    console: Console,
) -> None:
    """Print a line about a motion that has been written, and about each prompt that it does not show."""
    if as_json:
        files = [str(path) for path in paths]
        record = {"name": job.name, "seed": job.seed, "seconds": motion.duration, "files": files}
        record["missed"] = [each.text for each in missed]
        sys.stdout.write(json.dumps(record) + "\n")
        sys.stdout.flush()
    else:
        kinds = ", ".join(path.suffix for path in paths)
        console.print(f"{job.name}: {motion.duration:.1f} s in {kinds} ({place})", markup=False)
    for each in missed:
        console.print(f"{job.name}: {each.advice}", markup=False)
