"""Responses of the studio as typed dictionaries: what handlers return, and what the API documents.

Units are seconds and frames per second.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, NotRequired, TypedDict

from stmc.formats.motion_files import FormatEntry
from stmc.motion.body import BodyPart


class Nothing(TypedDict):
    """An empty object."""


class Key(TypedDict):
    """The key of a page."""

    key: Annotated[str, "for `Authorization: Bearer KEY`, until the server ends"]


class PromptData(TypedDict):
    """A prompt."""

    text: str
    start: Annotated[float, "s"]
    end: Annotated[float, "s"]
    parts: list[BodyPart]


class TimelineData(TypedDict):
    """A timeline, as requests take it."""

    name: str
    prompts: list[PromptData]


class TimelineList(TypedDict):
    """The timelines of a file."""

    timelines: list[TimelineData]


class Advice(TypedDict):
    """Advice on a prompt that the model may not show."""

    sentence: str
    known: Annotated[bool, "whether the model knows the prompt"]
    nearest: Annotated[list[str], "prompts nearby that it knows"]


class CheckedPrompt(TypedDict):
    """A prompt as it will be sampled."""

    read_as: Annotated[str | None, "text that the model reads instead; null: the prompt itself"]
    parts: list[BodyPart]
    suggested: Annotated[bool, "whether the body parts were suggested"]
    confidence: Annotated[float | None, "of the suggestion, from 0 to 1"]
    needs: Annotated[list[BodyPart], "the action needs at least one of these body parts; none: not known"]
    advice: Advice | None
    row: Annotated[int, "its track, from 0"]


class CheckedTimeline(TypedDict):
    """A timeline as it will be sampled."""

    prompts: list[CheckedPrompt]
    rows: Annotated[int, "number of tracks"]
    duration: Annotated[float, "s"]
    owners: Annotated[dict[str, list[list[Any]]], "of each body part: [index of a prompt or null, start, end]"]
    transitions: Annotated[dict[str, list[list[float]]], "of each body part: [start, end]"]
    warnings: list[str]


class MotionData(TypedDict):
    """A stored motion."""

    id: Annotated[str, "its name for other requests"]
    duration: Annotated[float, "s"]
    fps: Annotated[float, "frames per second"]
    frames: int


class StoredMotion(TypedDict):
    """The motion of an uploaded file."""

    motion: MotionData


class QueuedJob(TypedDict):
    """A job that was queued."""

    job: Annotated[str, "its name for other requests"]


class ProgressEvent(TypedDict):
    """The job has come to a step."""

    stage: Literal["waiting", "preview", "full", "film"]
    step: Annotated[int, "denoising step, or picture of a film"]
    steps: int


class Demand(TypedDict):
    """How far a motion is from a constraint."""

    name: str
    error: float
    unit: Literal["cm", "degrees"]


class MissedPrompt(TypedDict):
    """A prompt that a motion does not show, by the geometric test of its action."""

    text: str
    sentence: str


class MotionEvent(TypedDict):
    """A motion was sampled and stored."""

    seed: int
    stage: Literal["preview", "full"]
    motion: MotionData
    demands: list[Demand]
    missed: Annotated[list[MissedPrompt], "of the job's last stage; a preview before a motion is not judged"]


class FailedEvent(TypedDict):
    """The job has failed, and ended."""

    error: str


class StreamPrompt(PromptData):
    """A prompt of a stream."""

    number: Annotated[int, "by which edits name it"]


class OpenedStream(TypedDict):
    """A stream that was opened, with the skeleton of its frames."""

    stream: Annotated[str, "its name for other requests"]
    fps: Annotated[float, "frames per second"]
    joints: list[str]
    parents: Annotated[list[int], "index of the joint above; -1: the pelvis"]
    offsets: Annotated[list[list[float]], "position [x, y, z] beside the joint above at rest, m, y up"]
    prompts: list[StreamPrompt]


class StreamAnswer(TypedDict):
    """The answer to an edit: the number of the prompt and its times, or the sentence that refuses the edit."""

    added: NotRequired[int]
    moved: NotRequired[int]
    removed: NotRequired[int]
    error: NotRequired[str]
    start: NotRequired[Annotated[float, "s"]]
    end: NotRequired[Annotated[float, "s"]]
    frame: Annotated[int, "from which the edit holds"]


class FrameData(TypedDict):
    """A frame of a stream."""

    frame: Annotated[int, "its number, from 0"]
    seconds: Annotated[float, "s"]
    root: Annotated[list[float], "position [x, y, z] of the pelvis, m, z up"]
    rotations: Annotated[list[list[float]], "of each joint: a quaternion [w, x, y, z] from the joint above"]


class StreamFrames(TypedDict):
    """The next frames of a stream."""

    answers: Annotated[list[StreamAnswer], "one for each edit"]
    frames: list[FrameData]
    prompts: Annotated[list[StreamPrompt], "without those that ended long ago"]
    ended: Annotated[bool, "whether these were the last frames"]


class DocumentEntry(TypedDict):
    """A document in the list of all."""

    id: str
    name: str
    version: int
    changed: Annotated[float, "seconds since 1970"]


class DocumentList(TypedDict):
    """All readable documents, the last changed first."""

    documents: list[DocumentEntry]


class DocumentData(TypedDict):
    """A document."""

    id: str
    version: int
    content: dict[str, Any]


class SavedDocument(TypedDict):
    """The version that was saved."""

    version: int


class MappedSkeleton(TypedDict):
    """Which joint of a skeleton is which of ours."""

    joint_map: Annotated[dict[str, str], "names in the skeleton, by the names of our joints"]
    found_by: Annotated[str, "the way in which they were found"]


class CharacterJoints(MappedSkeleton):
    """Which joint of a character is which of ours, and what can be chosen."""

    corrections: Annotated[dict[str, str | None], "the stored joint map; null: the character has no such joint"]
    joints: Annotated[list[str], "our joints that a joint map may name"]
    names: Annotated[list[str], "joints of the file"]


class SkeletonMotion(MappedSkeleton):
    """A motion of a skeleton, in its own axes and unit."""

    fps: float
    frames: int
    travelling: Annotated[str, "the joint that travels"]
    places: Annotated[list[list[float]], "its position [x, y, z] in each frame"]
    turns: Annotated[
        dict[str, list[list[float]]],
        "of each joint that moves: its turn from the rest pose, along the skeleton's axes rather than its parent's, as "
        "a quaternion [w, x, y, z] in each frame; other joints follow the joints above them",
    ]


class Error(TypedDict):
    """A request that was refused."""

    error: Annotated[str, "what is wrong, in a sentence"]
    prompt: NotRequired[Annotated[int | None, "index of the prompt that is wrong"]]
    version: NotRequired[Annotated[int, "of the newer document, if it was changed elsewhere"]]
    content: NotRequired[Annotated[dict[str, Any] | None, "of the newer document"]]


class JointEntry(TypedDict):
    """A joint of the model's body."""

    name: str
    part: BodyPart


class ContentEntry(TypedDict):
    """An action that the model knows."""

    title: Annotated[str, "its plain name"]
    topic: str
    parts: list[BodyPart]
    examples: list[str]


class CharacterEntry(TypedDict):
    """A stored character."""

    id: Annotated[str, "its name for other requests"]
    name: Annotated[str, "its file's name, without the suffix"]
    formats: Annotated[list[FormatEntry], "formats of exported motions with the character"]
    corrections: Annotated[dict[str, str | None], "its stored joint map; empty: all joints are as found"]


class StoredCharacter(TypedDict):
    """The character of an uploaded file."""

    character: CharacterEntry


class CharacterList(TypedDict):
    """All characters, the last added first."""

    characters: list[CharacterEntry]


class CharacterLimits(TypedDict):
    """Files that are characters."""

    receives: Annotated[list[str], "suffixes"]
    most: Annotated[int, "largest file in bytes"]


class ExampleEntry(TypedDict):
    """A timeline to begin with."""

    name: str
    timeline: TimelineData


class LimitData(TypedDict):
    """Limits of a job."""

    duration: Annotated[float, "s"]
    prompts: int
    samples: int


class StepData(TypedDict):
    """Denoising steps of the two stages."""

    preview: int
    full: int


class ModelData(TypedDict):
    """The model, and the options of a job."""

    name: str
    version: Annotated[str, "of stmc"]
    fps: float
    longest: Annotated[float, "longest crop, in seconds"]
    overlap: Annotated[float | None, "length of a transition, in seconds"]
    parts: list[BodyPart]
    joints: list[JointEntry]
    contents: Annotated[list[ContentEntry], "actions that the model knows"]
    formats: Annotated[list[FormatEntry], "formats of exported motions"]
    receives: Annotated[list[str], "suffixes of uploaded motions"]
    characters: Annotated[CharacterLimits, "files of uploaded characters"]
    examples: list[ExampleEntry]
    limits: LimitData
    steps: StepData
    constraints: Annotated[list[dict[str, Any]], "kinds of constraints, and their fields"]
