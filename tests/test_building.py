"""A configuration builds what the library's table and the command line's `trusted` name, whoever wrote it."""

import pickle
import shutil
import sys
import textwrap
from pathlib import Path

import pytest
from helpers.scripts import ROOT, configured, loaded
from hydra.utils import get_object
from omegaconf import OmegaConf

from stmc.cli.config_parts import NAMES, build_part, check_plugins
from stmc.run import RunError
from stmc.run.construction import _resolve_name
from stmc.settings.records import SettingError


class Evil:
    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self):
        return Path.touch, (self.mark,)


@pytest.fixture
def evil(tmp_path) -> tuple[str, Path]:
    """A description that runs code, and the file that it makes then."""
    (tmp_path / "evil.pt").write_bytes(pickle.dumps(Evil(tmp_path / "it ran")))
    return f"{{_target_: torch.load, f: '{tmp_path / 'evil.pt'}', weights_only: false}}", tmp_path / "it ran"


def refused(capsys, script: str, *arguments: object) -> str:
    """What a command says that ends in one line."""
    assert loaded(script).main([str(each) for each in arguments]) == 2
    told = capsys.readouterr().err.strip()
    assert "\n" not in told and len(told) < 400, told
    return told


TRAIN = ("data.folder=nowhere", "device=cpu", "threads=1")
EVALUATE = ("device=cpu", "precision=fp32")  # of bf16, some processors are warned
PLACES = {
    "the training": ("train", "training", *TRAIN),
    "a setting of the training": ("train", "training.seed", *TRAIN),
    "the sampling": ("train", "data.sampling", *TRAIN),
    "the denoiser": ("train", "denoiser", *TRAIN),
    "the schedule": ("train", "schedule", *TRAIN),
    "the objective": ("train", "objective.prediction", *TRAIN),
    "weights": ("train", "+objective.energy_floor", *TRAIN),
    "TMR's objective": ("train_tmr", "objective", *TRAIN),
    "TMR's other encoder": ("train_tmr", "false_negative_encoder", *TRAIN),
    "the text encoder": ("embed", "text_encoder", f"texts={ROOT / 'README.md'}"),
    "a text encoder's source": ("embed", "text_encoder.pooling", f"texts={ROOT / 'README.md'}"),
    "a preparation": ("prepare", "data.preparation", "source=nowhere"),
    "a frame rate": ("prepare", "data.preparation.fps", "source=nowhere"),
    "a benchmark": ("evaluate", "benchmark", *EVALUATE),
    "a benchmark's setting": ("evaluate", "benchmark.first", *EVALUATE),
    "a table": ("evaluate", "experiment.table", *EVALUATE),
}


@pytest.mark.parametrize(("script", "place", "others"), [(a, b, c) for a, b, *c in PLACES.values()], ids=PLACES)
def test_an_override_that_would_run_code_ends_in_one_line(script, place, others, evil, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    told = refused(
        capsys, script, *others, *(["run=run"] if "train" in script else []), f"++{place.lstrip('+')}={evil[0]}"
    )
    assert not evil[1].exists()
    assert "torch.load" in told, told


@pytest.mark.parametrize("trusted", [False, True])
def test_a_folder_of_somebody_else_s_configurations_runs_nothing_and_trusts_nobody(
    trusted, evil, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cfg" / "text_encoder").mkdir(parents=True)
    (tmp_path / "cfg" / "text_encoder" / "theirs.yaml").write_text(evil[0])
    config = (ROOT / "configs" / "embed.yaml").read_text()
    (tmp_path / "cfg" / "embed.yaml").write_text(
        config.replace("trusted: []", "trusted: [torch]") if trusted else config
    )
    arguments = ("--config-dir", tmp_path / "cfg", "text_encoder=theirs", f"texts={ROOT / 'README.md'}")
    told = refused(capsys, "embed", *arguments)
    assert not evil[1].exists()
    assert (
        "set trusted= on the command line" if trusted else "'torch.load' is not a legal target of this configuration"
    ) in told


def test_hydra_s_own_settings_build_hydra_s_parts_alone(evil, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(ROOT / "configs", tmp_path / "cfg")
    text = (tmp_path / "cfg" / "embed.yaml").read_text()
    hydra = f"hydra:\n  callbacks:\n    theirs: {evil[0]}\n"
    (tmp_path / "cfg" / "embed.yaml").write_text(text + hydra)
    arguments = ("--config-dir", tmp_path / "cfg", "--multirun", f"texts={ROOT / 'README.md'}")
    assert "hydra.callbacks.theirs._target_='torch.load'" in refused(capsys, "embed", *arguments)
    assert not evil[1].exists()
    for logging in ({"()": "os.system"}, {"class": "subprocess.Popen"}):
        with pytest.raises(SettingError, match="not a part of Hydra"):
            check_plugins({"job_logging": {"handlers": {"theirs": logging}}})


OWN = """
    from dataclasses import dataclass
    import torch
    from stmc.data.preparation import LayoutError

    @dataclass(frozen=True)
    class Mine:
        source: str
        fps: float = 20

        def check(self): raise LayoutError(f"{self.source} is empty")
        def fingerprint(self): return ""
        def prepared(self, scratch, workers, watch): pass

    def table(results, title): return title
"""


@pytest.fixture
def mylab(tmp_path, monkeypatch):
    (tmp_path / "code" / "mylab").mkdir(parents=True)
    (tmp_path / "code" / "mylab" / "__init__.py").write_text("")
    (tmp_path / "code" / "mylab" / "parts.py").write_text(textwrap.dedent(OWN))
    monkeypatch.syspath_prepend(tmp_path / "code")
    yield
    for name in ("mylab", "mylab.parts"):
        sys.modules.pop(name, None)


def test_classes_and_functions_of_a_trusted_package_are_built(mylab):
    config = OmegaConf.create(
        {
            "trusted": ["mylab"],
            "data": {"_target_": "mylab.parts.Mine", "fps": 30},
            "table": {"_target_": "mylab.parts.table", "_partial_": True, "title": "ours"},
        }
    )
    assert build_part(config, "data", source="here").fps == 30
    assert build_part(config, "table")([]) == "ours"
    config.data["_target_"] = "mylab.parts.torch.load"
    with pytest.raises(RunError, match="is not a class that mylab defines"):
        build_part(config, "data")
    config.trusted = []
    with pytest.raises(RunError, match="is not a legal target of this configuration; name your own package"):
        build_part(config, "table")


def test_a_trusted_preparation_is_asked(mylab, capsys):
    described = "data.preparation={_target_: mylab.parts.Mine}"
    arguments = ("data=clips", f"+{described}", "source=here", "data.folder=x")
    assert "here is empty" in refused(capsys, "prepare", *arguments, "trusted=[mylab]")
    assert "'mylab.parts.Mine' is not a legal target of this configuration" in refused(capsys, "prepare", *arguments)


def targets(node: object):
    if isinstance(node, dict):
        if "_target_" in node:
            yield node["_target_"]
        node = list(node.values())
    if isinstance(node, list):
        for each in node:
            yield from targets(each)


def test_the_table_has_what_our_configurations_build_and_nothing_else():
    """Beside the classes that packages of parts export."""
    groups = [path for path in (ROOT / "configs").glob("*/**/*.yaml") if path.parent.name != "network"]
    used = {name for path in groups for name in targets(OmegaConf.to_container(OmegaConf.load(path)))}
    used |= set(targets(OmegaConf.to_container(configured("train_tmr", "run=x", "data.folder=y"))))
    exported = ("stmc.text.", "stmc.denoisers.", "stmc.diffusion.", "stmc.evaluators.Tmr")
    offered = {
        "stmc.training.Denoising",
        "stmc.training.data.prolonging.Prolonging",
        "stmc.training.data.limb_velocity.FootVelocity",
        "stmc.training.data.limb_velocity.LimbVelocity",
    }
    assert set(NAMES) - offered == {name for name in used if not name.startswith(exported)} | {
        "stmc.training.TmrObjective"
    }
    for name in NAMES:
        assert _resolve_name(name) is get_object(name) or name.endswith(".read")


WRONG = {
    "steps=ten": ("train", "training.steps=ten", "training.steps='ten': must be a whole number"),
    "a quote": ("train", "training.steps='\"'", "training.steps="),
    "lr=nan": ("train", "training.lr=nan", "training.lr=nan: must be a number"),
    "lr=1e6": ("train", "training.lr=1e6", r"lr (1000000.0) must be above 0 and at most 1"),
    "checkpoint_every": ("train_tmr", "training.checkpoint_every=''", "training.checkpoint_every=''"),
    "no folder": ("train_tmr", "data.folder=null", "data.folder=null: must be the folder of a prepared cache"),
    "no folders": ("train_tmr", "data.folder=[]", "data.folder=[]: must be the folder of a prepared cache"),
    "denoiser": ("train", "denoiser.width=wide", "denoiser.width='wide': must be a whole number"),
    "an unknown argument": ("train", "+denoiser.wide=3", "denoiser.wide: stmc.denoisers.MdmSmpl has no such argument"),
    "heads": ("train", "denoiser.heads=7", "denoiser"),
    "schedule": ("train", "schedule.steps=0", "schedule"),
    "prediction": ("train", "objective.prediction=noise", "objective.prediction='noise'"),
    "alpha": ("train", "+objective.timestep_alpha=-1", "timestep_alpha -1 must be above 0"),
    "rows": ("train", "data.sampling.rows=many", "data.sampling.rows='many': must be a whole number"),
    "no rows": ("train", "data.sampling.rows=0", "data.sampling cannot be built: rows=0: must be at least 1"),
    "another recipe's setting": ("train", "+data.sampling.drop_last=true", "BalancedBatches has no such argument"),
    "an auxiliary loss": (
        "train",
        "data.auxiliary_loss={_target_: stmc.training.data.limb_velocity.LimbVelocity, feet: 1}",
        "data.auxiliary_loss.feet: stmc.training.data.limb_velocity.LimbVelocity has no such argument",
    ),
    "prolonging": (
        "train",
        "data.prolonging={_target_: stmc.training.data.prolonging.Prolonging, seconds: long}",
        "data.prolonging.seconds='long': must be a number",
    ),
    "temperature": ("train_tmr", "+objective.temperature=warm", "objective.temperature='warm': must be a number"),
}


@pytest.mark.parametrize(("script", "setting", "message"), WRONG.values(), ids=WRONG)
def test_a_setting_of_a_part_that_does_not_fit_is_one_line_before_data_are_read(
    script, setting, message, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert message in refused(capsys, script, *TRAIN, "run=run", setting)


def test_a_benchmark_that_is_none_is_one_line(capsys, tmp_path):
    told = refused(capsys, "evaluate", "benchmark._target_=nope", f"output={tmp_path}", *EVALUATE)
    assert told.startswith("benchmark: 'nope' is not a legal target of this configuration")
