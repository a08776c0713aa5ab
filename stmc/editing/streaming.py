"""Motion streams: the frames of a timeline without end, which is edited while it plays.

Windows slide over the timeline. Each holds the crops that the next frames need; frames that are out are observed at
every step, and so, fading, are the next frames as the previous window had them. Depends on runs, plans and features
with forward kinematics; independent of networks and of `Model`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from stmc.composing import Observed, Run
from stmc.composing.sampling import Sampling
from stmc.editing.generate_request import GenerateRequest
from stmc.motion.body_model import Skeleton
from stmc.motion.feet import clean_feet
from stmc.motion.motion import Motion
from stmc.motion.representation import Representation, SmplRepresentation
from stmc.settings.records import SettingError
from stmc.timeline import LiveTimeline, Prompt, Timeline
from stmc.timeline.planning import Plan, Span, plan, transition_spans

EMPTY = Timeline([Prompt("rest", 14_399, 14_400)])
"""Stands for a timeline without prompts: the body rests."""
BLOCK_SECONDS = 2.0
"""Seconds of motion that a window adds, unless an edit ends the block earlier."""
LOOKAHEAD_SECONDS = 1.0
"""Seconds after a block whose crops the window holds, too, so that the block ends as the motion goes on."""
BORDER_SECONDS = 1.0
"""Seconds at the start of a block in which the frames of the previous window fade out; with half of it, limbs jump
after edits."""

FEET_SECONDS = 2.0
"""Seconds before a block that tell where feet stand."""


class Frame(NamedTuple):
    """A frame of a stream, in float64: its number, its time, and the pose as in `Motion`."""

    number: int
    seconds: float
    rotations: Float[Tensor, "22 3 3"]
    translation: Float[Tensor, " 3"]
    joints: Float[Tensor, "24 3"]


@dataclass(frozen=True, eq=False)
class _Sheet:
    """Consecutive frames from frame `start` on, in float64, as features and as a motion in the world."""

    start: int
    features: Float[Tensor, "frames features"]
    motion: Motion

    @property
    def end(self) -> int:
        return self.start + len(self.features)

    def slice(self, start: int, end: int) -> _Sheet:
        """Return the frames [start, end)."""
        first, last = start - self.start, end - self.start
        return _Sheet(start, self.features[first:last], self.motion.trimmed(first, last))


class MotionStream(Iterator[Frame]):
    """Frames of a timeline without end, one after the other; where no prompt is, the body rests.

    Prompts may be added, moved and removed from the next frame on. The same seed, and the same edits before the same
    frames, give the same frames. Memory stays flat. A block of frames is sampled when its first frame is asked for.

    Args:
        run: A run with the seed, the settings and the predictors; it needs no timelines.
        request: The request; its timeline is the one to begin with.
        skeleton: Body of the frames.
        representation: Representation of the features.
        read: Returns timelines as the model reads them; see `in_own_words`.
        one_shot: Finds the texts of one-shot actions; see `planning.plan`.

    Raises:
        SettingError: If the request has several timelines, keeps motions or has constraints, if its method does not
            compose at every step, or if the representation has no forward kinematics.

    Examples:
        >>> stream = stmc.load().stream("walk # 0 # 4", steps=1)
        >>> next(stream).number, stream
        (0, MotionStream(next frame 1 at 0.05 s, 1 prompts))
        >>> stream.add(stmc.Prompt("raise the right arm", 2, 4, ["right arm"]))
        1
    """

    def __init__(
        self,
        run: Run,
        request: GenerateRequest,
        skeleton: Skeleton,
        representation: Representation,
        read: Callable[[Sequence[Timeline]], Sequence[Timeline]],
        one_shot: Callable[[Sequence[Timeline]], Collection[str]],
    ) -> None:
        _check(request, representation)
        [timeline] = request.timelines
        prompts = () if timeline == EMPTY else timeline.prompts
        self._run, self._sample, self._clean = run, request.resolved_method.sample, request.clean_feet
        self.skeleton, self._representation = Skeleton(skeleton.offsets.double()), representation
        self._live, self._read, self._one_shot = LiveTimeline(run.fps, prompts, 2 * run.longest), read, one_shot
        self._follow_timeline(timeline)
        self._sheet: _Sheet | None = None
        self._ready = 0
        """The first frame that is not final; the frames of the sheet from here on fade out in the next block."""

    def __repr__(self) -> str:
        return f"MotionStream(next frame {self.cursor} at {self.now:g} s, {len(self.prompts)} prompts)"

    @property
    def fps(self) -> float | int:
        """Frames per second."""
        return self._run.fps

    @property
    def cursor(self) -> int:
        """The number of the next frame, the first one that an edit can change."""
        return self._live.cursor

    @property
    def now(self) -> float:
        """The time of the next frame in seconds: a prompt that starts at this time starts at the next frame."""
        return self._live.now

    @property
    def prompts(self) -> Mapping[int, Prompt]:
        """The prompts by number, without those that ended long ago."""
        return self._live.prompts

    def add(self, prompt: Prompt) -> int:
        """Add a prompt and return its number. Raises `TimelineError` if it starts before the next frame.

        Examples:
            >>> stmc.load().stream("walk # 0 # 4", steps=1).add(stmc.Prompt("wave", 1, 3, ["left arm"]))
            1
        """
        number = self._live.add(prompt)
        self._follow()
        return number

    def move(self, number: int, start: float | int, end: float | int) -> None:
        """Give a prompt other times. A prompt that has begun keeps its start.

        Args:
            number: Number of the prompt.
            start: Start in seconds.
            end: End in seconds.

        Raises:
            TimelineError: If the prompt or one of its new times is before the next frame, or the times are invalid.

        Examples:
            >>> stream = stmc.load().stream("walk # 0 # 4", steps=1)
            >>> stream.move(0, 1, 3)
            >>> stream.prompts[0].end
            3.0
        """
        self._live.move(number, start, end)
        self._follow()

    def remove(self, number: int) -> None:
        """Take a prompt back; one that has begun ends at the next frame. Raises `TimelineError` if it has ended.

        Examples:
            >>> stream = stmc.load().stream("walk # 0 # 4", steps=1)
            >>> stream.remove(0)
            >>> len(stream.prompts)
            0
        """
        self._live.remove(number)
        self._follow()

    def __next__(self) -> Frame:
        """Return the next frame."""
        if self._sheet is None or self.cursor >= self._ready:
            self._sheet, self._ready = self._sample_block()
        number, motion = self.cursor, self._sheet.motion
        self._live.cursor += 1
        index = number - self._sheet.start
        return Frame(
            number, number / self.fps, motion.rotations[index], motion.translation[index], motion.joints[index]
        )

    def take(self, frames: int) -> Motion:
        """Return the next frames as a motion.

        Examples:
            >>> stmc.load().stream("walk # 0 # 4", steps=1).take(30)
            Motion(30 frames at 20 fps, 1.50 s)
        """
        poses = [next(self) for _ in range(frames)]
        rotations = torch.stack([pose.rotations for pose in poses])
        translation = torch.stack([pose.translation for pose in poses])
        return Motion(rotations, translation, torch.stack([pose.joints for pose in poses]), self.fps)

    def _follow(self) -> None:
        """Follow an edit: if it changes what the frames of the block need, the block ends before the next frame."""
        end = self._ready + self._frames(LOOKAHEAD_SECONDS)
        before = self._needed_tiles(end)
        self._follow_timeline(self._live.timeline or EMPTY)
        if self._needed_tiles(end) != before:
            self._ready = self.cursor

    def _follow_timeline(self, timeline: Timeline) -> None:
        [self._timeline] = self._read([timeline])
        self._one_shot_texts = self._one_shot([self._timeline])

    def _needed_tiles(self, end: int) -> set[tuple]:
        """Return the tiles of the frames from the next one to `end`, with their crops, in frames of the stream."""
        if self.cursor >= self._ready:
            return set()
        first, layout = self._layout(end)
        crops = [(crop.text, first + crop.start, first + crop.end) for crop in layout.crops]
        return {
            (*crops[tile.crop], tile.part, first + tile.start, first + tile.end, tile.weight)
            for tile in layout.tiles
            if first + tile.start < end and first + tile.end > self.cursor
        }

    def _layout(self, end: int) -> tuple[int, Plan]:
        """Plan the crops that touch the frames from the next one to `end`; return the first frame of the plan, too."""
        run, finish = self._run, self._timeline.frames(self.fps)
        last, piece = end + run.longest + run.overlap, run.longest - run.overlap
        if last > finish:  # the pieces of the gap without end must not depend on the window
            last = finish + -(-(last - finish) // piece) * piece
        first = max(0, self.cursor - run.longest)
        return first, plan(self._timeline, self.fps, run.overlap, run.longest, self._one_shot_texts, (first, last))

    def _next_block(self) -> tuple[Span, int]:
        """Return the frames of the next window, and the end of the block: a block does not end within a transition."""
        lookahead, latest = (
            self._frames(LOOKAHEAD_SECONDS),
            self.cursor + self._frames(BLOCK_SECONDS) + self._run.overlap,
        )
        first, layout = self._layout(latest + lookahead)
        end = latest - self._run.overlap
        for start, stop in transition_spans(layout):
            if first + start < end < first + stop <= latest:
                end = first + stop
        seen = end + lookahead
        crops = [crop for crop in layout.crops if first + crop.start < seen and first + crop.end > self.cursor]
        right = self._run.overlap - self._run.overlap // 2
        last = max(seen, first + max(crop.end for crop in crops) - right)
        return (first + min(crop.start for crop in crops), last), end

    @torch.inference_mode()
    def _sample_block(self) -> tuple[_Sheet, int]:
        """Sample the next window; return the frames that are out with those of the window, and the block's end."""
        (first, last), end = self._next_block()
        run = replace(
            self._run,
            timelines=[self._timeline],
            one_shot=self._one_shot_texts,
            window=(first, last),
            observed=self._observed(first, last),
        )
        features = run.statistics.restore(self._sample(run)[0, : last - first].double().cpu())
        sheet = self._continue(features[self.cursor - first :])
        return self._clean_feet(sheet) if self._clean else sheet, end

    def _observed(self, first: int, last: int) -> Observed | None:
        """Return the frames that are out with weight 1, and the next frames of the sheet with fading weights."""
        if not self._sheet or not self.cursor:
            return None
        run, values = self._run, self._sheet.slice(first, min(last, self._sheet.end)).features
        content = torch.full((last - first + (run.fixed_length or 0), run.layout.width), torch.nan)
        content[: len(values)] = run.statistics.normalise(values).float()
        frame = torch.arange(len(content)) - (self.cursor - 1) + first
        weights = (1 - frame / (self._frames(BORDER_SECONDS) + 1)).clamp(0, 1)[:, None].expand_as(content)
        return Observed(content[None].to(run.device), weights[None].to(run.device))

    def _continue(self, features: Float[Tensor, "frames features"]) -> _Sheet:
        """Append features of the next frames to the frames that are out, at the place where those end."""
        if not self._sheet or not self.cursor:
            return _Sheet(0, features, self._representation.decode(features, self.fps, self.skeleton))
        past = self._sheet.slice(max(self._sheet.start, self.cursor - self._run.longest), self.cursor)
        place, angle = past.motion.translation[-1, :2], float(past.motion.heading[-1])
        step = torch.cat([past.features[-1:], features])
        moved = self._representation.decode(step, self.fps, self.skeleton, angle)
        by = torch.cat([place - moved.translation[0, :2], place.new_zeros(1)])
        moved = Motion(moved.rotations, moved.translation + by, moved.joints + by, self.fps)
        motion = _concatenate(past.motion, moved.trimmed(1, moved.frames))
        return _Sheet(past.start, torch.cat([past.features, features]), motion)

    def _clean_feet(self, sheet: _Sheet) -> _Sheet:
        """Keep standing feet in place, without changing frames that are out."""
        recent = sheet.slice(max(sheet.start, self.cursor - self._frames(FEET_SECONDS)), sheet.end)
        free = torch.arange(recent.start, recent.end) >= self.cursor
        clean = clean_feet(recent.motion, free=free)
        features = sheet.features.clone()
        features[-int(free.sum()) :] = self._encode(clean, recent.features)[free]
        if recent.start > sheet.start:
            clean = _concatenate(sheet.motion.trimmed(0, recent.start - sheet.start), clean)
        return _Sheet(sheet.start, features, clean)

    def _encode(self, motion: Motion, features: Tensor) -> Float[Tensor, "frames features"]:
        """Encode the poses of a motion, with the steps and turns of `features` and heights above the world's floor."""
        encoded, layout = self._representation.encode(motion), self._representation.layout
        encoded[:, layout["root_height"]] = motion.translation[:, 2:]
        for name in ("root_velocity", "yaw_velocity"):
            encoded[:, layout[name]] = features[:, layout[name]]
        return encoded

    def _frames(self, seconds: float) -> int:
        return max(1, round(seconds * self.fps))


def stream_defaults(own: Sampling) -> dict[str, Any]:
    """Return the default settings of a stream: 10 steps of DDIM, unless the model has its own number of steps.

    Args:
        own: The model's sampling settings. A model distilled to few steps is not trained for the noise levels between.
    """
    return {"steps": 10, "sampler": "ddim"} if own.steps is None else {}


def _concatenate(first: Motion, second: Motion) -> Motion:
    rotations = torch.cat([first.rotations, second.rotations])
    translation = torch.cat([first.translation, second.translation])
    return Motion(rotations, translation, torch.cat([first.joints, second.joints]), first.fps)


def _check(request: GenerateRequest, representation: Representation) -> None:
    method = request.resolved_method
    if len(request.timelines) != 1:
        raise SettingError(f"stream: {len(request.timelines)} timelines; a stream plays one")
    if request.keep or request.constraints:
        raise SettingError("stream: a stream takes no keep, change or constraints; generate motions with them")
    if method.baseline is not None or not method.stitches:
        raise SettingError(f"method={request.method}: a stream needs one that composes at every step, such as stmc")
    if not isinstance(representation, SmplRepresentation):
        name = type(representation).__name__
        raise SettingError(f"stream: {name} has no forward kinematics; use a model with SmplRepresentation")
