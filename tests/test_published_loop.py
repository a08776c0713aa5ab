"""The published loop as a method: the same motions as `stmc_paper`, with two calls a step over all padded crops."""

import pytest
import torch
from helpers.tiny_model import tiny

import stmc
from stmc.evaluation.published_sampling import published_loop

TIMELINES = [
    "walk # 0 # 2 # legs\nwave # 0.5 # 1.5 # right arm",
    "sit # 0 # 1\nstand # 1 # 2.5",
]


def test_the_published_loop_gives_the_motions_of_the_method_of_the_paper():
    model = tiny()
    settings = {"seed": [3, 4], "steps": 12, "clean_feet": False}
    theirs = model.generate(TIMELINES, method=published_loop(model), **settings)
    ours = model.generate(TIMELINES, method="stmc_paper", **settings)
    for one, other in zip(theirs, ours, strict=True):
        assert one.frames == other.frames
        assert torch.allclose(one.joints, other.joints, atol=1e-4)


def test_the_published_loop_calls_the_network_twice_a_step_over_all_crops_padded_to_the_longest(monkeypatch):
    model, shapes = tiny(), []
    network = type(model.network)
    forward = network.forward
    monkeypatch.setattr(
        network, "forward", lambda self, x, *rest: shapes.append(tuple(x.shape[:2])) or forward(self, x, *rest)
    )
    model.generate(TIMELINES, method=published_loop(model), steps=3, clean_feet=False)
    crops = [crop for plan in model.plans([stmc.Timeline.parse(text) for text in TIMELINES]) for crop in plan.crops]
    assert shapes == [(len(crops), max(crop.frames for crop in crops))] * 6


def test_a_network_with_a_text_for_every_frame_is_refused():
    with pytest.raises(ValueError, match="FlowMdm: the published loop needs one text per crop"):
        published_loop(stmc.load("flow_mdm_wide"))
