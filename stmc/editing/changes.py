"""What is made anew of a motion and what is kept: frames × body parts, as weights with soft borders.

Knows timelines, motions and seconds; knows no features and no sampling.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from stmc.io.bounds import MOST_SECONDS
from stmc.io.untrusted import shown
from stmc.motion.body import JOINTS, NUM_ROTATIONS, PARENTS, BodyPart
from stmc.motion.body_model import Skeleton
from stmc.motion.motion import Motion
from stmc.settings.records import SettingError, setting
from stmc.timeline import Prompt, Timeline
from stmc.timeline.planning import assign

BORDER = 0.5
"""Seconds, inside a change, in which the old fades into the new: in half of it, hands jump."""

_PRECISION = 1000
"""Frames a second at which two timelines are compared."""

_SAME_BODY = 0.005
"""Metres by which bones may differ in length before a motion is put on the model's body."""


@dataclass(frozen=True)
class Change:
    """What is made anew: from `start` to `end` seconds (None: to the end), of the body `parts` (none named: of all).

    For the first and the last `border` seconds, where something kept stands before or behind, the old fades into the
    new. Raises `SettingError` for times that are not in order, and for unknown parts.

    Examples:
        >>> sorted(stmc.Change(2, 4, ["right arm"]).parts)
        [<BodyPart.RIGHT_ARM: 'right arm'>]
    """

    start: float | int = setting(0.0, "the beginning", unit="s")
    end: float | int | None = setting(None, "the end; null: the motion's", unit="s")
    parts: Collection[str] = frozenset()
    border: float | int = setting(BORDER, "fade between the old and the new", unit="s")

    def __post_init__(self) -> None:
        times = [self.start, self.border, *([] if self.end is None else [self.end])]
        seconds = all(isinstance(each, (int, float)) and 0 <= each <= MOST_SECONDS for each in times)
        if not seconds or (self.end is not None and self.end <= self.start):
            place = f"{shown(self.start)}..{shown(self.end)} s, border {shown(self.border)} s"
            raise SettingError(f"change {place}: from 0 to {MOST_SECONDS:,} s, the end behind the start")
        if not isinstance(self.parts, Collection):
            raise SettingError(f"change: the body parts must be a list of names, not {shown(self.parts)}")
        try:
            named = (self.parts,) if isinstance(self.parts, str) else self.parts
            object.__setattr__(self, "parts", frozenset(map(BodyPart.parse, named)) or frozenset(BodyPart))
        except ValueError as error:
            raise SettingError(f"change: {error}") from None

    @classmethod
    def parse(cls, text: str) -> Change:
        """Of `start # end # part # part`, as a prompt without its text.

        Examples:
            >>> stmc.Change.parse("2 # 4 # right arm").end
            4.0
        """
        start, *rest = (word.strip() for word in text.split("#"))
        try:
            times = [float(word) for word in (start, *rest[:1])]
        except ValueError:
            raise SettingError(f"change={text!r}: start # end # body parts needed, in seconds") from None
        return cls(*times, parts=rest[1:])


def changed_prompt(timeline: Timeline, prompt: Prompt) -> tuple[Change, ...]:
    """What one prompt of a timeline decides: the times at which it owns body parts (see `assign`).

    Examples:
        >>> timeline = stmc.Timeline.parse("walk # 0 # 6 # legs\\nwave # 1 # 3 # right arm")
        >>> [(each.start, each.end) for each in stmc.changed_prompt(timeline, timeline.prompts[1])]
        [(1.0, 3.0)]
    """
    if prompt not in timeline.prompts:
        raise SettingError(f"{prompt} is not a prompt of the timeline")
    owners = assign(timeline, _PRECISION)
    return _joined(
        (start, end, part)
        for part, runs in owners.items()
        for owner, start, end in runs
        if owner is not None and timeline.prompts[owner] == prompt
    )


def changed_prompts(before: Timeline, after: Timeline) -> tuple[Change, ...]:
    """Where two timelines ask a body part for something else: another prompt, or none.

    Examples:
        >>> before = stmc.Timeline.parse("walk # 0 # 6 # legs\\nwave # 1 # 3 # right arm")
        >>> after = stmc.Timeline.parse("walk # 0 # 6 # legs\\nwave # 1 # 4 # right arm")
        >>> [(each.start, each.end, sorted(each.parts)) for each in stmc.changed_prompts(before, after)]
        [(1.0, 4.0, [<BodyPart.RIGHT_ARM: 'right arm'>])]
    """
    old, new = ({part: list(_asked(each, part)) for part in BodyPart} for each in (before, after))
    return _joined(
        (start, end, part)
        for part in BodyPart
        for (prompt, start, end) in new[part]
        if not any(prompt == was and begin <= start and end <= last for was, begin, last in old[part])
    )


def _asked(timeline: Timeline, part: BodyPart) -> list[tuple[Prompt | None, int, int]]:
    runs = assign(timeline, _PRECISION)[part]
    return [(None if owner is None else timeline.prompts[owner], start, end) for owner, start, end in runs]


def _joined(spans) -> tuple[Change, ...]:
    """One change for each span of time, of all the parts that have it."""
    parts: dict[tuple[int, int], list[BodyPart]] = {}
    for start, end, part in spans:
        parts.setdefault((start, end), []).append(part)
    return tuple(Change(start / _PRECISION, end / _PRECISION, parts[start, end]) for start, end in sorted(parts))


@dataclass(frozen=True, eq=False)
class Kept:
    """A motion, and how much of it is kept at each frame of a result and each `BodyPart`, in their order: 1 is the
    motion's own to the last digit, 0 is made anew."""

    motion: Motion
    weights: Float[Tensor, "frames 5"]

    @classmethod
    def but(cls, changes: Sequence[Change], motion: Motion, frames: int) -> Kept:
        """All of `motion` but the `changes`, and what a result of so many `frames` has behind its end."""
        known = min(frames, motion.frames)
        new = torch.zeros(frames, len(BodyPart), dtype=torch.bool)
        border = torch.zeros(frames, len(BodyPart))
        for change in changes:
            span = slice(int(change.start * motion.fps), None if change.end is None else int(change.end * motion.fps))
            for column, part in enumerate(BodyPart):
                if part in change.parts:
                    new[span, column] = True
                    border[span, column] = change.border * motion.fps
        new[known:], border[known:] = True, BORDER * motion.fps
        return cls(motion, torch.stack([_faded(*columns) for columns in zip(new.T, border.T, strict=True)], dim=1))


def _faded(new: Bool[Tensor, " frames"], border: Float[Tensor, " frames"]) -> Float[Tensor, " frames"]:
    """1 where nothing is new, and within new runs as far as their `border` reaches, a quarter of each at most."""
    weights = (~new).float()
    edges = torch.nn.functional.pad(new.int(), (1, 1)).diff()
    starts, ends = ((edges == sign).nonzero()[:, 0].tolist() for sign in (1, -1))
    for start, end in zip(starts, ends, strict=True):
        frame = torch.arange(end - start, dtype=torch.float32)
        near = torch.full_like(frame, math.inf)
        near = near.minimum(frame + 1) if start > 0 else near
        near = near.minimum(frame.flip(0) + 1) if end < len(new) else near
        reach = border[start:end].clamp(max=(end - start) / 4)
        weights[start:end] = (1 - near / (reach + 1)).clamp(min=0)
    return weights


def on_body(motion: Motion, skeleton: Skeleton, fps: float | int) -> Motion:
    """The motion at a frame rate and on a body: as it is where bones are as long as `skeleton`'s; else with the same
    rotations, and the pelvis' path scaled about the floor by how long the legs are.

    Raises `SettingError` for a body that is no person's: legs of less than half, or more than twice, the length.
    """
    motion = motion.to("cpu", torch.float64)
    own = Skeleton.measured(motion.rotations, motion.joints, skeleton.offsets[0])
    moved = motion.resampled(fps)
    lengths, wanted = (each.offsets[1:NUM_ROTATIONS].double().norm(dim=-1) for each in (own, skeleton))
    if float((lengths - wanted).abs().max()) <= _SAME_BODY:
        return moved if moved is motion else Motion.posed(moved.rotations, moved.translation, fps, own)
    scale = _leg(skeleton) / max(_leg(own), 1e-6)
    if not 0.5 < scale < 2:
        raise SettingError(f"keep: a body with legs of {_leg(own):.2f} m; the model's are {_leg(skeleton):.2f} m")
    posed = Motion.posed(moved.rotations, moved.translation * scale, fps, skeleton)
    down = posed.joints[..., 2].min() - moved.joints[..., 2].min()
    lower = posed.translation - posed.translation.new_tensor([0.0, 0.0, 1.0]) * down
    return Motion.posed(posed.rotations, lower, fps, skeleton)


def _leg(skeleton: Skeleton) -> float:
    """Metres of thigh and shin."""
    bones = [JOINTS.index(f"left_{joint}") for joint in ("knee", "ankle")]
    assert [PARENTS[bone] for bone in bones] == [JOINTS.index("left_hip"), bones[0]]
    return float(skeleton.offsets[bones].double().norm(dim=-1).sum())
