"""Where training runs: the accelerator if there is one, or what was asked for; and that one run at a time writes to a
folder. Knows no network."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import torch
from accelerate import Accelerator

from stmc.diffusion.tensors import found_device
from stmc.io.files import locked


def find_accelerator(device: str) -> Accelerator:
    """`device` is cuda, cpu, or auto: cuda if there is one. Apple's accelerator is passed over: it has no
    float64, in which distances are summed.

    Raises `ValueError` for another device, and for cuda where there is none.
    """
    choices = ("auto", "cpu", "cuda")
    if device not in choices:
        raise ValueError(f"device={device!r}: choose from {', '.join(choices)}")
    return Accelerator(cpu=torch.device(found_device(device)).type != "cuda")


@contextmanager
def begin(run: str | Path, device: str) -> Iterator[Accelerator]:
    """The accelerator (see `find_accelerator`), with the folder `run` locked by the main process. Raises
    `FolderInUse`."""
    accelerator = find_accelerator(device)
    with locked(Path(run).expanduser()) if accelerator.is_main_process else nullcontext():
        yield accelerator
