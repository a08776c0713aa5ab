"""One record for all that a model is asked: read from Python, a command line or JSON, with the same messages."""

import dataclasses
import inspect
import json
from pathlib import Path

import pytest
import torch
from helpers.motions import standing_still
from helpers.scripts import configured, loaded
from helpers.studio import knowing
from helpers.tiny_model import tiny

import stmc
from stmc import GenerateRequest
from stmc.composing.sampling import Sampling
from stmc.editing.generate_request import names
from stmc.settings.records import SettingError, defaults, field_infos
from stmc.viewing.studio import Characters, Documents, Motions, Sessions
from stmc.viewing.studio.bodies import JobBody, read_body
from stmc.viewing.studio.films import Films
from stmc.viewing.studio.request_errors import RequestError
from stmc.viewing.studio.server import Answers

WALK = {"prompts": [{"text": "walk", "start": 0, "end": 2, "parts": ["legs"]}], "name": ""}
TEXT = "walk # 0 # 2 # legs"


@pytest.fixture(scope="module")
def answers(tmp_path_factory) -> Answers:
    folder = tmp_path_factory.mktemp("studio")
    motions = Motions(folder / "motions")
    documents, characters = Documents(folder / "documents"), Characters(folder / "characters")
    films = Films(folder / "films")
    return Answers(knowing(), motions, documents, characters, films, Sessions(), steps=4)


@pytest.fixture(scope="module")
def motion() -> stmc.Motion:
    return tiny().generate(TEXT, steps=1)[0]


def requested(answers: Answers, body: dict) -> GenerateRequest:
    """The record that the studio makes of a body in JSON."""
    return answers._request(read_body(JobBody, json.loads(json.dumps(body))))


class Caught(Exception):
    """The request that `Model.generate` made."""


def in_python(monkeypatch, **arguments) -> GenerateRequest:
    """The record that `Model.generate` makes of its arguments."""

    def catch(self, request, progress=None):
        raise Caught(request)

    with monkeypatch.context() as patch, pytest.raises(Caught) as caught:
        patch.setattr(stmc.Model, "sample", catch)
        tiny().generate(TEXT, **arguments)
    return caught.value.args[0]


def typed(*settings: str) -> GenerateRequest:
    """The record of what is typed behind `stmc sample`."""
    sample = loaded("sample")
    read = sample.main.check(configured("sample", *settings))
    return sample.request_of(read, [stmc.Timeline.parse(TEXT)], [read.seed])


def test_python_a_command_line_and_json_give_one_record(answers, motion, tmp_path, monkeypatch):
    stmc.write(motion, tmp_path / "old.npz")
    kept = stmc.read(tmp_path / "old.npz")
    constraints = [{"heading": {"angle": 1, "start": 1.5}}, {"hold": {"joint": "left_hand"}}]
    (tmp_path / "beside.json").write_text(json.dumps(constraints))
    one = in_python(
        monkeypatch,
        seed=3,
        method="multi_diffusion",
        keep=kept,
        change=stmc.Change(1, 2, ["legs"]),
        constraints=stmc.read_constraints(tmp_path / "beside.json"),
        clean_feet=False,
        guidance=2,
        overlap=0.25,
    )
    other = typed(
        "seed=3",
        "method=multi_diffusion",
        f"keep={tmp_path / 'old.npz'}",
        'change=["1 # 2 # legs"]',
        f"constraints={tmp_path / 'beside.json'}",
        "clean_feet=false",
        "guidance=2",
        "overlap=0.25",
    )
    body = {"timeline": WALK, "seeds": [3], "method": "multi_diffusion", "keep": answers.motions.add(kept)}
    body |= {"change": [{"start": 1, "end": 2, "parts": ["legs"]}], "constraints": constraints, "tab": "x"}
    third = requested(answers, body | {"clean_feet": False, "guidance": 2, "overlap": 0.25})
    fields = {field.name for field in dataclasses.fields(GenerateRequest)} - {"keep"}  # motions are equal by their data
    for name in fields:
        assert getattr(one, name) == getattr(other, name) == getattr(third, name), name
    assert one.decides() == other.decides()
    assert {k: v for k, v in third.decides().items() if k != "keep"} == {
        k: v for k, v in one.decides().items() if k != "keep"
    }


WRONG = {
    "clean_feet=1": ({"clean_feet": 1}, "clean_feet=1: must be true or false"),
    "guidance=1000": ({"guidance": 1000}, "guidance=1000: must be above -1000 and below 1000"),
    "method=magic": ({"method": "magic"}, "method='magic': choose from"),
    "method=os.system": ({"method": "os.system"}, "method='os.system': 'os' is not among the trusted packages"),
    "seed=-1": ({"seed": -1}, "seed=-1: must be at least 0"),
    "guidence=2": ({"guidence": 2}, "unknown setting 'guidence': did you mean guidance?"),
    'change=["1 # 2"]': ({"change": "1 # 2"}, "change: pass the motion to change as keep=motion"),
    'change=["2 # 1"]': (
        {"change": "2 # 1"},
        "change 2.0..1.0 s, border 0.5 s: must be from 0 to 14,400 s, the end after",
    ),
    "sampler=heun": ({"sampler": "heun"}, "sampler='heun': choose from ddpm"),
    "noise_scale=x": ({"noise_scale": "x"}, "noise_scale='x': must be one of std, variance or null"),
}


@pytest.mark.parametrize("given", WRONG)
def test_what_does_not_fit_has_one_message_in_python_on_a_command_line_and_in_json(answers, given, monkeypatch):
    values, message = WRONG[given]
    told = []
    with pytest.raises(SettingError) as error:
        GenerateRequest.read({"timelines": TEXT, "seeds": values.get("seed", 0)} | without_seed(values))
    told.append(str(error.value))
    with pytest.raises(SettingError) as error:
        sample = loaded("sample")
        settings = sample.main.check(configured("sample", f"++{given}"))
        sample.request_of(settings, [stmc.Timeline.parse(TEXT)], [settings.seed])
    told.append(str(error.value))
    with pytest.raises((SettingError, RequestError)) as error:
        requested(answers, {"timeline": WALK, "seeds": [values.get("seed", 0)]} | without_seed(values))
    told.append(str(error.value).replace("seeds=", "seed=").replace("unknown field", "unknown setting"))  # JSON's names
    assert len(set(told)) == 1 and message in told[0], told


def without_seed(values: dict) -> dict:
    return {name: value for name, value in values.items() if name != "seed"}


OTHER = {
    "timelines": [stmc.Timeline.parse("walk # 0 # 2")],
    "seeds": [1],
    "method": "stmc_paper",
    "joints_from": "features",
    "keep": standing_still(60),
    "change": "0 # 1",
    "constraints": [{"heading": {"angle": 1.0}}],
    "clean_feet": False,
    "steps": 3,
    "sampler": "ddim",
    "noise_scale": "std",
    "guidance": 0,
    "guidance_from": 0,
    "overlap": 0,
    "stitch_from": 0.0,
    "restate_from": 0.5,
    "ape_steps": 0.5,
}
"""Another value of everything that can be asked for: a field without one fails the test below."""


@pytest.mark.parametrize("name", names())
def test_everything_that_can_be_asked_for_tells_a_motion_s_record_from_another(name):
    base = {"timelines": TEXT, **({"keep": standing_still(40)} if name in ("keep", "change") else {})}
    before = GenerateRequest.read(base).decides()
    after = GenerateRequest.read(base | {name: OTHER[name]}).decides()
    assert before != after and json.loads(json.dumps(after)) == after


def test_what_decides_a_motion_is_recorded_as_earlier_versions_did():
    told = GenerateRequest.read({"timelines": TEXT, "seeds": 4, "guidance": 2, "clean_feet": False}).decides()
    assert told == {"prompts": [["walk", 0.0, 2.0, ["legs"]]], "seed": 4, "method": "stmc", "guidance": 2}


def test_a_function_without_a_name_of_its_own_is_not_recorded():
    asked = GenerateRequest.read({"timelines": TEXT, "sampler": stmc.ddim})
    assert asked.decides()["sampler"] == f"{stmc.ddim.__module__}.ddim"
    with pytest.raises(SettingError, match="cannot be recorded"):
        GenerateRequest.read({"timelines": TEXT, "sampler": lambda *_: None}).decides()
    with pytest.raises(SettingError, match="cannot be recorded"):
        GenerateRequest.read({"timelines": TEXT, "method": stmc.stitched(lambda plan: plan)}).decides()
    found = GenerateRequest.read({"timelines": TEXT, "method": stmc.find_method("sinc")})
    assert found.decides()["method"] == "sinc"


def test_requests_are_split_and_joined_without_loss():
    motions = [standing_still(40), standing_still(40)]
    both = GenerateRequest.read({"timelines": [TEXT, "run # 0 # 3"], "seeds": [5, 9], "keep": motions, "change": "0#1"})
    assert GenerateRequest.joined(both.split()) == both
    assert [each.keep for each in both.split()] == [(motions[0],), (motions[1],)]
    with pytest.raises(SettingError, match="2 timelines: call `split`"):
        both.decides()


def test_a_timeline_is_read_from_its_text_its_json_or_itself():
    timeline = stmc.Timeline.parse(TEXT)
    forms = (TEXT, json.loads(timeline.to_json()), timeline)
    found = [GenerateRequest.read({"timelines": form}).timelines for form in forms]
    assert found[0] == found[1] == found[2]
    for wrong in (None, 5, [5]):
        with pytest.raises(SettingError, match="must be a Timeline or its text"):
            GenerateRequest.read({"timelines": wrong})


def test_a_request_gives_the_motions_that_its_arguments_give(motion):
    model, change = tiny(), {"keep": motion, "change": [stmc.Change(1, 2)], "steps": 2}
    [one] = model.generate(TEXT, seed=2, **change)
    [other] = model.sample(GenerateRequest.read({"timelines": TEXT, "seeds": 2} | change))
    assert torch.equal(one.joints, other.joints)


def test_generate_and_the_command_line_offer_the_fields_of_the_request():
    """With the same defaults and the same help: there is no other list."""
    arguments = inspect.signature(stmc.Model.generate).parameters
    renamed = {"seeds": "seed"}
    assert {renamed.get(name, name) for name in names()} == set(arguments) - {"self", "progress"}
    record = loaded("sample").main.settings
    fields = {renamed.get(name, name): name for name in names() if name not in ("timelines", "joints_from")}
    source = field_infos(GenerateRequest) | field_infos(Sampling)
    assert {own: field_infos(record)[own] for own in fields} == {own: source[name] for own, name in fields.items()}
    for name in ("method", "joints_from", "clean_feet", "change"):
        assert arguments[name].default == defaults(GenerateRequest)[name], name


def test_a_body_of_the_studio_trusts_no_package_and_names_no_file(answers, tmp_path, motion):
    stmc.write(motion, tmp_path / "mine.npz")
    body = {"timeline": WALK, "seeds": [0]}
    for values in ({"trusted": ["os"]}, {"constraints": str(tmp_path)}, {"keep": str(tmp_path / "mine.npz")}):
        with pytest.raises((SettingError, RequestError)):
            requested(answers, body | values)
    keyframe = {"keyframe": {"at": 1, "motion": str(Path(tmp_path / "mine.npz"))}}
    with pytest.raises(RequestError):
        requested(answers, body | {"constraints": [keyframe]})
