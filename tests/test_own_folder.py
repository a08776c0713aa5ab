"""A data set, a network, a method and a benchmark of somebody else's folder go the whole way, as the pages on extending
say, from the checkout and from the wheel."""

import json
import os
import subprocess
import sys

import pytest
from helpers.own_folder import install_wheel, write_package, write_recordings
from helpers.scripts import ROOT

import stmc

QUICK = (
    *("training.steps=3", "training.warmup=1", "training.log_every=1", "training.validate_every=3"),
    *("training.checkpoint_every=3", "training.precision=fp32", "data.sampling.rows=4", "data.sampling.pool=2"),
    *("validation=1", "draw=[]", "device=cpu", "threads=1", "denoiser.width=8"),
)


@pytest.mark.slow
@pytest.mark.parametrize("origin", ["checkout", "wheel"])
def test_a_folder_of_one_s_own_is_prepared_trained_sampled_and_evaluated(origin, tmp_path):
    if origin == "wheel":
        pytest.importorskip("setuptools", minversion="77")
    place = ROOT if origin == "checkout" else install_wheel(tmp_path / "wheel")
    write_package(tmp_path)
    paths = {"PYTHONPATH": os.pathsep.join(map(str, (place, tmp_path))), "OMP_NUM_THREADS": "1"}

    def run(command: str, *settings: str) -> str:
        called = [sys.executable, "-m", "stmc", command, "--config-dir", "mylab/configs", *settings]
        done = subprocess.run(called, cwd=tmp_path, env=os.environ | paths, text=True, capture_output=True)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    run("prepare", "data=mine", "trusted=[mylab]", f"source={write_recordings(tmp_path / 'recordings')}", "workers=1")
    assert (tmp_path / "cache/mine").is_dir()
    run("train", "data=mine", "denoiser=tiny", "trusted=[mylab]", "run=runs/tiny", "+data.dataset.min_clips=1", *QUICK)
    model, method = ("model=runs/tiny", "trusted=[mylab]"), "mylab.methods.resampled"
    run("sample", "walk # 0 # 2", "outputs/", *model, f"method={method}", "steps=2", "formats=npz", "device=cpu")
    assert stmc.read(tmp_path / "outputs/walk_0.npz").duration == 2
    settings = ("experiment=mine", "benchmark=reach", "models.MDM-SMPL=runs/tiny", "trusted=[mylab]", "seeds=[0]")
    run(
        "evaluate",
        "outputs/evaluation",
        *settings,
        "device=cpu",
        "precision=fp32",
        "threads=1",
        "experiment.settings.steps=[2]",
    )
    records = [json.loads(line) for line in (tmp_path / "outputs/evaluation/results.jsonl").read_text().splitlines()]
    assert len(records) == 2
    assert method in str(records)
