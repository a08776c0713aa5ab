"""Measure what a timeline costs in runs of many: shards of `stmc sample`, of which one is killed and resumed.

Each shard is a process that samples as `stmc sample shard=…` does, and records its processor time and memory. Timelines
have ten seconds and three prompts. Run the same command again to resume; shards with a record are done.
"""

from __future__ import annotations

import json
import random
import time
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, NamedTuple, cast, get_args

import torch
from rich.console import Console
from rich.table import Table

import stmc
from stmc.cli import sample
from stmc.cli.benchmark_length import MEBIBYTE, peak
from stmc.cli.commands import command
from stmc.cli.shared_settings import OnModel, Threaded
from stmc.io.files import write_text
from stmc.model import Precision
from stmc.settings.records import SettingError, setting
from stmc.settings.shards import Shard

LEGS = ("walk forwards", "walk backwards", "walk in a circle", "run", "jump up", "turn left", "sit down", "stand up")
ARMS = (
    ("wave with the right hand", "right arm"), ("raise the right arm", "right arm"),
    ("wave with the left hand", "left arm"), ("punch with the left hand", "left arm"),
)  # fmt: skip
_POLL_SECONDS = 0.2


class Recorded(NamedTuple):
    """Cost of a shard: its timelines, those that this process sampled, and the seconds and the memory of that."""

    timelines: int
    sampled: int
    seconds: float
    """Of planning, sampling and writing; processor time on a CPU."""
    loading: float
    """Of loading the model."""
    peak_bytes: int


@dataclass(frozen=True, kw_only=True)
class Settings(OnModel, Threaded):
    """Settings of `stmc benchmark-scale`."""

    counts: tuple[int, ...] = setting((100, 1000, 10_000), "numbers of timelines", at_least=1, at_most=15_000)
    shards: int = setting(2, "processes at a time, each with a shard", at_least=1, at_most=1024)
    kill: float | int = setting(
        0.5,
        "fraction of the motions after which the first shard is killed, once per number; 0: never",
        at_least=0,
        below=1,
    )
    steps: int = setting(10, "denoising steps", at_least=1)
    batch: int | None = setting(None, "timelines at a time; null: 8 on a CPU, 64 on a GPU", at_least=1)
    precision: str = setting("fp32", "of the denoiser; bf16 is faster on some processors", choices=get_args(Precision))
    output: str = setting("outputs/scale", "folder of the motions, the records and scale.json")


@command("benchmark_scale", Settings, takes_record=True)
def main(settings: Settings) -> None:
    console, output, rows = Console(), Path(settings.output).expanduser(), []
    check_folder(settings, output)
    for count in sorted(settings.counts):
        measure_count(settings, count, output / str(count), console)
        rows.append(describe_count(count, output / str(count), settings.shards))
        write_text(output / "scale.json", json.dumps(rows, indent=1) + "\n")
    console.print(print_rows(rows))
    console.print(f"{output / 'scale.json'}", markup=False)


def check_folder(settings: Settings, output: Path) -> None:
    """Raise `SettingError` if the folder has records of other settings; else store these there."""
    path = output / "settings.json"
    own = {name: value for name, value in asdict(settings).items() if name not in ("counts", "output")}
    if path.exists() and (stored := json.loads(path.read_text("utf-8"))) != own:
        others = ", ".join(sorted(name for name in own if own[name] != stored.get(name)))
        raise SettingError(f"output={output}: it was measured with other settings ({others}); choose another folder")
    write_text(path, json.dumps(own, indent=1) + "\n")


def random_timelines(count: int) -> str:
    """Return a file of timelines: two actions of the legs, and one of an arm at a random time. The first are always
    the same."""
    draw, timelines = random.Random(0), []
    for _ in range(count):
        first, second = draw.sample(LEGS, 2)
        (arm, part), start = draw.choice(ARMS), draw.randint(5, 55) / 10
        prompts = [f"{first} # 0 # 5 # legs", f"{second} # 5 # 10 # legs", f"{arm} # {start} # {start + 4} # {part}"]
        timelines.append("\n".join(prompts))
    return "\n\n".join(timelines) + "\n"


def measure_count(settings: Settings, count: int, folder: Path, console: Console) -> None:
    """Sample the shards without a record, each in a process of its own; kill the first one once, and resume it.

    Args:
        settings: Settings of the command.
        count: Number of timelines.
        folder: Folder of this number.
        console: Console for messages.

    Raises:
        RuntimeError: If a process fails.
    """
    if not (folder / "timelines.txt").exists():
        write_text(folder / "timelines.txt", random_timelines(count))
    missing = [n for n in range(1, settings.shards + 1) if not record_path(folder, n, settings.shards).exists()]
    processes = {number: start_shard(settings, folder, number) for number in missing}
    killed = folder / "killed.json"
    while any(process.is_alive() for process in processes.values()):
        time.sleep(_POLL_SECONDS)
        finished = len(list((folder / "motions").glob("*.json")))
        if settings.kill and 1 in missing and not killed.exists() and finished >= settings.kill * count:
            processes[1].kill()
            processes[1].join()
            write_text(killed, json.dumps({"motions": finished}))
            console.print(f"{count} timelines: shard 1 is killed after {finished} motions, and resumed", markup=False)
            processes[1] = start_shard(settings, folder, 1)
    if failed := [f"{number} (exit code {each.exitcode})" for number, each in processes.items() if each.exitcode]:
        raise RuntimeError(f"{folder}: shards failed: {', '.join(failed)}; run the command again to resume")


def start_shard(settings: Settings, folder: Path, number: int) -> BaseProcess:
    """Start the process of a shard."""
    process = get_context("spawn").Process(target=sample_shard, args=(settings, folder, number), daemon=True)
    process.start()
    return process


def sample_shard(settings: Settings, folder: Path, number: int) -> None:
    """Sample the missing motions of a shard as `stmc sample` does, and record what that cost.

    Args:
        settings: Settings of the command.
        folder: Folder of this number of timelines.
        number: Number of the shard, from 1.
    """
    if settings.threads:
        torch.set_num_threads(settings.threads)
    precision = cast(Precision, settings.precision)  # one of its choices
    start = time.process_time(), time.perf_counter()
    model = stmc.load(settings.model, device=settings.device, precision=precision)
    clock, begin = (time.process_time, start[0]) if model.device.type == "cpu" else (time.perf_counter, start[1])
    loaded = clock()
    sampling = sample.Settings(
        timeline=str(folder / "timelines.txt"), output=str(folder / "motions"), formats=("npz",), steps=settings.steps,
        model=settings.model, device=settings.device, precision=settings.precision,
        shard=str(Shard(number, settings.shards)),
    )  # fmt: skip
    motions, console = sample.open_folder(sampling), Console(quiet=True)
    wanted = Shard(number, settings.shards).of(sample.read_jobs(sampling, motions, console))
    missing = {job.name for job in wanted if not motions.is_finished(job)}
    if missing:
        size = settings.batch or sample.BATCH_SIZES.get(model.device.type, 1)
        sample.make(model, motions, wanted, missing, size, console, False)
    cost = Recorded(len(wanted), len(missing), clock() - loaded, loaded - begin, peak(model.device))
    write_text(record_path(folder, number, settings.shards), json.dumps(cost._asdict()) + "\n")


def record_path(folder: Path, number: int, shards: int) -> Path:
    """Return the file of a shard's record."""
    return folder / f"shard_{number}_of_{shards}.json"


def describe_count(count: int, folder: Path, shards: int) -> dict[str, Any]:
    """Return a row of the results: cost per sampled timeline, and the largest memory of a process.

    Args:
        count: Number of timelines.
        folder: Folder of this number, with the records of all shards.
        shards: Number of shards.
    """
    costs = [Recorded(**json.loads(record_path(folder, n + 1, shards).read_text("utf-8"))) for n in range(shards)]
    sampled, killed = sum(cost.sampled for cost in costs), folder / "killed.json"
    return {
        "timelines": count,
        "shards": shards,
        "seconds_per_timeline": sum(cost.seconds for cost in costs) / max(1, sampled),
        "loading_seconds": max(cost.loading for cost in costs),
        "peak_bytes": max(cost.peak_bytes for cost in costs),
        "killed_after": json.loads(killed.read_text("utf-8"))["motions"] if killed.exists() else None,
        "sampled_after_resuming": costs[0].sampled,
        "records": [cost._asdict() for cost in costs],
    }


def print_rows(rows: list[dict[str, Any]]) -> Table:
    """Return the rows as a printable table."""
    columns = ("timelines", "shards", "seconds a timeline", "relative", "peak memory of a process", "killed after")
    table = Table(*columns, title="Timelines of ten seconds")
    for row in rows:
        killed = "–" if row["killed_after"] is None else f"{row['killed_after']:,} motions"
        relative = row["seconds_per_timeline"] / (rows[0]["seconds_per_timeline"] or 1)
        memory = f"{row['peak_bytes'] / MEBIBYTE:.0f} MiB"
        cost = f"{row['seconds_per_timeline']:.3f}"
        table.add_row(f"{row['timelines']:,}", str(row["shards"]), cost, f"{relative:.3f}", memory, killed)
    return table
