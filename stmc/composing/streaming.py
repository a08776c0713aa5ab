"""Motion streams: a timeline without end as frames, sampled in windows that slide over it.

Each window holds the crops that the next frames need. Frames that are out are observed: they are imputed at every step,
and so is, fading, the previous window's idea of the next frames. Depends on runs, plans and features with forward
kinematics; independent of networks and of `Model`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.composing.inpainting import Known
from stmc.composing.running import Run
from stmc.motion.body_model import Skeleton
from stmc.motion.feet import clean_feet
from stmc.motion.motion import Motion
from stmc.motion.representation import SmplRepresentation
from stmc.timeline import Prompt, Timeline
from stmc.timeline.live_timeline import LiveTimeline
from stmc.timeline.planning import Plan, Span, plan, transition_spans

BLOCK_SECONDS = 2.0
"""Seconds of motion that a window adds, unless an edit ends the block earlier."""

LOOKAHEAD_SECONDS = 0.75
"""Seconds after a block whose crops are sampled, too, so that the block ends as the motion goes on."""

BORDER_SECONDS = 0.5
"""Seconds at the start of a block over which the previous window's idea of these frames fades out."""

FEET_SECONDS = 2.0
"""Seconds before a block that tell where feet stand."""


class Frame(NamedTuple):
    """One frame of a stream: its number and time, and the pose as in `Motion`."""

    number: int
    seconds: float
    rotations: Float[Tensor, "22 3 3"]
    translation: Float[Tensor, " 3"]
    joints: Float[Tensor, "24 3"]


@dataclass(frozen=True, eq=False)
class _Sheet:
    """Consecutive frames from `start` on as features, in float64, and as a motion in the world."""

    start: int
    features: Float[Tensor, "frames features"]
    motion: Motion

    @property
    def end(self) -> int:
        return self.start + len(self.features)

    def cut(self, start: int, end: int) -> _Sheet:
        """Return the frames [start, end)."""
        first, last = start - self.start, end - self.start
        return _Sheet(start, self.features[first:last], self.motion.trimmed(first, last))


class MotionStream(Iterator[Frame]):
    """Frames of a timeline without end, one after the other; the body rests where no prompt is.

    Prompts may be added, moved and removed from the first frame on that is not out yet, the `cursor`. With the same
    seed, and the same edits at the same cursors, the frames are the same. Memory stays flat.

    Args:
        run: Run with one timeline's seed and settings; its timelines are replaced.
        sample: Function of a `Method` that composes at every step.
        skeleton: Body of the frames.
        representation: Representation of the features.
        prompts: Prompts to begin with.
        one_shot: Returns the texts of one-shot actions; see `planning.plan`.
        clean: Whether standing feet are kept in place; see `clean_feet`.

    Examples:
        >>> stream = stmc.load().stream("walk # 0 # 4", steps=1)
        >>> next(stream).number, stream.cursor
        (0, 1)
    """

    def __init__(
        self,
        run: Run,
        sample: Callable[[Run], Tensor],
        skeleton: Skeleton,
        representation: SmplRepresentation,
        prompts: Sequence[Prompt] = (),
        one_shot: Callable[[Sequence[Timeline]], Collection[str]] = lambda timelines: (),
        clean: bool = True,
    ) -> None:
        self._template, self._sample, self._representation = run, sample, representation
        self._skeleton, self._clean = Skeleton(skeleton.offsets.double()), clean
        self._one_shot = one_shot
        self._live = LiveTimeline(run.fps, prompts, memory=2 * run.longest)
        self._timeline, self._once = self._current()
        self._sheet: _Sheet | None = None
        self._ready = 0
        """The first frame that is not final yet. Frames of the sheet from here on are the idea of the next block."""

    @property
    def fps(self) -> float | int:
        """Frames per second."""
        return self._template.fps

    @property
    def cursor(self) -> int:
        """The number of the next frame: the first one that an edit can change."""
        return self._live.cursor

    @property
    def prompts(self) -> dict[int, Prompt]:
        """The prompts by number; those that ended long ago are left out."""
        return dict(self._live.prompts)

    @property
    def now(self) -> float:
        """The time of the next frame in seconds."""
        return self._live.now

    def __repr__(self) -> str:
        return f"MotionStream(frame {self.cursor}, {self.now:.2f} s, {len(self._live.prompts)} prompts)"

    def add(self, prompt: Prompt) -> int:
        """Add a prompt and return its number. Raises `TimelineError` if it starts before the next frame."""
        number = self._live.add(prompt)
        self._follow()
        return number

    def move(self, number: int, start: float | int, end: float | int) -> None:
        """Give a prompt other times, in seconds; see `LiveTimeline.move`."""
        self._live.move(number, start, end)
        self._follow()

    def remove(self, number: int) -> None:
        """Take a prompt back; one that has begun ends at the next frame. Raises `TimelineError` if it has ended."""
        self._live.remove(number)
        self._follow()

    def __next__(self) -> Frame:
        """Return the next frame; every block of frames is sampled when its first one is needed."""
        if self.cursor >= self._ready:
            self._extend()
        number, sheet = self.cursor, self._sheet
        motion, index = sheet.motion, number - sheet.start
        self._live.cursor += 1
        poses = (values[index] for values in (motion.rotations, motion.translation, motion.joints))
        return Frame(number, number / self.fps, *poses)

    def take(self, frames: int) -> Motion:
        """Return the next frames as a motion."""
        taken = [next(self) for _ in range(frames)]
        columns = zip(*(frame[2:] for frame in taken), strict=True)
        return Motion(*(torch.stack(values) for values in columns), self.fps)

    def _current(self) -> tuple[Timeline, Collection[str]]:
        timeline = self._live.timeline or Timeline([_NEVER])
        return timeline, self._one_shot([timeline])

    def _follow(self) -> None:
        """Follow an edit: the block ends at the cursor if the edit changes what its frames need."""
        end = self._ready + self._frames(LOOKAHEAD_SECONDS)
        before = self._needed(end)
        self._timeline, self._once = self._current()
        if self._needed(end) != before:
            self._ready = self.cursor

    def _needed(self, end: int) -> set[tuple]:
        """Return the tiles that the frames from the cursor to `end` need, each with its crop, in frames of the stream."""
        if self.cursor >= end:
            return set()
        start, layout = self._layout(end)
        crops = [(crop.text, start + crop.start, start + crop.end) for crop in layout.crops]
        return {
            (*crops[tile.crop], tile.part, max(start + tile.start, self.cursor), start + tile.end, tile.weight)
            for tile in layout.tiles
            if crops[tile.crop][1] < end and crops[tile.crop][2] > self.cursor
        }

    def _layout(self, end: int) -> tuple[int, Plan]:
        """Plan all crops that touch the frames from the cursor to `end`; return the plan's first frame, and the plan."""
        run = self._template
        last, finish, piece = end + run.longest + run.overlap, self._timeline.frames(run.fps), run.longest - run.overlap
        if last > finish:  # pieces of the gap without end do not depend on the window
            last = finish + -(-(last - finish) // piece) * piece
        window = max(0, self.cursor - run.longest), last
        return window[0], plan(self._timeline, run.fps, run.overlap, run.longest, self._once, window)

    def _next_block(self) -> tuple[Span, int]:
        """Return the window of the next block, and the block's end: it does not cut a transition."""
        end, lookahead = self.cursor + self._frames(BLOCK_SECONDS), self._frames(LOOKAHEAD_SECONDS)
        first, layout = self._layout(end + self._template.overlap + lookahead)
        for start, stop in transition_spans(layout):
            if first + start < end < first + stop <= self.cursor + self._frames(BLOCK_SECONDS) + self._template.overlap:
                end = first + stop
        crops = [
            crop for crop in layout.crops
            if first + crop.start < end + lookahead and first + crop.end > self.cursor
        ]  # fmt: skip
        widened = self._template.overlap - self._template.overlap // 2
        last = max(crop.end for crop in crops) - widened
        return (first + min(crop.start for crop in crops), first + max(last, end + lookahead - first)), end

    def _extend(self) -> None:
        """Sample the next block and the frames after it that its crops hold."""
        with torch.inference_mode():
            window, end = self._next_block()
            run = replace(
                self._template,
                timelines=[self._timeline],
                once=self._once,
                window=window,
                known=self._observed(window),
            )
            x0 = self._sample(run)[0, : window[1] - window[0]]
            fresh = self._run_on(window[0], run.statistics.restore(x0.double().cpu()))
            self._sheet = self._cleaned(fresh) if self._clean else fresh
            self._ready = end

    def _observed(self, window: Span) -> Known | None:
        """Return the frames that are out with weight 1, and the sheet's next frames with a fading weight."""
        if self.cursor == 0:
            return None
        run, sheet = self._template, self._sheet
        content = torch.full((window[1] - window[0] + (run.fixed_length or 0), run.layout.width), torch.nan)
        weights = torch.zeros_like(content)
        stop = min(sheet.end, window[1])
        values = run.statistics.normalise(sheet.cut(window[0], stop).features).float()
        content[: len(values)] = values
        border = self._frames(BORDER_SECONDS)
        fade = 1 - torch.arange(1, border + 1) / (border + 1)
        out = self.cursor - window[0]
        weights[:out] = 1
        weights[out : out + border] = fade[: len(weights) - out, None]
        return Known(content[None].to(run.device), weights[None].to(run.device))

    def _run_on(self, first: int, features: Float[Tensor, "frames features"]) -> _Sheet:
        """Append the features of a window from frame `first` on to the frames that are out."""
        if self.cursor == 0:
            return _Sheet(0, features, self._decode(features))
        past = self._sheet.cut(max(self._sheet.start, self.cursor - self._template.longest), self.cursor)
        features = torch.cat([past.features, features[self.cursor - first :]])
        last, place = len(past.features) - 1, past.motion
        moved = self._decode(features[last:], float(place.heading[-1]))
        by = torch.cat([place.translation[-1, :2] - moved.translation[0, :2], place.translation.new_zeros(1)])
        moved = Motion(moved.rotations, moved.translation + by, moved.joints + by, self.fps)
        return _Sheet(past.start, features, _joined(place, moved.trimmed(1, moved.frames)))

    def _decode(self, features: Float[Tensor, "frames features"], heading: float = 0.0) -> Motion:
        return self._representation.decode(features, self.fps, self._skeleton, heading)

    def _cleaned(self, sheet: _Sheet) -> _Sheet:
        """Keep standing feet in place; frames that are out stay as they are."""
        recent = sheet.cut(max(sheet.start, self.cursor - self._frames(FEET_SECONDS)), sheet.end)
        clean = clean_feet(recent.motion, free=torch.arange(recent.start, recent.end) >= self.cursor)
        out = self.cursor - sheet.start
        motion = _joined(sheet.motion.trimmed(0, out), clean.trimmed(self.cursor - recent.start, clean.frames)) if out else clean
        features = sheet.features.clone()
        features[out:] = self._posture(features, motion)[out:]
        return _Sheet(sheet.start, features, motion)

    def _posture(self, features: Tensor, motion: Motion) -> Float[Tensor, "frames features"]:
        """Return the features of a motion, with the steps and turns of `features`."""
        layout = self._representation.layout
        posture = self._representation.encode(motion)
        posture[:, layout["root_height"]] = motion.translation[:, 2:]
        for name in ("root_velocity", "yaw_velocity"):
            posture[:, layout[name]] = features[:, layout[name]]
        return posture

    def _frames(self, seconds: float) -> int:
        return max(1, round(seconds * self.fps))


_NEVER = Prompt("rest", 14_399, 14_400)
"""The prompt of a timeline without prompts, which needs one."""


def _joined(first: Motion, second: Motion) -> Motion:
    pairs = ((getattr(first, name), getattr(second, name)) for name in ("rotations", "translation", "joints"))
    return Motion(*(torch.cat(pair) for pair in pairs), first.fps)
