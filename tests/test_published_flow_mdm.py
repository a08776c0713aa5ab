"""FlowMDM's published files become run directories, and what does not fit is refused with the reason."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import GOLDEN, checked
from helpers import checkpoints
from helpers.flow_mdm import entries, parameters
from helpers.published_networks import weight

import stmc
from stmc.denoisers import FlowMdm
from stmc.denoisers.flow_mdm_layers import frequencies
from stmc.diffusion import Schedule
from stmc.diffusion.tensors import sinusoids
from stmc.motion.representation import BabelRepresentation, HumanML3DRepresentation
from stmc.run.published.conversion import convert, read
from stmc.run.published.torch_checkpoint import CheckpointError

FILE = {"humanml": "model000500000.pt", "babel": "model001300000.pt"}
FEATURES = {"humanml": 263, "babel": 135}
SETS = pytest.mark.parametrize("dataset", ["humanml", "babel"])


def tables(width: int) -> dict[str, torch.Tensor]:
    """What a published file holds beside what is learned."""
    rows = sinusoids(5000, width)[:, None]
    rotary = "seqTransEncoder.attn_layers.rotary_pos_emb"
    return {
        "sequence_pos_encoder.pe": rows,
        "embed_timestep.sequence_pos_encoder.pe": rows.clone(),
        "t_pos_encoder.pe": rows.clone(),
        f"{rotary}.relative.inv_freq": frequencies(16).float(),
        f"{rotary}.last_timestep": torch.zeros(1),
        "clip_model.token_embedding.weight": torch.zeros(2, 2),
    }


def statistics(folder: Path, dataset: str) -> dict[str, torch.Tensor]:
    draw = torch.Generator().manual_seed(0)
    values = {"mean": torch.randn(FEATURES[dataset], generator=draw)}
    values["std"] = 0.5 + torch.rand(FEATURES[dataset], generator=draw)
    for moment, value in values.items():
        if dataset == "babel":
            torch.save(value, folder / f"rfeats_{moment}.pt")
        else:
            np.save(folder / f"{moment.capitalize()}.npy", value.numpy())
    return values


SMALL = {"width": 16, "feedforward": 32, "layers": 1, "heads": 2, "attention_window": 9}


def write(folder: Path, dataset: str, extra: dict | None = None, steps: int = 1000, **sizes) -> FlowMdm:
    """As FlowMDM's training writes them, of a small network or one of other `sizes`."""
    folder.mkdir(exist_ok=True)
    sizes = sizes or SMALL
    network = checkpoints.seeded(lambda: FlowMdm(FEATURES[dataset], 512, 0, **sizes))
    torch.save(network.state_dict() | tables(sizes["width"]) | (extra or {}), folder / FILE[dataset])
    said = {"latent_dim": sizes["width"], "num_heads": sizes["heads"], "rpe_horizon": sizes["attention_window"]}
    said |= {"dataset": dataset, "bpe_training_ratio": 0.5, "noise_schedule": "cosine", "diffusion_steps": steps}
    (folder / "args.json").write_text(json.dumps(said))
    statistics(folder, dataset)
    return network


@SETS
def test_a_checkpoint_becomes_a_model_that_is_sampled_as_published(tmp_path, dataset):
    network = write(tmp_path / "theirs", dataset)
    clip = str(checkpoints.clip(tmp_path / "clip"))
    model = stmc.load(convert(tmp_path / "theirs", tmp_path / "ours", text_model=clip))
    for name, value in network.state_dict().items():
        assert torch.equal(model.denoiser.state_dict()[name], value)
    babel = dataset == "babel"
    assert isinstance(model.representation, BabelRepresentation if babel else HumanML3DRepresentation)
    assert model.denoiser.attention_window == 9
    assert model.denoiser.absolute_from == (876 if babel else 941)
    assert (model.fps, model.longest, model.own_sampling.guidance, model.own_sampling.noise_scale) == (
        (30, 250, 1.5, "std") if babel else (20, 196, 2.5, "std")
    )
    assert torch.equal(model.schedule.alpha_bar, Schedule.cosine(1000).alpha_bar)
    assert model.text_encoder.encoder.tokens == (None if babel else 22)
    expected = statistics(tmp_path / "theirs", dataset)
    torch.testing.assert_close(model.motion_statistics.mean, expected["mean"])
    torch.testing.assert_close(model.motion_statistics.std, expected["std"])
    timeline = stmc.Timeline.parse("walk # 0 # 12 # legs\nraise # 1 # 3 # right arm")
    [motion] = model.generate(timeline, steps=2, method="flow_mdm")
    assert motion.frames == 12 * model.fps and motion.joints.isfinite().all()
    [motion] = model.generate(timeline, steps=2)
    assert motion.frames == 12 * model.fps
    assert "method=flow_mdm" in (tmp_path / "ours" / "README.md").read_text("utf-8")


def test_one_file_and_statistics_elsewhere_do(tmp_path):
    write(tmp_path / "theirs", "babel")
    (tmp_path / "stats").mkdir()
    for moment in ("mean", "std"):
        (tmp_path / "theirs" / f"rfeats_{moment}.pt").rename(tmp_path / "stats" / f"rfeats_{moment}.pt")
    assert read(tmp_path / "theirs" / FILE["babel"], tmp_path / "stats").title == "FlowMDM"
    with pytest.raises(CheckpointError, match=r"rfeats_mean\.pt"):
        read(tmp_path / "theirs")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dataset": "kit"}, "dataset must be humanml or babel, not 'kit'"),
        ({"rpe_horizon": -1}, "rpe_horizon must be a positive integer up to 10000, not -1"),
        ({"noise_schedule": "sigmoid"}, "noise_schedule must be cosine or linear"),
        ({"extra": {"embed_action.weight": torch.zeros(1)}}, r"unknown: embed_action\.weight"),
        ({"extra": {"embed_text.bias": torch.full((16,), torch.nan)}}, r"not finite: embed_text\.bias"),
        (
            {"extra": {"sequence_pos_encoder.pe": torch.zeros(5000, 1, 16)}},
            "differs from the expected positional table",
        ),
        (
            {"extra": {"seqTransEncoder.attn_layers.rotary_pos_emb.relative.inv_freq": torch.ones(16)}},
            "differs from FlowMDM's rotary",
        ),
    ],
)
def test_what_cannot_be_imported_is_refused_with_the_reason(tmp_path, change, message):
    write(tmp_path, "humanml", change.get("extra"))
    args = tmp_path / "args.json"
    args.write_text(
        json.dumps(json.loads(args.read_text()) | {key: value for key, value in change.items() if key != "extra"})
    )
    with pytest.raises(CheckpointError, match=message):
        read(tmp_path)


@pytest.mark.parametrize("value", [torch.zeros(134), torch.full((135,), torch.nan)])
def test_statistics_that_are_none_are_refused(tmp_path, value):
    write(tmp_path, "babel")
    torch.save(value, tmp_path / "rfeats_std.pt")
    with pytest.raises(CheckpointError, match=r"rfeats_std\.pt must hold 135 numbers, not \[134\]|must be finite"):
        read(tmp_path)


@pytest.mark.slow
@pytest.mark.golden
@pytest.mark.skipif(not (GOLDEN / "flow").exists(), reason=f"no golden numbers at {GOLDEN / 'flow'} (set STMC_GOLDEN)")
def test_every_name_of_the_published_checkpoints_has_its_place(tmp_path, subtests):
    checked(subtests, [(every_name_has_its_place, dataset) for dataset in FILE], tmp_path)


def every_name_has_its_place(tmp_path, dataset):
    tmp_path = tmp_path / dataset
    write(tmp_path, dataset)
    shapes = parameters(f"full_{dataset}")
    learned = {key: weight(key, shape, False, 0) for key, shape in shapes.items()}
    assert set(learned) | set(tables(512)) >= set(entries(f"full_{dataset}"))
    torch.save(learned | tables(512), tmp_path / FILE[dataset])
    network = read(tmp_path).model.denoiser
    assert len(network.seqTransEncoder.attn_layers.layers) == 16
    assert {key: tuple(value.shape) for key, value in network.state_dict().items()} == shapes


def test_of_fewer_steps_than_are_absolute_all_are(tmp_path):
    """In the published code every step is then above the number of steps less the absolute ones."""
    write(tmp_path / "theirs", "babel", steps=50)
    model = read(tmp_path / "theirs").model
    assert model.schedule.steps == 50 and model.denoiser.absolute_from == 0
