"""Distillation: what a teacher teaches, of one text and of several in a row, against it written out; and who learns."""

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


TEXTS = drawn(3, 3, WIDTH, seed=1)
"""What three sentences are to the teacher, of which the first is the empty one."""
WORDS = torch.tensor([2, 3, 2])
NULL = TEXTS[0, :2]


def taught(denoiser, guidance: float) -> GuidedTeacher:
    return GuidedTeacher(denoiser, guidance, TEXTS, WORDS)


def batch() -> Batch:
    """Three rows of 6, 4 and 2 frames, with texts of 3, 2 and 2 words, of which the last is the empty one."""
    frames, words = (
        torch.arange(most) < torch.tensor(each)[:, None] for most, each in ((6, [6, 4, 2]), (3, [3, 2, 2]))
    )
    sentence = torch.tensor([[1], [2], [0]])
    text = torch.where(words[..., None], TEXTS[sentence[:, 0]], 0.0)
    motion = torch.where(frames[..., None], drawn(3, 6, FEATURES), 0.0)
    return Batch(motion, frames, text, words, int(frames.sum()), sentence=sentence)


def noised(batch: Batch) -> tuple[torch.Tensor, torch.Tensor]:
    t, noise = draw_noise(batch, SCHEDULE.steps, torch.Generator().manual_seed(3))
    return SCHEDULE.q_sample(batch.motion, t, noise), t


def test_what_is_taught_is_the_prediction_without_a_text_moved_towards_the_one_with_it():
    teacher, rows = network(0), batch()
    noisy, t = noised(rows)
    with torch.no_grad():
        told = teacher(noisy, t, rows.text, rows.text_mask, rows.mask)
        untold = teacher(noisy, t, NULL.repeat(3, 1, 1), None, rows.mask)
    torch.testing.assert_close(taught(teacher, 2.5)(rows, noisy, t), 2.5 * told - 1.5 * untold)
    torch.testing.assert_close(taught(teacher, 0)(rows, noisy, t), untold)
    assert (told[0] - untold[0]).abs().max() > 0.01


def test_a_row_without_a_text_teaches_the_prediction_without_a_text():
    teacher, rows = network(0), batch()
    noisy, t = noised(rows)
    guided = taught(teacher, 7.5)(rows, noisy, t)
    with torch.no_grad():
        unguided = teacher(noisy[2:, :2], t[2:], NULL[None], None, None)
    torch.testing.assert_close(guided[2:, :2], unguided, atol=1e-5, rtol=1e-5)


def test_a_student_that_is_the_teacher_has_nothing_to_learn_of_guidance_1_and_something_of_more():
    teacher, rows = network(0), batch()
    losses = {}
    for guidance in (1, 2.5):
        objective = Denoising(SCHEDULE, teacher=taught(teacher, guidance))
        losses[guidance] = objective(teacher, rows, torch.Generator().manual_seed(0)).detach()
    torch.testing.assert_close(losses[1], torch.zeros(FEATURES), atol=1e-9, rtol=0)
    assert (losses[2.5] > 1e-5).all()


def test_the_errors_are_those_of_what_the_teacher_predicts_and_of_what_is_derived_from_it():
    student, teacher, rows = network(1), network(0), batch()
    t, noise = draw_noise(rows, SCHEDULE.steps, torch.Generator().manual_seed(3))

    def steps(x: torch.Tensor) -> torch.Tensor:
        return x[:, 1:] - x[:, :-1]

    lesson = taught(teacher, 2.5)
    found = squared_errors(student, SCHEDULE, rows, t, noise, auxiliary_loss=steps, teacher=lesson)
    noisy = SCHEDULE.q_sample(rows.motion, t, noise)
    away = student(noisy, t, rows.text, rows.text_mask, rows.mask) - lesson(rows, noisy, t)
    both = rows.mask[:, 1:] & rows.mask[:, :-1]
    torch.testing.assert_close(found, torch.cat([away[rows.mask].square().sum(0), steps(away)[both].square().sum(0)]))


@pytest.mark.parametrize("prediction", ["eps", "v", "score"])
def test_what_the_data_would_have_taught_does_not_matter(prediction):
    """The teacher predicts what the student does: nothing is converted."""
    student, rows = network(1), batch()
    t, noise = draw_noise(rows, SCHEDULE.steps, torch.Generator().manual_seed(3))
    lesson = taught(network(0), 2.5)
    plain = squared_errors(student, SCHEDULE, rows, t, noise, teacher=lesson)
    torch.testing.assert_close(squared_errors(student, SCHEDULE, rows, t, noise, prediction, teacher=lesson), plain)
    assert not torch.allclose(squared_errors(student, SCHEDULE, rows, t, noise, prediction), plain)


def test_gradients_reach_the_student_alone_and_lead_to_the_guided_prediction():
    """Of one batch with the same noise again and again."""
    teacher, student, rows = network(0), network(0).train(), batch()
    objective = Denoising(SCHEDULE, teacher=taught(teacher, 2.5))
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


def test_texts_of_one_word_are_taught_the_same_way():
    teacher, rows = network(0), batch()
    noisy, t = noised(rows)
    with torch.no_grad():
        told = teacher(noisy, t, TEXTS[rows.sentence[:, 0], :1], None, rows.mask)
        untold = teacher(noisy, t, NULL[:1].repeat(3, 1, 1), None, rows.mask)
    lesson = GuidedTeacher(teacher, 3, TEXTS[:, :1], torch.ones_like(WORDS))
    torch.testing.assert_close(lesson(rows, noisy, t), 3 * told - 2 * untold)


def test_the_teacher_reads_sentences_in_its_own_way_whatever_the_student_reads():
    teacher, rows = network(0), batch()
    noisy, t = noised(rows)
    read_otherwise = replace(rows, text=drawn(3, 1, 2 * WIDTH, seed=7), text_mask=None)
    torch.testing.assert_close(taught(teacher, 3)(read_otherwise, noisy, t), taught(teacher, 3)(rows, noisy, t))


# Rows of several texts ------------------------------------------------------------------------------------------------

LENGTHS = (60, 44)
"""Of two rows: the first has texts 1, 2 and 1 again, changing at frames 20 and 37; the second has none, twice."""


def in_rows() -> Batch:
    segment = torch.zeros(2, 60, dtype=torch.long)
    segment[0, 20:], segment[0, 37:], segment[1, 21:] = 1, 2, 1
    mask = torch.arange(60) < torch.tensor(LENGTHS)[:, None]
    sentence = torch.tensor([[1, 2, 1], [0, 0, 0]])
    text, motion = drawn(2, 3, 1, seed=7), drawn(2, 60, FEATURES)
    return Batch(motion, mask, text, None, sum(LENGTHS), segment=segment, sentence=sentence)


def test_each_text_of_a_row_is_taught_alone_and_cross_faded_into_the_next():
    """Against crops cut, predicted and added up one by one."""
    teacher, rows = network(0), in_rows()
    noisy, t = noised(rows)
    expected = torch.zeros_like(noisy)
    for row, sentence, begin, end in ((0, 1, 0, 25), (0, 2, 15, 42), (0, 1, 32, 60), (1, 0, 0, 26), (1, 0, 16, 44)):
        text = TEXTS[None, sentence, : WORDS[sentence]]
        with torch.no_grad():
            told, untold = (
                teacher(noisy[row : row + 1, begin:end], t[row : row + 1], each) for each in (text, NULL[None])
            )
        share = torch.ones(end - begin)
        if begin > 0:
            share[:10] = torch.arange(1, 11) / 11
        if end < LENGTHS[row]:
            share[-10:] = torch.arange(10, 0, -1) / 11
        expected[row, begin:end] += share[:, None] * (untold + 2.5 * (told - untold))[0]
    torch.testing.assert_close(taught(teacher, 2.5)(rows, noisy, t), expected, atol=1e-5, rtol=1e-5)


def test_a_teacher_who_says_the_same_of_all_texts_says_it_in_every_frame_of_a_row():
    rows = in_rows()
    noisy, t = noised(rows)
    for guidance in (1, 2.5):
        found = taught(lambda x, *_: torch.full_like(x, 3.0), guidance)(rows, noisy, t)
        torch.testing.assert_close(found[rows.mask], torch.full_like(found[rows.mask], 3.0))


def test_the_teacher_sees_a_quarter_of_a_second_beyond_its_text_and_no_further():
    teacher, rows = network(0), in_rows()
    noisy, t = noised(rows)
    other = noisy.clone()
    other[0, 25:] += 1.0
    before, after = (taught(teacher, 2.5)(rows, each, t) for each in (noisy, other))
    torch.testing.assert_close(after[0, :15], before[0, :15], atol=1e-5, rtol=1e-5)
    assert ((after - before)[0, 15:].abs().amax(dim=1) > 1e-4).all()
