"""Body parts as seamless sequences: layouts, answers known in closed form, and the network's promises about them."""

import pytest
import torch
from helpers.collages import COLUMNS, GAP, STAND_NOD, WALK_WAVE, embeddings, last, plans_of, random_embeddings, timeline
from helpers.strategies import quietly
from helpers.strategies import timelines as any_timeline
from hypothesis import given
from torch import Tensor

from stmc.composing import SequenceDenoiser, body_sequences, compose_tracks, guided_sequences
from stmc.denoisers import Denoiser, FlowMdm
from stmc.diffusion import Noise, Schedule, ddim, ddpm
from stmc.diffusion.tensors import mask
from stmc.motion.body import BodyPart
from stmc.training.loss import Batch, Denoising, draw_noise

SCHEDULE = Schedule.cosine(20)


class ConstantPerFrame:
    """Predicts, for every frame, the number that stands for its text; remembers the shapes it is given."""

    def __init__(self) -> None:
        self.calls: list[tuple[int, int]] = []

    def __call__(self, x: Tensor, t: Tensor, text: Tensor, text_mask, mask, segment: Tensor) -> Tensor:
        self.calls.append(tuple(x.shape[:2]))
        return text.take_along_dim(segment[..., None], dim=1).expand_as(x)


def small_network(attention_window: int = 7, absolute_from: int = 10) -> FlowMdm:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        sizes = {"width": 16, "feedforward": 32, "layers": 2, "heads": 2}
        network = FlowMdm(10, 4, absolute_from, attention_window=attention_window, **sizes)
        with torch.no_grad():
            network.seqTransEncoder.pos_emb["absolute"].scale.fill_(2.0)
            for parameter in network.parameters():
                parameter.mul_(2.0)
        return network.eval()


# Layouts ----------------------------------------------------------------------------------------------------------


def test_parts_that_obey_the_same_share_a_sequence():
    [plan] = plans_of(WALK_WAVE, overlap=0)
    sequences = body_sequences(plan)
    texts = {
        tuple((plan.crops[crop].text, start, end) for crop, start, end in sequence): parts
        for sequence, parts in sequences.items()
    }
    walking = (("walk", 0, 40), ("run", 40, 74))
    waving = (("walk", 0, 14), ("wave", 14, 52), ("run", 52, 74))
    assert texts == {
        walking: (BodyPart.LEFT_ARM, BodyPart.LEGS, BodyPart.HEAD, BodyPart.SPINE),
        waving: (BodyPart.RIGHT_ARM,),
    }


@quietly
@given(any_timeline())
def test_sequences_cover_every_frame_of_every_part_once(drawn):
    [plan] = plans_of(drawn, overlap=0)
    sequences = body_sequences(plan)
    assert sorted(part for parts in sequences.values() for part in parts) == sorted(BodyPart)
    for sequence in sequences:
        assert [segment.start for segment in sequence] == [0, *(segment.end for segment in sequence[:-1])]
        assert sequence[-1].end == plan.frames


def test_a_plan_with_overlap_has_no_sequences():
    with pytest.raises(ValueError, match="overlap=0"):
        body_sequences(plans_of(WALK_WAVE)[0])


def test_a_text_without_an_embedding_and_one_of_two_words_are_errors():
    plans = plans_of(WALK_WAVE, overlap=0)
    table = embeddings(plans)
    with pytest.raises(ValueError, match=r"no embedding for \['wave'\]"):
        guided_sequences(ConstantPerFrame(), SCHEDULE, plans, {k: v for k, v in table.items() if k != "wave"})
    with pytest.raises(ValueError, match="one word, but 'run' has 2"):
        guided_sequences(ConstantPerFrame(), SCHEDULE, plans, table | {"run": torch.zeros(2, 1)})


# Closed form ------------------------------------------------------------------------------------------------------


def predictor(denoiser, timelines, weight: float, **options):
    plans = plans_of(*timelines, overlap=0)
    sequences = guided_sequences(denoiser, SCHEDULE, plans, embeddings(plans), weight, **options)
    return plans, compose_tracks(sequences, plans, COLUMNS)


@pytest.mark.parametrize("weight", [0.0, 1.0, 2.5])
def test_every_part_of_every_frame_is_what_its_owner_predicts(weight):
    plans, predict = predictor(ConstantPerFrame(), [WALK_WAVE, STAND_NOD, GAP], weight)
    table = {text: float(value) for text, value in embeddings(plans).items()}
    expected = torch.zeros(3, max(plan.frames for plan in plans), 10)
    for i, plan in enumerate(plans):
        for tile in plan.tiles:
            told = table[plan.crops[tile.crop].text or ""]
            expected[i, tile.start : tile.end, list(COLUMNS[tile.part])] = 100 + weight * (told - 100)
    assert isinstance(ConstantPerFrame(), SequenceDenoiser)
    torch.testing.assert_close(predict(torch.randn(expected.shape), 3), expected)
    x = torch.randn(expected.shape)
    torch.testing.assert_close(last(ddim(predict, SCHEDULE, x)), expected)


@pytest.mark.parametrize(("weight", "budget", "calls"), [
    (2.5, 10_000, [(4, 74), (4, 60)]),
    (1.0, 10_000, [(2, 74), (2, 60)]),
    (2.5, 130, [(1, 74)] * 4 + [(2, 60), (2, 55)]),
])  # fmt: skip
def test_calls_hold_no_more_than_their_budget_and_little_padding(weight, budget, calls):
    denoiser = ConstantPerFrame()
    alone = timeline(("sit", 0, 60))
    _, predict = predictor(denoiser, [WALK_WAVE, alone, timeline(("stand", 0, 55))], weight, budget=budget)
    predict(torch.randn(3, 74, 10), 0)
    assert denoiser.calls == calls


def test_a_timeline_without_a_text_is_denoised_once():
    denoiser = ConstantPerFrame()
    silent = timeline(("walk", 0, 20, "legs"))
    [plan] = plans_of(silent, overlap=0)
    plan = type(plan)(plan.frames, tuple(type(crop)(None, crop.start, crop.end) for crop in plan.crops), plan.tiles)
    guided_sequences(denoiser, SCHEDULE, [plan], embeddings([plan]), 2.5)(torch.randn(1, 20, 10), 0)
    assert denoiser.calls == [(1, 20)]


# The network on sequences -----------------------------------------------------------------------------------------


@torch.no_grad()
def test_it_is_a_denoiser_and_a_crop_is_a_sequence_of_one_segment():
    network, generator = small_network().double(), torch.Generator().manual_seed(0)
    assert isinstance(network, Denoiser)
    x, text = (torch.randn(shape, generator=generator, dtype=torch.float64) for shape in ((3, 30, 10), (3, 1, 4)))
    t = torch.tensor([2, 10, 19])
    together = network(x, t, text)
    segmented = network(x, t, text.expand(-1, 2, -1), None, None, torch.zeros(3, 30, dtype=torch.int64))
    torch.testing.assert_close(together, segmented, atol=1e-5, rtol=0)


@torch.no_grad()
@pytest.mark.parametrize("frames", [1, 7, 8, 21, 22, 28, 50])
def test_blocks_give_what_all_frames_at_once_give(frames):
    """Also at the ends of blocks, in the padding, and where segments end."""
    network, generator = small_network(), torch.Generator().manual_seed(frames)
    x, text = torch.randn(4, frames, 10, generator=generator), torch.randn(4, 3, 4, generator=generator)
    segment = torch.randint(3, (4, frames), generator=generator).sort(dim=1).values
    present = mask(torch.tensor([frames, frames, (frames + 1) // 2, 1]), frames)
    t = torch.tensor([19, 3, 3, 12])
    actual = network(x, t, text, None, present, segment)
    torch.testing.assert_close(
        actual[present], dense(network, x, t, text, present, segment)[present], atol=2e-5, rtol=0
    )


def dense(network: FlowMdm, x, t, text, present, segment) -> Tensor:
    """The same formulas, straight from the paper: every pair of frames, one row and one head at a time."""
    encoder, out = network.seqTransEncoder, []
    width = encoder.project_in.in_features
    step = network.embed_timestep["time_embed"](network.positions[t])
    for row in range(len(x)):
        absolute, ids = bool(t[row] >= network.absolute_from), segment[row]
        number = torch.arange(len(ids))
        place = number - torch.stack([number[ids == each].min() for each in ids])
        angle = place[:, None] / 10000 ** (torch.arange(width // 2) / (width // 2))
        frames = encoder.project_in(network.input_process["poseEmbedding"](x[row]))
        if absolute:
            frames = frames + encoder.pos_emb["absolute"].scale * torch.cat([angle.sin(), angle.cos()], dim=1)
        seen = ((number[:, None] - number).abs() <= network.attention_window) & present[row]
        seen = seen & (ids[:, None] == ids) if absolute else seen
        seen = seen | torch.eye(len(ids), dtype=torch.bool)
        condition = step[row] + network.embed_text(text[row])[ids]
        for (norm,), block in encoder.attn_layers.layers:
            normed = norm(frames)
            attends = hasattr(block, "to_q")
            frames = frames + (attended(block, normed, condition, seen, absolute) if attends else block.ff(normed))
        out.append(network.output_process["poseFinal"](encoder.project_out(encoder.attn_layers.final_norm(frames))))
    return torch.stack(out)


def attended(block, normed: Tensor, condition: Tensor, seen: Tensor, absolute: bool) -> Tensor:
    told = block.custom_query_fn(torch.cat([normed, condition], dim=1))
    found = []
    for head in range(block.heads):
        own = slice(64 * head, 64 * head + 64)
        query, key, value = block.to_q(told)[:, own], block.to_k(normed)[:, own], block.to_v(normed)[:, own]
        if not absolute:
            query, key = turned(query), turned(key)
        scores = (query @ key.T / 8).masked_fill(~seen, -torch.inf)
        found.append(scores.softmax(dim=1) @ value)
    return block.to_out(torch.cat(found, dim=1))


def turned(values: Tensor) -> Tensor:
    """Pairs of channels (i, i + 16) as complex numbers, turned by the frame's number times 10000^(-i/16)."""
    angle = torch.arange(len(values))[:, None] * 10000 ** (-torch.arange(16) / 16)
    pairs = torch.complex(values[:, :16], values[:, 16:32]) * torch.polar(torch.ones_like(angle), angle)
    return torch.cat([pairs.real, pairs.imag, values[:, 32:]], dim=1)


@torch.no_grad()
def test_relative_steps_do_not_know_where_in_the_sequence_they_are_and_absolute_ones_see_their_segment_alone():
    network = small_network()
    x, text = torch.randn(1, 60, 10), torch.randn(1, 2, 4)
    segment = torch.tensor([[0] * 25 + [1] * 35])
    relative, absolute = torch.tensor([3]), torch.tensor([15])
    depth = 2 * network.attention_window  # two layers
    whole = network(x, relative, text, None, None, segment)
    cut = network(x[:, 5:], relative, text, None, None, segment[:, 5:])
    torch.testing.assert_close(whole[:, 5 + depth :], cut[:, depth:], atol=1e-4, rtol=0)
    changed = x.clone()
    changed[:, 25:] += 1
    assert torch.equal(
        network(x, absolute, text, None, None, segment)[:, :25],
        network(changed, absolute, text, None, None, segment)[:, :25],
    )
    assert not torch.allclose(network(changed, relative, text, None, None, segment)[:, 24], whole[:, 24], atol=1e-3)
    assert not torch.allclose(
        network(x, absolute, text, None, None, segment)[:, 25:],
        network(x, absolute, text, None, None, 0 * segment)[:, 25:],
        atol=1e-3,
    )


@torch.no_grad()
def test_the_condition_makes_queries_only():
    """With one layer, a frame's answer does not depend on the text of any other frame, however near."""
    network = small_network()
    del network.seqTransEncoder.attn_layers.layers[2:]
    x, text, segment = torch.randn(1, 20, 10), torch.randn(1, 2, 4), torch.tensor([[0] * 10 + [1] * 10])
    other = torch.cat([text[:, :1], text[:, 1:] + 1], dim=1)
    before, after = (network(x, torch.tensor([3]), each, None, None, segment) for each in (text, other))
    assert torch.equal(before[:, :10], after[:, :10])
    assert not torch.allclose(before[:, 10:], after[:, 10:], atol=1e-3)


def test_in_training_rows_are_relative_or_absolute_by_chance_and_halves_of_layers_are_skipped():
    network = small_network(absolute_from=0).train()
    x, text = torch.randn(200, 9, 10), torch.randn(1, 1, 4).expand(200, -1, -1)
    x = x[:1].expand_as(x)
    network.seqTransEncoder.dropout.p = 0.0
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(0)
        network.seqTransEncoder.attn_layers.stochastic_depth = 0.0
        out = network(x, torch.full((200,), 5), text)
        assert len(torch.unique(out.round(decimals=3), dim=0)) == 2
        assert 70 < int((out - out[0]).abs().amax(dim=(1, 2)).lt(1e-3).sum()) < 130
        network.seqTransEncoder.attn_layers.stochastic_depth = 0.5
        absolute, t = torch.ones(1, dtype=torch.bool), torch.full((1,), 5)
        ways = [network.blended(x[:1], t, network.encode_text(text[:1]), absolute) for _ in range(100)]
        assert len(torch.unique(torch.cat(ways).round(decimals=3), dim=0)) == 2**4


def test_every_weight_learns_from_a_padded_batch_of_several_segments():
    network = small_network().train()
    network.seqTransEncoder.attn_layers.stochastic_depth = 0.0
    x, text = torch.randn(8, 30, 10), torch.randn(8, 2, 4)
    segment, present = (
        torch.tensor([[0] * 12 + [1] * 18]).expand(8, -1),
        mask(torch.tensor([30, 3, 30, 9, 30, 30, 20, 22])),
    )
    out = network(x, torch.randint(20, (8,)), text, None, present, segment)
    out[present].square().mean().backward()
    silent = [name for name, each in network.named_parameters() if each.grad is None or not each.grad.abs().max() > 0]
    assert silent == []
    assert all(each.grad.isfinite().all() for each in network.parameters())


def test_the_denoisers_objective_tells_of_segments():
    """The same motion with its texts in one order and in the other: the loss is that of what the network was told."""
    network, generator = small_network(), torch.Generator()
    motion, text = torch.randn(2, 30, 10), torch.randn(2, 2, 4)
    segment = torch.tensor([[0] * 12 + [1] * 18]).expand(2, -1)
    losses = []
    for each in (segment, 1 - segment):
        batch = Batch(motion, None, text, None, 60, segment=each)
        terms = Denoising(SCHEDULE)(network, batch, generator.manual_seed(0))
        t, noise = draw_noise(batch, SCHEDULE.steps, generator.manual_seed(0))
        out = network(SCHEDULE.q_sample(motion, t, noise), t, text, None, None, each)
        torch.testing.assert_close(terms, (out - motion).square().sum(dim=(0, 1)))
        losses.append(float(terms.detach().mean()))
    assert abs(losses[0] - losses[1]) > 1e-3


@torch.no_grad()
def test_half_precision_is_close_to_full_on_a_long_sequence():
    network = small_network()
    x, t, text = torch.randn(2, 100, 10), torch.tensor([3, 15]), torch.randn(2, 1, 4)
    full = network(x, t, text)
    with torch.autocast("cpu", torch.bfloat16):
        half = network(x, t, text)
    assert half.dtype == torch.bfloat16
    assert (half - full).abs().max() < 0.1 * full.abs().max()


def test_what_cannot_be_built_or_denoised_is_an_error():
    with pytest.raises(ValueError, match="width 15 must be even"):
        FlowMdm(10, 4, 0, width=15)
    with pytest.raises(ValueError, match="attention_window 0 must be at least 1"):
        FlowMdm(10, 4, 0, attention_window=0)
    with pytest.raises(ValueError, match="2 words per text; FlowMdm reads one"):
        small_network()(torch.zeros(1, 5, 10), torch.zeros(1, dtype=torch.int64), torch.zeros(1, 2, 4))


@torch.no_grad()
def test_a_motion_is_the_same_alone_and_in_a_batch():
    network, schedule = small_network(absolute_from=2).double(), Schedule.cosine(4)
    plans = plans_of(WALK_WAVE, STAND_NOD, GAP, overlap=0)
    table = {text: words.double() for text, words in random_embeddings(plans).items()}
    lengths = [plan.frames for plan in plans]

    def sampled(chosen: slice, budget: int) -> Tensor:
        some = plans[chosen]
        predict = compose_tracks(guided_sequences(network, schedule, some, table, budget=budget), some, COLUMNS)
        draw = Noise(range(5, 8)[chosen], lengths[chosen], 10, dtype=torch.float64)
        return last(ddpm(predict, schedule, draw(), draw))

    batch = sampled(slice(0, 3), 65536)
    for i, length in enumerate(lengths):
        alone = sampled(slice(i, i + 1), 1)
        torch.testing.assert_close(batch[i, :length], alone[0], atol=1e-6, rtol=0)
        assert not batch[i, length:].any()
