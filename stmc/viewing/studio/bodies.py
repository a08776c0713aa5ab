"""What requests hold, as records: reading, checks and the documentation of the API derive from their fields.

This module knows JSON values and bounds; it knows no HTTP.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, dataclass
from typing import Any, Literal, get_type_hints

from stmc.composing.sampling import Sampling
from stmc.editing.generate_request import GenerateRequest
from stmc.settings.records import check_name, check_value, field_infos, setting
from stmc.timeline import Timeline
from stmc.viewing.exports import FILMS
from stmc.viewing.studio.documents_json import MOST_FILE, TIMELINE_FILES, timeline_of
from stmc.viewing.studio.request_errors import RequestError, read_value
from stmc.viewing.studio.skeletons_json import JointMap, RestSkeleton, joint_map_of, skeleton_of

MOST_SEEDS = 8
"""Maximum number of samples of a job."""

MOST_CONDITIONS = 100
"""Maximum number of changes, and of constraints, of a job."""

MOST_EDITS = 20
"""Maximum number of edits of a stream in a request."""

MOST_FRAMES = 200
"""Maximum number of frames of a stream in a response."""

FARTHEST = 10_000
"""The largest number in a job's settings: metres, radians or seconds."""

STAGES = ("preview", "full")
"""Names of the stages of a job."""

RECEIVED = (".glb", ".gltf", ".vrm")
"""Files of characters that the studio takes: those with a mesh to show."""

FILM_NAMES = tuple(suffix[1:] for suffix in FILMS)
"""Names of the formats of films."""

LEAST_FPS, MOST_FPS = 1, 240
"""Frame rates of exported motions."""


def of_length(default: Any, help: str, least: int, most: int, **limits: Any) -> Any:
    """Make a field of a text or a list whose length is bounded.

    Args:
        default: Default value; `MISSING` if it is required.
        help: Help in one line.
        least: Minimum length.
        most: Maximum length.
        **limits: Limits of each item, as in `setting`.
    """
    field = setting(default, help, **limits)
    return dataclasses.field(default=field.default, metadata={**field.metadata, "length": (least, most)})


def rest(*records: type, without: Sequence[str]) -> Any:
    """Make a field for all other keys of the object: the names of settings of these records, their values unchecked.

    Args:
        *records: Records of settings.
        without: Names that are no keys.
    """
    return dataclasses.field(metadata={"rest": records, "without": tuple(without)})


@dataclass(frozen=True, kw_only=True)
class TokenBody:
    """The token of an address."""

    token: str = setting(MISSING, "token of an address that the studio has made; it works once")


@dataclass(frozen=True, kw_only=True)
class TimelineBody:
    """A timeline."""

    timeline: Timeline = setting(MISSING, "")


@dataclass(frozen=True, kw_only=True)
class ReadBody:
    """A file of timelines."""

    name: str = setting(MISSING, "name of the file; its suffix is the format, .txt or .json")
    text: str = of_length(MISSING, "content of the file", 0, MOST_FILE)


@dataclass(frozen=True, kw_only=True)
class WriteBody(TimelineBody):
    """A timeline, and the format of a file."""

    format: str = setting(MISSING, "format of the file", choices=TIMELINE_FILES)


@dataclass(frozen=True, kw_only=True)
class JobBody(TimelineBody):
    """A request to sample a timeline: with the fields of `GenerateRequest` and `Sampling`."""

    seeds: tuple[int, ...] = of_length((0,), "a seed for each motion", 1, MOST_SEEDS, at_least=0)
    steps: str = setting("full", "the preview alone, or the preview and then the motion", choices=STAGES)
    tab: str = setting("", "any name: only the last of the jobs with this name waits")
    settings: Mapping[str, Any] = rest(GenerateRequest, Sampling, without=("timelines", "sampling"))


@dataclass(frozen=True, kw_only=True)
class StreamBody:
    """A request to open a stream: with the fields of `GenerateRequest` and `Sampling` that a stream has."""

    timeline: Timeline | None = setting(None, "timeline to begin with; null: none")
    seed: int = setting(0, "seed of the motion", at_least=0)
    settings: Mapping[str, Any] = rest(
        GenerateRequest,
        Sampling,
        without=("timelines", "seeds", "sampling", "joints_from", "keep", "change", "constraints"),
    )


@dataclass(frozen=True, kw_only=True)
class ReadStreamBody:
    """Edits of a stream, and how many frames are wanted after them."""

    edits: tuple[dict, ...] = of_length(
        (),
        'edits from the next frame on: {"add": {"text", "start", "end" or "seconds", "body_parts"}}, '
        '{"move": 0, "start", "end"} or {"remove": 0}',
        0,
        MOST_EDITS,
    )
    frames: int = setting(MISSING, "number of frames", at_least=0, at_most=MOST_FRAMES)


@dataclass(frozen=True, kw_only=True)
class DocumentBody:
    """A change of a document."""

    base: int = setting(MISSING, "version that the change is based on; 0: a new document")
    content: dict = setting(MISSING, "new content")


@dataclass(frozen=True, kw_only=True)
class JointMapBody:
    """Corrections of the map of a character's joints."""

    joint_map: JointMap = setting(
        MISSING, "names in the file by names of ours; null: it has none; it replaces the map that was stored"
    )


@dataclass(frozen=True, kw_only=True)
class SkeletonBody:
    """A skeleton, and corrections of the map of its joints."""

    skeleton: RestSkeleton = setting(MISSING, "")
    joint_map: JointMap = setting({}, "names in the skeleton by names of ours; null: it has none")


@dataclass(frozen=True, kw_only=True)
class RetargetBody(SkeletonBody):
    """A skeleton that a stored motion is to move."""

    motion: str = setting(MISSING, "id of a stored motion")
    fps: float | int | None = setting(
        None, "frames per second; null: those of the motion", at_least=LEAST_FPS, at_most=MOST_FPS
    )


@dataclass(frozen=True, kw_only=True)
class ExportQuery:
    """Settings of an exported file, in the address."""

    fps: float | int | None = setting(
        None, "frames per second; those of the motion by default", at_least=LEAST_FPS, at_most=MOST_FPS
    )
    loop: Literal[0, 1] = setting(0, "1: a loop, without timeline and constraints")
    timeline: Timeline | None = setting(None, "timeline of the motion, for formats that hold it")
    character: str | None = setting(None, "id of a character, for formats that show it")
    constraints: dict | None = setting(None, 'constraints to draw on a page: {"constraints": [...]}')


@dataclass(frozen=True, kw_only=True)
class FilmBody:
    """A film of a stored motion."""

    motion: str = setting(MISSING, "id of a stored motion")
    format: str = setting(FILM_NAMES[0], "format of the film", choices=FILM_NAMES)
    fps: float | int | None = setting(
        None, "frames per second; null: those of the motion", at_least=LEAST_FPS, at_most=MOST_FPS
    )
    loop: bool = setting(False, "a loop, without the timeline")
    timeline: Timeline | None = setting(None, "timeline whose prompts give colours and texts")


_READERS: Mapping[Any, Callable[[Any], Any]] = {
    Timeline: timeline_of,
    Timeline | None: timeline_of,
    RestSkeleton: skeleton_of,
    JointMap: joint_map_of,
}
"""Functions that read values of the studio's own types."""

_EXPECTED: Mapping[Any, Any] = {
    Timeline: dict | str,
    Timeline | None: dict | str | None,
    RestSkeleton: dict,
    JointMap: dict,
}
"""JSON types of these."""


def read_body(record: type, data: Mapping[str, Any]) -> Any:
    """Make a record from the values of a JSON object.

    Raises `RequestError` or `SettingError` for a missing, unknown or invalid value.
    """
    hints, fields = get_type_hints(record), {field.name: field for field in dataclasses.fields(record)}
    others = [name for name, field in fields.items() if "rest" in field.metadata]
    own = [name for name in fields if name not in others]
    for name in data:
        check_name(name, [*own, *rest_names(record)], "field")
    for name in own:
        if name not in data and fields[name].default is MISSING and fields[name].default_factory is MISSING:
            raise RequestError(422, f"{name} is missing")
    values = {name: _read(fields[name], hints[name], data[name]) for name in own if name in data}
    settings = {name: value for name, value in data.items() if name not in own}
    for name, value in settings.items():
        check_bounds(name, value)
    return record(**values, **{name: settings for name in others})


def read_query(record: type, data: Mapping[str, str]) -> Any:
    """Make a record from the parameters of an address, each a JSON value. Raises as `read_body`."""
    try:
        values = {name: read_value(text, name) for name, text in data.items()}
    except RequestError as error:
        raise RequestError(422, str(error)) from None
    return read_body(record, values)


def _read(field: dataclasses.Field, hint: Any, value: Any) -> Any:
    info, value = field.metadata["info"], tuple(value) if isinstance(value, list) else value
    check_value(field.name, value, _EXPECTED.get(hint, hint), info)
    if "length" in field.metadata:
        _check_length(field.name, value, *field.metadata["length"])
    return _READERS[hint](value) if hint in _READERS and value is not None else value


def _check_length(name: str, value: Any, least: int, most: int) -> None:
    if not least <= len(value) <= most:
        raise RequestError(
            422, f"{name}: {least} to {most:,} {'letters' if isinstance(value, str) else 'items'} needed"
        )


def check_bounds(name: str, value: Any) -> None:
    """Raise `RequestError` for a list that is too long, or for a number that is too large."""
    if isinstance(value, list):
        _check_length(name, value, 0, MOST_CONDITIONS)
    left = [value]
    while left:
        each = left.pop()
        left += each.values() if isinstance(each, dict) else each if isinstance(each, list) else ()
        if isinstance(each, (int, float)) and abs(each) > FARTHEST:
            raise RequestError(422, f"{name}: {each:g} is beyond {FARTHEST} metres, radians or seconds")


def rest_names(record: type) -> list[str]:
    """Return the names that a record's JSON object may have beside its own."""
    return [
        name
        for field in dataclasses.fields(record)
        for other in field.metadata.get("rest", ())
        for name in field_infos(other)
        if name not in field.metadata["without"]
    ]


def rest_of(record: type) -> tuple[type, ...]:
    """Return the records of these names."""
    return tuple(other for field in dataclasses.fields(record) for other in field.metadata.get("rest", ()))
