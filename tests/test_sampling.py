"""The one list of sampling settings: what fits, what is left open, and who decides then."""

import dataclasses
import inspect
from typing import Unpack, get_type_hints

import pytest

import stmc
from stmc.composing.sampling import DEFAULT, Sampling, SamplingArguments
from stmc.settings.records import SettingError, field_infos, record_of


@pytest.mark.parametrize(
    "values",
    [
        {"steps": 0},
        {"steps": 1.5},
        {"steps": "ten"},
        {"steps": True},
        {"guidance": float("nan")},
        {"guidance": float("inf")},
        {"guidance": []},
        {"overlap": -0.1},
        {"overlap": "half"},
        {"sampler": "euler"},
        {"sampler": 3},
        {"noise_scale": "wide"},
        {"stitch_from": 1.0},
        {"stitch_from": -0.1},
        {"ape_steps": 1.5},
        {"ape_steps": True},
    ],
)
def test_a_setting_that_does_not_fit_is_refused_in_one_sentence_that_names_it(values):
    [name] = values
    with pytest.raises(SettingError, match=rf"^{name}=") as caught:
        record_of(Sampling, values)
    assert len(str(caught.value)) < 200
    assert "\n" not in str(caught.value)


def test_every_setting_says_what_it_is_and_is_open_unless_said():
    assert list(field_infos(Sampling)) == [field.name for field in dataclasses.fields(Sampling)]
    assert all(each.help for each in field_infos(Sampling).values())
    assert not Sampling().given


def test_a_sampler_is_a_name_or_any_function():
    assert Sampling(sampler="ddim").given == {"sampler": "ddim"}
    assert Sampling(sampler=stmc.ddim).sampler is stmc.ddim


def test_what_is_left_open_is_the_others_and_nothing_else():
    own = Sampling(guidance=1.5, stitch_from=0.2)
    assert Sampling(stitch_from=0.0).with_defaults(own).with_defaults(DEFAULT) == dataclasses.replace(
        DEFAULT, guidance=1.5, stitch_from=0.0
    )


def test_editors_complete_and_check_the_settings_of_generate():
    """Their arguments are typed one by one, as the record of settings has them."""
    arguments = get_type_hints(SamplingArguments)
    record = get_type_hints(Sampling)
    assert arguments == {each.name: record[each.name] for each in dataclasses.fields(Sampling)}
    assert not SamplingArguments.__required_keys__
    for function in (stmc.Model.generate, stmc.Model.settings):
        hints = get_type_hints(inspect.unwrap(function))
        assert hints["settings"] == Unpack[SamplingArguments]
