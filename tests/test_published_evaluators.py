"""Published evaluators become this library's: small files in the true formats, written here."""

import pytest
import torch
from helpers.motions import walking
from helpers.tiny_model import Hashes

from stmc.evaluators import GuoEvaluator, Tmr
from stmc.run import load_evaluator
from stmc.run.published import CheckpointError, convert, read, read_guo


def tmr_run(folder, **sizes):
    """`folder`/models/run as TMR leaves it, its statistics beside `models`; the network whose weights it has."""
    torch.manual_seed(0)
    network = Tmr(263, 384, **({"width": 16, "feedforward": 32, "layers": 2} | sizes)).eval()
    run, statistics = folder / "models" / "run", folder / "stats" / "humanml3d" / "guoh3dfeats"
    for part in ("motion_encoder", "text_encoder", "motion_decoder"):
        (run / "last_weights").mkdir(parents=True, exist_ok=True)
        torch.save(getattr(network, part).state_dict(), run / "last_weights" / f"{part}.pt")
    (run / "config.json").write_text('{"model": {"vae": true}}')
    statistics.mkdir(parents=True)
    torch.save(torch.linspace(-1, 1, 263), statistics / "mean.pt")
    torch.save(torch.linspace(0, 2, 263), statistics / "std.pt")
    return run, network


@pytest.mark.parametrize("variational", [True, False])
def test_a_run_of_tmr_becomes_an_evaluator_that_gives_the_networks_latents(tmp_path, variational):
    run, network = tmr_run(tmp_path, variational=variational)
    folder = convert(run, tmp_path / "imported")
    judge = load_evaluator(folder)
    assert judge.fps == 20
    features = judge.features(walking(3.0))
    normal = (features - torch.linspace(-1, 1, 263)) / (torch.linspace(0, 2, 263) + 1e-12)
    torch.testing.assert_close(judge.motions([features])[0], network.motion_encoder(normal[None]).mean[0].detach())
    words = Hashes().encode(["walk fast"])[0]
    torch.testing.assert_close(judge.text_statistics.normalise(words), words)
    assert judge.text_encoder.name == "distilbert/distilbert-base-uncased 512 tokens"
    assert "TMR" in (folder / "README.md").read_text()


def test_weights_are_cut_out_of_the_last_checkpoint_where_they_are_not_split(tmp_path):
    run, network = tmr_run(tmp_path)
    for file in (run / "last_weights").iterdir():
        file.unlink()
    (run / "last_weights").rmdir()
    (run / "logs" / "checkpoints").mkdir(parents=True)
    state = network.state_dict() | {"something.else": torch.zeros(3)}
    torch.save({"state_dict": state, "epoch": 3}, run / "logs" / "checkpoints" / "last.ckpt")
    back = read(run).model.network.state_dict()
    assert all(torch.equal(value, back[name]) for name, value in network.state_dict().items())


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda run: (run / "last_weights" / "text_encoder.pt").unlink(), "text_encoder.pt does not exist"),
        (lambda run: (run / "last_weights" / "text_encoder.pt").write_bytes(b"no"), "text_encoder.pt"),
        (lambda run: torch.save({"x": torch.zeros(2)}, run / "last_weights" / "motion_encoder.pt"), "another model"),
        (
            lambda run: torch.save(torch.zeros(9), run.parent.parent / "stats/humanml3d/guoh3dfeats/mean.pt"),
            r"mean.pt must hold 263 numbers, not \[9\]",
        ),
        (
            lambda run: torch.save({"a": 1}, run.parent.parent / "stats/humanml3d/guoh3dfeats/std.pt"),
            "std.pt holds a dict, not a tensor",
        ),
        (
            lambda run: torch.save(-torch.ones(263), run.parent.parent / "stats/humanml3d/guoh3dfeats/std.pt"),
            "std of 0 or more",
        ),
    ],
)
def test_a_damaged_run_of_tmr_is_an_error_and_leaves_nothing(tmp_path, damage, message):
    run, _ = tmr_run(tmp_path)
    damage(run)
    with pytest.raises(CheckpointError, match=message):
        convert(run, tmp_path / "imported")
    assert not (tmp_path / "imported").exists()


def test_statistics_may_lie_anywhere(tmp_path):
    run, _ = tmr_run(tmp_path)
    moved = (tmp_path / "stats" / "humanml3d" / "guoh3dfeats").rename(tmp_path / "elsewhere")
    with pytest.raises(CheckpointError, match="does not exist"):
        read(run)
    assert read(run, moved).model.motion_statistics.mean[0] == -1


def test_the_evaluator_of_guo_is_read_from_its_file_whatever_its_sizes(tmp_path):
    torch.manual_seed(0)
    network = GuoEvaluator(7, (8, 6), 5, 4, 3, 2).eval()
    sections = {
        name: getattr(network, name).state_dict() for name in ("movement_encoder", "text_encoder", "motion_encoder")
    }
    torch.save(sections | {"epoch": 3, "opt_text_encoder": {"state": {}}}, tmp_path / "finest.tar")
    back = read_guo(tmp_path / "finest.tar")
    motions, lengths = torch.randn(2, 12, 9), torch.tensor([12, 8])
    torch.testing.assert_close(back.motions(motions, lengths), network.motions(motions, lengths))
    del sections["text_encoder"]
    torch.save(sections, tmp_path / "finest.tar")
    with pytest.raises(CheckpointError, match="holds no text_encoder"):
        read_guo(tmp_path / "finest.tar")
