"""Plans as the paper's appendix B and its published code lay them out, interval by interval: an oracle that is slow.

Frames in, plain lists out; ties fall to the file's order. What the published code answers with an exception is the
exception's name here.
"""

from itertools import pairwise

PARTS = ("left arm", "right arm", "legs", "head", "spine")


def by_the_rules(prompts: list, overlap: int) -> tuple | str:
    """Of prompts (start, end, parts): frames, crops [start, end], and for each part its tiles of weight 1 and of -1, as
    [crop, start, end, start in the crop, end in the crop]. Prompts that own nothing have no crop."""
    moments = sorted({moment for start, end, _ in prompts for moment in (start, end)})
    owners = {}
    for interval in pairwise(moments):
        active = [n for n, (start, end, _) in enumerate(prompts) if start <= interval[0] and interval[1] <= end]
        if not active:
            return "IndexError"
        owners[interval] = _owners(prompts, active)
    cuts = {one[1]: [part for part in PARTS if owners[one][part] != owners[two][part]] for one, two in pairwise(owners)}
    if not all(cuts.values()):
        return "AssertionError"
    before, after, last = overlap // 2, overlap - overlap // 2, moments[-1]

    def widened(start: int, end: int) -> list[int]:
        return [max(0, start - before), min(last, end + after)]

    used = sorted({owner for own in owners.values() for owner in own.values()})
    crops = [widened(*prompts[owner][:2]) for owner in used] + [widened(cut, cut) for cut in cuts if overlap]

    def tile(row: int, start: int, end: int) -> list[int]:
        return [row, start, end, start - crops[row][0], end - crops[row][0]]

    plus = [[tile(used.index(owner), *widened(*span)) for owner, *span in _runs(owners, part)] for part in PARTS]
    minus = [
        [tile(len(used) + n, *widened(cut, cut)) for n, cut in enumerate(cuts) if overlap and part in cuts[cut]]
        for part in PARTS
    ]
    return last, crops, plus, minus


def _owners(prompts: list, active: list[int]) -> dict[str, int]:
    """Whose each part is while these prompts are active."""
    by_size = sorted(active, key=lambda n: -len(prompts[n][2]))
    base = next((n for n in by_size if "legs" in prompts[n][2]), by_size[0])
    owners = dict.fromkeys(PARTS, base)
    for other in by_size:
        if other != base:
            owners |= dict.fromkeys(prompts[other][2], other)
    return owners


def _runs(owners: dict, part: str) -> list[list[int]]:
    """Owner, start and end of each stretch that a part has one owner in."""
    runs: list[list[int]] = []
    for (start, end), own in owners.items():
        if runs and runs[-1][0] == own[part]:
            runs[-1][2] = end
        else:
            runs.append([own[part], start, end])
    return runs
