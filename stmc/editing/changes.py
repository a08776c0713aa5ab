"""The regenerated and the kept parts of a motion: weights over frames × body parts, with soft borders."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from stmc.io.bounds import MOST_SECONDS
from stmc.io.untrusted import quote
from stmc.motion.body import JOINTS, NUM_ROTATIONS, PARENTS, BodyPart
from stmc.motion.body_model import Skeleton
from stmc.motion.motion import Motion
from stmc.settings.records import SettingError, setting
from stmc.timeline import Prompt, Timeline
from stmc.timeline.planning import assign

BORDER = 0.5
"""Seconds inside a change over which the old motion fades into the new one; with half of it, hands jump."""
_PRECISION = 1000
"""Frames per second at which two timelines are compared."""
_SAME_BODY = 0.005
"""Metres by which bone lengths may differ before a motion is moved to the model's body."""


@dataclass(frozen=True)
class Change:
    """An interval to regenerate, from `start` to `end` seconds (None: to the end), for some body `parts` (empty: all).

    Next to kept frames, the old motion fades into the new one over the first and the last `border` seconds. Raises
    `SettingError` for times out of order and for unknown parts.

    Examples:
        >>> sorted(stmc.Change(2, 4, ["right arm"]).parts)
        [<BodyPart.RIGHT_ARM: 'right arm'>]
    """

    start: float | int = setting(0.0, "start of the interval", unit="s")
    end: float | int | None = setting(None, "end of the interval; null: the end of the motion", unit="s")
    parts: Collection[str] = frozenset()
    border: float | int = setting(BORDER, "fade between the old motion and the new one", unit="s")

    def __post_init__(self) -> None:
        times = [self.start, self.border, *([] if self.end is None else [self.end])]
        valid = all(isinstance(time, (int, float)) and 0 <= time <= MOST_SECONDS for time in times)
        if not valid or (self.end is not None and self.end <= self.start):
            interval = f"{quote(self.start)}..{quote(self.end)} s, border {quote(self.border)} s"
            raise SettingError(f"change {interval}: must be from 0 to {MOST_SECONDS:,} s, the end after the start")
        if not isinstance(self.parts, Collection):
            raise SettingError(f"change: the body parts must be a list of names, not {quote(self.parts)}")
        try:
            names = (self.parts,) if isinstance(self.parts, str) else self.parts
            object.__setattr__(self, "parts", frozenset(map(BodyPart.parse, names)) or frozenset(BodyPart))
        except ValueError as error:
            raise SettingError(f"change: {error}") from None

    @classmethod
    def parse(cls, text: str) -> Change:
        """Parse `start # end # part # part`, a prompt without its text.

        Examples:
            >>> stmc.Change.parse("2 # 4 # right arm").end
            4.0
        """
        start, *rest = (word.strip() for word in text.split("#"))
        try:
            first, last = float(start), float(rest[0]) if rest else None
        except ValueError:
            raise SettingError(f"change={text!r}: must be start # end # body parts, in seconds") from None
        return cls(first, last, rest[1:])


def changed_prompt(timeline: Timeline, prompt: Prompt) -> tuple[Change, ...]:
    """Return the intervals in which a prompt of a timeline owns body parts (see `assign`).

    Examples:
        >>> timeline = stmc.Timeline.parse("walk # 0 # 6 # legs\\nwave # 1 # 3 # right arm")
        >>> [(change.start, change.end) for change in stmc.changed_prompt(timeline, timeline.prompts[1])]
        [(1.0, 3.0)]
    """
    if prompt not in timeline.prompts:
        raise SettingError(f"{prompt} is not a prompt of the timeline")
    owners = assign(timeline, _PRECISION)
    return _changes(
        (start, end, part)
        for part, runs in owners.items()
        for owner, start, end in runs
        if owner is not None and timeline.prompts[owner] == prompt
    )


def changed_prompts(before: Timeline, after: Timeline) -> tuple[Change, ...]:
    """Return the intervals in which two timelines differ: a body part has another prompt, or none.

    Examples:
        >>> before = stmc.Timeline.parse("walk # 0 # 6 # legs\\nwave # 1 # 3 # right arm")
        >>> after = stmc.Timeline.parse("walk # 0 # 6 # legs\\nwave # 1 # 4 # right arm")
        >>> [(change.start, change.end, sorted(change.parts)) for change in stmc.changed_prompts(before, after)]
        [(1.0, 4.0, [<BodyPart.RIGHT_ARM: 'right arm'>])]
    """
    old, new = ({part: list(_prompt_runs(timeline, part)) for part in BodyPart} for timeline in (before, after))
    return _changes(
        (first, last, part)
        for part in BodyPart
        for prompt, start, end in new[part]
        for first, last in _without((start, end), [(begin, stop) for was, begin, stop in old[part] if was == prompt])
    )


def _without(span: tuple[int, int], others: Sequence[tuple[int, int]]) -> Iterator[tuple[int, int]]:
    """Yield the parts of a span outside of others, which are in order and do not overlap."""
    start, end = span
    for first, last in others:
        if start < min(first, end):
            yield start, min(first, end)
        start = max(start, last)
    if start < end:
        yield start, end


def _prompt_runs(timeline: Timeline, part: BodyPart) -> list[tuple[Prompt | None, int, int]]:
    runs = assign(timeline, _PRECISION)[part]
    return [(None if owner is None else timeline.prompts[owner], start, end) for owner, start, end in runs]


def _changes(spans) -> tuple[Change, ...]:
    """Make one change of all body parts with the same start and end."""
    parts: dict[tuple[int, int], list[BodyPart]] = {}
    for start, end, part in spans:
        parts.setdefault((start, end), []).append(part)
    return tuple(Change(start / _PRECISION, end / _PRECISION, parts[start, end]) for start, end in sorted(parts))


@dataclass(frozen=True, eq=False)
class Kept:
    """A motion and the weight with which a result keeps it, at each frame and `BodyPart`, in their order.

    A weight of 1 keeps the motion exactly; 0 regenerates it.
    """

    motion: Motion
    weights: Float[Tensor, "frames 5"]

    @classmethod
    def all_but(cls, changes: Sequence[Change], motion: Motion, frames: int) -> Kept:
        """Keep all of a motion except some intervals, and except the frames after its end.

        Args:
            changes: Intervals to regenerate.
            motion: Motion to keep.
            frames: Number of frames of the result.
        """
        kept = min(frames, motion.frames)
        new = torch.zeros(frames, len(BodyPart), dtype=torch.bool)
        border = torch.zeros(frames, len(BodyPart))
        for change in changes:
            span = slice(int(change.start * motion.fps), None if change.end is None else int(change.end * motion.fps))
            for column, part in enumerate(BodyPart):
                if part in change.parts:
                    new[span, column] = True
                    border[span, column] = change.border * motion.fps
        new[kept:], border[kept:] = True, BORDER * motion.fps
        return cls(motion, torch.stack([_fade(*columns) for columns in zip(new.T, border.T, strict=True)], dim=1))


def _fade(new: Bool[Tensor, " frames"], border: Float[Tensor, " frames"]) -> Float[Tensor, " frames"]:
    """Compute weights: 1 in kept frames, falling to 0 within the `border` of new runs, a quarter of a run at most."""
    weights = (~new).float()
    edges = torch.nn.functional.pad(new.int(), (1, 1)).diff()
    starts, ends = ((edges == sign).nonzero()[:, 0].tolist() for sign in (1, -1))
    for start, end in zip(starts, ends, strict=True):
        frame = torch.arange(end - start, dtype=torch.float32)
        near = torch.full_like(frame, math.inf)
        near = near.minimum(frame + 1) if start > 0 else near
        near = near.minimum(frame.flip(0) + 1) if end < len(new) else near
        length = border[start:end].clamp(max=(end - start) / 4)
        weights[start:end] = (1 - near / (length + 1)).clamp(min=0)
    return weights


def move_to_body(motion: Motion, skeleton: Skeleton, fps: float | int) -> Motion:
    """Resample a motion and move it to a body.

    If the bone lengths are those of `skeleton`, the motion stays as it is. Otherwise its rotations stay, and the path
    of the pelvis is scaled about the floor by the ratio of the leg lengths.

    Args:
        motion: Motion on any body.
        skeleton: Body of the result.
        fps: Frame rate of the result.

    Raises:
        SettingError: If the legs are shorter than half the length of those of `skeleton`, or longer than twice.
    """
    motion = motion.to("cpu", torch.float64)
    source = Skeleton.measured(motion.rotations, motion.joints, skeleton.offsets[0])
    moved = motion.resampled(fps)
    lengths, target = (body.offsets[1:NUM_ROTATIONS].double().norm(dim=-1) for body in (source, skeleton))
    if float((lengths - target).abs().max()) <= _SAME_BODY:
        return moved if moved is motion else Motion.posed(moved.rotations, moved.translation, fps, source)
    scale = _leg_length(skeleton) / max(_leg_length(source), 1e-6)
    if not 0.5 < scale < 2:
        lengths = f"its legs are {_leg_length(source):.2f} m long, the model's {_leg_length(skeleton):.2f} m"
        raise SettingError(f"keep: {lengths}; the ratio must be between 0.5 and 2")
    posed = Motion.posed(moved.rotations, moved.translation * scale, fps, skeleton)
    down = posed.joints[..., 2].min() - moved.joints[..., 2].min()
    lower = posed.translation - posed.translation.new_tensor([0.0, 0.0, 1.0]) * down
    return Motion.posed(posed.rotations, lower, fps, skeleton)


def _leg_length(skeleton: Skeleton) -> float:
    """Sum the lengths of thigh and shin, in metres."""
    bones = [JOINTS.index(f"left_{joint}") for joint in ("knee", "ankle")]
    assert [PARENTS[bone] for bone in bones] == [JOINTS.index("left_hip"), bones[0]]
    return float(skeleton.offsets[bones].double().norm(dim=-1).sum())
