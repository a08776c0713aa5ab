"""What tests of the published networks share: golden weights by the recipe of the README, arrays, comparisons."""

import functools
import json
import math
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import numpy as np
import torch
from conftest import GOLDEN
from torch import Tensor, nn

from stmc.denoisers import MdmDecoder, MdmEncoder, MotionDiffuse, Network

RELATIVE = 1e-5
"""Of the largest value: golden/mdm/README.md, "Tolerances"."""


@functools.cache
def entries(name: str) -> dict[str, dict]:
    """The entries of a published state dict: shape, kind and whether it is the weight of a norm, by name."""
    listed = json.loads((GOLDEN / "mdm" / "state_dicts" / f"{name}.json").read_text("utf-8"))["entries"]
    return {entry["name"]: entry for entry in listed}


def weight(name: str, shape: tuple[int, ...], norm: bool, seed: int) -> Tensor:
    """Section 1 of the README."""
    rng = np.random.default_rng(zlib.crc32(f"{seed}:{name}".encode()))
    values = rng.standard_normal(shape).astype(np.float32) * np.float32(0.05)
    return torch.from_numpy(values + np.float32(1) if norm else values)


def filled(network: nn.Module, names: str, seed: int) -> Network:
    """The network with golden weights, all of them: names and shapes have to be the published ones."""
    parameters = {name: entry for name, entry in entries(names).items() if entry["kind"] == "parameter"}
    weights = {
        name: weight(name, tuple(entry["shape"]), entry["layernorm_weight"], seed) for name, entry in parameters.items()
    }
    network.load_state_dict(weights, strict=True)
    return network.eval().requires_grad_(False)


@functools.cache
def mdm(seed: int) -> MdmEncoder:
    return filled(MdmEncoder(263, 512), "mdm_trans_enc", seed)


@functools.cache
def mdm_decoder(names: str, seed: int, text_width: int = 512, leading: str | None = None) -> MdmDecoder:
    return filled(MdmDecoder(263, text_width, leading=leading), names, seed)


@functools.cache
def motion_diffuse(seed: int) -> MotionDiffuse:
    return filled(MotionDiffuse(263, 512), "motiondiffuse_t2m", seed)


def drawn(seed: int, shape: tuple[int, ...]) -> Tensor:
    """Inputs of the golden files."""
    return torch.from_numpy(np.random.default_rng(int(seed)).standard_normal(shape).astype(np.float32))


def frames(array) -> Tensor:
    """MDM's [batch, features, 1, frames] as ours, [batch, frames, features]."""
    return torch.as_tensor(np.asarray(array)).squeeze(2).transpose(1, 2).contiguous()


def close(actual: Tensor, expected, relative: float = RELATIVE) -> None:
    """Within `relative` of the largest expected value."""
    expected = torch.as_tensor(np.asarray(expected))
    torch.testing.assert_close(actual, expected, atol=relative * max(1.0, float(expected.abs().max())), rtol=0)


def limit_at(steps) -> float:
    """`RELATIVE`, and what the last bits of the steps' sinusoids make of it, which grow with the step."""
    return RELATIVE + 4e-8 * float(np.max(np.asarray(steps)))


def waves(steps: Tensor, width: int) -> tuple[Tensor, Tensor]:
    """Sines and cosines of float64, each [steps, width / 2]: what every table of positions or steps is made of."""
    frequency = torch.exp(torch.arange(width // 2, dtype=torch.float64) * (-2 * math.log(10000.0) / width))
    angle = steps.double()[:, None] * frequency
    return angle.sin(), angle.cos()


def close_waves(actual, expected: Tensor, steps: Tensor) -> None:
    """As float32 may have them: the last bits of a frequency, which no two processors share, grow with the step.

    Of the limit, 0.44 are the rounding of the exponent, 0.6 the exponential's last bit, 0.6 the product's.
    """
    limit = 2e-7 * (1 + steps.double())[:, None]
    error = (torch.as_tensor(np.asarray(actual)).double() - expected).abs()
    assert (error <= limit).all(), f"{float((error / limit).max()):.2f} of what float32 allows"


def interleaved(sines: Tensor, cosines: Tensor) -> Tensor:
    """A table of positions: sines in the even columns, cosines in the odd ones."""
    return torch.stack([sines, cosines], dim=-1).flatten(1)


def words_of(features: Tensor, ends) -> Tensor:
    """CLIP's features [texts, 77, width] with the word at the end of each text in front, as `ClipTokens` gives them."""
    rows = [torch.cat([row[end : end + 1], row[:end], row[end + 1 :]]) for row, end in zip(features, ends, strict=True)]
    return torch.stack(rows)


@contextmanager
def watched(modules: Mapping[str, nn.Module]) -> Iterator[dict[str, tuple[Tensor, Tensor]]]:
    """The first argument and the output of each module, by its name, once it was called."""
    seen: dict[str, tuple[Tensor, Tensor]] = {}
    handles = [
        module.register_forward_hook(lambda _, given, out, name=name: seen.update({name: (given[0], out)}))
        for name, module in modules.items()
    ]
    try:
        yield seen
    finally:
        for handle in handles:
            handle.remove()
