"""Sampling, features and measures as the papers' formulas say, number by number: an oracle that is slow.

In float64, with numpy and math alone. Knows one sample at a time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
from scipy.linalg import sqrtm
from scipy.ndimage import gaussian_filter1d

Answer = Callable[[np.ndarray, int], np.ndarray]
"""(x_t, t) → the clean sample that is predicted."""

CHAINS = ((0, 2, 5, 8, 11), (0, 1, 4, 7, 10), (0, 3, 6, 9, 12, 15), (9, 14, 17, 19, 21), (9, 13, 16, 18, 20))
"""Of HumanML3D: right leg, left leg, spine, right arm, left arm."""
PARENT = {child: parent for chain in CHAINS for parent, child in pairwise(chain)}


# Samplers: clean samples of every step, from the noisiest on ----------------------------------------------------------


def ancestral(
    answer: Answer,
    left: Sequence[float],
    times: Sequence[int],
    x: np.ndarray,
    noises: Sequence,
    published: bool = False,
) -> list[np.ndarray]:
    """Ho et al. 2020, Eq. 6 and 7, over the steps `times` of a schedule of which `left` is alpha bar; `published`: the
    noise times the variance, as STMC's code has it, not its root."""
    found = []
    for i in reversed(range(len(times))):
        now, before = left[times[i]], left[times[i - 1]] if i else 1.0
        alpha, beta = now / before, 1 - now / before
        clean = answer(x, times[i])
        found.append(clean)
        mean = math.sqrt(before) * beta / (1 - now) * clean + math.sqrt(alpha) * (1 - before) / (1 - now) * x
        variance = (1 - before) / (1 - now) * beta
        x = mean + (variance if published else math.sqrt(variance)) * noises[len(found) - 1]
    return found


def implicit(
    answer: Answer, left: Sequence[float], times: Sequence[int], x: np.ndarray, noises: Sequence, eta: float
) -> list[np.ndarray]:
    """DDIM (Song et al. 2021), Eq. 12, with its sigma of Eq. 16."""
    found = []
    for i in reversed(range(len(times))):
        now, before = left[times[i]], left[times[i - 1]] if i else 1.0
        clean = answer(x, times[i])
        found.append(clean)
        eps = (x - math.sqrt(now) * clean) / math.sqrt(1 - now)
        sigma = eta * math.sqrt((1 - before) / (1 - now)) * math.sqrt(1 - now / before)
        x = math.sqrt(before) * clean + math.sqrt(1 - before - sigma**2) * eps + sigma * noises[len(found) - 1]
    return found


def second_order(answer: Answer, left: Sequence[float], times: Sequence[int], x: np.ndarray) -> list[np.ndarray]:
    """DPM-Solver++(2M) (Lu et al. 2022), algorithm 2: h is a step of the half log signal-to-noise ratio."""
    alphas, sigmas = ([math.sqrt(share) for share in each] for each in (left, [1 - share for share in left]))
    found: list[np.ndarray] = []
    lengths: list[float] = []
    for i in reversed(range(len(times))):
        found.append(answer(x, times[i]))
        if i == 0:
            return found
        s, t = times[i], times[i - 1]
        lengths.append(math.log(alphas[t] / sigmas[t]) - math.log(alphas[s] / sigmas[s]))
        slope = found[-1]
        if len(lengths) > 1:
            r = lengths[-2] / lengths[-1]
            slope = (1 + 1 / (2 * r)) * found[-1] - 1 / (2 * r) * found[-2]
        x = sigmas[t] / sigmas[s] * x - alphas[t] * (math.exp(-lengths[-1]) - 1) * slope
    raise AssertionError


# The 205 features of MDM-SMPL -----------------------------------------------------------------------------------------


def about_z(angle: float) -> np.ndarray:
    return np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])


def yaw(matrix: np.ndarray) -> float:
    return math.atan2(matrix[1, 0], matrix[0, 0])


def wrapped(angle: float) -> float:
    return math.remainder(angle, 2 * math.pi)


def smpl_features(rotations: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """STMC, appendix D, frame by frame, from rotations [frames, 22, 3, 3] and joints [frames, 24, 3], z up."""
    frames, floor = len(joints), joints[:, :, 2].min()
    yaws = [yaw(each[0]) for each in rotations]
    steps = [joints[i + 1, 0] - joints[i, 0] for i in range(frames - 1)]
    turns = [wrapped(yaws[i + 1] - yaws[i]) for i in range(frames - 1)]
    steps.append(2 * steps[-1] - steps[-2])
    turns.append(wrapped(2 * turns[-1] - turns[-2]))
    rows = []
    for i in range(frames):
        back = about_z(-yaws[i])
        row = [joints[i, 0, 2] - floor, *(back @ steps[i])[:2], turns[i]]
        for joint, rotation in enumerate(rotations[i]):
            row += list((back @ rotation if joint == 0 else rotation)[:2].flatten())
        for place in joints[i, 1:]:
            row += list(back @ (place - joints[i, 0]))
        rows.append(row)
    return np.array(rows)


def smpl_motion(features: np.ndarray, first: float) -> tuple[np.ndarray, np.ndarray]:
    """The way back, from the heading `first`: rotations and joints. Rows of rotations need not be orthonormal."""
    angle, x, y = first, 0.0, 0.0
    rotations, joints = [], []
    for row in features:
        turn = about_z(angle)
        local = [gram_schmidt(row[4 + 6 * joint : 10 + 6 * joint]) for joint in range(22)]
        rotations.append([about_z(angle - yaw(local[0])) @ local[0], *local[1:]])
        pelvis = np.array([x, y, row[0]])
        joints.append([pelvis, *(pelvis + turn @ row[136 + 3 * joint : 139 + 3 * joint] for joint in range(23))])
        step = turn @ np.array([row[1], row[2], 0])
        angle, x, y = angle + row[3], x + step[0], y + step[1]
    return np.array(rotations), np.array(joints)


def gram_schmidt(six: np.ndarray) -> np.ndarray:
    """Zhou et al. 2019, on two rows."""
    first = six[:3] / np.linalg.norm(six[:3])
    second = six[3:] - (first @ six[3:]) * first
    second = second / np.linalg.norm(second)
    return np.stack([first, second, np.cross(first, second)])


# The 263 features of HumanML3D: its code works with quaternions, real part first --------------------------------------

RAW = np.zeros((22, 3))
RAW[[1, 13]], RAW[[2, 14]] = (1, 0, 0), (-1, 0, 0)
RAW[[3, 6, 9, 12]], RAW[[10, 11, 15]] = (0, 1, 0), (0, 0, 1)
RAW[[4, 5, 7, 8, 16, 17, 18, 19, 20, 21]] = (0, -1, 0)
"""Along which axis the rotation of each bone starts."""


def times(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Hamilton's product."""
    return np.array([p[0] * q[0] - p[1:] @ q[1:], *(p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:]))])


def inverse(q: np.ndarray) -> np.ndarray:
    return q * np.array([1, -1, -1, -1])


def turn(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    return times(times(q, np.array([0, *v])), inverse(q))[1:]


def between(v: np.ndarray, w: np.ndarray) -> np.ndarray:
    """The shortest arc from v to w."""
    q = np.array([np.linalg.norm(v) * np.linalg.norm(w) + v @ w, *np.cross(v, w)])
    return q / np.linalg.norm(q)


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v)


AHEAD, UP = np.array([0.0, 0, 1]), np.array([0.0, 1, 0])


def humanml3d_features(joints: np.ndarray, lengths: Sequence[float]) -> np.ndarray:
    """Guo et al. 2022, frame by frame, from joints [frames, 22, 3] with y up and the lengths of the uniform bones."""
    whole = canonical(uniform(joints, lengths))
    hips, shoulders = whole[:, 2] - whole[:, 1], whole[:, 17] - whole[:, 16]
    # The published indexes of the hips are mixed up, so that they count from the other side.
    ahead = np.stack([np.cross(UP, unit(s - h)) for h, s in zip(hips, shoulders, strict=True)])
    smooth = gaussian_filter1d(ahead, 20, axis=0, mode="nearest")
    roots = [between(unit(each), AHEAD) for each in smooth]
    roots[0] = np.array([1.0, 0, 0, 0])
    rows = []
    for i in range(len(whole) - 1):
        root, following = roots[i], roots[i + 1]
        under = whole[i, 0] * [1, 0, 1]
        velocity = turn(following, whole[i + 1, 0] - whole[i, 0])
        row = [math.asin(times(following, inverse(root))[2]), velocity[0], velocity[2], whole[i, 0, 1]]
        for joint in range(1, 22):
            row += list(turn(root, whole[i, joint] - under))
        for matrix in bone_rotations(whole[i], root):
            row += [*matrix[:, 0], *matrix[:, 1]]
        for joint in range(22):
            row += list(turn(root, whole[i + 1, joint] - whole[i, joint]))
        for joint in (7, 10, 8, 11):
            row.append(float(((whole[i + 1, joint] - whole[i, joint]) ** 2).sum() < 0.002))
        rows.append(row)
    return np.array(rows)


def uniform(joints: np.ndarray, lengths: Sequence[float]) -> np.ndarray:
    """All bones with the uniform lengths; the path scaled by the right leg of the first frame."""
    leg = sum(np.linalg.norm(joints[0, child] - joints[0, PARENT[child]]) for child in (5, 8))
    found = np.zeros_like(joints)
    for i, frame in enumerate(joints):
        found[i, 0] = frame[0] * (lengths[5] + lengths[8]) / leg
        for chain in CHAINS:
            for child in chain[1:]:
                found[i, child] = found[i, PARENT[child]] + lengths[child] * unit(frame[child] - frame[PARENT[child]])
    return found


def canonical(joints: np.ndarray) -> np.ndarray:
    """On the floor, from the origin, facing z at first."""
    joints = joints - [joints[0, 0, 0], joints[:, :, 1].min(), joints[0, 0, 2]]
    across = joints[0, 2] - joints[0, 1] + joints[0, 17] - joints[0, 16]
    first = between(unit(np.cross(UP, unit(across))), AHEAD)
    return np.array([[turn(first, joint) for joint in frame] for frame in joints])


def bone_rotations(frame: np.ndarray, root: np.ndarray) -> list[np.ndarray]:
    """Of joints 1 to 21: every chain starts again from the root's rotation, the arms' too."""
    found = {}
    for chain in CHAINS:
        before = root
        for child in chain[1:]:
            arc = between(RAW[child], unit(frame[child] - frame[PARENT[child]]))
            own = times(inverse(before), arc)
            found[child], before = np.stack([turn(own, axis) for axis in np.eye(3)], axis=1), times(before, own)
    return [found[joint] for joint in range(1, 22)]


# Measures -------------------------------------------------------------------------------------------------------------


def standing(scores: np.ndarray, right: np.ndarray) -> list[float]:
    """Of each query: the wrong candidates before its best right one, and half of those as good."""
    found = []
    for row, true in zip(scores, right, strict=True):
        best = max(score for score, yes in zip(row, true, strict=True) if yes)
        wrong = [score for score, yes in zip(row, true, strict=True) if not yes]
        found.append(sum(score > best for score in wrong) + 0.5 * sum(score == best for score in wrong))
    return found


def frechet(first: np.ndarray, second: np.ndarray) -> float:
    """Heusel et al. 2017, by the root of a matrix."""
    (m, c), (n, d) = ((each.mean(axis=0), np.cov(each.T)) for each in (first, second))
    return float(((m - n) ** 2).sum() + np.trace(c + d - 2 * sqrtm(c @ d).real))


def jerks(joints: np.ndarray) -> list[float]:
    """FlowMDM, section 4.1: in each frame the largest of the joints' third differences, summed over the axes."""
    third = [joints[i + 3] - 3 * joints[i + 2] + 3 * joints[i + 1] - joints[i] for i in range(len(joints) - 3)]
    return [max(sum(abs(axis) for axis in joint) for joint in frame) for frame in third]


def pose_distance(before: np.ndarray, after: np.ndarray) -> float:
    """The mean way of a joint relative to the pelvis."""
    ways = [(b - after[0]) - (a - before[0]) for a, b in zip(before, after, strict=True)]
    return float(np.mean([np.linalg.norm(way) for way in ways]))
