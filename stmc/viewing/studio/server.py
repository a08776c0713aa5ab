"""The studio's HTTP interface.

This module knows requests and responses; a model, a queue of jobs and stores do the work.
"""

from __future__ import annotations

import dataclasses
import json
import logging
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import asynccontextmanager
from functools import cache, partial
from importlib.resources import files
from pathlib import Path
from threading import Lock
from typing import Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, HTMLResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

import stmc
from stmc.editing.constraints import Constraint, constraint_of
from stmc.editing.generate_request import GenerateRequest
from stmc.formats.characters import retarget
from stmc.model import Model
from stmc.motion.motion import Motion
from stmc.run.suggestions import suggester, with_suggestions
from stmc.text import Cached, TextEncoder
from stmc.text.vocabulary import sentence_encoder
from stmc.timeline import Timeline
from stmc.viewing.exports import CHARACTER_EXPORTS, EXPORTS
from stmc.viewing.studio.api_page import render_api
from stmc.viewing.studio.auth import AccessControl, error_response
from stmc.viewing.studio.bodies import (
    DocumentBody,
    ExportQuery,
    FilmBody,
    JobBody,
    JointMapBody,
    ReadBody,
    ReadStreamBody,
    RetargetBody,
    SkeletonBody,
    StreamBody,
    TimelineBody,
    TokenBody,
    WriteBody,
    check_bounds,
)
from stmc.viewing.studio.character_storage import Characters
from stmc.viewing.studio.documents_json import as_data, check_timeline, read_timelines, write_timeline
from stmc.viewing.studio.films import Films
from stmc.viewing.studio.job_queue import Job, JobQueue
from stmc.viewing.studio.jobs import FULL_STEPS, OWN, Jobs, Stage, stages_by_quality
from stmc.viewing.studio.model_json import describe_model
from stmc.viewing.studio.openapi import openapi_document
from stmc.viewing.studio.operations import GLTF, OPERATIONS, PUBLIC, UPLOADS, Operation
from stmc.viewing.studio.request_errors import RequestError, request_error, take
from stmc.viewing.studio.responses import SkeletonMotion
from stmc.viewing.studio.sampling_turns import Turns
from stmc.viewing.studio.sessions import Sessions
from stmc.viewing.studio.skeletons_json import MOST_KEY_FRAMES, character_of, describe_keys, describe_map
from stmc.viewing.studio.storage import Documents, Motions, private_folder
from stmc.viewing.studio.streams import Streams, mannequin_file
from stmc.viewing.web import Doubtful

logger = logging.getLogger(__name__)

ASSETS = Path(str(files("stmc") / "assets"))

TYPES = {each.name: each.media_type for each in (*EXPORTS, *CHARACTER_EXPORTS)}

Handler = Callable[..., Awaitable[Response]]

FindMissed = Callable[[Model, Timeline, Motion], Sequence[Doubtful]]
"""`stmc.evaluation.verification.find_missed`, or a function like it."""


def application(
    model: Model,
    folder: str | Path,
    sessions: Sessions,
    port: int,
    steps: int | None = None,
    find_missed: FindMissed | None = None,
) -> Starlette:
    """Build the studio as an ASGI application.

    Args:
        model: Model to sample with.
        folder: Folder for motions, documents and embedded texts. It serves one application at a time: hold
            `stmc.io.files.lock_folder(folder)` while the application runs, as `stmc studio` does.
        sessions: Sessions that may use the application.
        port: Port of the application, at 127.0.0.1.
        steps: Denoising steps of a motion; None: 50, or the model's own few. Previews have fewer.
        find_missed: Function that finds the prompts that a motion does not show; None: no motion is judged.

    Examples:
        >>> app = stmc.viewing.studio.application(stmc.load(), "studio", stmc.viewing.studio.Sessions(), port=8686)
        >>> sorted(route.path for route in app.routes if route.path.startswith("/api/mo"))
        ['/api/model', '/api/motions', '/api/motions/{name}.{kind}']
    """
    folder = private_folder(Path(folder).expanduser())
    encoder = model.text_encoder
    if isinstance(encoder, TextEncoder) and not isinstance(encoder, Cached):
        model = dataclasses.replace(model, text_encoder=Cached(encoder, private_folder(folder / "texts")))
    documents = Documents(folder / "documents")
    motions, characters = Motions(folder / "motions", documents.texts), Characters(folder / "characters")
    answers = Answers(model, motions, documents, characters, Films(folder / "films"), sessions, steps, find_missed)

    @asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        await run_in_threadpool(answers.motions.prune)
        await run_in_threadpool(answers.suggest, ["walk"])  # loads the encoder's weights before the first request
        yield
        await run_in_threadpool(answers.films.close)
        await run_in_threadpool(answers.jobs.close)

    routes = [
        Route("/", answers.page),
        Route("/api", answers.api_page),
        *[
            Route(each.path, wrap_handler(each, getattr(answers, each.handler)), methods=[each.method])
            for each in OPERATIONS
        ],
        Mount("/assets", StaticFiles(directory=ASSETS / "studio")),
    ]
    guard = Middleware(AccessControl, sessions=sessions, port=port, public=PUBLIC, uploads=UPLOADS)
    app = Starlette(
        routes=routes, lifespan=lifespan, middleware=[guard], exception_handlers={HTTPException: answer_unknown_address}
    )
    app.router.redirect_slashes = False
    app.state.folder, app.state.jobs, app.state.films = folder, answers.jobs, answers.films
    return app


def wrap_handler(operation: Operation, handler: Handler) -> Handler:
    """Wrap a handler so that it gets what the operation takes, and that errors become responses {"error": message}."""

    async def answer(request: Request) -> Response:
        try:
            return await handler(*await operation.takes.read(request), **request.path_params)
        except ClientDisconnect:
            return error_response(400, "the request is incomplete")
        except Exception as error:
            refusal = request_error(error)
            if refusal is None:
                logger.exception("%s %s", request.method, request.url.path)
                refusal = RequestError(500, "something went wrong; see the terminal that runs the studio")
            return error_response(refusal.status, str(refusal), **refusal.others)

    return answer


async def answer_unknown_address(request: Request, error: Exception) -> Response:
    """Answer a request to an unknown address, or with an unknown method."""
    return error_response(
        error.status_code if isinstance(error, HTTPException) else 500, "the studio has no such address"
    )


class Answers:
    """Handlers of the addresses."""

    def __init__(
        self,
        model: Model,
        motions: Motions,
        documents: Documents,
        characters: Characters,
        films: Films,
        sessions: Sessions,
        steps: int | None,
        find_missed: FindMissed | None = None,
    ) -> None:
        self.model, self.motions, self.documents, self.characters = model, motions, documents, characters
        self.films = films
        self.stages = stages_by_quality(model.sampling.steps, steps or model.sampling.steps or FULL_STEPS)
        self.sessions, self.api = sessions, openapi_document(OPERATIONS, stmc.__version__)
        self._retargeting = Lock()
        self.suggest, turns = suggester(sentence_encoder(model.text_encoder)), Turns()
        self.jobs = Jobs(model.sample, motions, turns, find_missed and partial(find_missed, model))
        self.mannequin = cache(partial(mannequin_file, model.skeleton, model.fps))
        self.streams = Streams(model.stream, self.stages["preview"][-1].steps, self.suggest, turns)

    async def page(self, request: Request) -> Response:
        """Send the page."""
        return FileResponse(ASSETS / "studio" / "index.html", headers={"Cache-Control": "no-cache"})

    async def api_page(self, request: Request) -> Response:
        """Send the page about the API."""
        return HTMLResponse(render_api(self.api, str(request.base_url).rstrip("/")))

    async def describe_api(self) -> Response:
        """Send the description of the API."""
        return JSONResponse(self.api)

    async def client(self) -> Response:
        """Send the example client."""
        return FileResponse(ASSETS / "api" / "client.py", media_type="text/x-python", filename="client.py")

    async def blender_addon(self) -> Response:
        """Send the add-on for Blender."""
        path = ASSETS / "api" / "blender_addon.py"
        return FileResponse(path, media_type="text/x-python", filename="stmc_blender_addon.py")

    async def enter(self, body: TokenBody) -> Response:
        """Exchange the token of an address for a key."""
        key = self.sessions.admit(body.token)
        if key is None:
            raise RequestError(401, "this address was used before: start `stmc studio` again for another one")
        return JSONResponse({"key": key}, 201)

    async def describe(self) -> Response:
        """Describe the model and the options of the page."""
        return JSONResponse(await run_in_threadpool(describe_model, self.model, self.stages))

    async def check(self, body: TimelineBody) -> Response:
        """Check a timeline."""
        return JSONResponse(await run_in_threadpool(check_timeline, body.timeline, self.model, self.suggest))

    async def read(self, body: ReadBody) -> Response:
        """Read timelines from a file."""
        found = await run_in_threadpool(read_timelines, body.name, body.text)
        return JSONResponse({"timelines": [as_data(timeline) for timeline in found]})

    async def write(self, body: WriteBody) -> Response:
        """Write a timeline to a file."""
        kind, content = body.format, await run_in_threadpool(write_timeline, body.timeline, body.format)
        return _attachment(content.encode(), f"timeline.{kind}", "application/json" if kind == "json" else "text/plain")

    async def receive(self, filename: str, content: bytes) -> Response:
        """Store an uploaded motion, in the format of the file's suffix."""
        name = await run_in_threadpool(self.motions.receive, content, Path(filename).suffix.lower())
        return JSONResponse({"motion": self.motions.describe(name)}, 201)

    async def export(self, query: ExportQuery, name: str, kind: str) -> Response:
        """Export a motion as a file."""
        content = await run_in_threadpool(self._export, query, name, kind)
        return _attachment(content, f"motion.{kind}", TYPES[kind])

    def _export(self, query: ExportQuery, name: str, kind: str) -> bytes:
        demands = [] if query.constraints is None else self._constraints(query.constraints)
        character = None if query.character is None else self.characters.get(query.character)
        return self.motions.export(name, kind, query.timeline, query.fps, query.loop == 1, demands, character)

    async def add_film(self, body: FilmBody) -> Response:
        """Queue a film."""
        job = await run_in_threadpool(self._film, body)
        return JSONResponse({"job": job.name}, 201)

    def _film(self, body: FilmBody) -> Job:
        motion = self.motions.variant(body.motion, body.fps, body.loop)
        return self.films.add(motion, body.format, None if body.loop else body.timeline)

    async def send_film(self, name: str) -> Response:
        """Send the file of a film."""
        path = self.films.path(name)
        return FileResponse(path, media_type=TYPES[path.suffix[1:]], filename=f"motion{path.suffix}")

    async def list_characters(self) -> Response:
        """List all characters."""
        return JSONResponse({"characters": await run_in_threadpool(self.characters.all)})

    async def receive_character(self, filename: str, content: bytes) -> Response:
        """Store an uploaded character."""
        name = await run_in_threadpool(self.characters.receive, content, filename)
        return JSONResponse({"character": self.characters.describe(name)}, 201)

    async def send_character(self, name: str) -> Response:
        """Send a character's file as it was uploaded."""
        return Response(await run_in_threadpool(self.characters.content, name), media_type=GLTF)

    async def read_joint_map(self, name: str) -> Response:
        """Describe the joint map of a character."""
        return JSONResponse(await run_in_threadpool(self.characters.joints, name))

    async def write_joint_map(self, body: JointMapBody, name: str) -> Response:
        """Correct the joint map of a character."""
        return JSONResponse(await run_in_threadpool(self.characters.correct, name, body.joint_map))

    async def pose_character(self, name: str, motion: str) -> Response:
        """Send a character's poses in a motion, without its mesh."""
        content = await run_in_threadpool(lambda: self.characters.poses(name, motion, self.motions.get(motion)))
        return Response(content, media_type=GLTF)

    async def delete_character(self, name: str) -> Response:
        """Delete a character."""
        await run_in_threadpool(self.characters.delete, name)
        return JSONResponse({})

    async def map_skeleton(self, body: SkeletonBody) -> Response:
        """Find the joints of a skeleton."""
        return JSONResponse(describe_map(await run_in_threadpool(character_of, body.skeleton, body.joint_map)))

    async def retarget(self, body: RetargetBody) -> Response:
        """Move a skeleton as a motion."""
        return await run_in_threadpool(lambda: JSONResponse(self._retarget(body)))  # megabytes: not in the loop

    def _retarget(self, body: RetargetBody) -> SkeletonMotion:
        character, motion = character_of(body.skeleton, body.joint_map), self.motions.get(body.motion)
        fps = motion.fps if body.fps is None else body.fps
        if motion.duration * fps > MOST_KEY_FRAMES:
            raise RequestError(
                422, f"more than {MOST_KEY_FRAMES} frames at {fps:g} frames per second; lower the frame rate"
            )
        with self._retargeting:
            return describe_keys(retarget(motion.resampled(fps), character), body.skeleton)

    async def add_job(self, body: JobBody) -> Response:
        """Queue a job."""
        request = await run_in_threadpool(self._request, body)
        return JSONResponse({"job": self.jobs.add(request, self._stages(body), body.tab[:100]).name}, 201)

    async def hear_job(self, name: str) -> Response:
        """Stream the events of a job (server-sent events)."""
        job = self._queue(name).get(name)

        async def write_events() -> AsyncIterator[str]:
            async for kind, details in job.subscribe():
                yield f"event: {kind}\ndata: {json.dumps(details)}\n\n"

        return StreamingResponse(write_events(), media_type="text/event-stream", headers={"Cache-Control": "no-store"})

    async def cancel_job(self, name: str) -> Response:
        """Cancel a job."""
        self._queue(name).cancel(name)
        return JSONResponse({})

    async def open_stream(self, body: StreamBody) -> Response:
        """Open a stream."""
        return JSONResponse(await run_in_threadpool(self.streams.open, body.timeline, body.seed, body.settings), 201)

    async def read_stream(self, body: ReadStreamBody, name: str) -> Response:
        """Edit a stream and send its next frames."""
        return JSONResponse(await run_in_threadpool(self.streams.read, name, body.edits, body.frames))

    async def close_stream(self, name: str) -> Response:
        """End a stream."""
        self.streams.close(name)
        return JSONResponse({})

    async def send_mannequin(self) -> Response:
        """Send the figure that the frames of streams move."""
        return Response(await run_in_threadpool(self.mannequin), media_type=GLTF)

    async def list_documents(self) -> Response:
        """List all readable documents."""
        return JSONResponse({"documents": await run_in_threadpool(self.documents.all)})

    async def read_document(self, name: str) -> Response:
        """Send a document with its version."""
        return JSONResponse({"id": name, **await run_in_threadpool(self.documents.get, name)})

    async def write_document(self, body: DocumentBody, name: str) -> Response:
        """Save a document, unless it was changed elsewhere."""
        version = await run_in_threadpool(self.documents.put, name, body.base, body.content)
        return JSONResponse({"version": version})

    async def delete_document(self, name: str) -> Response:
        """Delete a document."""
        await run_in_threadpool(self.documents.delete, name)
        return JSONResponse({})

    def _request(self, body: JobBody) -> GenerateRequest:
        """Read the generation request of a job."""
        timeline, _ = with_suggestions(body.timeline, self.suggest)
        values = {**body.settings, "timelines": [timeline] * len(body.seeds), "seeds": body.seeds}
        request = GenerateRequest.read(values, self.motions.get)
        self.model.check(dataclasses.replace(request, sampling=request.sampling.with_defaults(OWN)))
        return request

    def _queue(self, name: str) -> JobQueue:
        """Return the queue of the job with this name, if there is one."""
        return self.films if name in self.films else self.jobs

    def _stages(self, body: JobBody) -> tuple[Stage, ...]:
        return self.stages[body.steps]

    def _constraints(self, data: dict[str, Any]) -> tuple[Constraint, ...]:
        entries = take(data, "constraints", list, [])
        check_bounds("constraints", entries)
        return tuple(constraint_of(each, self.motions.get) for each in entries)


def _attachment(content: bytes, name: str, kind: str) -> Response:
    return Response(content, media_type=kind, headers={"Content-Disposition": f'attachment; filename="{name}"'})
