"""Choose the device of training, and let one run at a time write to a folder."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import torch
from accelerate import Accelerator

from stmc.diffusion.tensors import resolve_device
from stmc.io.files import lock_folder


def find_accelerator(device: str) -> Accelerator:
    """Return an accelerator for a device: "cuda", "cpu", or "auto", which is CUDA if there is one.

    Apple's GPU is not used: it lacks float64, in which distances are summed. Raises `ValueError` for another device,
    and for CUDA if there is none.
    """
    choices = ("auto", "cpu", "cuda")
    if device not in choices:
        raise ValueError(f"device={device!r}: choose from {', '.join(choices)}")
    return Accelerator(cpu=torch.device(resolve_device(device)).type != "cuda")


@contextmanager
def begin(run: str | Path, device: str) -> Iterator[Accelerator]:
    """Lock the folder `run` in the main process and yield the accelerator (see `find_accelerator`).

    Raises `FolderInUse` if another process holds the lock.
    """
    accelerator = find_accelerator(device)
    with lock_folder(Path(run).expanduser()) if accelerator.is_main_process else nullcontext():
        yield accelerator
