"""MDM-SMPL against PyTorch's own transformer layer, its promises about padding, and the published code."""

import zlib

import numpy as np
import pytest
import torch
from conftest import checked, golden, golden_sets
from helpers.published_networks import close_waves, interleaved, waves
from torch import Tensor, nn

from stmc.denoisers import Denoiser, MdmSmpl
from stmc.diffusion.tensors import mask


@pytest.fixture
def network() -> MdmSmpl:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return MdmSmpl(7, 5, width=16, feedforward=32, layers=2, heads=4).eval()


def inputs(batch: int = 3, frames: int = 9, words: int = 2) -> tuple[Tensor, Tensor, Tensor]:
    draw = torch.Generator().manual_seed(1)
    x, text = torch.randn(batch, frames, 7, generator=draw), torch.randn(batch, words, 5, generator=draw)
    return x, torch.randint(0, 100, (batch,), generator=draw), text


def test_it_is_a_denoiser(network):
    assert isinstance(network, Denoiser)
    assert network(*inputs()).shape == (3, 9, 7)


@torch.no_grad()
def test_the_layers_are_pytorchs_pre_norm_layers_under_the_same_names(network):
    reference = nn.TransformerEncoderLayer(16, 4, 32, activation="gelu", batch_first=True, norm_first=True).eval()
    tokens = torch.randn(3, 6, 16)
    present = mask(torch.tensor([6, 2, 4]))
    for layer in network.seqTransEncoder.layers:
        reference.load_state_dict(layer.state_dict(), strict=True)
        expected = reference(tokens, src_key_padding_mask=~present)
        actual = layer(tokens, present[:, None, None])
        torch.testing.assert_close(actual[present], expected[present], atol=1e-5, rtol=0)


@torch.no_grad()
def test_what_stands_in_the_padding_influences_no_frame(network):
    x, t, text = inputs()
    present, words = mask(torch.tensor([9, 4, 1])), mask(torch.tensor([2, 1, 2]))
    clean = network(x, t, text, words, present)
    dirty_x, dirty_text = x.masked_fill(~present[..., None], 1e3), text.masked_fill(~words[..., None], -1e3)
    dirty = network(dirty_x, t, dirty_text, words, present)
    assert torch.equal(clean[present], dirty[present])


@torch.no_grad()
def test_a_padded_row_gives_what_it_gives_alone(network):
    x, t, text = inputs()
    padded = network(x, t, text, None, mask(torch.tensor([9, 4, 6])))
    alone = network(x[1:2, :4], t[1:2], text[1:2])
    torch.testing.assert_close(padded[1:2, :4], alone, atol=1e-5, rtol=0)


@torch.no_grad()
def test_full_masks_are_no_masks(network):
    x, t, text = inputs()
    full = network(x, t, text, torch.ones(3, 2, dtype=torch.bool), torch.ones(3, 9, dtype=torch.bool))
    assert torch.equal(full, network(x, t, text))


@torch.no_grad()
def test_step_text_and_order_of_frames_all_matter(network):
    x, t, text = inputs()
    before = network(x, t, text)
    assert not torch.allclose(before, network(x, (t + 1) % 100, text), atol=1e-4)
    assert not torch.allclose(before, network(x, t, text + 1), atol=1e-4)
    assert not torch.allclose(before, network(x.flip(1), t, text).flip(1), atol=1e-4)


def test_every_parameter_learns(network):
    x, t, text = inputs()
    network.train()(x, t, text, None, mask(torch.tensor([9, 4, 6]))).square().mean().backward()
    silent = [name for name, parameter in network.named_parameters() if not parameter.grad.abs().max() > 0]
    assert silent == []


@torch.no_grad()
def test_dropout_acts_in_training_only(network):
    assert torch.equal(network(*inputs()), network(*inputs()))
    with torch.random.fork_rng():
        network.train()
        assert not torch.equal(network(*inputs()), network(*inputs()))


@torch.no_grad()
def test_half_precision_is_close_to_full(network):
    x, t, text = inputs()
    present = mask(torch.tensor([9, 4, 6]))
    full = network(x, t, text, None, present)
    with torch.autocast("cpu", torch.bfloat16):
        half = network(x, t, text, None, present)
    assert half.dtype == torch.bfloat16
    assert (half - full)[present].abs().max() < 0.05 * full[present].abs().max()


def test_what_cannot_be_built_or_denoised_is_an_error():
    with pytest.raises(ValueError, match=r"width 10 must be even and a multiple of heads \(4\)"):
        MdmSmpl(7, 5, width=10, heads=4)
    network = MdmSmpl(7, 5, width=4, feedforward=4, layers=1, heads=1)
    with pytest.raises(ValueError, match="5001 tokens"):
        network(torch.zeros(1, 4997, 7), torch.zeros(1, dtype=torch.int64), torch.zeros(1, 1, 5))


# Parity with the published code -----------------------------------------------------------------------

NETWORKS = {"denoiser_full": 1e-4, "denoiser_small": 3e-6, "denoiser_small_multitoken": 3e-6}
"""Golden networks and how far float32 may stray."""


def golden_network(meta: dict) -> MdmSmpl:
    """The network of one golden file, filled by the recipe of its README, section 0."""
    config = meta["config"]
    sizes = [config[key] for key in ("latent_dim", "ff_size", "num_layers", "num_heads")]
    network = MdmSmpl(config["nfeats"], config["tx_dim"], *sizes, registers=config["nb_registers"])
    weights = {}
    for name, value in network.state_dict().items():
        rng = np.random.default_rng(zlib.crc32(f"{meta['weight_seed']}:{name}".encode()))
        weight = rng.standard_normal(tuple(value.shape)).astype(np.float32) * np.float32(0.05)
        weights[name] = weight + 1 if name in meta["layernorm_weights"] else weight
        assert zlib.crc32(weights[name].tobytes()) == meta["weight_crc32"][name], name
    network.load_state_dict({name: torch.from_numpy(weight) for name, weight in weights.items()})
    return network.eval()


def names_and_shapes_are_those_of_the_published_network(folder, name):
    meta = golden(folder, "denoiser_meta.json")[name]
    network = golden_network(meta)
    assert {key: list(value.shape) for key, value in network.state_dict().items()} == meta["state_dict_shapes"]
    [shape] = meta["nonpersistent_buffers"].values()
    assert shape == [len(network.positions), 1, network.positions.shape[1]]
    rows, columns, values = map(torch.tensor, zip(*meta["pe_probe"], strict=True))
    table = interleaved(*waves(rows, shape[-1]))
    close_waves(values[:, None], table.gather(1, columns[:, None]), rows)


@pytest.mark.parametrize("width", [16, 64, 512])
def test_positions_are_sines_and_cosines_as_exact_as_float32_allows(width):
    network = MdmSmpl(7, 5, width=width, feedforward=4, layers=1, heads=1)
    rows = torch.arange(len(network.positions))
    close_waves(network.positions, interleaved(*waves(rows, width)), rows)


def the_default_sizes_are_those_of_the_published_checkpoint(folder):
    shapes = golden(folder, "lightning_checkpoint_keys.json")["state_dict_shapes_full"]
    prefix = "denoiser."
    expected = {key.removeprefix(prefix): value for key, value in shapes.items() if key.startswith(prefix)}
    assert {key: list(value.shape) for key, value in MdmSmpl(205, 512).state_dict().items()} == expected


@torch.no_grad()
def outputs_are_those_of_the_published_network(folder, name, tolerance):
    data = {key: torch.from_numpy(value) for key, value in golden(folder, f"{name}.npz").items() if value.ndim}
    network = golden_network(golden(folder, "denoiser_meta.json")[name])
    present, words = mask(data["lengths"], data["x"].shape[1]), mask(data["tx_lengths"], data["tx"].shape[1])
    step = network.timestep_encoder(network.positions[data["t"]])
    torch.testing.assert_close(step, data["time_emb"], atol=tolerance, rtol=0)
    torch.testing.assert_close(network.tx_embedding(data["tx"])[words], data["tx_emb"][words], atol=tolerance, rtol=0)
    out = network(data["x"], data["t"], data["tx"], words, present)
    for reference in (data["out"], data["out_from_f64"]):
        torch.testing.assert_close(out[present], reference[present], atol=tolerance, rtol=0)


@pytest.mark.golden
@pytest.mark.parametrize("folder", golden_sets("stmc"))
def test_mdm_smpl_is_the_published_network(folder, subtests):
    checked(
        subtests,
        [
            the_default_sizes_are_those_of_the_published_checkpoint,
            *((names_and_shapes_are_those_of_the_published_network, each) for each in NETWORKS),
            *((outputs_are_those_of_the_published_network, *each) for each in NETWORKS.items()),
        ],
        folder,
    )


def test_with_a_fixed_place_for_words_padding_a_text_changes_nothing() -> None:
    """The published network moves the frames when a longer text joins the batch; `words` keeps them in place."""
    torch.manual_seed(0)
    x, t, text = torch.randn(1, 9, 7), torch.tensor([3]), torch.randn(1, 3, 5)
    padded = torch.cat([text, torch.randn(1, 4, 5)], dim=1)
    exists = torch.tensor([[True] * 3 + [False] * 4])
    sizes = {"features": 7, "text_width": 5, "width": 16, "feedforward": 16, "layers": 1, "heads": 2}
    for words, same in ((4, True), (None, False)):
        network = MdmSmpl(**sizes, words=words).eval()
        alone, beside = network(x, t, text), network(x, t, padded, exists)
        assert torch.allclose(alone, beside, atol=1e-5) is same
