"""Motions of robots: hinges follow a motion of their rig in the least squares' sense, frame by frame.

Angles stay within their limits, and so does their change from frame to frame. Knows no balance and no collisions.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from stmc.motion.retargeting.linkage import Base, Linkage, Pose
from stmc.motion.retargeting.rig import LIMBS, SIDES, Rig

_SOLE, _LIFTED = 4.0, 0.5
"""Weights of the soles' corners on the floor and well above it. Positions count in lengths of the leg."""
_LOW, _HIGH = 0.05, 0.3
"""Heights of a corner, in lengths of the leg, up to which it is on the floor, and from which it is well above."""
_PELVIS, _LEG, _SHOULDER, _ARM = 0.5, 0.3, 0.3, 0.7
"""Weights of the pelvis' position, of bones of legs, of the ways from the chest to the shoulders, of bones of arms."""
_BEND = 0.3
"""The weight of the normal of an arm's plane."""
_HAND = 1.5
"""The weight of the way from the head, or from the other wrist, to a wrist that is there."""
_HAND_PAIRS = (("left_wrist", "head"), ("right_wrist", "head"), ("left_wrist", "right_wrist"))
_TURNS = {"pelvis": 0.2, "chest": 0.2, "head": 0.1, "left_wrist": 0.02, "right_wrist": 0.02}
"""Weights of turns, in radians."""
_SINKING = 8.0
"""The weight of a corner below the floor."""
_REST, _STILL = 0.005, 0.01
"""Weights of the angles' distances from rest and from the frame before, in radians."""
_NEAR, _FAR = 0.45, 0.8
"""Distances of a wrist from the head, in lengths of the arm, at which it is wholly led by it, and not at all."""
_FIRST, _STEPS = 60, 4
"""Most steps of a frame that begins anywhere, and of one that begins at the frame beside it."""
_FOLDED = 4.0
"""How many times a later frame's sum of squares the first frame's is if it is taken to be folded the wrong way."""
_MISSED = 0.05
"""The distance of a hand from where it should be, in lengths of the leg, above which other arms are tried."""
_SETTLED = 1e-4
"""The greatest step, in radians and lengths of the leg, after which a frame is done."""
_TRUST = 0.5
"""The greatest turn of a step, in radians."""
_MARGIN = 2e-6
"""Radians that angles and their changes keep from their limits, so that rounded ones do not exceed them."""


_Posture = tuple[np.ndarray, Base]
"""The hinges' angles and the base of one frame."""


@dataclass(frozen=True, eq=False)
class HingeCurves:
    """The hinges of a rig's linkage over time."""

    angles: Float[np.ndarray, "frames hinges"]
    """Radians from rest."""
    turns: Float[np.ndarray, "frames 3 3"]
    places: Float[np.ndarray, "frames 3"]
    """The base's turns and shifts from rest, as in `Base`."""


@dataclass(frozen=True, eq=False)
class _Goals:
    """Targets of the least-squares problems: positions of sums of points, and rotations of nodes."""

    rest: Float[np.ndarray, "points 3"]
    movers: np.ndarray
    sums: Float[np.ndarray, "rows points"]
    """The points' weights in each sum: one point, or the difference of two."""
    targets: Float[np.ndarray, "frames rows 3"]
    weights: Float[np.ndarray, "frames rows"]
    turners: np.ndarray
    turns: Float[np.ndarray, "frames turned 3 3"]
    turn_weights: Float[np.ndarray, " turned"]
    corners: int
    """The number of soles' corners, which are the last points."""


def follow(
    rig: Rig,
    turns: Float[np.ndarray, "frames driven 3 3"],
    places: Float[np.ndarray, "frames driven 3"],
    fps: float | int,
) -> HingeCurves:
    """Solve for the hinge angles that bring a robot closest to the rotations and positions of its driven nodes.

    Each frame is a bounded least-squares problem, solved by Gauss-Newton steps from the solution of the frame before.
    Its terms are the positions of the soles, the directions of arms and legs, and the rotations of trunk and head. If a
    corner of a sole remains below the floor, the base is lifted.

    An arm often has two solutions, and the limits of its hinges block one of them. If a hand therefore misses the head
    or the other hand, its worst frame is solved again from other angles of that arm, and the frames before and after
    are solved from there.

    Args:
        rig: Rig with a linkage.
        turns: World rotations of the driven nodes from the rest pose.
        places: World positions of the driven nodes, in the rig's unit.
        fps: Frame rate, for the speed limits of hinges.
    """
    linkage, leg = _linkage(rig), rig.length(LIMBS[0])
    problem = _Problem(linkage, _goals(rig, linkage, turns, places, leg), fps, leg)
    first = problem.solved(0, linkage.resting, _start(rig, turns[0], places[0]))
    found = _begin_again(problem, [first, *problem.track(range(1, len(turns)), first)])
    found = _reach(rig, problem, found)
    return HingeCurves(
        np.stack([angles for angles, _ in found]),
        np.stack([base.turn for _, base in found]),
        np.stack([base.place for _, base in found]),
    )


def apply_hinges(
    rig: Rig, curves: HingeCurves
) -> tuple[Float[np.ndarray, "frames driven 3 3"], Float[np.ndarray, "frames driven 3"]]:
    """Compute the rotations and positions of a rig's driven nodes from its hinge angles (forward kinematics)."""
    linkage, driven = _linkage(rig), list(rig.driven)
    movers, turners, rest = linkage.movers[driven], linkage.turners[driven], rig.rest[driven].numpy()
    turns, places = [], []
    for angles, turn, place in zip(curves.angles, curves.turns, curves.places, strict=True):
        pose = linkage.pose(angles, Base(turn, place))
        turns.append(pose.turns[turners])
        places.append(pose.points(rest, movers))
    return np.stack(turns), np.stack(places)


def _linkage(rig: Rig) -> Linkage:
    assert rig.linkage is not None, "a rig without hinges"
    return rig.linkage


def _start(rig: Rig, turns: np.ndarray, places: np.ndarray) -> Base:
    """Return the base that places the resting robot's pelvis where the rig's is."""
    place = rig.place("pelvis")
    return Base(turns[place], places[place] - turns[place] @ rig.at("pelvis").numpy())


def _goals(rig: Rig, linkage: Linkage, turns: np.ndarray, places: np.ndarray, leg: float) -> _Goals:
    driven = list(rig.driven)
    soles = np.array([driven.index(node) for node in linkage.sole_nodes], dtype=int)
    arms = linkage.soles - rig.rest[driven].numpy()[soles]
    corners = places[:, soles] + np.einsum("fcij,cj->fci", turns[:, soles], arms)
    corners[..., 2] = np.maximum(corners[..., 2], 0.0)
    bends = [_bend(rig, linkage, places, side) for side in SIDES]
    tips = [
        places[:, rig.place(f"{side}_elbow")] + _unit(bend) * leg for side, (bend, _) in zip(SIDES, bends, strict=True)
    ]
    points = np.concatenate([places, np.stack(tips, axis=1), corners], axis=1)
    rows = _rows(rig, places, corners[..., 2] / leg, [bend for bend, _ in bends])
    sums = np.zeros((len(rows), points.shape[1]))
    weights = np.empty((len(places), len(rows)))
    for number, (row, weight) in enumerate(rows):
        sums[number, list(row)] = list(row.values())
        weights[:, number] = weight
    turned = {"chest": _chest(rig)}
    turned |= {joint: rig.place(joint) for joint in _TURNS if joint in rig.joints}
    elbows = [rig.joints[f"{side}_elbow"] for side in SIDES]
    movers = np.concatenate([linkage.movers[driven], linkage.movers[elbows], linkage.turners[linkage.sole_nodes]])
    resting_tips = rig.rest[elbows].numpy() + leg * np.stack([normal for _, normal in bends])
    rest = np.concatenate([rig.rest[driven].numpy(), resting_tips, linkage.soles])
    nodes = list(turned.values())
    return _Goals(
        rest,
        movers,
        sums,
        np.einsum("rp,fpk->frk", sums, points),
        weights / leg,
        linkage.turners[driven][nodes],
        turns[:, nodes],
        np.array([_TURNS[joint] for joint in turned]),
        len(soles),
    )


def _rows(
    rig: Rig, places: np.ndarray, heights: np.ndarray, bends: list[np.ndarray]
) -> list[tuple[dict[int, float], np.ndarray | float]]:
    """Return the sums of points with their weights, those of the hands last.

    The tips of the arms and the soles' corners follow the nodes.
    """
    count = len(rig.driven)
    rows: list[tuple[dict[int, float], np.ndarray | float]] = []
    for number, height in enumerate(heights.T):
        rows.append(({count + 2 + number: 1.0}, _LIFTED + (_SOLE - _LIFTED) * _share(height, _LOW, _HIGH)))
    rows += [({rig.place("pelvis"): 1.0}, _PELVIS), *_bones(rig)]
    for number, (side, bend) in enumerate(zip(SIDES, bends, strict=True)):
        tip = {count + number: 1.0, rig.place(f"{side}_elbow"): -1.0}
        rows.append((tip, _BEND * np.linalg.norm(bend, axis=-1)))
    return rows + _hands(rig, places)


def _bones(rig: Rig) -> list[tuple[dict[int, float], float]]:
    """Return the bones of legs and arms and those to the shoulders, as differences of nodes, with their weights."""
    pairs = [
        (rig.place(f"{side}_{above}"), rig.place(f"{side}_{below}"), weight)
        for limb, weight in zip(LIMBS, (_LEG, _ARM), strict=True)
        for side in SIDES
        for above, below in itertools.pairwise(limb)
    ]
    pairs += [(_chest(rig), rig.place(f"{side}_shoulder"), _SHOULDER) for side in SIDES]
    return [({below: 1.0, above: -1.0}, weight) for above, below, weight in pairs]


def _bend(rig: Rig, linkage: Linkage, places: np.ndarray, side: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the normal of an arm's plane in each frame, and the unit normal at rest with a bent elbow.

    The length of the first is the sine of the bend. For the second, the elbow is in the middle of its limits. Both tell
    to which side the elbow of a straight arm has to point before it bends.
    """
    from scipy.spatial.transform import Rotation  # imported late: it is slow to import

    shoulder, elbow, wrist = (rig.place(f"{side}_{joint}") for joint in LIMBS[1])
    upper, lower = places[:, elbow] - places[:, shoulder], places[:, wrist] - places[:, elbow]
    bend = np.cross(_unit(upper), _unit(lower))
    node, hinge = rig.joints[f"{side}_elbow"], linkage.turners[rig.joints[f"{side}_elbow"]]
    while hinge >= 0 and linkage.parents[hinge] != linkage.movers[node]:
        hinge = linkage.parents[hinge]
    limits = np.array([linkage.lower[hinge], linkage.upper[hinge]])
    if hinge < 0 or not np.isfinite(limits).all():
        return 0 * bend, np.zeros(3)
    rest = [rig.at(f"{side}_{joint}").numpy() for joint in LIMBS[1]]
    turned = Rotation.from_rotvec(linkage.axes[hinge] * limits.mean()).apply(rest[2] - rest[1])
    return bend, _unit(np.cross(rest[1] - rest[0], turned))


def _unit(vectors: Float[np.ndarray, "*_ 3"]) -> Float[np.ndarray, "*_ 3"]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)


def _chest(rig: Rig) -> int:
    """Return the index, among the driven nodes, of the node that carries arms and head."""
    return rig.driven.index(rig.spine[-1]) if rig.spine else rig.place("pelvis")


def _hands(rig: Rig, places: np.ndarray) -> list[tuple[dict[int, float], np.ndarray]]:
    """Return the vectors from head to wrists and between the wrists, as sums of nodes, with weights per frame."""
    arm, found = rig.length(LIMBS[1]), []
    for pair in _HAND_PAIRS:
        first, second = (rig.place(joint) for joint in pair)
        away = np.linalg.norm(places[:, first] - places[:, second], axis=-1) / arm
        found.append(({first: 1.0, second: -1.0}, _HAND * _share(away, _NEAR, _FAR)))
    return found


def _share(values: Float[np.ndarray, " frames"], near: float, far: float) -> Float[np.ndarray, " frames"]:
    """Return a weight that falls smoothly from 1, for values up to `near`, to 0, for values from `far` on."""
    share = np.clip((far - values) / (far - near), 0, 1)
    return share**2 * (3 - 2 * share)


@dataclass(frozen=True, eq=False)
class _Problem:
    """The least-squares problems of all frames."""

    linkage: Linkage
    goals: _Goals
    fps: float | int
    leg: float

    def track(self, frames: Iterable[int], start: _Posture) -> list[_Posture]:
        """Solve frames in the given order, each from the solution before it (at first `start`), within speed limits."""
        found = []
        for frame in frames:
            near = self.linkage.speeds / self.fps - _MARGIN
            lower, upper = self._limits()
            lower, upper = np.maximum(lower, start[0] - near), np.minimum(upper, start[0] + near)
            start = self._frame(frame, start, (lower, np.maximum(lower, upper)), _STEPS)
            found.append(start)
        return found

    def solved(self, frame: int, angles: np.ndarray, base: Base) -> _Posture:
        """Solve a frame from any initial posture, without limits of speed."""
        return self._frame(frame, (angles, base), self._limits(), _FIRST)

    def misses(self, frame: int, posture: _Posture) -> Float[np.ndarray, " rows"]:
        """Return the weighted distance of each sum of points from its target, in leg lengths."""
        points = self.linkage.pose(*posture).points(self.goals.rest, self.goals.movers)
        away = self.goals.targets[frame] - self.goals.sums @ points
        return self.goals.weights[frame] * np.linalg.norm(away, axis=1)

    def _limits(self) -> tuple[np.ndarray, np.ndarray]:
        return self.linkage.lower + _MARGIN, self.linkage.upper - _MARGIN

    def _frame(self, frame: int, start: _Posture, bounds: tuple[np.ndarray, np.ndarray], most: int) -> _Posture:
        """Solve one frame in at most `most` Gauss-Newton steps, with angles within `bounds`."""
        from scipy.spatial.transform import Rotation  # imported late: it is slow to import

        (before, base), goals, leg = start, self.goals, self.leg
        angles = np.clip(before, *bounds)
        for _ in range(most):
            pose = self.linkage.pose(angles, base)
            step = _step(goals, frame, pose, angles, before, bounds, leg)
            angles = np.clip(angles + step[6:], *bounds)
            base = Base(Rotation.from_rotvec(step[3:6]).as_matrix() @ base.turn, base.place + step[:3])
            if max(np.abs(step[3:]).max(), np.abs(step[:3]).max() / leg) < _SETTLED:
                break
        pose = self.linkage.pose(angles, base)
        corners = pose.points(goals.rest, goals.movers)[len(goals.rest) - goals.corners :]
        sunk = max(0.0, -float(corners[:, 2].min(initial=0.0)))
        return angles, Base(base.turn, base.place + np.array([0.0, 0.0, sunk]))


def _begin_again(problem: _Problem, found: list[_Posture]) -> list[_Posture]:
    """Solve the first second again, backwards from its end, and return the postures with the smaller residual.

    The first frame is solved from the rest pose, which can fold a limb the wrong way until later frames unfold it.
    """
    end = min(round(problem.fps), len(found) - 1)
    if _square(problem.misses(0, found[0])) < _FOLDED * _square(problem.misses(end, found[end])):
        return found
    again = problem.track(reversed(range(end)), found[end])[::-1]
    before, after = (
        sum(_square(problem.misses(frame, posture)) for frame, posture in enumerate(postures))
        for postures in (found[:end], again)
    )
    return again + found[end:] if after < before else found


def _reach(rig: Rig, problem: _Problem, found: list[_Posture]) -> list[_Posture]:
    """Solve all frames again with another posture of the arm whose hand misses most, if that lowers the residual."""
    misses = np.stack([problem.misses(frame, posture) for frame, posture in enumerate(found)])
    hands = misses[:, -len(_HAND_PAIRS) :] / _HAND
    frame, pair = (int(place) for place in np.unravel_index(hands.argmax(), hands.shape))
    if hands[frame, pair] < _MISSED:
        return found
    best = found[frame]
    for side in [side for side in SIDES if f"{side}_wrist" in _HAND_PAIRS[pair]]:
        base = best[1]
        tried = [problem.solved(frame, angles, base) for angles in _other_arms(rig, problem.linkage, side, best[0])]
        best = min([best, *tried], key=lambda posture: _square(problem.misses(frame, posture)))
    if best is found[frame]:
        return found
    before = problem.track(reversed(range(frame)), best)
    other = [*reversed(before), best, *problem.track(range(frame + 1, len(found)), best)]
    others = np.stack([problem.misses(number, posture) for number, posture in enumerate(other)])
    return other if _square(others) < _square(misses) else found


def _square(values: np.ndarray) -> float:
    return float((values**2).sum())


def _other_arms(rig: Rig, linkage: Linkage, side: str, angles: np.ndarray) -> Iterator[np.ndarray]:
    """Yield other initial angles for the hinges of an arm; all other hinges keep theirs.

    The arm's first three hinges are at a quarter or three quarters of their ranges, the rest in the middle.
    """
    wrist, chest = linkage.movers[rig.joints[f"{side}_wrist"]], linkage.turners[rig.driven[_chest(rig)]]
    carrying = linkage.chains[chest] if chest >= 0 else np.zeros(len(angles), dtype=bool)
    arm = np.flatnonzero(linkage.chains[wrist] & ~carrying) if wrist >= 0 else np.zeros(0, dtype=int)
    lower, upper = np.maximum(linkage.lower[arm], -np.pi), np.minimum(linkage.upper[arm], np.pi)
    for shares in itertools.product((0.25, 0.75), repeat=min(3, len(arm))):
        share = np.array([*shares, *[0.5] * (len(arm) - len(shares))])
        other = angles.copy()
        other[arm] = lower + share * (upper - lower)
        yield other


def _step(
    goals: _Goals,
    frame: int,
    pose: Pose,
    angles: np.ndarray,
    before: np.ndarray,
    bounds: tuple[np.ndarray, np.ndarray],
    leg: float,
) -> Float[np.ndarray, " unknowns"]:
    """Compute the Gauss-Newton step of base and angles: bounded least squares of the problem linearised at `pose`."""
    from scipy.optimize import lsq_linear  # imported late: it is slow to import
    from scipy.spatial.transform import Rotation  # imported late: it is slow to import

    points = pose.points(goals.rest, goals.movers)
    moves = pose.moves(points, goals.movers)
    weights = goals.weights[frame][:, None]
    lines = [(np.einsum("rp,pku->rku", goals.sums, moves) * weights[..., None]).reshape(-1, moves.shape[2])]
    wanted = [((goals.targets[frame] - goals.sums @ points) * weights).ravel()]
    low = np.flatnonzero(points[:, 2] < 0)
    low = low[low >= len(points) - goals.corners]
    lines.append(moves[low, 2] * (_SINKING / leg))
    wanted.append(-points[low, 2] * (_SINKING / leg))
    weights = goals.turn_weights[:, None]
    lines.append((pose.spins(goals.turners) * weights[..., None]).reshape(-1, moves.shape[2]))
    off = goals.turns[frame] @ pose.turns[goals.turners].swapaxes(1, 2)
    wanted.append((Rotation.from_matrix(off).as_rotvec() * weights).ravel())
    hinged = np.eye(len(angles), moves.shape[2], 6)
    lines += [_REST * hinged, _STILL * hinged]
    wanted += [_REST * (pose.linkage.resting - angles), _STILL * (before - angles)]
    lower, upper = (
        np.concatenate([np.full(6, sign * _TRUST), np.clip(bound - angles, -_TRUST, _TRUST)])
        for sign, bound in zip((-1, 1), bounds, strict=True)
    )
    lower[:3], upper[:3] = -np.inf, np.inf
    within = lower, np.maximum(upper, lower + 1e-12)
    return lsq_linear(np.concatenate(lines), np.concatenate(wanted), within, method="bvls").x
