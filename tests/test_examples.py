"""Everything public has an example in its docstring, and it does what it says."""

import doctest
import functools
import inspect
import tempfile
import webbrowser
from collections.abc import Callable, Iterator
from types import FunctionType

import pytest
import torch

import stmc
from stmc.editing.constraints import Constraint
from stmc.run import WEIGHTS, bundled

PUBLIC = [name for name in stmc.__all__ if not inspect.ismodule(getattr(stmc, name))]


def public() -> Iterator[tuple[str, object]]:
    """The names of `stmc`, and the methods of its classes, as users and pytest's import hook have them. What all
    constraints can do has its example once."""
    yield "Constraint", Constraint
    for name in PUBLIC:
        value = getattr(stmc, name)
        yield name, value
        for method, kind in vars(value).items() if isinstance(value, type) else ():
            if not (method.startswith("_") or hasattr(Constraint, method)) and isinstance(
                kind, (FunctionType, classmethod, staticmethod)
            ):
                yield f"{name}.{method}", getattr(value, method)


PARSER = doctest.DocTestParser()
EXAMPLES = {name: PARSER.get_doctest(value.__doc__ or "", {}, name, name, 0) for name, value in public()}


@pytest.fixture(scope="module")
def load() -> Callable[..., stmc.Model]:
    """The bundled model is read once for all examples."""
    return functools.cache(stmc.load)


def test_everything_public_has_an_example():
    assert len(EXAMPLES) > len(PUBLIC)
    assert [name for name, example in EXAMPLES.items() if not example.examples] == []


@pytest.mark.skipif(not (bundled() / WEIGHTS).exists(), reason="this checkout has no bundled model")
@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_gives_what_it_says(name, load, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(stmc, "load", load)
    monkeypatch.setattr(webbrowser, "open", lambda address: True)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    EXAMPLES[name].globs = {"stmc": stmc, "torch": torch}
    said: list[str] = []
    assert not doctest.DocTestRunner().run(EXAMPLES[name], out=said.append).failed, "".join(said)
