"""Few steps: one step of a student arrives where several of its teacher do, alone and as a model of four steps."""

import copy
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from helpers.scripts import configured, loaded
from helpers.tiny_model import tiny
from torch import Tensor, nn

import stmc
from stmc.diffusion import Schedule, ddim
from stmc.training import Batch, Denoising, MultistepTeacher

SCHEDULE = Schedule.cosine(100, spacing="trailing")
STD = 0.15
TWO = stmc.Sampling(steps=2)


def drawn(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def ideal(x: Tensor, t: Tensor | int) -> Tensor:
    """The ideal denoiser of data that are 1 or -1 in every feature, each with the deviation `STD`."""
    signal = SCHEDULE.alpha_bar[t].float().reshape(-1, *[1] * (x.ndim - 1))
    variance = signal * STD**2 + 1 - signal
    mode = torch.tanh(signal.sqrt() * x / variance)
    return mode + STD**2 * signal.sqrt() / variance * (x - signal.sqrt() * mode)


def teach(batch: Batch, noisy: Tensor, t: Tensor) -> Tensor:
    return ideal(noisy, t)


def sampled(predict, x: Tensor, steps: int | None) -> Tensor:
    *_, x0 = ddim(predict, SCHEDULE, x, steps=steps)
    return x0


def batch_of(motion: Tensor) -> Batch:
    return Batch(motion, None, torch.zeros(len(motion), 1, 1), None, motion.shape[0] * motion.shape[1])


def data(rows: int, seed: int) -> Tensor:
    """Rows of one frame and two features."""
    return drawn(rows, 1, 2, seed=2 * seed).sign() + STD * drawn(rows, 1, 2, seed=2 * seed + 1)


# What is taught -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("steps", "teacher_steps"), [(4, 20), (2, 20), (1, 10), (5, 5), (3, 6)])
def test_steps_of_a_perfect_student_are_the_steps_of_its_teacher(steps, teacher_steps):
    teacher = MultistepTeacher(teach, SCHEDULE, steps, teacher_steps)
    x = drawn(50, 3, 2)
    few = sampled(lambda x, t: teacher(batch_of(x), x, torch.full((50,), t)), x, steps)
    torch.testing.assert_close(few, sampled(ideal, x, teacher_steps), atol=1e-4, rtol=1e-4)
    if steps < teacher_steps:
        assert (sampled(ideal, x, steps) - few).abs().max() > 0.05


@pytest.mark.parametrize("prediction", ["eps", "v"])
def test_what_is_taught_is_in_the_terms_of_the_prediction(prediction):
    def teach_otherwise(batch: Batch, noisy: Tensor, t: Tensor) -> Tensor:
        return SCHEDULE.from_x0(ideal(noisy, t), noisy, t, prediction)

    x0, t = data(4, seed=0), torch.tensor([24, 49, 74, 99])
    noisy = SCHEDULE.q_sample(x0, t, drawn(4, 1, 2, seed=5))
    lesson = MultistepTeacher(teach_otherwise, SCHEDULE, 4, 12, prediction)(batch_of(x0), noisy, t)
    expected = MultistepTeacher(teach, SCHEDULE, 4, 12)(batch_of(x0), noisy, t)
    torch.testing.assert_close(SCHEDULE.to_x0(lesson, noisy, t, prediction)[:3], expected[:3], atol=1e-4, rtol=1e-4)


def test_steps_that_the_teacher_does_not_visit_are_refused():
    with pytest.raises(ValueError, match=r"teacher_steps \(10\) must be a multiple of steps \(4\)"):
        MultistepTeacher(teach, SCHEDULE, 4, 10)
    with pytest.raises(ValueError, match=r"do not pass through the 4 steps \(0, 33, 66, 99\).*spacing=trailing"):
        MultistepTeacher(teach, Schedule.cosine(100), 4, 20)
    with pytest.raises(ValueError, match="1 to 100"):
        Denoising(SCHEDULE, steps=101)


# Who learns -----------------------------------------------------------------------------------------------------------


class Bumps(nn.Module):
    """A denoiser of single features: for every step of its own, a weighted mean of values at 40 places."""

    def __init__(self) -> None:
        super().__init__()
        self.places = torch.linspace(-4, 4, 40)
        self.values = nn.Parameter(self.places.repeat(100, 1))

    def forward(self, x: Tensor, t: Tensor, *others: Tensor | None) -> Tensor:
        near = (-((x[..., None] - self.places) ** 2) / (2 * 0.15**2)).softmax(dim=-1)
        return (near * self.values[t][:, None, None]).sum(dim=-1)


def learn(objective: Denoising, updates: int = 150) -> Bumps:
    student, seen = Bumps(), []
    optimizer = torch.optim.Adam(student.parameters(), lr=0.05)

    def watched(x: Tensor, t: Tensor, *others: Tensor | None) -> Tensor:
        seen.append(t)
        return student(x, t)

    for number in range(updates):
        optimizer.zero_grad()
        generator = torch.Generator().manual_seed(number)
        objective.weigh(objective(watched, batch_of(data(512, number)), generator) / 512).backward()
        optimizer.step()
    assert set(torch.cat(seen).tolist()) == set(SCHEDULE.spaced(objective.steps))
    return student


def test_four_steps_of_a_student_match_a_hundred_of_its_teacher_better_than_four_of_its_teacher():
    """In where each noise leads, and in how far from the modes the samples lie."""
    teacher = MultistepTeacher(teach, SCHEDULE, 4, 20)
    student = learn(Denoising(SCHEDULE, steps=4, teacher=teacher))
    noise = drawn(2000, 1, 2, seed=9)
    with torch.no_grad():
        full, own = sampled(ideal, noise, None), sampled(ideal, noise, 4)
        few = sampled(lambda x, t: student(x, torch.full((len(x),), t)), noise, 4)

    def spread(samples: Tensor) -> float:
        return (samples.abs() - 1).square().mean().sqrt().item()

    assert (few - full).square().mean() < 0.5 * (own - full).square().mean()
    assert abs(spread(few) - spread(full)) < 0.5 * abs(spread(own) - spread(full))
    assert spread(full) == pytest.approx(STD, rel=0.15)


# A model of four steps ------------------------------------------------------------------------------------------------


@pytest.fixture
def model() -> stmc.Model:
    """A tiny model that is sampled in four steps by itself."""
    sampling = stmc.Sampling(steps=4, sampler="ddim", guidance=1, stitch_from=0.25)
    config = tiny().config | {"schedule": {"_target_": f"{Schedule.__module__}.Schedule.cosine", "steps": 100}}
    config["schedule"]["spacing"] = "trailing"
    return replace(tiny(), schedule=SCHEDULE, sampling=sampling, config=config)


def test_a_model_of_few_steps_remembers_how_it_is_sampled(model, tmp_path):
    again = stmc.load(stmc.save(model, tmp_path / "run", card=""))
    settings = again.settings()
    assert (settings.steps, settings.sampler, settings.guidance, settings.stitch_from) == (4, "ddim", 1, 0.25)
    assert again.schedule.spaced(settings.steps) == (24, 49, 74, 99)
    assert again.settings(steps=2).steps == 2


def test_a_model_of_few_steps_stitches_keeps_and_obeys_at_every_step(model):
    timeline = "walk # 0 # 3 # legs\nwave # 1 # 2 # right arm\nrun # 3 # 5"
    seen, denoise = [], model.denoiser.denoise

    def watched(x: Tensor, t: Tensor, *others: Tensor | None, **settings: int) -> Tensor:
        seen.append(int(t[0]))
        return denoise(x, t, *others, **settings)

    model.denoiser.denoise = watched
    [motion] = model.generate(timeline, clean_feet=False)
    assert list(dict.fromkeys(seen)) == [99, 74, 49, 24]
    assert motion.frames == 100

    [changed] = model.generate(timeline, keep=motion, change=[stmc.Change(3.0, 4.0)], seed=1, clean_feet=False)
    torch.testing.assert_close(changed.rotations[:50], motion.rotations[:50], atol=1e-4, rtol=0)
    assert not torch.allclose(changed.rotations[65:75], motion.rotations[65:75], atol=1e-3)

    goal = (1.0, 0.5)
    [walked] = model.generate(timeline, constraints=[stmc.Path([(0.0, 0.0), goal])], clean_feet=False)
    assert (walked.translation[-1, :2] - torch.tensor(goal)).norm() < 0.1


def test_the_last_of_few_steps_is_of_full_precision(model):
    seen, denoise = [], model.denoiser.denoise

    def watched(x: Tensor, t: Tensor, *others: Tensor | None, **settings: int) -> Tensor:
        seen.append((int(t[0]), torch.is_autocast_enabled("cpu")))
        return denoise(x, t, *others, **settings)

    model.denoiser.denoise = watched
    replace(model, precision="bf16").generate("walk # 0 # 2", clean_feet=False)
    assert list(dict.fromkeys(seen)) == [(99, True), (74, True), (49, True), (24, False)]


def test_the_experiment_compares_a_teacher_with_students_in_their_own_steps(model):
    experiment = configured("evaluate", "experiment=few_steps").experiment
    models = {"MDM-SMPL": tiny(), "Student": model, "Two": replace(model, sampling=TWO.with_defaults(model.sampling))}
    settings = dict.fromkeys(loaded("evaluate").choose_settings(experiment, models, ()))
    rows = [(each.denoiser, each.sampling.steps, each.sampling.guidance, each.sampling.sampler) for each in settings]
    own = [("MDM-SMPL", steps, 2.5, "ddim") for steps in (50, 4)]
    assert rows == [*own, *(("Student", steps, 1, "ddim") for steps in (4, 2, 1)), ("Two", 2, 1, "ddim")]


# Spacing --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("steps", [*range(1, 101, 7), 100])
def test_trailing_steps_are_the_noisiest_of_equal_shares(steps):
    times = SCHEDULE.spaced(steps)
    gaps = [b - a for a, b in pairwise((-1, *times))]
    assert len(times) == steps and times[-1] == 99 and min(gaps) >= 1
    assert max(gaps) - min(gaps) <= 1


def test_an_unknown_spacing_is_refused_with_the_choices():
    schedule = copy.copy(SCHEDULE)
    object.__setattr__(schedule, "spacing", "even")  # past the checks of types that tests have
    with pytest.raises(ValueError, match="unknown spacing 'even'; choose from linspace, trailing"):
        schedule.__post_init__()
