"""A request for motions: one frozen record, read from Python, a command line or JSON by the same code."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from numbers import Integral
from typing import Any

import numpy as np
from torch import Tensor

from stmc.composing import METHODS, Method, Rule, find_method
from stmc.composing.sampling import INDEPENDENT, Sampling
from stmc.editing.changes import Change
from stmc.editing.constraints import Constraint, constraint_of
from stmc.formats import READABLE
from stmc.io.untrusted import quote
from stmc.motion.motion import Motion
from stmc.motion.representation import JointsFrom
from stmc.settings.records import SettingError, check, check_name, check_value, field_infos, record_of, setting
from stmc.timeline import Prompt, Timeline

Changes = Change | Prompt | Sequence[Change | Prompt]
"""Parts of a motion to regenerate; a prompt of the timeline stands for every interval in which it owns body parts."""
Find = Callable[[str], Motion]
"""Function from a name to a motion, from a file or from a server's memory."""


@dataclass(frozen=True, kw_only=True)
class GenerateRequest:
    """Everything that, with the model, determines motions: one timeline and one seed per motion, and all settings.

    `Model.generate`, `stmc sample` and the studio make this record with `read`, and `Model.sample` takes it. `trusted`
    names packages that may be imported for `method`; only the program sets it, never a request.

    Raises:
        SettingError: If a value has the wrong type, the number of seeds or motions is not that of the timelines, or the
            method is unknown.

    Examples:
        >>> request = stmc.GenerateRequest.read({"timelines": "walk # 0 # 2", "seeds": 3, "steps": 2})
        >>> stmc.load().sample(request)
        [Motion(40 frames at 20 fps, 2.00 s)]
    """

    timelines: tuple[Timeline, ...] = setting(MISSING, "timelines, or their texts: text # start # end # body parts")
    seeds: tuple[int, ...] = setting(MISSING, "seed of the first motion of each timeline", at_least=0)
    method: str | Method | Rule = setting(
        "stmc",
        f"how crops become a motion: {', '.join(name for name in METHODS if name != INDEPENDENT)}, or mylab.rules.mine",
    )
    sampling: Sampling = setting(Sampling(), "sampling settings; open ones take the method's or the model's default")
    joints_from: JointsFrom = setting("skeleton", "source of the joints: the posed skeleton, or the features")
    keep: tuple[Motion, ...] = setting(
        (),
        f"motion to edit, {' or '.join(kind.suffix for kind in READABLE)}; "
        "only `change`, and frames after its end, are generated",
    )
    change: tuple[Change | Prompt, ...] = setting(
        (), "intervals of `keep` to regenerate: start # end # body parts, in seconds"
    )
    constraints: tuple[Constraint, ...] = setting(
        (), ".json of paths, headings, keyframes, hands and feet, for every timeline"
    )
    clean_feet: bool = setting(True, "keep standing feet in place and above the floor; false: leave them as sampled")
    trusted: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        find_method(self.method, self.trusted)
        check(self)
        count = len(self.timelines)
        if len(self.seeds) != count:
            raise SettingError(f"{len(self.seeds)} seeds for {count} timelines: each timeline needs one seed")
        if self.change and count and not self.keep:
            raise SettingError("change: pass the motion to change as keep=motion")
        if self.keep and len(self.keep) != count:
            raise SettingError(f"keep: {len(self.keep)} motions for {count} timelines: pass one for all, or one each")

    @classmethod
    def read(cls, values: Mapping[str, Any], find: Find | None = None, trusted: Sequence[str] = ()) -> GenerateRequest:
        """Make the record from arguments in Python, a command line's settings or the values of a JSON object.

        Args:
            values: Fields of this record and of `Sampling` by name. A timeline may also be a text or a JSON object;
                `seeds` is one number, the first of consecutive seeds, or one per timeline; `keep` is a motion or its
                name, or one per timeline; a change may also be "start # end # body parts" or an object of its fields; a
                constraint may also be an object `{"kind": {...}}`.
            find: Function that finds motions by the names in `keep` and in keyframes; None: `keep` takes no names.
            trusted: Packages that may be imported for `method`.

        Raises:
            SettingError: For an unknown name, with the nearest valid one, and for an invalid value.
            TimelineError: If a text is not a timeline.

        Examples:
            >>> values = {"timelines": "walk # 0 # 2", "constraints": [{"heading": {"angle": 1.5}}], "guidance": 3}
            >>> request = stmc.GenerateRequest.read(values)
            >>> request.constraints, dict(request.sampling.given)
            ((Heading(angle=1.5, start=0.0, end=None),), {'guidance': 3})
        """
        for name in values:
            check_name(name, names())
        sampling = {name: value for name, value in values.items() if name in field_infos(Sampling)}
        arguments = {name: value for name, value in values.items() if name not in sampling}
        timelines = _read_timelines(arguments.get("timelines"))
        keep = _read_keep(arguments.get("keep"), len(timelines), find)
        change = tuple(map(_read_change, _as_list(arguments.get("change"))))
        constraints = tuple(_read_constraint(item, find) for item in _as_list(arguments.get("constraints")))
        seeds = _read_seeds(arguments.get("seeds", 0), len(timelines))
        arguments |= {"timelines": timelines, "seeds": seeds, "keep": keep, "change": change}
        arguments |= {"constraints": constraints, "sampling": record_of(Sampling, sampling), "trusted": tuple(trusted)}
        return record_of(cls, arguments)

    @property
    def resolved_method(self) -> Method:
        """The `Method` that `method` names or stands for."""
        return find_method(self.method, self.trusted)

    def split(self) -> list[GenerateRequest]:
        """Return a request for each motion.

        Examples:
            >>> two = stmc.GenerateRequest.read({"timelines": ["walk # 0 # 2", "run # 0 # 1"], "seeds": 4})
            >>> [request.seeds for request in two.split()]
            [(4,), (5,)]
        """
        keeps: Sequence[tuple[Motion, ...]] = [(motion,) for motion in self.keep] or [()] * len(self.timelines)
        return [
            replace(self, timelines=(timeline,), seeds=(seed,), keep=keep)
            for timeline, seed, keep in zip(self.timelines, self.seeds, keeps, strict=True)
        ]

    @staticmethod
    def joined(requests: Sequence[GenerateRequest]) -> GenerateRequest:
        """Join requests that differ only in their motions, such as parts of one `split`.

        Examples:
            >>> two = stmc.GenerateRequest.read({"timelines": ["walk # 0 # 2", "run # 0 # 1"], "seeds": 4})
            >>> stmc.GenerateRequest.joined(two.split()) == two
            True
        """
        items: dict[str, Any] = {
            name: tuple(item for request in requests for item in getattr(request, name)) for name in _PER_MOTION
        }
        return replace(requests[0], **items)

    def decides(self) -> dict[str, Any]:
        """Return every value that determines the motion of a request for one motion, as JSON values.

        Motions and constraints are digests. The record beside a file holds these values: the file is up to date if a
        request has the same. Open, false and empty fields are omitted, as is `joints_from` if it is "skeleton".

        Raises:
            SettingError: For a request for several motions, and for a function that no module and name identify.

        Examples:
            >>> stmc.GenerateRequest.read({"timelines": "walk # 0 # 2", "seeds": 3, "steps": 2}).decides()
            {'prompts': [['walk', 0.0, 2.0, []]], 'seed': 3, 'method': 'stmc', 'clean_feet': True, 'steps': 2}
        """
        if len(self.timelines) != 1:
            raise SettingError(f"{len(self.timelines)} timelines: call `split` for one request per motion")
        values = {name: getattr(self, name) for name in field_infos(GenerateRequest)}
        [timeline], [seed], sampling = values.pop("timelines"), values.pop("seeds"), values.pop("sampling")
        data = {"prompts": prompts_of(timeline), "seed": seed}
        data |= {name: _digest(value) if name in _LARGE and value else _plain(value) for name, value in values.items()}
        data |= {name: _plain(value) for name, value in sampling.given.items()}
        if self.joints_from == "skeleton":  # records from before this field existed lack it
            del data["joints_from"]
        return {name: value for name, value in data.items() if value is not None and value is not False and value != []}


_PER_MOTION = ("timelines", "seeds", "keep")
"""Fields with one item per motion."""
_LARGE = ("keep", "constraints")
"""Fields that records hold as digests."""


def names() -> list[str]:
    """Return all names that `GenerateRequest.read` takes."""
    return [*(name for name in field_infos(GenerateRequest) if name != "sampling"), *field_infos(Sampling)]


def prompts_of(timeline: Timeline) -> list[list]:
    """Return the prompts of a timeline in the form of records."""
    return [[prompt.text, prompt.start, prompt.end, sorted(prompt.parts)] for prompt in timeline.prompts]


def _as_list(values: Any) -> list[Any]:
    """Return one or several values as a list; None gives an empty list."""
    if values is None:
        return []
    return list(values) if isinstance(values, Iterable) and not isinstance(values, (str, Mapping)) else [values]


def _read_timelines(timelines: Any) -> tuple[Timeline, ...]:
    return tuple(map(_read_timeline, [None] if timelines is None else _as_list(timelines)))


def _read_timeline(value: Any) -> Timeline:
    if isinstance(value, Mapping):
        return Timeline.parse(json.dumps(value), ".json")
    if isinstance(value, str):
        return Timeline.parse(value)
    if not isinstance(value, Timeline):
        raise SettingError(f"timelines={quote(value)}: must be a Timeline or its text")
    return value


def _read_seeds(seed: Any, count: int) -> tuple[int, ...]:
    several = isinstance(seed, Iterable) and not isinstance(seed, (str, bytes, Mapping))
    seeds = [int(value) if _is_whole(value) else value for value in (seed if several else [seed])]
    for value in seeds:
        check_value("seed", value, int, field_infos(GenerateRequest)["seeds"])
    return tuple(seeds if several else range(seeds[0], seeds[0] + count))


def _is_whole(value: Any) -> bool:
    return isinstance(value, Integral) and not isinstance(value, bool)


def _read_keep(keep: Any, count: int, find: Find | None) -> tuple[Motion, ...]:
    several = isinstance(keep, Sequence) and not isinstance(keep, str)
    motions = [find(item) if find and isinstance(item, str) else item for item in (keep if several else [keep])]
    if keep is None:
        return ()
    if not all(isinstance(motion, Motion) for motion in motions):
        raise SettingError(f"keep={quote(keep)}: must be a motion, or one per timeline; read files with stmc.read")
    return tuple(motions if several else motions * count)


def _read_change(value: Any) -> Change | Prompt:
    if isinstance(value, str):
        return Change.parse(value)
    if isinstance(value, Mapping):
        parts = value.get("parts", ())
        check_value("parts", tuple(parts) if isinstance(parts, list) else parts, tuple[str, ...])
        return record_of(Change, value)
    if not isinstance(value, (Change, Prompt)):
        raise SettingError(f"change={quote(value)}: must be start # end # body parts, in seconds")
    return value


def _read_constraint(value: Any, find: Find | None) -> Constraint:
    if isinstance(value, Constraint):
        return value
    return constraint_of(value) if find is None else constraint_of(value, find)


def _plain(value: Any) -> Any:
    """Convert a value to JSON values: arrays to digests, functions to their names."""
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, (Tensor, np.ndarray)):
        array = np.ascontiguousarray(value.cpu() if isinstance(value, Tensor) else value)
        return [*array.shape, str(array.dtype), hashlib.sha256(array.tobytes()).hexdigest()]
    if isinstance(value, Method):
        return next((name for name, method in METHODS.items() if method is value), None) or _plain(value.sample)
    if is_dataclass(value):
        return {field.name: _plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, (frozenset, set)):
        return sorted(map(_plain, value))
    if isinstance(value, (tuple, list)):
        return [_plain(item) for item in value]
    name = f"{getattr(value, '__module__', '')}.{getattr(value, '__qualname__', '<nameless>')}"
    if "<" in name:
        raise SettingError(f"{quote(str(value))} cannot be recorded: use a function of a module, or a dataclass")
    return name


def _digest(values: Sequence[Any]) -> str:
    """Return a digest that identifies these values."""
    data = [[type(value).__name__, _plain(value)] for value in values]
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:16]
