"""Pickles as SMPL's files are, and as nobody should open: written by stand-ins for chumpy, which no longer installs."""

import pickle
import sys
import types
from importlib import import_module

import numpy as np


class Foreign:
    """An object of a class that no file of arrays has."""


class _Code:
    def __init__(self, call: str, argument: str) -> None:
        self.call, self.argument = call, argument

    def __reduce__(self):
        module, _, name = self.call.rpartition(".")
        return getattr(import_module(module), name), (self.argument,)


def run_code(call: str, argument: str, protocol: int) -> bytes:
    """A pickle that calls `call(argument)` where it is opened carelessly."""
    return pickle.dumps({"plain": np.zeros(3), "surprise": _Code(call, argument)}, protocol)


def python_2_pickle(entries: dict[str, object], protocol: int) -> bytes:
    """A dict as Python 2 pickled it, with chumpy's objects for ("Ch", values), ("Select", values, places, shape) and
    ("add", values)."""
    chumpy = {name: types.ModuleType(name) for name in ("chumpy", "chumpy.ch", "chumpy.reordering")}
    classes = {}
    for name, module in (("Ch", "chumpy.ch"), ("add", "chumpy.ch"), ("Select", "chumpy.reordering")):
        classes[name] = type(name, (), {"__module__": module})
        setattr(chumpy[module], name, classes[name])

    def made(value: object) -> object:
        if not isinstance(value, tuple):
            return value
        kind, values, *more = value
        thing = classes[kind]()
        if kind == "Select":
            thing.a, thing.idxs, thing.preferred_shape = made(("Ch", values)), np.array(more[0]), more[1]
        else:
            thing.x = values
            thing._dirty_vars, thing._itr, thing._parents = {"x"}, None, []
        return thing

    sys.modules.update(chumpy)
    try:
        content = pickle.dumps({name: made(value) for name, value in entries.items()}, protocol, fix_imports=True)
    finally:
        for name in chumpy:
            del sys.modules[name]
    return content
