"""Exit codes of commands: user errors give one line and 2, Ctrl-C one line and 130, bugs a traceback.

The raiser decides: a `ValueError` raised by this library is a message to the user, one raised by torch or NumPy is a
bug of ours.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from types import FrameType
from typing import TextIO

import hydra
import omegaconf
from hydra.errors import HydraException
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException
from yaml import YAMLError

from stmc.cli.config_folder import PACKAGE
from stmc.io.extras import missing_extra

USAGE, STOPPED, ENDED = 2, 130, 143
"""Exit codes of a user error, of Ctrl-C, and of a request to end (SIGTERM)."""
_CONFIG_PACKAGES = tuple(Path(package.__path__[0]).resolve() for package in (hydra, omegaconf))
MAX_CHARACTERS = 380
"""Maximum number of characters of a message."""


def run_guarded(run: Callable[[], object]) -> int:
    """Run a command and return its exit code; print errors that the user can fix as one line to stderr."""
    with warnings.catch_warnings():
        warnings.showwarning = _print_warning
        try:
            _exit_on_sigterm()
            run()
            sys.stdout.flush()
        except KeyboardInterrupt:
            _print_line("Interrupted. Run the same command again to resume.")
            return STOPPED
        except BrokenPipeError:  # the reader of our output has closed it
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        except Exception as error:
            sentence = explain_error(error)
            if sentence is None:
                raise
            _print_line(sentence)
            return USAGE
    return 0


def explain_error(error: BaseException) -> str | None:
    """Return an error's message to the user in one line, or None for a bug."""
    if isinstance(error, HydraException) and error.__cause__ is not None:
        return explain_error(error.__cause__)
    if (message := missing_extra(error)) is not None:
        return message
    if isinstance(error, HydraException) and "'hydra/launcher/submitit" in str(error):
        return "this needs hydra-submitit-launcher: pip install 'stmc[slurm]'"
    if isinstance(error, (ConfigAttributeError, ConfigKeyError)) and "not in struct" in str(error):
        return to_one_line(
            f"there is no setting {error.full_key}; add a key of your own with a plus: +{error.full_key}=…"
        )
    if isinstance(error, (HydraException, OmegaConfBaseException, YAMLError)):
        return to_one_line(str(error).partition("full_key:")[0].partition("See https")[0])
    if isinstance(error, BrokenProcessPool):
        return "a worker process was killed, perhaps for lack of memory; run again with fewer workers="
    if isinstance(error, OSError):
        return to_one_line(_system_message(error))
    if isinstance(error, (ValueError, FloatingPointError)) and _is_ours(error):
        return to_one_line(str(error))
    return None


def to_one_line(text: str) -> str:
    """Remove line breaks and control characters from a text and truncate it."""
    line = " ".join(text.split())
    line = "".join(each if each.isprintable() else repr(each)[1:-1] for each in line[: MAX_CHARACTERS + 1])
    return line if len(line) <= MAX_CHARACTERS else f"{line[:MAX_CHARACTERS]}…"


def _system_message(error: OSError) -> str:
    if error.strerror is None or error.filename is None:
        return error.strerror or str(error)
    return f"{error.filename}: {error.strerror[:1].lower()}{error.strerror[1:]}"


def _is_ours(error: BaseException) -> bool:
    """Return whether the library, Hydra or OmegaConf raised an error, or the user's package raised one of ours."""
    if type(error).__module__.startswith(f"{PACKAGE.name}."):
        return True
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    raised = Path(trace.tb_frame.f_code.co_filename).resolve() if trace is not None else Path()
    return any(raised.is_relative_to(folder) for folder in (PACKAGE, *_CONFIG_PACKAGES))


def _exit_on_sigterm() -> None:
    """Turn SIGTERM into a line and `SystemExit`, so that `finally` blocks remove temporary files.

    During an import the process ends at once, because extension modules replace an exception that passes through them.
    """
    process = os.getpid()

    def end(_: int, frame: FrameType | None) -> None:
        if os.getpid() == process:  # workers inherit this function
            os.write(2, b"Terminated. Run the same command again to resume.\n")
        if _is_importing(frame):
            os._exit(ENDED)
        sys.exit(ENDED)

    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, end)


def _is_importing(frame: FrameType | None) -> bool:
    while frame is not None and not frame.f_code.co_filename.startswith("<frozen importlib"):
        frame = frame.f_back
    return frame is not None


def _print_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    if issubclass(category, UserWarning):
        _print_line(f"warning: {to_one_line(str(message))}")


def _print_line(line: str) -> None:
    sys.stderr.write(f"{line}\n")
