"""The objective against closed forms, and the loop: it learns, it averages, and a kill changes nothing."""

import csv
import math
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers.toy_data import LAYOUT, LetterCounts, cache
from jaxtyping import TypeCheckError
from torch import nn

from stmc.denoisers import MdmSmpl
from stmc.diffusion.schedule import Schedule
from stmc.training import (
    Batch,
    Callback,
    CheckpointError,
    Checkpoints,
    Denoising,
    Ema,
    RememberingTeacher,
    Settings,
    SettingsChanged,
    Trainer,
    draw_noise,
    energy_weights,
    find_accelerator,
    loop,
    optimizers,
    squared_errors,
)
from stmc.training.data.balanced_batches import BalancedBatches
from stmc.training.data.batches import ClipBatches
from stmc.training.data.dataset import Dataset
from stmc.training.logs import Table
from stmc.training.speed import ByteDropout, quick_attention, quicken_dropout

HERE = Path(__file__).parent
QUICK = {"lr": 3e-3, "warmup": 5, "ema_decay": 0.9, "log_every": 2, "checkpoint_every": 4, "validate_every": 8}


class Constant(nn.Module):
    """Answers the same frame whatever it is asked: the gradient is known in closed form."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.frame = nn.Parameter(torch.zeros(features))

    def forward(self, x, t, text, text_mask=None, mask=None):
        return self.frame.expand(x.shape)


class Killed(BaseException):
    """As sudden as a kill, within one process."""


def trainer(
    folder, denoiser=None, callbacks=(), pieces=2, dropout=0.1, objective=None,
    described=None, allow_changed_settings=False, **settings,
) -> Trainer:  # fmt: skip
    torch.manual_seed(0)
    dataset = Dataset(cache(), LetterCounts(), LAYOUT, min_clips=3)
    recipe = BalancedBatches(rows=8, pool=2, pieces=pieces)
    return Trainer(
        denoiser or MdmSmpl(LAYOUT.width, 8, width=16, feedforward=32, layers=1, heads=2, dropout=dropout),
        objective or Denoising(Schedule.cosine(20), fields=LAYOUT.slices),
        ClipBatches(dataset, "train", recipe),
        folder,
        Settings(**({"steps": 16} | QUICK | settings)),
        validation=ClipBatches(dataset, "val", recipe)(0),
        callbacks=callbacks,
        described=described,
        allow_changed_settings=allow_changed_settings,
    )


def rows(path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def losses(folder) -> list[dict[str, str]]:
    """Every logged number that does not measure time."""
    tables = [rows(folder / name) for name in ("train.csv", "validation.csv")]
    return [{k: v for k, v in row.items() if not k.endswith("per_second")} for table in tables for row in table]


def batch_of(motion, mask=None) -> Batch:
    frames = motion.shape[0] * motion.shape[1] if mask is None else int(mask.sum())
    return Batch(motion, mask, torch.zeros(len(motion), 1, 8), None, frames)


def test_errors_are_summed_over_real_frames_only():
    motion = torch.randn(3, 6, 4)
    mask = torch.arange(6) < torch.tensor([6, 2, 3])[:, None]
    errors = squared_errors(
        Constant(4), Schedule.cosine(10), batch_of(motion, mask), torch.tensor([0, 5, 9]), torch.randn(3, 6, 4)
    )
    torch.testing.assert_close(errors, (motion.square() * mask[..., None]).sum(dim=(0, 1)))


def test_small_motions_count_as_much_as_large_ones():
    motion = torch.tensor([1.0, 100.0])[:, None, None] * torch.randn(2, 50, 4)
    motion[1, 20:] = math.nan  # padding
    batch = batch_of(motion, torch.arange(50) < torch.tensor([50, 20])[:, None])
    weight = energy_weights(replace(batch, motion=motion.nan_to_num(7.0)), floor=1e-6)
    energy = torch.stack([motion[0].var(dim=0, correction=0).mean(), motion[1, :20].var(dim=0, correction=0).mean()])
    torch.testing.assert_close(weight[0] * energy[0], weight[1] * energy[1])
    torch.testing.assert_close((weight * torch.tensor([50.0, 20.0])).sum(), torch.tensor(70.0))  # 1 a frame on average
    still = energy_weights(batch_of(torch.ones(2, 5, 4)), floor=0.3)
    assert still.tolist() == [1.0, 1.0]
    with pytest.raises(ValueError, match="energy_floor 0 must be above 0, or None"):
        Denoising(Schedule.cosine(4), energy_floor=0)


def test_rows_count_by_their_weight_in_the_sums():
    motion, weight = torch.randn(2, 6, 4), torch.tensor([2.0, 0.5])
    errors = squared_errors(
        Constant(4), Schedule.cosine(10), batch_of(motion), torch.tensor([0, 5]), torch.randn(2, 6, 4), weight=weight
    )
    torch.testing.assert_close(errors, (2 * motion[0].square() + 0.5 * motion[1].square()).sum(dim=0))


@pytest.mark.parametrize("prediction", ["x0", "eps", "v"])
def test_a_denoiser_that_knows_the_answer_has_no_loss(prediction):
    schedule, motion, noise, t = (
        Schedule.cosine(10),
        torch.randn(3, 6, 4),
        torch.randn(3, 6, 4),
        torch.tensor([0, 5, 9]),
    )

    def oracle(x, t, text, text_mask=None, mask=None):
        shape = (-1, 1, 1)
        signal = schedule.alpha_bar.sqrt()[t].float().reshape(shape)
        spread = (1 - schedule.alpha_bar).sqrt()[t].float().reshape(shape)
        torch.testing.assert_close(x, signal * motion + spread * noise)  # Eq. 1
        return {"x0": motion, "eps": noise, "v": signal * noise - spread * motion}[prediction]

    errors = squared_errors(oracle, schedule, batch_of(motion), t, noise, prediction)
    torch.testing.assert_close(errors, torch.zeros(4), atol=1e-4, rtol=0)


def test_errors_of_derived_numbers_follow_where_both_frames_exist():
    motion = torch.arange(12.0).reshape(2, 3, 2)
    mask = torch.tensor([[True, True, True], [True, True, False]])
    errors = squared_errors(
        lambda x, *_: torch.zeros_like(x), Schedule.cosine(10), batch_of(motion, mask),
        torch.tensor([3, 4]), torch.zeros_like(motion), auxiliary_loss=lambda x: x[:, 1:].sum(-1, keepdim=True),
    )  # fmt: skip
    assert errors.tolist() == [0 + 4 + 16 + 36 + 64, 1 + 9 + 25 + 49 + 81, 5**2 + 9**2 + 17**2]


def test_only_a_prediction_of_the_clean_motion_has_derived_numbers():
    with pytest.raises(ValueError, match="x0, not eps"):
        Denoising(Schedule.cosine(10), auxiliary_loss=lambda x: x[:, 1:], prediction="eps")


def test_derived_numbers_are_logged_and_weighed_by_their_name(tmp_path):
    fields = LAYOUT.slices | {"steps": slice(LAYOUT.width, None)}
    derived = {"auxiliary_loss": lambda x: x.diff(dim=1), "fields": fields}
    heavy = Denoising(Schedule.cosine(20), weights={"steps": 100.0}, **derived)
    run = trainer(tmp_path / "heavy", steps=2, objective=heavy)
    run.run()
    light = trainer(tmp_path / "light", steps=2, objective=Denoising(Schedule.cosine(20), **derived))
    light.run()
    assert float(rows(tmp_path / "heavy" / "train.csv")[0]["loss_steps"]) > 0
    assert any(
        (a - b).abs().max() > 1e-5 for a, b in zip(run.network.parameters(), light.network.parameters(), strict=True)
    )


def test_steps_of_noising_are_uniform_and_noise_is_standard():
    batch = batch_of(torch.zeros(20_000, 2, 3))
    t, noise = draw_noise(batch, 4, torch.Generator().manual_seed(0))
    torch.testing.assert_close(torch.bincount(t, minlength=4) / 20_000, torch.full((4,), 0.25), atol=0.02, rtol=0)
    assert abs(noise.mean()) < 0.01
    assert abs(noise.std() - 1) < 0.01


def test_steps_of_noising_follow_a_beta_distribution_where_asked():
    batch = batch_of(torch.zeros(20_000, 2, 3))
    t, _ = draw_noise(batch, 4, torch.Generator().manual_seed(0), alpha=2)
    drawn = torch.bincount(t, minlength=4) / 20_000  # t < k with probability (k / 4) ** 2
    torch.testing.assert_close(drawn, torch.tensor([1.0, 3, 5, 7]) / 16, atol=0.02, rtol=0)
    with pytest.raises(ValueError, match="timestep_alpha 0 must be above 0"):
        Denoising(Schedule.cosine(4), timestep_alpha=0)


@pytest.mark.parametrize("optimizer", ["adamw", "muon"])
def test_the_loss_falls_and_the_average_learns_too(tmp_path, optimizer):
    model = trainer(tmp_path, steps=48, lr=1e-2, precision="fp32", optimizer=optimizer).run()
    first, *_, last = rows(tmp_path / "train.csv")
    assert float(last["loss"]) < 0.6 * float(first["loss"])
    first, *_, last = rows(tmp_path / "validation.csv")
    assert float(last["loss"]) < 0.8 * float(first["loss"])
    assert not model.training


def test_half_precision_learns_the_same_and_keeps_weights_in_full(tmp_path):
    half = trainer(tmp_path / "half", steps=8, dropout=0.0)
    half.run()
    trainer(tmp_path / "full", steps=8, dropout=0.0, precision="fp32").run()
    assert {parameter.dtype for parameter in half.network.parameters()} == {torch.float32}
    for a, b in zip(rows(tmp_path / "half/train.csv"), rows(tmp_path / "full/train.csv"), strict=True):
        assert float(a["loss"]) == pytest.approx(float(b["loss"]), rel=0.03)


def test_losses_of_fields_are_means_over_their_columns(tmp_path):
    run = trainer(tmp_path, Constant(LAYOUT.width), steps=2, log_every=1)
    run.run()
    for row in rows(tmp_path / "train.csv"):
        total = sum(float(row[f"loss_{name}"]) * (s.stop - s.start) for name, s in LAYOUT.slices.items())
        assert total / LAYOUT.width == pytest.approx(float(row["loss"]))


def test_pieces_of_a_batch_add_up_to_the_batch(tmp_path):
    frames = {}
    for pieces in (1, 4):
        run = trainer(tmp_path / str(pieces), Constant(LAYOUT.width), pieces=pieces, steps=2)
        whole = ClipBatches(run.batches.dataset, "train", BalancedBatches(rows=8, pool=1, pieces=pieces))
        run.batches = lambda step, process, draw=whole: draw(0, process)
        run.run()
        frames[pieces] = run.network.frame.detach()
    torch.testing.assert_close(frames[1], frames[4])


def test_a_fields_weight_scales_its_part_of_the_gradient():
    objective = Denoising(Schedule.cosine(20), fields=LAYOUT.slices, weights={"root_velocity": 5.0})
    terms = torch.ones(LAYOUT.width, requires_grad=True)
    objective.weigh(terms).backward()
    torch.testing.assert_close(terms.grad[:2] / terms.grad[2:4], torch.full((2,), 5.0))
    assert terms.grad.sum() == pytest.approx(1.0)
    with pytest.raises(ValueError, match=r"weights of unknown fields.*speed.*root_velocity"):
        Denoising(Schedule.cosine(20), fields=LAYOUT.slices, weights={"speed": 2.0})


def test_the_rate_rises_to_its_peak_and_falls_to_its_end():
    settings = Settings(steps=1000, lr=1.0, warmup=100, final_lr_ratio=0.1)
    assert settings.lr_at(0) == pytest.approx(0.01)
    assert settings.lr_at(99) == settings.lr_at(100) == pytest.approx(1.0)
    assert settings.lr_at(550) == pytest.approx(0.55)
    assert settings.lr_at(1000) == settings.lr_at(2000) == pytest.approx(0.1)


@pytest.mark.parametrize(
    "wrong", [{"precision": "fp8"}, {"optimizer": "sgd"}, {"steps": 0}, {"checkpoint_every": 75}, {"validate_every": 0}]
)
def test_settings_that_cannot_be_meant_are_errors(wrong):
    with pytest.raises((ValueError, TypeCheckError), match=next(iter(wrong))):
        Settings(**({"steps": 10} | wrong))


def test_without_average_clipping_and_warm_up_a_run_is_plain_adamw(tmp_path):
    plain = {"warmup": 0, "ema_decay": 0.0, "grad_clip": None, "final_lr_ratio": 1.0, "precision": "fp32", "lr": 0.05}
    trained = trainer(tmp_path, Constant(LAYOUT.width), steps=6, **plain)
    batches, oracle = trained.batches, Constant(LAYOUT.width)
    average = trained.run()
    optimizer = torch.optim.AdamW(oracle.parameters(), lr=0.05, weight_decay=0.01)
    for step in range(6):
        generator = torch.Generator().manual_seed(loop._seed(0, step, 0))
        pieces = batches(step, 0)
        for piece in pieces:
            terms = trained.objective(oracle, piece, generator)
            (terms.mean() / sum(each.frames for each in pieces)).backward()
        optimizer.step()
        optimizer.zero_grad()
    torch.testing.assert_close(trained.network.frame.data, oracle.frame.data)
    assert torch.equal(average.frame.data, trained.network.frame.data)
    assert all(trained.settings.lr_at(step) == 0.05 for step in range(6))


def test_muon_moves_the_matrices_of_layers_and_nothing_else(tmp_path):
    trained = trainer(tmp_path, optimizer="muon", weight_decay=0.0)
    adamw, muon = (
        {name for name, each in trained.network.named_parameters() if any(each is one for one in group["params"])}
        for optimizer in trained.optimizers
        for group in optimizer.param_groups
    )
    layer = "seqTransEncoder.layers.0."
    matrices = ("self_attn.in_proj_weight", "self_attn.out_proj.weight", "linear1.weight", "linear2.weight")
    assert muon == {layer + name for name in matrices}
    assert adamw == {name for name, _ in trained.network.named_parameters()} - muon
    before = {name: each.detach().clone() for name, each in trained.network.named_parameters()}
    trained._update()
    step = trained.network.get_parameter(layer + "linear2.weight").detach() - before[layer + "linear2.weight"]
    stretched = torch.linalg.svdvals(step) / trained.settings.lr_at(0)  # all directions alike, where AdamW knows a few
    assert 0.2 * math.sqrt(32) * 0.6 < float(stretched.min()) <= float(stretched.max()) < 0.2 * math.sqrt(32) * 1.3


def test_where_bf16_is_imitated_muon_takes_torchs_steps_in_fp32(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.Tensor, "bfloat16", torch.Tensor.float)  # torch's own iteration in fp32, to compare with
    networks = []
    for imitates in (True, False):
        monkeypatch.setattr(optimizers, "imitates_bf16", lambda device, answer=imitates: answer)
        trained = trainer(tmp_path / str(imitates), optimizer="muon", dropout=0.0, precision="fp32")
        assert (type(trained.optimizers[1].optimizer) is torch.optim.Muon) is not imitates
        for trained.step in range(3):
            trained._update()
        networks.append(trained.network.state_dict())
    torch.testing.assert_close(*networks)


def test_with_rounds_batches_come_again_with_their_noise_and_a_teacher_is_asked_once(tmp_path):
    asked = []

    def teach(batch, noisy, t):
        asked.append(len(noisy))
        return batch.motion

    def objective() -> Denoising:
        teacher = RememberingTeacher(teach, 2 * (loop.ROUND + 1))
        return Denoising(Schedule.cosine(20), fields=LAYOUT.slices, teacher=teacher)

    steps = 2 * loop.ROUND + 3
    assert [Settings(steps, rounds=2).drawn_at(step) for step in range(steps)] == [
        *range(loop.ROUND), *range(loop.ROUND), *range(loop.ROUND, loop.ROUND + 3),
    ]  # fmt: skip
    settings = {"objective": objective(), "steps": steps, "rounds": 2, "pieces": 1, "validate_every": 100}
    whole = trainer(tmp_path / "whole", **settings).run().state_dict()
    assert len(asked) == loop.ROUND + 3 + 1  # and once for the validation

    def kill(step, _):
        if step == loop.ROUND + 2:
            raise Killed

    with pytest.raises(Killed):
        trainer(tmp_path / "killed", callbacks=[Callback(1, kill)], **settings).run()
    resumed = trainer(tmp_path / "killed", **(settings | {"objective": objective()})).run().state_dict()
    assert all(torch.equal(resumed[name], whole[name]) for name in whole)


def test_a_run_that_changes_its_optimizer_goes_on_from_the_weights(tmp_path):
    trainer(tmp_path, steps=2).run()
    other = trainer(tmp_path, steps=4, lr_decay_steps=2, optimizer="muon", allow_changed_settings=True)
    assert other.step == 2 and not any(optimizer.state_dict()["state"] for optimizer in other.optimizers)
    other.run()


def test_a_checkpoint_of_one_optimizer_alone_is_still_read(tmp_path):
    first = trainer(tmp_path, steps=2)
    first.run()
    state = first._state()
    first.checkpoints.save(2, state | {"optimizer": state["optimizer"][0]})
    again = trainer(tmp_path, steps=2)
    torch.testing.assert_close(again.optimizers[0].state_dict(), first.optimizers[0].state_dict())


def test_the_average_follows_at_the_warmed_up_decay():
    network = nn.Linear(1, 1)
    ema = Ema(network, decay=0.9)
    expected = network.weight.item()
    for step in range(200):
        with torch.no_grad():
            network.weight += 1.0
        ema.update(network, step)
        decay = min(0.9, (1 + step) / (10 + step))
        expected = decay * expected + (1 - decay) * network.weight.item()
        assert ema.model.weight.item() == pytest.approx(expected, rel=1e-5)
    assert ema.model.weight.item() == pytest.approx(network.weight.item() - 9, rel=1e-3)  # its lag: decay / (1 - decay)
    assert not ema.model.weight.requires_grad


@pytest.mark.parametrize(("optimizer", "moments"), [("adamw", (1, 7, 12)), ("muon", (7,))])
def test_a_run_stopped_anywhere_goes_on_as_if_nothing_had_happened(tmp_path, optimizer, moments):
    whole = trainer(tmp_path / "whole", optimizer=optimizer).run().state_dict()
    for moment in moments:

        def kill(step, _, moment=moment):
            if step == moment:
                raise Killed

        folder = tmp_path / str(moment)
        with pytest.raises(Killed):
            trainer(folder, callbacks=[Callback(1, kill)], optimizer=optimizer).run()
        resumed = trainer(folder, optimizer=optimizer)
        assert resumed.step == (moment - 1) // 4 * 4  # a checkpoint is the last thing that a step does
        model = resumed.run().state_dict()
        assert all(torch.equal(model[name], whole[name]) for name in whole)
        assert losses(folder) == losses(tmp_path / "whole")


def test_a_finished_run_has_nothing_to_do(tmp_path):
    trainer(tmp_path, steps=4).run()
    again = trainer(tmp_path, steps=4)
    assert again.step == 4
    again.run()
    assert [row["step"] for row in rows(tmp_path / "train.csv")] == ["2", "4"]


def test_a_run_that_has_more_steps_than_asked_for_says_so(tmp_path, caplog):
    trainer(tmp_path, steps=4).run()
    trainer(tmp_path, steps=2, lr_decay_steps=4).run()
    assert "the run already has 4 steps; settings ask for 2" in caplog.text


def test_another_seed_cannot_go_on_with_a_run(tmp_path):
    trainer(tmp_path, steps=4).run()
    with pytest.raises(SettingsChanged, match="seed: 0 → 1"):
        trainer(tmp_path, steps=8, lr_decay_steps=4, seed=1)


def test_a_run_of_an_earlier_version_goes_on_under_todays_names(tmp_path, monkeypatch):
    with monkeypatch.context() as before:
        old = {"training.lr": "training.rate", "training.ema_decay": "training.decay"}
        renamed = loop.deciding_settings
        before.setattr(
            loop, "deciding_settings", lambda now: {old.get(path, path): v for path, v in renamed(now).items()}
        )
        trainer(tmp_path, steps=2).run()
    table = tmp_path / "train.csv"
    table.write_text(table.read_text().replace(",lr,", ",rate,"))
    again = trainer(tmp_path, steps=4, lr_decay_steps=2)
    assert again.step == 2
    again.run()
    assert [row["step"] for row in rows(table)] == ["2", "4"]


def test_what_a_run_was_begun_with_is_named_with_both_values_where_it_differs(tmp_path):
    trainer(tmp_path, steps=2, described={"data": {"rows": 48, "trim": 0.1}, "cache": "abc"}).run()
    other = {"data": {"rows": 8, "trim": 0.1}, "cache": "abd", "start": None}
    with pytest.raises(SettingsChanged) as refusal:
        trainer(tmp_path, steps=2, lr=1.0, described=other)
    for difference in ("data.rows: 48 → 8", "cache: abc → abd", "start: absent → None", "training.lr: 0.003 → 1.0"):
        assert difference in str(refusal.value)
    assert "trim" not in str(refusal.value) and "allow_changed_settings=true" in str(refusal.value)


def test_a_run_may_go_on_with_other_settings_where_that_is_asked_for_and_remembers_it(tmp_path, caplog):
    trainer(tmp_path, steps=2, described={"cache": "abc"}).run()
    changed = {"steps": 4, "lr_decay_steps": 2, "described": {"cache": "abd"}}
    trainer(tmp_path, **changed, allow_changed_settings=True).run()
    assert "resumes with other settings: cache: abc → abd" in caplog.text
    again = trainer(tmp_path, **changed)
    assert (again.step, again.changes) == (4, ["after step 2: cache: abc → abd"])


def test_places_machines_and_intervals_may_change(tmp_path):
    begun = {"run": "a", "device": "cpu", "threads": 2, "data": {"folder": "b", "preparation": {"fps": 20}, "rows": 8}}
    trainer(tmp_path, steps=2, described=begun).run()
    moved = {"run": "c", "device": "cuda", "threads": None, "data": {"folder": "d", "rows": 8}}
    intervals = {"log_every": 1, "validate_every": 2, "checkpoint_every": 2, "keep": 3}
    assert trainer(tmp_path, **intervals, steps=1, lr_decay_steps=2, described=moved).step == 2


def test_a_longer_run_must_say_where_its_rate_has_fallen(tmp_path):
    trainer(tmp_path, steps=2, warmup=1).run()
    with pytest.raises(SettingsChanged, match=r"to extend the run, set training\.lr_decay_steps=2"):
        trainer(tmp_path, steps=4, warmup=1)
    trainer(tmp_path, steps=4, lr_decay_steps=2, warmup=1).run()
    trainer(tmp_path / "whole", steps=4, lr_decay_steps=2, warmup=1, validate_every=2).run()
    assert losses(tmp_path) == losses(tmp_path / "whole")
    assert rows(tmp_path / "train.csv")[-1]["lr"] == format(3e-3 * 0.02, ".9g")


def cut(content: bytes) -> bytes:
    return content[: len(content) // 2]


def flipped(content: bytes) -> bytes:
    middle = len(content) // 2
    return content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]


@pytest.mark.parametrize("damage", [cut, flipped, lambda content: b"", lambda content: content + b"0"])
def test_a_damaged_checkpoint_is_passed_over_and_named(tmp_path, damage, caplog):
    checkpoints, found = Checkpoints(tmp_path), []
    for step in (4, 8):
        checkpoints.save(step, {"value": torch.tensor(step)})
    newest = tmp_path / "step-00000008.pt"
    newest.write_bytes(damage(newest.read_bytes()))
    assert checkpoints.restore(lambda step, state: found.append(int(state["value"]))) == 4
    assert found == [4] and "step-00000008.pt is damaged (its checksum is wrong); resuming from step 4" in caplog.text


def test_where_no_checkpoint_is_whole_the_message_says_what_to_do(tmp_path):
    for step in (4, 8):
        (tmp_path / f"step-{step:08d}.pt").touch()
    with pytest.raises(CheckpointError, match=r"0008.pt is damaged.*0004.pt is damaged.*remove this folder"):
        Checkpoints(tmp_path).restore(lambda *state: pytest.fail("taken"))


def test_a_run_whose_newest_checkpoint_is_damaged_comes_to_the_same_end(tmp_path):
    quick = {"steps": 4, "checkpoint_every": 2, "validate_every": 2}
    whole = trainer(tmp_path, **quick).run().state_dict()
    logged, newest = losses(tmp_path), tmp_path / "checkpoints" / "step-00000004.pt"
    newest.write_bytes(flipped(newest.read_bytes()))
    resumed = trainer(tmp_path, **quick)
    assert resumed.step == 2
    model = resumed.run().state_dict()
    assert all(torch.equal(model[name], whole[name]) for name in whole)
    assert resumed.checkpoints.steps() == [2, 4] and losses(tmp_path) == logged


def test_a_checkpoint_of_another_network_is_passed_over_and_changes_nothing(tmp_path, caplog):
    trainer(tmp_path, steps=4).run()
    wide = trainer(tmp_path / "wide", MdmSmpl(LAYOUT.width, 8, width=32, feedforward=32, layers=1, heads=2), steps=4)
    Checkpoints(tmp_path / "checkpoints").save(8, wide._state())
    resumed = trainer(tmp_path, steps=4)
    assert resumed.step == 4 and "step-00000008.pt is damaged (it belongs to another network)" in caplog.text


def test_a_damaged_checkpoint_of_a_later_step_outlives_no_whole_one(tmp_path):
    checkpoints = Checkpoints(tmp_path, keep=1)
    checkpoints.save(8, {})
    checkpoints.save(6, {})
    assert checkpoints.steps() == [6]


def test_a_step_leaves_the_global_generator_alone(tmp_path):
    run = trainer(tmp_path)
    before = torch.get_rng_state()
    run._update()
    assert torch.equal(before, torch.get_rng_state())


def test_callbacks_get_the_average_now_and_then_and_at_the_end(tmp_path):
    seen = []
    run = trainer(tmp_path, steps=10, callbacks=[Callback(4, lambda step, model: seen.append((step, model.training)))])
    run.run()
    assert seen == [(4, False), (8, False), (10, False)]


def test_a_loss_that_is_not_finite_stops_the_run(tmp_path):
    run = trainer(tmp_path, Constant(LAYOUT.width))
    with torch.no_grad():
        run.network.frame.fill_(torch.nan)
    with pytest.raises(FloatingPointError, match="steps 1 to 2 is nan"):
        run.run()
    assert not (tmp_path / "checkpoints").exists()


def test_tensorboard_gets_what_the_tables_get(tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    trainer(tmp_path, steps=8).run()
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    logged = {event.step: event.value for event in events.Scalars("train/loss_rotations")}
    for row in rows(tmp_path / "train.csv"):
        assert logged[int(row["step"])] == pytest.approx(float(row["loss_rotations"]))
    assert events.Scalars("validation/loss")


def test_only_the_newest_checkpoints_stay(tmp_path):
    checkpoints = Checkpoints(tmp_path, keep=2)
    found = []
    assert checkpoints.restore(lambda *state: found.append(state)) == 0 and not found
    for step in (5, 10, 100):
        checkpoints.save(step, {"value": torch.tensor(step)})
    (tmp_path / ".step-00000200.pt.1234").write_bytes(b"a kill while writing")
    assert checkpoints.steps() == [10, 100]
    assert checkpoints.restore(lambda *state: found.append(state)) == 100
    [(step, state)] = found
    assert (step, int(state["value"])) == (100, 100)


def test_a_checkpoint_that_carries_code_is_not_run(tmp_path):
    class Evil:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "pwned"),)

    Checkpoints(tmp_path).save(1, {"model": Evil()})
    with pytest.raises(CheckpointError, match="more than tensors and plain data"):
        Checkpoints(tmp_path).restore(lambda *state: pytest.fail("taken"))
    assert not (tmp_path / "pwned").exists()


def test_a_checkpoint_can_be_read_without_this_library(tmp_path):
    Checkpoints(tmp_path).save(1, {"model": {"weight": torch.ones(3)}})
    assert torch.load(tmp_path / "step-00000001.pt", weights_only=True)["model"]["weight"].sum() == 3


def test_an_accelerator_that_is_not_there_is_an_error(monkeypatch):
    def absent(*shape, device):
        raise RuntimeError(f"no {device}")

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch, "empty", absent)
    with pytest.raises(ValueError, match="device 'cuda' is unknown or not available here; choose from auto, cpu"):
        find_accelerator("cuda")
    with pytest.raises(ValueError, match="device='gpu': choose from auto, cpu, cuda"):
        find_accelerator("gpu")
    assert find_accelerator("auto").device.type == "cpu"


def test_where_there_is_no_terminal_the_loss_is_told_in_lines(tmp_path, caplog):
    caplog.set_level("INFO")
    trainer(tmp_path, steps=2).run()
    assert f"starting {tmp_path} on cpu: 0 of 2 steps done" in caplog.text
    assert "step 2 of 2: loss " in caplog.text
    trainer(tmp_path, steps=2)
    assert f"resuming {tmp_path} on cpu: 2 of 2 steps done" in caplog.text


def test_a_table_forgets_later_rows_and_half_rows(tmp_path):
    path = tmp_path / "train.csv"
    table = Table(path, ("loss", "lr"), 0)
    for step in (10, 20, 30):
        table.write(step, {"loss": 1 / step, "lr": 0.1})
    with path.open("a") as file:
        file.write("4")
    resumed = Table(path, ("loss", "lr"), 20)
    assert [row["step"] for row in rows(path)] == ["10", "20"]
    resumed.write(30, {"loss": 0.5, "lr": 0.1})
    assert rows(path)[-1] == {"step": "30", "loss": "0.5", "lr": "0.1"}
    with pytest.raises(ValueError, match="has the columns"):
        Table(path, ("loss",), 0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_byte_dropout_drops_its_share_and_keeps_the_mean(dtype):
    torch.manual_seed(0)
    dropout = ByteDropout(0.25)
    x = torch.ones(1001, 301, dtype=dtype, requires_grad=True)
    y = dropout(x)
    assert y.dtype == dtype
    assert (y == 0).float().mean() == pytest.approx(0.25, abs=0.005)
    assert y.detach().float().mean() == pytest.approx(1.0, abs=0.01)
    y.sum().backward()
    assert torch.equal(x.grad, y.detach())  # dropped elements get no gradient, the others the same scale
    assert dropout.eval()(x) is x


def test_dropout_is_replaced_everywhere_and_only_dropout():
    network = MdmSmpl(11, 8, width=16, feedforward=32, layers=2, heads=2, dropout=0.1).eval()
    names = [*network.state_dict()]
    quicken_dropout(network)
    kinds = [type(module) for module in network.modules()]
    assert nn.Dropout not in kinds
    assert kinds.count(ByteDropout) == 3
    assert [*network.state_dict()] == names
    assert not any(module.training for module in network.modules())


def test_quick_attention_computes_the_same():
    query, key, value = torch.randn(3, 2, 4, 30, 16, requires_grad=True)
    mask = (torch.arange(30) < torch.tensor([30, 12])[:, None])[:, None, None]
    results = []
    for context in (quick_attention(torch.device("cpu")), quick_attention(torch.device("meta"))):
        with context:
            y = nn.functional.scaled_dot_product_attention(query, key, value, attn_mask=mask)
        results.append((y, torch.autograd.grad(y.square().sum(), query)[0]))
    for quick, plain in zip(*results, strict=True):
        torch.testing.assert_close(quick, plain, atol=1e-5, rtol=1e-4)
    assert not torch.backends.cuda.fp16_bf16_reduction_math_sdp_allowed()


def script(folder, *arguments) -> subprocess.Popen:
    environment = os.environ | {"OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": "", "ACCELERATE_USE_CPU": "true"}
    return subprocess.Popen([sys.executable, *arguments, str(folder)], cwd=HERE, env=environment)


@pytest.mark.slow
def test_a_process_that_is_killed_goes_on_to_the_same_losses(tmp_path):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    uninterrupted, victim = (script(folder, "train_toy.py", "--steps=80") for folder in (whole, killed))
    deadline = time.monotonic() + 900
    while len(Checkpoints(killed / "checkpoints").steps()) < 2 and victim.poll() is None:
        assert time.monotonic() < deadline, "no checkpoint appeared"
        time.sleep(0.01)
    victim.send_signal(signal.SIGKILL)
    victim.wait()
    assert Checkpoints(killed / "checkpoints").steps()[-1] < 80, "killed too late to mean anything"
    assert script(killed, "train_toy.py", "--steps=80").wait(900) == 0
    assert uninterrupted.wait(900) == 0
    assert losses(killed) == losses(whole)
    assert len(losses(whole)) == 40 + 10


@pytest.mark.slow
def test_two_processes_share_a_step(tmp_path):
    launch = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2")
    assert script(tmp_path, *launch, "train_toy.py", "--steps=8").wait(900) == 0
    first, second = (torch.load(tmp_path / f"process-{rank}.pt", weights_only=True) for rank in (0, 1))
    assert all(torch.equal(first["network"][name], second["network"][name]) for name in first["network"])
    assert first["drawn"] != second["drawn"]
    drawn = first["drawn"] + second["drawn"]
    assert sum(int(float(row["frames"])) for row in rows(tmp_path / "frames.csv")) == sum(drawn)


def test_training_in_bf16_warns_of_a_processor_that_imitates_it(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "AVX2")
    monkeypatch.setattr("platform.machine", lambda: "x86_64")
    with pytest.warns(UserWarning, match="precision=bf16 is very slow on this processor"):
        trainer(tmp_path, precision="bf16")
