"""A survey as one page that loads nothing from anywhere and holds no answer. Looks and player are in assets/study.*."""

from __future__ import annotations

import json
from importlib.resources import files

from stmc.evaluation.study.clips import TREE
from stmc.evaluation.study.surveys import Question, Survey

_ASSETS = ("study.html", "study.css", "study_stage.js", "study.js")


def survey_page(survey: Survey) -> str:
    """A self-contained HTML page (some 50 kB for each ten seconds of a motion): both motions in step, the timeline with
    a bar that moves along it, two questions a pair, answers as a file to download.

    It keeps the answers in the browser as they are given, so that a closed tab loses nothing.
    """
    content, style, *scripts = ((files("stmc") / "assets" / name).read_text("utf-8") for name in _ASSETS)
    data = {"survey": survey.id, "tree": TREE, "questions": [_asked(question) for question in survey.questions]}
    embedded = json.dumps(data, separators=(",", ":")).replace("<", r"\u003c")
    for mark, text in (("/* style */", style), ("/* script */", "\n".join(scripts)), ("/* survey */", embedded)):
        assert content.count(mark) == 1, mark
        content = content.replace(mark, text)
    return content


def _asked(question: Question) -> dict:
    timeline = question.timeline
    prompts = [
        {"text": prompt.text, "start": prompt.start, "end": prompt.end, "row": row}
        for prompt, row in zip(timeline.prompts, timeline.rows, strict=True)
    ]
    clips = [{"id": name} | clip.data() for name, clip in question.sides]
    duration = max(timeline.duration, *(clip.duration for _, clip in question.sides))
    return {"id": question.id, "duration": duration, "prompts": prompts, "clips": clips}
