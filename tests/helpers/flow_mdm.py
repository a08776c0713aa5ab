"""What tests of FlowMDM share: networks with golden weights by the recipe of golden/flow/README.md, section 0."""

import functools
import json
from collections.abc import Sequence

import numpy as np
import torch
from conftest import GOLDEN
from helpers.published_networks import weight
from torch import Tensor

from stmc.denoisers import FlowMdm
from stmc.denoisers.flow_mdm_layers import HEAD

RELATIVE = 2e-5
"""Of the largest expected value: the README's tolerance of network outputs."""


@functools.cache
def entries(name: str) -> dict[str, dict]:
    """The entries of a published state dict by name: shape and kind."""
    listed = json.loads((GOLDEN / "flow" / "flowmdm_state_dicts.json").read_text("utf-8"))[name]
    return {entry["name"]: entry for entry in listed}


def parameters(name: str) -> dict[str, tuple[int, ...]]:
    """Shapes of what is learned; the rest are tables."""
    return {key: tuple(entry["shape"]) for key, entry in entries(name).items() if entry["kind"] != "buffer_official"}


@functools.cache
def flow_mdm(name: str, seed: int, absolute_from: int, attention_window: int) -> FlowMdm:
    """The network "small_humanml", "full_babel", … with golden weights, all of them."""
    shapes = parameters(name)
    features, text_width = shapes["output_process.poseFinal.weight"][0], shapes["embed_text.weight"][1]
    layers = "seqTransEncoder.attn_layers.layers."
    sizes = {
        "width": shapes["embed_text.weight"][0],
        "feedforward": shapes[f"{layers}1.1.ff.0.0.weight"][0],
        "layers": sum(key.endswith("to_q.weight") for key in shapes),
        "heads": shapes[f"{layers}0.1.to_q.weight"][0] // HEAD,
    }
    network = FlowMdm(features, text_width, absolute_from, attention_window=attention_window, **sizes)
    weights = {
        key: weight(key, shape, entries(name)[key]["kind"] == "norm_weight", seed) for key, shape in shapes.items()
    }
    network.load_state_dict(weights, strict=True)
    return network.eval().requires_grad_(False)


def segments(*lengths: Sequence[int]) -> Tensor:
    """[batch, frames]: the number of the segment that each frame of each row belongs to; 0 behind the last."""
    rows = [torch.from_numpy(np.repeat(np.arange(len(row)), row)) for row in lengths]
    return torch.nn.utils.rnn.pad_sequence(rows, batch_first=True)


def close(actual: Tensor, expected: Tensor) -> None:
    torch.testing.assert_close(actual, expected, atol=RELATIVE * float(expected.abs().max()), rtol=0)
