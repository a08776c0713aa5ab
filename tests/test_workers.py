"""The processes that convert pieces: they end with the one that started them, also if it is killed."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

SLEEPER = """
import os, pathlib, sys, time
from stmc.data.preparation import in_parallel

if __name__ == "__main__":
    for name, pid in in_parallel([(str(n), (os.getpid,)) for n in range(40)], workers=1):
        pathlib.Path(sys.argv[1], str(pid)).touch()
        if name == "1":
            pathlib.Path(sys.argv[1], "ready").touch()
            time.sleep(600)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="kill -9")
def test_workers_end_when_their_parent_is_killed(tmp_path):
    (tmp_path / "sleeper.py").write_text(SLEEPER)
    (tmp_path / "workers").mkdir()
    path = os.pathsep.join([str(Path(__file__).resolve().parents[1]), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, str(tmp_path / "sleeper.py"), str(tmp_path / "workers")]
    parent = subprocess.Popen(command, env=os.environ | {"PYTHONPATH": path})
    try:
        until(lambda: (tmp_path / "workers" / "ready").exists())
    finally:
        parent.send_signal(signal.SIGKILL)
        parent.wait()
    workers = [int(file.name) for file in (tmp_path / "workers").iterdir() if file.name != "ready"]
    assert workers
    until(lambda: not any(map(alive, workers)))


def until(done) -> None:
    limit = time.monotonic() + 120
    while not done():
        assert time.monotonic() < limit
        time.sleep(0.05)


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    status = Path(f"/proc/{pid}/stat")  # whose parent is gone may wait to be collected by a container's first process
    return not (status.exists() and status.read_text().rpartition(")")[2].split()[0] == "Z")
