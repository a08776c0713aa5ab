"""The README is true: its cells run, its commands are understood, and what it names is there."""

import re
import shlex
from pathlib import Path

import pytest
from scripting import ROOT, configured

from stmc.model import Model
from stmc.run import WEIGHTS, bundled

README = (ROOT / "README.md").read_text("utf-8")
CELLS = re.findall(r"^```python\n(.*?)^```$", README, flags=re.DOTALL | re.MULTILINE)
THEIRS = ("MTT.txt", "texts.txt", "motions.txt")
"""Files of the benchmark of STMC's authors, which are not ours to ship."""
COMMANDS = re.findall(r"python (scripts/\w+\.py)((?: +[\w.]+=[^\s`|&;]+)*)", README)


@pytest.mark.skipif(not (bundled() / WEIGHTS).exists(), reason="this checkout has no bundled model")
def test_the_cells_run_one_after_the_other(tmp_path, monkeypatch):
    """As in a notebook, in an empty folder; with few steps, since it is not the motion that is tested."""
    generate = Model.generate
    monkeypatch.setattr(Model, "generate", lambda *args, **settings: generate(*args, **settings | {"steps": 3}))
    monkeypatch.chdir(tmp_path)
    namespace: dict = {"__name__": "__main__"}
    for number, cell in enumerate(CELLS, start=1):
        exec(compile(cell, f"README.md, cell {number}", "exec"), namespace)
    for name in re.findall(r'stmc\.write\(\w+, "([^"]+)"', "".join(CELLS)):
        assert (tmp_path / name).stat().st_size > 0, name


def test_there_are_cells_and_commands_to_try():
    assert CELLS
    assert {script for script, _ in COMMANDS} >= {"scripts/sample.py", "scripts/prepare.py", "scripts/train.py"}


@pytest.mark.parametrize(("script", "settings"), COMMANDS, ids=str.strip)
def test_a_command_names_a_script_that_is_there_and_settings_that_it_has(script, settings):
    assert (ROOT / script).is_file()
    configured(Path(script).stem, *shlex.split(settings))


def test_settings_that_are_only_mentioned_exist_too():
    """`steps=`, `method=stmc|sinc`, … in the row of the script they belong to."""
    rows = [line for line in README.splitlines() if line.startswith("| `python scripts/")]
    assert rows
    for row in rows:
        script = re.search(r"scripts/(\w+)\.py", row)[1]
        config = configured(script)
        for key in re.findall(r"`(\w+)=", row):
            assert key in config, f"{script}.py has no setting {key}"


@pytest.mark.parametrize(
    "page",
    [ROOT / "README.md", *sorted((ROOT / "stmc/assets").rglob("*.md"))],
    ids=lambda page: str(page.relative_to(ROOT)),
)
def test_every_file_that_a_page_links_is_there(page):
    links = re.findall(r"\]\((?!https?:|#|mailto:)([^)\s#]+)", page.read_text("utf-8"))
    assert not [name for name in links if not (page.parent / name).exists()]


def test_every_file_that_is_named_is_there():
    named = re.findall(r"`((?:scripts|configs|tests|stmc|docs)/[\w./-]*\w)`", README)
    named += re.findall(r"`([\w-]+\.(?:txt|toml|md|cff))`", README)
    assert not [name for name in named if not (ROOT / name).exists() and name not in THEIRS]


def test_the_test_command_is_the_one_that_ci_runs():
    """`.ci/run` looks it up by this pattern."""
    commands = re.findall(r"^pip install .*&& pytest.*$", README, flags=re.MULTILINE)
    assert len(commands) == 1
    assert "pip install" in (ROOT / ".ci" / "run").read_text("utf-8")
