"""Every network against its paper's equations, in float64, with small random weights: parity for everybody."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from helpers import equations
from helpers.equations import Weights
from torch import Tensor, nn

from stmc.denoisers import FlowMdm, MdmDecoder, MdmEncoder, MdmSmpl, MotionDiffuse
from stmc.diffusion.tensors import mask
from stmc.evaluators import GuoEvaluator, Tmr

LENGTHS = [11, 7, 1]
STEPS = [0, 3, 9]
"""Small ones: the networks' tables are float32, whose last bits grow with the step."""
SIZES = {"features": 7, "text_width": 5, "width": 12, "feedforward": 18, "layers": 3, "heads": 3}


def drawn(*shape: int, seed: int = 1) -> Tensor:
    return torch.from_numpy(np.random.default_rng(seed).standard_normal(shape))


def filled(network: nn.Module, seed: int = 0) -> tuple[nn.Module, Weights]:
    """The network in float64 with every weight drawn, also those that start as zeros and ones; and the weights."""
    generator = np.random.default_rng(seed)
    for parameter in network.parameters():
        parameter.data = torch.from_numpy(0.3 * generator.standard_normal(parameter.shape))
    network = network.double().eval().requires_grad_(False)
    return network, Weights({name: value.numpy() for name, value in network.state_dict().items()})


def agree(actual: Tensor, expected: np.ndarray) -> None:
    """Within 1e-5 of the largest number."""
    np.testing.assert_allclose(actual.numpy(), expected, rtol=0, atol=1e-5 * np.abs(expected).max())


def padded_batch(words: list[int]) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Frames, steps, words and their two masks; what stands in the padding is large."""
    present, told = mask(torch.tensor(LENGTHS)), mask(torch.tensor(words))
    x = drawn(3, max(LENGTHS), 7) + 50.0 * ~present[..., None]
    text = drawn(3, max(words), 5, seed=2) + 50.0 * ~told[..., None]
    return x, torch.tensor(STEPS), text, told, present


def assert_rows(network: nn.Module, words: list[int], expected: Callable) -> None:
    """Each row of a padded batch is `expected(x, t, words)` of that sample alone."""
    x, t, text, told, present = padded_batch(words)
    answers = network(x, t, text, told if max(words) > 1 else None, present)
    for row, (length, count) in enumerate(zip(LENGTHS, words, strict=True)):
        alone = expected(x[row, :length].numpy(), STEPS[row], text[row, :count].numpy())
        agree(answers[row, :length], alone)


@pytest.mark.parametrize("words", [1, 4])
def test_mdm_smpl_is_its_equations(words):
    network, weights = filled(MdmSmpl(**SIZES, registers=3))
    assert_rows(network, [words] * 3, lambda x, t, text: equations.mdm_smpl(weights, 3, x, t, text))


def test_mdm_s_encoder_is_its_equations():
    network, weights = filled(MdmEncoder(**SIZES))
    assert_rows(network, [1, 1, 1], lambda x, t, text: equations.mdm_encoder(weights, 3, x, t, text[0]))


@pytest.mark.parametrize(("leading", "words"), [(None, [5, 1, 3]), ("step", [2, 4, 1]), ("step_and_text", [1, 1, 1])])
def test_mdm_s_decoder_is_its_equations(leading, words):
    network, weights = filled(MdmDecoder(**SIZES, leading=leading))
    assert_rows(network, words, lambda x, t, text: equations.mdm_decoder(weights, 3, x, t, text, leading))


def test_motion_diffuse_is_its_equations():
    reading = {"text_latent_width": 8, "text_feedforward": 10, "text_layers": 2, "text_heads": 2}
    network, weights = filled(MotionDiffuse(**SIZES, **reading, frames=13))
    assert_rows(network, [5, 1, 3], lambda x, t, text: equations.motion_diffuse(weights, 3, 2, x, t, text))


@pytest.mark.parametrize("attention_window", [2, 4, 40], ids=["many blocks", "few blocks", "at once"])
@pytest.mark.parametrize("conditioning", ["pccat", "sat", "cat"])
def test_flow_mdm_is_its_equations_in_both_modes(attention_window, conditioning):
    """Rows of other segments and other steps: of steps from 3 on positions are absolute."""
    sizes = SIZES | {"layers": 2, "heads": 2, "conditioning": conditioning}
    network, weights = filled(FlowMdm(**sizes, absolute_from=3, attention_window=attention_window))
    segments = [[0] * 4 + [1] * 5 + [2] * 2, [0] * 3 + [2] * 4, [1]]
    x, t, _, _, present = padded_batch([1, 1, 1])
    text = drawn(3, 3, 5, seed=4)
    segment = torch.tensor([row + [0] * (max(LENGTHS) - len(row)) for row in segments])
    # What stands behind the end belongs to no segment that begins there: only frames that exist are compared.
    answers = network(x, t, text, None, present, segment)
    for row, (length, step) in enumerate(zip(LENGTHS, STEPS, strict=True)):
        given = (x[row, :length].numpy(), step, text[row].numpy(), segments[row])
        expected = equations.flow_mdm(weights, 2, attention_window, step >= 3, *given, conditioning)
        agree(answers[row, :length], expected)


@pytest.mark.parametrize("variational", [True, False])
def test_tmr_is_its_equations(variational):
    network, weights = filled(Tmr(**SIZES, variational=variational))
    x, _, text, told, present = padded_batch([5, 1, 3])
    for encoder, name, rows, exists in (
        (network.motion_encoder, "motion_encoder", x, present),
        (network.text_encoder, "text_encoder", text, told),
    ):
        posterior = encoder(rows, exists)
        for row, count in enumerate(exists.sum(dim=1).tolist()):
            expected = equations.tmr_encoder(weights.of(name), 3, rows[row, :count].numpy())
            agree(posterior.mean[row], expected[0])
            if variational:
                agree(posterior.log_variance[row], expected[1])
    latents = drawn(3, 12, seed=3)
    decoded = network.motion_decoder(latents, present)
    for row, length in enumerate(LENGTHS):
        expected = equations.tmr_decoder(weights.of("motion_decoder"), 3, latents[row].numpy(), length)
        agree(decoded[row, :length], expected)


def test_guo_s_evaluator_is_its_equations():
    network, weights = filled(GuoEvaluator(seen=6, movements=(5, 7), motion_hidden=4, words=3, text_hidden=6, width=5))
    motions, lengths = drawn(3, 21, 8), [21, 9, 4]
    embedded = network.motions(motions, torch.tensor(lengths))
    for row, length in enumerate(lengths):
        movements = equations.guo_movements(weights.of("movement_encoder"), motions[row, :, :6].numpy())
        agree(embedded[row], equations.guo_reader(weights.of("motion_encoder"), movements[: length // 4]))
    words, kinds, counts = drawn(3, 6, 3, seed=2), torch.arange(18).reshape(3, 6) % 15, [6, 1, 4]
    spoken = nn.functional.one_hot(kinds, 15).double()
    embedded = network.texts(words, spoken, torch.tensor(counts))
    for row, count in enumerate(counts):
        read = weights.of("text_encoder")
        rows = words[row, :count].numpy() + read.linear("pos_emb", spoken[row, :count].numpy())
        agree(embedded[row], equations.guo_reader(read, rows))
