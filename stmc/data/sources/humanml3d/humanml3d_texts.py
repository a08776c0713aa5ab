"""HumanML3D's free files: what people wrote about each clip, and which seconds of which recording a clip is.

Knows `texts/` and `index.csv`; knows no features, no recording and no split.
"""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path

from stmc.io.untrusted import cut, read_lines, shown

INDEX_FPS = 20
"""Frames per second that `index.csv` counts in."""

MOST_INDEX = 10**7
"""The last frame that `index.csv` may name."""

WHOLE = (0.0, 0.0)
"""Start and end of a caption that describes its whole clip."""

LEAD_INS = {
    "Eyes_Japan_Dataset": 3.0,
    "MPI_HDM05": 3.0,
    "TotalCapture": 1.0,
    "MPI_Limits": 1.0,
    "Transitions_mocap": 0.5,
}
"""Seconds at the beginning of every recording of these data sets that HumanML3D drops before it counts (people standing
with their arms spread; `raw_pose_processing` of its code). CMU's begin at their first frame."""

COLUMNS = ("source_path", "start_frame", "end_frame", "new_name")


@dataclass(frozen=True)
class Caption:
    """What somebody wrote about a clip, or about `start` to `end` seconds of it (`WHOLE`: all of it); `tagged`: its
    words with their parts of speech."""

    text: str
    start: float
    end: float
    tagged: str = ""


@dataclass(frozen=True)
class Cut:
    """A clip: `start` to `end` seconds of the recording at AMASS's `path`, without suffix; `end` None: to its end."""

    path: str
    start: float
    end: float | None


def read_captions(path: Path) -> list[Caption | str]:
    """Every line of a file of `texts/`: a caption, or what is wrong with it.

    A line is `caption#caption/DET tagged/VERB#start#end`; a time of `nan` is 0, as published.
    """
    lines = enumerate(read_lines(path), start=1)
    return [_caption(line, number) for number, line in lines if line.strip()]


def _caption(line: str, number: int) -> Caption | str:
    text, *others = line.split("#")
    times = [_seconds(value) for value in others[1:]]
    if len(others) != 3 or None in times or not text.strip():
        return f"malformed caption: line {number} is not caption#tagged words#start#end but {shown(line, 80)}"
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
    """Every clip of `index.csv` by its name: which seconds of which recording it is, or what is wrong with its row.

    Raises `ValueError` for a file with other columns.
    """
    rows = csv.DictReader(read_lines(path))
    try:
        if tuple(rows.fieldnames or ()) != COLUMNS:
            has = cut(", ".join(rows.fieldnames or ()), 80)
            raise ValueError(f"{path}: its columns should be {', '.join(COLUMNS)}, not {has}")
        return {str(row["new_name"]).removesuffix(".npy"): _cut(row) for row in rows}
    except csv.Error as error:
        raise ValueError(f"{path}: not a table ({error})") from error


def _cut(row: dict[str, str]) -> Cut | str:
    try:
        first, last = int(row["start_frame"]), int(row["end_frame"])
    except (TypeError, ValueError):
        return f"malformed index: frames {shown(row['start_frame'])} to {shown(row['end_frame'])}"
    if not 0 <= first <= MOST_INDEX or not (last == -1 or first < last <= MOST_INDEX):
        return f"malformed index: frames {shown(first)} to {shown(last)}"
    path = row["source_path"].replace("\\", "/").removeprefix("./").removeprefix("pose_data/").removesuffix(".npy")
    begins = LEAD_INS.get(path.partition("/")[0], 0.0)
    return Cut(path, begins + first / INDEX_FPS, None if last == -1 else begins + last / INDEX_FPS)
