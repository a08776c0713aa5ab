"""`fuzz.py` in a process of its own: 2,000 mutated files over all readers; 20,000 by hand."""

import subprocess
import sys
from pathlib import Path

import pytest

FUZZ = Path(__file__).with_name("fuzz.py")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="its memory is measured as on Unix")
def test_mutated_files_are_read_or_refused_in_a_sentence_within_a_second_and_a_gigabyte():
    done = subprocess.run([sys.executable, str(FUZZ), "2000"], capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "2000 files" in done.stdout and ": 0 failures" in done.stdout
