"""Measure time and memory against the length of a timeline, each length in its own process.

The command prints a table and saves the figure and the numbers. On a CPU, times are ratios to the shortest timeline of
the same run.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track
from rich.table import Table

import stmc
from stmc.cli.commands import command
from stmc.cli.config_parts import resolve_config
from stmc.cli.shared_settings import OnDevice, Threaded
from stmc.evaluation.results.naming import method_row
from stmc.io.files import write_text, write_whole
from stmc.settings.records import SettingError, setting

MEBIBYTE = 2**20
TEXTS = ("walk forwards", "turn left", "wave with the right hand", "run", "raise both arms", "turn right")


class Measured(NamedTuple):
    """Cost of a timeline: seconds of sampling (CPU time on a CPU); peak bytes of memory before sampling and overall."""

    time: float
    loaded: int
    peak: int
    device: str


@dataclass(frozen=True, kw_only=True)
class Settings(OnDevice, Threaded):
    """Settings of `stmc benchmark-length`."""

    runs: tuple[Mapping, ...] = setting(
        ({"method": "stmc", "model": None},),
        "methods, each with the run directory of its model (null: the bundled one)",
    )
    seconds: tuple[float | int, ...] = setting(
        (10, 30, 60, 120, 300, 600), "length of each timeline", unit="s", above=0
    )
    prompt: float | int = setting(5, "length of each prompt", unit="s", above=0)
    texts: tuple[str, ...] = setting(TEXTS, "texts of the prompts, repeated cyclically")
    steps: int = setting(3, "denoising steps", at_least=1)
    repeats: int = setting(3, "repetitions of every measurement; the fastest is reported", at_least=1)
    output: str = setting("outputs/length", "folder for length.png and length.json")


@command("benchmark_length", Settings)
def main(config: DictConfig) -> None:
    from stmc.evaluation.results.length_charts import length_chart  # not above: it comes with an extra

    jobs = [(run.method, run.model, seconds) for run in config.runs for seconds in sorted(config.seconds)]
    settings = resolve_config(config)
    console = Console()
    found = {}
    for name, model, seconds in track(jobs, "Lengths", console=console):
        # A process of its own, because the system keeps one maximum of memory per process.
        with ProcessPoolExecutor(1, get_context("spawn")) as process:
            found[name, model, seconds] = process.submit(measure, name, model, seconds, settings).result()
    rows = records(found)
    console.print(table(rows))
    folder = Path(config.output).expanduser()
    write_text(folder / "length.json", json.dumps(rows, indent=1) + "\n")
    write_whole(folder / "length.png", lambda path: length_chart(rows).savefig(path, dpi=150, format="png"))
    console.print(f"{folder / 'length.png'}, {folder / 'length.json'}")


def timeline(seconds: float | int, prompt: float | int, texts: list[str]) -> stmc.Timeline:
    """Return a single-track timeline of consecutive prompts; the last one may be shorter."""
    starts = [number * prompt for number in range(-int(-seconds // prompt))]
    return stmc.Timeline(
        [
            stmc.Prompt(texts[number % len(texts)], start, min(start + prompt, seconds))
            for number, start in enumerate(starts)
        ]
    )


def measure(name: str, folder: str | None, seconds: float | int, settings: dict) -> Measured:
    """Measure sampling in this process, after a one-prompt timeline that loads everything.

    Args:
        name: Name of the method.
        folder: Run directory of the model; None: the bundled model.
        seconds: Duration of the timeline.
        settings: Settings of the command as plain data.
    """
    if settings["threads"]:
        torch.set_num_threads(settings["threads"])
    model = stmc.load(folder, device=settings["device"])
    prompt, texts = settings["prompt"], settings["texts"]
    full_timeline = timeline(seconds, prompt, texts)
    model.generate(timeline(prompt, prompt, texts), steps=1, method=name, clean_feet=False)
    model.embed(texts)
    loaded = peak(model.device)
    clock = time.process_time if model.device.type == "cpu" else time.perf_counter  # CPU time excludes other processes
    spent = []
    for _ in range(settings["repeats"]):
        start = clock()
        model.generate(full_timeline, steps=settings["steps"], method=name, clean_feet=False)
        spent.append(clock() - start)
    return Measured(min(spent), loaded, peak(model.device), str(model.device))


def peak(device: torch.device) -> int:
    """Return the peak memory of this process in bytes: of the GPU, or else resident memory."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    if sys.platform == "win32":
        raise SettingError("device=cpu: memory can be measured on Linux and macOS only; choose device=cuda")
    import resource  # not on Windows

    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else 1024 * most


def records(found: dict[tuple[str, str | None, float | int], Measured]) -> list[dict]:
    """Return a row per length: time relative to the run's shortest timeline, and in seconds on a GPU only."""
    shortest: dict[tuple[str, str | None], Measured] = {}
    rows = []
    for (name, model, seconds), measured in found.items():
        first = shortest.setdefault((name, model), measured)
        row = {"method": name, "model": model, "length": seconds, "relative_time": measured.time / first.time}
        row |= {"peak_bytes": measured.peak, "sampling_bytes": measured.peak - measured.loaded}
        rows.append(row | {"device": measured.device})
        if measured.device != "cpu":
            rows[-1]["seconds"] = measured.time
    return rows


def table(rows: list[dict]) -> Table:
    """Return the rows as a printable table."""
    table = Table("method", "length", "time / shortest", "seconds", "peak memory", "used by sampling", title="Lengths")
    for row in rows:
        seconds = f"{row['seconds']:.2f}" if "seconds" in row else "–"
        memory = [f"{row[name] / MEBIBYTE:.0f} MiB" for name in ("peak_bytes", "sampling_bytes")]
        table.add_row(
            method_row(row["method"]).label, f"{row['length']:g} s", f"{row['relative_time']:.2f}", seconds, *memory
        )
    return table
