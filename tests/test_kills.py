"""Whatever is killed and asked again ends as if nothing had happened: see `kills.py`, which takes more kills."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

KILLS = Path(__file__).with_name("kills.py")


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")
@pytest.mark.parametrize("work", ["sampling", "training", "preparing", "evaluating"])
def test_what_is_killed_loses_nothing_and_leaves_nothing(work):
    command = [sys.executable, str(KILLS), work, "--kills=4"]
    done = subprocess.run(command, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False)
    assert done.returncode == 0, done.stdout
