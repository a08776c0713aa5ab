"""Guidance distillation: what a teacher teaches against its guidance written out, and who learns of it."""

from dataclasses import replace

import pytest
import torch

from stmc.denoisers import MdmSmpl
from stmc.diffusion import Schedule
from stmc.training import Batch, Denoising, GuidedTeacher, draw_noise, squared_errors

SCHEDULE = Schedule.cosine(20)
FEATURES, WIDTH = 5, 8


def network(seed: int) -> MdmSmpl:
    torch.manual_seed(seed)
    return MdmSmpl(FEATURES, WIDTH, width=16, feedforward=32, layers=2, heads=2, words=4).eval()


def drawn(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


NULL = drawn(2, WIDTH, seed=9)
"""A text of two words, as an encoder's begin and end are."""


def batch() -> Batch:
    """Three rows of 6, 4 and 2 frames, with texts of 3, 2 and 2 words, of which the last is the empty one."""
    frames, words = (
        torch.arange(most) < torch.tensor(each)[:, None] for most, each in ((6, [6, 4, 2]), (3, [3, 2, 2]))
    )
    text = drawn(3, 3, WIDTH, seed=1)
    text[2, :2] = NULL
    text = torch.where(words[..., None], text, 0.0)
    motion = torch.where(frames[..., None], drawn(3, 6, FEATURES), 0.0)
    return Batch(motion, frames, text, words, int(frames.sum()))


def noised(batch: Batch) -> tuple[torch.Tensor, torch.Tensor]:
    t, noise = draw_noise(batch, SCHEDULE.steps, torch.Generator().manual_seed(3))
    return SCHEDULE.q_sample(batch.motion, t, noise), t


def test_what_is_taught_is_the_prediction_without_a_text_moved_towards_the_one_with_it():
    teacher, rows = network(0), batch()
    noisy, t = noised(rows)
    with torch.no_grad():
        told = teacher(noisy, t, rows.text, rows.text_mask, rows.mask)
        untold = teacher(noisy, t, NULL.repeat(3, 1, 1), None, rows.mask)
    torch.testing.assert_close(GuidedTeacher(teacher, 2.5, NULL)(rows, noisy, t), 2.5 * told - 1.5 * untold)
    torch.testing.assert_close(GuidedTeacher(teacher, 0, NULL)(rows, noisy, t), untold)
    assert (told[0] - untold[0]).abs().max() > 0.01


def test_a_row_without_a_text_teaches_the_prediction_without_a_text():
    teacher, rows = network(0), batch()
    noisy, t = noised(rows)
    guided = GuidedTeacher(teacher, 7.5, NULL)(rows, noisy, t)
    with torch.no_grad():
        unguided = teacher(noisy[2:, :2], t[2:], NULL[None], None, None)
    torch.testing.assert_close(guided[2:, :2], unguided, atol=1e-5, rtol=1e-5)


def test_a_student_that_is_the_teacher_has_nothing_to_learn_of_guidance_1_and_something_of_more():
    teacher, rows = network(0), batch()
    losses = {}
    for guidance in (1, 2.5):
        objective = Denoising(SCHEDULE, teacher=GuidedTeacher(teacher, guidance, NULL))
        losses[guidance] = objective(teacher, rows, torch.Generator().manual_seed(0)).detach()
    torch.testing.assert_close(losses[1], torch.zeros(FEATURES), atol=1e-9, rtol=0)
    assert (losses[2.5] > 1e-5).all()


def test_the_errors_are_those_of_what_the_teacher_predicts_and_of_what_is_derived_from_it():
    student, teacher, rows = network(1), network(0), batch()
    t, noise = draw_noise(rows, SCHEDULE.steps, torch.Generator().manual_seed(3))

    def steps(x: torch.Tensor) -> torch.Tensor:
        return x[:, 1:] - x[:, :-1]

    taught = GuidedTeacher(teacher, 2.5, NULL)
    found = squared_errors(student, SCHEDULE, rows, t, noise, auxiliary_loss=steps, teacher=taught)
    noisy = SCHEDULE.q_sample(rows.motion, t, noise)
    away = student(noisy, t, rows.text, rows.text_mask, rows.mask) - taught(rows, noisy, t)
    both = rows.mask[:, 1:] & rows.mask[:, :-1]
    torch.testing.assert_close(found, torch.cat([away[rows.mask].square().sum(0), steps(away)[both].square().sum(0)]))


@pytest.mark.parametrize("prediction", ["eps", "v", "score"])
def test_what_the_data_would_have_taught_does_not_matter(prediction):
    """The teacher predicts what the student does: nothing is converted."""
    student, rows = network(1), batch()
    t, noise = draw_noise(rows, SCHEDULE.steps, torch.Generator().manual_seed(3))
    taught = GuidedTeacher(network(0), 2.5, NULL)
    plain = squared_errors(student, SCHEDULE, rows, t, noise, teacher=taught)
    torch.testing.assert_close(squared_errors(student, SCHEDULE, rows, t, noise, prediction, teacher=taught), plain)
    assert not torch.allclose(squared_errors(student, SCHEDULE, rows, t, noise, prediction), plain)


def test_gradients_reach_the_student_alone_and_lead_to_the_guided_prediction():
    """Of one batch with the same noise again and again."""
    teacher, student, rows = network(0), network(0).train(), batch()
    objective = Denoising(SCHEDULE, teacher=GuidedTeacher(teacher, 2.5, NULL))
    for layer in (each for each in student.modules() if isinstance(each, torch.nn.Dropout)):
        layer.p = 0.0
    optimizer = torch.optim.Adam(student.parameters(), lr=3e-3)
    losses = []
    for _ in range(60):
        optimizer.zero_grad()
        loss = objective.weigh(objective(student, rows, torch.Generator().manual_seed(0)))
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.2 * losses[0]
    assert all(weight.grad is None for weight in teacher.parameters())


def test_a_batch_of_texts_of_one_word_is_taught_the_same_way():
    teacher, rows = network(0), batch()
    short = replace(rows, text=rows.text[:, :1], text_mask=None)
    noisy, t = noised(rows)
    with torch.no_grad():
        told = teacher(noisy, t, short.text, None, rows.mask)
        untold = teacher(noisy, t, NULL[:1].repeat(3, 1, 1), None, rows.mask)
    torch.testing.assert_close(GuidedTeacher(teacher, 3, NULL[:1])(short, noisy, t), 3 * told - 2 * untold)
