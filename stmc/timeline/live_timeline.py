"""A timeline that changes while it is played: prompts are added, moved and removed ahead of a cursor.

Depends on prompts and frames; independent of motions and sampling.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from dataclasses import replace
from types import MappingProxyType

from stmc.io.untrusted import quote
from stmc.timeline.advice import TimelineWarning
from stmc.timeline.prompts import Prompt, Timeline
from stmc.timeline.timeline_files import TimelineError


class LiveTimeline:
    """Prompts by number, and a cursor: the first frame that is still open. Frames before it do not change.

    Prompts that ended long before the cursor are forgotten when prompts change, so that memory stays flat.

    Args:
        fps: Frames per second.
        prompts: Prompts to begin with; they get the numbers from 0 on.
        memory: Number of frames after which a prompt that has ended is forgotten.

    Examples:
        >>> live = stmc.timeline.LiveTimeline(fps=20, prompts=[stmc.Prompt("walk", 0, 4)])
        >>> live.cursor = 30
        >>> live.add(stmc.Prompt("wave", 2, 3, ["right arm"]))
        1
        >>> live.remove(0)
        >>> live.prompts[0].end
        1.5
    """

    def __init__(self, fps: float | int, prompts: Iterable[Prompt] = (), memory: int = 1000) -> None:
        self.fps, self.memory, self.cursor = fps, memory, 0
        self._prompts = dict(enumerate(prompts))
        self._next = len(self._prompts)
        self.timeline = self._arrange(self._prompts)

    @property
    def prompts(self) -> Mapping[int, Prompt]:
        """The prompts that are not forgotten, by number."""
        return MappingProxyType(self._prompts)

    @property
    def now(self) -> float:
        """The cursor in seconds: a prompt that starts at this time starts at the cursor."""
        return self._seconds(self.cursor)

    def add(self, prompt: Prompt) -> int:
        """Add a prompt and return its number. Raises `TimelineError` if it starts behind the cursor."""
        self._check_start(prompt)
        self._change({**self._prompts, self._next: prompt})
        self._next += 1
        return self._next - 1

    def move(self, number: int, start: float | int, end: float | int) -> None:
        """Give a prompt other times. A prompt that has begun keeps its start.

        Args:
            number: Number of the prompt.
            start: Start in seconds.
            end: End in seconds.

        Raises:
            TimelineError: If the prompt or one of its new times is behind the cursor, or the times are invalid.
        """
        before = self._find(number)
        after = replace(before, start=start, end=end)
        if not self._began(before):
            self._check_start(after)
        elif self._frame(after.start) != self._frame(before.start):
            raise TimelineError(f"{quote(before.text)} has begun at {before.start:g} s; only its end can move")
        elif self._frame(after.end) < self.cursor:
            raise TimelineError(f"{quote(before.text)} cannot end at {after.end:g} s: {self._open_from()}")
        self._change({**self._prompts, number: after})

    def remove(self, number: int) -> None:
        """Take a prompt back. A prompt that has begun ends at the cursor. Raises `TimelineError` if it has ended."""
        prompt = self._find(number)
        others = {key: other for key, other in self._prompts.items() if key != number}
        self._change({**others, number: replace(prompt, end=self.now)} if self._began(prompt) else others)

    def _find(self, number: int) -> Prompt:
        if not 0 <= number < self._next:
            choices = f"they have the numbers 0 to {self._next - 1}" if self._next else "there are none"
            raise TimelineError(f"there is no prompt {quote(number)}: {choices}")
        prompt = self._prompts.get(number)
        if prompt is None or self._frame(prompt.end) <= self.cursor:
            raise TimelineError(f"prompt {number} has been removed or has ended: {self._open_from()}")
        return prompt

    def _check_start(self, prompt: Prompt) -> None:
        if self._frame(prompt.start) < self.cursor:
            raise TimelineError(f"{quote(prompt.text)} cannot start at {prompt.start:g} s: {self._open_from()}")

    def _open_from(self) -> str:
        return f"changes are possible from {self.now:.2f} s on"

    def _began(self, prompt: Prompt) -> bool:
        return self._frame(prompt.start) < self.cursor

    def _frame(self, seconds: float) -> int:
        return int(self.fps * seconds)  # as `Timeline.spans`

    def _seconds(self, frame: int) -> float:
        seconds = frame / self.fps
        return seconds if self._frame(seconds) == frame else (frame + 0.5) / self.fps

    def _change(self, prompts: Mapping[int, Prompt]) -> None:
        """Replace the prompts, unless they are no timeline, and forget old ones."""
        latest = max(prompts, key=lambda number: self._ended(prompts[number]), default=None)
        kept = {
            number: prompt
            for number, prompt in sorted(prompts.items())
            if self._frame(prompt.end) > self.cursor - self.memory or number == latest
        }
        self.timeline, self._prompts = self._arrange(kept), kept

    def _ended(self, prompt: Prompt) -> float:
        """Return when a prompt ended; the gap at the cursor begins with the latest end."""
        return prompt.end if self._frame(prompt.end) <= self.cursor else -1.0

    @staticmethod
    def _arrange(prompts: Mapping[int, Prompt]) -> Timeline | None:
        """Return the timeline, without repeating with every edit which prompts claim a body part together."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", TimelineWarning)
            return Timeline(tuple(prompts.values())) if prompts else None
