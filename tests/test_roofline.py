"""The roofline of a denoising step: operations counted by hand."""

import torch
from helpers.tiny_model import tiny

import stmc
from stmc.evaluation.roofline import Roofline, _Traffic, measure_roofline


def test_the_operations_of_a_step_are_those_of_its_matrix_products(monkeypatch):
    monkeypatch.setattr("stmc.evaluation.roofline._MATRIX", 32)
    monkeypatch.setattr("stmc.evaluation.roofline._COPIED", 32)
    model, frames = tiny(), 40
    roofline = measure_roofline(model, model.plans([stmc.Timeline.parse("walk # 0 # 2")]))
    tokens, width, features = frames + 4, 16, 205  # the step, a word and two registers come before the frames
    layer = tokens * (4 * width**2 + 2 * width * 32) + 2 * tokens**2 * width
    ends = 2 * frames * features * width + 2 * width**2
    assert roofline.flops == 2 * 2 * (layer + ends)  # multiply and add, with the text and without it


def test_bytes_are_those_of_operations_and_views_move_none():
    a, b = torch.zeros(10, 20), torch.zeros(20, 5)
    with _Traffic() as traffic:
        (a @ b).T[None]
    assert traffic.moved == 4 * (200 + 100 + 50)


def test_the_higher_ceiling_is_the_shortest_time():
    assert Roofline(flops=10, moved=1, seconds=8, peak_flops=5, bandwidth=1).floor == 2
    assert Roofline(flops=1, moved=12, seconds=8, peak_flops=5, bandwidth=3).efficiency == 0.5
