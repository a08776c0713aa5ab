"""Objects from plain descriptions: the name of a class as `_target_`, and its arguments.

Descriptions are untrusted. A name is looked up among the classes that one package of this library exports, or imported
from a package that the caller trusts; arguments are checked against the constructor's signature.
"""

from __future__ import annotations

import functools
import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from types import UnionType
from typing import Any, NamedTuple, Union, get_args, get_origin, get_type_hints

from stmc.io.extras import missing_extra
from stmc.run.configs import PARTIAL, TARGET, RunError, brief
from stmc.settings.records import SettingError, check_value, quote

_TARGET = re.compile(r"[A-Za-z]\w*(\.[A-Za-z]\w*)+", re.ASCII)


class Part(NamedTuple):
    """The legal values of a part of a config: classes of the package `home`, or of a trusted package, of a `kind`.

    A configuration, which a command composes, may also name classes and functions of the table `names`, partial ones
    among them (`_partial_: true`), and paths in the file system; a run directory may not.
    """

    home: str
    kind: type
    names: tuple[str, ...] = ()


class _Constructor(NamedTuple):
    target: str
    call: Callable[..., Any]
    lenient: bool
    """True for a trusted package or a table of names: annotations may be more than types, and arguments may be paths.
    """


def construct(description: Any, place: str, part: Part, trusted: Sequence[str] = ()) -> Any:
    """Build the object that `_target_` and arguments describe.

    Args:
        description: The description.
        place: Its path in the config, for messages.
        part: The legal values.
        trusted: Packages whose classes are also legal.

    Raises:
        RunError: If the class is neither of the part's home nor of a trusted package, or arguments do not fit.
    """
    if not isinstance(description, Mapping) or TARGET not in description:
        raise RunError(f"{place} must name the class to build as `{TARGET}`; got {quote(description)}")
    constructor = _constructor(description[TARGET], place, part, trusted)
    partial = bool(part.names) and description.get(PARTIAL) is True
    settings = {name: value for name, value in description.items() if name not in (TARGET, PARTIAL)}
    arguments = _arguments(constructor, settings, place, part, trusted, partial)
    if partial:
        return functools.partial(constructor.call, **arguments)
    try:
        result = constructor.call(**arguments)
    except Exception as error:  # a constructor may raise any exception
        ours = type(error).__module__.startswith("stmc.") and not isinstance(error, SettingError)
        if part.names and (isinstance(error, (OSError, ImportError)) or ours):
            raise
        raise RunError(f"{place} cannot be built: {brief(error)}") from error
    if not isinstance(result, part.kind):
        raise RunError(f"{place}: {constructor.target} builds a {type(result).__name__}, not a {part.kind.__name__}")
    return result


def is_from_library(description: Mapping[str, Any], part: Part) -> bool:
    """Return whether a description names a class of this library."""
    return isinstance(description.get(TARGET), str) and description[TARGET] in _exported(part.home)


def signature_of(description: Mapping[str, Any], place: str, part: Part, trusted: Sequence[str]) -> inspect.Signature:
    """Return the signature of the constructor that a description names.

    Args:
        description: The description.
        place: Its path in the config, for messages.
        part: The legal values.
        trusted: Packages whose classes are also legal.

    Raises:
        RunError: As `construct`.
    """
    return inspect.signature(_constructor(description.get(TARGET), place, part, trusted).call)


def _constructor(target: Any, place: str, part: Part, trusted: Sequence[str]) -> _Constructor:
    exported = _exported(part.home)
    if isinstance(target, str) and target in exported:
        return _Constructor(target, exported[target], bool(part.names))
    if isinstance(target, str) and target in part.names:
        return _Constructor(target, _resolve_name(target), True)
    packages = _packages(trusted)
    if isinstance(target, str) and _TARGET.fullmatch(target) and target.startswith(packages):
        return _Constructor(target, _import_trusted(target, place, packages, bool(part.names)), True)
    hint = f"; name your own package as trusted: {_TRUST}" if not packages else ""
    kind = "a legal target of this configuration" if part.names else f"a class of {part.home}"
    raise RunError(f"{place}: {quote(target)} is not {kind}{hint}")


_TRUST = 'trusted=("mylab",)'


def _packages(trusted: Sequence[str]) -> tuple[str, ...]:
    """Return the prefixes of trusted names."""
    names = (trusted,) if isinstance(trusted, str) else tuple(trusted)
    for name in names:
        if not isinstance(name, str) or not _TARGET.fullmatch(f"{name}.x"):
            raise RunError(f"trusted: {quote(name)} is not the name of a package, as in {_TRUST}")
    return tuple(f"{name}." for name in names)


@functools.cache
def _exported(home: str) -> Mapping[str, Callable[..., Any]]:
    """Map the names that configs use to the classes that a package exports and defines, and to their constructors.

    Examples of names are `stmc.diffusion.Schedule.cosine` and `stmc.diffusion.schedule.Schedule.cosine`.
    """
    package, targets = import_module(home), {}
    for name in package.__all__:
        value = getattr(package, name)
        if inspect.isclass(value) and _is_within(value, (f"{home}.",)):
            for target in (f"{home}.{name}", f"{value.__module__}.{value.__qualname__}"):
                targets[target] = value
                targets |= {f"{target}.{method}": getattr(value, method) for method in _class_methods(value)}
    return targets


def _resolve_name(target: str) -> Callable[..., Any]:
    """Return a class, a function or a class's constructor of this library."""
    names = target.split(".")
    for count in range(len(names) - 1, 0, -1):
        module = _module(".".join(names[:count]), target)
        if module is not None:
            return functools.reduce(getattr, names[count:], module)
    raise RunError(f"{target} does not exist")


def _import_trusted(target: str, place: str, packages: tuple[str, ...], functions: bool) -> Callable[..., Any]:
    """Import a class of a trusted package, a constructor of such a class, or one of its `functions`."""
    names = target.split(".")
    for count in (1, 2):  # number of names after the module: the class, and perhaps its constructor
        module = _module(".".join(names[:-count]), place)
        value = getattr(module, names[-count], None)
        if count == 1 and functions and inspect.isfunction(value) and f"{value.__module__}.".startswith(packages):
            return value
        if inspect.isclass(value) and _is_within(value, packages):
            if count == 1:
                return value
            if names[-1] in _class_methods(value):
                return getattr(value, names[-1])
    raise RunError(f"{place}: {quote(target)} is not a class that {' or '.join(packages).replace('.', '')} defines")


def _module(name: str, place: str) -> Any:
    """Import a module, or return None if it does not exist."""
    try:
        return import_module(name) if name else None
    except ModuleNotFoundError as error:
        if error.name is not None and f"{name}.".startswith(f"{error.name}."):
            return None
        raise RunError(f"{place}: {name} cannot be imported: {missing_extra(error) or brief(error)}") from error
    except Exception as error:  # a module may raise any exception
        raise RunError(f"{place}: {name} cannot be imported: {brief(error)}") from error


def _is_within(value: type, packages: tuple[str, ...]) -> bool:
    return f"{value.__module__}.".startswith(packages)


def _class_methods(value: type) -> list[str]:
    return [name for name, method in vars(value).items() if isinstance(method, classmethod) and name[0] != "_"]


def _arguments(
    constructor: _Constructor,
    settings: Mapping[str, Any],
    place: str,
    part: Part,
    trusted: Sequence[str],
    partial: bool,
) -> dict[str, Any]:
    """Check arguments against the annotated types, and build nested descriptions."""
    parameters = inspect.signature(constructor.call).parameters
    kinds = {parameter.kind for parameter in parameters.values()}
    if inspect.Parameter.VAR_KEYWORD not in kinds:
        for name in settings:
            if name not in parameters:
                choices = ", ".join(parameters) or "none"
                raise RunError(f"{place}.{name}: {constructor.target} has no such argument; it has {choices}")
        required = [name for name, argument in parameters.items() if argument.default is argument.empty]
        missing = [name for name in required if name not in settings]
        if missing and not partial and inspect.Parameter.VAR_POSITIONAL not in kinds:
            raise RunError(f"{place}: {constructor.target} needs {', '.join(missing)}")
    hints = _hints(constructor)
    return {
        name: _argument(value, hints.get(name, Any), f"{place}.{name}", part, constructor, trusted)
        for name, value in settings.items()
    }


def _argument(value: Any, hint: Any, place: str, part: Part, constructor: _Constructor, trusted: Sequence[str]) -> Any:
    kinds = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    if isinstance(value, Mapping) and TARGET in value:
        inner = next((kind for kind in kinds if isinstance(kind, type) and kind.__module__ != "builtins"), object)
        value = construct(value, place, part._replace(kind=inner), trusted)
    if Path in kinds and not constructor.lenient:
        raise RunError(f"{place}: a config must not name paths in the file system")
    if Path in kinds and isinstance(value, str):
        value = Path(value)
    if isinstance(value, list) and any(get_origin(kind) is tuple for kind in kinds):
        value = tuple(value)
    try:
        if hint is not Any:
            check_value(place, value, hint)
    except SettingError as error:
        raise RunError(str(error)) from error
    except TypeError:  # the annotation is more than a type
        if not constructor.lenient:
            raise
    return value


def _hints(constructor: _Constructor) -> dict[str, Any]:
    call = constructor.call
    try:
        return get_type_hints(call.__init__ if inspect.isclass(call) else call)
    except NameError:  # annotations for type checkers only
        if not constructor.lenient:
            raise
        return {}
