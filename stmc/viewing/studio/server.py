"""The studio's HTTP interface.

This module knows requests and responses; a model, a queue of jobs and stores do the work.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import re
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

import stmc
from stmc.data.sources.contents import CONTENTS
from stmc.editing.constraints import KINDS, Constraint, constraint_of
from stmc.editing.generate_request import GenerateRequest
from stmc.formats import READABLE
from stmc.io.untrusted import shown
from stmc.model import Model
from stmc.motion.body import JOINTS, BodyPart
from stmc.run.suggestions import suggester, with_suggestions
from stmc.text import Cached, TextEncoder
from stmc.text.vocabulary import Content, Sentence, sentence_encoder
from stmc.timeline import Timeline
from stmc.viewing.exports import EXPORTS
from stmc.viewing.studio.auth import SESSION, AccessControl, error_response
from stmc.viewing.studio.documents_json import (
    MOST_PROMPTS,
    MOST_SECONDS,
    as_data,
    checked,
    in_order,
    read_timelines,
    timeline_of,
    write_timeline,
)
from stmc.viewing.studio.jobs import FULL_STEPS, OWN, Jobs, Stage, stages_by_quality
from stmc.viewing.studio.request_errors import RequestError, read_object, request_error, take
from stmc.viewing.studio.sessions import Sessions
from stmc.viewing.studio.storage import Documents, Motions, private_folder

logger = logging.getLogger(__name__)

OF_JOB = ("timeline", "seeds", "steps", "tab")
"""Keys of a job's JSON that are no fields of the request, or that are checked separately."""

MOST_SEEDS = 8
"""Maximum number of samples of a job."""

MOST_CONDITIONS = 100
"""Maximum number of changes, and of constraints, of a job."""

FARTHEST = 10_000
"""The largest number in a constraint: metres, radians or seconds."""

ASSETS = Path(str(files("stmc") / "assets"))

TYPES = {each.name: each.media_type for each in EXPORTS}

Handler = Callable[[Request], Awaitable[Response]]


def application(model: Model, folder: str | Path, sessions: Sessions, port: int, steps: int | None = None) -> Starlette:
    """Build the studio as an ASGI application.

    Args:
        model: Model to sample with.
        folder: Folder for motions, documents and embedded texts. It serves one application at a time: hold
            `stmc.io.files.locked(folder)` while the application runs, as `stmc studio` does.
        sessions: Sessions that may use the application.
        port: Port of the application, at 127.0.0.1.
        steps: Denoising steps of a motion; None: 50, or the model's own few. Previews have fewer.

    Examples:
        >>> app = stmc.viewing.studio.application(stmc.load(), "studio", stmc.viewing.studio.Sessions(), port=8686)
        >>> sorted(route.path for route in app.routes if route.path.startswith("/api/m"))
        ['/api/model', '/api/motions', '/api/motions/{name}.{kind}']
    """
    folder = private_folder(Path(folder).expanduser())
    encoder = model.text_encoder
    if isinstance(encoder, TextEncoder) and not isinstance(encoder, Cached):
        model = dataclasses.replace(model, text_encoder=Cached(encoder, private_folder(folder / "texts")))
    documents = Documents(folder / "documents")
    answers = Answers(model, Motions(folder / "motions", documents.texts), documents, sessions, steps)

    @asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        await run_in_threadpool(answers.motions.prune)
        await run_in_threadpool(answers.suggest, ["walk"])  # loads the encoder's weights before the first request
        yield
        await run_in_threadpool(answers.jobs.close)

    routes = [
        Route("/", answers.page),
        Route(SESSION, answered(answers.enter), methods=["POST"]),
        Route("/api/model", answered(answers.describe)),
        Route("/api/check", answered(answers.check), methods=["POST"]),
        Route("/api/read", answered(answers.read), methods=["POST"]),
        Route("/api/write", answered(answers.write), methods=["POST"]),
        Route("/api/motions", answered(answers.receive), methods=["POST"]),
        Route("/api/motions/{name}.{kind}", answered(answers.export)),
        Route("/api/jobs", answered(answers.add_job), methods=["POST"]),
        Route("/api/jobs/{name}", answered(answers.cancel_job), methods=["DELETE"]),
        Route("/api/jobs/{name}/events", answered(answers.hear_job)),
        Route("/api/documents", answered(answers.list_documents)),
        Route("/api/documents/{name}", answered(answers.read_document)),
        Route("/api/documents/{name}", answered(answers.write_document), methods=["PUT"]),
        Route("/api/documents/{name}", answered(answers.delete_document), methods=["DELETE"]),
        Mount("/assets", StaticFiles(directory=ASSETS / "studio")),
    ]
    guard = Middleware(AccessControl, sessions=sessions, port=port)
    app = Starlette(routes=routes, lifespan=lifespan, middleware=[guard], exception_handlers={HTTPException: unrouted})
    app.router.redirect_slashes = False
    app.state.folder, app.state.jobs = folder, answers.jobs
    return app


def answered(handler: Handler) -> Handler:
    """Wrap a handler so that errors become responses {"error": message}."""

    async def answer(request: Request) -> Response:
        try:
            return await handler(request)
        except ClientDisconnect:
            return error_response(400, "the request is incomplete")
        except Exception as error:
            refusal = request_error(error)
            if refusal is None:
                logger.exception("%s %s", request.method, request.url.path)
                refusal = RequestError(500, "something went wrong; see the terminal that runs the studio")
            return error_response(refusal.status, str(refusal), **refusal.others)

    return answer


async def unrouted(request: Request, error: Exception) -> Response:
    """Answer a request to an unknown address, or with an unknown method."""
    return error_response(
        error.status_code if isinstance(error, HTTPException) else 500, "the studio has no such address"
    )


class Answers:
    """Handlers of the addresses."""

    def __init__(
        self, model: Model, motions: Motions, documents: Documents, sessions: Sessions, steps: int | None
    ) -> None:
        self.model, self.motions, self.documents = model, motions, documents
        self.stages = stages_by_quality(model.sampling.steps, steps or model.sampling.steps or FULL_STEPS)
        self.sessions = sessions
        self.jobs = Jobs(model.sample, motions)
        self.suggest = suggester(sentence_encoder(model.text_encoder))

    async def page(self, request: Request) -> Response:
        """Send the page."""
        return FileResponse(ASSETS / "studio" / "index.html", headers={"Cache-Control": "no-cache"})

    async def enter(self, request: Request) -> Response:
        """Exchange the token of an address for a key."""
        key = self.sessions.admit(take(read_object(await request.body()), "token", str))
        if key is None:
            raise RequestError(401, "this address was used before: start `stmc studio` again for another one")
        return JSONResponse({"key": key}, 201)

    async def describe(self, request: Request) -> Response:
        """Describe the model and the options of the page."""
        return JSONResponse(await run_in_threadpool(self._described))

    async def check(self, request: Request) -> Response:
        """Check a timeline."""
        timeline = timeline_of(take(read_object(await request.body()), "timeline", dict))
        return JSONResponse(await run_in_threadpool(checked, timeline, self.model, self.suggest))

    async def read(self, request: Request) -> Response:
        """Read timelines from a file."""
        data = read_object(await request.body())
        found = await run_in_threadpool(read_timelines, take(data, "name", str), take(data, "text", str))
        return JSONResponse({"timelines": [as_data(timeline) for timeline in found]})

    async def write(self, request: Request) -> Response:
        """Write a timeline to a file."""
        data = read_object(await request.body())
        timeline, kind = timeline_of(take(data, "timeline", dict)), take(data, "format", str)
        content = await run_in_threadpool(write_timeline, timeline, kind)
        return _attached(content.encode(), f"timeline.{kind}", "application/json" if kind == "json" else "text/plain")

    async def receive(self, request: Request) -> Response:
        """Store an uploaded motion, in the format of the file's name, by default `.npz`."""
        kind = Path(unquote(request.headers.get("x-filename", "motion.npz"))).suffix.lower()
        name = await run_in_threadpool(self.motions.received, await request.body(), kind)
        return JSONResponse({"motion": self.motions.told(name)}, 201)

    async def export(self, request: Request) -> Response:
        """Export a motion as a file."""
        name, kind, query = request.path_params["name"], request.path_params["kind"], request.query_params
        timeline, loop = query.get("timeline"), query.get("loop") == "1"
        shown, fps = None if timeline is None else timeline_of(read_object(timeline.encode())), _rate(query.get("fps"))
        content = await run_in_threadpool(self._exported, name, kind, shown, fps, loop, query.get("constraints"))
        return _attached(content, f"motion.{kind}", TYPES[kind])

    def _exported(
        self, name: str, kind: str, timeline: Timeline | None, fps: float | None, loop: bool, constraints: str | None
    ) -> bytes:
        demands = [] if constraints is None else self._constraints(read_object(constraints.encode()))
        return self.motions.exported(name, kind, timeline, fps, loop, demands)

    async def add_job(self, request: Request) -> Response:
        """Queue a job."""
        data = read_object(await request.body())
        asked, stages = await run_in_threadpool(self._request, data), self._stages(data)
        return JSONResponse({"job": self.jobs.add(asked, stages, take(data, "tab", str, "")[:100]).name}, 201)

    async def hear_job(self, request: Request) -> Response:
        """Stream the events of a job (server-sent events)."""
        job = self.jobs.get(request.path_params["name"])

        async def told() -> AsyncIterator[str]:
            async for kind, details in job.heard():
                yield f"event: {kind}\ndata: {json.dumps(details)}\n\n"

        return StreamingResponse(told(), media_type="text/event-stream", headers={"Cache-Control": "no-store"})

    async def cancel_job(self, request: Request) -> Response:
        """Cancel a job."""
        self.jobs.cancel(request.path_params["name"])
        return JSONResponse({})

    async def list_documents(self, request: Request) -> Response:
        """List all readable documents."""
        return JSONResponse({"documents": await run_in_threadpool(self.documents.all)})

    async def read_document(self, request: Request) -> Response:
        """Send a document with its version."""
        name = request.path_params["name"]
        return JSONResponse({"id": name, **await run_in_threadpool(self.documents.get, name)})

    async def write_document(self, request: Request) -> Response:
        """Save a document, unless it was changed elsewhere."""
        data = read_object(await request.body())
        base, content = take(data, "base", int), take(data, "content", dict)
        version = await run_in_threadpool(self.documents.put, request.path_params["name"], base, content)
        return JSONResponse({"version": version})

    async def delete_document(self, request: Request) -> Response:
        """Delete a document."""
        await run_in_threadpool(self.documents.delete, request.path_params["name"])
        return JSONResponse({})

    def _described(self) -> dict[str, Any]:
        known = self.model.vocabulary
        return {
            "name": type(self.model.denoiser).__name__,
            "version": stmc.__version__,
            "fps": self.model.fps,
            "longest": self.model.longest / self.model.fps,
            "overlap": self.model.own_sampling.overlap,
            "parts": list(BodyPart),
            "joints": [{"name": joint, "part": part} for joint in JOINTS for part in BodyPart if joint in part.joints],
            "contents": _actions({} if known is None else known.examples),
            "formats": [each.describe() for each in EXPORTS],
            "receives": [each.suffix for each in READABLE],
            "examples": [{"name": each.name, "timeline": as_data(each)} for each in bundled_timelines()],
            "limits": {"duration": MOST_SECONDS, "prompts": MOST_PROMPTS, "samples": MOST_SEEDS},
            "steps": {quality: stages[-1].steps for quality, stages in self.stages.items()},
            "constraints": [kind.describe() for kind in KINDS],
        }

    def _request(self, data: dict[str, Any]) -> GenerateRequest:
        """Read the generation request of a page's JSON, within bounds."""
        timeline, _ = with_suggestions(timeline_of(take(data, "timeline", dict)), self.suggest)
        seeds = _few(take(data, "seeds", list, [0]), "seeds", MOST_SEEDS)
        values = {name: _bounded(name, value) for name, value in data.items() if name not in OF_JOB}
        values |= {"timelines": [timeline] * len(seeds), "seeds": seeds}
        request = GenerateRequest.read(values, self.motions.get)
        self.model.check(dataclasses.replace(request, sampling=request.sampling.over(OWN)))
        return request

    def _stages(self, data: dict[str, Any]) -> tuple[Stage, ...]:
        steps = take(data, "steps", str, "full")
        if steps not in self.stages:
            raise RequestError(422, f"steps={shown(steps)}: choose from {', '.join(self.stages)}")
        return self.stages[steps]

    def _constraints(self, data: dict[str, Any]) -> tuple[Constraint, ...]:
        entries = _bounded("constraints", take(data, "constraints", list, []))
        return tuple(constraint_of(each, self.motions.get) for each in entries)


def _actions(vocabulary: Mapping[Content, Sequence[Sentence]]) -> list[dict[str, Any]]:
    """Describe the known actions for the page, one for each title; actions of strangers are titled by a sentence."""
    actions: dict[str, dict[str, Any]] = {}
    for content, sentences in vocabulary.items():
        examples, own = [sentence.text for sentence in sentences], CONTENTS.get(content.name)
        title, topic = (own.title, own.topic) if own else (examples[0], "other actions")
        actions.setdefault(title, {"topic": topic, "parts": in_order(content.parts), "examples": examples})
    return [{"title": title} | action for title, action in actions.items()]


def bundled_timelines() -> list[Timeline]:
    """Read the bundled examples; unnamed ones get the name of their file."""
    timelines = []
    for path in sorted((ASSETS / "timelines").glob("*.json")):
        for each in Timeline.read_all(path):
            timelines.append(each if each.name else dataclasses.replace(each, name=path.stem.replace("_", " ")))
    return timelines


def _rate(text: str | None) -> float | None:
    if text is None:
        return None
    if not re.fullmatch(r"\d{1,3}(\.\d{1,3})?", text) or not 1 <= float(text) <= 240:
        raise RequestError(422, f"fps={text[:20]}: a number from 1 to 240 needed")
    return float(text)


def _few(values: list[Any], name: str, most: int) -> list[Any]:
    if not 0 < len(values) <= most:
        raise RequestError(422, f"{name}: 1 to {most} needed")
    return values


def _bounded(name: str, value: Any) -> Any:
    """Return the value. Raises `RequestError` for a list that is too long, or a number that is too large."""
    if isinstance(value, list) and value:
        _few(value, name, MOST_CONDITIONS)
    left = [value]
    while left:
        each = left.pop()
        left += each.values() if isinstance(each, dict) else each if isinstance(each, list) else ()
        if isinstance(each, (int, float)) and abs(each) > FARTHEST:
            raise RequestError(422, f"{name}: {each:g} is beyond {FARTHEST} metres, radians or seconds")
    return value


def _attached(content: bytes, name: str, kind: str) -> Response:
    return Response(content, media_type=kind, headers={"Content-Disposition": f'attachment; filename="{name}"'})
