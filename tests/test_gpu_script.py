"""The script for a GPU, small, on the CPU."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from helpers.scripts import ROOT, loaded
from helpers.tiny_model import tiny

SETTINGS = {"DEVICE": "cpu", "BATCH": "2", "STEPS": "2", "REPEATS": "1"}


@pytest.mark.slow
def test_the_script_for_a_gpu_runs_every_measurement_on_a_cpu(tmp_path):
    timelines = tmp_path / "timelines.txt"
    timelines.write_text("walk # 0 # 2\n\nwave # 0 # 1 # right arm\nsit down # 0 # 2 # legs\n", "utf-8")
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    subprocess.run(
        [ROOT / "scripts/gpu.sh", timelines, tmp_path / "gpu"],
        check=True, cwd=ROOT, env=os.environ | SETTINGS | {"PATH": path},
    )  # fmt: skip
    assert {each.name for each in (tmp_path / "gpu").iterdir()} == {
        "parity.txt", "bf16.txt", "fp32.txt", "length", "length.txt", "motions", "sample.txt"
    }  # fmt: skip
    assert "time of the published loop" in (tmp_path / "gpu/bf16.txt").read_text("utf-8")
    assert len(list((tmp_path / "gpu/motions").glob("**/*.npz"))) == 2


def test_an_accelerator_is_compared_with_the_cpu():
    model, reference = tiny(), tiny()
    with torch.no_grad():
        for parameter in reference.network.parameters():
            parameter.add_(0.1)
    rows = loaded("benchmark").measure_accelerator(model, reference, lambda own: own.generate("walk # 0 # 1", steps=2))
    assert [name.partition(",")[0] for name, _ in rows] == ["time of the batch", "largest difference of a joint"]
    assert float(rows[-1][1].split()[0]) > 0
