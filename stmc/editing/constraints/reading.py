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
from stmc.io.untrusted import UnreadableError, load_json, quote, read_text
from stmc.motion.motion import Motion
from stmc.settings.records import SettingError

_MOST = 2**24
"""Bytes of a constraint file, enough for a path of a hundred thousand points."""
KINDS: tuple[type[Constraint], ...] = (Path, Heading, Keyframe, Target, Hold)
"""All kinds for JSON and the studio; the only listing."""


def constraint_of(entry: Any, find: Callable[[str], Motion] = read) -> Constraint:
    """Make a constraint from `{"kind": {its arguments}}`.

    `find` returns the motion that a keyframe names, by default from a file. Raises `SettingError` for any other object,
    and for a keyframe at a time after the end of its motion.

    Examples:
        >>> stmc.editing.constraints.constraint_of({"heading": {"angle": 1.5, "start": 2}})
        Heading(angle=1.5, start=2, end=None)
    """
    if not isinstance(entry, dict) or len(entry) != 1 or not isinstance(next(iter(entry.values())), dict):
        raise SettingError(f'constraint {quote(str(entry))}: must be {{"kind": {{...}}}}')
    [(kind, arguments)] = entry.items()
    kinds = {kind.name: kind for kind in KINDS}
    if kind not in kinds:
        raise SettingError(f"constraint {quote(kind)}: choose from {', '.join(kinds)}")
    try:
        return kinds[kind].from_json(find, **arguments)
    except TypeError as error:
        raise SettingError(f"constraint {kind}: {error}") from None


def read_constraints(path: str | File) -> list[Constraint]:
    """Read constraints from a JSON file. Raises `SettingError` with the file and the number of an invalid entry.

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
        raise SettingError(f"{path}: must be a list of constraints")
    constraints = []
    for number, entry in enumerate(entries, start=1):
        try:
            constraints.append(constraint_of(entry))
        except (SettingError, ValueError) as error:
            raise SettingError(f"{path}, constraint {number}: {error}") from None
    return constraints
