"""Where the time of an edit in the studio goes: stages, denoised crops and caches."""

import dataclasses
import json
import threading

import pytest
from helpers.tiny_model import tiny

import stmc
from stmc.cli.edit_tables import describe_edits
from stmc.composing.sampling import Sampling
from stmc.evaluation.edit_profile import EditProfile, Lookups, MeasuredEdit, list_edits, profile_edits
from stmc.evaluation.stage_timer import Seam, StageTimer
from stmc.model import Model


class Clock:
    """A clock that each function moves on by its own seconds."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now

    def outer(self) -> None:
        self.now += 2
        self.inner()
        self.now += 3

    def inner(self) -> None:
        self.now += 10


def test_a_stage_has_its_own_time_and_not_that_of_the_stages_inside():
    clock = Clock()
    timer = StageTimer(clock)
    with timer.watching([Seam(Clock, "outer", "outer"), Seam(Clock, "inner", "inner")]):
        clock.outer()
    clock.outer()  # nobody watches
    assert timer.take() == {"outer": 5, "inner": 10}
    assert timer.take() == {}


def test_a_stage_that_fails_has_its_time_and_ends():
    clock = Clock()
    timer = StageTimer(clock)
    with pytest.raises(ZeroDivisionError), timer.stage("fails"):
        clock.now += 1
        raise ZeroDivisionError
    clock.now += 5
    with timer.stage("next"):
        clock.now += 2
    assert timer.take() == {"fails": 1, "next": 2}


def test_threads_have_stages_of_their_own():
    clock = Clock()
    timer = StageTimer(clock)
    with timer.stage("here"):
        clock.now += 1
        other = threading.Thread(target=timer.timed(clock.inner, "there"))
        other.start()
        other.join()
    assert timer.take() == {"here": 11, "there": 10}


def test_a_function_that_is_gone_is_an_error():
    with pytest.raises(AttributeError, match="gone"), StageTimer().watching([Seam(Clock, "gone", "stage")]):
        pass


def test_edits_differ_from_each_other_and_change_one_prompt():
    edits = list_edits(10)
    assert [edit.kind for edit in edits[:3]] == ["an end is moved", "a text is changed", "a prompt is added"]
    assert len({edit.timeline for edit in edits}) == len(edits) == 30
    assert len({prompt.text for edit in edits for prompt in edit.timeline.prompts}) == 3 + 10 + 1


@pytest.fixture(scope="module")
def profile(tmp_path_factory) -> EditProfile:
    """Of the first edit, with a tiny model of few steps, whose texts are compared by hashes."""
    model = dataclasses.replace(tiny(longest=200), sampling=Sampling(steps=2))
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("stmc.viewing.studio.server.sentence_encoder", lambda encoder: encoder)
        return profile_edits(model, tmp_path_factory.mktemp("studio"), 2, list_edits(1)[:1])


def test_an_edit_denoises_every_crop_unless_the_rest_is_kept(profile):
    [everything], [touched] = profile.everything, profile.touched
    assert (everything.denoised, everything.crops) == (6, 6)  # three prompts, and the transitions between them
    assert (touched.denoised, touched.crops) == (4, 6)  # not the prompt after it, and not the transition to that


def test_every_stage_of_an_edit_is_measured(profile):
    stages = {name for name, seconds in profile.medians("everything").items() if seconds}
    assert {"read requests", "plan", "encode texts", "steps: network", "decode", "feet", "figure (.glb)"} <= stages
    assert sum(profile.shares("touched").values()) == pytest.approx(1)


def test_a_text_is_encoded_once_however_often_it_is_needed(profile):
    texts = profile.caches["encoded texts"]
    assert texts.missing == 3 + 1  # those of the timeline, and no text
    assert texts.texts > 5 * texts.missing


def test_functions_are_as_they_were_once_nobody_watches():
    before = dict(vars(stmc.GenerateRequest)), dict(vars(Model))
    with StageTimer().watching([Seam(stmc.GenerateRequest, "read", "read"), Seam(Model, "guided", "plan")]):
        assert dict(vars(Model)) != before[1]
        assert stmc.GenerateRequest.read({"timelines": "walk # 0 # 1"}).seeds == (0,)
    assert (dict(vars(stmc.GenerateRequest)), dict(vars(Model))) == before


def test_the_tables_say_which_edits_denoise_how_much_and_fit_into_json():
    fast = MeasuredEdit("moved", {"steps": 3.0, "feet": 1.0}, 1.0, 4.0, 2, 6)
    profile = EditProfile([fast, fast], [dataclasses.replace(fast, stages={"steps": 1.0})], {"texts": Lookups(4, 1)})
    stages, edits, caches = describe_edits(profile)
    assert stages.rows == [
        ("steps", "3000.0 ms", "75.0%", "1000.0 ms", "100.0%"),
        ("feet", "1000.0 ms", "25.0%", "0.0 ms", "0.0%"),
    ]
    assert edits.rows[0] == ("moved", "everything", "2 of 6", "1.00 s", "4.00 s")
    assert caches.rows == [("texts", "4", "75.0%")]
    assert json.loads(json.dumps(dataclasses.asdict(profile)))["touched"][0]["stages"] == {"steps": 1.0}
