"""The table of characters.md: python docs/character_numbers.py CMU CHARACTER... Half a minute for each robot.

CMU is a folder with the recordings. Angles are degrees: the mean and the 95th percentile. A hand counts within half an
arm of the head. The last columns are the mean speeds of standing toes and heels in the walk and in the kick, in mm/s on
our scale.
"""

import sys
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

import stmc
from stmc.data.sources.cmu import catalogue
from stmc.formats.characters.characters import character_of_joints
from stmc.motion.body import JOINTS, PARENTS
from stmc.motion.kinematics import contact_weights
from stmc.motion.retargeting.performer import Performer
from stmc.motion.retargeting.rig import LIMBS, SIDES

LEG, ARM = LIMBS

MOTIONS = (
    ("walk: legs", LEG, "02_01", 0.0, 2.8),
    ("sit down: legs", LEG, "14_31", 4.5, 8.0),
    ("wave: arms", ARM, "14_24", 12.0, 15.5),
    ("hand on chin: arms", ARM, "14_30", 17.0, 20.5),
    ("kick: legs", LEG, "135_04", 5.0, 8.5),
)
"""Column, limb, recording of CMU, and the seconds that are measured."""
FPS = 20


def main(folder: str, paths: Sequence[str]) -> None:
    """Print a row for our own skeleton, for it at the rate of robots, and for each character."""
    motions = read_motions(Path(folder))
    ourselves = character_of_joints(JOINTS, PARENTS, stmc.Skeleton.default().rest.double().numpy())
    print("|", " | ".join(["", *(title for title, *_ in MOTIONS), "hand to head", "toes", "heels"]), "|")
    read = ((Path(path).stem, stmc.read_character(path), None) for path in paths)
    for name, character, fps in [("ours", ourselves, None), ("ours at 50 fps", ourselves, 50), *read]:
        cells, slides, error = [], [], 0.0
        for (_, limb, *_), motion in zip(MOTIONS, motions, strict=True):
            moved = stmc.retarget(motion, character, fps)
            ours = stmc.retarget(motion.resampled(moved.motion.fps), ourselves)
            degrees = angles(ours, moved, limb)
            cells.append(f"{float(degrees.mean()):.1f} ({float(degrees.quantile(0.95)):.1f})")
            slides.append(sliding(moved, ours))
            error = max(error, hand_error(ours, moved))
        feet = [", ".join(f"{ends[number]:.1f}" for ends in (slides[0], slides[-1])) for number in (0, 1)]
        print("|", " | ".join([name, *cells, f"{error:.2f}", *feet]), "|", flush=True)


def read_motions(folder: Path) -> list[stmc.Motion]:
    """Read the measured seconds of each recording, with clean feet."""
    named = {each.name: each for each in catalogue.read_sources(folder) if isinstance(each, catalogue.Source)}
    skeleton = stmc.Skeleton.default()
    whole = [stmc.clean_feet(catalogue.read(named[name], skeleton, FPS)) for _, _, name, _, _ in MOTIONS]
    return [
        motion.trimmed(round(first * FPS), round(last * FPS))
        for motion, (*_, first, last) in zip(whole, MOTIONS, strict=True)
    ]


def places(moved: stmc.CharacterMotion, joint: str) -> Float[Tensor, "frames 3"]:
    """Return the positions of a joint of ours."""
    return moved.motion.places[:, moved.motion.rig.place(joint)]


def angles(ours: stmc.CharacterMotion, moved: stmc.CharacterMotion, limb: tuple[str, ...]) -> Float[Tensor, " values"]:
    """Measure the degrees between our bones of both legs or arms and the character's, in all frames."""
    found = []
    for side in SIDES:
        for above, below in pairwise(f"{side}_{joint}" for joint in limb):
            first, second = (normalize(places(each, below) - places(each, above), dim=-1) for each in (ours, moved))
            turned = torch.atan2(torch.linalg.cross(first, second).norm(dim=-1), (first * second).sum(dim=-1))
            found.append(torch.rad2deg(turned))
    return torch.cat(found)


def hand_error(ours: stmc.CharacterMotion, moved: stmc.CharacterMotion) -> float:
    """Measure the largest error of the distance of a hand within half an arm of the head, in arm lengths."""
    errors = []
    for side in SIDES:
        first, second = (
            (places(each, f"{side}_wrist") - places(each, "head")).norm(dim=-1) / each.motion.rig.length(ARM)
            for each in (ours, moved)
        )
        errors.append((second - first).abs()[first < 0.5])
    return float(torch.cat([*errors, torch.zeros(1)]).max())


def sliding(moved: stmc.CharacterMotion, ours: stmc.CharacterMotion) -> tuple[float, float]:
    """Measure the mean speeds of toes and of heels, in mm/s on our scale, weighted by our `contact_weights`."""
    weight = contact_weights(soles(ours)[..., 2])
    speeds = 1000 * soles(moved)[..., :2].diff(dim=0).norm(dim=-1) * moved.motion.fps / moved.motion.scale
    heels, toes = ((speeds * weight).sum(dim=(0, 1)) / weight.sum(dim=(0, 1))).tolist()
    return toes, heels


def soles(moved: stmc.CharacterMotion) -> Float[Tensor, "frames 2 2 3"]:
    """Return the positions of heel and toes of both feet."""
    rig = moved.motion.rig
    joints = {joint: rig.driven.index(node) for joint, node in rig.joints.items() if node in rig.driven}
    return Performer(moved.motion.turns, moved.motion.places, rig.rest[list(rig.driven)], joints).soles()


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
