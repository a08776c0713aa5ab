"""Tables of a profile of edits in the studio: stages, kinds of edits, and caches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import median
from typing import NamedTuple

from stmc.evaluation.edit_profile import EditProfile, MeasuredEdit


class Described(NamedTuple):
    """The texts of a table."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]


def describe_edits(profile: EditProfile) -> list[Described]:
    """Return the tables of a profile."""
    everything, touched = profile.medians("everything"), profile.medians("touched")
    stages = [
        (name, *describe_stage(everything, name), *describe_stage(touched, name))
        for name in dict.fromkeys([*everything, *touched])
    ]
    kinds = [
        (kind, generated, *describe_kind([each for each in edits if each.kind == kind]))
        for kind in dict.fromkeys(each.kind for each in profile.everything)
        for generated, edits in (("everything", profile.everything), ("what the edit touches", profile.touched))
    ]
    caches = [(name, str(each.texts), f"{each.hit_rate:.1%}") for name, each in profile.caches.items()]
    columns = ("stage", "everything is generated", "share", "what the edit touches", "share")
    return [
        Described("An edit, from the request to the figures of preview and motion", columns, stages),
        Described("Edits", ("edit", "generated", "crops denoised", "to the preview", "to the motion"), kinds),
        Described("Caches", ("cache", "texts", "found"), caches),
    ]


def describe_stage(seconds: Mapping[str, float], name: str) -> tuple[str, str]:
    """Return the time of a stage, and its share of all stages."""
    own = seconds.get(name, 0.0)
    return f"{1000 * own:.1f} ms", f"{own / sum(seconds.values()):.1%}"


def describe_kind(edits: Sequence[MeasuredEdit]) -> tuple[str, str, str]:
    """Return the crops of edits of one kind, and the median times to preview and motion."""
    crops = dict.fromkeys(f"{each.denoised} of {each.crops}" for each in edits)
    preview, motion = median(each.preview for each in edits), median(each.motion for each in edits)
    return ", ".join(crops), f"{preview:.2f} s", f"{motion:.2f} s"
