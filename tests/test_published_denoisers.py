"""MDM and MotionDiffuse against PyTorch's own layers and plain formulas, and their promises about padding and texts."""

import pytest
import torch
from torch import Tensor, nn

from stmc.denoisers import Denoiser, MdmDecoder, MdmEncoder, MotionDiffuse, Network
from stmc.denoisers.layers import DecoderLayer, PostNormLayer
from stmc.diffusion.statistics import WIDEST, Statistics
from stmc.diffusion.tensors import mask

SIZES = {"features": 7, "text_width": 5, "width": 16, "feedforward": 32, "layers": 2, "heads": 4}
READING = {"text_latent_width": 8, "text_feedforward": 16, "text_layers": 2, "text_heads": 2}
NETWORKS = {
    "encoder": lambda: MdmEncoder(**SIZES),
    "decoder": lambda: MdmDecoder(**SIZES),
    "decoder, step": lambda: MdmDecoder(**SIZES, leading="step"),
    "decoder, step and text": lambda: MdmDecoder(**SIZES, leading="step_and_text"),
    "motion diffuse": lambda: MotionDiffuse(**SIZES, **READING, frames=12),
}
MANY_WORDS = ["decoder", "decoder, step", "motion diffuse"]


def seeded(name: str) -> Network:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return NETWORKS[name]().eval()


@pytest.fixture(params=NETWORKS)
def network(request) -> Network:
    return seeded(request.param)


def inputs(words: int = 1, batch: int = 3, frames: int = 9) -> tuple[Tensor, Tensor, Tensor]:
    draw = torch.Generator().manual_seed(1)
    x, text = torch.randn(batch, frames, 7, generator=draw), torch.randn(batch, words, 5, generator=draw)
    return x, torch.randint(0, 100, (batch,), generator=draw), text


def test_they_are_denoisers(network):
    assert isinstance(network, Denoiser) and isinstance(network, Network)
    assert network(*inputs()).shape == (3, 9, 7)


@torch.no_grad()
def test_a_text_that_was_read_once_gives_the_same_answer(network):
    x, t, text = inputs()
    assert torch.equal(network.denoise(x, t, network.encode_text(text)), network(x, t, text))


@torch.no_grad()
def test_what_stands_in_the_padding_influences_no_frame(network):
    x, t, text = inputs()
    present = mask(torch.tensor([9, 4, 1]))
    clean = network(x, t, text, None, present)
    dirty = network(x.masked_fill(~present[..., None], 1e3), t, text, None, present)
    assert torch.equal(clean[present], dirty[present])
    alone = network(x[1:2, :4], t[1:2], text[1:2])
    torch.testing.assert_close(clean[1:2, :4], alone, atol=1e-5, rtol=0)


@torch.no_grad()
@pytest.mark.parametrize("name", MANY_WORDS)
def test_padding_a_text_leaves_an_answer_alone_as_mixed_says(name):
    network = seeded(name)
    x, t, text = inputs(words=3)
    assert network.supports_padding
    padded = torch.cat([text, torch.full((3, 2, 5), 1e3)], dim=1)
    beside = network(x, t, padded, mask(torch.tensor([3, 3, 3]), 5))
    torch.testing.assert_close(beside, network(x, t, text), atol=1e-4, rtol=0)


@torch.no_grad()
def test_full_masks_are_no_masks(network):
    x, t, text = inputs()
    full = network(x, t, text, torch.ones(3, 1, dtype=torch.bool), torch.ones(3, 9, dtype=torch.bool))
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
    words = torch.cat([text, text.flip(0)], dim=1) if isinstance(network, MotionDiffuse) else text
    network.train()(x, t, words, None, mask(torch.tensor([9, 4, 6]))).square().mean().backward()
    # A softmax over the memory does not notice what is added to all of its keys.
    learning = {name: parameter for name, parameter in network.named_parameters() if not name.endswith("key.bias")}
    assert [name for name, parameter in learning.items() if not parameter.grad.abs().max() > 0] == []


@torch.no_grad()
def test_dropout_acts_in_training_only():
    for name in ("encoder", "decoder"):
        network = seeded(name)
        assert torch.equal(network(*inputs()), network(*inputs()))
        with torch.random.fork_rng():
            network.train()
            assert not torch.equal(network(*inputs()), network(*inputs()))


def test_what_cannot_be_built_or_denoised_is_an_error():
    with pytest.raises(ValueError, match=r"width 16 must be even and a multiple of heads \(3\)"):
        MdmEncoder(**SIZES | {"heads": 3})
    with pytest.raises(ValueError, match=r"width 16 must be even and a multiple of heads \(3\)"):
        MotionDiffuse(**SIZES | {"heads": 3})
    with pytest.raises(ValueError, match="fixed_length 0 must be 1 to 4999 frames"):
        MdmEncoder(**SIZES, fixed_length=0)
    with pytest.raises((ValueError, TypeError), match="leading"):
        MdmDecoder(**SIZES, leading="text")
    with pytest.raises(ValueError, match="13 frames exceed the 12"):
        seeded("motion diffuse")(*inputs(frames=13))
    for name in ("encoder", "decoder, step and text"):
        with pytest.raises(ValueError, match="reads one word per text here; got 2"):
            seeded(name)(*inputs(words=2))
    with pytest.raises(ValueError, match="5001 tokens exceed the 5000"):
        MdmEncoder(1, 1, 2, 1, 1, 1)(torch.zeros(1, 5000, 1), torch.tensor([0]), torch.zeros(1, 1, 1))


# MDM ----------------------------------------------------------------------------------------------


@torch.no_grad()
def test_layers_are_pytorchs_post_norm_layers_under_the_same_names():
    reference = nn.TransformerEncoderLayer(16, 4, 32, activation="gelu", batch_first=True).eval()
    layer = PostNormLayer(16, 32, 4, 0.1).eval()
    layer.load_state_dict(reference.state_dict())
    tokens, present = torch.randn(3, 6, 16), mask(torch.tensor([6, 2, 4]))
    expected = reference(tokens, src_key_padding_mask=~present)
    torch.testing.assert_close(layer(tokens, present[:, None, None])[present], expected[present], atol=1e-5, rtol=0)

    reference = nn.TransformerDecoderLayer(16, 4, 32, activation="gelu", batch_first=True).eval()
    layer = DecoderLayer(16, 32, 4, 0.1).eval()
    layer.load_state_dict(reference.state_dict())
    memory, words = torch.randn(3, 5, 16), mask(torch.tensor([1, 5, 3]))
    expected = reference(tokens, memory, tgt_key_padding_mask=~present, memory_key_padding_mask=~words)
    actual = layer(tokens, memory, present[:, None, None], words[:, None, None])
    torch.testing.assert_close(actual[present], expected[present], atol=1e-5, rtol=0)


@torch.no_grad()
def test_no_text_is_the_same_to_the_decoder_in_one_word_of_zeros_and_in_many():
    network = seeded("decoder")
    x, t, _ = inputs()
    many = network(x, t, torch.zeros(3, 6, 5), mask(torch.tensor([6, 2, 4])))
    torch.testing.assert_close(network(x, t, torch.zeros(3, 1, 5)), many, atol=1e-5, rtol=0)


@torch.no_grad()
def test_the_window_decides_what_is_asked_of_mdm_and_not_how_it_answers():
    wide, narrow = seeded("encoder"), MdmEncoder(**SIZES, fixed_length=None).eval()
    narrow.load_state_dict(wide.state_dict())
    assert wide.fixed_length == 196 and narrow.fixed_length is None
    assert torch.equal(wide(*inputs()), narrow(*inputs()))


# MotionDiffuse ------------------------------------------------------------------------------------


@torch.no_grad()
def test_linear_attention_is_its_formula():
    """Frame by frame and head by head: softmax of the query over features, of each key's feature over frames."""
    network = seeded("motion diffuse")
    block = network.temporal_decoder_blocks[0].sa_block
    tokens, present = torch.randn(1, 5, 16), torch.tensor([[True, True, True, True, False]])
    block.proj_out = nn.Identity()
    block.proj_out.forward = lambda mixed, steering: mixed
    actual = block(tokens, tokens, torch.zeros(1, 1, 64), present)[0]
    query, key, value = (part(tokens[0]) for part in (block.query, block.key, block.value))
    for head in range(4):
        own = slice(4 * head, 4 * head + 4)
        weights = key[:4, own].softmax(dim=0)
        for frame in range(5):
            asked = query[frame, own].softmax(dim=0)
            expected = sum(asked @ weights[other] * value[other, own] for other in range(4))
            torch.testing.assert_close(actual[frame, own], expected, atol=1e-6, rtol=0)


@torch.no_grad()
def test_the_first_word_stands_for_the_text_and_the_others_have_no_order():
    network = seeded("motion diffuse")
    x, t, text = inputs(words=6)
    answer = network(x, t, text)
    torch.testing.assert_close(network(x, t, text[:, [0, 4, 2, 1, 5, 3]]), answer, atol=1e-5, rtol=0)
    assert not torch.allclose(network(x, t, text[:, [1, 0, 2, 3, 4, 5]]), answer, atol=1e-4)


@torch.no_grad()
def test_weights_restated_for_other_statistics_say_the_same_motion(network):
    x, t, text = inputs()
    draw = torch.Generator().manual_seed(2)
    old = Statistics(torch.randn(7, generator=draw), torch.rand(7, generator=draw) + 0.5)
    new = Statistics(torch.randn(7, generator=draw), old.std * (1 + (WIDEST - 1) * torch.rand(7, generator=draw)))
    before = old.restore(network(x, t, text))
    network.restate(old, new)
    torch.testing.assert_close(new.restore(network(new.normalise(old.restore(x)), t, text)), before, atol=1e-4, rtol=0)


@torch.no_grad()
def test_a_feature_divided_by_far_more_than_before_keeps_its_noise_small(network):
    old = Statistics(torch.zeros(7), torch.full((7,), 1e-3))
    first = network.get_submodule(network.ends[0])
    before = first.weight.clone()
    network.restate(old, Statistics(torch.zeros(7), torch.ones(7)))
    torch.testing.assert_close(first.weight, WIDEST * before)
