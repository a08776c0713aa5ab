"""Stream the motion of a timeline that is edited while it plays: frames as lines of JSON, or as OSC over UDP.

    stmc stream                                         edits on stdin, frames on stdout
    stmc stream "walk # 0 # 4" to=osc://127.0.0.1:9000  frames for an engine on this machine

Every line on stdin is an edit: {"add": {"text": "wave", "seconds": 2, "body_parts": ["right arm"]}}, {"move": 0,
"start": 5, "end": 7} or {"remove": 0}; it is answered by a line on stdout. Ctrl-C ends the stream.
"""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from queue import Empty, Queue
from threading import Event, Thread
from typing import Any, cast, get_args

from rich.console import Console

import stmc
from stmc.cli.commands import command
from stmc.cli.sample import read_timelines
from stmc.cli.shared_settings import OnDevice, Threaded
from stmc.cli.stream_outputs import Output, open_output
from stmc.composing.sampling import Sampling
from stmc.diffusion.tensors import resolve_device
from stmc.editing.generate_request import GenerateRequest
from stmc.editing.stream_edits import answer_edit
from stmc.editing.streaming import Frame, MotionStream
from stmc.io.untrusted import UnreadableError, load_json
from stmc.model import Precision
from stmc.settings.records import SettingError, as_in, setting

MOST_LETTERS = 1_000_000
"""Maximum number of characters of a line on stdin."""
MOST_EDITS = 1000
"""Maximum number of edits that wait for the next frame."""


@dataclass(frozen=True, kw_only=True)
class Settings(Sampling, OnDevice, Threaded):
    """Settings of `stmc stream`."""

    timeline: str | None = setting(None, ".json or .txt file of one timeline, or its text; null: none to begin with")
    to: str = setting("json", "json: lines on stdout; osc://HOST:PORT: OSC bundles over UDP")
    model: str | None = setting("mdm_smpl_wide_fast", "run directory or bundled model; null: the default model")
    seed: int = as_in(GenerateRequest, "seeds", 0)
    method: str = setting("stmc", "method of composition; it must compose at every step")
    clean_feet: bool = as_in(GenerateRequest, "clean_feet")
    ahead: float | int = setting(
        0.75, "motion that is sampled ahead of time: edits take effect after it", unit="s", above=0, at_most=60
    )
    realtime: bool = setting(True, "write frames at the model's frame rate; false: as soon as they are sampled")
    seconds: float | int | None = setting(None, "motion to stream; null: until Ctrl-C", unit="s", above=0)
    allow_remote: bool = setting(False, "send OSC to other machines, too")
    precision: str = setting("fp32", "of the denoiser; bf16 is faster on some processors", choices=get_args(Precision))
    trusted: tuple[str, ...] = setting((), "your own packages that hold classes of the model")


@command("stream", Settings, ("timeline",), takes_record=True)
def main(settings: Settings) -> None:
    timelines = [] if settings.timeline is None else read_timelines(settings.timeline)[0]
    if len(timelines) > 1:
        raise SettingError(f"timeline={settings.timeline}: {len(timelines)} timelines; a stream plays one")
    resolve_device(settings.device)
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    with open_output(settings.to, settings.allow_remote) as output, console.status("loading the model") as status:
        stream = open_stream(settings, timelines)
        output.begin(stream)
        status.stop()
        play(settings, stream, output, console)


def open_stream(settings: Settings, timelines: list[stmc.Timeline]) -> MotionStream:
    """Load the model and open the stream."""
    precision = cast(Precision, settings.precision)  # one of its choices
    model = stmc.load(settings.model, device=settings.device, precision=precision, trusted=settings.trusted)
    own: dict[str, Any] = {"seed": settings.seed, "method": settings.method, "clean_feet": settings.clean_feet}
    sampling = {name: getattr(settings, name) for name in Sampling.__dataclass_fields__}
    own |= {name: value for name, value in sampling.items() if value is not None}
    if timelines:
        own["timeline"] = timelines[0]
    return model.stream(**own)


def play(settings: Settings, stream: MotionStream, output: Output, console: Console) -> None:
    """Write frames, and the answers to edits, until the end or Ctrl-C."""
    ahead = max(1, round(settings.ahead * stream.fps))
    last = None if settings.seconds is None else round(settings.seconds * stream.fps)
    source, frames, late, due = Source(stream, ahead, last), 0, 0, None
    try:
        for item in source:
            if not isinstance(item, Frame):
                output.answer(item)
                continue
            now = time.monotonic()
            if settings.realtime:
                late += due is not None and now > due + 1 / stream.fps
                due = now if due is None else max(due, now)
                time.sleep(due - now)
                due += 1 / stream.fps
            output.write(item)
            frames += 1
    except KeyboardInterrupt:
        pass  # the usual end
    finally:
        source.close()
    waits = f"; it had to wait {late} times" if late else ""
    console.print(f"streamed {frames:,} frames, {frames / stream.fps:.1f} s{waits}", markup=False)


class Source:
    """Frames sampled ahead in a thread of their own, and the answers to the edits that stdin holds.

    Args:
        stream: The stream; only this thread uses it from now on.
        ahead: Number of frames to sample ahead.
        last: Number of frames after which the source ends; None: never.
    """

    def __init__(self, stream: MotionStream, ahead: int, last: int | None) -> None:
        self._stream, self._last, self._ended = stream, last, Event()
        self._items: Queue[Any] = Queue(maxsize=ahead)
        self._edits: deque[str] = deque(maxlen=MOST_EDITS)
        self._sampling = Thread(target=self._sample, name="stream", daemon=True)
        for thread in (self._sampling, Thread(target=self._read, name="stdin", daemon=True)):
            thread.start()

    def __iter__(self) -> Iterator[Frame | dict[str, Any]]:
        """Yield frames and answers in order. Raises what sampling raises."""
        while True:
            try:
                item = self._items.get(timeout=1)  # without a timeout, Ctrl-C would wait for the next frame
            except Empty:
                continue
            if item is None:
                return
            if isinstance(item, BaseException):
                raise item
            yield item

    def close(self) -> None:
        """End the thread; the block that is being sampled is finished first."""
        self._ended.set()
        while self._sampling.is_alive():
            while not self._items.empty():
                self._items.get()
            self._sampling.join(timeout=0.05)

    def _sample(self) -> None:
        try:
            while not self._ended.is_set() and (self._last is None or self._stream.cursor < self._last):
                while self._edits:
                    self._items.put(_answer(self._stream, self._edits.popleft()))
                self._items.put(next(self._stream))
            self._items.put(None)
        except Exception as error:
            self._items.put(error)

    def _read(self) -> None:
        while line := sys.stdin.readline(MOST_LETTERS):
            if line.strip():
                self._edits.append(line)


def _answer(stream: MotionStream, line: str) -> dict[str, Any]:
    """Apply the edit of a line; a refused one is answered by a sentence."""
    try:
        edit = load_json(line)
        if not isinstance(edit, dict):
            raise SettingError("edit: must be a JSON object on one line")
    except (SettingError, UnreadableError) as error:
        return {"error": str(error), "frame": stream.cursor}
    return answer_edit(stream, edit)
