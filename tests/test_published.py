"""Published checkpoints become run directories: complete, with the numbers of their files, or an error and nothing."""

import json
import subprocess
import sys
import zipfile
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import checked, golden, golden_sets
from helpers import checkpoints
from helpers.scripts import run, script
from test_text import RunsCode

import stmc
from stmc.denoisers import MdmDecoder, MdmSmpl
from stmc.diffusion.tensors import sinusoids
from stmc.run.published import CheckpointError, convert, read
from stmc.run.published.torch_checkpoint import fill, read_checkpoint

WRITERS = [checkpoints.mdm_smpl, checkpoints.mdm, checkpoints.motion_diffuse]
FILES = {
    checkpoints.mdm_smpl: "logs/checkpoints/last.ckpt",
    checkpoints.mdm: "model000200000.pt",
    checkpoints.motion_diffuse: "model/latest.tar",
}


@pytest.mark.parametrize("by_file", [False, True])
@pytest.mark.parametrize("write", WRITERS)
def test_a_checkpoint_becomes_a_run_directory_with_the_same_network(tmp_path, write, by_file):
    network = write(tmp_path / "theirs")
    source = tmp_path / "theirs" / FILES[write] if by_file else tmp_path / "theirs"
    model = stmc.load(convert(source, tmp_path / "ours"))
    weights, expected = model.denoiser.state_dict(), network.state_dict()
    assert set(weights) == set(expected)
    assert all(torch.equal(weights[name], value) for name, value in expected.items())
    assert type(model.denoiser) is type(network)
    x, text = torch.randn(1, 7, model.representation.width), torch.randn(1, 1, 512)
    t = torch.tensor([3])
    torch.testing.assert_close(model.denoiser(x, t, text), network(x, t, text))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ours", "theirs"]


def test_what_mdm_smpl_is_sampled_with_is_that_of_the_published_code(tmp_path):
    checkpoints.mdm_smpl(tmp_path / "theirs")
    model = stmc.load(convert(tmp_path / "theirs", tmp_path / "ours"))
    assert (model.schedule.steps, model.fps, model.longest, model.prediction) == (100, 20, 200, "x0")
    assert (model.own_sampling.guidance, model.own_sampling.noise_scale) == (2.5, "variance")
    assert model.network.fixed_length is None
    state = torch.load(tmp_path / "theirs" / FILES[checkpoints.mdm_smpl], weights_only=True)["state_dict"]
    for side, statistics in (("motion", model.motion_statistics), ("text", model.text_statistics)):
        assert torch.equal(statistics.mean, state[f"{side}_normalizer.mean"])
        torch.testing.assert_close(statistics.std, state[f"{side}_normalizer.std"] + 1e-12, rtol=0, atol=0)
    assert model.representation.width == 205 and model.text_encoder.name == "openai/clip-vit-base-patch32"


def test_what_mdm_is_sampled_with_is_that_of_the_published_code(tmp_path):
    checkpoints.mdm(tmp_path / "theirs")
    model = stmc.load(convert(tmp_path / "theirs", tmp_path / "ours"))
    assert (model.schedule.steps, model.fps, model.longest, model.prediction) == (1000, 20, 196, "x0")
    assert (model.own_sampling.guidance, model.own_sampling.noise_scale) == (2.5, "std")
    assert model.network.fixed_length == 196
    np.testing.assert_array_equal(model.motion_statistics.mean, np.load(tmp_path / "theirs" / "Mean.npy"))
    np.testing.assert_array_equal(model.motion_statistics.std, np.load(tmp_path / "theirs" / "Std.npy"))
    assert not model.text_encoder.encode([""])[0].any()
    assert model.text_encoder.name == "openai/clip-vit-base-patch32 22 tokens fp16, empty as zeros"
    assert float(model.schedule.beta[0]) == pytest.approx(4.13e-5, rel=1e-3)


def test_what_motion_diffuse_is_sampled_with_is_that_of_the_published_code(tmp_path):
    checkpoints.motion_diffuse(tmp_path / "theirs")
    model = stmc.load(convert(tmp_path / "theirs", tmp_path / "ours"))
    assert (model.schedule.steps, model.fps, model.longest, model.prediction) == (1000, 20, 196, "eps")
    assert (model.own_sampling.guidance, model.own_sampling.noise_scale) == (1.0, "std")
    assert model.network.fixed_length is None
    np.testing.assert_array_equal(model.motion_statistics.std, np.load(tmp_path / "theirs" / "meta" / "std.npy"))
    assert model.text_encoder.name == "openai/clip-vit-base-patch32 positions"
    assert float(model.schedule.beta[-1]) == pytest.approx(0.02)


@pytest.mark.slow
def test_an_imported_model_samples_with_the_scripts(tmp_path):
    checkpoints.mdm(tmp_path / "theirs")
    text_model = checkpoints.clip(tmp_path / "clip")
    source, ours = f"source={tmp_path / 'theirs'}", tmp_path / "ours"
    done = script("import_checkpoint", source, f"output={ours}", f"text_model={text_model}", folder=tmp_path / "here")
    assert f"stmc sample model={ours}" in done.stdout
    (tmp_path / "two.txt").write_text("walk # 0 # 1 # legs\nraise the right arm # 0.5 # 1.5 # right arm\n")
    settings = (f"timeline={tmp_path / 'two.txt'}", f"model={ours}", f"output={tmp_path / 'out'}", "steps=2")
    script("sample", *settings, "formats=[npz,bvh]", folder=tmp_path / "here")
    motion = stmc.read(tmp_path / "out" / "two_0.npz")
    assert motion.frames == 30 and motion.joints.isfinite().all()


@pytest.fixture(scope="module", params=WRITERS)
def imported(request, tmp_path_factory) -> stmc.Model:
    folder = tmp_path_factory.mktemp("imported")
    request.param(folder / "theirs")
    return read(folder / "theirs", text_model=str(checkpoints.clip(folder / "clip"))).model


@pytest.mark.parametrize("method", ["stmc", "sinc", "sinc_lerp", "single_track", "one_text"])
def test_every_method_runs_with_every_imported_model(imported, method):
    """Also for prompts longer than the model knows; a motion does not depend on its batch."""
    model = imported
    timelines = [
        stmc.Timeline.parse("walk # 0 # 11 # legs\nturn left # 1 # 3 # head"),
        stmc.Timeline.parse("raise # 0 # 1 # right arm"),
    ]
    motions = model.generate(timelines, steps=2, method=method)
    assert [motion.frames for motion in motions] == [model.longest if method == "one_text" else 220, 20]
    [alone] = model.generate(timelines[1:], seed=1, steps=2, method=method)
    torch.testing.assert_close(motions[1].joints, alone.joints, atol=1e-3, rtol=0)


# MDM's variants -----------------------------------------------------------------------------------


def test_weights_in_a_file_with_a_moving_average_are_the_ones_that_args_ask_for(tmp_path):
    def both(weights):
        return {"model": weights, "model_avg": {name: value.detach() + 1 for name, value in weights.items()}}

    for average in (False, True):
        folder = tmp_path / str(average)
        wrap = both if not average else lambda weights: {"model": both(weights)["model_avg"], "model_avg": weights}
        network = checkpoints.mdm(folder, wrap=wrap, use_ema=average)
        weight = read(folder).model.denoiser.embed_text.weight
        assert torch.equal(weight, network.embed_text.weight)


def test_fifty_steps_with_masked_frames_need_no_fixed_length(tmp_path):
    checkpoints.mdm(tmp_path, diffusion_steps=50, mask_frames=True, text_encoder_type="clip")
    model = read(tmp_path).model
    assert model.schedule.steps == 50 and model.denoiser.fixed_length is None
    assert float(model.schedule.beta[0]) == pytest.approx(0.00175, rel=1e-2)


@pytest.mark.parametrize(
    ("args", "leading"),
    [
        ({}, None),
        ({"emb_trans_dec": True}, "step_and_text"),
        ({"emb_trans_dec": True, "text_encoder_type": "clip"}, "step"),
    ],
)
def test_the_decoders_leading_token_follows_the_age_of_the_checkpoint(tmp_path, args, leading):
    network = checkpoints.mdm_decoder(leading=leading)
    checkpoints.mdm(tmp_path, network, arch="trans_dec", **args)
    model = read(tmp_path).model
    assert isinstance(model.denoiser, MdmDecoder) and model.denoiser.leading == leading


def test_the_decoder_with_distilbert_reads_its_tokens(tmp_path):
    checkpoints.mdm(tmp_path, checkpoints.mdm_decoder(768), arch="trans_dec", text_encoder_type="bert")
    model = read(tmp_path).model
    assert model.text_encoder.name == "distilbert/distilbert-base-uncased 512 tokens, empty as zeros"
    words = torch.randn(2, 5, 768)
    assert model.denoiser(torch.randn(2, 4, 263), torch.tensor([0, 9]), words).isfinite().all()


def test_statistics_of_mdm_may_lie_elsewhere(tmp_path):
    checkpoints.mdm(tmp_path / "theirs")
    (tmp_path / "HumanML3D").mkdir()
    for name in ("Mean.npy", "Std.npy"):
        (tmp_path / "theirs" / name).rename(tmp_path / "HumanML3D" / name)
    with pytest.raises(CheckpointError, match=r"Mean\.npy does not exist"):
        read(tmp_path / "theirs")
    assert read(tmp_path / "theirs", statistics=tmp_path / "HumanML3D").model.motion_statistics.std.min() >= 0.5


def test_of_several_weights_in_a_folder_one_has_to_be_named(tmp_path):
    checkpoints.mdm(tmp_path)
    checkpoints.mdm(tmp_path, name="model000475000.pt")
    with pytest.raises(CheckpointError, match=r"holds model000200000\.pt, model000475000\.pt; name the file"):
        read(tmp_path)
    assert "model000475000.pt" in read(tmp_path / "model000475000.pt").facts[1]


# What is wrong with a checkpoint ------------------------------------------------------------------


def test_weights_that_do_not_fit_are_listed_all():
    network = MdmSmpl(7, 5, width=8, feedforward=8, layers=1, heads=2)
    weights = network.state_dict()
    weights["surplus.weight"] = weights.pop("to_skel_layer.bias")
    weights["registers"] = torch.zeros(3, 8)
    weights["skel_embedding.bias"] = torch.full((8,), torch.nan)
    with pytest.raises(CheckpointError) as caught:
        fill(network, weights, "some.pt")
    message = str(caught.value)
    assert "some.pt does not fit MdmSmpl" in message
    assert "missing: to_skel_layer.bias" in message and "unknown: surplus.weight" in message
    assert "registers [3, 8] instead of [2, 8]" in message and "not finite: skel_embedding.bias" in message


def refused(source: Path, message: str, **settings) -> None:
    """An error that says so, and not a file more than there was."""
    before = sorted(source.parent.rglob("*"))
    with pytest.raises(CheckpointError, match=message):
        convert(source, source.parent / "ours", **settings)
    assert sorted(source.parent.rglob("*")) == before


DAMAGES = {
    "empty": (lambda path: path.write_bytes(b""), "is damaged|cannot be read"),
    "truncated": (lambda path: path.write_bytes(path.read_bytes()[:-500]), "is damaged|cannot be read"),
    "garbage": (lambda path: path.write_bytes(b"\x00garbage" * 99), "is damaged|cannot be read"),
    "a list": (lambda path: torch.save([1, 2], path), "holds a list"),
    "another model": (lambda path: torch.save({"layer.weight": torch.ones(2)}, path), "does not fit|has no"),
    "no weights": (lambda path: torch.save({}, path), "must be a dict of tensors|has no"),
    "absent": (Path.unlink, "does not exist|holds none"),
}


@pytest.mark.parametrize("write", WRITERS)
@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_weights_are_refused_and_leave_nothing(tmp_path, write, damage):
    write(tmp_path / "theirs")
    do, message = DAMAGES[damage]
    do(tmp_path / "theirs" / FILES[write])
    refused(tmp_path / "theirs", message)


@pytest.mark.parametrize("write", WRITERS)
def test_weights_that_would_run_code_are_refused_and_do_not_run_it(tmp_path, write):
    write(tmp_path / "theirs")
    path = tmp_path / "theirs" / FILES[write]
    content = torch.load(path, weights_only=True)
    torch.save(content | {"callbacks": RunsCode(tmp_path / "ran")}, path)
    refused(tmp_path / "theirs", "could execute code, and is not loaded")
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (partial(checkpoints.mdm, dataset="kit"), "dataset is 'kit', but only 'humanml'"),
        (partial(checkpoints.mdm, arch="gru"), "arch is 'gru', but only 'trans_enc' or 'trans_dec'"),
        (partial(checkpoints.mdm, unconstrained=True), "unconstrained is true"),
        (partial(checkpoints.mdm, cond_mode="no_cond"), "unconstrained is true"),
        (partial(checkpoints.mdm, pred_len=40, context_len=20), "pred_len is 40"),
        (partial(checkpoints.mdm, sigma_small=False), "sigma_small is false"),
        (partial(checkpoints.mdm, text_encoder_type="bert"), "reads CLIP's sentences only"),
        (partial(checkpoints.mdm, layers="many"), "layers must be a positive integer up to 10000, not 'many'"),
        (partial(checkpoints.mdm, latent_dim=18), "(?s)args.json: denoiser cannot be built: .*multiple of heads"),
        (partial(checkpoints.mdm, latent_dim=32), r"does not fit|differs from the expected positional table"),
        (
            partial(checkpoints.mdm, layers=2),
            r"does not fit the denoiser .*, MdmEncoder. missing: seqTransEncoder\.layers\.1",
        ),
        (partial(checkpoints.mdm, use_ema=True, wrap=lambda weights: {"model": weights}), "has no model_avg"),
        (partial(checkpoints.motion_diffuse, more="no_eff: True"), "no_eff is True"),
        (partial(checkpoints.motion_diffuse, more="no_clip: True"), "no_clip is True"),
        (partial(checkpoints.motion_diffuse, more="dataset_name: kit"), "dataset_name is kit"),
        (partial(checkpoints.motion_diffuse, more="num_layers: two"), "num_layers must be a positive integer"),
        (partial(checkpoints.motion_diffuse, more=""), "does not fit the denoiser of the config, MotionDiffuse"),
        (partial(checkpoints.mdm_smpl, motion_features="rots"), "motion_features must be smplrifke or guoh3dfeats"),
        (partial(checkpoints.mdm_smpl, diffusion__prediction="y"), "prediction must be one of x, x0"),
        (
            partial(checkpoints.mdm_smpl, diffusion__schedule={"_target_": "Square"}),
            "schedule must be cosine or",
        ),
        (partial(checkpoints.mdm_smpl, diffusion__denoiser__num_heads=7), "config.json: denoiser cannot be built"),
        (partial(checkpoints.mdm, layers=10**9), "layers must be a positive integer up to"),
        (partial(checkpoints.mdm, layers=9_999), "denoiser cannot be built: it has more layers than the"),
        (partial(checkpoints.mdm, latent_dim=10_000), "does not fit the denoiser of the config, MdmEncoder"),
        (partial(checkpoints.mdm, layers=True), "layers must be a positive integer"),
        (partial(checkpoints.mdm, noise_schedule=["cosine"]), "noise_schedule is"),
        (partial(checkpoints.mdm_smpl, diffusion__timesteps=10**9), "timesteps must be a positive integer up to"),
        (partial(checkpoints.mdm_smpl, diffusion__timesteps="ten"), "timesteps must be a positive integer"),
        (
            partial(checkpoints.mdm_smpl, diffusion__denoiser__num_heads="two"),
            "denoiser.heads='two': must be a whole",
        ),
        (partial(checkpoints.mdm_smpl, diffusion__denoiser__dropout=[0]), r"denoiser.dropout=\[0\]: must be a number"),
        (partial(checkpoints.mdm_smpl, diffusion__prediction=[]), "prediction must be one of x, x0"),
        (partial(checkpoints.mdm_smpl, motion_features={}), "motion_features must be smplrifke or"),
        (
            partial(checkpoints.mdm_smpl, data__text_encoder__modelname=7),
            "modelname must be the name of a model, not 7",
        ),
        (partial(checkpoints.mdm_smpl, data__motion_loader__fps=1e300), "fps must be a positive number up to 1000"),
        (
            partial(checkpoints.motion_diffuse, more="num_layers: " + "9" * 5000),
            "num_layers must be a positive integer",
        ),
        (partial(checkpoints.mdm_smpl, data__motion_loader={}), "has no setting data.motion_loader.fps"),
        (partial(checkpoints.mdm_smpl, data__motion_loader__fps=0), "fps must be a positive number up to 1000, not 0"),
        (
            partial(checkpoints.mdm_smpl, data__text_encoder__modelname="gpt"),
            "mean_pooling of 'gpt' is not supported",
        ),
        (partial(checkpoints.mdm_smpl, weights={"tmr.weight": torch.ones(1)}), "of another model: tmr.weight"),
        (
            partial(checkpoints.mdm_smpl, weights={"motion_normalizer.std": torch.full((205,), -1.0)}),
            "motion_normalizer must be finite, with a std of 0 or more",
        ),
        (
            partial(checkpoints.mdm_smpl, weights={"text_normalizer.mean": torch.zeros(2)}),
            r"text_normalizer\.mean must hold 512 numbers, not \[2\]",
        ),
    ],
)
def test_what_cannot_be_imported_is_refused_with_the_reason(tmp_path, write, message):
    write(tmp_path / "theirs")
    refused(tmp_path / "theirs", message)


CODE = "${oc.create:{_target_:pathlib.Path.touch,self:proof}}"


@pytest.mark.parametrize("setting", [
    {"diffusion__denoiser__dropout": CODE},
    {"diffusion__denoiser__num_heads": CODE},
    {"diffusion__schedule": {"_target_": "CosineSchedule", "s": CODE}},
    {"diffusion__timesteps": CODE},
    {"data__text_encoder__modelname": CODE, "data__text_encoder__mean_pooling": False},
    {"data__motion_loader__fps": CODE},
    {"diffusion__denoiser__dropout": {"_target_": "pathlib.Path.touch", "self": "proof"}},
])  # fmt: skip
def test_nothing_in_published_settings_is_run_escaped_or_not(tmp_path, monkeypatch, setting):
    monkeypatch.chdir(tmp_path)
    for slash in ("", "\\"):
        changed = json.loads(json.dumps(setting).replace(json.dumps(CODE)[1:-1], json.dumps(slash + CODE)[1:-1]))
        checkpoints.mdm_smpl(tmp_path / f"theirs{slash and 1}", **changed)
        refused(tmp_path / f"theirs{slash and 1}", "config.json")
    assert not (tmp_path / "proof").exists()


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.ones(251, np.float32), r"must hold 263 numbers, not float32 \[251\]"),
        (np.zeros(263, np.float32), "with std above 0"),
        (np.full(263, np.nan), "must be finite"),
        (np.array([None] * 263), r"Std\.npy"),
    ],
)
def test_statistics_that_are_none_are_refused(tmp_path, array, message):
    checkpoints.mdm(tmp_path / "theirs")
    np.save(tmp_path / "theirs" / "Std.npy", array, allow_pickle=True)
    refused(tmp_path / "theirs", message)


def test_other_tables_of_positions_are_refused_and_shorter_ones_are_not(tmp_path):
    network = checkpoints.mdm(tmp_path / "theirs")
    path = tmp_path / "theirs" / FILES[checkpoints.mdm]
    weights = torch.load(path, weights_only=True)
    name = "sequence_pos_encoder.pe"
    torch.save(weights | {name: network.positions[:300, None].clone()}, path)
    assert read(path).model.longest == 196
    torch.save(weights | {name: network.positions.flip(0)[:, None].clone()}, path)
    refused(tmp_path / "theirs", rf"{name} \[5000, 1, 16\] differs from the expected positional table")


@pytest.mark.parametrize("name", ["args.json", "config.json"])
@pytest.mark.parametrize("text", ["", "[1]", "{'a': 1}", "\xff"])
def test_settings_that_cannot_be_read_are_refused(tmp_path, name, text):
    {"args.json": checkpoints.mdm, "config.json": checkpoints.mdm_smpl}[name](tmp_path / "theirs")
    (tmp_path / "theirs" / name).write_bytes(text.encode("latin-1"))
    refused(tmp_path / "theirs", rf"{name} (cannot be read|must hold settings)")


def test_a_folder_of_no_known_format_is_refused_with_those_that_are(tmp_path):
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs" / "model000200000.pt").write_bytes(b"")
    for source in (tmp_path / "theirs", tmp_path / "theirs" / "model000200000.pt"):
        with pytest.raises(CheckpointError, match=r"expected one of: STMC's .*args\.json.*opt\.txt"):
            convert(source, tmp_path / "ours")
    with pytest.raises(CheckpointError, match="does not exist; expected one of"):
        convert(tmp_path / "nowhere", tmp_path / "ours")
    checkpoints.motion_diffuse(tmp_path / "md")
    with pytest.raises(CheckpointError, match="only the weights of MDM, FlowMDM and TMR take separate"):
        convert(tmp_path / "md", tmp_path / "ours", statistics=tmp_path)


def test_a_run_directory_that_is_there_is_not_touched(tmp_path):
    checkpoints.mdm(tmp_path / "theirs")
    (tmp_path / "ours").mkdir()
    convert(tmp_path / "theirs", tmp_path / "ours")
    before = {path: path.read_bytes() for path in (tmp_path / "ours").iterdir()}
    with pytest.raises(CheckpointError, match="ours already exists"):
        convert(tmp_path / "theirs", tmp_path / "ours")
    assert before == {path: path.read_bytes() for path in (tmp_path / "ours").iterdir()}


def test_a_full_disk_leaves_no_part_of_a_run_directory(tmp_path, monkeypatch):
    checkpoints.mdm(tmp_path / "theirs")
    monkeypatch.setattr("stmc.run.directories.write_text", lambda *_: (_ for _ in ()).throw(OSError("no space left")))
    with pytest.raises(OSError, match="no space left"):
        convert(tmp_path / "theirs", tmp_path / "ours")
    assert [path.name for path in tmp_path.iterdir()] == ["theirs"]


def test_the_script_says_in_a_sentence_what_is_wrong(tmp_path):
    with pytest.raises(ValueError, match="expected one of"):
        run("import_checkpoint", "import_checkpoint", f"source={tmp_path}", f"output={tmp_path / 'o'}")


# The published files' own names -------------------------------------------------------------------


def flat(shape: list[int], value: float = 0.01) -> torch.Tensor:
    """Any shape in a file of a few bytes."""
    return torch.full([1] * len(shape), value).expand(shape)


@pytest.mark.golden
@pytest.mark.parametrize("folder", golden_sets("stmc"))
def test_every_name_of_the_published_lightning_checkpoint_has_its_place(folder, tmp_path):
    listed = golden(folder, "lightning_checkpoint_keys.json")
    checkpoints.mdm_smpl(tmp_path, diffusion__denoiser__num_heads=8)
    weights = {name: flat(shape) for name, shape in listed["state_dict_shapes_full"].items()}
    content = {name: None for name in listed["checkpoint_top_level"]} | {"state_dict": weights}
    torch.save(content, tmp_path / FILES[checkpoints.mdm_smpl])
    model = read(tmp_path).model
    assert sum(parameter.numel() for parameter in model.denoiser.parameters()) == 27_007_181


ARGS = {
    "mdm_trans_enc": {},
    "mdm_trans_dec_clip": {"arch": "trans_dec"},
    "mdm_trans_dec_clip_emb": {"arch": "trans_dec", "emb_trans_dec": True},
    "mdm_trans_dec_bert": {"arch": "trans_dec", "text_encoder_type": "bert", "diffusion_steps": 50},
}


def every_name_of_mdms_published_checkpoints_has_its_place(folder, tmp_path, name):
    tmp_path = tmp_path / name
    listed = golden(folder.parent / "state_dicts", f"{name}.json")["entries"]
    checkpoints.mdm(tmp_path)
    table = sinusoids(5000, 512)[:, None]
    weights = {
        entry["name"]: flat(entry["shape"]) if entry["kind"] == "parameter" else table.clone() for entry in listed
    }
    torch.save(weights, tmp_path / FILES[checkpoints.mdm])
    (tmp_path / "args.json").write_text(json.dumps(ARGS[name]))
    model = read(tmp_path).model
    parameters = [np.prod(entry["shape"], dtype=int) for entry in listed if entry["kind"] == "parameter"]
    assert sum(parameter.numel() for parameter in model.denoiser.parameters()) == sum(parameters)


def every_name_of_motion_diffuses_published_checkpoint_has_its_place(folder, tmp_path):
    checkpoints.motion_diffuse(tmp_path, more="")
    listed = [
        entry
        for part in ("motiondiffuse_t2m", "motiondiffuse_t2m_clip_part")
        for entry in golden(folder.parent / "state_dicts", f"{part}.json")["entries"]
    ]
    weights = {entry["name"]: flat(entry["shape"]) for entry in listed}
    torch.save({"encoder": weights, "ep": 49, "total_it": 1}, tmp_path / FILES[checkpoints.motion_diffuse])
    model = read(tmp_path).model
    assert sum(parameter.numel() for parameter in model.denoiser.parameters()) == 87_152_135


@pytest.mark.slow
@pytest.mark.golden
@pytest.mark.parametrize("folder", golden_sets("mdm"))
def test_every_name_of_the_published_checkpoints_of_mdm_and_motion_diffuse_has_its_place(folder, tmp_path, subtests):
    checks = [(every_name_of_mdms_published_checkpoints_has_its_place, name) for name in ARGS]
    checked(subtests, [*checks, every_name_of_motion_diffuses_published_checkpoint_has_its_place], folder, tmp_path)


def test_a_checkpoint_whose_key_would_be_hashed_for_minutes_is_refused_at_once(tmp_path):
    """Doubled by what the pickle remembers: the copy that `DUP` makes is not PyTorch's to read."""
    torch.save({"weight": torch.eye(2)}, tmp_path / "whole.pt")
    with zipfile.ZipFile(tmp_path / "whole.pt") as whole, zipfile.ZipFile(tmp_path / "model.pt", "w") as forged:
        for name in whole.namelist():
            key = b")" + b"q\x00h\x00\x86" * 34
            forged.writestr(name, b"\x80\x02}" + key + b"K\x01s." if name.endswith("data.pkl") else whole.read(name))
    code = (
        "import sys; from pathlib import Path\n"
        "from stmc.run.published.torch_checkpoint import CheckpointError, read_checkpoint\n"
        "try: read_checkpoint(Path(sys.argv[1]))\n"
        "except CheckpointError as error: print(error)\n"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "model.pt")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert "model.pt cannot be read as a checkpoint of PyTorch: a key that is a tuple" in done.stdout


@pytest.mark.parametrize("legacy", [False, True])
def test_checkpoints_of_old_and_new_layouts_are_read(legacy, tmp_path):
    network = torch.nn.Linear(2, 3)
    content = {"net": network.state_dict(), "epoch": 3, 0: [torch.eye(2).half(), {"lr": 1e-3}]}
    torch.save(content, tmp_path / "model.pt", _use_new_zipfile_serialization=not legacy)
    back = read_checkpoint(tmp_path / "model.pt")
    assert torch.equal(back["net"]["weight"], network.weight) and back["epoch"] == 3
