"""Run directories: what is saved comes back wherever it lies, and what is damaged or malicious is refused by name."""

import dataclasses
import json
import os
import re
import shutil
from pathlib import Path

import pytest
import torch
from helpers.tiny_model import CONFIG as PARTS
from helpers.tiny_model import Hashes, tiny
from omegaconf import OmegaConf
from safetensors.torch import load_file, save_file

import stmc
from stmc.composing.sampling import DEFAULT, Sampling
from stmc.diffusion import ddim
from stmc.model import Model
from stmc.run import (
    BUNDLED,
    BUNDLED_EVALUATOR,
    BUNDLED_MODELS,
    CARD,
    CONFIG,
    STATISTICS,
    WEIGHTS,
    RunError,
    bundled,
    fingerprint,
)
from stmc.text import MiniLM
from stmc.timeline import Timeline

WALK = Timeline.parse("walk forwards # 0 # 3 # legs\nwave # 1 # 2 # right arm")
FILES = sorted([CARD, CONFIG, STATISTICS, WEIGHTS])


@pytest.fixture(scope="module")
def model() -> Model:
    return tiny()


@pytest.fixture(scope="session")
def saved(tmp_path_factory):
    return stmc.save(tiny(), tmp_path_factory.mktemp("saved") / "tiny", "# A tiny model\n")


@pytest.fixture
def run(saved, tmp_path):
    """A copy of one's own."""
    return Path(shutil.copytree(saved, tmp_path / "runs" / "tiny"))


def loaded(folder, **arguments) -> Model:
    """As loaded, but for the text encoder: the tiny model's has no weights to load."""
    model = stmc.load(folder, **arguments)
    assert isinstance(model.text_encoder, MiniLM)
    return dataclasses.replace(model, text_encoder=Hashes())


def joints(model: Model) -> torch.Tensor:
    return model.generate(WALK, steps=4, sampler=ddim)[0].joints


def edit(folder, **changes) -> None:
    config = OmegaConf.to_container(OmegaConf.load(folder / CONFIG)) | changes
    OmegaConf.save(
        OmegaConf.create({key: value for key, value in config.items() if value is not None}), folder / CONFIG
    )


# There and back -----------------------------------------------------------------------------------------------------


def test_a_model_comes_back_as_it_was_saved(model, run):
    back = loaded(run)
    assert sorted(os.listdir(run)) == FILES
    assert torch.equal(joints(back), joints(model))
    assert (back.fps, back.longest, back.prediction) == (model.fps, model.longest, model.prediction)
    assert torch.equal(back.schedule.alpha_bar, model.schedule.alpha_bar)
    assert torch.equal(back.skeleton.offsets, model.skeleton.offsets)
    assert (run / CARD).read_text() == "# A tiny model\n"


def test_a_run_can_be_moved_and_lent(model, run, tmp_path, monkeypatch):
    shutil.move(run, tmp_path / "elsewhere")
    monkeypatch.chdir(tmp_path)
    assert torch.equal(joints(loaded("elsewhere")), joints(model))
    text = "".join(path.read_text() for path in (tmp_path / "elsewhere").glob("*.yaml"))
    assert str(tmp_path) not in text


def test_a_loaded_model_saves_the_same_files_again(run, tmp_path):
    again = stmc.save(stmc.load(run), tmp_path / "again", "# A tiny model\n")
    for name in FILES:
        assert (again / name).read_bytes() == (run / name).read_bytes(), name


def test_how_it_is_sampled_comes_with_the_model_and_older_runs_have_the_usual_ones(model, run, tmp_path):
    own = stmc.save(
        dataclasses.replace(model, sampling=Sampling(guidance=1.0, noise_scale="std", stitch_from=0.25)),
        tmp_path / "own",
        "",
    )
    back = stmc.load(own)
    assert back.sampling == Sampling(guidance=1.0, noise_scale="std", stitch_from=0.25)
    edit(own, noise_scale=None, stitch_from=None, spread="std", late=0.25)
    assert stmc.load(own).sampling == back.sampling, "keys of earlier versions"
    edit(run, guidance=None, noise_scale=None, stitch_from=None)
    usual = stmc.load(run)
    assert usual.own_sampling == DEFAULT.with_defaults(Sampling(steps=100))


def test_half_precision_halves_the_weights_and_hardly_changes_the_motion(model, run, tmp_path):
    half = stmc.save(model, tmp_path / "half", "", dtype=torch.float16)
    stored = load_file(half / WEIGHTS)
    assert {tensor.dtype for tensor in stored.values()} == {torch.float16}
    assert (half / WEIGHTS).stat().st_size < 0.6 * (run / WEIGHTS).stat().st_size
    back = loaded(half)
    assert {weight.dtype for weight in back.denoiser.parameters()} == {torch.float32}
    torch.testing.assert_close(joints(back), joints(model), atol=0.02, rtol=0)
    assert {tensor.dtype for tensor in load_file(half / STATISTICS).values()} == {torch.float32}


def test_auto_is_the_gpu_where_there_is_one(run, monkeypatch):
    assert stmc.load(run, device="auto").device.type == ("cuda" if torch.cuda.is_available() else "cpu")
    asked = []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(Model, "to", lambda self, device: asked.append(device) or self)
    for device in ("auto", "cpu"):
        stmc.load(run, device=device)
    assert asked == ["cuda", "cpu"]


def test_a_loaded_model_is_ready_to_sample_and_has_no_gradients(run):
    back = stmc.load(run)
    assert not back.denoiser.training
    assert not any(weight.requires_grad for weight in back.denoiser.parameters())


def test_saving_again_replaces_the_model(model, run):
    other = dataclasses.replace(model, longest=77)
    stmc.save(other, run, "# Another\n")
    assert stmc.load(run).longest == 77
    assert sorted(os.listdir(run)) == FILES


# What cannot be saved -----------------------------------------------------------------------------------------------


def test_writing_that_fails_leaves_the_old_model_and_no_litter(model, run, monkeypatch):
    before = {name: (run / name).read_bytes() for name in FILES}

    def full(tensors, path):
        path.write_bytes(b"half")
        raise OSError("no space left on device")

    monkeypatch.setattr("stmc.run.directories.save_file", full)
    with pytest.raises(OSError, match="no space"):
        stmc.save(model, run, "# Another\n")
    assert {name: (run / name).read_bytes() for name in os.listdir(run)} == before


def test_a_network_of_another_class_than_the_config_s_is_refused_with_the_key_that_names_it(model, tmp_path):
    class Mine(torch.nn.Module):
        def forward(self, x, t, text, text_mask=None, mask=None):
            return x

    with pytest.raises(RunError, match=r"is a Mine, but its config says .*'denoiser': {'_target_': '.*\.Mine', …}"):
        stmc.save(dataclasses.replace(model, denoiser=Mine()), tmp_path, "card")


def test_a_model_that_does_not_say_how_to_build_its_parts_is_not_saved(model, tmp_path):
    config = {part: PARTS[part] for part in ("denoiser", "schedule")}
    with pytest.raises(RunError, match="does not describe text_encoder, representation"):
        stmc.save(dataclasses.replace(model, config=config), tmp_path / "run", "")
    assert not (tmp_path / "run").exists()


def test_of_eight_bits_are_the_matrices_alone_and_they_are_rounded_by_a_sixteenth_at_most(model, tmp_path):
    small = stmc.save(model, tmp_path / "small", "", dtype=torch.float8_e4m3fn)
    kinds = {(value.ndim > 1, value.dtype) for value in load_file(small / WEIGHTS).values()}
    assert kinds == {(True, torch.float8_e4m3fn), (False, torch.float16)}
    back = loaded(small).denoiser.state_dict()
    for name, weight in model.denoiser.state_dict().items():  # three bits behind the first; 2^-10 where they are small
        torch.testing.assert_close(back[name], weight, rtol=1 / 16, atol=2**-10)


def test_of_whole_numbers_are_the_matrices_alone_and_each_row_is_rounded_by_its_own_scale(tmp_path):
    model = tiny()
    with torch.no_grad():
        model.denoiser.registers[0] *= 1000
        model.denoiser.registers[1] = 0
    small = stmc.save(model, tmp_path / "small", "", dtype=torch.int8)
    in_file = load_file(small / WEIGHTS)
    originals = model.denoiser.state_dict()
    back = loaded(small).denoiser.state_dict()
    assert {name for name in in_file if not name.endswith(".scale")} == set(originals)
    for name, weight in originals.items():
        matrix = weight.ndim > 1
        assert in_file[name].dtype == (torch.int8 if matrix else torch.float16)
        rows = weight.flatten(1) if matrix else weight
        bound = rows.abs().amax(1) / 127 / 2 if matrix else weight.abs() * 2**-11 + 2**-25
        change = (back[name] - weight).abs()
        assert ((change.flatten(1).amax(1) if matrix else change) <= bound * 1.0001).all()


def test_a_matrix_of_eight_bits_without_its_scale_is_refused(model, tmp_path):
    small = stmc.save(model, tmp_path / "small", "", dtype=torch.int8)
    weights = load_file(small / WEIGHTS)
    del weights["registers.scale"]
    save_file(weights, small / WEIGHTS)
    with pytest.raises(RunError, match="of another type: registers"):
        stmc.load(small)


@pytest.mark.parametrize(
    ("dtype", "weight"), [(torch.float16, 1e6), (torch.float8_e4m3fn, 500), (torch.int8, torch.inf)]
)
def test_weights_that_a_type_cannot_hold_are_not_saved(tmp_path, dtype, weight):
    model = tiny()
    with torch.no_grad():
        model.denoiser.registers[0, 0] = weight
    with pytest.raises(RunError, match=f"exceed the range of {re.escape(str(dtype))}: registers"):
        stmc.save(model, tmp_path / "run", "", dtype=dtype)
    assert not (tmp_path / "run").exists()


def test_weights_of_a_type_that_no_run_is_read_from_are_not_saved(model, tmp_path):
    with pytest.raises(RunError, match=r"weights stored as torch\.float8_e5m2 .* of another type"):
        stmc.save(model, tmp_path / "run", "", dtype=torch.float8_e5m2)
    assert not (tmp_path / "run").exists()


# What is damaged ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lost", [CONFIG, WEIGHTS, STATISTICS])
def test_a_missing_file_is_named(run, lost):
    (run / lost).unlink()
    with pytest.raises(RunError, match=f"is not a run directory: {lost} missing"):
        stmc.load(run)


def test_a_folder_that_is_not_there_is_named(tmp_path):
    with pytest.raises(RunError, match=r"nowhere is not a run directory: config\.yaml, weights"):
        stmc.load(tmp_path / "nowhere")


def test_a_run_without_its_card_is_still_a_run(run):
    (run / CARD).unlink()
    stmc.load(run)


@pytest.mark.parametrize("name", [WEIGHTS, STATISTICS])
@pytest.mark.parametrize("damage", [lambda data: data[:-100], lambda data: b"", lambda data: b"\x80\x04junk" * 9])
def test_a_file_that_was_cut_or_is_something_else_is_named(run, name, damage):
    (run / name).write_bytes(damage((run / name).read_bytes()))
    with pytest.raises(RunError) as error:
        stmc.load(run)
    assert str(run / name) in str(error.value)


@pytest.mark.parametrize("text", ["denoiser: [", "just text", "- a\n- list", "", "denoiser: ${nothing}\n", "\0"])
def test_a_config_that_is_none_is_named(run, text):
    (run / CONFIG).write_text(text)
    with pytest.raises(RunError) as error:
        stmc.load(run)
    assert str(run / CONFIG) in str(error.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"schedule": None}, "schedule missing"),
        ({"fps": None, "prediction": None}, "fps, prediction missing"),
        ({"fps": 0}, "fps=0: must be above 0 and at most 1000 Hz"),
        ({"fps": "twenty"}, "fps='twenty': must be a number"),
        ({"fps": True}, "fps=true: must be a number"),
        ({"fps": 1001}, "fps=1001: must be"),
        ({"longest": 7.5}, r"longest=7\.5: must be a whole number"),
        ({"longest": 0}, "longest=0: must be at least 1"),
        ({"longest": 10**30}, "longest=1000000000000000000000000000000: must be a finite number"),
        ({"prediction": "noise"}, "prediction='noise': must be one of x0, eps, v, score"),
        ({"guidance": "much"}, "guidance='much': must be a number or null"),
        ({"late": 1.0}, r"stitch_from=1\.0: must be at least 0 and below 1"),
        ({"spread": "wide"}, "noise_scale='wide': must be one of std, variance or null"),
        ({"denoiser": 3}, "denoiser must name the class to build as `_target_`; got 3"),
        ({"denoiser": {"width": 16}}, "denoiser must name the class to build"),
        ({"denoiser": PARTS["denoiser"] | {"depth": 3}}, "denoiser.depth: .* has no such argument; it has features"),
        ({"denoiser": {"_target_": "stmc.denoisers.MdmSmpl", "features": 205}}, "MdmSmpl needs text_width"),
        ({"denoiser": PARTS["denoiser"] | {"layers": True}}, "denoiser.layers=true: must be a whole number"),
        ({"denoiser": PARTS["denoiser"] | {"dropout": "0.1"}}, "denoiser.dropout='0.1': must be a number"),
        ({"denoiser": PARTS["denoiser"] | {"heads": 5}}, r"denoiser cannot be built: .*multiple of heads \(5\)"),
        ({"schedule": PARTS["schedule"] | {"steps": 0}}, "schedule cannot be built: steps=0 must be 1 to"),
        ({"schedule": PARTS["schedule"] | {"steps": 10**9}}, "schedule cannot be built: steps=1000000000 must be 1 to"),
        ({"schedule": {"_target_": "stmc.text.MiniLM"}}, "schedule: 'stmc.text.MiniLM' is not a class of stmc.diff"),
        ({"schedule": {"_target_": "stmc.diffusion.Schedule", "alpha_bar": 3}}, "schedule.alpha_bar=3: must be"),
        ({"text_encoder": {"_target_": "stmc.text.TextEncoder"}}, "text_encoder cannot be built: Protocols cannot"),
        ({"text_encoder": {"_target_": "stmc.text.Cached", "encoder": PARTS["text_encoder"], "folder": "."}},
         "text_encoder.folder: a config must not name paths"),
        ({"text_encoder": PARTS["text_encoder"] | {"pooling": "max"}}, "pooling='max': must be one of mean, tokens"),
        ({"denoiser": PARTS["denoiser"] | {"features": 263}}, r"of another shape: .*skel_embedding.weight"),
        ({"denoiser": PARTS["denoiser"] | {"width": 32}}, f"{WEIGHTS} does not fit the denoiser of the config.*shape"),
        ({"denoiser": PARTS["denoiser"] | {"layers": 2}}, f"{WEIGHTS} does not fit .*missing: seqT.*layers.1.* more"),
        ({"text_encoder": {"_target_": "stmc.text.Clip"}}, "text_width 384, but the text_encoder has width 512"),
    ],
)  # fmt: skip
def test_a_config_that_does_not_describe_the_files_says_where(run, changes, message):
    edit(run, **changes)
    with pytest.raises(RunError, match="(?s)" + message) as error:
        stmc.load(run)
    assert str(run) in str(error.value)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("motion_mean", lambda value: None, "motion_mean missing"),
        ("skeleton", lambda value: value[:22], r"skeleton must be \(24, 3\) finite numbers, not .*\(22, 3\)"),
        ("text_std", lambda value: 0 * value, "text_std must be above 0"),
        ("motion_std", lambda value: value * torch.nan, r"motion_std must be \(205,\) finite"),
        ("motion_mean", lambda value: value[:-1], r"motion_mean must be \(205,\) finite numbers, not .*\(204,\)"),
        (
            "motion_mean",
            lambda value: value * 0 + 1e38,
            r"motion_mean must be \(205,\) finite numbers of at most 1e\+06",
        ),
        ("text_std", lambda value: value.long() + 1, r"text_std must be \(384,\) finite numbers, not torch.int64"),
    ],
)
def test_statistics_that_cannot_be_meant_are_named(run, name, change, message):
    numbers = load_file(run / STATISTICS)
    changed = change(numbers.pop(name))
    save_file(numbers if changed is None else numbers | {name: changed.contiguous()}, run / STATISTICS)
    with pytest.raises(RunError, match=f"{STATISTICS}: {message}"):
        stmc.load(run)


def test_weights_that_are_not_finite_are_named(run):
    weights = load_file(run / WEIGHTS)
    weights["registers"][0, 0] = torch.inf
    save_file(weights, run / WEIGHTS)
    edit(run, digest=None)
    with pytest.raises(RunError, match=f"{WEIGHTS} holds weights that are not finite: registers"):
        stmc.load(run)


# What is malicious --------------------------------------------------------------------------------------------------

TARGETS = [
    "os.system",
    "posix.system",
    "builtins.eval",
    "builtins.exec",
    "subprocess.Popen",
    "stmc.run.os.system",
    "stmc.text.os.system",
    "stmc.text.tempfile.mkstemp",
    "stmc.denoisers.mdm_smpl.torch.load",
    "torch.load",
    "torch.nn.Linear",
    "pickle.loads",
    "stmc.denoisers",
    "stmc.denoisers.",
    "stmc.nothing.Denoiser",
    "stmc.data.cache.Cache.write",
    "stmc.training.Checkpoints.save",
    "stmc.training.logs.Table",
    "stmc.text.Path",
    "stmc.text.Cached.file",
    "stmc.text.MiniLM.__init__.__globals__",
    "hydra.utils.call",
    ["os", "system"],
    {"_target_": "os.system"},
    7,
]


@pytest.mark.parametrize("part", list(PARTS))
@pytest.mark.parametrize("target", TARGETS, ids=str)
def test_a_config_that_asks_for_anything_but_the_part_s_own_classes_is_refused_unexecuted(run, part, target, tmp_path):
    proof = tmp_path / "proof"
    edit(run, **{part: {"_target_": target, "command": f"touch {proof}"}})
    with pytest.raises(RunError, match=f"{part}: .* is not a class of stmc|_target_.* is invalid"):
        stmc.load(run)
    assert not proof.exists()


def test_a_module_that_is_named_is_not_even_imported(run, tmp_path, monkeypatch):
    (tmp_path / "evil.py").write_text(f"open({str(tmp_path / 'proof')!r}, 'w')\nclass Evil: pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    edit(run, schedule={"_target_": "evil.Evil"})
    for trusted in ((), ("mylab",), ("evi", "evil.Ev")):
        with pytest.raises(RunError, match=r"'evil\.Evil' is not a class of stmc\.diffusion"):
            stmc.load(run, trusted=trusted)
    assert not (tmp_path / "proof").exists()


def test_tags_that_yaml_could_run_are_refused(run, tmp_path):
    proof = tmp_path / "proof"
    text = (run / CONFIG).read_text()
    (run / CONFIG).write_text(f'{text}evil: !!python/object/apply:os.system ["touch {proof}"]\n')
    with pytest.raises(RunError, match=CONFIG):
        stmc.load(run)
    assert not proof.exists()


def test_pickled_weights_are_not_weights(run, tmp_path):
    weights = {name: value.clone() for name, value in load_file(run / WEIGHTS).items()}
    torch.save(weights, run / WEIGHTS)
    with pytest.raises(RunError, match=WEIGHTS):
        stmc.load(run)


# The bundled model --------------------------------------------------------------------------------------------------


@pytest.mark.skipif(not (bundled() / WEIGHTS).exists(), reason="this checkout has no bundled model")
@pytest.mark.parametrize("name", BUNDLED_MODELS)
def test_the_bundled_models_load_are_small_and_say_where_they_come_from(name):
    model = stmc.load(name)
    assert (bundled(name) / WEIGHTS).stat().st_size < 16 * 2**20
    assert model.fps == 20
    card = (bundled(name) / CARD).read_text("utf-8")
    bandai = ("CC BY-NC 4.0", "Bandai Namco", "Kobayashi")
    for words in ("mocap.cs.cmu.edu", *([] if name == "mdm_smpl_cmu" else bandai)):
        assert words in card
    config = json.dumps(OmegaConf.to_container(OmegaConf.load(bundled(name) / CONFIG)))
    assert "/" not in config, "no paths of the machine that trained it"


def test_all_that_comes_with_the_library_is_below_40_megabytes():
    assert sum(path.stat().st_size for path in bundled().parent.rglob("*.safetensors")) < 40e6


def test_what_comes_with_the_library_has_names_and_a_folder_of_that_name_comes_first(tmp_path, monkeypatch):
    assert stmc.load(BUNDLED).config == stmc.load().config
    assert stmc.load("mdm_smpl_wide_fast").own_sampling.guidance == 1, "its guidance is in its weights"
    assert fingerprint(BUNDLED_EVALUATOR) == fingerprint(bundled(BUNDLED_EVALUATOR))
    monkeypatch.chdir(tmp_path)
    (tmp_path / BUNDLED).mkdir()
    with pytest.raises(RunError, match=BUNDLED):
        stmc.load(BUNDLED)
