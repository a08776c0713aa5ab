"""Shares of work: every item is in one of them, whatever their number; how they are asked for; two at once."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from helpers.scripts import ROOT, loaded
from helpers.tiny_model import tiny
from hypothesis import given
from hypothesis import strategies as st

import stmc
from stmc.evaluation.benchmarks.samples import Samples
from stmc.io.files import FolderInUse, lock_folder
from stmc.settings.records import SettingError
from stmc.settings.shards import Shard, describe_shards

counts = st.integers(min_value=1, max_value=80)


@given(counts, st.integers(min_value=0, max_value=200))
def test_every_item_is_in_one_share_and_shares_differ_by_one_at_most(count, items):
    shares = [Shard(number, count).of(range(items)) for number in range(1, count + 1)]
    assert sorted(item for share in shares for item in share) == list(range(items))
    assert max(map(len, shares)) - min(map(len, shares)) <= 1


@given(counts, st.sets(st.integers(min_value=0, max_value=199)))
def test_what_is_missing_is_told_of_the_shares_that_should_have_made_it(count, missing):
    lacking = Shard(None, count).count_missing(range(200), missing)
    expected = {
        Shard(number, count): len({*Shard(number, count).of(range(200))} & missing) for number in range(1, count + 1)
    }
    assert lacking == {shard: left for shard, left in expected.items() if left}


@pytest.mark.parametrize("text", ["0/4", "5/4", "1/0", "4", "1/2/3", "-1/4", "1.5/4", "one/4", "all", "", "1/4 "])
def test_what_is_no_share_is_refused(text):
    with pytest.raises(SettingError, match="shard="):
        Shard.parse(text)


def test_a_share_counted_from_0_is_told_how_to_count():
    with pytest.raises(SettingError, match=r"shard=0/4: must be from 1/4 to 4/4 .*--array=1-4"):
        Shard.parse("0/4")
    assert (Shard.parse("3/64"), Shard.parse("all/64")) == (Shard(3, 64), Shard(None, 64))
    assert [str(Shard.parse(text)) for text in ("3/64", "all/64")] == ["3/64", "all/64"]


def test_a_process_that_was_launched_with_others_has_its_share():
    assert Shard.of_process({}) == Shard.of_process({"RANK": "0"}) == Shard.of_process({"RANK": "0", "WORLD_SIZE": "1"})
    assert [Shard.of_process({"RANK": str(rank), "WORLD_SIZE": "2"}) for rank in (0, 1)] == [Shard(1, 2), Shard(2, 2)]
    with pytest.raises(SettingError, match="WORLD_SIZE='two'"):
        Shard.of_process({"RANK": "0", "WORLD_SIZE": "two"})


def test_shares_are_listed_in_words_and_not_without_end():
    lacking = {Shard(number, 20): number for number in range(1, 12)}
    assert describe_shards({Shard(2, 4): 5}) == "shard 2/4 (5)"
    assert describe_shards({Shard(2, 4): 5, Shard(3, 4): 1}) == "shards 2/4 (5) and 3/4 (1)"
    assert describe_shards(lacking).endswith("8/20 (8) and 3 more")


def test_a_lock_is_waited_for_as_long_as_there_is_patience(tmp_path):
    with ThreadPoolExecutor() as pool:
        with lock_folder(tmp_path):
            with pytest.raises(FolderInUse), lock_folder(tmp_path, patience=0.01):
                pass
            waiting = pool.submit(lambda: lock_folder(tmp_path, patience=60).__enter__())
            assert not waiting.done()
        waiting.result(timeout=60)


def test_motions_wait_on_the_disk_as_they_were_made(tmp_path):
    [motion] = tiny().generate("nod # 0 # 1 # head", steps=2)
    samples = Samples(tmp_path / "run", motion.fps)
    assert samples.missing([3, 1]) == [3, 1]
    samples.write(3, motion, seconds=1.5)
    assert samples.missing([3, 1]) == [1]
    read, seconds = samples.read(3)
    assert seconds == 1.5
    assert all(
        torch.equal(getattr(read, name), getattr(motion, name)) for name in ("rotations", "translation", "joints")
    )
    samples.remove()
    samples.remove()
    assert samples.missing([3]) == [3]


# Sampling ------------------------------------------------------------------------------------------------------------

TIMELINES = "\n\n".join(f"nod # 0 # {seconds} # head" for seconds in (1, 2, 1.5))


@pytest.fixture
def asked(tmp_path) -> list[str]:
    stmc.save(tiny(), tmp_path / "model", "")
    (tmp_path / "three.txt").write_text(TIMELINES)
    return [str(tmp_path / "three.txt"), f"model={tmp_path / 'model'}", "steps=2", "formats=npz", "device=cpu"]


def test_shares_of_sampling_are_together_what_one_process_makes(asked, tmp_path, capsys):
    main = loaded("sample").main
    assert main([*asked, f"output={tmp_path / 'one'}"]) == 0
    assert main([*asked, f"output={tmp_path / 'two'}", "shard=2/2"]) == 0
    assert len(list((tmp_path / "two").glob("*.npz"))) == 1
    capsys.readouterr()
    assert main([*asked, f"output={tmp_path / 'two'}", "shard=all/2"]) == 2
    assert "motions are missing of shard 1/2 (2)" in capsys.readouterr().err
    assert main([*asked, f"output={tmp_path / 'two'}", "shard=1/2"]) == 0
    assert main([*asked, f"output={tmp_path / 'two'}", "shard=all/2"]) == 0
    one, two = ({path.name: stmc.read(path) for path in (tmp_path / name).glob("*.npz")} for name in ("one", "two"))
    assert set(one) == set(two)
    for name, motion in one.items():
        torch.testing.assert_close(two[name].joints, motion.joints, atol=1e-4, rtol=0)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="torchrun's rendezvous")
def test_processes_that_are_launched_together_share_the_sampling(asked, tmp_path):
    launched("sample", [*asked, f"output={tmp_path / 'out'}"])
    assert len(list((tmp_path / "out").glob("*.npz"))) == 3
    assert not list((tmp_path / "out").glob(".*"))


def launched(command: str, arguments: list[str]) -> str:
    """Two processes of a command, as `accelerate launch` starts them; what they said."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "COLUMNS": "200"}
    launch = [
        sys.executable,
        "-m",
        "accelerate.commands.launch",
        "--multi_gpu",
        "--num_processes=2",
        "--main_process_port=0",
    ]
    done = subprocess.run(
        [*launch, "-m", "stmc", command, *arguments],
        env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
    return done.stdout


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="submitit is for POSIX")
def test_shares_are_jobs_of_hydra_s_submitit_launcher(asked, tmp_path):
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher", reason="needs hydra-submitit-launcher: stmc[slurm]")
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    jobs = ["--multirun", "hydra/launcher=submitit_local", "shard=1/2,2/2", f"hydra.sweep.dir={tmp_path / 'jobs'}"]
    done = subprocess.run(
        [sys.executable, "-m", "stmc", "sample", *asked, f"output={tmp_path / 'out'}", *jobs],
        env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False, cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
    assert len(list((tmp_path / "out").glob("*.npz"))) == 3
    assert sorted(path.name for path in (tmp_path / "jobs").iterdir() if path.is_dir()) == [".submitit", "0", "1"]


def test_many_runs_of_a_command_are_hydra_s_to_launch(asked, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    jobs = ["--multirun", f"hydra.sweep.dir={tmp_path / 'jobs'}"]
    assert loaded("sample").main([*asked, f"output={tmp_path / 'out'}", "shard=1/2,2/2", *jobs]) == 0
    assert len(list((tmp_path / "out").glob("*.npz"))) == 3
    capsys.readouterr()
    assert loaded("sample").main([*asked, f"output={tmp_path / 'out'}", "shard=0/2,1/2", *jobs]) == 2
    assert "shard=0/2: must be from 1/2" in capsys.readouterr().err
