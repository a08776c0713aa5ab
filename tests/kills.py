"""Kills a script at random moments, asks it again, and compares what it leaves with an undisturbed run.

`python tests/kills.py training --kills 100`: also sampling, preparing and evaluating, `--seed` for other moments. Each
process is forked from this one, which has imported everything: most moments fall into the work, not the start.
"""

import argparse
import contextlib
import csv
import os
import random
import runpy
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

os.environ |= {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": "", "COLUMNS": "200"}

import psutil
import tensorboard  # noqa: F401
import torch.utils.tensorboard  # noqa: F401
import transformers
from helpers.bandai_files import bvh_text
from helpers.scripts import ROOT
from helpers.tiny_model import tiny
from test_multi_track import BUNDLED, evaluator, prepared
from test_scripts import TIMELINES, clip

import stmc
from stmc.evaluation.benchmarks import multi_track, resampling
from stmc.run import save_evaluator

SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
GRACE = 20.0
"""Seconds in which what a killed process had started must end."""


@dataclass(frozen=True)
class Work:
    """A script and its settings. `prepare` fills the folder in which it runs, whose `output` is compared."""

    script: str
    prepare: Callable[[Path], None]
    settings: tuple[str, ...]


def recordings(folder: Path) -> None:
    """Motion capture of two contents."""
    (folder / "source").mkdir()
    for content, count in (("walk", 10), ("raise-up-left-hand", 5)):
        for number in range(count):
            path = folder / "source" / f"dataset-1_{content}_normal_{number:03d}.bvh"
            path.write_text(bvh_text(clip(content, number)))


def data(folder: Path) -> None:
    """What preparing makes of the recordings."""
    recordings(folder)
    assert ended(started(WORKS["preparing"], folder)) == 0
    (folder / "output").rename(folder / "cache")


def model(folder: Path) -> None:
    """A tiny model and timelines for it."""
    stmc.save(tiny(), folder / "model", "card")
    (folder / "two.txt").write_text(TIMELINES)


def benchmark(folder: Path) -> None:
    """A tiny model, an evaluator and a benchmark."""
    stmc.save(tiny(), folder / "model", "card")
    save_evaluator(evaluator(), folder / "tmr", "card")
    prepared([prompt.text for prompt in multi_track.read_atomic_prompts(BUNDLED / "prompts.json")]).write(
        folder / "cache"
    )


WORKS = {
    "sampling": Work(
        "sample", model,
        ("timeline=two.txt", "model=model", "output=output", "formats=[npz,bvh]", "samples=5", "batch=1", "steps=5",
         "device=cpu"),
    ),
    "training": Work(
        "train", data,
        ("run=output", "data.folder=cache", "text_cache=output/texts", "device=cpu", "denoiser=mdm_smpl_small",
         "denoiser.width=32", "denoiser.feedforward=64", "denoiser.layers=1", "training.steps=30", "training.warmup=1",
         "training.log_every=1", "training.validate_every=3", "training.checkpoint_every=3", "training.precision=fp32",
         "data.sampling.rows=4", "data.sampling.pool=2", "validation=1", "draw=[]"),
    ),
    "preparing": Work("prepare", recordings, ("source=source", "folder=output", "workers=2")),
    "evaluating": Work(
        "evaluate", benchmark,
        ("models.MDM-SMPL=model", "evaluator=tmr", "benchmark.cache=cache", "benchmark.first=4", "output=output",
         "batch=1", "device=cpu", "precision=fp32", "experiment=steps", "experiment.settings.steps=[2]",
         "experiment.settings.sampler=[ddim]", "seeds=[0,1]"),
    ),
}  # fmt: skip


def forked(folder: Path, do: Callable[[], object]) -> int:
    """A process that does it in `folder`, in a session of its own; returns its number."""
    process = os.fork()
    if process:
        return process
    code = 1
    try:
        os.setsid()
        os.chdir(folder)
        log = os.open("log.txt", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        for stream in (1, 2):
            os.dup2(log, stream)
        do()
        code = 0
    except SystemExit as error:
        code = error.code if isinstance(error.code, int) else int(error.code is not None)
        print(error.code)
    except BaseException:
        traceback.print_exc()
    finally:
        with contextlib.suppress(Exception):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


def started(work: Work, folder: Path) -> int:
    """The script, as from the command line."""
    path = str(ROOT / "scripts" / f"{work.script}.py")

    def script() -> None:
        sys.argv = [path, *work.settings]
        multi_track.PER_TEXT = 2  # FID compares with few real clips
        resampling.DRAWS = 2
        runpy.run_path(path, run_name="__main__")

    return forked(folder, script)


def ended(process: int) -> int:
    """The exit status of a process, once it and all that it started are gone."""
    code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    until = time.monotonic() + GRACE
    while left := [each for each in psutil.pids() if session(each) == process]:
        assert time.monotonic() < until, f"processes {left} outlive the one that started them"
        time.sleep(0.05)
    return code


def session(process: int) -> int | None:
    """The session of a process that is alive."""
    with contextlib.suppress(ProcessLookupError, psutil.NoSuchProcess):
        if psutil.Process(process).status() != psutil.STATUS_ZOMBIE:
            return os.getsid(process)
    return None


def results(folder: Path) -> dict[str, object]:
    """What must be the same, by its path: not TensorBoard's files, the text cache and speeds, which hold times or the
    order of writing."""
    found: dict[str, object] = {}
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        name = path.relative_to(folder).as_posix()
        if path.suffix == ".csv":
            with path.open(newline="", encoding="utf-8") as file:
                rows = list(csv.DictReader(file))
            found[name] = [{key: row[key] for key in row if not key.endswith("per_second")} for row in rows]
        elif not name.startswith(("tensorboard/", "texts/")):
            found[name] = path.read_bytes()
    return found


def check(folder: Path, expected: dict[str, object]) -> None:
    """Nothing is half written, lost, different or left over."""
    assert not (hidden := [path for path in folder.rglob(".*") if path.is_file()]), f"left behind: {hidden}"
    left = results(folder)
    assert set(left) == set(expected), f"files that are here or there alone: {sorted(set(left) ^ set(expected))}"
    assert not (other := [name for name in left if left[name] != expected[name]]), f"different: {other}"


def survived(name: str, kills: int, seed: int, folder: Path) -> dict[str, int]:
    """Asks again and again, killed up to four times in a row; returns how often each signal hit. Raises
    `AssertionError` where anything is wrong with what is left."""
    work, rng, counts = WORKS[name], random.Random(seed), {each.name: 0 for each in SIGNALS}
    inputs = folder / "inputs"
    inputs.mkdir(parents=True)
    assert ended(forked(inputs, partial(work.prepare, inputs))) == 0, (inputs / "log.txt").read_text()
    whole = Path(shutil.copytree(inputs, folder / "whole"))
    began = time.monotonic()
    assert ended(started(work, whole)) == 0, (whole / "log.txt").read_text()
    length, expected = time.monotonic() - began, results(whole / "output")
    check(whole / "output", expected)
    while sum(counts.values()) < kills:
        attempt = Path(shutil.copytree(inputs, folder / "attempt"))
        for _ in range(rng.randint(1, 4)):
            process, chosen = started(work, attempt), rng.choice(SIGNALS)
            time.sleep(rng.uniform(0, 1.1 * length))
            if os.waitid(os.P_PID, process, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
                counts[chosen.name] += 1
                os.kill(process, chosen)
            ended(process)
        assert ended(started(work, attempt)) == 0, (attempt / "log.txt").read_text()
        check(attempt / "output", expected)
        shutil.rmtree(attempt)
    return counts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("work", choices=WORKS)
    parser.add_argument("--kills", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    transformers.logging.set_verbosity_error()
    with tempfile.TemporaryDirectory() as folder:
        counts = survived(arguments.work, arguments.kills, arguments.seed, Path(folder) / "kills")
    print(f"{arguments.work} survived", ", ".join(f"{count} x {name}" for name, count in counts.items()))


if __name__ == "__main__":
    main()
