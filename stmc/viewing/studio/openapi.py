"""The studio's API as an OpenAPI 3.1 document, derived from the table of operations.

This module knows operations and schemas; it knows no requests.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from http import HTTPStatus
from typing import Any

from stmc.editing.changes import Change
from stmc.editing.constraints import KINDS, Constraint
from stmc.motion.body import BodyPart
from stmc.motion.motion import Motion
from stmc.timeline import Prompt, Timeline
from stmc.viewing.studio.bodies import MOST_SEEDS
from stmc.viewing.studio.documents_json import TIMELINE, TIMELINE_TEXT
from stmc.viewing.studio.json_schemas import Schema, Schemas
from stmc.viewing.studio.operations import Operation
from stmc.viewing.studio.responses import Error
from stmc.viewing.studio.skeletons_json import JOINT_MAP, SKELETON, JointMap, RestSkeleton

_ABOUT = """Sample, edit and export motions of timelines. Seconds, metres and radians; z is up in motions.

Programs send the token in the file `api_token` of the studio's folder: `Authorization: Bearer TOKEN`. A refused request
gets a JSON object with the sentence `error`."""

_MOTIONS = {"type": "array", "items": {"type": "string"}, "maxItems": MOST_SEEDS, "description": "one for each seed"}

_PARTS = {
    "name": "name of the thing, from another request",
    "kind": "format of the file",
    "motion": "id of a stored motion",
}
"""Descriptions of the parts of paths."""


def _constraint(schemas: Schemas) -> Schema:
    return schemas.named("Constraint", lambda: {"oneOf": [_kind(kind, schemas) for kind in KINDS]})


def _kind(kind: type[Constraint], schemas: Schemas) -> Schema:
    """Describe the JSON object of a kind of constraint, with its name as the only key."""
    overridden = "from_json" in vars(kind)
    schema = schemas.of_arguments(kind.from_json) if overridden else schemas.of_record(kind)
    schema = schema | {"description": kind.about}
    return {"type": "object", "required": [kind.name], "additionalProperties": False, "properties": {kind.name: schema}}


def _change(schemas: Schemas) -> Schema:
    return {"anyOf": [schemas.named("Change", lambda: schemas.of_record(Change)), {"type": "string"}]}


OWN = {
    BodyPart: lambda schemas: schemas.named("BodyPart", lambda: {"type": "string", "enum": list(BodyPart)}),
    Timeline: lambda schemas: schemas.named("Timeline", lambda: {"anyOf": [TIMELINE_TEXT, TIMELINE]}),
    tuple[Motion, ...]: lambda schemas: {"anyOf": [{"type": ["string", "null"]}, _MOTIONS]},
    Constraint: _constraint,
    Change: _change,
    Prompt: lambda schemas: None,  # of a timeline in Python; JSON has the texts of changes
    RestSkeleton: lambda schemas: schemas.named("Skeleton", lambda: SKELETON),
    JointMap: lambda schemas: JOINT_MAP,
}
"""Schemas of the studio's own types."""


def openapi_document(operations: Sequence[Operation], version: str) -> dict[str, Any]:
    """Return the OpenAPI 3.1 document of these operations.

    Args:
        operations: Operations to describe.
        version: Version of the library.
    """
    schemas = Schemas(OWN)
    paths: dict[str, Any] = {}
    for operation in operations:
        paths.setdefault(operation.path, {})[operation.method.lower()] = _describe_operation(operation, schemas)
    return {
        "openapi": "3.1.0",
        "info": {"title": "stmc studio", "version": version, "description": _ABOUT},
        "servers": [{"url": "/"}],
        "security": [{"token": []}],
        "tags": [{"name": topic} for topic in dict.fromkeys(each.topic for each in operations)],
        "paths": paths,
        "components": {
            "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}},
            "schemas": dict(sorted(schemas.components.items())),
        },
    }


def _describe_operation(operation: Operation, schemas: Schemas) -> Schema:
    takes = operation.takes.describe(schemas)
    parts = [
        {"name": name, "in": "path", "required": True, "description": _PARTS[name], "schema": {"type": "string"}}
        for name in re.findall(r"{(\w+)}", operation.path)
    ]
    error = {"application/json": {"schema": schemas.of(Error)}}
    refusals = {str(status): {"description": text, "content": error} for status, text in operation.refusals.items()}
    made = {"description": HTTPStatus(operation.status).phrase, "content": operation.gives.describe(schemas)}
    return {
        "operationId": operation.handler,
        "tags": [operation.topic],
        "summary": operation.summary,
        **({"description": operation.about} if operation.about else {}),
        **({"security": []} if operation.public else {}),
        **takes,
        **({"parameters": [*parts, *takes.get("parameters", [])]} if parts or "parameters" in takes else {}),
        "responses": {
            str(operation.status): made,
            **refusals,
            "default": {"description": "refused, with a sentence", "content": error},
        },
    }
