"""A request for motions: one frozen record, read from Python, a command line or JSON by the same code.

Knows timelines, methods, the settings of sampling, kept motions and constraints; knows no model and no file.
"""

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
from stmc.io.untrusted import shown
from stmc.motion.motion import Motion
from stmc.motion.representation import JointsFrom
from stmc.settings.records import SettingError, about, check, check_name, check_value, record_of, setting
from stmc.timeline import Prompt, Timeline

Changes = Change | Prompt | Sequence[Change | Prompt]
"""Parts of a motion to regenerate; a prompt of the timeline stands for all that it decides."""

Find = Callable[[str], Motion]
"""Return the motion of a name: a file's, or one that a server has."""


@dataclass(frozen=True, kw_only=True)
class GenerateRequest:
    """Everything that decides motions beside the model: one timeline and one seed for each of them.

    `Model.generate`, `stmc sample` and the studio make this record with `read`, and `Model.sample` takes it. `trusted`
    names packages that may be imported for `method`; a program says which, and no request can.

    Raises:
        SettingError: For a value of another type, another number of seeds or motions than timelines, an unknown method.

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
    sampling: Sampling = setting(Sampling(), "settings of sampling; open ones are the method's or the model's")
    joints_from: JointsFrom = setting("skeleton", "source of the joints: the posed skeleton, or the features")
    keep: tuple[Motion, ...] = setting(
        (),
        f"motion to edit, {' or '.join(each.suffix for each in READABLE)}; "
        "only `change`, and frames behind its end, are generated",
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
            raise SettingError(f"{len(self.seeds)} seeds for {count} timelines: each needs one")
        if self.change and count and not self.keep:
            raise SettingError("change: of which motion? keep=motion says it")
        if self.keep and len(self.keep) != count:
            raise SettingError(f"keep: {len(self.keep)} motions for {count} timelines: one for all, or one for each")

    @classmethod
    def read(cls, values: Mapping[str, Any], find: Find | None = None, trusted: Sequence[str] = ()) -> GenerateRequest:
        """Make the record from arguments in Python, a command line's settings or the values of a JSON object.

        Args:
            values: Fields of this record and of `Sampling` by name, in any of their forms. A timeline is one, its text
                or its JSON object; `seeds` one number, from which they count up, or one for each timeline; `keep` a
                motion, its name, or one for each timeline; a change is one, "start # end # body parts", or an object of
                its fields; a constraint is one, or an object `{"kind": {...}}`.
            find: Return the motion of a name, in `keep` and in keyframes; None: `keep` takes no names.
            trusted: Packages that may be imported for `method`.

        Raises:
            SettingError: For an unknown name, with the nearest known one, and for a value that does not fit.
            TimelineError: For a text that is no timeline.

        Examples:
            >>> values = {"timelines": "walk # 0 # 2", "constraints": [{"heading": {"angle": 1.5}}], "guidance": 3}
            >>> request = stmc.GenerateRequest.read(values)
            >>> request.constraints, dict(request.sampling.given)
            ((Heading(angle=1.5, start=0.0, end=None),), {'guidance': 3})
        """
        for name in values:
            check_name(name, names())
        sampling = {name: value for name, value in values.items() if name in about(Sampling)}
        own = {name: value for name, value in values.items() if name not in sampling}
        own["timelines"] = _timelines(own.get("timelines"))
        own["seeds"] = _seeds(own.get("seeds", 0), len(own["timelines"]))
        own["keep"] = _kept(own.get("keep"), len(own["timelines"]), find)
        own["change"] = tuple(map(_change, _several(own.get("change"))))
        own["constraints"] = tuple(_constraint(each, find) for each in _several(own.get("constraints")))
        return record_of(cls, own | {"sampling": record_of(Sampling, sampling), "trusted": tuple(trusted)})

    @property
    def resolved_method(self) -> Method:
        """The method itself, where `method` is its name or a rule."""
        return find_method(self.method, self.trusted)

    def split(self) -> list[GenerateRequest]:
        """Return a request for each motion.

        Examples:
            >>> two = stmc.GenerateRequest.read({"timelines": ["walk # 0 # 2", "run # 0 # 1"], "seeds": 4})
            >>> [each.seeds for each in two.split()]
            [(4,), (5,)]
        """
        keeps = [(motion,) for motion in self.keep] or [()] * len(self.timelines)
        return [
            replace(self, timelines=(timeline,), seeds=(seed,), keep=keep)
            for timeline, seed, keep in zip(self.timelines, self.seeds, keeps, strict=True)
        ]

    @staticmethod
    def joined(requests: Sequence[GenerateRequest]) -> GenerateRequest:
        """Return one request for the motions of several that are otherwise alike, such as parts of one `split`.

        Examples:
            >>> two = stmc.GenerateRequest.read({"timelines": ["walk # 0 # 2", "run # 0 # 1"], "seeds": 4})
            >>> stmc.GenerateRequest.joined(two.split()) == two
            True
        """
        several = {name: tuple(item for each in requests for item in getattr(each, name)) for name in _EACH}
        return replace(requests[0], **several)

    def decides(self) -> dict[str, Any]:
        """Return, as JSON has it, all that decides the motion of a request for one; motions and constraints as digests.

        It stands in the record beside a file, which is up to date if a request decides the same. Every field is in it;
        absent is what is open, false or empty, and joints of the skeleton.

        Raises:
            SettingError: For a request of several motions, and for a function without a name by which it is found.

        Examples:
            >>> stmc.GenerateRequest.read({"timelines": "walk # 0 # 2", "seeds": 3, "steps": 2}).decides()
            {'prompts': [['walk', 0.0, 2.0, []]], 'seed': 3, 'method': 'stmc', 'clean_feet': True, 'steps': 2}
        """
        if len(self.timelines) != 1:
            raise SettingError(f"{len(self.timelines)} timelines: `split` gives a request for each")
        values = {name: getattr(self, name) for name in about(GenerateRequest)}
        [timeline], [seed], sampling = values.pop("timelines"), values.pop("seeds"), values.pop("sampling")
        data = {"prompts": prompts_of(timeline), "seed": seed}
        data |= {name: _digest(value) if name in _LARGE and value else _plain(value) for name, value in values.items()}
        data |= {name: _plain(value) for name, value in sampling.given.items()}
        if self.joints_from == "skeleton":  # records of before it was a field say nothing of it
            del data["joints_from"]
        return {name: value for name, value in data.items() if value is not None and value is not False and value != []}


_EACH = ("timelines", "seeds", "keep")
"""Fields with an item for each motion."""

_LARGE = ("keep", "constraints")
"""Fields that a record holds as a digest."""


def names() -> list[str]:
    """Return the names of everything that can be asked for, as `GenerateRequest.read` takes them."""
    return [*(name for name in about(GenerateRequest) if name != "sampling"), *about(Sampling)]


def prompts_of(timeline: Timeline) -> list[list]:
    """Return the prompts of a timeline as records have them."""
    return [[prompt.text, prompt.start, prompt.end, sorted(prompt.parts)] for prompt in timeline.prompts]


def _several(values: Any) -> list[Any]:
    """Return one value, or several, as a list; None is none."""
    if values is None:
        return []
    return list(values) if isinstance(values, Iterable) and not isinstance(values, (str, Mapping)) else [values]


def _timelines(timelines: Any) -> tuple[Timeline, ...]:
    return tuple(map(_timeline, [None] if timelines is None else _several(timelines)))


def _timeline(value: Any) -> Timeline:
    if isinstance(value, Mapping):
        return Timeline.parse(json.dumps(value), ".json")
    if isinstance(value, str):
        return Timeline.parse(value)
    if not isinstance(value, Timeline):
        raise SettingError(f"timelines={shown(value)}: a Timeline needed, or its text")
    return value


def _seeds(seed: Any, count: int) -> tuple[int, ...]:
    several = isinstance(seed, Iterable) and not isinstance(seed, (str, bytes, Mapping))
    seeds = [int(each) if _is_whole(each) else each for each in (seed if several else [seed])]
    for each in seeds:
        check_value("seed", each, int, about(GenerateRequest)["seeds"])
    return tuple(seeds if several else range(seeds[0], seeds[0] + count))


def _is_whole(value: Any) -> bool:
    return isinstance(value, Integral) and not isinstance(value, bool)


def _kept(keep: Any, count: int, find: Find | None) -> tuple[Motion, ...]:
    several = isinstance(keep, Sequence) and not isinstance(keep, str)
    motions = [find(each) if find and isinstance(each, str) else each for each in (keep if several else [keep])]
    if keep is None:
        return ()
    if not all(isinstance(motion, Motion) for motion in motions):
        raise SettingError(f"keep={shown(keep)}: a motion needed, or one for each timeline: stmc.read reads a file's")
    return tuple(motions if several else motions * count)


def _change(value: Any) -> Change | Prompt:
    if isinstance(value, str):
        return Change.parse(value)
    if isinstance(value, Mapping):
        parts = value.get("parts", ())
        check_value("parts", tuple(parts) if isinstance(parts, list) else parts, tuple[str, ...])
        return record_of(Change, value)
    if not isinstance(value, (Change, Prompt)):
        raise SettingError(f"change={shown(value)}: start # end # body parts needed, in seconds")
    return value


def _constraint(value: Any, find: Find | None) -> Constraint:
    if isinstance(value, Constraint):
        return value
    return constraint_of(value) if find is None else constraint_of(value, find)


def _plain(value: Any) -> Any:
    """Return a value as JSON has it; arrays as digests, functions by their names."""
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, (Tensor, np.ndarray)):
        array = np.ascontiguousarray(value.cpu() if isinstance(value, Tensor) else value)
        return [*array.shape, str(array.dtype), hashlib.sha256(array.tobytes()).hexdigest()]
    if isinstance(value, Method):
        return next((name for name, each in METHODS.items() if each is value), None) or _plain(value.sample)
    if is_dataclass(value):
        return {each.name: _plain(getattr(value, each.name)) for each in fields(value)}
    if isinstance(value, (frozenset, set)):
        return sorted(map(_plain, value))
    if isinstance(value, (tuple, list)):
        return [_plain(each) for each in value]
    name = f"{getattr(value, '__module__', '')}.{getattr(value, '__qualname__', '<nameless>')}"
    if "<" in name:
        raise SettingError(f"{shown(str(value))} cannot be recorded: a function of a module, or a dataclass, is needed")
    return name


def _digest(values: Sequence[Any]) -> str:
    """Return a text that tells these values from others."""
    data = [[type(value).__name__, _plain(value)] for value in values]
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:16]
