"""Schedules, samplers, noise and guidance against closed forms for Gaussian data, and the published code."""

import inspect
import math
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import checked, golden, golden_files
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from stmc.diffusion import Noise, Schedule, ddim, ddpm, dpm_solver, guide

SCHEDULES = {"cosine 100": Schedule.cosine(100), "linear 1000": Schedule.linear(1000)}
SAMPLERS = {"ddpm": partial(ddpm, noise_scale="std"), "ddim": ddim, "dpm_solver": dpm_solver}


def drawn(seed: int = 0, dtype: torch.dtype = torch.float64):
    generator = torch.Generator().manual_seed(seed)
    return lambda shape: torch.randn(tuple(shape), generator=generator, dtype=dtype)


def gains(schedule: Schedule, std: float) -> Tensor:
    """For data that is normal with this std, the ideal denoiser is x0 = gain[t] x."""
    return std**2 * schedule.alpha_bar.sqrt() / (schedule.alpha_bar * std**2 + 1 - schedule.alpha_bar)


def last(generator) -> Tensor:
    for x0 in generator:  # noqa: B007
        pass
    return x0


# Schedules ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("schedule", SCHEDULES.values(), ids=SCHEDULES)
def test_noising_step_by_step_agrees_with_noising_at_once(schedule):
    """Eq. 1: multiplying by sqrt(1 - beta) and adding beta of variance, t times, keeps alpha_bar of the signal."""
    signal, variance = 1.0, 0.0
    for beta, alpha_bar in zip(schedule.beta.tolist(), schedule.alpha_bar.tolist(), strict=True):
        signal, variance = signal * (1 - beta) ** 0.5, variance * (1 - beta) + beta
        assert signal**2 == pytest.approx(alpha_bar, rel=1e-9)
        assert variance == pytest.approx(1 - alpha_bar)


@given(st.sampled_from(["cosine", "linear"]), st.integers(21, 1500))
def test_a_schedule_of_any_length_is_that_of_its_paper(name, steps):
    """Nichol and Dhariwal 2021, equation 17, and Ho et al. 2020 with their 1,000 steps' noise spread over `steps`."""
    if name == "linear":
        beta = np.linspace(0.1 / steps, 20 / steps, steps)
    else:
        left = np.cos((np.arange(steps + 1) / steps + 0.008) / 1.008 * np.pi / 2) ** 2
        beta = np.minimum(1 - left[1:] / left[:-1], 0.999)
    schedule = getattr(Schedule, name)(steps)
    np.testing.assert_allclose(schedule.beta.numpy(), beta, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(schedule.alpha_bar.numpy(), np.cumprod(1 - beta), rtol=1e-9)


@pytest.mark.parametrize("schedule", SCHEDULES.values(), ids=SCHEDULES)
def test_the_posterior_is_bayes_rule(schedule):
    """Prior of x_{t-1} given x0, likelihood of x_t given x_{t-1}: precisions add, means weigh by precision."""
    x0, x = torch.tensor([[0.7]], dtype=torch.float64), torch.tensor([[-1.3]], dtype=torch.float64)
    for t in range(1, schedule.steps, 7):
        before, beta = schedule.alpha_bar[t - 1], schedule.beta[t]
        precision = 1 / (1 - before) + (1 - beta) / beta
        expected = (before.sqrt() * x0 / (1 - before) + (1 - beta).sqrt() * x / beta) / precision
        mean, variance = schedule.posterior(x0, x, t)
        torch.testing.assert_close(mean, expected)
        torch.testing.assert_close(variance, 1 / precision)


@pytest.mark.parametrize("schedule", SCHEDULES.values(), ids=SCHEDULES)
def test_the_last_step_ends_exactly_in_the_clean_sample(schedule):
    x0, x = torch.randn(2, 5, 3), torch.randn(2, 5, 3)
    mean, variance = schedule.posterior(x0, x, 0)
    torch.testing.assert_close(mean, x0, atol=0, rtol=0)
    assert variance == 0


@pytest.mark.parametrize("prediction", ["x0", "eps", "v", "score"])
@pytest.mark.parametrize("schedule", SCHEDULES.values(), ids=SCHEDULES)
def test_every_prediction_leads_back_to_the_clean_sample(schedule, prediction):
    draw = drawn()
    x0, noise, t = draw((8, 5, 3)), draw((8, 5, 3)), torch.linspace(0, schedule.steps - 1, 8).long()
    x = schedule.q_sample(x0, t, noise)
    output = schedule.from_x0(x0, x, t, prediction)
    torch.testing.assert_close(schedule.to_x0(output, x, t, prediction), x0, atol=1e-6, rtol=0)
    signal, left = (each.sqrt()[t][:, None, None] for each in (schedule.alpha_bar, 1 - schedule.alpha_bar))
    meaning = {"x0": x0, "eps": noise, "v": signal * noise - left * x0, "score": -noise / left}[prediction]
    torch.testing.assert_close(output, meaning, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("prediction", ["x0", "eps", "v"])
def test_a_step_for_all_is_that_step_for_each(prediction):
    schedule, draw = SCHEDULES["cosine 100"], drawn(dtype=torch.float32)
    a, b, each = draw((3, 4, 2)), draw((3, 4, 2)), torch.full((3,), 40)
    for one, many in [
        (schedule.q_sample(a, 40, b), schedule.q_sample(a, each, b)),
        (schedule.to_x0(a, b, 40, prediction), schedule.to_x0(a, b, each, prediction)),
        (schedule.posterior(a, b, 40)[0], schedule.posterior(a, b, each)[0]),
    ]:
        assert one.dtype == many.dtype == torch.float32
        assert torch.equal(one, many)


@given(st.integers(1, 100))
def test_any_number_of_steps_is_evenly_spaced_and_keeps_both_ends(steps):
    schedule = SCHEDULES["cosine 100"]
    times = schedule.spaced(steps)
    assert len(times) == steps and times[-1] == 99 and (steps == 1 or times[0] == 0)
    assert all(a < b for a, b in pairwise(times))
    gaps = [b - a for a, b in pairwise(times)]
    assert not gaps or max(gaps) - min(gaps) <= 1
    assert all(abs(time - i * 99 / (steps - 1)) <= 0.5 for i, time in enumerate(times) if steps > 1)  # the nearest
    assert torch.equal(schedule.respaced(times).alpha_bar, schedule.alpha_bar[list(times)])


def test_all_steps_is_the_default():
    assert SCHEDULES["cosine 100"].spaced(None) == tuple(range(100)) == SCHEDULES["cosine 100"].spaced(100)


@pytest.mark.parametrize("steps", [0, -1, 101])
def test_too_few_and_too_many_steps_are_errors(steps):
    with pytest.raises(ValueError, match="1 to 100"):
        SCHEDULES["cosine 100"].spaced(steps)


def test_what_is_no_schedule_is_refused():
    for alpha_bar in ([0.5, 0.6], [1.0, 0.5], [0.5, 0.0], []):
        with pytest.raises(ValueError, match="alpha_bar must start below 1"):
            Schedule(torch.tensor(alpha_bar, dtype=torch.float64))


def test_an_unknown_prediction_is_refused_with_the_choices():
    with pytest.raises(ValueError, match="x0, eps, v, score"):
        inspect.unwrap(Schedule.to_x0)(SCHEDULES["cosine 100"], torch.ones(1, 1), torch.ones(1, 1), 3, "noise")


# Samplers: Gaussian data, where everything is linear ---------------------------------------------------


def ancestral_std(schedule: Schedule, std: float, times: tuple[int, ...], spread: str) -> float:
    """The std of ddpm's result for the ideal denoiser, by propagating the variance."""
    short, gain, variance = schedule.respaced(times), gains(schedule, std), 1.0
    for i in reversed(range(len(times))):
        clean, noisy = ((short.posterior(a, b, i)[0]).item() for a, b in torch.eye(2, dtype=torch.float64)[:, :, None])
        result = gain[times[i]].item() ** 2 * variance
        added = short.posterior(torch.zeros(1), torch.zeros(1), i)[1].item()
        variance = (clean * gain[times[i]].item() + noisy) ** 2 * variance + (added if spread == "std" else added**2)
    return result**0.5


@pytest.mark.parametrize("steps", [None, 20])
@pytest.mark.parametrize("spread", ["std", "variance"])
def test_ancestral_samples_of_gaussian_data_have_the_std_that_theory_gives(spread, steps):
    schedule, std, draw = SCHEDULES["cosine 100"], 1.0, drawn()
    gain = gains(schedule, std)
    x = draw((200, 500, 1))
    samples = last(ddpm(lambda x, t: gain[t] * x, schedule, x, draw, steps, spread))
    expected = ancestral_std(schedule, std, schedule.spaced(steps), spread)
    assert samples.std().item() == pytest.approx(expected, rel=0.01)


def test_the_published_spread_samples_far_too_narrow_a_distribution():
    """R1: the variance in the place of the standard deviation."""
    schedule = SCHEDULES["cosine 100"]
    right, narrow = (ancestral_std(schedule, 1.0, schedule.spaced(None), spread) for spread in ("std", "variance"))
    assert right == pytest.approx(0.98, abs=0.01)
    assert narrow == pytest.approx(0.21, abs=0.01)


def smooth_schedule(steps: int) -> Schedule:
    """Evenly spaced in log signal-to-noise, so that the order of a solver shows."""
    return Schedule(torch.sigmoid(torch.linspace(7, -7, steps, dtype=torch.float64)))


@pytest.mark.parametrize(("sampler", "order"), [(ddim, 1), (dpm_solver, 2)], ids=["ddim", "dpm_solver"])
def test_ode_samplers_converge_to_the_exact_solution_with_their_order(sampler, order):
    """The probability-flow ODE of Gaussian data scales x by the ratio of the marginal stds."""
    schedule, std = smooth_schedule(1281), 0.5
    gain, x = gains(schedule, std), torch.ones(1, 1, 1, dtype=torch.float64)
    marginal = (schedule.alpha_bar * std**2 + 1 - schedule.alpha_bar).sqrt()
    exact = gain[0] * marginal[0] / marginal[-1]
    runs = [last(sampler(lambda x, t: gain[t] * x, schedule, x, steps=steps + 1)) for steps in (20, 40, 80, 160)]
    errors = [abs(run.item() / exact.item() - 1) for run in runs]
    assert errors[-1] < {1: 2e-2, 2: 5e-4}[order]
    for coarse, fine in pairwise(errors):
        assert np.log2(coarse / fine) == pytest.approx(order, abs=0.35)


@pytest.mark.parametrize("steps", [None, 7])
def test_ddim_with_eta_one_is_ddpm(steps):
    schedule, x = SCHEDULES["cosine 100"], drawn(3)((2, 6, 3))

    def nonlinear(x: Tensor, t: int) -> Tensor:
        return torch.tanh(x + t / 100)

    ancestral = list(ddpm(nonlinear, schedule, x, drawn(4), steps, noise_scale="std"))
    implicit = list(ddim(nonlinear, schedule, x, drawn(4), steps, eta=1.0))
    for a, b in zip(ancestral, implicit, strict=True):
        torch.testing.assert_close(a, b, atol=1e-9, rtol=0)


@pytest.mark.parametrize("eta", [0.3, 1.0])
def test_eta_scales_the_noise_that_ddim_adds(eta):
    schedule, states = SCHEDULES["cosine 100"], []

    def predict(x: Tensor, t: int) -> Tensor:
        states.append(x)
        return 0 * x

    for value in (0.0, 1.0):
        steps = ddim(predict, schedule, torch.ones(1, 1), lambda shape, value=value: torch.full(shape, value), eta=eta)
        next(steps)
        next(steps)
    _, without, _, with_noise = states
    _, variance = schedule.posterior(states[0], states[0], 99)
    torch.testing.assert_close(with_noise - without, eta * variance.sqrt().expand(1, 1))


@pytest.mark.parametrize("sampler", SAMPLERS.values(), ids=SAMPLERS)
def test_a_constant_prediction_is_the_result_after_any_number_of_steps(sampler):
    schedule, draw = SCHEDULES["cosine 100"], drawn()
    target = draw((2, 5, 3))
    for steps in (1, 2, 3, 10, None):
        for x0 in sampler(lambda x, t: target, schedule, draw((2, 5, 3)), draw, steps):
            assert torch.equal(x0, target)


@pytest.mark.parametrize("sampler", SAMPLERS.values(), ids=SAMPLERS)
def test_a_constant_prediction_leads_x_to_it_at_the_right_noise(sampler):
    """With the clean sample known, the deterministic part of x_t is sqrt(alpha_bar) x0 plus noise of the rest."""
    schedule, seen = SCHEDULES["cosine 100"], {}
    target = torch.full((200, 200, 1), 3.0, dtype=torch.float64)

    def predict(x: Tensor, t: int) -> Tensor:
        seen[t] = (x.mean().item(), x.std().item())
        return target

    draw = drawn()
    x = schedule.q_sample(target, 99, draw(target.shape))
    last(sampler(predict, schedule, x, draw, 10))
    for t, (mean, std) in seen.items():
        assert mean == pytest.approx(3 * schedule.alpha_bar[t].item() ** 0.5, abs=0.03)
        assert std == pytest.approx((1 - schedule.alpha_bar[t].item()) ** 0.5, rel=0.02)


@pytest.mark.parametrize(
    ("sampler", "draws"), [(ddpm, 4), (ddim, 0), (dpm_solver, 0)], ids=["ddpm", "ddim", "dpm_solver"]
)
def test_samplers_visit_the_spaced_steps_and_draw_as_documented(sampler, draws):
    visited, asked = [], []

    def predict(x: Tensor, t: int) -> Tensor:
        visited.append(t)
        return 0.5 * x

    def draw(shape) -> Tensor:
        asked.append(tuple(shape))
        return torch.zeros(shape)

    results = list(sampler(predict, SCHEDULES["cosine 100"], torch.ones(1, 4, 2), draw, 4))
    assert visited == [99, 66, 33, 0] and len(results) == 4
    assert asked == [(1, 4, 2)] * draws


@pytest.mark.parametrize("sampler", SAMPLERS.values(), ids=SAMPLERS)
def test_single_precision_stays_single_and_finite(sampler):
    draw = drawn(dtype=torch.float32)
    x0 = last(sampler(lambda x, t: 0.9 * x, SCHEDULES["cosine 100"], draw((2, 8, 3)), draw))
    assert x0.dtype == torch.float32 and x0.isfinite().all()


def test_wrong_spreads_and_etas_are_errors():
    x, schedule = torch.zeros(1, 2, 3), SCHEDULES["cosine 100"]
    with pytest.raises(ValueError, match="std, variance"):
        next(inspect.unwrap(ddpm)(lambda x, t: x, schedule, x, drawn(), noise_scale="narrow"))
    for eta in (-0.1, 0.5):
        with pytest.raises(ValueError, match=f"eta={eta}"):
            next(ddim(lambda x, t: x, schedule, x, eta=eta))


# Noise and guidance -------------------------------------------------------------------------------------


@given(st.lists(st.integers(1, 30), min_size=1, max_size=5), st.integers(0, 2**40))
@settings(max_examples=25)
def test_a_sample_draws_the_same_alone_as_in_a_batch(lengths, seed):
    seeds = [seed + i for i in range(len(lengths))]
    together = Noise(seeds, lengths, 4)
    for _ in range(3):
        batch = together()
        for row, length in zip(batch, lengths, strict=True):
            assert row[length:].eq(0).all()
        if _ == 0:
            first = batch
    for i, (each, length) in enumerate(zip(seeds, lengths, strict=True)):
        alone = Noise([each], [length], 4)
        assert torch.equal(alone()[0], first[i, :length])
        alone()
        assert torch.equal(alone()[0], batch[i, :length])


def test_noise_is_standard_normal_and_differs_between_draws_seeds_and_streams():
    noise = Noise([0, 1, (0, 0), (0, 1)], [500] * 4, 40)
    one, two = noise(), noise()
    assert one.mean().abs() < 0.02 and one.std().item() == pytest.approx(1, abs=0.01)
    rows = [*one, *two]
    for i, a in enumerate(rows):
        for b in rows[:i]:
            assert (a * b).mean().abs() < 0.04


def test_a_negative_seed_and_a_wrong_shape_are_errors():
    with pytest.raises(ValueError, match="negative"):
        Noise([-1], [3], 2)
    with pytest.raises(ValueError, match="2 seeds for 1 samples"):
        Noise([1, 2], [3], 2)
    with pytest.raises(ValueError, match=r"\(1, 3, 2\)"):
        Noise([1], [3], 2)((1, 4, 2))


def test_noise_has_the_same_numbers_in_any_dtype():
    single, double = Noise([3], [5], 2)(), Noise([3], [5], 2, dtype=torch.float64)()
    assert double.dtype == torch.float64 and torch.equal(single.double(), double)
    assert not torch.equal(single, single.half().float())


def test_guidance_is_a_line_through_both_predictions():
    text, null = torch.full((1, 2), 3.0), torch.full((1, 2), 1.0)
    assert [guide(text, null, weight)[0, 0].item() for weight in (0.0, 1.0, 2.5)] == [1.0, 3.0, 6.0]


# Parity with the published code -----------------------------------------------------------------------

GOLDEN_SCHEDULES = pytest.mark.parametrize("path", golden_files("stmc", "diffusion_*_T*.npz"))


def golden_schedule(path: Path) -> tuple[Schedule, dict[str, Tensor]]:
    """The schedule of the betas that the file holds, and all that it holds. A file without tables is of a published
    schedule, whose name it has."""
    data = {key: torch.from_numpy(np.asarray(value)) for key, value in golden(path.parent, path.name).items()}
    if "buf_betas" not in data:
        return (Schedule.cosine if "cosine" in path.stem else Schedule.linear)(int(data["T"])), data
    return Schedule((1 - data["buf_betas"]).cumprod(dim=0)), data


def betas_are_of_our_schedules(path):
    """Evenly spaced ones are linear, and ours where they begin as the published ones do; others are a cosine's, whose
    offset follows from the first of them."""
    data = golden_schedule(path)[1]
    if "buf_betas" not in data:
        pytest.skip(f"{path.name} holds no tables")
    betas, steps = data["buf_betas"], int(data["T"])
    if torch.allclose(betas.diff(), betas.diff()[:1], rtol=1e-6):
        same = math.isclose(betas[0], 0.1 / steps) and math.isclose(betas[-1], 20 / steps)
        ours = Schedule.linear(steps).beta if same else torch.linspace(*betas[[0, -1]].tolist(), steps).to(betas)
    else:
        ours = Schedule.cosine(steps, offset_of(betas)).beta
    torch.testing.assert_close(ours, betas, rtol=1e-6, atol=1e-9)


def offset_of(betas: Tensor) -> float:
    """The cosine's s for which the first beta is as it is, by halving: a larger s has a larger one."""

    def first(s: float) -> float:
        levels = [math.cos((u + s) / (1 + s) * math.pi / 2) ** 2 for u in (1 / len(betas), 0.0)]
        return 1 - levels[0] / levels[1]

    low, high = 0.0, 0.5
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if first(middle) < float(betas[0]) else (low, middle)
    return low


def schedules_are_those_of_the_published_code(path):
    schedule, data = golden_schedule(path)
    if "buf_betas" not in data:
        pytest.skip(f"{path.name} holds no tables")
    one, zero = torch.ones(schedule.steps, 1, dtype=torch.float64), torch.zeros(schedule.steps, 1, dtype=torch.float64)
    every = torch.arange(schedule.steps)
    clean, variance = schedule.posterior(one, zero, every)
    ours = {
        "betas": schedule.beta,
        "alphas_cumprod": schedule.alpha_bar,
        "alphas_cumprod_prev": schedule.alpha_bar_before,
        "sqrt_alphas_cumprod": schedule.q_sample(one, every, zero)[:, 0],
        "sqrt_one_minus_alphas_cumprod": schedule.q_sample(zero, every, one)[:, 0],
        "posterior_variance": variance[:, 0],
        "posterior_mean_coef1": clean[:, 0],
        "posterior_mean_coef2": schedule.posterior(zero, one, every)[0][:, 0],
        "inv_sqrt_alphas_cumprod": schedule.to_x0(zero, one, every, "eps")[:, 0],
        "sqrt_inv_alphas_cumprod_minus_one": -schedule.to_x0(one, zero, every, "eps")[:, 0],
        "one_minus_alphas_cumprod_over_sqrt_alphas_cumprod": schedule.to_x0(one, zero, every, "score")[:, 0],
    }
    for key, value in ours.items():
        torch.testing.assert_close(
            value, data[f"buf_{key}"], rtol=1e-9, atol=1e-12, msg=lambda m, key=key: f"{key}: {m}"
        )


def noising_posterior_and_predictions_are_those_of_the_published_code(path, precision):
    schedule, data = golden_schedule(path)
    dtype = {"f64": torch.float64, "f32": torch.float32}[precision]
    x0, x, noise, t = *(data[key].to(dtype) for key in ("x0", "xt", "noise")), data["t"]
    mean, variance = schedule.posterior(x0, x, t)
    ours = {
        "q_sample": schedule.q_sample(x0, t, noise),
        "post_mean": mean,
        "post_sigma": variance,
        "post_sample": mean + variance * noise,
        "eps_from_x0": schedule.from_x0(x0, x, t, "eps"),
        "score_from_x0": schedule.from_x0(x0, x, t, "score"),
    }
    for kind in ("eps", "score"):
        clean = schedule.to_x0(noise, x, t, kind)
        ours[f"x0_from_{kind}"] = clean
        ours[f"post_mean_from_{kind}"] = schedule.posterior(clean, x, t)[0]
    for key, value in ours.items():
        expected = data[f"{key}_{precision}"]
        assert value.dtype == expected.dtype
        # Conversions divide by tiny alpha_bar: the error that float allows grows with the size of the numbers.
        unit = max(1.0, expected.abs().max().item()) * (1e-12 if precision == "f64" else 1e-6)
        assert torch.allclose(value, expected, atol=unit, rtol=0), (key, (value - expected).abs().max() / unit)


@pytest.mark.golden
@GOLDEN_SCHEDULES
def test_schedules_and_what_follows_from_them_are_those_of_the_published_code(path, subtests):
    checked(
        subtests,
        [
            betas_are_of_our_schedules,
            schedules_are_those_of_the_published_code,
            (noising_posterior_and_predictions_are_those_of_the_published_code, "f64"),
            (noising_posterior_and_predictions_are_those_of_the_published_code, "f32"),
        ],
        path,
    )
