"""An artist's mannequin around any SMPL skeleton: smooth limbs that need no licensed body model.

Every piece is a loft: elliptic cross-sections along a path, rounded at both ends, that bends smoothly at joints.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from stmc.motion.body import JOINTS, BodyPart
from stmc.motion.body_model import Body, Skeleton
from stmc.motion.motion import Motion
from stmc.motion.skins.skin import PARTS, Skin

_RING_VERTICES = 20
_X, _Y, _Z = np.eye(3)
_Joints = Mapping[str, np.ndarray]
_Section = tuple[np.ndarray, float, float]
"""A cross-section: its centre, its half axis along the `wide` direction of the loft, and the other half axis (metres).
"""


def skin_of(motion: Motion, body: Body | None = None) -> Skin:
    """Return the surface of a motion: the mesh of `body`, or a mannequin around the motion's own bones."""
    if body is not None:
        return Skin.of_body(body)
    return build_mannequin(Skeleton.measured(motion.rotations, motion.joints))


def build_mannequin(skeleton: Skeleton) -> Skin:
    """Build the mannequin around a skeleton in its rest pose (arms stretched sideways)."""
    at = dict(zip(JOINTS, skeleton.rest.double().cpu().numpy(), strict=True))
    size = float(np.linalg.norm(at["left_hip"] - at["left_ankle"])) / 0.80  # thicknesses are defined for legs of 0.80 m
    pieces = [*_trunk(at, size), *_head(at, size)]
    for side in ("left", "right"):
        pieces += [*_arm(at, size, side), *_leg(at, size, side), _foot(at, size, side)]
    starts = np.cumsum([0, *(len(piece.vertices) for piece in pieces[:-1])])
    return Skin(
        vertices=np.concatenate([piece.vertices for piece in pieces]),
        faces=np.concatenate([piece.faces + start for piece, start in zip(pieces, starts, strict=True)]),
        weights=np.concatenate([piece.weights for piece in pieces]),
        parts=np.concatenate([np.full(len(piece.faces), PARTS.index(piece.part)) for piece in pieces]),
        skeleton=skeleton,
    )


@dataclass(frozen=True)
class _Piece:
    vertices: np.ndarray
    faces: np.ndarray
    weights: np.ndarray
    part: BodyPart


def _loft(
    part: BodyPart,
    sections: Sequence[_Section],
    wide: np.ndarray,
    carried: Sequence[tuple[str, float]],
    soft: float = 0.08,
    ends: tuple[float, float] = (1.0, 1.0),
) -> _Piece:
    """Build a closed surface through `sections`, rounded at both ends.

    Args:
        part: Body part of the faces.
        sections: Cross-sections in order.
        wide: Direction of the first half axis.
        carried: Joints, each with the height (0 to 1) at which it takes over from the previous joint.
        soft: Height over which two joints blend, on either side.
        ends: Length of the rounded ends relative to the mean half axis.
    """
    centres = np.array([centre for centre, *_ in sections])
    distance = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(centres, axis=0), axis=1))])
    from scipy.interpolate import PchipInterpolator  # imported late: it is slow to import

    spline = PchipInterpolator(distance, np.column_stack([centres, [half for _, *half in sections]]))
    rings = spline(np.linspace(0.0, distance[-1], max(5, round(distance[-1] / 0.022))))
    along = (centres[-1] - centres[0]) / np.linalg.norm(centres[-1] - centres[0])
    rings = np.concatenate([_cap(rings[0], -along, ends[0])[::-1], rings, _cap(rings[-1], along, ends[1])])
    angle = np.linspace(0.0, 2 * np.pi, _RING_VERTICES, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    vertices = rings[:, None, :3] + (circle * rings[:, None, 3:]) @ np.stack([wide, np.cross(along, wide)])
    height = (rings[:, :3] - centres[0]) @ along / ((centres[-1] - centres[0]) @ along)
    return _Piece(
        vertices.reshape(-1, 3),
        _tube(len(rings)),
        np.repeat(_weights(height, carried, soft), _RING_VERTICES, axis=0),
        part,
    )


def _cap(ring: np.ndarray, outwards: np.ndarray, length: float) -> np.ndarray:
    """Build the rings that close one end as half an ellipsoid, from the ring outwards."""
    angle = np.linspace(0.0, np.pi / 2, 7)[1:, None]
    centres = ring[:3] + np.sin(angle) * outwards * length * ring[3:].mean()
    return np.concatenate([centres, np.maximum(np.cos(angle), 0.01) * ring[3:]], axis=1)


def _tube(rings: int) -> np.ndarray:
    """Build triangles between successive rings of `_RING_VERTICES` vertices."""
    vertex = np.arange(_RING_VERTICES)
    neighbour = np.roll(vertex, -1)
    quad = np.concatenate(
        [
            np.stack([vertex, neighbour, neighbour + _RING_VERTICES], 1),
            np.stack([vertex, neighbour + _RING_VERTICES, vertex + _RING_VERTICES], 1),
        ]
    )
    return np.concatenate([quad + ring * _RING_VERTICES for ring in range(rings - 1)])


def _weights(height: np.ndarray, carried: Sequence[tuple[str, float]], soft: float) -> np.ndarray:
    weights = np.zeros((len(height), len(JOINTS)))
    reached = np.ones(len(height))
    for index, (joint, _) in enumerate(carried):
        following = np.zeros(len(height))
        if index + 1 < len(carried):
            step = np.clip((height - carried[index + 1][1]) / (2 * soft) + 0.5, 0.0, 1.0)
            following = step * step * (3 - 2 * step)
        weights[:, JOINTS.index(joint)] += reached - following
        reached = following
    return weights


def _trunk(at: _Joints, size: float) -> list[_Piece]:
    hips, waist, neck = (at["left_hip"] + at["right_hip"]) / 2, at["spine1"], at["neck"]
    half_hips = abs(at["left_hip"][0] - hips[0])
    shoulders = abs(at["left_shoulder"][0] - neck[0])
    low, high = hips - 0.035 * size * _Y, hips + (waist - hips) * 0.80
    pelvis = [
        (low, half_hips * 0.9 + 0.02 * size, 0.070 * size),
        (hips + (high - low) * 0.25, half_hips + 0.072 * size, 0.098 * size),
        (high, 0.118 * size, 0.088 * size),
    ]
    top = neck - at["spine1"]
    base = high + 0.012 * size * _Y
    chest = [
        (base, 0.112 * size, 0.083 * size),
        (base + top * 0.22, 0.116 * size, 0.086 * size),
        (waist + top * 0.45, shoulders * 0.62 + 0.055 * size, 0.104 * size),
        (waist + top * 0.72, shoulders * 0.66 + 0.060 * size, 0.102 * size),
        (waist + top * 0.93, shoulders * 0.55, 0.070 * size),
    ]
    spine = [("spine1", 0.0), ("spine2", 0.16), ("spine3", 0.34)]
    return [
        _loft(BodyPart.LEGS, pelvis, -_X, [("pelvis", 0.0), ("spine1", 0.95)], 0.2, (0.7, 0.25)),
        _loft(BodyPart.SPINE, chest, -_X, spine, 0.12, (0.3, 0.5)),
    ]


def _head(at: _Joints, size: float) -> list[_Piece]:
    neck, head = at["neck"], at["head"]
    throat = [
        (neck - 0.030 * size * _Y, 0.056 * size, 0.056 * size),
        (head + 0.035 * size * _Y, 0.050 * size, 0.050 * size),
    ]
    profile = ((-0.020, 0.034, 0.048, 0.034), (0.020, 0.062, 0.080, 0.024), (0.075, 0.078, 0.096, 0.014),
               (0.12, 0.081, 0.101, 0.006), (0.16, 0.066, 0.084, 0.002))  # fmt: skip
    skull = [(head + size * np.array([0.0, up, front]), wide * size, deep * size) for up, wide, deep, front in profile]
    bridge = head + size * np.array([0.0, 0.090, 0.104])
    nose = [
        (bridge, 0.008 * size, 0.010 * size),
        (bridge + size * np.array([0.0, -0.038, 0.012]), 0.014 * size, 0.017 * size),
    ]
    carried = [("head", 0.0)]
    return [
        _loft(BodyPart.HEAD, throat, -_X, [("neck", 0.0), ("head", 0.6)], 0.25),
        _loft(BodyPart.HEAD, skull, -_X, carried, ends=(0.6, 0.55)),
        _loft(BodyPart.HEAD, nose, _X, carried),
    ]


def _arm(at: _Joints, size: float, side: str) -> list[_Piece]:
    part = BodyPart(f"{side} arm")
    collar, shoulder, elbow, wrist, hand = (
        at[f"{side}_{name}"] for name in ("collar", "shoulder", "elbow", "wrist", "hand")
    )
    out = (wrist - shoulder) / np.linalg.norm(wrist - shoulder)
    bend = float(np.linalg.norm(elbow - shoulder) / np.linalg.norm(wrist - shoulder))
    profile = ((0.0, 0.054), (0.35 * bend, 0.047), (0.92 * bend, 0.037),
               (bend + 0.25 * (1 - bend), 0.039), (1.0, 0.025))  # fmt: skip
    limb = [(shoulder + (wrist - shoulder) * along, half * size, half * size) for along, half in profile]
    yoke = [(collar + (shoulder - collar) * 0.1, 0.050 * size, 0.060 * size), (shoulder, 0.050 * size, 0.052 * size)]
    palm = [
        (wrist + out * 0.004 * size, 0.024 * size, 0.020 * size),
        (wrist + (hand - wrist) * 0.8, 0.040 * size, 0.017 * size),
        (wrist + (hand - wrist) * 1.9, 0.030 * size, 0.012 * size),
    ]
    root = wrist + (hand - wrist) * 0.35 + 0.020 * size * _Z
    thumb = [(root, 0.013 * size, 0.013 * size), (root + size * (0.045 * out + 0.032 * _Z), 0.010 * size, 0.010 * size)]
    wide = _Z if side == "left" else -_Z
    return [
        _loft(part, yoke, wide, [(f"{side}_collar", 0.0), (f"{side}_shoulder", 0.95)], 0.2),
        _loft(part, limb, wide, [(f"{side}_shoulder", 0.0), (f"{side}_elbow", bend)], 0.09),
        _loft(part, palm, wide, [(f"{side}_wrist", 0.0)], ends=(1.0, 0.9)),
        _loft(part, thumb, _Y, [(f"{side}_wrist", 0.0)]),
    ]


def _leg(at: _Joints, size: float, side: str) -> list[_Piece]:
    hip, knee, ankle = (at[f"{side}_{name}"] for name in ("hip", "knee", "ankle"))
    bend = float(np.linalg.norm(knee - hip) / np.linalg.norm(ankle - hip))
    below = 1 - bend
    profile = ((0.03, 0.078), (0.35 * bend, 0.074), (0.93 * bend, 0.052), (bend + 0.10 * below, 0.050),
               (bend + 0.32 * below, 0.053), (bend + 0.8 * below, 0.035), (0.99, 0.034))  # fmt: skip
    limb = [(hip + (ankle - hip) * along, half * size, half * size) for along, half in profile]
    return [_loft(BodyPart.LEGS, limb, _X, [(f"{side}_hip", 0.0), (f"{side}_knee", bend)], 0.08)]


def _foot(at: _Joints, size: float, side: str) -> _Piece:
    ankle, ball = at[f"{side}_ankle"], at[f"{side}_foot"]
    sole = min(ball[1], ankle[1] - 0.05 * size) - 0.012 * size
    reach = ball[2] - ankle[2]
    profile = ((-0.035 * size, 0.034, 0.80), (0.0, 0.038, 1.15), (0.45 * reach, 0.040, 0.85),
               (reach, 0.045, 0.50), (reach + 0.050 * size, 0.038, 0.36))  # fmt: skip
    tall = (ankle[1] - sole) * 0.5
    sections = [
        (np.array([ankle[0], sole + tall * high * 0.92, ankle[2] + along]), wide * size, tall * high)
        for along, wide, high in profile
    ]
    ball_height = (reach + 0.035 * size) / (reach + 0.085 * size)
    carried = [(f"{side}_ankle", 0.0), (f"{side}_foot", ball_height)]
    piece = _loft(BodyPart.LEGS, sections, _X, carried, 0.12, (0.6, 0.8))
    piece.vertices[:, 1] = np.maximum(piece.vertices[:, 1], sole)
    return piece
