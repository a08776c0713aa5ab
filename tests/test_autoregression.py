"""Actions one after the other (TEACH): closed forms, a slow oracle, and what each action saw of the one before it."""

import dataclasses
from collections.abc import Callable, Sequence

import pytest
import torch
from helpers.tiny_model import tiny
from test_methods import OneWord
from test_model import GAP, NOD, WALK_WAVE, apart
from torch import Tensor

import stmc
from stmc.composing import METHODS, Run, slerp
from stmc.composing.autoregression import action_rounds
from stmc.denoisers import FlowMdm
from stmc.diffusion import Noise, Schedule, ddim, guide
from stmc.diffusion.statistics import Statistics
from stmc.editing.constraints import Hold
from stmc.model import Model
from stmc.settings.records import SettingError
from stmc.timeline import Timeline, single_track
from stmc.timeline.planning import look_back, plan

THREE_ACTIONS = Timeline.parse("walk # 0 # 2\njump # 2 # 3.5\nbow # 3.5 # 4")
TWO_ACTIONS = Timeline.parse("jump # 0 # 1\nbow # 1 # 3")
LONG = Timeline.parse("walk # 0 # 12\njump # 12 # 13")
TIMELINES = [THREE_ACTIONS, TWO_ACTIONS, NOD, LONG]
NUMBERS = {"": 0.0, "walk": 1.0, "jump": 2.0, "bow": 3.0}


@pytest.fixture(scope="module")
def model() -> Model:
    return tiny()


def encode_numbers(texts: Sequence[str]) -> tuple[Tensor, Tensor]:
    return torch.tensor([NUMBERS[text] for text in texts])[:, None, None], torch.ones(len(texts), dtype=torch.long)


def answering(denoiser: Callable[..., Tensor]) -> Model:
    """The tiny model with a denoiser that is told a text's number."""
    plain = Statistics(torch.zeros(1), torch.ones(1))
    return dataclasses.replace(tiny(), denoiser=denoiser, text_encoder=encode_numbers, text_statistics=plain)


def constant(x: Tensor, t: Tensor, text: Tensor, text_mask: Tensor | None, mask: Tensor | None) -> Tensor:
    return text[:, :1].expand_as(x)


def features(
    model: Model, timelines: Timeline | list[Timeline], method: str | stmc.Method = "teach_b", **settings
) -> Tensor:
    """What the method makes, normalised, padded with zeros."""
    found, method = [], METHODS[method] if isinstance(method, str) else method

    def watched(run: Run) -> Tensor:
        found.append(method.sample(run))
        return found[-1]

    model.generate(timelines, method=dataclasses.replace(method, sample=watched), **settings)
    return found[0]


def seeing(frames: int) -> stmc.Method:
    """Actions one after the other, each of which sees as many frames."""
    return stmc.Method(lambda run: run.autoregressive([look_back(plan, frames) for plan in run.plans(0)]), "")


# Closed forms -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("guidance", [1.0, 2.5])
def test_texts_that_each_ask_for_one_pose_have_it_from_their_first_frame_to_their_last(guidance):
    made = features(answering(constant), [THREE_ACTIONS, TWO_ACTIONS], steps=3, guidance=guidance)
    wanted = torch.tensor([[1.0] * 40 + [2.0] * 30 + [3.0] * 10, [2.0] * 20 + [3.0] * 40 + [0.0] * 20])
    torch.testing.assert_close(made, guidance * wanted[..., None].expand_as(made))


def test_an_action_sees_the_last_frames_before_it_as_noisy_as_itself():
    """DDIM's steps leave of a constant answer c, at every step, sqrt(alpha_bar) c and the noise that was begun with."""
    seen, schedule = [], Schedule.cosine(100)

    def watched(x, t, text, text_mask, mask):
        seen.append((x[0], int(t[0]), float(text[0, 0, 0])))
        return constant(x, t, text, text_mask, mask)

    features(answering(watched), TWO_ACTIONS, steps=4, seed=7, guidance=1.0, sampler=ddim)
    last, first = seen[-1], seen[4]
    assert (last[0].shape, last[2], first[2]) == ((3 + 40, 205), 3.0, 3.0)
    begun = Noise([(7, 1)], [43], 205)()[0]
    torch.testing.assert_close(first[0], begun)
    a, b = schedule.alpha_bar[first[1]], schedule.alpha_bar[last[1]]
    answers = torch.tensor([2.0] * 3 + [3.0] * 40)[:, None]  # the jump's last three frames, then the bow
    noise = (begun - a.sqrt() * answers) / (1 - a).sqrt()
    torch.testing.assert_close(last[0], (b.sqrt() * answers + (1 - b).sqrt() * noise).float(), atol=1e-5, rtol=1e-5)


def test_actions_that_stay_as_they_are_stay_as_the_first_was():
    """A denoiser that answers a text's number to one that begins a motion, and else what it sees first of it."""

    def stay(x, t, text, text_mask, mask):
        begins = (text == NUMBERS["walk"])[:, :1]
        return torch.where(begins, text[:, :1], x[:, :1, :1]).expand_as(x)

    made = features(answering(stay), THREE_ACTIONS, guidance=1.0, sampler=ddim)
    assert (made[:, :40] == 1).all()
    assert (made[:, 40:] - 1).abs().max() < 0.15  # the least noisy step still has a noise of 0.03
    alone = features(answering(stay), THREE_ACTIONS, seeing(0), guidance=1.0, sampler=ddim)
    assert (alone[:, 40:] - 1).abs().max() > 0.5


def test_actions_that_see_nothing_before_them_are_sincs(model):
    tracks = [THREE_ACTIONS, TWO_ACTIONS, GAP]
    torch.testing.assert_close(
        features(model, tracks, seeing(0), steps=4), features(model, tracks, "sinc", steps=4), atol=1e-4, rtol=0
    )


def test_slerp_replaces_the_overlap_around_each_change_and_nothing_else(model):
    without, with_slerp = (features(model, TIMELINES, name, steps=3) for name in ("teach_b", "teach"))
    plans = [plan(timeline, 20, 0, model.longest - 3) for timeline in TIMELINES]
    statistics = model.motion_statistics
    raw = slerp(statistics.restore(without), plans, model.representation.layout, 10)
    torch.testing.assert_close(with_slerp, statistics.normalise(raw))
    changed = (with_slerp - without).abs().amax(dim=-1) > 1e-3
    assert not changed[0, :35].any() and changed[0, 36:44].all() and not changed[0, 45:65].any()
    assert not changed[2].any()


# A slow oracle ----------------------------------------------------------------------------------------------------


def slowly(model: Model, timeline: Timeline, seed: int, steps: int, seen: int) -> Tensor:
    """Action after action by the equations, one sample, text and step at a time."""
    made, schedule = torch.zeros(0, 205), model.schedule.respaced(model.schedule.spaced(steps))
    times, embeddings = model.schedule.spaced(steps), {}
    for number, prompt in enumerate(timeline.prompts):
        for text in ("", prompt.text):
            embeddings[text] = model.embed([text])[text][None]
        past = made[max(0, len(made) - seen) :]
        frames = len(past) + int(prompt.end * 20) - int(prompt.start * 20)
        draw = Noise([(seed, number)], [frames], 205)
        x = draw()
        for i in reversed(range(steps)):
            answers = (
                model.network(x, torch.tensor([times[i]]), embeddings[text], None, None) for text in (prompt.text, "")
            )
            x0 = guide(*answers, 2.5)
            x0[0, : len(past)] = past
            mean, variance = schedule.posterior(x0, x, i)
            x = mean + variance * draw()
        made = torch.cat([made, x0[0, len(past) :]])
    return made


def test_a_batch_of_timelines_of_different_numbers_of_actions_is_what_the_slow_way_makes_of_each(model):
    timelines = [THREE_ACTIONS, NOD, TWO_ACTIONS]
    made = features(model, timelines, seeing(12), seed=[5, 6, 7], steps=4, guidance=2.5)
    with torch.inference_mode():
        for row, timeline, seed in zip(made, timelines, [5, 6, 7], strict=True):
            frames = timeline.frames(20)
            torch.testing.assert_close(row[:frames], slowly(model, timeline, seed, 4, 12), atol=2e-4, rtol=1e-4)
            assert not row[frames:].any()


# Properties -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["teach_b", "teach"])
def test_what_comes_later_changes_nothing_before(model, method):
    other = Timeline.parse("walk # 0 # 2\njump # 2 # 3.5\nnod # 3.5 # 5")
    first, second = (features(model, each, method, steps=3, seed=1) for each in (THREE_ACTIONS, other))
    torch.testing.assert_close(first[:, :65], second[:, :65], atol=1e-4, rtol=0)
    assert (first[:, 70:80] - second[:, 70:80]).abs().max() > 1e-3


def test_several_tracks_are_sampled_as_the_single_track(model):
    several, single = (features(model, each, steps=3) for each in (WALK_WAVE, single_track(WALK_WAVE, 20)))
    assert torch.equal(several, single)
    run_alone = stmc.Method(lambda run: run.autoregressive(run.plans(0)), "")
    with pytest.raises(ValueError, match="'walk forwards' and 'wave' hold at the same frames"):
        model.generate(WALK_WAVE, method=run_alone, steps=1)


def test_a_prompt_too_long_for_the_network_is_actions_that_leave_room_for_what_they_see(model):
    shapes = []

    def watched(x, t, text, text_mask, mask):
        shapes.append(x.shape[1])
        return constant(x, t, text, text_mask, mask)

    made = features(answering(watched), LONG, steps=1, guidance=1.0)
    assert shapes == [80, 83, 83, 23] and max(shapes) <= model.longest
    assert made[0, :, 0].tolist() == [1.0] * 240 + [2.0] * 20


def test_a_gap_is_an_action_without_a_text_in_its_turn():
    actions = [action for [action] in action_rounds([look_back(plan(GAP, 20, 0), 5)])]
    assert [(each.number, each.crop.text, each.start) for each in actions] == [
        (0, "turn left", 0), (2, None, 20), (1, "turn left", 40)
    ]  # fmt: skip


def test_a_motion_that_is_kept_is_seen_and_stays(model):
    [motion] = model.generate(THREE_ACTIONS, seed=0, steps=3, method="teach_b")
    [changed] = model.generate(
        THREE_ACTIONS, seed=1, steps=3, method="teach", keep=motion, change=THREE_ACTIONS.prompts[1]
    )
    same = (changed.joints - motion.joints).norm(dim=-1).amax(dim=-1)
    assert same[:40].max() < 1e-5 < 0.01 < same[45:65].min()
    longer = Timeline.parse("walk # 0 # 2\njump # 2 # 3.5\nbow # 3.5 # 6")
    [further] = model.generate(longer, seed=1, steps=3, method="teach_b", keep=motion)
    assert (further.joints[:80] - motion.joints).abs().max() < 1e-5


def test_what_is_kept_of_one_timeline_is_nothing_to_the_others_of_its_batch(model):
    kept = model.generate([THREE_ACTIONS, TWO_ACTIONS], seed=0, steps=2, method="teach_b")
    both = model.generate(
        [THREE_ACTIONS, TWO_ACTIONS], seed=[3, 4], steps=3, method="teach_b", keep=kept, change=stmc.Change(0.5, 2)
    )
    [alone] = model.generate(TWO_ACTIONS, seed=4, steps=3, method="teach_b", keep=kept[1], change=stmc.Change(0.5, 2))
    assert apart(both[1], alone) < 1e-4


@pytest.mark.parametrize("method", ["teach_b", "teach"])
def test_constraints_are_refused_by_name(model, method):
    with pytest.raises(SettingError, match="constraints need a method that composes at every step"):
        model.generate(TWO_ACTIONS, method=method, constraints=[Hold("left_hand", 0, 1)], steps=1)


def test_a_network_of_a_fixed_length_sees_the_past_at_the_start_of_it():
    class Fixed:
        fixed_length = 60

        def __call__(self, x, t, text, text_mask, mask):
            shapes.append(tuple(x.shape))
            return constant(x, t, text, text_mask, mask)

    shapes = []
    model = dataclasses.replace(answering(Fixed()), longest=60)
    made = features(model, [THREE_ACTIONS, TWO_ACTIONS], steps=2, guidance=1.0)
    assert {shape[1] for shape in shapes} == {60}
    assert made[0, :, 0].tolist() == [1.0] * 40 + [2.0] * 30 + [3.0] * 10


def test_a_network_that_knows_a_text_for_every_frame_makes_actions_too():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = FlowMdm(205, 384, absolute_from=90, width=16, feedforward=32, layers=1, heads=2, attention_window=20)
    flow = dataclasses.replace(tiny(), denoiser=network.eval(), text_encoder=OneWord())
    batch = flow.generate([THREE_ACTIONS, TWO_ACTIONS], seed=[3, 4], steps=3, method="teach")
    assert [motion.frames for motion in batch] == [80, 60]
    assert apart(batch[1], flow.generate(TWO_ACTIONS, seed=4, steps=3, method="teach")[0]) < 1e-4


def test_a_model_in_half_precision_makes_nearly_the_same_actions(model):
    half = dataclasses.replace(model, precision="bf16")
    exact, made = (features(each, [THREE_ACTIONS, TWO_ACTIONS], "teach", steps=3) for each in (model, half))
    assert made.dtype == torch.float32
    assert 0 < (exact - made).abs().mean() < 0.05
