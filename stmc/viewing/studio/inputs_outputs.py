"""What operations of the studio's API take and give: JSON objects, files and events, read and described by one class.

This module knows records, bytes and JSON Schema; it knows no operations.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable
from urllib.parse import unquote

from starlette.requests import Request

from stmc.viewing.studio import bodies
from stmc.viewing.studio.bodies import read_body, read_query, rest_names, rest_of
from stmc.viewing.studio.json_schemas import Schema, Schemas
from stmc.viewing.studio.request_errors import read_object

MOST_UPLOAD = 32 * 2**20
"""Maximum size of an uploaded motion or character in bytes."""


@runtime_checkable
class Input(Protocol):
    """What an operation reads of a request beside the parts of its path."""

    @property
    def most(self) -> int | None:
        """Maximum size of the request in bytes; None: that of every request."""

    async def read(self, request: Request) -> tuple[Any, ...]:
        """Return the handler's first arguments. Raises `RequestError` or `SettingError`."""

    def describe(self, schemas: Schemas) -> Schema:
        """Return the fields of an OpenAPI operation that describe this input."""


@runtime_checkable
class Output(Protocol):
    """A response to a fulfilled request."""

    def describe(self, schemas: Schemas) -> Schema:
        """Return the content of an OpenAPI response."""


@dataclass(frozen=True)
class NoInput:
    """Nothing but the address."""

    most: int | None = None

    async def read(self, request: Request) -> tuple[Any, ...]:
        """Return no arguments."""
        return ()

    def describe(self, schemas: Schemas) -> Schema:
        """Return no fields."""
        return {}


@dataclass(frozen=True)
class JsonBody:
    """A JSON object with the fields of a record."""

    record: type
    example: Mapping[str, Any]
    most: int | None = None

    async def read(self, request: Request) -> tuple[Any, ...]:
        """Return the record."""
        return (read_body(self.record, read_object(await request.body())),)

    def describe(self, schemas: Schemas) -> Schema:
        """Return the request body."""
        schema = schemas.named(self.record.__name__, lambda: self._schema(schemas))
        return {
            "requestBody": {
                "required": True,
                "content": {"application/json": {"schema": schema, "example": dict(self.example)}},
            }
        }

    def _schema(self, schemas: Schemas) -> Schema:
        schema = schemas.of_record(self.record)
        names = rest_names(self.record)
        for record in rest_of(self.record):
            for name, each in schemas.of_record(record)["properties"].items():
                bound = {"maxItems": bodies.MOST_CONDITIONS} if each.get("type") == "array" else {}
                schema["properties"] |= (
                    {name: each | bound} if name in names and name not in schema["properties"] else {}
                )
        return schema


@dataclass(frozen=True)
class JsonQuery:
    """Parameters of the address, each a JSON value, with the fields of a record."""

    record: type
    most: int | None = None

    async def read(self, request: Request) -> tuple[Any, ...]:
        """Return the record."""
        return (read_query(self.record, dict(request.query_params)),)

    def describe(self, schemas: Schemas) -> Schema:
        """Return the parameters."""
        properties = schemas.of_record(self.record)["properties"]
        return {"parameters": [_parameter(name, schema) for name, schema in properties.items()]}


def _parameter(name: str, schema: Schema) -> Schema:
    """Describe a parameter of an address: objects and lists are JSON texts there."""
    described = {"name": name, "in": "query", "required": False, "description": schema["description"]}
    schema = {key: value for key, value in schema.items() if key != "description"}
    plain = "anyOf" not in schema and "$ref" not in schema and "object" not in schema.get("type", ())
    return described | ({"schema": schema} if plain else {"content": {"application/json": {"schema": schema}}})


@dataclass(frozen=True)
class FileBody:
    """The bytes of a file, whose name is in the header `X-Filename`."""

    about: str
    default: str
    """Name of a file that is sent without one."""
    most: int | None = MOST_UPLOAD

    async def read(self, request: Request) -> tuple[Any, ...]:
        """Return the file's name and its bytes."""
        return Path(unquote(request.headers.get("x-filename", self.default))).name, await request.body()

    def describe(self, schemas: Schemas) -> Schema:
        """Return the header and the body."""
        name = {"name": "X-Filename", "in": "header", "required": False, "schema": {"type": "string"}}
        suffix = Path(self.default).suffix
        name |= {"description": f"name of the file, percent-encoded; its suffix is the format, by default {suffix}"}
        content: Schema = {"application/octet-stream": {}}
        return {"parameters": [name], "requestBody": {"required": True, "description": self.about, "content": content}}


@dataclass(frozen=True)
class JsonOutput:
    """A JSON object."""

    hint: Any

    def describe(self, schemas: Schemas) -> Schema:
        """Return its schema."""
        return {"application/json": {"schema": schemas.of(self.hint)}}


@dataclass(frozen=True)
class FileOutput:
    """A file of one of these media types."""

    media_types: tuple[str, ...]

    def describe(self, schemas: Schemas) -> Schema:
        """Return the media types."""
        return {media_type: {} for media_type in self.media_types}


@dataclass(frozen=True)
class EventOutput:
    """A stream of server-sent events, each with a JSON object."""

    hints: Mapping[str, Any]

    def describe(self, schemas: Schemas) -> Schema:
        """Return the schemas of the events by their names."""
        events = {name: schemas.of(hint) for name, hint in self.hints.items()}
        return {"text/event-stream": {"schema": {"type": "string"}, "x-events": events}}
