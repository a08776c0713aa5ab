"""Identify joints by the shape of the rig alone, for rigs with arbitrary names.

Assumes a person who stands upright: two legs end lowest, two arms end farthest to the sides, the head is highest.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np
from jaxtyping import Float

from stmc.motion.retargeting.rig import SIDES, ancestors, path

_LONGEST = 40
"""Maximum number of joints of a limb, counted from the trunk."""
_STEEP = 0.6
"""Sine of the slope above which a bone belongs to the leg rather than to the foot."""


def joints_by_shape(
    parents: Sequence[int], places: Float[np.ndarray, "nodes 3"], nodes: Sequence[int]
) -> dict[str, int]:
    """Identify our joints among `nodes` by their rest positions (y up); return an empty mapping for no person.

    The person faces along z or along x. Toes point forward and so decide which side is left; without toes it is +x, or
    -z for a person who faces along x.
    """
    inside, places = set(nodes), _sideways(places, nodes)
    leaves = [node for node in nodes if not any(parents[other] == node for other in inside)]
    middle = float(np.median(places[list(nodes), 0]))
    legs = _pair(leaves, places, middle, lambda node: -places[node, 1])
    if legs is None:
        return {}
    pelvis = _above(parents, legs)
    if pelvis is None:
        return {}
    upper = [leaf for leaf in leaves if pelvis in ancestors(parents, leaf) and not _shared(parents, leaf, legs, pelvis)]
    arms = _pair(upper, places, middle, lambda node: abs(places[node, 0] - middle))
    if arms is None:
        return {}
    chest = _above(parents, arms)
    assert chest is not None  # both arms are above the pelvis
    heads = [leaf for leaf in upper if chest in ancestors(parents, leaf) and not _shared(parents, leaf, arms, chest)]
    if not heads:
        return {}
    top = max(heads, key=lambda leaf: places[leaf, 1])
    joints = {"head": _head(path(parents, chest, top)[1:])}
    forward = 1.0
    for side, leg, arm in zip(SIDES, legs, arms, strict=True):
        lower = _leg(places, path(parents, pelvis, leg)[1:])
        upper_limb = _arm(parents, places, path(parents, chest, arm)[1:], inside)
        if not lower or not upper_limb:
            return {}
        found = lower | upper_limb
        if "foot" in found:
            forward = float(places[found["foot"], 2] - places[found["ankle"], 2])
        joints |= {f"{side}_{joint}": node for joint, node in found.items()}
    return joints if forward > 0 else _swapped(joints)


def _sideways(places: np.ndarray, nodes: Sequence[int]) -> np.ndarray:
    """Turn a person by a quarter about y if it is wider along z than along x: arms and hips are wider than feet."""
    width, depth = np.ptp(places[list(nodes)][:, [0, 2]], axis=0)
    return places[:, [2, 1, 0]] * [-1, 1, 1] if depth > width else places


def _pair(
    leaves: Sequence[int], places: np.ndarray, middle: float, rank: Callable[[int], float]
) -> tuple[int, int] | None:
    """Return the highest-ranked leaf on the +x side, and that on the other side."""
    sides = [[leaf for leaf in leaves if sign * (places[leaf, 0] - middle) > 1e-6] for sign in (1, -1)]
    if not all(sides):
        return None
    return max(sides[0], key=rank), max(sides[1], key=rank)


def _above(parents: Sequence[int], pair: tuple[int, int]) -> int | None:
    return max(set(ancestors(parents, pair[0])) & set(ancestors(parents, pair[1])), default=None)


def _shared(parents: Sequence[int], leaf: int, pair: tuple[int, int], top: int) -> bool:
    """Return whether a leaf lies on one of the two branches from `top` to the pair."""
    branch = path(parents, top, leaf)[1:2]
    return any(branch == path(parents, top, other)[1:2] for other in pair)


def _head(chain: Sequence[int]) -> int:
    """Return the head joint of a chain: the last but one of three or more, since the last is only a tip."""
    return chain[-1] if len(chain) < 3 else chain[-2]


def _leg(places: np.ndarray, chain: Sequence[int]) -> dict[str, int]:
    slopes = [_slope(places[above], places[below]) for above, below in itertools.pairwise(chain)]
    steep = [number for number, slope in enumerate(slopes) if slope > _STEEP]
    if len(chain) < 3 or not steep:
        return {}
    last = steep[-1] + 1
    if len(chain) > 3 and last == len(chain) - 1 and _span(places, chain[-2:]) < 0.4 * _span(places, chain[-3:-1]):
        last -= 1  # a toe that lies below the ankle rather than before it
    limb = _bent(places, chain, [last])
    if not limb:
        return {}
    toes = {"foot": chain[last + 1]} if last + 1 < len(chain) else {}
    return dict(zip(("hip", "knee", "ankle"), limb, strict=True)) | toes


def _arm(parents: Sequence[int], places: np.ndarray, chain: Sequence[int], inside: set[int]) -> dict[str, int]:
    forks = [node for node in chain if sum(parents[other] == node for other in inside) > 1]
    ends = [chain.index(forks[0])] if forks else range(max(2, len(chain) - 2), len(chain))
    limb = _bent(places, chain, ends)
    if not limb:
        return {}
    before = chain.index(limb[0])
    collar = {"collar": chain[before - 1]} if before else {}
    return dict(zip(("shoulder", "elbow", "wrist"), limb, strict=True)) | collar


def _bent(places: np.ndarray, chain: Sequence[int], ends: Iterable[int]) -> tuple[int, ...] | None:
    """Find the beginning, the bend and the end of a limb in a chain.

    The choice maximises the lengths of the two bones and their similarity. `ends` are the candidate indices of the end.
    """
    best: tuple[float, tuple[int, ...]] | None = None
    for end in ends if len(chain) <= _LONGEST else ():
        for first, second in itertools.combinations(chain[:end], 2):
            upper, lower = _span(places, (first, second)), _span(places, (second, chain[end]))
            if min(upper, lower) > 1e-6:
                score = abs(math.log(upper / lower)) - 0.2 * math.log(upper + lower)
                best = min(best or (math.inf, ()), (score, (first, second, chain[end])))
    return best and best[1]


def _span(places: np.ndarray, pair: Sequence[int]) -> float:
    return float(np.linalg.norm(places[pair[0]] - places[pair[1]]))


def _slope(above: np.ndarray, below: np.ndarray) -> float:
    length = float(np.linalg.norm(above - below))
    return float(above[1] - below[1]) / length if length > 0 else 0.0


def _swapped(joints: dict[str, int]) -> dict[str, int]:
    other = {"left": "right", "right": "left"}
    names = {joint: joint.partition("_") for joint in joints}
    return {f"{other[side]}_{rest}" if rest else side: joints[joint] for joint, (side, _, rest) in names.items()}
