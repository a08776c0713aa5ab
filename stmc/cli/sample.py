"""Sample motions of timelines: files to animate with, and pages to look at.

    stmc sample timelines.json outputs/       every timeline of a file
    stmc sample "walk # 0 # 4" outputs/       one timeline: text # start # end, in seconds, # body parts

Run the same command again to resume: motions that are complete, and made with the same settings, are kept.
"""

from __future__ import annotations

import json
import math
import sys
import time
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.resources import files
from itertools import chain, count
from pathlib import Path
from typing import Any, NamedTuple, get_args

import torch
from omegaconf import DictConfig, ListConfig
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

import stmc
from stmc.cli.character_settings import asked_character, tell_character
from stmc.cli.commands import command
from stmc.cli.shared_settings import OnModel, Sharded
from stmc.composing import METHODS, find_method
from stmc.composing.sampling import INDEPENDENT, Sampling
from stmc.diffusion.tensors import found_device
from stmc.io.filenames import distinct, name_of_texts
from stmc.io.files import held, probe, remove_leftovers, scratch, sha256, write_text
from stmc.io.untrusted import MOST_BYTES, UnreadableError, load_json, read_text
from stmc.model import Precision
from stmc.run import fingerprint
from stmc.settings.records import SettingError, about, record_of, setting, shown
from stmc.settings.shards import Incomplete, Shard, listed
from stmc.text.vocabulary import Recognition
from stmc.timeline import UnknownPromptWarning, advise
from stmc.viewing.film_formats import FILMS, ffmpeg

FORMATS = ("npz", "bvh", "html")
"""Those that are written if nobody says which."""
CHOICES = (*FORMATS, "glb", "csv", "xml", "webp", "gif", "mp4", "vrm", "vrma")
EXAMPLE = "'walk # 0 # 4'"
"""A timeline as it is typed."""
TIMES = (TimeElapsedColumn(), TimeRemainingColumn())
FILES = ("keep", "constraints", "character", "joint_map")
DECIDING = ("method", "precision", "fps", "clean_feet", "change", *about(Sampling))
"""The settings that decide what a motion becomes, beside its seed, model and timeline, and those whose files do."""
TOGETHER = {"cpu": 8, "cuda": 64}
"""Timelines at a time: a GPU is faster with many; a CPU is not, and what is done should be on the disk soon."""
SILENCE = 30
"""Seconds after which a log that is no terminal hears of the steps."""


@dataclass(frozen=True, kw_only=True)
class Settings(Sampling, OnModel, Sharded):
    """Settings of `stmc sample`."""

    timeline: str | None = setting(
        None, ".json or .txt file of timelines, or one timeline as text; null: the bundled example"
    )
    output: str = setting("outputs", "folder of the motions")
    method: str = setting(
        "stmc",
        f"how crops become a motion: {', '.join(name for name in METHODS if name != INDEPENDENT)}, or mylab.rules.mine",
    )
    keep: str | None = setting(
        None, "motion to edit, .npz or .bvh; only `change`, and frames behind its end, are generated"
    )
    change: tuple[str, ...] = setting((), "intervals of `keep` to regenerate: start # end # body parts, in seconds")
    constraints: str | None = setting(None, ".json of paths, headings, keyframes, hands and feet, for every timeline")
    samples: int = setting(1, "motions of each timeline; their seeds count up from `seed`", at_least=1, at_most=100_000)
    seed: int = setting(0, "seed of the first motion of each timeline", at_least=0)
    formats: tuple[str, ...] = setting(FORMATS, "files of each motion", choices=CHOICES)
    character: str | None = setting(None, "your .glb, .gltf, .vrm or .bvh: it moves in files of formats=glb, vrm, bvh")
    joint_map: str | None = setting(None, ".yaml that corrects which joint of the character is which")
    clean_feet: bool = setting(True, "keep standing feet in place and above the floor; false: leave them as sampled")
    fps: float | int | None = setting(None, "frame rate of the files; null: the model's", above=0, at_most=1000)
    precision: str = setting("fp32", "of the denoiser; bf16 is faster on some processors", choices=get_args(Precision))
    batch: int | None = setting(None, "timelines at a time; null: 8 on a CPU, 64 on a GPU", at_least=1)
    trusted: tuple[str, ...] = setting((), "your own packages that hold classes of the model, or the `method`")
    suggest_parts: bool = setting(False, "suggest body parts for prompts that list none, and print them")
    json: bool = setting(False, "print a line of JSON on stdout for each motion, and everything else on stderr")

    def __post_init__(self) -> None:
        super().__post_init__()
        Shard.asked(self.shard)
        find_method(self.method, self.trusted)


class Job(NamedTuple):
    """A motion to be: its files' name, its timeline, its seed."""

    name: str
    timeline: stmc.Timeline
    seed: int


@command("sample", Settings, ("timeline", "output"))
def main(config: DictConfig) -> None:
    console, folder = Console(stderr=config.json, soft_wrap=True, highlight=False), Path(config.output).expanduser()
    check(config)
    tell_character(config.character, config.joint_map, config.formats, console)
    made_by, shard, everything = fingerprint(config.model), Shard.asked(config.shard), jobs(config, console)
    wanted = everything if shard.number is None else shard.of(everything)
    missing = {job.name for job in wanted if not finished(job, config, made_by)}
    if missing and shard.number is None:
        lacking = shard.lacking([job.name for job in everything], missing)
        raise Incomplete(f"{config.output}: motions are missing of {listed(lacking)}")
    if not missing:
        console.print(f"every motion{of_share(shard)} is in {folder.resolve()} already", markup=False)
        return
    model = stmc.load(config.model, device=config.device, precision=config.precision, trusted=config.trusted)
    settings = model.settings(find_method(config.method, config.trusted), **sampling(config))
    model.plans([job.timeline for job in wanted], settings.overlap)  # what cannot be planned fails now
    unknown = model.unknown([job.timeline for job in wanted if job.name in missing])
    for prompt in unknown:
        advise(prompt.advice, UnknownPromptWarning)
    warnings.simplefilter("ignore", UnknownPromptWarning)  # `generate` would tell again
    probe(folder)
    remove_leftovers(folder)
    size = config.batch or TOGETHER.get(model.device.type, 1)
    with told(console) as progress:
        task = progress.add_task("Motions", total=len(missing))
        for number, (job, motion) in enumerate(sampled(model, wanted, missing, size, config, progress), start=1):
            paths = save(motion, job, config, made_by, unknown)
            tell(job, motion, paths, f"{number} of {len(missing)}", config.json, progress.console)
            progress.advance(task)
    console.print(f"motions{of_share(shard)} in {folder.resolve()}{hint(config.formats)}", markup=False)


def hint(formats: Sequence[str]) -> str:
    """The programs for those of the formats that a newcomer may not know."""
    blender = " or ".join(f".{kind}" for kind in ("bvh", "glb") if kind in formats)
    told = ["an .html in a browser"] * ("html" in formats) + [f"a {blender} in Blender"] * bool(blender)
    return f": open {', '.join(told)}" if told else ""


def of_share(shard: Shard) -> str:
    """Name the shard in a message; empty if there is only one."""
    return "" if shard.count == 1 or shard.number is None else f" of share {shard}"


def check(config: DictConfig) -> None:
    """Refuses what settings cannot be together."""
    if not config.formats:
        raise SettingError(f"formats=[]: choose from {', '.join(CHOICES)}")
    found_device(config.device)
    if "mp4" in config.formats:
        try:
            ffmpeg()
        except ModuleNotFoundError as error:
            raise SettingError(f"formats=mp4: {error}") from None
    beside(config)  # what cannot be read fails now


def jobs(config: DictConfig, console: Console) -> list[Job]:
    """Every motion that is asked for; the longest first, so that memory runs out early."""
    timelines, stem = asked(config.timeline)
    if config.suggest_parts:
        tell_parts(timelines, console)
        timelines = [stmc.with_suggested_parts(each) for each in timelines]
    stem = stem or free_name(timelines[0], Path(config.output).expanduser())
    names = distinct((timeline.name or (stem if len(timelines) == 1 else "") for timeline in timelines), stem)
    seeds = range(config.seed, config.seed + config.samples)
    made = [Job(f"{name}_{seed}", each, seed) for name, each in zip(names, timelines, strict=True) for seed in seeds]
    return sorted(made, key=lambda job: -job.timeline.duration)


def asked(timeline: str | None) -> tuple[list[stmc.Timeline], str | None]:
    """The timelines of a file, and the name for those without one; or the one that was typed, without a name."""
    if timeline is not None and "#" in timeline and not Path(timeline).expanduser().exists():
        return [stmc.Timeline.parse(timeline.replace("\\n", "\n"))], None
    path = Path(timeline or str(files("stmc") / "assets/timelines/walk_jump_sit.json")).expanduser()
    if timeline is not None and not path.suffix and "/" not in timeline and not path.exists():
        raise SettingError(f"timeline={shown(timeline)}: no such file; with its seconds it is a timeline: {EXAMPLE}")
    return list(stmc.Timeline.read_all(path)), path.stem


def free_name(timeline: stmc.Timeline, folder: Path) -> str:
    """The name of a typed timeline: its texts, and a number behind them where motions of the same texts at other times
    or for other body parts have that name in `folder`."""
    base = name_of_texts(prompt.text for prompt in timeline.prompts)
    names = chain([base], (f"{base}-{number}" for number in count(2)))
    return next(name for name in names if told_prompts(name, folder) in ([], [prompts_of(timeline)]))


def told_prompts(name: str, folder: Path) -> list[list]:
    """The different prompts in the records of the motions of that name, of whatever seed."""
    records = [read_record(path) for path in folder.glob(f"{name}_*.json") if path.stem[len(name) + 1 :].isdigit()]
    told = [record["prompts"] for record in records if "prompts" in record]
    return [prompts for number, prompts in enumerate(told) if prompts not in told[:number]]


def read_record(path: Path) -> dict:
    """A record beside a motion; empty where there is none that can be read."""
    try:
        read = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError):
        return {}
    return read if isinstance(read, dict) else {}


def prompts_of(timeline: stmc.Timeline) -> list[list]:
    """The prompts of a timeline as a record has them."""
    return [[prompt.text, prompt.start, prompt.end, sorted(prompt.parts)] for prompt in timeline.prompts]


def tell_parts(timelines: list[stmc.Timeline], console: Console) -> None:
    """The body parts of every prompt that listed none, each text once."""
    for text in dict.fromkeys(prompt.text for each in timelines for prompt in each.prompts if not prompt.parts):
        console.print(f"suggested for {shown(text)}: {stmc.suggest_parts(text)}", markup=False)


def record(job: Job, config: DictConfig, made_by: str) -> dict:
    """What a motion depends on, but for settings that are left open."""
    said = {key: plain(config[key]) for key in DECIDING}
    said = {key: value for key, value in said.items() if value is not None and value is not False and value != []}
    files = {key: digest(config[key]) for key in FILES if config[key] is not None}
    return (
        said
        | files
        | {"seed": job.seed, "model": made_by, "prompts": prompts_of(job.timeline), "version": stmc.__version__}
    )


def digest(path: str) -> str:
    """What tells a file from another one. Raises `SettingError` where there is none."""
    try:
        return sha256(Path(path).expanduser())[:16]
    except OSError as error:
        raise SettingError(f"{path}: {error.strerror}") from None


def plain(value: Any) -> Any:
    """A setting as JSON has it."""
    return list(value) if isinstance(value, ListConfig) else value


def finished(job: Job, config: DictConfig, made_by: str) -> bool:
    """Whether the folder has the motion in all formats, made of this request."""
    folder = Path(config.output).expanduser()
    request, digests = recorded(folder, job.name)
    return request == record(job, config, made_by) and set(config.formats) <= whole(folder, job.name, digests)


def recorded(folder: Path, name: str) -> tuple[dict | None, dict[str, str | None]]:
    """The request that a motion's record names, and the SHA-256 of its files by format. A record that is damaged, or of
    an earlier version, names no request, and may have files of every format."""
    try:
        request = load_json(read_text(folder / f"{name}.json", MOST_BYTES))
        digests = request.pop("files")
        return request, {kind: digests[kind] for kind in CHOICES if kind in digests}
    except (FileNotFoundError, NotADirectoryError):
        return None, {}
    except (UnreadableError, AttributeError, KeyError, TypeError):
        return None, dict.fromkeys(CHOICES)


def whole(folder: Path, name: str, digests: Mapping[str, str | None]) -> set[str]:
    """The formats whose files are as their record says."""
    files = {kind: folder / f"{name}.{kind}" for kind in digests}
    return {kind for kind, path in files.items() if path.is_file() and sha256(path) == digests[kind]}


def sampled(
    model: stmc.Model, wanted: list[Job], missing: set[str], size: int, config: DictConfig, progress: Progress
) -> Iterator[tuple[Job, stmc.Motion]]:
    """Every missing job with its motion, in batches of `size`, or smaller ones where the memory does not suffice.

    Batches are those of a run that makes everything: in bf16 a motion depends, a bit, on its batch, so there a batch is
    made whole although only some of its motions are missing.
    """
    done = 0
    while done < len(wanted):
        batch = wanted[done : done + size]
        chosen = [job for job in batch if job.name in missing]
        made = batch if chosen and config.precision == "bf16" else chosen
        try:
            motions = generate(model, made, config, progress) if made else []
        except torch.OutOfMemoryError:
            if size == 1:
                raise
            torch.cuda.empty_cache()
            size = min(size, len(batch)) // 2 or 1
            progress.console.print(f"not enough memory: {size} timelines at a time from here on")
            continue
        yield from ((job, motion) for job, motion in zip(made, motions, strict=True) if job.name in missing)
        done += len(batch)


def generate(model: stmc.Model, batch: list[Job], config: DictConfig, progress: Progress) -> list[stmc.Motion]:
    """Generate the motions of a batch of jobs."""
    task = progress.add_task(f"Denoising {len(batch)}")
    try:
        return model.generate(
            [job.timeline for job in batch],
            seed=[job.seed for job in batch],
            method=find_method(config.method, config.trusted),
            progress=partial(followed, progress=progress, task=task, of=len(batch)),
            clean_feet=config.clean_feet,
            **beside(config),
            **sampling(config),
        )
    finally:
        progress.remove_task(task)


def beside(config: DictConfig) -> dict[str, Any]:
    """What is asked for beside the timelines, as `Model.generate` takes it."""
    return {
        "keep": None if config.keep is None else stmc.read(config.keep),
        "change": [stmc.Change.parse(each) for each in config.change],
        "constraints": [] if config.constraints is None else stmc.read_constraints(config.constraints),
    }


def sampling(config: DictConfig) -> dict[str, Any]:
    """The settings of sampling that are said, as `Model.generate` takes them."""
    return dict(record_of(Sampling, {name: config[name] for name in about(Sampling)}).given)


def followed(steps: Iterable, total: int, progress: Progress, task: int, of: int) -> Iterator:
    """The steps of denoising, with a bar on a terminal and a line now and then elsewhere."""
    last = time.monotonic()
    progress.reset(task, total=total)
    for number, step in enumerate(steps, start=1):
        yield step
        progress.advance(task)
        if not progress.console.is_terminal and time.monotonic() - last > SILENCE:
            progress.console.print(f"denoising {of}: step {number} of {total}")
            last = time.monotonic()


@contextmanager
def told(console: Console) -> Iterator[Progress]:
    """Progress bars on a terminal; elsewhere the lines that are printed are all."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), *TIMES)
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        yield progress


def save(
    motion: stmc.Motion, job: Job, config: DictConfig, made_by: str, unknown: Sequence[Recognition] = ()
) -> list[Path]:
    """Write the motion's files aside, then put all of them in place with the record that names their digests, which no
    other process does at that time. Files of an earlier request go."""
    folder = Path(config.output).expanduser()
    motion = motion if config.fps is None else motion.resampled(config.fps)
    with scratch(folder / job.name) as aside:
        made = [aside / f"{job.name}.{kind}" for kind in config.formats]
        character = asked_character(config.character, config.joint_map)
        for path in made:
            write_format(motion, path, job, unknown, character)
        digests = {path.suffix[1:]: sha256(path) for path in made}
        with held(folder / f".{job.name}.lock", math.inf):
            request, former = recorded(folder, job.name)
            kept = whole(folder, job.name, former) if request == record(job, config, made_by) else set()
            for kind in former.keys() - kept:
                (folder / f"{job.name}.{kind}").unlink(missing_ok=True)
            (folder / f"{job.name}.json").unlink(missing_ok=True)
            paths = [path.replace(folder / path.name) for path in made]
            done = record(job, config, made_by) | {"files": {kind: former[kind] for kind in kept} | digests}
            write_text(folder / f"{job.name}.json", json.dumps(done, indent=1, ensure_ascii=False) + "\n")
    return paths


def write_format(
    motion: stmc.Motion, path: Path, job: Job, unknown: Sequence[Recognition], character: stmc.Character | None
) -> None:
    """Write a motion in the format of the path's suffix, of the character where that has one."""
    if character is not None and path.suffix in character.formats:
        stmc.retarget(motion, character).write(path)
    elif path.suffix == ".html":
        write_text(path, stmc.render_html(motion, job.timeline, title=job.name, unknown=unknown))
    elif path.suffix in FILMS:
        stmc.render_film(motion, path, job.timeline)
    else:
        stmc.write(motion, path, timeline=job.timeline)


def tell(job: Job, motion: stmc.Motion, paths: list[Path], place: str, as_json: bool, console: Console) -> None:
    """A line for a motion that is on the disk."""
    if as_json:
        told = {"name": job.name, "seed": job.seed, "seconds": motion.duration, "files": [str(path) for path in paths]}
        sys.stdout.write(json.dumps(told) + "\n")
        sys.stdout.flush()
    else:
        kinds = ", ".join(path.suffix for path in paths)
        console.print(f"{job.name}: {motion.duration:.1f} s in {kinds} ({place})", markup=False)
