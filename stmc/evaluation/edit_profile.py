"""Profile of an edit in the studio: the stages from the request to the bytes of the motion that the page shows.

The studio runs in this process, and is asked what its page asks after an edit: a check of the timeline, a job, and the
figures of the preview and of the motion. Drawing, and the pauses in which the page waits for further keys, are not
included.
"""

from __future__ import annotations

import asyncio
import dataclasses
import json
import time
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import chain, cycle, islice
from pathlib import Path
from statistics import median
from typing import Any, Literal, NamedTuple
from unittest.mock import patch

from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message

import stmc.model
import stmc.run.suggestions
from stmc.composing import Run
from stmc.editing import changed_prompts
from stmc.editing.conditions import Conditions
from stmc.editing.generate_request import GenerateRequest
from stmc.evaluation.stage_timer import Seam, StageTimer
from stmc.model import Model
from stmc.motion.feet import cleaning
from stmc.text import Cached
from stmc.text.vocabulary import Recogniser, Vocabulary
from stmc.timeline import Prompt, Timeline
from stmc.timeline.planning import Plan
from stmc.viewing.studio import Motions, Sessions, application, documents_json, inputs_outputs
from stmc.viewing.studio.documents_json import as_data

BASE = Timeline.parse(
    "walk forwards # 0 # 6 # legs\nwave with the right hand # 2 # 5 # right arm\nsit down # 6 # 10 # legs # spine"
)
"""Ten seconds of three prompts, to edit."""
Scope = Literal["everything", "touched"]
"""What is generated after an edit."""
_ACTIONS = ("raise the right arm", "punch with the right hand", "throw a ball", "point at something", "drink water")
_MANNERS = ("", " slowly", " quickly", " twice", " carefully", " again and again", " happily", " like a robot")
_PORT = 8686
_KEY = "profile"
REST = "server, threads and waiting"
"""Name of the time that no stage has."""


class Edit(NamedTuple):
    """An edit of `BASE`: what is done, and the timeline after it."""

    kind: str
    timeline: Timeline


@dataclass(frozen=True)
class MeasuredEdit:
    """One edit: seconds of each stage, seconds to the preview and to the motion, and how many crops were denoised."""

    kind: str
    stages: Mapping[str, float]
    preview: float
    motion: float
    denoised: int
    crops: int


@dataclass(frozen=True)
class Lookups:
    """How many texts were looked up in a cache, and how many of them it did not have."""

    texts: int = 0
    missing: int = 0

    @property
    def hit_rate(self) -> float:
        """The fraction of the texts that the cache had; 1 without texts."""
        return 1 - self.missing / self.texts if self.texts else 1.0


@dataclass(frozen=True)
class EditProfile:
    """Measured edits after which everything is generated, or only what they touch, and how often caches helped.

    Examples:
        >>> edits = [MeasuredEdit("an end is moved", {"steps": 3.0, "feet": 1.0}, 1.0, 4.0, 2, 6)]
        >>> EditProfile(edits, [], {}).shares("everything")
        {'steps': 0.75, 'feet': 0.25}
    """

    everything: Sequence[MeasuredEdit]
    touched: Sequence[MeasuredEdit]
    caches: Mapping[str, Lookups]

    def medians(self, scope: Scope) -> dict[str, float]:
        """Return the median seconds of each stage over the edits of all kinds, the longest first."""
        every = [edit.stages for edit in getattr(self, scope)]
        names = dict.fromkeys(chain.from_iterable(every))
        seconds = {name: median(stages.get(name, 0.0) for stages in every) for name in names}
        return dict(sorted(seconds.items(), key=lambda each: -each[1]))

    def shares(self, scope: Scope) -> dict[str, float]:
        """Return the fraction of each stage's median in the sum of all."""
        seconds = self.medians(scope)
        return {name: each / sum(seconds.values()) for name, each in seconds.items()}


def list_edits(count: int) -> list[Edit]:
    """Return `count` edits of each kind: a prompt's end is moved, a text is changed to a new one, a prompt is added."""
    walk, wave, sit = BASE.prompts
    texts = islice(cycle(f"{action}{manner}" for manner in _MANNERS for action in _ACTIONS), count)
    edits = []
    for number, text in enumerate(texts):
        later = 0.1 * (number % 10)
        left = Prompt("wave with the left hand", 1 + later, 4, ["left arm"])
        edits += [
            Edit("an end is moved", Timeline((walk, dataclasses.replace(wave, end=4 + later), sit))),
            Edit("a text is changed", Timeline((walk, dataclasses.replace(wave, text=text), sit))),
            Edit("a prompt is added", Timeline((walk, wave, sit, left))),
        ]
    return edits


def profile_edits(
    model: Model, folder: Path, steps: int, edits: Sequence[Edit], progress: Callable[..., Any] = lambda edits: edits
) -> EditProfile:
    """Measure edits of `BASE`: with everything generated, as after an edit of a motion that only its seed decides, and
    with what the edit does not touch kept, as after an edit of a motion that was regenerated in part.

    Args:
        model: Model of the studio.
        folder: Folder of the studio.
        steps: Denoising steps of a motion; its preview has fewer.
        edits: Edits to measure, such as those of `list_edits`.
        progress: Wraps the edits.
    """
    timer, counts = StageTimer(), _Counts()
    with timer.watching(_seams(model)), counts.watching(model):
        sessions = Sessions()
        sessions.allow(_KEY)
        app = application(model, folder, sessions, _PORT, steps)
        try:
            everything, touched = asyncio.run(_Client(app, timer, counts).measure(edits, progress))
        finally:
            app.state.jobs.close()
            app.state.films.close()
    return EditProfile(everything, touched, counts.lookups)


def _seams(model: Model) -> list[Seam]:
    """List the functions at which stages begin."""
    network, representation = type(model.network), type(model.representation)
    seams = [
        (inputs_outputs, "read_object", "read requests"),
        (inputs_outputs, "read_body", "read requests"),
        (GenerateRequest, "read", "read requests"),
        (stmc.run.suggestions, "suggest", "suggest body parts"),
        (Recogniser, "__call__", "recognise prompts"),
        (Model, "plans", "plan"),
        (Run, "plans", "plan"),
        (documents_json, "owned_seconds", "plan"),
        (Model, "guided", "plan"),
        (Model, "embed", "encode texts"),
        (Cached, "encode", "encode texts"),
        (network, "encode_text", "encode texts"),
        (network, "denoise", "steps: network"),
        (Run, "denoise", "steps: crops, stitching, sampler"),
        (Model, "decode", "decode"),
        (representation, "decode", "decode"),
        (stmc.model, "prepare_kept", "keep the rest"),
        (Conditions, "sample", "keep the rest"),
        (stmc.model, "clean_motions", "feet"),
        (cleaning, "bend_leg", "inverse kinematics"),
        (Motions, "add", "store the motion"),
        (Motions, "export", "figure (.glb)"),
        (JSONResponse, "render", "write JSON"),
    ]
    return [Seam(*each) for each in seams]


class _Counts:
    """Counts of texts in caches, and of the crops of the last request to sample."""

    def __init__(self) -> None:
        self._counts: dict[str, list[int]] = {name: [0, 0] for name in ("encoded texts", "recognised texts")}
        self.crops = (0, 0)
        """The number of denoised crops, and of all crops."""

    @property
    def lookups(self) -> dict[str, Lookups]:
        """The counts of each cache."""
        return {name: Lookups(*counts) for name, counts in self._counts.items()}

    @contextmanager
    def watching(self, model: Model) -> Iterator[None]:
        """Count while this context lasts."""
        with ExitStack() as stack:
            for owner, attribute, cache, column in (
                (Cached, "encode", "encoded texts", 0),
                (type(model.text_encoder), "encode", "encoded texts", 1),
                (Recogniser, "__call__", "recognised texts", 0),
                (Vocabulary, "recognise", "recognised texts", 1),
            ):
                if hasattr(owner, attribute):
                    counted = self._counted(getattr(owner, attribute), self._counts[cache], column)
                    stack.enter_context(patch.object(owner, attribute, counted))
            stack.enter_context(patch.object(Model, "guided", self._recorded(Model.guided)))
            yield

    @staticmethod
    def _counted(function: Callable[..., Any], counts: list[int], column: int) -> Callable[..., Any]:
        def call(owner: Any, texts: Sequence[str], *others: Any, **settings: Any) -> Any:
            counts[column] += len(set(texts))
            return function(owner, texts, *others, **settings)

        return call

    def _recorded(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(model: Model, plans: Sequence[Plan], *others: Any, **settings: Any) -> Any:
            crops, needed = sum(len(plan.crops) for plan in plans), settings.get("needed")
            self.crops = (crops if needed is None else sum(needed), crops)
            return function(model, plans, *others, **settings)

        return call


class _Client:
    """Asks a studio in this process for what its page asks."""

    def __init__(self, app: ASGIApp, timer: StageTimer, counts: _Counts) -> None:
        self._app, self._timer, self._counts = app, timer, counts

    async def measure(
        self, edits: Sequence[Edit], progress: Callable[..., Any]
    ) -> tuple[list[MeasuredEdit], list[MeasuredEdit]]:
        """Sample `BASE`, then measure each edit twice: without its motion, and with it kept where it can be."""
        await self._measure("", BASE)
        _, base = await self._measure("", BASE)  # everything is loaded by now
        everything, touched = [], []
        for kind, timeline in progress(edits):
            everything.append((await self._measure(kind, timeline))[0])
            changes = [
                {"start": each.start, "end": each.end, "parts": sorted(each.parts)}
                for each in changed_prompts(BASE, timeline)
            ]
            touched.append((await self._measure(kind, timeline, keep=base, change=changes))[0])
        return everything, touched

    async def _measure(self, kind: str, timeline: Timeline, **settings: Any) -> tuple[MeasuredEdit, str]:
        """Measure what the page asks after an edit; return the name of the motion, too."""
        self._timer.take()
        start, times, name = time.perf_counter(), {}, ""
        data = {"timeline": as_data(timeline)}
        await self._read("POST", "/api/check", data)
        job = json.loads(await self._read("POST", "/api/jobs", data | settings))["job"]
        async for event, details in self._events(f"/api/jobs/{job}/events"):
            if event == "failed":
                raise RuntimeError(details["error"])
            if event == "motion":
                name = details["motion"]["id"]
                await self._read("GET", f"/api/motions/{name}.glb")
                times[details["stage"]] = time.perf_counter() - start
        stages = self._timer.take()
        stages[REST] = max(0.0, time.perf_counter() - start - sum(stages.values()))
        return MeasuredEdit(kind, stages, min(times.values()), max(times.values()), *self._counts.crops), name

    async def _read(self, method: str, path: str, data: Mapping[str, Any] | None = None) -> bytes:
        return b"".join([part async for part in self._send(method, path, data)])

    async def _events(self, path: str) -> AsyncIterator[tuple[str, dict[str, Any]]]:
        async for part in self._send("GET", path, None):
            for block in filter(None, part.decode().split("\n\n")):
                event, details = (line.partition(": ")[2] for line in block.split("\n"))
                yield event, json.loads(details)

    async def _send(self, method: str, path: str, data: Mapping[str, Any] | None) -> AsyncIterator[bytes]:
        """Send a request and yield the parts of the answer. Raises `RuntimeError` for a refusal."""
        body, messages = b"" if data is None else json.dumps(data).encode(), asyncio.Queue[Message | None]()
        headers = {"host": f"127.0.0.1:{_PORT}", "authorization": f"Bearer {_KEY}", "content-length": str(len(body))}
        scope = {
            "type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1", "method": method, "scheme": "http",
            "path": path, "raw_path": path.encode(), "root_path": "", "query_string": b"",
            "headers": [(name.encode(), value.encode()) for name, value in headers.items()],
        }  # fmt: skip
        requests: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]

        async def receive() -> Message:
            if not requests:
                await asyncio.Event().wait()  # the page stays
            return requests.pop()

        task = asyncio.ensure_future(self._app(scope, receive, messages.put))
        task.add_done_callback(lambda _: messages.put_nowait(None))
        status = 0
        while (message := await messages.get()) is not None:
            status = message.get("status", status)
            part = message.get("body", b"")
            if status >= 400 and part:
                raise RuntimeError(f"{method} {path}: {part.decode()}")
            if part:
                yield part
        await task
