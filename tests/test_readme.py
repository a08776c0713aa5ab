"""The README is short and true: its cells run, and what it names is there. Its links and commands are tested with those
of all pages, in test_docs."""

import re
from pathlib import Path

import pytest
from helpers.scripts import ROOT

from stmc.cli.dispatch import find_command
from stmc.model import Model
from stmc.run import WEIGHTS, bundled
from stmc.settings.records import field_infos

README = (ROOT / "README.md").read_text("utf-8")
CELLS = re.findall(r"^```python\n(.*?)^```$", README, flags=re.DOTALL | re.MULTILINE)


@pytest.mark.skipif(not (bundled() / WEIGHTS).exists(), reason="this checkout has no bundled model")
def test_the_cells_run_one_after_the_other(tmp_path, monkeypatch):
    """As in a notebook, in an empty folder; with few steps, since it is not the motion that is tested."""
    generate = Model.generate
    monkeypatch.setattr(Model, "generate", lambda *args, **settings: generate(*args, **settings | {"steps": 3}))
    monkeypatch.chdir(tmp_path)
    namespace: dict = {"__name__": "__main__"}
    for number, cell in enumerate(CELLS, start=1):
        exec(compile(cell, f"README.md, cell {number}", "exec"), namespace)
    for name in re.findall(r'stmc\.write\(.+, "([^"]+)"', "".join(CELLS)):
        assert (tmp_path / name).stat().st_size > 0, name


def test_it_has_cells_and_at_most_120_lines():
    assert CELLS
    assert len(README.splitlines()) <= 120


def test_settings_that_are_only_mentioned_exist_too():
    """`steps=`, `method=stmc|sinc`, … in the row of the command they belong to."""
    rows = [line for line in README.splitlines() if line.startswith("| `stmc ")]
    assert rows
    for row in rows:
        command = find_command(re.match(r"\| `stmc (\w+)", row)[1])
        for key in re.findall(r"`(\w+)=", row):
            assert key in field_infos(command.settings) or key in command.parts, (
                f"stmc {command.name} has no setting {key}"
            )


def test_every_file_that_is_named_is_there():
    named = re.findall(r"`((?:scripts|configs|tests|stmc|docs)/[\w./-]*\w)`", README)
    named += re.findall(r"`([\w-]+\.(?:toml|md|cff))`", README)
    assert not [name for name in named if not (ROOT / name).exists()]
    assert (ROOT / "constraints.txt").exists()


def test_the_test_command_is_the_one_that_ci_runs():
    """`.ci/run` looks it up by this pattern."""
    commands = re.findall(r"^pip install .*&& pytest.*$", README, flags=re.MULTILINE)
    assert len(commands) == 1
    assert "pip install" in (Path(ROOT) / ".ci" / "run").read_text("utf-8")
