"""Kinds of constraints answer for themselves: nothing asks which kind it has, and one more needs no other code."""

import ast
import dataclasses
import inspect
import json
import math
import re

import pytest
import torch
from helpers.motions import walking
from helpers.scripts import ROOT
from helpers.tiny_model import tiny

import stmc
from stmc.editing.constraints import (
    KINDS,
    Constraint,
    Heading,
    Hold,
    Keyframe,
    Order,
    Path,
    Pose,
    Target,
    constraint_of,
    project,
    reading,
)

SEEN = walking(seconds=3)
EXAMPLES = [
    Path([(0, 0), (0, -2)], end=2, facing=None),
    Path([(0, 0), (1, 0), (1, 1)], times=[0.5, 1, 2]),
    Heading(0.8, 1.5),
    Keyframe(SEEN.trimmed(30, 31), 1.5),
    Target("left_hand", (0.3, -0.4, 1.1), 1.0, 1.5),
    Target("left_foot", (0.1, 0.0, 0.2), 1.0),
    Hold("right_hand", 1),
]


def test_there_is_an_example_of_every_kind():
    assert {type(each) for each in EXAMPLES} == set(KINDS)
    assert len({kind.name for kind in KINDS}) == len(KINDS) and all(kind.name and kind.about for kind in KINDS)


def test_no_code_asks_which_kind_of_constraint_it_has():
    """Neither `isinstance` of a kind in Python, nor the name of one in the page's JavaScript."""
    kinds = {kind.__name__ for kind in KINDS}
    for path in [*(ROOT / "stmc/editing").rglob("*.py"), *(ROOT / "stmc/viewing/studio").glob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "isinstance":
                assert not kinds & {each.id for each in ast.walk(node) if isinstance(each, ast.Name)}, path.name
    for name in ("constraints", "constraint_panel", "gizmos", "locks", "tracks", "actions", "state"):
        script = (ROOT / f"stmc/assets/studio/{name}.js").read_text("utf-8")
        assert not re.search(r"kind\)? === \"(path|heading|keyframe|target|hold)\"", script), name


@pytest.mark.parametrize("constraint", EXAMPLES, ids=lambda each: each.name)
def test_a_constraint_is_read_from_the_json_that_it_writes(constraint):
    files: dict[str, stmc.Motion] = {}

    def save(motion: stmc.Motion) -> str:
        files["pose.npz"] = motion
        return "pose.npz"

    entry = json.loads(json.dumps(constraint.to_json(save)))
    again = constraint_of(entry, files.__getitem__)
    assert type(again) is type(constraint) and again.to_json(save) == constraint.to_json(save)
    assert again == constraint or torch.equal(again.pose.joints, constraint.pose.joints)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_the_fields_of_a_form_are_arguments_of_the_json_and_give_all_that_has_no_default(kind):
    reader = kind if kind.from_json.__func__ is Constraint.from_json.__func__ else kind.from_json
    parameters = {each.name: each for each in inspect.signature(reader).parameters.values()}
    names = {field.name for field in kind.fields}
    needed = {
        name for name, each in parameters.items() if each.default is each.empty and each.kind != each.POSITIONAL_ONLY
    }
    assert needed <= names <= set(parameters)
    described = json.loads(json.dumps(kind.describe()))
    assert [field["name"] for field in described["fields"]] == [field.name for field in kind.fields]
    assert all(field["least"] is None or field["least"] < field["most"] for field in described["fields"])


@pytest.mark.parametrize("constraint", EXAMPLES, ids=lambda each: each.name)
def test_a_constraint_measures_a_motion_at_its_own_frames_in_the_unit_that_people_read(constraint):
    pose, told = Pose.of(SEEN), constraint.measure(SEEN)
    errors, span = constraint.errors(pose), constraint.frames(pose)
    assert len(errors) == span.stop - span.start
    scale = {"cm": 100, "degrees": 180 / math.pi}[told["unit"]]
    assert told == {"name": constraint.name, "error": pytest.approx(float(errors.max()) * scale), "unit": told["unit"]}
    assert constraint.describe()["tolerance"] == pytest.approx(constraint.tolerance * scale)


def test_a_constraint_beyond_the_motion_has_no_error():
    assert Target("left_hand", (0, 0, 1), 30).measure(SEEN)["error"] == 0.0


def test_a_path_and_a_heading_that_start_at_zero_say_where_a_motion_begins_and_nothing_else_does():
    place = (0.0, 0.0, 0.5, 0.1)
    assert Path([(2, 1), (2, -3)]).begin_place(place) == (2.0, 1.0, 0.5, 0.0)
    assert Path([(2, 1), (2, -3)], start=1).begin_place(place) == place
    assert Heading(1.0).begin_place(place) == (0.0, 0.0, 0.5, 1.0) and Heading(1.0, 1).begin_place(place) == place
    assert all(each.begin_place(place) == place for each in EXAMPLES[3:])
    for mine in ([Path([(5, 5), (6, 5)]), Heading(2.0)], [Heading(2.0), Path([(5, 5), (6, 5)], facing=None)]):
        [motion] = tiny().generate("walk # 0 # 1", steps=1, constraints=mine, clean_feet=False)
        assert (motion.translation[0, :2] - 5).norm() < 0.05
        assert float(motion.heading[0]) == pytest.approx(2.0, abs=0.3)


def test_poses_are_projected_before_paths_and_paths_before_limbs():
    met: list[str] = []

    @dataclasses.dataclass(frozen=True)
    class Noted(Constraint):
        label: str
        order: Order

        def errors(self, pose):
            return pose.translation[:, 0] * 0

        residuals = errors

        def project(self, motion, skeleton, free):
            met.append(self.label)
            return motion

    given = [
        Noted("limb", Order.LIMB),
        Noted("path", Order.PATH),
        Noted("pose", Order.POSE),
        Noted("limb 2", Order.LIMB),
    ]
    project(SEEN, given, stmc.Skeleton.default(), torch.ones(60, 5))
    assert met == ["pose", "path", "limb", "limb 2"]


def test_a_class_without_its_two_methods_is_no_constraint():
    class Empty(Constraint):
        pass

    with pytest.raises(TypeError, match="abstract"):
        Empty()


@pytest.fixture
def below() -> type[Constraint]:
    """The class of the page on constraints, which is made outside of the library."""
    page = (ROOT / "docs/extending/constraint.md").read_text("utf-8")
    [block] = re.findall(r"^```python\n(.*?)^```$", page, re.S | re.M)
    space: dict = {"__name__": "somebodys_module"}
    exec(block.split("model = ")[0], space)
    return space["Below"]


def test_the_constraint_of_the_page_is_met_beside_others_and_with_clean_feet(below):
    model = tiny()
    timeline = "walk # 0 # 3"
    [free] = model.generate(timeline, steps=4)
    height = float(free.joints[20:40, 15, 2].min()) - 0.15
    beam = below("head", height, start=1, end=2)
    for others in ([], [Target("right_hand", (-0.35, -0.35, 0.9), 2.5), Path([(0, 0), (0, -0.6)])]):
        [met] = model.generate(timeline, steps=4, constraints=[beam, *others])
        assert beam.measure(met)["error"] < 6 < 15 < beam.measure(free)["error"] + 0.01


def test_the_constraint_of_the_page_is_read_and_described_by_one_entry_of_the_kinds(below, monkeypatch):
    entry = {"below": {"joint": "head", "height": 1.3, "start": 1}}
    with pytest.raises(stmc.settings.records.SettingError, match="choose from path, heading, keyframe, target, hold"):
        constraint_of(entry)
    monkeypatch.setattr(reading, "KINDS", (*KINDS, below))
    assert constraint_of(entry) == below("head", 1.3, 1)
    assert below.describe()["title"] == "Below" and below.describe()["tolerance"] == pytest.approx(3)
