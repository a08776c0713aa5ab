"""Values that nobody can mean are refused with the name of the setting, before anything is sampled."""

import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from helpers.tiny_model import tiny

import stmc
from stmc.editing.constraints import constraint_of
from stmc.settings.records import SettingError

WRONG = {
    "a path's end": ({"path": {"points": [[0, 0], [0, 1]], "end": 1e308}}, "path at 0.0..1e+308 s: must be from 0 to"),
    "a point far away": (
        {"path": {"points": [[0, 0], [0, 1e20]], "end": 2}},
        "point=[0, 1e+20]: must be 2 finite numbers, at",
    ),
    "a path of 42 km": ({"path": {"points": [[0, 0], [0, 42e3]], "end": 2}}, "at most 10000 from 0"),
    "a number of 400 digits": ({"path": {"points": [[0, 0], [0, 10**400]], "end": 2}}, "point="),
    "an angle of 400 digits": ({"heading": {"angle": 10**400}}, "angle="),
    "a target far away": ({"target": {"joint": "left_hand", "point": [0, 0, -2e4]}}, "point="),
    "not a number": ({"heading": {"angle": 0, "start": float("nan")}}, "heading at nan s"),
}


@pytest.mark.parametrize(("entry", "message"), WRONG.values(), ids=WRONG)
def test_a_constraint_beyond_all_bounds_is_named(entry, message):
    with pytest.raises(SettingError) as caught:
        constraint_of(entry)
    assert message in str(caught.value) and len(str(caught.value)) < 300


@pytest.mark.parametrize("guidance", [1e30, 1000, -1e10])
def test_a_guidance_beyond_all_bounds_is_named(guidance):
    with pytest.raises(SettingError, match=r"guidance=.*must be above -1000 and below 1000"):
        stmc.Sampling(guidance=guidance)


TYPES = {
    "Prompt(3, 0, 1)": "a prompt needs a text and a list of body parts; got [3, ",
    "Prompt('a', 'x', 1)": "start 'x' must be a finite number of seconds",
    "Prompt('a', 0, [1])": "end [1] must be a finite number of seconds",
    "Prompt('a', 0, 1, [[]])": "unknown body part []",
    "Prompt('a', 0, 1, [None])": "unknown body part null",
    "Prompt('a', 0, 1, 7)": 'got ["a", 7]',
    "BodyPart.parse({})": "a body part must be a text, not {}",
    "Change(0, 1, [{}])": "change: a body part must be a text, not {}",
    "Change('x', 1)": "change 'x'..1 s",
    "Change(0, 1e308)": "must be from 0 to 14,400 s, the end after the start",
    "Path([(0, 0), (0, 1)], end='x')": "path at 0.0..'x' s: must be from 0 to 14,400 s",
    "Hold('left_hand', end=[1])": "left_hand at 0.0..[1] s",
    "find_method('os.system', ['os'])": "method='os.system': os defines no such rule Plan → Plan",
    "find_method('os.path', ['os'])": "pass a name, a Method or a rule Plan → Plan",
    "load('mdm_smpl_cmu').generate('walk # 0 # 1', keep='x.npz', steps=2)": "keep='x.npz': must be a motion",
}


def test_a_value_of_another_type_is_named():
    """In a process of its own: the types of these tests are checked elsewhere already."""
    code = (
        "import sys, stmc\n"
        "for call in sys.argv[1:]:\n"
        "    try: sys.exit(repr(eval('stmc.' + call)))\n"
        "    except ValueError as error: print(str(error).replace(chr(10), ' '))\n"
    )
    done = subprocess.run([sys.executable, "-c", code, *TYPES], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for line, (call, message) in zip(done.stdout.splitlines(), TYPES.items(), strict=True):
        assert message in line and len(line) < 300, call


def test_a_rule_that_makes_no_plan_is_named():
    with pytest.raises(SettingError, match="the rule nothing returns a NoneType instead of a Plan"):

        def nothing(plan):
            return None

        tiny().generate("walk # 0 # 1", method=nothing, steps=2)


def test_the_pages_of_earlier_views_are_removed(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr("webbrowser.open", lambda address: None)
    monkeypatch.setattr("stmc.viewing.web.render_html", lambda *_: "a page")
    motion = stmc.Motion.posed(torch.eye(3).repeat(2, 22, 1, 1), torch.zeros(2, 3), 20, stmc.Skeleton.default())
    (tmp_path / "mine.html").write_text("stays")
    stmc.view(motion)
    stmc.view(motion)
    assert len(list(tmp_path.iterdir())) == 3, "a browser may not have read the first one yet"
    now = time.time()
    monkeypatch.setattr("time.time", lambda: now + 7200)
    stmc.view(motion)
    assert len(list(tmp_path.iterdir())) == 2


def test_ctrl_c_while_the_library_is_imported_is_one_line(tmp_path):
    (tmp_path / "hydra.py").write_text("raise KeyboardInterrupt")
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); from stmc.__main__ import main; sys.exit(main())"
    root = Path(__file__).parents[1]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (130, "Interrupted. Run the same command again to resume.\n")


INTERRUPTED_IMPORT = """
import os, signal
try:
    os.kill(os.getpid(), signal.SIGTERM)
    for _ in range(10**9): pass
except BaseException:
    raise ImportError("numpy.core.multiarray failed to import") from None
"""
"""What C code of an extension module makes of an exception that passes through it."""


@pytest.mark.skipif(sys.platform == "win32", reason="processes of Windows end without a signal")
def test_a_request_to_end_is_one_line_while_the_library_is_imported_and_later(tmp_path):
    (tmp_path / "torch.py").write_text(INTERRUPTED_IMPORT)
    importing = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); from stmc.__main__ import main; sys.exit(main())"
    later = (
        "import os, signal, sys; from stmc.cli.exit_codes import run_guarded\n"
        "def run():\n"
        "    try: os.kill(os.getpid(), signal.SIGTERM)\n"
        "    finally: print('tidied')\n"
        "sys.exit(run_guarded(run))"
    )
    for code, told in ((importing, ""), (later, "tidied\n")):
        command = [sys.executable, "-c", code, "sample", "walk # 0 # 1", str(tmp_path / "out")]
        done = subprocess.run(command, cwd=Path(__file__).parents[1], capture_output=True, text=True, check=False)
        line = "Terminated. Run the same command again to resume.\n"
        assert (done.returncode, done.stdout, done.stderr) == (143, told, line)
