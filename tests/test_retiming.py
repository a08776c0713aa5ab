"""Arms in transitions: how far they turn in a frame, in closed forms and over random motions."""

import dataclasses
import math

import pytest
import torch
from helpers.tiny_model import tiny
from hypothesis import given
from hypothesis import strategies as st
from test_model import WALK_WAVE, apart
from torch import Tensor

import stmc
from stmc.composing.retiming import MAX_SPEED_RATIO, _locate, limit_speed, time_warp
from stmc.diffusion.statistics import Statistics
from stmc.motion.body import BodyPart
from stmc.motion.geometry import axis_angle_to_matrix, matrix_to_axis_angle, matrix_to_rows, rows_to_matrix, wrap
from stmc.motion.kinematics import hand_step
from stmc.motion.representation import Field, Layout, SmplRepresentation
from stmc.timeline import Timeline
from stmc.timeline.planning import Plan, cross_fade

LAYOUT = SmplRepresentation().layout
STATISTICS = Statistics(torch.linspace(-0.2, 0.2, LAYOUT.width), torch.linspace(0.5, 2.0, LAYOUT.width))
RAISED = Timeline.parse("stand # 0 # 4 # legs\nraise # 2 # 3 # right arm")
OWNED = {part: list(columns) for part, columns in LAYOUT.columns.items()}
WHERE = LAYOUT["rotations"]
TURNED = [column for column in OWNED[BodyPart.RIGHT_ARM] if WHERE.start <= column < WHERE.stop]
MOVED = [column for column in OWNED[BodyPart.RIGHT_ARM] if column not in TURNED]


def planned(timeline: Timeline, overlap: int = 10) -> Plan:
    return stmc.plan(timeline, fps=20, overlap=overlap)


def turning(angles: Tensor) -> Tensor:
    """Normalised features of one timeline in which every joint of all parts turns about one axis by these angles, and
    whose other numbers are the angle."""
    rows = matrix_to_rows(axis_angle_to_matrix(angles[:, None] * torch.tensor([0.6, 0.0, 0.8])))
    raw = angles[:, None].repeat(1, LAYOUT.width)
    raw[:, WHERE] = rows.repeat(1, (WHERE.stop - WHERE.start) // 6)
    return STATISTICS.normalise(raw)[None]


def angles_of(features: Tensor) -> Tensor:
    """Of the right arm's first joint, per frame."""
    rows = STATISTICS.restore(features)[0][:, TURNED[:6]]
    return matrix_to_axis_angle(rows_to_matrix(rows)) @ torch.tensor([0.6, 0.0, 0.8])


def steady(features: Tensor, *plans: Plan, layout: Layout = LAYOUT) -> Tensor:
    return time_warp(lambda x, t: x, plans, layout, STATISTICS)(features, 0)


def jumping(frames: int, at: int, by: float = 2.0) -> Tensor:
    return by * (torch.arange(frames) >= at).float()


def test_an_arm_that_jumps_reaches_over_the_whole_transition_instead():
    """Of all the way in one of 11 steps, twice the mean is left, the rest is a reach's: closed form."""
    plan = planned(RAISED)  # transitions at 35 to 45 and 55 to 65
    angles = angles_of(steady(turning(jumping(80, at=40)), plan))
    way = torch.arange(12) / 11
    reach = (way**2 * (3 - 2 * way)).diff()
    mixed = (1 - 2 / 11) / (1 - reach.max())
    steps = mixed * reach
    steps[5] += 1 - mixed
    torch.testing.assert_close(angles[34:46].diff(), 2.0 * steps, atol=1e-5, rtol=0)
    assert angles.diff().max() == pytest.approx(2 * 2.0 / 11, abs=1e-5)


def test_a_frame_at_the_border_of_two_steps_is_behind_all_that_stand_still():
    """Rotations rest while the other numbers of the hand go on: the last of the equal poses is meant."""
    steps = torch.tensor([[1.0, 0.0, 1.0]])
    at, share = _locate(steps, steps)
    assert at.tolist() == [[2, 2]] and share.tolist() == [[0.0, 0.0]]


def test_what_is_no_arm_in_a_transition_is_not_touched():
    before = turning(jumping(80, at=40))
    after = steady(before, planned(RAISED))
    moved = (before != after)[0]
    assert set(moved.any(dim=0).nonzero().flatten().tolist()) <= set(OWNED[BodyPart.RIGHT_ARM])
    assert set(moved.any(dim=1).nonzero().flatten().tolist()) <= set(range(35, 45))
    torch.testing.assert_close(before, turning(jumping(80, at=40)), atol=0, rtol=0)  # nor what it was made of


def test_the_other_numbers_of_an_arm_go_with_its_rotations():
    after = STATISTICS.restore(steady(turning(jumping(80, at=40)), planned(RAISED)))[0]
    torch.testing.assert_close(after[:, MOVED[0]], angles_of(STATISTICS.normalise(after)[None]), atol=1e-5, rtol=0)


@pytest.mark.parametrize("swings", [0.5, 1.0])
def test_an_arm_that_swings_to_and_fro_stays_as_it_is(swings):
    angles = torch.sin(2 * math.pi * swings * (torch.arange(80) - 34) / 11)
    before = turning(angles)
    assert torch.equal(steady(before, planned(RAISED)), before)


@pytest.mark.parametrize("overlap", [0, 1])
def test_where_there_is_no_time_nothing_is_retimed(overlap):
    before = turning(jumping(80, at=40))
    assert torch.equal(steady(before, planned(RAISED, overlap)), before)


def test_features_without_rotations_stay_as_they_are():
    heights = Layout((Field("positions", 3, ("right_wrist", "left_wrist")),))
    before = torch.randn(1, 80, 6)
    assert torch.equal(steady(before, planned(RAISED), layout=heights), before)


SPANS = st.lists(st.integers(1, 39), min_size=2, max_size=2, unique=True).map(sorted)


@pytest.mark.filterwarnings("ignore::stmc.timeline.TimelineWarning")  # prompts may claim one arm
@given(st.lists(SPANS, min_size=1, max_size=2), st.integers(0, 2**20), st.integers(2, 12), st.booleans())
def test_no_arm_turns_further_in_a_frame_than_twice_its_mean_and_ends_are_kept(spans, seed, overlap, rough):
    """Of any motion, also where transitions touch or meet the timeline's ends, alone and in a batch."""
    lines = [f"raise # {start / 10} # {end / 10} # right arm" for start, end in spans]
    plans = [planned(Timeline.parse("\n".join(["stand # 0 # 4 # legs", *lines])), overlap), planned(RAISED, overlap)]
    draw = torch.Generator().manual_seed(seed)
    angles = torch.randn(80, generator=draw).cumsum(0) * 0.2 if rough else jumping(80, int(40 + seed % 40))
    before = turning(angles)
    after = steady(before, plans[0])
    both = steady(before.repeat(2, 1, 1), *plans)
    torch.testing.assert_close(both[:1], after, atol=1e-6, rtol=0)
    changed = (before != after)[0].any(dim=1)
    old, new = (wrap(angles_of(each).diff()).abs() for each in (before, after))
    assert new.max() <= old.max() + 1e-4
    for window in runs(changed.tolist()):
        assert new[window].max() <= MAX_SPEED_RATIO * old[window].mean() + 1e-3


def runs(changed: list[bool]) -> list[slice]:
    """The steps into, within and out of each run of changed frames."""
    edges = [frame for frame in range(1, len(changed)) if changed[frame] != changed[frame - 1]]
    return [slice(start - 1, end) for start, end in zip(edges[::2], edges[1::2], strict=True)]


@given(st.lists(st.floats(0, 9, width=32), min_size=1, max_size=20))
def test_limit_speed_steps_have_the_same_sum_and_none_is_longer_than_twice_the_mean(values):
    steps = torch.tensor([values])
    found = limit_speed(steps, torch.ones_like(steps))
    assert found.sum() == pytest.approx(float(steps.sum()), abs=1e-3)
    assert (found >= 0).all() and found.max() <= max(MAX_SPEED_RATIO * steps.mean(), 0) + 1e-3
    assert steps.max() > MAX_SPEED_RATIO * steps.mean() or torch.equal(found, steps)


# In a run ---------------------------------------------------------------------------------------------------------


def poses(texts: list[str]) -> tuple[Tensor, Tensor]:
    wanted = {"stand": 0.0, "raise": 1.0}
    return torch.tensor([wanted.get(text, 0.5) for text in texts])[:, None, None], torch.ones(len(texts)).long()


def wish(x: Tensor, t: Tensor, text: Tensor, text_mask: Tensor | None, mask: Tensor | None) -> Tensor:
    """Every frame as the text wants it: arms that hang, or that are raised; the middle of a crop knows no other."""
    return text[:, :1] * raised(1.0) + (1 - text[:, :1]) * raised(0.0) + 0 * x


def raised(share: float) -> Tensor:
    turn = axis_angle_to_matrix(torch.tensor([0.0, 0.0, 2.8 * share]))
    row = torch.zeros(LAYOUT.width)
    row[WHERE] = matrix_to_rows(torch.eye(3)).repeat((WHERE.stop - WHERE.start) // 6)
    row[TURNED[6:12]] = matrix_to_rows(turn)
    return row


def test_a_hand_that_goes_all_the_way_up_does_so_over_the_whole_transition_by_default():
    """The denoiser answers a constant per text; cross-faded, its rotations pass each other within a frame or two."""
    plain = Statistics(torch.zeros(1), torch.ones(1))
    model = dataclasses.replace(tiny(), denoiser=wish, text_encoder=poses, text_statistics=plain)
    model = dataclasses.replace(model, motion_statistics=Statistics(torch.zeros(205), torch.ones(205)))
    settings = {"steps": 2, "guidance": 1.0, "seed": 0}
    [faded] = model.generate(RAISED, method=cross_fade, **settings)
    [default] = model.generate(RAISED, **settings)
    assert hand_step(default) < 0.6 * hand_step(faded)
    outside = [frame for frame in range(80) if not 35 <= frame < 45 and not 55 <= frame < 65]
    torch.testing.assert_close(default.joints[outside], faded.joints[outside], atol=1e-5, rtol=0)


def test_without_overlap_the_default_is_its_rule_alone():
    one, other = (tiny().generate(WALK_WAVE, steps=2, overlap=0, method=method)[0] for method in ("stmc", cross_fade))
    assert apart(one, other) == 0
