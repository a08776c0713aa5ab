"""Open the studio: a page on this machine to write timelines, sample, edit and export motions.

    stmc studio                      with the bundled model
    stmc studio model=runs/mine      with a model of your own

The page is served to this machine alone, sends nothing anywhere, and needs no network.
"""

import secrets
import socket
import sys
import time
import webbrowser
from collections.abc import Callable
from dataclasses import dataclass
from threading import Timer
from typing import get_args

import uvicorn
from omegaconf import DictConfig
from rich.console import Console

import stmc
from stmc.commands import command
from stmc.commands.shared import OnModel, Threaded
from stmc.model import Precision
from stmc.settings import SettingError, setting
from stmc.studio import application


@dataclass(frozen=True, kw_only=True)
class Settings(OnModel, Threaded):
    folder: str = setting("~/.stmc/studio", "where motions and documents are kept")
    port: int = setting(8686, "of the address; 0: any that is free", at_least=0, at_most=65535)
    steps: int = setting(50, "steps of denoising of a motion; its preview takes fewer", at_least=1, at_most=1000)
    precision: str | None = setting(
        None, "of the denoiser; null: what is faster on this machine, tried out", choices=get_args(Precision)
    )
    open: bool = setting(True, "open the page in the web browser")
    trusted: tuple[str, ...] = setting((), "packages of your own that the model is made of")


@command("studio", Settings)
def main(config: DictConfig) -> None:
    console = Console(soft_wrap=True, highlight=False)
    listening = listen(config.port)
    port, token = listening.getsockname()[1], secrets.token_urlsafe(18)
    with console.status("loading the model"):
        model = loaded(config)
    address = f"http://127.0.0.1:{port}/?token={token}"
    console.print(
        f"the studio is at {address}\nmotions and documents are kept in {config.folder}; Ctrl-C ends it", markup=False
    )
    if config.open:
        Timer(0.5, webbrowser.open, [address]).start()
    app = application(model, config.folder, token, port, config.steps)
    server = uvicorn.Server(uvicorn.Config(app, log_level="warning", timeout_graceful_shutdown=2))
    server.run(sockets=[listening])


def listen(port: int) -> socket.socket:
    """A socket of this machine alone. Raises `SettingError` where the port is taken."""
    listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind(("127.0.0.1", port))
    except OSError as error:
        raise SettingError(f"port={port}: {error.strerror}; port=0 takes one that is free") from None
    return listening


def loaded(config: DictConfig) -> stmc.Model:
    """The model, in the precision that is asked for, or else in the faster one."""

    def load(precision: str) -> stmc.Model:
        return stmc.load(config.model, device=config.device, precision=precision, trusted=config.trusted)

    if config.precision:
        return load(config.precision)
    return min(map(load, get_args(Precision)), key=seconds)


def seconds(model: stmc.Model) -> float:
    """How long two steps take, the first try aside."""

    def try_out() -> None:
        model.generate("walk # 0 # 5", steps=2)

    try_out()
    return timed(try_out)


def timed(work: Callable[[], None]) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


if __name__ == "__main__":
    sys.exit(main())
