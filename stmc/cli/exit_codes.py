"""How a command ends: what the user got wrong is one line and exit code 2, Ctrl-C one line and 130, a bug a traceback.

Which is which is told by who raised: a `ValueError` out of this library or its scripts is a sentence for the user, one
out of torch or NumPy is a bug of ours.
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

import hydra
import omegaconf
from hydra.errors import HydraException
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException
from yaml import YAMLError

from stmc.cli.config_folder import PACKAGE
from stmc.io.extras import missing_extra

USAGE, STOPPED, ENDED = 2, 130, 143
"""Exit codes: what the user got wrong, Ctrl-C, and a request to end (SIGTERM)."""
_COMPOSERS = tuple(Path(package.__file__).resolve().parent for package in (hydra, omegaconf))
MOST = 380
"""Characters of a message."""


def guarded(run: Callable[[], object]) -> int:
    """Runs a command and says how it ended, as an exit code; what the user can do something about is told in one line
    on stderr."""
    with warnings.catch_warnings():
        warnings.showwarning = _warn
        try:
            _end_when_asked()
            run()
            sys.stdout.flush()
        except KeyboardInterrupt:
            _say("Interrupted. Run the same command again to resume.")
            return STOPPED
        except BrokenPipeError:  # whoever read our output has enough
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        except Exception as error:
            sentence = explained(error)
            if sentence is None:
                raise
            _say(sentence)
            return USAGE
    return 0


def explained(error: BaseException) -> str | None:
    """What a user should read of an error, in one line; None where it is a bug."""
    if isinstance(error, HydraException) and error.__cause__ is not None:
        return explained(error.__cause__)
    if (message := missing_extra(error)) is not None:
        return message
    if isinstance(error, HydraException) and "'hydra/launcher/submitit" in str(error):
        return "this needs hydra-submitit-launcher: pip install 'stmc[slurm]'"
    if isinstance(error, (ConfigAttributeError, ConfigKeyError)) and "not in struct" in str(error):
        return one_line(f"there is no setting {error.full_key}; a plus adds a key of your own: +{error.full_key}=…")
    if isinstance(error, (HydraException, OmegaConfBaseException, YAMLError)):
        return one_line(str(error).partition("full_key:")[0].partition("See https")[0])
    if isinstance(error, BrokenProcessPool):
        return "a worker was killed, perhaps for lack of memory; run again with fewer workers="
    if isinstance(error, OSError):
        return one_line(_of_the_system(error))
    if isinstance(error, (ValueError, FloatingPointError)) and _is_ours(error):
        return one_line(str(error))
    return None


def one_line(text: str) -> str:
    """A text without line breaks and control characters, cut where it is long."""
    line = " ".join(text.split())
    line = "".join(each if each.isprintable() else repr(each)[1:-1] for each in line[: MOST + 1])
    return line if len(line) <= MOST else f"{line[:MOST]}…"


def _of_the_system(error: OSError) -> str:
    if error.strerror is None or error.filename is None:
        return error.strerror or str(error)
    return f"{error.filename}: {error.strerror[:1].lower()}{error.strerror[1:]}"


def _is_ours(error: BaseException) -> bool:
    """Whether this library raised it, one of its scripts, what composes the settings, or a package of the user's own by
    an error of this library's."""
    if type(error).__module__.startswith(f"{PACKAGE.name}."):
        return True
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    raised = Path(trace.tb_frame.f_code.co_filename).resolve() if trace is not None else Path()
    return any(raised.is_relative_to(folder) for folder in (PACKAGE, *_COMPOSERS))


def _end_when_asked() -> None:
    """Has SIGTERM end the process as an exception does, so that temporary files go."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(ENDED))


def _warn(message: Warning | str, category: type[Warning], *_: object) -> None:
    if issubclass(category, UserWarning):
        _say(f"warning: {one_line(str(message))}")


def _say(line: str) -> None:
    sys.stderr.write(f"{line}\n")
