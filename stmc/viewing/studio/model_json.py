"""JSON of the model for the page: what it knows, and the options and limits of jobs.

This module knows models, formats and the bundled examples; it knows no requests.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path

import stmc
from stmc.data.sources.contents import CONTENTS
from stmc.editing.constraints import KINDS
from stmc.formats import READABLE
from stmc.model import Model
from stmc.motion.body import JOINTS, BodyPart
from stmc.text.vocabulary import Content, Sentence
from stmc.timeline import Timeline
from stmc.viewing.exports import EXPORTS
from stmc.viewing.studio.bodies import MOST_SEEDS, RECEIVED
from stmc.viewing.studio.documents_json import MOST_PROMPTS, MOST_SECONDS, as_data, sort_parts
from stmc.viewing.studio.inputs_outputs import MOST_UPLOAD
from stmc.viewing.studio.jobs import Stage
from stmc.viewing.studio.responses import ContentEntry, ModelData


def describe_model(model: Model, stages: Mapping[str, Sequence[Stage]]) -> ModelData:
    """Describe a model and the options of the page, with the stages of a preview and of a motion."""
    known = model.vocabulary
    return {
        "name": type(model.denoiser).__name__,
        "version": stmc.__version__,
        "fps": model.fps,
        "longest": model.longest / model.fps,
        "overlap": model.own_sampling.overlap,
        "parts": list(BodyPart),
        "joints": [{"name": joint, "part": part} for joint in JOINTS for part in BodyPart if joint in part.joints],
        "contents": _actions({} if known is None else known.examples),
        "formats": [each.describe() for each in EXPORTS],
        "receives": [each.suffix for each in READABLE],
        "characters": {"receives": list(RECEIVED), "most": MOST_UPLOAD},
        "examples": [{"name": each.name, "timeline": as_data(each)} for each in bundled_timelines()],
        "limits": {"duration": MOST_SECONDS, "prompts": MOST_PROMPTS, "samples": MOST_SEEDS},
        "steps": {"preview": stages["preview"][-1].steps, "full": stages["full"][-1].steps},
        "constraints": [kind.describe() for kind in KINDS],
    }


def _actions(vocabulary: Mapping[Content, Sequence[Sentence]]) -> list[ContentEntry]:
    """Describe the known actions for the page, one for each title; actions of strangers are titled by a sentence."""
    actions: dict[str, ContentEntry] = {}
    for content, sentences in vocabulary.items():
        examples, own = [sentence.text for sentence in sentences], CONTENTS.get(content.name)
        title, topic = (own.title, own.topic) if own else (examples[0], "other actions")
        parts = sort_parts(content.parts)
        actions.setdefault(title, {"title": title, "topic": topic, "parts": parts, "examples": examples})
    return list(actions.values())


def bundled_timelines() -> list[Timeline]:
    """Read the bundled examples; unnamed ones get the name of their file."""
    timelines = []
    for path in sorted(Path(str(files("stmc") / "assets" / "timelines")).glob("*.json")):
        for each in Timeline.read_all(path):
            timelines.append(each if each.name else dataclasses.replace(each, name=path.stem.replace("_", " ")))
    return timelines
