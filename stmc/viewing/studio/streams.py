"""Streams of the studio: motions that are edited while they are read, a few at a time, within bounds.

This module knows streams, prompts and JSON values; it knows no HTTP.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from threading import Lock
from typing import Any, cast

import torch

from stmc.editing.stream_edits import answer_edit
from stmc.editing.stream_frames import describe_frame, describe_stream
from stmc.editing.streaming import EMPTY, MotionStream
from stmc.formats.axes import Z_UP_TO_Y_UP
from stmc.formats.glb import Animation, glb_of
from stmc.motion.body import NUM_ROTATIONS
from stmc.motion.body_model import Skeleton
from stmc.motion.motion import Motion
from stmc.motion.skins import build_mannequin
from stmc.run.suggestions import Suggest, with_suggestions
from stmc.timeline import Prompt, Timeline, TimelineError
from stmc.viewing.studio.documents_json import MOST_PROMPTS, MOST_SECONDS, sort_parts
from stmc.viewing.studio.request_errors import RequestError
from stmc.viewing.studio.responses import OpenedStream, StreamFrames, StreamPrompt
from stmc.viewing.studio.sampling_turns import Turns

MOST_STREAMS = 2
"""Maximum number of streams; another one ends the one that was read longest ago."""

IDLE_SECONDS = 600.0
"""Seconds without a request after which a stream ends."""

MOST_TEXT = 1000
"""Maximum number of letters of a text that is added."""

Open = Callable[..., MotionStream]
"""`Model.stream`, or a function like it."""


@dataclass(eq=False)
class _Entry:
    stream: MotionStream
    used: float
    """When it was last read, in seconds of the clock."""
    reading: Lock = field(default_factory=Lock)


class Streams:
    """Streams by name, which take turns with the jobs.

    Args:
        open: `Model.stream`, or a function like it.
        steps: Denoising steps, unless a request says how many.
        suggest: Suggests the body parts of prompts that list none.
        turns: Turns of sampling.
        clock: Seconds of a clock that never goes back.
    """

    def __init__(
        self, open: Open, steps: int, suggest: Suggest, turns: Turns, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._open, self._steps, self._suggest, self._turns, self._clock = open, steps, suggest, turns, clock
        self._entries: dict[str, _Entry] = {}
        self._lock = Lock()

    def open(self, timeline: Timeline | None, seed: int, settings: Mapping[str, Any]) -> OpenedStream:
        """Open a stream. Raises `RequestError` if all streams are being read, and `SettingError` as `Model.stream`.

        Args:
            timeline: Timeline to begin with; None: none.
            seed: Seed.
            settings: Settings of `Model.stream`.
        """
        timeline = EMPTY if timeline is None else with_suggestions(timeline, self._suggest)[0]
        stream = self._open(timeline, seed, **{"steps": self._steps, **settings})
        name = secrets.token_urlsafe(9)
        with self._lock:
            self._make_room()
            self._entries[name] = _Entry(stream, self._clock())
        opened = {"stream": name, **describe_stream(stream), "prompts": _describe_prompts(stream)}
        return cast(OpenedStream, opened)

    def read(self, name: str, edits: Sequence[dict[str, Any]], frames: int) -> StreamFrames:
        """Apply edits, and return the answers to them and the next frames; fewer where the stream ends.

        Raises `RequestError` if there is no such stream, or if another request reads it at this moment.

        Args:
            name: Name of the stream.
            edits: Edits, as `apply_edit` takes them.
            frames: Number of frames.
        """
        entry = self._find(name)
        if not entry.reading.acquire(blocking=False):
            raise RequestError(429, "another request is reading this stream; wait for its answer")
        try:
            stream, last = entry.stream, round(MOST_SECONDS * entry.stream.fps)
            answers = [self._answer(stream, edit) for edit in edits]
            described = self._take(stream, min(frames, last - stream.cursor))
            ended = stream.cursor >= last
            return {"answers": answers, "frames": described, "prompts": _describe_prompts(stream), "ended": ended}
        finally:
            entry.used = self._clock()
            entry.reading.release()

    def close(self, name: str) -> None:
        """End a stream. Raises `RequestError` if there is none."""
        self._find(name)
        with self._lock:
            self._entries.pop(name, None)

    def _find(self, name: str) -> _Entry:
        with self._lock:
            self._forget()
            if name not in self._entries:
                raise RequestError(404, "there is no such stream, or it has ended; open another one")
            return self._entries[name]

    def _forget(self) -> None:
        """Forget idle streams."""
        latest = self._clock() - IDLE_SECONDS
        idle = {name for name, each in self._entries.items() if each.used < latest and not each.reading.locked()}
        self._entries = {name: each for name, each in self._entries.items() if name not in idle}

    def _make_room(self) -> None:
        self._forget()
        if len(self._entries) < MOST_STREAMS:
            return
        waiting = {name: each.used for name, each in self._entries.items() if not each.reading.locked()}
        if not waiting:
            raise RequestError(429, f"{MOST_STREAMS} streams are being read, the maximum; end one first")
        del self._entries[min(waiting, key=lambda name: waiting[name])]

    def _take(self, stream: MotionStream, frames: int) -> list[Any]:
        if frames <= 0:
            return []
        with self._turns.stream():
            return [describe_frame(next(stream)) for _ in range(frames)]

    def _answer(self, stream: MotionStream, edit: dict[str, Any]) -> Any:
        refusal = _beyond_bounds(stream, edit)
        if refusal is not None:
            return {"error": refusal, "frame": stream.cursor}
        return answer_edit(stream, self._with_parts(edit))

    def _with_parts(self, edit: dict[str, Any]) -> dict[str, Any]:
        """Add suggested body parts to an added prompt that does not say which."""
        prompt = edit.get("add")
        if not isinstance(prompt, dict) or "body_parts" in prompt or not isinstance(prompt.get("text"), str):
            return edit
        try:
            timeline = Timeline((Prompt(prompt["text"], 0, 1),))
        except TimelineError:
            return edit  # the stream refuses it
        [suggested] = with_suggestions(timeline, self._suggest)[0].prompts
        return {**edit, "add": {**prompt, "body_parts": list(sort_parts(suggested.parts))}}


def _beyond_bounds(stream: MotionStream, edit: Mapping[str, Any]) -> str | None:
    """Return a sentence about an edit that the studio does not take; None: the stream may see it."""
    prompt = edit.get("add")
    values = {**edit, **prompt} if isinstance(prompt, dict) else edit
    for name in ("start", "end", "seconds"):
        value = values.get(name)
        if isinstance(value, (int, float)) and value > MOST_SECONDS:
            return f"{name}={value:g}: {MOST_SECONDS} s at most in the studio"
    text = values.get("text")
    if isinstance(text, str) and len(text) > MOST_TEXT:
        return f"a text of {len(text):,} letters: {MOST_TEXT:,} at most in the studio"
    if isinstance(prompt, dict) and len(stream.prompts) >= MOST_PROMPTS:
        return f"{len(stream.prompts)} prompts: {MOST_PROMPTS} at most in the studio; remove one first"
    return None


def _describe_prompts(stream: MotionStream) -> list[StreamPrompt]:
    return [
        {"number": number, "text": each.text, "start": each.start, "end": each.end, "parts": sort_parts(each.parts)}
        for number, each in stream.prompts.items()
    ]


def mannequin_file(skeleton: Skeleton, fps: float | int) -> bytes:
    """Return a `.glb` file of the mannequin at rest; its nodes have the names of the joints in streams.

    Args:
        skeleton: Body of the mannequin.
        fps: Frame rate of its only frame.
    """
    rotations = torch.eye(3).repeat(1, NUM_ROTATIONS, 1, 1)
    rotations[:, 0] = torch.from_numpy(Z_UP_TO_Y_UP).float().T
    height = float(skeleton.rest[0, 1] - skeleton.rest[:, 1].min())
    rest = Motion.posed(rotations, torch.tensor([[0.0, 0.0, height]]), fps, skeleton)
    return glb_of(build_mannequin(skeleton), {"rest": Animation(rest)})
