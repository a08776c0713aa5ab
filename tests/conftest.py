"""Where tests find what is not committed: the golden numbers of the published code, and the real data."""

import functools
import gzip
import json
import logging
import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, settings

ROOT = Path(__file__).resolve().parents[1]
GOLDEN = Path(os.environ.get("STMC_GOLDEN", ROOT / "../shared/golden"))
DATA = Path(os.environ.get("STMC_DATA", ROOT / "../shared/data"))

EXAMPLES = {"default": 15, "slow": 1000}
"""Of a property in each tier, where it does not say itself how many it can afford: the same ones in every run."""
settings.register_profile(
    "default",
    max_examples=EXAMPLES["default"],
    derandomize=True,
    deadline=None,  # nor a check of speed: how long an example takes is a matter of the machine
    suppress_health_check=[HealthCheck.too_slow],
)
settings.register_profile("slow", settings.get_profile("default"), max_examples=EXAMPLES["slow"])


def pytest_configure(config: pytest.Config) -> None:
    if worker := getattr(config, "workerinput", None):  # of several, each with its share of the processor
        share = max(1, (os.cpu_count() or 1) // worker["workercount"])
        torch.set_num_threads(min(share, torch.get_num_threads()))
    settings.load_profile("slow" if config.option.markexpr == "slow" else "default")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """`-m slow` selects the properties too, to draw more examples of them."""
    if config.option.markexpr == "slow":
        for item in items:
            if getattr(item.function, "is_hypothesis_test", False):
                item.add_marker("slow")


@pytest.fixture(scope="session", autouse=True)
def one_minilm():
    """The bundled text encoder is read once for all tests."""
    from stmc.text import language_models

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(language_models, "load", functools.cache(language_models.load))
        yield


@pytest.fixture(scope="session", autouse=True)
def no_waiting_for_the_disk():
    """No test cuts the power: what was written is there to read at once. That it is asked for, `test_files` says."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda descriptor: None)
        yield


@pytest.fixture(autouse=True)
def no_handler_left():
    """What a command, or Hydra, has set up to log to this test's stderr goes with it."""
    root = logging.getLogger()
    before, level = list(root.handlers), root.level
    yield
    for handler in root.handlers[:]:
        if handler not in before and not type(handler).__module__.startswith("_pytest"):
            root.removeHandler(handler)
    root.setLevel(level)


def golden_sets(area: str) -> list:
    """Every set folder of one area ("stmc", "mdm", "flow"), or one parameter that skips where there is none."""
    folders = sorted(path for path in (GOLDEN / area).glob("*") if path.is_dir() and path.name != "state_dicts")
    if folders:
        return [pytest.param(folder, id=folder.name) for folder in folders]
    reason = f"no golden numbers at {GOLDEN / area} (set STMC_GOLDEN)"
    return [pytest.param(None, id="absent", marks=pytest.mark.skip(reason=reason))]


def golden_files(area: str, pattern: str) -> list:
    """Every file of one area whose name matches, in every set folder, or one parameter that skips."""
    sets = golden_sets(area)
    files = [path for each in sets if each.values[0] for path in sorted(each.values[0].glob(pattern))]
    return [pytest.param(path, id=f"{path.parent.name}-{path.stem}") for path in files] or sets[:1]


def golden(folder: Path, name: str):
    """The content of one golden file: a dict of arrays for `.npz`, plain data for `.json` and `.json.gz`."""
    path = folder / name
    if not path.exists():
        pytest.skip(f"{path.parent.name} has no {name}")
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as archive:
            return dict(archive)
    text = gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()
    return json.loads(text)


def checked(subtests: pytest.Subtests, checks: Iterable, *given) -> None:
    """All checks of one formula as one test, of which each that fails is told by its name.

    A check is a function of what is `given`, or a tuple of one and its further arguments.
    """
    for check in checks:
        function, *more = check if isinstance(check, tuple) else (check,)
        with subtests.test(" ".join([function.__name__.replace("_", " "), *map(str, more)])):
            function(*given, *more)


def data_file(name: str) -> Path:
    """A file of the real data, or a skip that says where it was looked for."""
    path = DATA / name
    if not path.exists():
        pytest.skip(f"no {name} at {DATA} (set STMC_DATA)")
    return path
