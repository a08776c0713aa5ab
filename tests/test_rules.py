"""MultiDiffusion and DoubleTake as plans of plans, inpainting, interpolation on the sphere: oracles, and parity."""

from itertools import pairwise

import numpy as np
import pytest
import roma
import torch
from conftest import golden, golden_sets
from helpers.collages import COLUMNS, FPS, GAP, STAND_NOD, WALK_WAVE, Constant, embeddings, last, plans_of, timeline
from helpers.published_networks import frames
from helpers.strategies import quietly
from helpers.strategies import timelines as any_timeline
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from stmc.composing import collage, crop_lengths, first_take_weights, guided_crops, inpaint, slerp, smooth_seams
from stmc.diffusion import Schedule, ddim, ddpm
from stmc.motion.body import BodyPart
from stmc.motion.geometry import matrix_to_rows, rows_to_matrix
from stmc.motion.representation import SMPL_LAYOUT
from stmc.timeline.planning import (
    Crop,
    Plan,
    Tile,
    cross_fade,
    handshake,
    multi_diffusion,
    plan,
    second_take,
    transition_spans,
)

SCHEDULE = Schedule.cosine(12)
SETS = pytest.mark.parametrize("folder", golden_sets("flow"))
TWO = timeline(("walk", 0, 30), ("run", 30, 70))


def weights(laid_out: Plan, part: BodyPart) -> Tensor:
    """[crops, frames]: how much of each crop a part's frames have."""
    found = torch.zeros(len(laid_out.crops), laid_out.frames)
    for tile in laid_out.tiles:
        if tile.part == part:
            found[tile.crop, tile.start : tile.end] += tile.weight
    return found


def everywhere(plan_frames: int, crops: list[Crop], *tiles: tuple[int, int, int, int]) -> Plan:
    """A plan whose parts all have the same tiles: (crop, start, end, weight)."""
    return Plan(plan_frames, tuple(crops), tuple(Tile(c, part, a, b, w) for part in BodyPart for c, a, b, w in tiles))


# Weights ----------------------------------------------------------------------------------------------------------


def test_multi_diffusion_averages_where_crops_overlap():
    [laid_out] = plans_of(TWO)
    averaged = multi_diffusion(laid_out)
    assert averaged.crops == (Crop("walk", 0, 35), Crop("run", 25, 70))
    expected = torch.tensor([[1.0] * 25 + [0.5] * 10 + [0.0] * 35, [0.0] * 25 + [0.5] * 10 + [1.0] * 35])
    for part in BodyPart:
        torch.testing.assert_close(weights(averaged, part), expected)


def test_a_handshake_fades_from_one_crop_into_the_next():
    [laid_out] = plans_of(TWO)
    shaken = handshake(laid_out)
    assert shaken.crops == (Crop("walk", 0, 35), Crop("run", 25, 70))
    share = torch.tensor([0.0] * 25 + [k / 10 for k in range(10)] + [1.0] * 35)
    for part in BodyPart:
        torch.testing.assert_close(weights(shaken, part), torch.stack([1 - share, share]))


def test_soft_edges_come_and_go_along_straight_lines():
    [laid_out] = plans_of(TWO)
    softened = cross_fade(laid_out)
    assert softened.crops == laid_out.crops == (Crop("walk", 0, 35), Crop("run", 25, 70), Crop(None, 25, 35))
    rise = torch.tensor([0.1, 0.3, 0.5, 0.7, 0.9] + [1.0] * 5)
    expected = torch.zeros(3, 70)
    expected[0, :25], expected[0, 25:35] = 1, rise.flip(0)
    expected[1, 35:], expected[1, 25:35] = 1, rise
    expected[2, 25:35] = 1 - rise - rise.flip(0)
    for part in BodyPart:
        torch.testing.assert_close(weights(softened, part), expected)


@quietly
@given(any_timeline(), st.integers(0, 30), st.sampled_from([None, 60, 200]))
def test_soft_edges_never_jump_and_leave_the_middle_of_a_transition_as_it_is(drawn, overlap, longest):
    """A weight changes by no more than one over half a transition, but where transitions meet or the timeline ends."""
    laid_out = plan(drawn, FPS, overlap, longest)
    softened = cross_fade(laid_out)
    assert softened.crops == laid_out.crops
    for part in BodyPart:
        spans = transition_spans(laid_out, part)
        before, after = weights(laid_out, part), weights(softened, part)
        plain = [a[1] <= b[0] for a, b in pairwise(spans)]
        if not spans or not all(plain) or any(end - start < overlap for start, end in spans):
            continue
        assert after.diff(dim=1).abs().max() <= 2 / overlap + 1e-5
        for start, end in spans:
            if (end - start) % 2:
                torch.testing.assert_close(after[:, (start + end) // 2], before[:, (start + end) // 2])


def test_parts_that_do_not_change_hands_keep_their_crop_alone():
    [laid_out] = plans_of(WALK_WAVE)
    for rule in (multi_diffusion, handshake):
        changed = weights(rule(laid_out), BodyPart.LEGS)
        assert changed.shape == (3, 74)  # walk, run, wave; nothing unconditional
        assert not changed[2].any()
        waved = weights(rule(laid_out), BodyPart.RIGHT_ARM)
        assert waved[2, 19:47].eq(1).all()


def test_a_crop_with_two_tiles_around_a_short_one_counts_once_in_an_average():
    [laid_out] = plans_of(timeline(("walk", 0, 60, "legs", "right arm"), ("wave", 28, 32, "right arm")))
    crops = [crop.text for crop in multi_diffusion(laid_out).crops]
    assert crops == ["walk", "wave"]
    averaged = weights(multi_diffusion(laid_out), BodyPart.RIGHT_ARM)
    torch.testing.assert_close(averaged[:, 23:37], torch.full((2, 14), 0.5))


@quietly
@given(any_timeline(), st.integers(0, 30), st.sampled_from([None, 60, 200]))
def test_every_rule_makes_a_legal_plan_of_any_timeline(drawn, overlap, longest):
    """That weights sum to one is checked where a plan is made."""
    laid_out = plan(drawn, FPS, overlap, longest)
    for rule in (multi_diffusion, handshake):
        changed = rule(laid_out)
        assert changed.frames == laid_out.frames
        assert all(0 < tile.weight <= 1 for tile in changed.tiles)
        assert {crop.text for crop in changed.crops} <= {crop.text for crop in laid_out.crops}
    again = second_take(laid_out, longest)
    assert {crop.text for crop in again.crops} == {None}
    assert longest is None or not overlap or all(crop.frames <= longest for crop in again.crops)
    spans = transition_spans(laid_out)
    assert all(any(c.start <= start and end <= c.end for c in again.crops) for start, end in spans)


def test_a_second_take_goes_from_transition_to_transition():
    three = timeline(("walk", 0, 60), ("run", 60, 120), ("sit", 120, 200))
    [laid_out] = plans_of(three)
    assert second_take(laid_out).crops == (Crop(None, 0, 115), Crop(None, 65, 200))
    for part in BodyPart:
        assert weights(second_take(laid_out), part)[0].sum() == 90
    cut = second_take(laid_out, longest=100)
    assert set(cut.crops) == {Crop(None, 10, 110), Crop(None, 70, 170), Crop(None, 0, 10), Crop(None, 170, 200)}
    assert second_take(plans_of(timeline(("walk", 0, 60)))[0]).crops == (Crop(None, 0, 60),)
    odd = second_take(laid_out, longest=101)  # the half frame that is left over is in front
    assert set(odd.crops) == {Crop(None, 9, 110), Crop(None, 69, 170), Crop(None, 0, 9), Crop(None, 170, 200)}


# Answers known in closed form -------------------------------------------------------------------------------------


@pytest.mark.parametrize("rule", [multi_diffusion, handshake])
def test_the_collage_follows_whatever_rule_made_its_plan(rule):
    plans = [rule(each) for each in plans_of(WALK_WAVE, STAND_NOD, GAP)]
    table = embeddings(plans)
    crops = guided_crops(Constant(), SCHEDULE, plans, table, guidance=1.0)
    expected = torch.zeros(3, max(each.frames for each in plans), 10)
    for i, each in enumerate(plans):
        value = torch.tensor([float(table[crop.text or ""]) for crop in each.crops])
        for part, own in COLUMNS.items():
            expected[i, : each.frames, list(own)] = (value @ weights(each, part))[:, None]
    x0 = last(ddim(collage(crops, plans, COLUMNS), SCHEDULE, torch.randn(expected.shape)))
    torch.testing.assert_close(x0, expected, atol=1e-4, rtol=0)


def test_inpainting_goes_on_only_where_nothing_is_kept():
    content, kept = torch.randn(1, 6, 2), torch.tensor([0.0, 0.0, 0.25, 0.25, 1.0, 1.0])[None, :, None].expand(1, -1, 2)
    painted = inpaint(lambda x, t: torch.full_like(x, 8.0), content, kept)(torch.randn(1, 6, 2), 3)
    assert torch.equal(painted[:, 4:], content[:, 4:])
    assert (painted[:, :2] == 8).all()
    torch.testing.assert_close(painted[:, 2:4], 6 + 0.25 * content[:, 2:4])


def test_what_a_second_take_keeps_is_a_matter_of_each_part():
    plans = plans_of(WALK_WAVE, GAP)
    kept = first_take_weights(plans, COLUMNS, ramp=4)
    legs, arm = (kept[0, :, list(COLUMNS[part])] for part in (BodyPart.LEGS, BodyPart.RIGHT_ARM))
    before, after = torch.tensor([0.85, 0.6375, 0.425, 0.2125]), torch.tensor([0.0, 0.2125, 0.425, 0.6375])
    expected = torch.ones(74)
    expected[31:35], expected[45:49] = before, after
    torch.testing.assert_close(legs, expected[:, None].expand(-1, 2))
    expected = torch.ones(74)
    for start in (9, 47):
        expected[start - 4 : start], expected[start + 10 : start + 14] = before, after
    torch.testing.assert_close(arm, expected[:, None].expand(-1, 2))
    assert (kept[1, 60:] == 1).all()


def test_rotations_of_a_transition_follow_the_shortest_arc_and_the_rest_a_line():
    plans = plans_of(timeline(("walk", 0, 30), ("wave", 30, 60, "right arm"), ("run", 30, 60)), overlap=0)
    rotations = SMPL_LAYOUT["rotations"]
    raw = torch.randn(1, 60, SMPL_LAYOUT.width, generator=torch.Generator().manual_seed(0))
    axis, angle = torch.tensor([0.0, 0.6, 0.8]), torch.linspace(-1.0, 1.2, 60)
    turn = matrix_to_rows(roma.rotvec_to_rotmat(angle[:, None] * axis))
    raw[0, :, rotations] = turn.repeat(1, 22)
    raw[0, 26:34, rotations] += 0.3 * torch.randn(8, 132)
    raw[0, [25, 34], rotations] = turn[[25, 34]].repeat(1, 22)
    smooth = slerp(raw, plans, SMPL_LAYOUT, overlap=10)
    torch.testing.assert_close(smooth[0, :, rotations], turn.repeat(1, 22), atol=1e-5, rtol=0)
    rest = [column for column in range(SMPL_LAYOUT.width) if not rotations.start <= column < rotations.stop]
    assert torch.equal(smooth[..., rest], smooth_seams(raw, plans, SMPL_LAYOUT.columns, 10)[..., rest])
    made = rows_to_matrix(smooth[0, :, rotations].reshape(60, 22, 6))
    assert roma.is_rotation_matrix(made, epsilon=1e-4)
    assert torch.equal(slerp(raw, plans, SMPL_LAYOUT, overlap=0), raw)


# Parity -----------------------------------------------------------------------------------------------------------


def stand_in(x: Tensor, t: float) -> Tensor:
    """The README's denoiser, on [batch, frames, features]."""
    return 0.6 * torch.tanh(x) + 0.2 * x.roll(1, dims=1) + 0.01 * t


def one_owner(features: int) -> dict[BodyPart, range]:
    """All columns are the legs', but for one of each other part: golden features have no parts, and all move alike."""
    others = {part: [number] for number, part in enumerate(part for part in BodyPart if part != BodyPart.LEGS)}
    return others | {BodyPart.LEGS: range(4, features)}


def close(actual: Tensor, expected) -> None:
    expected = torch.as_tensor(np.asarray(expected))
    torch.testing.assert_close(actual, expected, atol=2e-5 * float(expected.abs().max()), rtol=0)


@pytest.mark.golden
@SETS
def test_a_collage_of_windows_is_the_published_diffcollage(folder):
    data = golden(folder, "sampling_diffcollage.npz")
    width, overlap, count = int(data["window"]), int(data["overlap"]), int(data["num_windows"])
    stride, x = width - overlap, windows_of(data["x"])
    starts = [stride * i for i in range(count)]
    crops = [Crop("window", start, start + width) for start in starts]
    crops += [Crop(None, start, start + overlap) for start in starts[1:]]
    tiles = [(i, crop.start, crop.end, 1 if i < count else -1) for i, crop in enumerate(crops)]
    laid_out = everywhere(x.shape[1], crops, *tiles)
    alone, t = CropsAlone([laid_out]), float(data["t"])  # of the stand-in alone: no step of a schedule
    eps = collage(lambda crops, _: alone(crops, t), [laid_out], one_owner(x.shape[2]))(x, 0)
    close(eps, windows_of(data["eps"]))


def windows_of(array) -> Tensor:
    """[batch, 1, features, frames] as ours."""
    return torch.from_numpy(np.asarray(array)).squeeze(1).transpose(1, 2).contiguous()


class CropsAlone:
    """The stand-in on every crop of plans, each as long as it is: rolling goes around its own end."""

    def __init__(self, plans: list[Plan], factor: float = 1.0) -> None:
        self.lengths, self.factor = crop_lengths(plans), factor

    def __call__(self, x: Tensor, t: float) -> Tensor:
        out = torch.zeros_like(x)
        for row, length in enumerate(self.lengths):
            out[row, :length] = self.factor * stand_in(x[row : row + 1, :length], t)[0]
        return out


@pytest.mark.golden
@SETS
def test_an_averaged_plan_steps_as_the_published_multidiffusion(folder):
    """Golden windows step by x - 0.3 g(x, 3); the mean of the steps is the step of the mean."""
    data = golden(folder, "sampling_multidiffusion.npz")
    x = windows_of(data["x"])
    spans = [(int(left), int(right)) for _, _, left, right in data["views"]]
    crops = [Crop("window", *span) for span in spans]
    crops += [Crop(None, b[0], a[1]) for a, b in pairwise(spans)]
    tiles = [(i, crop.start, crop.end, 1 if i < len(spans) else -1) for i, crop in enumerate(crops)]
    averaged = multi_diffusion(everywhere(x.shape[1], crops, *tiles))
    assert len(averaged.crops) == len(spans)
    predicted = collage(CropsAlone([averaged]), [averaged], one_owner(x.shape[2]))(x, 3)
    close(x - 0.3 * predicted, windows_of(data["out"]))


class DoubleTake:
    """The published run on segments, and the same as timelines: what stands in two segments is one frame here."""

    def __init__(self, folder) -> None:
        self.data = data = golden(folder, "sampling_doubletake.npz")
        self.steps, self.skip = int(data["num_steps"]), int(data["skip_steps"])
        self.schedule, self.shared = Schedule.cosine(self.steps), int(data["handshake"])
        lengths = data["lengths"].tolist()
        starts = [sum(lengths[:i]) - i * self.shared for i in range(len(lengths))]
        crops = [Crop("segment", start, start + length) for start, length in zip(starts, lengths, strict=True)]
        crops += [Crop(None, start, start + self.shared) for start in starts[1:]]
        tiles = [(i, crop.start, crop.end, 1 if i < len(lengths) else -1) for i, crop in enumerate(crops)]
        self.plan = everywhere(crops[len(lengths) - 1].end, crops, *tiles)
        self.shaken, self.taken = handshake(self.plan), second_take(self.plan)
        self.columns = one_owner(data["first_take"].shape[1])
        rng = np.random.default_rng(int(data["seed"]))
        first, second = data["first_take"].shape, data["second_take_first_input"].shape
        self.first_noise = [drawn_frames(rng, first) for _ in range(1 + self.steps)]
        self.second_noise = [drawn_frames(rng, second) for _ in range(1 + self.steps - self.skip)]

    def mixed(self, segments: Tensor) -> Tensor:
        """Segments as one timeline, by the handshakes' weights: of noise, what each frame gets in the published run."""
        timeline = torch.zeros(1, self.plan.frames, segments.shape[2])
        for tile in self.shaken.tiles:
            first, part = self.shaken.crops[tile.crop].start, list(self.columns[tile.part])
            moved = segments[tile.crop, tile.start - first : tile.end - first][:, part]
            timeline[0, tile.start : tile.end, part] += tile.weight * moved
        return timeline

    def placed(self, windows: Tensor) -> Tensor:
        """The published windows, from one handshake's end to the next but one's start, as one timeline, halved as ours
        are. Published windows leave out as many frames at the timeline's ends; they are zero here."""
        timeline = torch.zeros(1, self.plan.frames, windows.shape[2])
        spans = transition_spans(self.plan)
        starts = [self.shared, *(end for _, end in spans[:-1])]
        for row, (start, length) in enumerate(zip(starts, self.data["second_take_lengths"].tolist(), strict=True)):
            owned = weights(self.taken, BodyPart.LEGS)[row, start : start + length].bool()
            timeline[0, start : start + length][owned] = windows[row, :length][owned]
        return timeline

    def first_take(self) -> Tensor:
        """From the first blended state on: before it, segments do not agree on the frames that they share."""

        def crops(x: Tensor, t: int) -> Tensor:
            """The stand-in rolls around the end of the padding; what stands there is as published."""
            rows = frames(self.data["x_in_of_step"][self.steps - 1 - t]).clone()
            for row, length in enumerate(crop_lengths([self.shaken])):
                rows[row, :length] = x[row, :length]
            return stand_in(rows, t)

        noise = iter(self.first_noise[2:])
        x = self.mixed(frames(self.data["x_in_of_step"][1]))
        predict, short = (
            collage(crops, [self.shaken], self.columns),
            self.schedule.respaced(tuple(range(self.steps - 1))),
        )
        return last(ddpm(predict, short, x, lambda shape: self.mixed(next(noise)), noise_scale="std"))

    def second_take(self, content: Tensor) -> Tensor:
        noise = iter(self.second_noise[1:])
        crops = CropsAlone([self.taken], factor=0.9)
        kept = first_take_weights([self.plan], self.columns, int(self.data["blend_len"]))
        predict = inpaint(collage(crops, [self.taken], self.columns), content, kept)
        x, short = (
            self.placed(frames(self.data["second_take_first_input"])),
            self.schedule.respaced(tuple(range(self.steps - self.skip))),
        )
        return last(ddpm(predict, short, x, lambda shape: self.placed(next(noise)), noise_scale="std"))


def drawn_frames(rng: np.random.Generator, shape: tuple[int, ...]) -> Tensor:
    return frames(rng.standard_normal(shape).astype(np.float32))


@pytest.mark.golden
@SETS
def test_both_takes_are_the_published_doubletake(folder):
    run = DoubleTake(folder)
    close(frames(run.data["x_in_of_step"][0]), run.first_noise[0])
    assert run.plan.frames == run.data["final_unfolded"].shape[-1]
    first = run.first_take()
    close(first, run.mixed(frames(run.data["first_take"])))
    close(run.second_take(first), frames(run.data["final_unfolded"]))
    masks = frames(run.data["second_take_mask"])
    kept = first_take_weights([run.plan], run.columns, int(run.data["blend_len"]))
    covered = run.placed(torch.ones_like(masks)).bool()
    close(run.placed(masks)[covered], kept[covered])
    start = run.schedule.q_sample(first, run.steps - run.skip - 1, run.placed(run.second_noise[0]))
    close(start[covered], run.placed(frames(run.data["second_take_first_input"]))[covered])
