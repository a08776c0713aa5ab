"""Survey pages, which are self-contained and hold no answers. Style and script are in assets/study.*."""

from __future__ import annotations

import base64
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from stmc.evaluation.study.clips import Clip
from stmc.evaluation.study.surveys import Question, Survey
from stmc.formats.glb import glb_of
from stmc.motion.body import JOINTS
from stmc.motion.body_model import Skeleton
from stmc.motion.skins import Skin, build_mannequin
from stmc.viewing.bundle import as_json, assemble
from stmc.viewing.colours import as_rgb

SIDES = {"left": "#6f95c4", "right": "#cf9a62", "": "#b0b6c0"}
"""Colours of the left and right limbs and of the rest of the body; the page's legend repeats them."""
_SAME = 1e-3
"""Maximum difference in metres between bones of the same body."""


def survey_page(survey: Survey) -> str:
    """Build the HTML page of a survey, self-contained, of 1.5 MB plus 50 kB per ten seconds of motion.

    For each pair, the page plays both motions in step above the timeline with a cursor, and asks two questions. The
    rater downloads the answers as a file. The browser stores answers immediately, so a closed tab loses none.
    """
    clips = {name: clip for question in survey.questions for name, clip in question.sides}
    bodies = _bodies(clips)
    data = {
        "survey": survey.id,
        "figures": [base64.b64encode(_figure(skeleton, clips, names)).decode("ascii") for skeleton, names in bodies],
        "questions": [_question_data(question, [names for _, names in bodies]) for question in survey.questions],
    }
    return assemble("study.html", "study.js", ("stage.css", "study.css"), {"survey": as_json(data)})


def _question_data(question: Question, figures: Sequence[Collection[str]]) -> dict[str, Any]:
    timeline = question.timeline
    prompts = [
        {"text": prompt.text, "start": prompt.start, "end": prompt.end, "row": row}
        for prompt, row in zip(timeline.prompts, timeline.rows, strict=True)
    ]
    numbers = {name: number for number, names in enumerate(figures) for name in names}
    clips = [{"id": name, "figure": numbers[name]} for name, _ in question.sides]
    duration = max(timeline.duration, *(clip.duration for _, clip in question.sides))
    return {"id": question.id, "duration": duration, "prompts": prompts, "clips": clips}


def _bodies(clips: Mapping[str, Clip]) -> list[tuple[Skeleton, list[str]]]:
    """Return the distinct bodies, with the names of their clips; bones of one body are equal to a millimetre."""
    bodies: list[tuple[Skeleton, list[str]]] = []
    for name, clip in clips.items():
        own = Skeleton.measured(clip.motion.rotations, clip.motion.joints)
        for skeleton, names in bodies:
            if (own.offsets - skeleton.offsets).abs().max() < _SAME:
                names.append(name)
                break
        else:
            bodies.append((own, [name]))
    return bodies


def _figure(body: Skeleton, clips: Mapping[str, Clip], names: Sequence[str]) -> bytes:
    """Return a mannequin as GLB with some clips as animations; left and right limbs differ in colour."""
    skin = build_mannequin(body)
    return glb_of(skin, {name: clips[name].animation for name in names}, tints=_tints(skin), compact=True)


def _tints(skin: Skin) -> Float[np.ndarray, "vertices 3"]:
    """Return linear colours of the vertices by the side of the joint with the largest weight."""
    sides = [name.partition("_")[0] if "_" in name else "" for name in JOINTS]
    colours = np.stack([as_rgb(SIDES[side]) ** 2.2 for side in sides])
    return colours[skin.weights.argmax(axis=1)]
