"""scripts/actions.py: a model asked for what geometry can tell, beside real motion."""

import dataclasses
import json

import pytest
import torch
from helpers.motions import standing_still
from helpers.scripts import loaded, run
from helpers.tiny_model import tiny
from omegaconf import OmegaConf
from rich.console import Console

import stmc
from stmc.cli.action_plausibility import (
    FROZEN,
    has_frozen,
    measure_plausibility,
    measure_rest,
    share_lively,
    split_rest,
)
from stmc.cli.action_reports import print_by_distance, print_report
from stmc.data.cache import Cache, Clip
from stmc.data.sources.contents import CONTENTS, describe
from stmc.evaluators import Evaluator
from stmc.motion.representation import SmplRepresentation
from stmc.settings.records import SettingError


@pytest.fixture
def caches(tmp_path):
    """A data set of seated bodies, and one of standing ones."""
    folders = []
    for name, height in (("sit", 0.45), ("stand", 0.9)):
        features = torch.zeros(100, SmplRepresentation.layout.width)
        features[:, SmplRepresentation.layout["rotations"]] = torch.tensor([1.0, 0, 0, 0, 1, 0]).repeat(22)
        features[:, 0] = height
        clips = tuple(
            Clip(f"{name}{start}", name, "normal", name, ("legs",), False, False, "train", start, start + 50)
            for start in (0, 50)
        )
        Cache(20, "smpl", features, clips, {name: describe(name, "normal")}).write(tmp_path / name)
        folders.append(str(tmp_path / name))
    return folders


def test_unseen_sentences_are_asked_beside_what_real_motion_and_chance_reach(caches, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(stmc, "load", lambda *_, **__: tiny())
    settings = (
        f"cache=[{','.join(caches)}]",
        "samples=2",
        "steps=2",
        "sentences=1",
        f"output={tmp_path / 'out'}",
        "contents=[sit]",
    )
    run("actions", "actions", *settings)
    [(name, row)] = json.loads((tmp_path / "out" / "actions.json").read_text()).items()
    assert (name, row["ceiling"], row["chance"]) == ("sit", 1.0, 0.0)
    assert 0 <= row["found"] <= 1 and row["real_found"] in (0.0, 1.0)
    assert set(row["sentences"]) == {CONTENTS["sit"].unseen[0]} and row["shown"] in (0.0, 0.5, 1.0)
    assert row["real"]["hand_step_cm"] == pytest.approx(0, abs=1e-4) and row["sampled"]["hand_step_cm"] > 0
    assert [picture.name for picture in (tmp_path / "out").glob("*.png")] == ["sit.png"]
    assert (row["real"]["energy"], row["real"]["rest_energy"], row["after"]) == (0.0, 0.0, None)
    assert row["sampled"]["energy"] >= row["sampled"]["rest_energy"] > 0
    printed = capsys.readouterr().out
    assert "floating by more than" in printed
    assert "sit" in printed and "cosine to the nearest training sentence" in printed
    with pytest.raises(SettingError, match="contents=dance: choose from stand, sit"):
        run("actions", "actions", *settings[:-1], "contents=[dance]")


def test_a_content_is_found_where_the_evaluator_has_it_among_its_best_three():
    texts = list(dict.fromkeys(content.sentences[0] for content in CONTENTS.values()))
    place = texts.index("squat")

    class OneHot(Evaluator):
        """Whose latents are one-hot: motions are near the texts that they name."""

        def __init__(self):
            pass

        def texts(self, asked):
            assert list(asked) == texts
            return torch.eye(len(texts))

        def features(self, motion):
            return nearest[len(motion) - 1]

        def motions(self, features):
            return torch.stack(features)

    nearest = [torch.arange(len(texts)).float().roll(place + 1 + best) for best in (0, 2, 3)]
    finder = loaded("actions").Finder(OneHot(), CONTENTS)
    assert finder.finds("squat", list(map(standing_still, (1, 2, 3)))) == [True, True, False]


def test_a_content_is_looked_for_among_those_that_the_data_show():
    class OneHot(Evaluator):
        def __init__(self):
            pass

        def texts(self, asked):
            return torch.eye(len(asked))

    finder = loaded("actions").Finder(OneHot(), {"squat", "walk", "walk-left"})
    assert finder.texts == [CONTENTS["walk"].sentences[0], CONTENTS["squat"].sentences[0]]  # both walks say the same


def test_the_settings_of_sampling_reach_the_model(monkeypatch):
    requests = []

    def generate(self, timelines, **settings):
        requests.append(([prompt.end for timeline in timelines for prompt in timeline.prompts], settings))
        return []

    monkeypatch.setattr(stmc.Model, "generate", generate)
    sampling = {"seed": 3, "guidance": 1.5, "steps": 7, "noise_scale": "std", "clean_feet": True}
    config = OmegaConf.create({"samples": 2} | sampling)
    loaded("actions").sample_sentence(config, tiny(), "sit", "be seated", 2.04)
    assert requests == [([2.0, 2.0], sampling)]


def moving(speed):
    """Three seconds along x at a speed in m/s."""
    still, path = standing_still(60), torch.zeros(60, 3, dtype=torch.float64)
    path[:, 0] = speed * torch.arange(60) / 20
    return dataclasses.replace(still, translation=still.translation + path, joints=still.joints + path[:, None])


def test_the_seconds_after_an_action_are_judged_apart_and_beside_people_who_stand():
    actions, rests = split_rest({"jump": [moving(0.1)]}, 1.0)
    assert [motion.frames for motion in (*actions["jump"], *rests)] == [40, 20]
    assert measure_rest(rests, {"stand": [moving(0.2)], "run": [moving(4.0)]})["after"] == pytest.approx(0.25)
    assert measure_rest(rests, {"run": [moving(4.0)]})["after"] is None
    assert split_rest(actions, 0.0) == (actions, []) and measure_rest([], {})["after"] is None


def test_actions_beyond_a_factor_of_two_and_bodies_that_float_are_named(capsys):
    def row(energy, toe, after):
        life = {"sliding_cm": None, "hand_step_cm": 1.0, "rest_energy": 1.0}
        shares = dict.fromkeys(("shown", "ceiling", "chance", "found", "real_found"))
        real = {**life, "energy": 1.0, "lower_toe_cm": 1.0}
        return {
            **shares,
            "lively": 0.75,
            "after": after,
            "sampled": {**life, "energy": energy, "lower_toe_cm": toe},
            "real": real,
        }

    results = {"walk": row(1.9, 3.0, None), "dance": row(0.3, 5.2, None), "jump": row(1.0, 1.0, 0.1)}
    print_report(results, Console(width=80))
    lines = capsys.readouterr().out.splitlines()
    assert not any("…" in line for line in lines) and "this factor in 2 of 3" in lines[-2]
    named = dict(line.rsplit(": ", 1) for line in lines if ": " in line)
    assert named["energy (whole) beyond a factor of 2 of recordings"] == "dance"
    assert named["energy (calmest) beyond a factor of 2 of recordings"] == "none"
    assert named["energy (after) beyond a factor of 2 of recordings"] == "jump"
    assert named["floating by more than 2.5 cm"] == "dance"


def test_recordings_of_one_energy_are_always_within_the_factor_and_mixed_ones_often_not():
    assert share_lively([moving(1.0)] * 3, 6) == 1.0
    assert share_lively([moving(0.0)] * 3, 6) is None
    mixed = [moving(0.1)] * 5 + [moving(1.0)] + [moving(9.0)] * 5
    assert 0 < share_lively(mixed, 1) < 0.25
    assert share_lively(mixed, 1) < share_lively(mixed, 9)


def test_sentences_of_the_training_are_asked_where_wanted():
    config = OmegaConf.create({"seen": True, "sentences": 2})
    assert loaded("actions").sentences(config, "sit") == CONTENTS["sit"].sentences[:2]


def test_a_motion_has_frozen_if_it_has_less_than_a_tenth_of_the_energy_of_recordings():
    energy = measure_plausibility([moving(1.0), moving(2.0), moving(9.0)])["energy"]
    slow = 2.0 * FROZEN**0.5
    sampled = [moving(0.0), moving(0.99 * slow), moving(1.01 * slow)]
    assert [has_frozen(motion, energy) for motion in sampled] == [True, True, False]


def test_contents_that_geometry_cannot_recognise_have_no_table_by_distance(capsys):
    print_by_distance({"salsa": {"sentences": {}}}, Console())
    assert capsys.readouterr().out == ""
