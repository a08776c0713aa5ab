"""The Bandai Namco Research motion dataset: its files, its skeleton, and retargeting to SMPL's.

Depends on the location of the clips (the published archive or the unpacked folder), their names, and the constant
rotation between each of their joints and SMPL's. Source: Kobayashi et al. 2023, arXiv 2306.08861, CC BY-NC 4.0.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from einops import einsum
from jaxtyping import Float
from torch import Tensor

from stmc.data.cache import Cache, Clip, assemble
from stmc.data.preparation import in_parallel
from stmc.data.sources.archives import read_texts
from stmc.data.sources.contents import CONTENTS, STYLES, describe, mirror_content
from stmc.data.sources.segments import Segment, read_segments
from stmc.formats.bvh_parser import Bvh, BvhError, parse_bvh
from stmc.io.untrusted import UnreadableError, quote
from stmc.motion.body import JOINTS, NUM_ROTATIONS, PARENTS
from stmc.motion.body_model import Skeleton
from stmc.motion.motion import Motion
from stmc.motion.representation.smpl import SmplRepresentation

SOURCE_JOINTS: dict[str, str] = {
    "pelvis": "Hips", "spine1": "Spine", "spine3": "Chest", "neck": "Neck", "head": "Head",
    "left_collar": "Shoulder_L", "left_shoulder": "UpperArm_L", "left_elbow": "LowerArm_L", "left_wrist": "Hand_L",
    "right_collar": "Shoulder_R", "right_shoulder": "UpperArm_R", "right_elbow": "LowerArm_R", "right_wrist": "Hand_R",
    "left_hip": "UpperLeg_L", "left_knee": "LowerLeg_L", "left_ankle": "Foot_L", "left_foot": "Toes_L",
    "right_hip": "UpperLeg_R", "right_knee": "LowerLeg_R", "right_ankle": "Foot_R", "right_foot": "Toes_R",
}  # fmt: skip
"""SMPL's joint → the dataset's. SMPL's spine2 lies between Spine and Chest and moves with spine1; hands follow wrists.
"""

CLIPS = 3076
"""Number of clips in the published archive."""
FARTHEST = 1e4
"""Distance in metres from the origin, and speed in m/s, that no person reaches in a clip; float32 then resolves a
millimetre."""

_FEET = [JOINTS.index(f"{side}_{name}") for side in ("left", "right") for name in ("ankle", "foot")]

UNLABELLED = ""
"""Key of clips without sentences, which serve training without a name."""

MISNAMED = frozenset(
    f"dataset-2_walk-turn-{number}"
    for number in (
        *("left_masculine_006", "left_masculine_007", "left_normal_031", "left_normal_032", "left_normal_033"),
        *("right_masculine_006", "right_masculine_007"),
        *("right_normal_004", "right_normal_032", "right_normal_033"),
    )
)
"""Turns to the other side than their names say, or twice as far as all others (184 to 222 degrees)."""

FOOT_SLOPE, TOES_SLOPE = math.radians(39.6), math.radians(23.0)
"""Angles by which the bones of the foot and the toes point below the horizontal on a flat foot: medians over all frames
in which neither ankle nor toes move."""


def _pitch_rotation(slope: float) -> tuple[tuple[float, float, float], ...]:
    return (0.0, -math.sin(slope), math.cos(slope)), (1.0, 0.0, 0.0)


LEFT, UP, FORWARD = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
RIGHT, DOWN = (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)
T_POSE: dict[str, tuple[tuple[float, float, float], ...]] = {
    "Hips": (UP, RIGHT), "Spine": (UP, FORWARD), "Chest": (UP, FORWARD), "Neck": (UP, FORWARD), "Head": (UP, FORWARD),
    "Shoulder": (LEFT, UP), "UpperArm": (LEFT, UP), "LowerArm": (LEFT, UP), "Hand": (LEFT, UP),
    "UpperLeg": (DOWN, LEFT), "LowerLeg": (DOWN, LEFT),
    "Foot": _pitch_rotation(FOOT_SLOPE), "Toes": _pitch_rotation(TOES_SLOPE),
}  # fmt: skip
"""Directions of the local x and y axes of each joint in SMPL's rest pose: midline and left, whose bones run along +x.
Bones of the right side run along -x."""


@dataclass(frozen=True)
class ClipName:
    """The parts of a file name such as `dataset-2_raise-up-right-hand_active_001.bvh`."""

    name: str
    content: str
    style: str

    @classmethod
    def parse(cls, name: str) -> ClipName:
        """Parse a name. Raises `ValueError` if it is not the dataset's, or its action or style is unknown."""
        match = re.fullmatch(r"(dataset-[12]_([a-z-]+)_([a-z-]+)_\d+)", name)
        if not match:
            raise ValueError(f"{quote(name)} is not dataset-N_content_style_NNN")
        if match[2] not in CONTENTS:
            raise ValueError(f"unknown action {quote(match[2])}; choose from {', '.join(CONTENTS)}")
        if match[3] not in STYLES:
            raise ValueError(f"unknown style {quote(match[3])}; choose from {', '.join(STYLES)}")
        return cls(*match.groups())


def read_sources(source: Path) -> Iterator[tuple[str, str | UnreadableError]]:
    """Yield every clip's name and BVH text, or the reason why it cannot be read.

    Raises as `read_texts`, and `ValueError` if a folder or an archive has no BVH files.
    """
    name = None
    for path, text in read_texts(Path(source), (".bvh",)):
        name = path.stem
        yield name, text
    if name is None:
        raise ValueError(f"{source} holds no .bvh file; it should be the dataset's .tar.xz or its unpacked folder")


def rest_rotations(names: Iterable[str]) -> Float[Tensor, "joints 3 3"]:
    """Return the world rotation of each joint's frame in SMPL's rest pose: the constants of the retargeting."""
    rotations = []
    for name in names:
        x, y = (torch.tensor(axis, dtype=torch.float64) for axis in T_POSE[name.removesuffix("_L").removesuffix("_R")])
        if name.endswith("_R"):  # the axes of the right side are the reversed mirror images of the left side's
            mirror = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
            x, y = mirror * x, mirror * y
        rotations.append(torch.stack([x, y, torch.linalg.cross(x, y)], dim=-1))
    return torch.stack(rotations)


def retarget(bvh: Bvh, skeleton: Skeleton) -> Motion:
    """Retarget a clip to SMPL's joints at its own frame rate: metres, z up, the lowest foot at height zero.

    Each SMPL joint has the rotation of the dataset's joint, corrected by that joint's constant rotation in the rest
    pose; at the dataset's own proportions, forward kinematics reproduces the clip's joint positions. Raises `BvhError`
    if a joint is missing.
    """
    missing = sorted(set(SOURCE_JOINTS.values()) - set(bvh.names))
    if missing:
        raise BvhError(f"joints {', '.join(missing)} are missing; this is not a clip of the dataset")
    rotations, positions = bvh.world()
    index = [bvh.names.index(SOURCE_JOINTS.get(joint, "Spine")) for joint in JOINTS[:NUM_ROTATIONS]]
    rest = rest_rotations([bvh.names[joint] for joint in index])
    up = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]], dtype=torch.float64)  # y up → z up
    world = einsum(up, rotations[:, index], rest, "a b, frames joints b c, joints d c -> frames joints a d")
    local = torch.stack([
        world[:, joint] if parent < 0 else world[:, parent].mT @ world[:, joint]
        for joint, parent in enumerate(PARENTS[:NUM_ROTATIONS])
    ], dim=1)  # fmt: skip
    centimetre = 0.01
    pelvis = einsum(up, positions[:, bvh.names.index("Hips")] * centimetre, "a b, frames b -> frames a")
    motion = Motion.posed(local, pelvis, bvh.fps, skeleton)
    floor = motion.joints[:, _FEET, 2].min()  # not of all joints: a hand that touches the floor would lift the feet
    return Motion.posed(local, pelvis - torch.tensor([0.0, 0.0, floor]), bvh.fps, skeleton)


def split(clips: Iterable[ClipName]) -> dict[str, str]:
    """Assign clip names to "train", "val" or "test", 80 : 10 : 10 within every action, spread over its styles.

    A pure function of the set of names. Actions with fewer than ten clips are for training only.
    """
    contents: dict[str, list[ClipName]] = {}
    for clip in clips:
        contents.setdefault(clip.content, []).append(clip)
    result = {}
    for members in contents.values():
        members.sort(key=lambda clip: (clip.style, hashlib.sha256(clip.name.encode()).hexdigest()))
        for position, clip in enumerate(members):
            result[clip.name] = {4: "val", 9: "test"}.get(position % 10, "train") if len(members) >= 10 else "train"
    return result


def convert(name: str, text: str, fps: float | int) -> list[tuple[Clip, Float[Tensor, "frames features"]]]:
    """Convert one file to the rows of a cache: the clip and its mirror image, as 205 features on the default skeleton.

    The split is not set yet. Raises `ValueError` (including `BvhError`) if the file is invalid.

    Args:
        name: Name of the clip.
        text: Its BVH text.
        fps: Frame rate of the features.
    """
    label = ClipName.parse(name)
    skeleton, representation = Skeleton.default(), SmplRepresentation()
    motion = retarget(parse_bvh(text), skeleton).resampled(fps)
    rows = []
    for mirrored, version in ((False, motion), (True, motion.mirrored())):
        content = mirror_content(label.content) if mirrored else label.content
        posed = Motion.posed(version.rotations, version.translation, fps, skeleton)
        cuts = read_segments("bandai").get(name, ())
        unlabelled = name in MISNAMED or content in {cut.content for cut in cuts}  # one of several actions
        clip = Clip(
            name=f"M/{name}" if mirrored else name,
            content=content,
            style=label.style,
            texts=UNLABELLED if unlabelled else f"{content}/{label.style}",
            parts=tuple(sorted(CONTENTS[content].parts)),
            cyclic=CONTENTS[content].cyclic,
            mirrored=mirrored,
            split="",
            start=0,
            end=posed.frames,
        )
        features = representation.encode(posed).float()
        if not (features.abs() < FARTHEST).all():
            raise BvhError(f"its features are not all finite and below {FARTHEST:g} (metres, metres per second)")
        rows.append((clip, features))
        rows += [_cut(clip, features, number, cut, fps) for number, cut in enumerate(cuts)]
    return rows


def _cut(
    clip: Clip, features: Float[Tensor, "frames features"], number: int, segment: Segment, fps: float | int
) -> tuple[Clip, Float[Tensor, "_ features"]]:
    """Cut the part of a clip that a segment names: one action of several, or its actor standing still."""
    content = mirror_content(segment.content) if clip.mirrored else segment.content
    part = dataclasses.replace(
        clip,
        name=f"{clip.name}/{number}",
        content=content,
        style="normal",
        texts=f"{content}/normal",
        parts=tuple(sorted(CONTENTS[content].parts)),
        cyclic=CONTENTS[content].cyclic,
    )
    return part, features[round(segment.start * fps) : round(segment.end * fps)]


def read_clips(source: Path, fps: float | int, workers: int) -> Iterator[tuple[str, list | str]]:
    """Convert every clip in parallel: yield its name, and its rows or the reason for its omission.

    Args:
        source: Archive or folder of the dataset.
        fps: Frame rate of the features.
        workers: Number of processes.
    """
    return in_parallel(((name, (_convert_text, name, text, fps)) for name, text in read_sources(source)), workers)


def _convert_text(name: str, text: str | UnreadableError, fps: float | int) -> list[tuple[Clip, Tensor]]:
    if isinstance(text, UnreadableError):
        raise text
    return convert(name, text, fps)


def gather(clips: Iterable[tuple[str, list | str]], fps: float | int) -> Cache:
    """Build the cache of all converted clips, in the order of their names, without a fingerprint.

    Raises `ValueError` if all were skipped.
    """
    converted, skipped = {}, []
    for name, rows in clips:
        if isinstance(rows, str):
            skipped.append((name, rows))
        elif name in converted:
            skipped.append((name, "a second clip of this name"))
        else:
            converted[name] = rows
    if not converted:
        raise ValueError(f"no clip could be read; the first: {skipped[0][0]}: {skipped[0][1]}")
    splits = split(ClipName.parse(name) for name in converted)
    rows = [
        (dataclasses.replace(clip, split=splits[name]), features)
        for name in sorted(converted)
        for clip, features in converted[name]
    ]
    table, features = assemble(rows)
    labels = sorted({(clip.texts, clip.content, clip.style) for clip in table if clip.texts != UNLABELLED})
    return Cache(
        fps=fps,
        representation="smpl",
        features=features,
        clips=table,
        texts={UNLABELLED: ()} | {key: describe(content, style) for key, content, style in labels},
        skipped=tuple(skipped),
    )
