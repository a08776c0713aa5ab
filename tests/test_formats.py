"""Formats stand in one table: commands, the studio, messages and the page of formats say what it says."""

import ast
import dataclasses
import re
from pathlib import Path

import pytest
from helpers.motions import walking
from helpers.scripts import ROOT

import stmc
from stmc.cli import sample
from stmc.formats import FORMATS, READABLE, motion_files, write_as
from stmc.motion.body import JOINTS
from stmc.viewing.exports import CHARACTER_EXPORTS, EXPORTS, FILMS, export

WALK = walking(seconds=1.0)


def test_every_suffix_stands_once_and_the_table_of_exports_begins_with_that_of_files():
    suffixes = [each.suffix for each in EXPORTS]
    assert len(set(suffixes)) == len(suffixes)
    assert EXPORTS[: len(FORMATS)] == FORMATS
    assert {each.suffix for each in READABLE} < {each.suffix for each in FORMATS}
    assert FILMS == (".webp", ".gif", ".mp4")


@pytest.mark.parametrize("kind", FORMATS, ids=lambda kind: kind.name)
def test_write_writes_every_format_of_the_table_and_read_reads_those_with_a_reader(kind, tmp_path):
    stmc.write(WALK, tmp_path / f"walk{kind.suffix}")
    if kind in READABLE:
        assert stmc.read(tmp_path / f"walk{kind.suffix}").frames == WALK.frames
    else:
        readable = ", ".join(each.suffix for each in READABLE)
        with pytest.raises(ValueError, match=re.escape(f"choose from {readable}")):
            stmc.read(tmp_path / f"walk{kind.suffix}")


def test_a_command_offers_the_formats_of_the_table_and_its_help_names_those_it_reads():
    assert set(sample.CHOICES) == {each.name for each in (*EXPORTS, *CHARACTER_EXPORTS)}
    keep = {field.name: field for field in dataclasses.fields(sample.Settings)}["keep"].metadata["info"].help
    assert all(each.suffix in keep for each in READABLE)


def test_the_page_of_formats_has_the_rows_of_the_table():
    rows = [f"| `{each.suffix}` | {each.used_by} | {each.holds} |" for each in EXPORTS]
    assert "\n".join(rows) in (ROOT / "docs/export.md").read_text("utf-8"), "\n".join(["the rows should be:", *rows])


def test_no_other_module_lists_suffixes_of_motions():
    """A tuple, list, set or table of two suffixes or more of the table, beside those that the table itself is made of
    and the defaults of `stmc sample`."""
    names = {name for each in EXPORTS for name in (each.name, each.suffix)}
    listed = []
    for path in sorted((ROOT / "stmc").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            items = node.keys if isinstance(node, ast.Dict) else getattr(node, "elts", [])
            if len([each for each in items if isinstance(each, ast.Constant) and each.value in names]) > 1:
                listed.append(path.name)
    assert set(listed) == {"film.py", "sample_folder.py", "characters.py", "gltf_rig.py"}


def test_an_export_takes_only_the_options_that_its_format_has(tmp_path):
    for suffix in (".bvh", ".html"):
        export(WALK, tmp_path / f"walk{suffix}", title="A title")
    assert "A title" in (tmp_path / "walk.html").read_text("utf-8")
    assert b"A title" not in (tmp_path / "walk.bvh").read_bytes()
    with pytest.raises(ValueError, match=r"cannot write '\.fbx' files; choose from \.glb, .*\.mp4"):
        export(WALK, tmp_path / "walk.fbx")


def test_the_studio_describes_and_receives_what_the_table_has():
    described = [each.describe() for each in EXPORTS]
    assert described[0]["name"] == "glb"  # the one that the dialog chooses at first
    assert [each["name"] for each in described if each["drawn"]] == [suffix[1:] for suffix in FILMS]
    page = "".join(path.read_text("utf-8") for path in (ROOT / "stmc/assets/studio").glob("*.*"))
    assert not re.search(r"[\"'.](npz|bvh|webp|mp4)\b", page)


def test_the_format_of_the_page_is_written_as_it_says_and_by_its_entry_alone(tmp_path, monkeypatch):
    [block] = re.findall(r"^```python\n(.*?)^```$", (ROOT / "docs/extending/format.md").read_text("utf-8"), re.S | re.M)
    monkeypatch.chdir(tmp_path)
    space: dict = {}
    exec(block.split("[motion] = ")[0], space)
    write_as(space["TRC"], WALK, Path("walk.trc"), fps=100)
    monkeypatch.setattr(motion_files, "FORMATS", (*FORMATS, space["TRC"]))
    stmc.write(WALK, "same.trc", fps=100)
    assert Path("same.trc").read_bytes() == Path("walk.trc").read_bytes()
    *head, names, _, first = Path("walk.trc").read_text().splitlines()[:6]
    assert head[-1].split("\t")[:4] == ["100", "100", str(WALK.resampled(100).frames), "24"]
    assert names.split("\t")[2::3] == list(JOINTS)
    x, height, depth = map(float, first.split("\t")[2:5])
    assert (x, -depth, height) == pytest.approx((1000 * WALK.joints[0, 0]).tolist(), abs=1e-3)
