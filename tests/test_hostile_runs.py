"""Run directories as nobody should open them: nothing in them is run, and none takes the machine."""

import inspect
import os
import random
import shutil
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.motions import walking
from helpers.scripts import script
from helpers.tiny_model import Hashes, tiny
from safetensors.torch import load_file, save_file
from test_run import PARTS, edit, joints, loaded, run, saved  # noqa: F401
from test_text import RunsCode

import stmc
from stmc.data.cache import Cache, Clip
from stmc.denoisers import MdmEncoder
from stmc.diffusion import Schedule, ddim
from stmc.diffusion.statistics import Statistics
from stmc.evaluators import Evaluator, Tmr
from stmc.model import Model
from stmc.motion.representation import SmplRepresentation
from stmc.run import CONFIG, STATISTICS, WEIGHTS, RunError, bundled, check, load_evaluator, save_evaluator


@pytest.fixture(scope="module")
def model() -> Model:
    return tiny()


@pytest.fixture(scope="module")
def saved_evaluator(tmp_path_factory):
    sizes = {"features": 205, "text_width": 384, "width": 8, "feedforward": 8, "layers": 1, "heads": 2}
    one = Statistics(torch.zeros(205), torch.ones(205)), Statistics(torch.zeros(384), torch.ones(384))
    config = {"network": {"_target_": "stmc.evaluators.Tmr"} | sizes} | {
        part: PARTS[part] for part in ("text_encoder", "representation")
    }
    judge = Evaluator(Tmr(**sizes).eval(), Hashes(), tiny().representation, *one, 20, config)
    return save_evaluator(judge, tmp_path_factory.mktemp("saved") / "tmr", "")


@pytest.fixture
def evaluator_run(saved_evaluator, tmp_path):
    """A copy of one's own."""
    return Path(shutil.copytree(saved_evaluator, tmp_path / "tmr"))


def refused(folder, message: str = "", load=stmc.load) -> None:
    """In a sentence that names a file or the folder."""
    with pytest.raises(RunError, match="(?s)" + message) as error:
        load(folder)
    assert str(folder) in str(error.value)
    assert len(str(error.value)) < 600 + 2 * len(str(folder))


# What would run -----------------------------------------------------------------------------------------------------

CALLS = [
    "_target_:torch.load,f:evil.pt,weights_only:false",
    "_target_:numpy.load,file:evil.npy,allow_pickle:true",
    "_target_:pathlib.Path.touch,self:proof",
    "_target_:builtins.open,file:proof,mode:w",
    "_target_:os.system,command:touch proof",
    "_target_:numpy.savetxt,fname:proof,X:[1]",
    "_target_:stmc.io.files.write_text,path:proof,text:x",
]
PLACES = [
    "denoiser:\n  _target_: stmc.denoisers.MdmSmpl\n  {0}",
    "denoiser:\n  _target_: stmc.denoisers.MdmSmpl\n  width: {1}",
    "denoiser:\n  _target_: stmc.denoisers.MdmSmpl\n  nested: [1, [2, {{deep: {1}}}]]",
    "schedule:\n  {0}\n  steps: 100",
    "text_encoder:\n  _target_: stmc.text.EmptyAsZeros\n  encoder: {{{0}}}",
    "text_encoder:\n  _target_: stmc.text.MiniLM\n  source: {1}",
    "card: {1}",
    "{0}",
    "fps: {1}",
]


@pytest.mark.parametrize("place", PLACES)
def test_an_interpolation_is_never_resolved_escaped_or_not(run, tmp_path, monkeypatch, place):  # noqa: F811
    monkeypatch.chdir(tmp_path)
    torch.save(RunsCode(tmp_path / "proof"), tmp_path / "evil.pt")
    np.save(tmp_path / "evil.npy", np.array([RunsCode(tmp_path / "proof")], dtype=object), allow_pickle=True)
    key = place.partition(":")[0]
    kept = "\n".join(part for part in _sections((run / CONFIG).read_text()) if not part.startswith(f"{key}:"))
    for call in CALLS:
        for slashes in ("", "\\"):
            text = f"'{slashes}${{oc.create:{{{call}}}}}'"
            (run / CONFIG).write_text(kept + "\n" + place.format(f"evil: {text}", text) + "\n")
            refused(run, "a run directory does not resolve interpolations")
    assert not (tmp_path / "proof").exists()


def _sections(text: str) -> list[str]:
    """A config's entries, each with the lines below it."""
    sections: list[str] = []
    for line in text.splitlines():
        if line[:1] not in (" ", "-") or not sections:
            sections.append(line)
        else:
            sections[-1] += "\n" + line
    return sections


def test_no_environment_variable_gets_into_a_model(run, monkeypatch):  # noqa: F811
    monkeypatch.setenv("TOKEN", "secret")
    edit(run, text_encoder=PARTS["text_encoder"] | {"source": "somebody/${oc.env:TOKEN}"})
    refused(run, "text_encoder.source=.*a run directory does not resolve interpolations")


def test_keys_that_hydra_understands_are_refused_wherever_they_are(run):  # noqa: F811
    for key, value in (("_partial_", True), ("_args_", ["touch proof"]), ("_recursive_", 0), ("_convert_", "all")):
        edit(run, schedule=PARTS["schedule"] | {key: value})
        refused(run, f"schedule: the key '{key}' is invalid")
        edit(run, schedule=PARTS["schedule"], more=[{"deep": {key: value}}])
        refused(run, rf"more\[0\].deep: the key '{key}' is invalid")
        edit(run, more=None)


@pytest.mark.parametrize("within", [{"_target_": "os.system", "command": "touch proof"}, {"_target_": "torch.load"}])
def test_what_is_hidden_inside_an_argument_is_refused(run, within, tmp_path, monkeypatch):  # noqa: F811
    monkeypatch.chdir(tmp_path)
    for encoder in (
        {"_target_": "stmc.text.EmptyAsZeros", "encoder": within},
        {"_target_": "stmc.text.EmptyAsZeros", "encoder": {"_target_": "stmc.text.EmptyAsZeros", "encoder": within}},
        PARTS["text_encoder"] | {"batch": within},
    ):
        edit(run, text_encoder=encoder)
        refused(run, "text_encoder.*is not a class of stmc.text")
    assert not (tmp_path / "proof").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("more: &a [1, 2]\nagain: *a\n", "anchors and aliases are not allowed"),
        ("more: &a [*a]\n", "anchors and aliases are not allowed"),
        ("more: !!python/name:os.system\n", "the tag .* is not allowed"),
        ("more: !!binary aGVsbG8=\n", "the tag .* is not allowed"),
        ("more: ???\n", r"more has no value \(\?\?\?\)"),
        ("fps: 20\n", "'fps' is duplicated"),
        ("denoiser: {width: 3}\n", "'denoiser' is duplicated"),
        ("<<: {more: 1}\n", "cannot be read"),
        ("3: three\n", "the key 3 is not a text"),
        ("? [1, 2]\n: three\n", r"the key \[1, 2\] is not a text"),
        ("more: " + "[" * 5000 + "\n", "more than 16 levels of nested collections"),
        ("more: " + "{a: " * 5000 + "\n", "more than 16 levels of nested collections"),
        ("more: " + "- " * 5000 + "\n", "config.yaml"),
        ("more: " + "9" * 5000 + "\n", "config.yaml"),
        ("more: .nan\n", "more=nan: must be a finite number"),
        ("more: 1e300\n", r"more=1e\+300: must be a finite number"),
        ("more: " + "x" * 2000 + "\n", "characters, all of them printable"),
        ("more: " + "x" * 2**17 + "\n", "more than 65536 bytes"),
        ("---\nmore: 1\n", "config.yaml cannot be read"),
    ],
)
def test_a_config_that_is_more_than_plain_data_is_refused(run, text, message):  # noqa: F811
    (run / CONFIG).write_text((run / CONFIG).read_text() + text)
    refused(run, message)


def test_an_alias_bomb_is_refused_at_once(run):  # noqa: F811
    levels = "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 40))
    (run / CONFIG).write_text("a0: &a0 [x]\n" + levels + (run / CONFIG).read_text())
    refused(run, "anchors and aliases")


# What would take the machine ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "sizes",
    [
        {"layers": 10**9},
        {"layers": 100_000},
        {"width": 40_000},
        {"feedforward": 10**9},
        {"registers": 2**31},
        {"width": 2**31, "heads": 1},
        {"heads": 0},
        {"layers": -1},
    ],
)
def test_sizes_are_compared_with_the_weights_before_memory_is_asked_for(run, sizes):  # noqa: F811
    edit(run, denoiser=PARTS["denoiser"] | sizes)
    refused(run, "does not fit the denoiser|denoiser cannot be built")


@pytest.mark.parametrize("sizes", [{"layers": 10**9}, {"width": 2**20}, {"feedforward": 2**31}])
def test_an_evaluator_s_sizes_are_compared_too(evaluator_run, sizes):
    text = (evaluator_run / CONFIG).read_text()
    for name, size in sizes.items():
        text = text.replace(f"{name}: {1 if name == 'layers' else 8}", f"{name}: {size}")
    (evaluator_run / CONFIG).write_text(text)
    refused(evaluator_run, "does not fit the network|network cannot be built", load_evaluator)


def test_a_window_or_schedule_of_any_length_is_refused():
    with pytest.raises(ValueError, match="fixed_length 1000000000 must be 1 to 4999 frames"):
        MdmEncoder(205, 384, 16, 32, 1, 2, fixed_length=10**9)
    for kind in (Schedule.cosine, Schedule.linear):
        with pytest.raises(ValueError, match="must be 1 to 10000"):
            kind(10**9)


def test_weights_of_another_type_are_refused(run):  # noqa: F811
    weights = load_file(run / WEIGHTS)
    for dtype in (torch.int32, torch.bool):
        save_file(weights | {"registers": weights["registers"].to(dtype)}, run / WEIGHTS)
        refused(run, f"{WEIGHTS} does not fit the denoiser .*of another type: registers")


def test_loading_leaves_the_global_generator_alone(run):  # noqa: F811
    torch.manual_seed(3)
    expected = torch.rand(3)
    torch.manual_seed(3)
    stmc.load(run)
    assert torch.equal(torch.rand(3), expected)


# The digest ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [WEIGHTS, STATISTICS])
def test_a_flipped_bit_is_noticed_and_a_directory_without_a_digest_loads_as_ever(run, name):  # noqa: F811
    data = bytearray((run / name).read_bytes())
    data[-5] ^= 1
    (run / name).write_bytes(data)
    refused(run, rf"{name} is damaged: its SHA-256 is not the digest in {CONFIG}")
    edit(run, digest=None)
    stmc.load(run)


@pytest.mark.parametrize("digest", [{"weights": "0" * 64}, "x", {"weights": 1, "statistics": 2}, []])
def test_a_digest_that_is_none_is_refused(run, digest):  # noqa: F811
    edit(run, digest=digest)
    refused(run, "digest")


@pytest.mark.parametrize("folder", [bundled(), bundled("tmr_wide")], ids=lambda folder: folder.name)
def test_the_bundled_files_are_those_of_their_digests(folder):
    assert "digest" in (folder / CONFIG).read_text()
    read, own = (load_evaluator, set()) if "tmr" in folder.name else (stmc.load, {"vocabulary"})
    assert read(folder).config["digest"].keys() == {"weights", "statistics"} | own


def test_a_kill_between_old_and_new_files_leaves_what_loads(model, run, monkeypatch):  # noqa: F811
    other = tiny()
    with torch.no_grad():
        other.denoiser.registers.add_(1)
    written = []

    def killed(path, write):
        if written:
            raise KeyboardInterrupt
        write(path)
        written.append(path)

    monkeypatch.setattr("stmc.run.directories.write_whole", killed)
    with pytest.raises(KeyboardInterrupt):
        stmc.save(other, run, "")
    assert torch.equal(stmc.load(run).denoiser.registers, other.denoiser.registers)


# A package of one's own ---------------------------------------------------------------------------------------------

OWN = """
import torch
from torch import nn
from stmc.denoisers import Network

class Tiny(Network):
    def __init__(self, features: int, text_width: int, depth: "Hidden" = 2, **rest: float) -> None:
        super().__init__()
        scale = [float(share) for share in torch.linspace(0, 1, depth)]  # needs numbers, not shapes alone
        self.layers = nn.ModuleList(nn.Linear(features, features) for _ in scale)
        self.told = nn.Linear(text_width, features)
        self.register_buffer("count", torch.zeros((), dtype=torch.int64))

    @classmethod
    def deep(cls, features: int, text_width: int):
        return cls(features, text_width, 4)

    def encode_text(self, text, text_mask=None):
        return self.told(text)

    def denoise(self, x, t, text, text_mask=None, mask=None):
        for layer in self.layers:
            x = layer(x)
        return 0 * x + 0.01 * text.mean(dim=1, keepdim=True)

def factory(features, text_width):
    return Tiny(features, text_width)
"""


@pytest.fixture
def mylab(tmp_path, monkeypatch):
    (tmp_path / "code" / "mylab").mkdir(parents=True)
    (tmp_path / "code" / "mylab" / "__init__.py").write_text("")
    (tmp_path / "code" / "mylab" / "nets.py").write_text(textwrap.dedent(OWN))
    monkeypatch.syspath_prepend(tmp_path / "code")
    yield
    for name in ("mylab", "mylab.nets"):
        sys.modules.pop(name, None)


def own(target: str = "mylab.nets.Tiny", **arguments) -> Model:
    """The tiny model with a network of somebody's own."""
    import mylab.nets

    network = mylab.nets.Tiny(205, 384).eval().requires_grad_(False)
    described = {"_target_": target, "features": 205, "text_width": 384} | arguments
    whole = tiny()
    return Model(**(vars(whole) | {"denoiser": network, "config": dict(whole.config) | {"denoiser": described}}))


def test_a_network_of_one_s_own_is_saved_loaded_and_sampled_where_its_package_is_trusted(mylab, tmp_path):
    model = own()
    with pytest.raises(RunError, match=r"'mylab.nets.Tiny' is not a class of stmc.denoisers; .*trusted=\(\"mylab\",\)"):
        stmc.save(model, tmp_path / "own", "")
    assert not (tmp_path / "own").exists()
    folder = stmc.save(model, tmp_path / "own", "", dtype=torch.float16, trusted=("mylab",))
    refused(folder, "'mylab.nets.Tiny' is not a class of stmc.denoisers")
    back = loaded(folder, trusted=["mylab"])
    assert type(back.denoiser) is type(model.denoiser) and back.denoiser.count.dtype == torch.int64
    torch.testing.assert_close(joints(back), joints(model), atol=0.05, rtol=0)
    assert torch.isfinite(back.generate(stmc.Timeline.parse("walk # 0 # 1"), steps=2, sampler=ddim)[0].joints).all()


@pytest.mark.slow
def test_a_network_of_one_s_own_is_trained_where_its_package_is_trusted_and_refused_before_the_first_step_elsewhere(
    mylab, tmp_path, monkeypatch
):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path / "code"), os.environ.get("PYTHONPATH", "")]))
    features = [SmplRepresentation().encode(walking(2.0 + 0.1 * number)).float() for number in range(12)]
    ends = np.cumsum([len(rows) for rows in features]).tolist()
    clips = [
        Clip(f"walk-{number}", "walk", "", "walk", ("legs",), True, False, ("train", "train", "val")[number % 3], *span)
        for number, span in enumerate(zip([0, *ends], ends, strict=False))
    ]
    Cache(20, "smpl", torch.cat(features), tuple(clips), {"walk": (("walk", 1.0),)}).write(tmp_path / "cache")
    settings = [f"run={tmp_path / 'run'}", f"data.folder={tmp_path / 'cache'}", f"text_cache={tmp_path / 'texts'}"]
    settings += ["denoiser._target_=mylab.nets.Tiny", "device=cpu", "threads=1", "validation=1", "training.steps=2"]
    settings += [
        "training.checkpoint_every=2",
        "training.log_every=2",
        "training.validate_every=2",
        "data.sampling.rows=4",
    ]
    done = script("train", *settings, folder=tmp_path / "here", check=False)
    assert done.returncode and "'mylab.nets.Tiny' is not a class of stmc.denoisers" in done.stdout
    assert not (tmp_path / "run" / CONFIG).exists() and not list(tmp_path.rglob("*.pt"))
    script("train", *settings, "trusted=[mylab]", folder=tmp_path / "here")
    back = stmc.load(tmp_path / "run", trusted=("mylab",))
    assert back.generate(stmc.Timeline.parse("walk # 0 # 1 # legs"), steps=2)[0].joints.isfinite().all()


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ("mylab.nets.torch.load", "is not a class that mylab defines"),
        ("mylab.nets.factory", "is not a class that mylab defines"),
        ("mylab.nets.Network", "is not a class that mylab defines"),
        ("mylab.nets.nn.Linear", "is not a class that mylab defines"),
        ("mylab.nets.Tiny.forward", "is not a class that mylab defines"),
        ("mylab.nets.Tiny.__init__", "is not a class of stmc.denoisers"),
        ("mylab.nothing.Tiny", "is not a class that mylab defines"),
        ("mylabs.nets.Tiny", "is not a class of stmc.denoisers"),
        ("os.system", "is not a class of stmc.denoisers"),
    ],
)
def test_the_door_for_trusted_packages_is_narrow(mylab, run, target, message):  # noqa: F811
    edit(run, denoiser={"_target_": target, "features": 205, "text_width": 384})
    refused(run, message, lambda folder: stmc.load(folder, trusted="mylab"))


def test_what_is_trusted_has_to_be_a_package_s_name(run):  # noqa: F811
    edit(run, denoiser=PARTS["denoiser"] | {"_target_": "own.Net"})
    for name in ("", "__main__", "my lab", "own."):
        with pytest.raises(RunError, match=r"trusted: .* is not the name of a package"):
            stmc.load(run, trusted=(name,))


# What would not come back -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"config": {"denoiser": PARTS["denoiser"] | {"layers": 2}}},
            "the network does not fit the denoiser .*missing",
        ),
        ({"config": {"denoiser": PARTS["denoiser"] | {"depth": 2}}}, "denoiser.depth: .* has no such argument"),
        ({"config": {"schedule": {"_target_": "own.Schedule"}}}, "'own.Schedule' is not a class of stmc.diffusion"),
        (
            {"config": {"text_encoder": {"_target_": "stmc.text.Clip"}}},
            "text_width 384, but the text_encoder has width 512",
        ),
        ({"config": {"representation": {"_target_": "${oc.env:HOME}"}}}, "interpolations"),
        ({"longest": 0}, "longest=0: must be at least 1"),
        ({"fps": 5000}, "fps=5000: must be above 0"),
        ({"text_statistics": Statistics(torch.zeros(3), torch.ones(3))}, r"text_mean must be \(384,\) finite"),
        ({"motion_statistics": Statistics(torch.zeros(205) + 1e9, torch.ones(205))}, "motion_mean must be .* at most"),
    ],
)
def test_what_could_not_be_loaded_again_is_not_saved(model, tmp_path, changes, message):
    given = changes | ({"config": dict(model.config) | changes["config"]} if "config" in changes else {})
    changed = Model(**(vars(model) | given))
    for refusing in (lambda: stmc.save(changed, tmp_path / "run", ""), lambda: check(changed)):
        with pytest.raises(RunError, match=message):
            refusing()
    assert not (tmp_path / "run").exists()


def test_a_swapped_network_with_the_old_config_is_not_saved(model, tmp_path):
    class Other(type(model.denoiser)):
        pass

    arguments = {name: value for name, value in PARTS["denoiser"].items() if name != "_target_"}
    swapped = Model(**(vars(model) | {"denoiser": Other(**arguments)}))
    with pytest.raises(RunError, match="the denoiser is a Other, but its config says MdmSmpl"):
        stmc.save(swapped, tmp_path / "run", "")


# Settings of loading ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("load", [stmc.load, load_evaluator])
@pytest.mark.parametrize("device", ["bogus", "cuda:-3", "cpu:x", "", "xpu", "cuda:99"])
def test_a_device_that_there_is_not_is_an_error_in_a_sentence_with_the_choices(load, device):
    with pytest.raises(ValueError, match="is unknown or not available here; choose from auto, cpu") as error:
        load(device=device)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 200


def test_a_precision_that_there_is_not_is_an_error():
    for precision in ("fp16", 16, None):
        with pytest.raises(ValueError, match=r"unknown precision .*; choose from fp32, bf16"):
            inspect.unwrap(stmc.load)(precision=precision)


def test_auto_is_also_a_mac_s_accelerator(run, monkeypatch):  # noqa: F811
    asked = []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: True)
    monkeypatch.setattr(Model, "to", lambda self, device: asked.append(device) or self)
    stmc.load(run, device="auto")
    assert asked == ["mps"]


# Anything at all ----------------------------------------------------------------------------------------------------

VALUES = [
    None, True, -1, 0, 3, 10**9, 10**30, 1e300, float("nan"), "", "x" * 3000, "${oc.env:HOME}", "???", "\x00", [], [[]],
    {}, {"_target_": "os.system", "command": "touch proof"}, {"_target_": "pathlib.Path.touch", "self": "proof"},
    r"\${oc.create:{_target_:pathlib.Path.touch,self:proof}}", "stmc.denoisers.MdmEncoder", "stmc.text.Cached",
    "stmc.motion.representation.BabelRepresentation", "builtins.open",
]  # fmt: skip
KEYS = ["width", "layers", "_target_", "_partial_", "_args_", "steps", "source", "batch", "words", "evil", "digest",
        "fps", "longest", "heads", "window", "dropout", "folder"]  # fmt: skip


def _mutate(folder, rng: random.Random) -> None:
    """One to three changes: of values, keys and places in the config, of bytes and of lengths of any file."""
    import yaml

    for _ in range(rng.randint(1, 3)):
        kind = rng.choice(["value", "key", "bytes", "cut", "lose", "text"])
        path = folder / rng.choice([CONFIG, CONFIG, WEIGHTS, STATISTICS])
        try:
            config = yaml.safe_load((folder / CONFIG).read_text("utf-8"))
        except (OSError, ValueError, yaml.YAMLError):
            config = None
        if kind in ("value", "key", "lose") and isinstance(config, dict) and config:
            place = rng.choice([config, *(value for value in config.values() if isinstance(value, dict))])
            if kind == "lose" and place:
                del place[rng.choice(list(place))]
            else:
                keys = list(place) if kind == "value" and place else KEYS
                place[rng.choice(keys)] = rng.choice(VALUES)
            (folder / CONFIG).write_text(yaml.safe_dump(config, sort_keys=False), "utf-8")
            continue
        data = bytearray(path.read_bytes())
        if kind == "cut":
            data = data[: rng.randint(0, len(data))]
        elif kind == "text":
            at = rng.randint(0, len(data))
            data[at:at] = rng.choice(
                [b"&a ", b"*a", b"!!python/name:os.system ", b"{", b"[" * 999, b"\n---\n", b"\xff"]
            )
        elif data:
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        path.write_bytes(data)


@pytest.mark.slow
def test_two_hundred_hostile_directories_are_refused_by_name_or_work_and_run_nothing(model, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    worked = 0
    for seed in range(200):
        folder = stmc.save(model, tmp_path / f"run-{seed}", "")
        if seed % 2:
            edit(folder, digest=None)
        _mutate(folder, random.Random(seed))
        try:
            back = stmc.load(folder)
        except RunError as error:
            assert str(folder) in str(error), seed
            assert len(str(error)) < 1000 + 2 * len(str(folder)), seed
        else:
            worked += 1
            assert back.representation.width == back.denoiser.skel_embedding.in_features, seed
        assert not (tmp_path / "proof").exists(), seed
    assert 0 < worked < 100
