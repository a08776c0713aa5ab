"""Configs of earlier versions with today's names."""

from stmc.settings.renamed import with_new_names, with_new_paths


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
