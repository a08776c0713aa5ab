"""Configs of earlier versions with today's names."""

import pytest
from helpers.scripts import configured
from omegaconf import OmegaConf

from stmc.settings.renamed import with_new_names, with_new_paths
from stmc.training.resuming import deciding_settings, differences


def test_old_keys_have_todays_names_wherever_they_stand_and_todays_win():
    old = {"spread": "std", "late": 0.2, "denoiser": {"window": 196, "layers": 2}, "parts": [{"late": 1}]}
    assert with_new_names(old) == {
        "noise_scale": "std",
        "stitch_from": 0.2,
        "denoiser": {"fixed_length": 196, "layers": 2},
        "parts": [{"stitch_from": 1}],
    }
    assert with_new_names({"late": 0.2, "stitch_from": 0.5}) == {"stitch_from": 0.5}


def test_settings_of_an_earlier_training_have_todays_paths_and_no_other_setting_does():
    old = {"training.rate": 1e-3, "training.steps": 4, "denoiser.rate": 2.0, "data.corpus.least": 2}
    old["data.corpus._target_"] = "stmc.data.dataset.Corpus"
    assert with_new_paths(old) == {
        "training.lr": 1e-3,
        "training.steps": 4,
        "denoiser.rate": 2.0,
        "data.dataset.min_clips": 2,
        "data.dataset._target_": "stmc.training.data.dataset.Dataset",
    }


def test_arguments_have_todays_names_beside_their_own_class_alone():
    old = {"_target_": "stmc.denoisers.FlowMdm", "horizon": 100, "skipped": 0.05, "width": 16}
    own = {"_target_": "mylab.Net", "horizon": 100}
    new = {"_target_": "stmc.denoisers.FlowMdm", "attention_window": 100, "stochastic_depth": 0.05, "width": 16}
    assert with_new_names({"denoiser": old, "other": own}) == {"denoiser": new, "other": own}
    flat = {f"denoiser.{name}": value for name, value in old.items()}
    assert with_new_paths(flat) == {f"denoiser.{name}": value for name, value in new.items()}
    flat = {f"denoiser.{name}": value for name, value in own.items()}
    assert with_new_paths(flat) == flat
    assert with_new_names({"_target_": ["no", "name"]}) == {"_target_": ["no", "name"]}


ONE_RECORD = {"_target_": "stmc.training.data.batches.Sampling", "pieces": 1}
ENTRIES = ONE_RECORD | {"rows": 128, "balance": 0.0, "slowest": 1.0, "fastest": 1.0, "pool": 1, "longest": 10.0}
BEGUN = {
    "train": ONE_RECORD | {"rows": 128, "balance": 0.4, "slowest": 0.85, "fastest": 1.2, "pool": 16},
    "train_flow_wide": ONE_RECORD
    | {"rows": 40, "balance": 0.3, "slowest": 0.9, "fastest": 1.1, "pool": 16, "compose_prob": 0.5, "receivers": "any"}
    | {"compose_legs_prob": 0.2, "from_start_prob": 0.5, "texts_per_row": [1, 4]},
    "train_humanml3d": ENTRIES
    | {"order": "epochs", "trim": 0.1, "trimmed": "in_all", "uncond_crop_prob": 0.05, "text_dropout": 0.0526},
    "train_flow_humanml3d": ENTRIES
    | {"rows": 64, "order": "epochs", "drop_last": True, "trim": 0.0, "uncond_crop_prob": 0.0, "text_dropout": 0.1},
    "train_flow_babel": ONE_RECORD
    | {"rows": 64, "balance": 0.4, "slowest": 0.85, "fastest": 1.2, "pool": 1, "order": "rows", "drop_last": True}
    | {"longest": 6.6667, "text_dropout": 0.1, "uncond_crop_prob": 0.0, "trim": 0.0},
}
"""What checkpoints say that were begun when one record had the settings of all recipes of batches."""


def begun(sampling: dict) -> dict:
    return with_new_paths(deciding_settings({"data": {"sampling": sampling}}))


def today(name: str, *overrides: str) -> dict:
    return deciding_settings({"data": {"sampling": OmegaConf.to_container(configured(name, *overrides).data.sampling)}})


@pytest.mark.parametrize("name", BEGUN)
@pytest.mark.parametrize("target", ["stmc.data.batches.Sampling", "stmc.training.data.batches.Sampling"])
def test_a_training_that_was_begun_with_the_one_record_of_all_batches_has_todays_recipe(name, target):
    assert differences(begun(BEGUN[name] | {"_target_": target}), today(name)) == []


def test_a_setting_of_that_record_that_changed_batches_and_that_todays_recipe_lacks_is_named():
    either_end = {name: value for name, value in BEGUN["train_humanml3d"].items() if name != "trimmed"}
    assert differences(begun(either_end), today("train_humanml3d")) == ["data.sampling.trimmed: either_end → absent"]
    composed = BEGUN["train_humanml3d"] | {"compose_prob": 0.5}
    assert differences(begun(composed), today("train_humanml3d")) == ["data.sampling.compose_prob: 0.5 → absent"]
    in_all = BEGUN["train"] | {"trimmed": "in_all"}
    assert differences(begun(in_all), today("train")) == ["data.sampling.trimmed: in_all → absent"]
    assert differences(begun(BEGUN["train"] | {"trimmed": "either_end", "texts_per_row": [1, 1]}), today("train")) == []


def test_what_was_in_an_earlier_record_by_another_name_goes_to_todays_recipe_and_other_recipes_stay_as_they_are():
    old = BEGUN["train"] | {"composed": 0.5, "emphasis": {"squat": 3}}
    new = today("train", "+data.sampling.compose_prob=0.5", "+data.sampling.emphasis={squat: 3}")
    assert differences(begun(old), new) == []
    own = {"data.sampling._target_": "mylab.Mine", "data.sampling.order": "rows"}
    assert with_new_paths(own) == own
