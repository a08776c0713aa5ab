"""HumanML3D's free files: captions of the clips, and the seconds of recordings that clips consist of."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path

from stmc.io.untrusted import quote, read_lines, truncate

INDEX_FPS = 20
"""Frame rate of `index.csv`."""
MOST_INDEX = 10**7
"""Maximum frame in `index.csv`."""
WHOLE = (0.0, 0.0)
"""Start and end of a caption that describes its whole clip."""

LEAD_INS = {
    "Eyes_Japan_Dataset": 3.0,
    "MPI_HDM05": 3.0,
    "TotalCapture": 1.0,
    "MPI_Limits": 1.0,
    "Transitions_mocap": 0.5,
}
"""Seconds that HumanML3D drops at the beginning of every recording of these data sets before it counts frames (people
standing with their arms spread; `raw_pose_processing` of its code). CMU's begin at their first frame."""

COLUMNS = ("source_path", "start_frame", "end_frame", "new_name")


@dataclass(frozen=True)
class Caption:
    """A description of a clip, or of `start` to `end` seconds of it (`WHOLE`: all of it).

    `tagged` holds its words with their parts of speech.
    """

    text: str
    start: float
    end: float
    tagged: str = ""


@dataclass(frozen=True)
class Cut:
    """A clip: `start` to `end` seconds of the recording at AMASS's `path`, without suffix.

    An `end` of None is the end of the recording.
    """

    path: str
    start: float
    end: float | None


def read_captions(path: Path) -> list[Caption | str]:
    """Read every line of a file of `texts/`: a caption, or the problem of the line.

    A line is `caption#caption/DET tagged/VERB#start#end`; a time of `nan` is 0, as published.
    """
    lines = enumerate(read_lines(path), start=1)
    return [_caption(line, number) for number, line in lines if line.strip()]


def _caption(line: str, number: int) -> Caption | str:
    text, *others = line.split("#")
    times = [seconds for value in others[1:] if (seconds := _seconds(value)) is not None]
    if len(others) != 3 or len(times) != 2 or not text.strip():
        return f"malformed caption: line {number} must be caption#tagged words#start#end, not {quote(line, 80)}"
    start, end = times
    if (start, end) != WHOLE and not 0 <= start < end < math.inf:
        return f"malformed caption: line {number} is from {start:g} to {end:g} s"
    return Caption(" ".join(text.split()), start, end, others[0].strip())


def _seconds(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return 0.0 if math.isnan(value) else value


def read_index(path: Path) -> dict[str, Cut | str]:
    """Read every clip of `index.csv` by name: the seconds of a recording, or the problem of its row.

    Raises `ValueError` if the file has other columns.
    """
    rows = csv.DictReader(read_lines(path))
    try:
        if tuple(rows.fieldnames or ()) != COLUMNS:
            columns = truncate(", ".join(rows.fieldnames or ()), 80)
            raise ValueError(f"{path}: its columns must be {', '.join(COLUMNS)}, not {columns}")
        return {str(row["new_name"]).removesuffix(".npy"): _cut(row) for row in rows}
    except csv.Error as error:
        raise ValueError(f"{path}: not a table ({error})") from error


def _cut(row: dict[str, str]) -> Cut | str:
    try:
        first, last = int(row["start_frame"]), int(row["end_frame"])
    except (TypeError, ValueError):
        return f"malformed index: frames {quote(row['start_frame'])} to {quote(row['end_frame'])}"
    if not 0 <= first <= MOST_INDEX or not (last == -1 or first < last <= MOST_INDEX):
        return f"malformed index: frames {quote(first)} to {quote(last)}"
    path = row["source_path"].replace("\\", "/").removeprefix("./").removeprefix("pose_data/").removesuffix(".npy")
    begins = LEAD_INS.get(path.partition("/")[0], 0.0)
    return Cut(path, begins + first / INDEX_FPS, None if last == -1 else begins + last / INDEX_FPS)
