"""Constraints as JSON, beside a timeline: `[{"path": {"points": [[0, 0], [0, -3]], "end": 4}}, …]`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path as File
from typing import Any

from stmc.editing.constraints.constraint import Constraint
from stmc.editing.constraints.limbs import Hold, Target
from stmc.editing.constraints.root import Heading, Path
from stmc.editing.constraints.whole_body import Keyframe
from stmc.formats import read
from stmc.io.untrusted import UnreadableError, load_json, read_text, shown
from stmc.motion.motion import Motion
from stmc.settings.records import SettingError

_MOST = 2**24
"""Bytes of a file of constraints: a path of a hundred thousand points fits."""

KINDS: tuple[type[Constraint], ...] = (Path, Heading, Keyframe, Target, Hold)
"""Every kind that JSON and the studio know; the only listing."""


def constraint_of(entry: Any, find: Callable[[str], Motion] = read) -> Constraint:
    """One of `{"kind": {its arguments}}`; `find` says which motion it is that a keyframe names: a file's. Raises
    `SettingError` for anything else, and for a keyframe at a second that its motion does not have.

    Examples:
        >>> stmc.editing.constraints.constraint_of({"heading": {"angle": 1.5, "start": 2}})
        Heading(angle=1.5, start=2, end=None)
    """
    if not isinstance(entry, dict) or len(entry) != 1 or not isinstance(next(iter(entry.values())), dict):
        raise SettingError(f'constraint {shown(str(entry))}: {{"kind": {{...}}}} needed')
    [(kind, arguments)] = entry.items()
    kinds = {each.name: each for each in KINDS}
    if kind not in kinds:
        raise SettingError(f"constraint {shown(kind)}: choose from {', '.join(kinds)}")
    try:
        return kinds[kind].from_json(find, **arguments)
    except TypeError as error:
        raise SettingError(f"constraint {kind}: {error}") from None


def read_constraints(path: str | File) -> list[Constraint]:
    """Those of a JSON file. Raises `SettingError` naming the file, and the number of the entry that is not one.

    Examples:
        >>> from pathlib import Path
        >>> _ = Path("reach.json").write_text('[{"hold": {"joint": "left_hand", "start": 1, "end": 2}}]')
        >>> stmc.read_constraints("reach.json")
        [Hold(joint='left_hand', start=1, end=2)]
    """
    try:
        entries = load_json(read_text(File(path), _MOST))
    except (OSError, UnreadableError) as error:
        raise SettingError(f"{path}: {error}") from None
    if not isinstance(entries, list):
        raise SettingError(f"{path}: a list of constraints needed")
    constraints = []
    for number, entry in enumerate(entries, start=1):
        try:
            constraints.append(constraint_of(entry))
        except (SettingError, ValueError) as error:
            raise SettingError(f"{path}, constraint {number}: {error}") from None
    return constraints
