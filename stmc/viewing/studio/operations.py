"""The operations of the studio's API: one table, from which routes, access control and documentation derive.

An operation says which request it takes, which response it gives, and which method of the handlers does it. This module
knows records and typed dictionaries; it knows no models.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from stmc.formats import READABLE
from stmc.viewing.exports import CHARACTER_EXPORTS, EXPORTS
from stmc.viewing.studio import bodies, responses
from stmc.viewing.studio.bodies import RECEIVED
from stmc.viewing.studio.documents_json import MOST_SECONDS
from stmc.viewing.studio.inputs_outputs import (
    MOST_UPLOAD,
    EventOutput,
    FileBody,
    FileOutput,
    Input,
    JsonBody,
    JsonOutput,
    JsonQuery,
    NoInput,
    Output,
)

Method = Literal["GET", "POST", "PUT", "DELETE"]


@dataclass(frozen=True, kw_only=True)
class Operation:
    """An operation: the address that clients call, and the handler that answers."""

    method: Method
    path: str
    handler: str
    """Name of a method of the handlers. It gets the input's arguments, then the parts of the path by name."""
    topic: str
    summary: str
    about: str = ""
    takes: Input = field(default_factory=NoInput)
    gives: Output
    status: int = 200
    refusals: Mapping[int, str] = field(default_factory=dict)
    """Errors beside those that every operation has, by status."""
    public: bool = False
    """Whether the operation needs no key."""


_WAVE = "walk forwards # 0 # 4 # legs\nwave with the right hand # 1 # 3 # right arm"
_TIMELINE = {"name": "A walk", "prompts": [{"text": "walk forwards", "start": 0, "end": 4, "parts": []}]}
_PERSON = {
    "up": "y",
    "joints": [
        {"name": "hips", "parent": None, "place": [0, 0.95, 0]},
        {"name": "spine", "parent": "hips", "place": [0, 1.15, 0]},
        {"name": "head", "parent": "spine", "place": [0, 1.55, 0]},
        *[
            {"name": f"{side} {joint}", "parent": f"{side} {parent}" if parent else above, "place": [sign * x, y, 0]}
            for side, sign in (("left", 1), ("right", -1))
            for joint, parent, above, x, y in (
                ("upper leg", "", "hips", 0.1, 0.9), ("lower leg", "upper leg", "", 0.1, 0.5),
                ("foot", "lower leg", "", 0.1, 0.1), ("upper arm", "", "spine", 0.2, 1.4),
                ("forearm", "upper arm", "", 0.45, 1.4), ("hand", "forearm", "", 0.7, 1.4),
            )
        ],
    ],
}  # fmt: skip
_NO_MOTION = {404: "there is no such motion"}
_NO_CHARACTER = {404: "there is no such character or motion"}
_NO_JOB = {404: "there is no such job"}
_NO_STREAM = {404: "there is no such stream, or it has ended"}
_NO_DOCUMENT = {404: "there is no such document"}
GLTF = "model/gltf-binary"
_PYTHON = ("text/x-python",)
_EVENTS = {
    "progress": responses.ProgressEvent,
    "motion": responses.MotionEvent,
    "done": responses.Nothing,
    "failed": responses.FailedEvent,
    "cancelled": responses.Nothing,
}


def _upload(suffixes: Sequence[str]) -> str:
    return f"a {' or a '.join(suffixes)} file, {MOST_UPLOAD // 2**20} MiB at most"


OPERATIONS: tuple[Operation, ...] = (
    Operation(
        method="GET", path="/api/model", handler="describe", topic="Timelines",
        summary="Describe the model",
        about="Its actions and body parts, formats of files, kinds of constraints, and limits.",
        gives=JsonOutput(responses.ModelData),
    ),
    Operation(
        method="POST", path="/api/check", handler="check", topic="Timelines",
        summary="Check a timeline",
        about="Suggests body parts for prompts without any, advises on prompts that the model may not show, and says "
        "which prompt owns each body part when.",
        takes=JsonBody(bodies.TimelineBody, {"timeline": _WAVE}), gives=JsonOutput(responses.CheckedTimeline),
    ),
    Operation(
        method="POST", path="/api/read", handler="read", topic="Timelines",
        summary="Read a file of timelines",
        takes=JsonBody(bodies.ReadBody, {"name": "wave.txt", "text": _WAVE}), gives=JsonOutput(responses.TimelineList),
    ),
    Operation(
        method="POST", path="/api/write", handler="write", topic="Timelines",
        summary="Write a file of a timeline",
        takes=JsonBody(bodies.WriteBody, {"timeline": _TIMELINE, "format": "txt"}),
        gives=FileOutput(("application/json", "text/plain")),
    ),
    Operation(
        method="POST", path="/api/jobs", handler="add_job", topic="Jobs", status=201,
        summary="Sample a timeline",
        about="Queues a job; its events tell the motions. `keep` names a stored motion to edit: only `change`, and "
        "frames after its end, are generated.",
        takes=JsonBody(bodies.JobBody, {"timeline": _WAVE, "seeds": [0], "steps": "preview"}),
        gives=JsonOutput(responses.QueuedJob),
        refusals={404: "there is no such motion to keep", 429: "too many jobs are waiting"},
    ),
    Operation(
        method="GET", path="/api/jobs/{name}/events", handler="hear_job", topic="Jobs",
        summary="Follow a job",
        about="Server-sent events, from the job's beginning: `event: NAME`, `data: JSON`, an empty line. The stream "
        "ends after `done`, `failed` or `cancelled`.",
        gives=EventOutput(_EVENTS), refusals=_NO_JOB,
    ),
    Operation(
        method="DELETE", path="/api/jobs/{name}", handler="cancel_job", topic="Jobs",
        summary="Cancel a job",
        about="At once if it waits, before its next step if it runs; a job that has ended stays as it is.",
        gives=JsonOutput(responses.Nothing), refusals=_NO_JOB,
    ),
    Operation(
        method="POST", path="/api/streams", handler="open_stream", topic="Streams", status=201,
        summary="Open a stream: a timeline that is edited while it plays",
        about="Two at most: a third ends the one that was read longest ago. A stream also ends after ten minutes "
        f"without a request, and after {MOST_SECONDS} s of motion. See also the page on streaming.",
        takes=JsonBody(bodies.StreamBody, {"timeline": _WAVE, "seed": 0}),
        gives=JsonOutput(responses.OpenedStream), refusals={429: "all streams are being read"},
    ),
    Operation(
        method="POST", path="/api/streams/{name}", handler="read_stream", topic="Streams",
        summary="Edit a stream and read its next frames",
        about="Edits come first, as those of `stmc stream`; each is answered, also one that is refused. `body_parts` "
        "that are left out are suggested.",
        takes=JsonBody(bodies.ReadStreamBody, {"edits": [{"add": {"text": "wave", "seconds": 2}}], "frames": 10}),
        gives=JsonOutput(responses.StreamFrames), refusals=_NO_STREAM | {429: "another request reads it"},
    ),
    Operation(
        method="DELETE", path="/api/streams/{name}", handler="close_stream", topic="Streams",
        summary="End a stream",
        gives=JsonOutput(responses.Nothing), refusals=_NO_STREAM,
    ),
    Operation(
        method="GET", path="/api/mannequin.glb", handler="send_mannequin", topic="Streams",
        summary="Read the figure that the frames of streams move",
        about="At rest; its nodes are called as the joints.",
        gives=FileOutput((GLTF,)),
    ),
    Operation(
        method="POST", path="/api/motions", handler="receive", topic="Motions", status=201,
        summary="Upload a motion",
        takes=FileBody(_upload([each.suffix for each in READABLE]), "motion.npz"),
        gives=JsonOutput(responses.StoredMotion),
    ),
    Operation(
        method="GET", path="/api/motions/{name}.{kind}", handler="export", topic="Motions",
        summary="Export a motion",
        about=f"`kind` is one of {', '.join(each.name for each in EXPORTS)}; with a character, also of its formats.",
        takes=JsonQuery(bodies.ExportQuery),
        gives=FileOutput(tuple(dict.fromkeys(each.media_type for each in (*EXPORTS, *CHARACTER_EXPORTS)))),
        refusals=_NO_MOTION | {429: "another film is being rendered", 501: "a package is missing"},
    ),
    Operation(
        method="POST", path="/api/films", handler="add_film", topic="Motions", status=201,
        summary="Draw a film of a motion",
        about="Queues a job, for which the addresses of jobs hold: its events count the pictures. Films are drawn one "
        "after the other, some four pictures a second.",
        takes=JsonBody(bodies.FilmBody, {"motion": "ID", "format": "webp"}), gives=JsonOutput(responses.QueuedJob),
        refusals=_NO_MOTION | {429: "too many films are waiting", 501: "a package is missing"},
    ),
    Operation(
        method="GET", path="/api/films/{name}", handler="send_film", topic="Motions",
        summary="Read the film of a job that is done",
        about="The newest films are stored until the studio starts again.",
        gives=FileOutput(tuple(each.media_type for each in EXPORTS if each.drawn)),
        refusals={404: "there is no such film, or not yet"},
    ),
    Operation(
        method="GET", path="/api/characters", handler="list_characters", topic="Characters",
        summary="List the characters",
        gives=JsonOutput(responses.CharacterList),
    ),
    Operation(
        method="POST", path="/api/characters", handler="receive_character", topic="Characters", status=201,
        summary="Upload a character",
        about="The same file is stored once. See the page on characters for what is read and refused.",
        takes=FileBody(_upload(RECEIVED), "character.glb"),
        gives=JsonOutput(responses.StoredCharacter), refusals={507: "there are too many characters"},
    ),
    Operation(
        method="GET", path="/api/characters/{name}", handler="send_character", topic="Characters",
        summary="Read the file of a character",
        gives=FileOutput((GLTF,)), refusals=_NO_CHARACTER,
    ),
    Operation(
        method="GET", path="/api/characters/{name}/joint_map", handler="read_joint_map", topic="Characters",
        summary="Read which joint of a character is which",
        gives=JsonOutput(responses.CharacterJoints), refusals=_NO_CHARACTER,
    ),
    Operation(
        method="PUT", path="/api/characters/{name}/joint_map", handler="write_joint_map", topic="Characters",
        summary="Correct which joint of a character is which",
        about="As `joint_map` in Python: joints that it does not name are as found in the file. Poses and exports "
        "follow the stored map; one that does not fit is refused, and the map of before stays.",
        takes=JsonBody(bodies.JointMapBody, {"joint_map": {"left_foot": None}}),
        gives=JsonOutput(responses.CharacterJoints), refusals=_NO_CHARACTER,
    ),
    Operation(
        method="GET", path="/api/characters/{name}/poses/{motion}", handler="pose_character", topic="Characters",
        summary="Move a character as a stored motion",
        about="A `.glb` file without a mesh, for players that hold the character's file: a node `n12` turns as the "
        "file's node 12, a node of each of our joints has its position, and `stage` brings the character to our size.",
        gives=FileOutput((GLTF,)), refusals=_NO_CHARACTER,
    ),
    Operation(
        method="DELETE", path="/api/characters/{name}", handler="delete_character", topic="Characters",
        summary="Delete a character",
        gives=JsonOutput(responses.Nothing), refusals=_NO_CHARACTER,
    ),
    Operation(
        method="POST", path="/api/map", handler="map_skeleton", topic="Skeletons",
        summary="Find which joint of a skeleton is which",
        about="By names or by shape; `joint_map` corrects it. See also the page on characters.",
        takes=JsonBody(bodies.SkeletonBody, {"skeleton": _PERSON, "joint_map": {}}),
        gives=JsonOutput(responses.MappedSkeleton),
    ),
    Operation(
        method="POST", path="/api/retarget", handler="retarget", topic="Skeletons",
        summary="Move a skeleton as a stored motion",
        about="Arms and legs point where the motion's do, feet and hands keep their contacts: see `stmc.retarget`.",
        takes=JsonBody(bodies.RetargetBody, {"motion": "ID", "skeleton": _PERSON, "fps": 30}),
        gives=JsonOutput(responses.SkeletonMotion), refusals=_NO_MOTION,
    ),
    Operation(
        method="GET", path="/api/documents", handler="list_documents", topic="Documents",
        summary="List the documents of the page",
        gives=JsonOutput(responses.DocumentList),
    ),
    Operation(
        method="GET", path="/api/documents/{name}", handler="read_document", topic="Documents",
        summary="Read a document",
        gives=JsonOutput(responses.DocumentData), refusals=_NO_DOCUMENT,
    ),
    Operation(
        method="PUT", path="/api/documents/{name}", handler="write_document", topic="Documents",
        summary="Save a document",
        about="Unless it was changed elsewhere since version `base`; the refusal then holds the newer document.",
        takes=JsonBody(bodies.DocumentBody, {"base": 0, "content": {"name": "A walk"}}),
        gives=JsonOutput(responses.SavedDocument),
        refusals={409: "the document was changed elsewhere", 507: "there are too many documents"},
    ),
    Operation(
        method="DELETE", path="/api/documents/{name}", handler="delete_document", topic="Documents",
        summary="Delete a document",
        gives=JsonOutput(responses.Nothing),
    ),
    Operation(
        method="POST", path="/api/session", handler="enter", topic="Files for programs", status=201, public=True,
        summary="Exchange the token of an address for a key",
        about="For pages; programs have the token of the studio's folder instead.",
        takes=JsonBody(bodies.TokenBody, {"token": "TOKEN"}), gives=JsonOutput(responses.Key),
    ),
    Operation(
        method="GET", path="/api/openapi.json", handler="describe_api", topic="Files for programs", public=True,
        summary="Describe this API: OpenAPI 3.1",
        gives=FileOutput(("application/json",)),
    ),
    Operation(
        method="GET", path="/api/client.py", handler="client", topic="Files for programs", public=True,
        summary="An example client in Python, which needs nothing but Python",
        gives=FileOutput(_PYTHON),
    ),
    Operation(
        method="GET", path="/api/blender_addon.py", handler="blender_addon", topic="Files for programs", public=True,
        summary="An add-on for Blender: motions of timelines on the selected armature",
        gives=FileOutput(_PYTHON),
    ),
)  # fmt: skip
"""All operations; the only listing."""

PUBLIC = frozenset(each.path for each in OPERATIONS if each.public)
"""Addresses that need no key."""

UPLOADS: Mapping[str, int] = {each.path: each.takes.most for each in OPERATIONS if each.takes.most is not None}
"""Addresses that take larger requests, and their maximum size in bytes."""
