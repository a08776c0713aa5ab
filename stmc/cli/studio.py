"""Open the studio: a page on this machine to write timelines, sample, edit and export motions.

    stmc studio                      with the bundled model
    stmc studio model=runs/mine      with a model of your own

The page is served to this machine alone, sends nothing anywhere, and needs no network.
"""

from __future__ import annotations

import os
import socket
import time
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Timer
from typing import cast, get_args

from rich.console import Console

import stmc
from stmc.cli.commands import command
from stmc.cli.shared_settings import OnModel, Threaded
from stmc.diffusion import tensors
from stmc.evaluation.verification import find_missed
from stmc.io.extras import require
from stmc.io.files import lock_folder, probe
from stmc.model import Precision
from stmc.run.precision import imitates_bf16
from stmc.settings.records import SettingError, setting


@dataclass(frozen=True, kw_only=True)
class Settings(OnModel, Threaded):
    """Settings of `stmc studio`."""

    folder: str = setting("~/.stmc/studio", "where motions and documents are kept")
    port: int = setting(8686, "of the address; 0: any that is free", at_least=0, at_most=65535)
    steps: int | None = setting(
        None,
        "steps of denoising of a motion, whose preview takes fewer; null: 50, or the model's own few",
        at_least=1,
        at_most=1000,
    )
    precision: str | None = setting(
        None, "of the denoiser; null: what is faster on this machine, tried out", choices=get_args(Precision)
    )
    open: bool = setting(True, "open the page in the web browser")
    trusted: tuple[str, ...] = setting((), "packages of your own that the model is made of")


@command("studio", Settings, takes_record=True)
def main(settings: Settings) -> None:
    require("starlette", "uvicorn")
    from stmc.viewing.studio.storage import private_folder  # not above: the studio comes with an extra

    folder = Path(settings.folder).expanduser()
    probe(private_folder(folder))
    with lock_folder(folder), listen(settings.port) as listening:
        serve(settings, folder, listening)


def serve(settings: Settings, folder: Path, listening: socket.socket) -> None:
    """Serve the studio until the user ends it."""
    from stmc.viewing.studio import Sessions, application, program_token
    from stmc.viewing.studio.connections import server_of

    console = Console(soft_wrap=True, highlight=False)
    sessions, port = Sessions(), listening.getsockname()[1]
    sessions.allow(program_token(folder))
    with console.status("loading the model"):
        model = load_model(settings)
    app = application(model, folder, sessions, port, settings.steps, find_missed)
    console.print(
        f"the studio is at http://127.0.0.1:{port}/#token={sessions.invite()}\n"
        f"the address can be opened once; motions and documents are kept in {settings.folder}; Ctrl-C ends it\n"
        f"programs: http://127.0.0.1:{port}/api says how; their token is in {Path(settings.folder) / 'api_token'}",
        markup=False,
    )
    with redirect_file(folder, f"http://127.0.0.1:{port}/#token={sessions.invite()}") as page:
        if settings.open:
            Timer(0.5, webbrowser.open, [page.as_uri()]).start()
        server_of(app).run(sockets=[listening])


@contextmanager
def redirect_file(folder: Path, address: str) -> Iterator[Path]:
    """Write a private file that redirects a browser to `address`, and delete it at the end.

    The address holds a token, and other users of the machine can read the arguments of a browser process.
    """
    path = folder.resolve() / "open.html"
    path.unlink(missing_ok=True)
    try:
        with open(path, "x", opener=lambda name, flags: os.open(name, flags, 0o600)) as file:
            file.write(f'<!doctype html><meta http-equiv="refresh" content="0; url={address}">')
            file.write(f'<a href="{address}">stmc studio</a>')
        yield path
    finally:
        path.unlink(missing_ok=True)


def listen(port: int) -> socket.socket:
    """Open a socket on the loopback interface. Raises `SettingError` if the port is taken."""
    # asyncio turns Nagle's algorithm off only where the protocol is named; with it, each answer comes 40 ms late
    listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind(("127.0.0.1", port))
        listening.listen()
    except OSError as error:
        listening.close()
        raise SettingError(f"port={port}: {error.strerror}; port=0 takes one that is free") from None
    return listening


def load_model(settings: Settings) -> stmc.Model:
    """Load the model in the requested precision, by default in the faster one."""

    def load(precision: Precision) -> stmc.Model:
        return stmc.load(settings.model, device=settings.device, precision=precision, trusted=settings.trusted)

    if settings.precision:
        return load(cast(Precision, settings.precision))  # one of its choices
    if imitates_bf16(tensors.resolve_device(settings.device)):
        return load("fp32")
    return min(map(load, get_args(Precision)), key=time_steps)


def time_steps(model: stmc.Model) -> float:
    """Measure two denoising steps, in seconds, after a warm-up."""

    def try_out() -> None:
        model.generate("walk # 0 # 5", steps=2)

    try_out()
    return time_call(try_out)


def time_call(work: Callable[[], None]) -> float:
    """Measure the duration of a call, in seconds."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began
