"""Files that are whole or absent, whatever goes wrong while they are written, and folders with one writer."""

import errno
import multiprocessing
import os
import signal
import socket
import stat
import subprocess
import sys

import pytest
import torch
from safetensors.torch import save_file

from stmc.io import files
from stmc.io.files import LOCK, FolderInUse, lock_folder, remove_leftovers, write_text, write_whole, write_whole_folder

if os.name != "nt":
    import fcntl

HOLD = """
import sys
from pathlib import Path
from stmc.io.files import lock_folder
with lock_folder(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def umask():
    before = os.umask(0o027)
    yield
    os.umask(before)


@pytest.fixture
def holder(tmp_path):
    """Another process that has locked `tmp_path`."""
    command = [sys.executable, "-c", HOLD, str(tmp_path)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.communicate()


def leave(folder):
    """Leaves a temporary behind, as a kill in the middle of a write does."""
    write_whole(folder / "whole", lambda path: (path.write_bytes(b"half"), os._exit(0)))


def leave_folder(path):
    """The same of a folder."""
    write_whole_folder(path, lambda folder: (folder.mkdir(), (folder / "half").touch(), os._exit(0)))


@pytest.mark.skipif(os.name == "nt", reason="POSIX modes")
@pytest.mark.parametrize(
    "write", [lambda path: path.write_text("a"), lambda path: save_file({"a": torch.ones(2)}, path)]
)
def test_a_file_has_the_mode_that_open_would_give_it(tmp_path, umask, write):
    write_whole(tmp_path / "whole", write)
    assert stat.S_IMODE((tmp_path / "whole").stat().st_mode) == 0o640


def test_a_file_is_flushed_through_a_handle_that_may_write(tmp_path, monkeypatch):
    flushed = []

    def fsync(descriptor):
        if not stat.S_ISDIR(os.fstat(descriptor).st_mode):
            os.write(descriptor, b"")  # on Windows only such a handle can be flushed
            flushed.append(os.fstat(descriptor).st_ino)

    monkeypatch.setattr(os, "fsync", fsync)
    write_text(tmp_path / "whole", "a")
    assert flushed == [(tmp_path / "whole").stat().st_ino]


def test_a_text_has_the_same_bytes_on_every_system(tmp_path):
    write_text(tmp_path / "whole", "a\nä\n")
    assert (tmp_path / "whole").read_bytes() == b"a\n\xc3\xa4\n"


def test_a_file_is_written_beside_a_scratch_folder_whose_long_name_begins_alike(tmp_path):
    path = tmp_path / ("a-timeline-with-many-prompts" * 3)
    with files.scratch(path) as aside:
        write_text(path.with_suffix(".json"), "{}")
        assert aside.is_dir()
    assert [each.suffix for each in tmp_path.iterdir()] == [".json"]


def test_a_long_name_can_be_written(tmp_path):
    write_text(tmp_path / ("走" * 80), "a")
    assert len(os.listdir(tmp_path)) == 1


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left on device"), RuntimeError("[enforce fail]")])
def test_a_full_disk_is_an_os_error_that_says_so_and_what_was_there_stays(tmp_path, monkeypatch, error):
    write_text(tmp_path / "whole", "old")
    monkeypatch.setattr(files.shutil, "disk_usage", lambda _: type("Usage", (), {"free": 0}))

    def fail(path):
        raise error

    with pytest.raises(OSError, match=r"the disk is full.*whole"):
        write_whole(tmp_path / "whole", fail)
    assert (tmp_path / "whole").read_text() == "old" and os.listdir(tmp_path) == ["whole"]


def test_another_error_of_a_writer_stays_what_it_was(tmp_path):
    with pytest.raises(ZeroDivisionError):
        write_whole(tmp_path / "whole", lambda path: 1 / 0)
    assert os.listdir(tmp_path) == []


@pytest.mark.skipif(os.name == "nt", reason="forks")
def test_temporaries_of_killed_processes_are_removed_and_those_of_living_ones_stay(tmp_path):
    child = multiprocessing.get_context("fork").Process(target=leave, args=(tmp_path / "below",))
    child.start()
    child.join()
    [left] = (tmp_path / "below").iterdir()
    foreign = tmp_path / left.name.replace(files._HOST, "0" * 8)
    again = tmp_path / left.name.replace(f"-{child.pid}-{files._TOKEN}", f"-{os.getpid()}-{'0' * 8}")
    for path in (foreign, again, tmp_path / ".hidden.tmp"):
        path.touch()

    def write(path):
        remove_leftovers(tmp_path)
        assert not left.exists() and not again.exists()
        path.write_text("a")

    write_whole(tmp_path / "whole", write)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["below", foreign.name, ".hidden.tmp", "whole"])


@pytest.mark.skipif(os.name == "nt", reason="forks")
def test_a_folder_is_whole_or_absent_and_what_a_killed_process_left_beside_it_goes(tmp_path):
    child = multiprocessing.get_context("fork").Process(target=leave_folder, args=(tmp_path / "run",))
    child.start()
    child.join()
    [left] = tmp_path.iterdir()
    assert (left / "half").exists()
    foreign = tmp_path / left.name.replace(files._HOST, "0" * 8)
    foreign.mkdir()
    with pytest.raises(ZeroDivisionError):
        write_whole_folder(tmp_path / "run", lambda folder: (folder.mkdir(), 1 / 0))
    assert os.listdir(tmp_path) == [foreign.name]
    (tmp_path / "run").mkdir()
    write_whole_folder(tmp_path / "run", lambda folder: (folder.mkdir(), (folder / "whole").touch()))
    assert sorted(os.listdir(tmp_path)) == sorted([foreign.name, "run"]) and os.listdir(tmp_path / "run") == ["whole"]


def test_a_folder_that_is_being_written_is_refused_by_its_owner_s_name(tmp_path, holder):
    with pytest.raises(FolderInUse, match=rf"is in use by process {holder.pid} on host"), lock_folder(tmp_path):
        pass


def test_a_crash_gives_a_folder_back(tmp_path, holder):
    holder.send_signal(signal.SIGKILL if hasattr(signal, "SIGKILL") else signal.SIGTERM)
    holder.wait()
    with lock_folder(tmp_path):
        assert (tmp_path / LOCK).exists()
    assert os.listdir(tmp_path) == []


def test_the_end_of_a_run_gives_its_folder_back_whatever_ends_it(tmp_path):
    with pytest.raises(KeyboardInterrupt), lock_folder(tmp_path):
        raise KeyboardInterrupt
    with lock_folder(tmp_path):
        pass
    assert os.listdir(tmp_path) == []


@pytest.mark.skipif(os.name == "nt", reason="Windows removes no open file")
def test_a_lock_that_was_removed_while_another_opened_it_locks_nothing(tmp_path, monkeypatch):
    """Between the opening of a lock and its locking its owner can go away, and take the name with it."""
    flock, locks = fcntl.flock, []

    def late(descriptor, operation):
        if not locks:
            (tmp_path / LOCK).unlink()
        locks.append(descriptor)
        flock(descriptor, operation)

    monkeypatch.setattr(fcntl, "flock", late)
    with lock_folder(tmp_path, patience=5):
        assert len(locks) == 2
        with pytest.raises(FolderInUse), lock_folder(tmp_path):
            pass


@pytest.mark.skipif(os.name == "nt", reason="POSIX locks")
@pytest.mark.parametrize("code", [errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP])
def test_a_file_system_without_locks_is_a_warning(tmp_path, monkeypatch, caplog, code):
    def flock(descriptor, operation):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(fcntl, "flock", flock)
    with lock_folder(tmp_path):
        assert "this file system has no locks" in caplog.text
    assert os.listdir(tmp_path) == []


def test_an_owner_with_a_shorter_name_than_the_last_one_is_named_whole(tmp_path):
    (tmp_path / LOCK).write_bytes(b" process 1234567890 on host of-a-machine-with-a-name-without-end.example\n")
    with lock_folder(tmp_path):
        message = rf"in use by process {os.getpid()} on host {socket.gethostname()}; wait"
        with pytest.raises(FolderInUse, match=message), lock_folder(tmp_path):
            pass


def test_a_lock_file_that_cannot_be_opened_is_an_error_and_no_file_system_without_locks(tmp_path):
    (tmp_path / LOCK).mkdir()
    with pytest.raises(OSError, match="lock"), lock_folder(tmp_path):
        pass


def test_a_process_is_alive_until_it_has_ended():
    process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    assert files._is_alive(process.pid, "0" * 8)
    process.communicate(b"\n")
    assert not files._is_alive(process.pid, "0" * 8)
    assert not files._is_alive(10**30, "0" * 8)
