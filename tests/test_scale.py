"""What a timeline costs in runs of many: their files, the records of shards, and the table."""

import json

import pytest
from helpers.scripts import loaded
from helpers.tiny_model import tiny

import stmc
from stmc.cli.benchmark_scale import (
    Recorded,
    Settings,
    check_folder,
    describe_count,
    print_rows,
    random_timelines,
    record_path,
    sample_shard,
)
from stmc.settings.records import SettingError
from stmc.timeline import Timeline


def test_more_timelines_begin_with_the_fewer_and_all_have_ten_seconds():
    few, many = (Timeline.parse_all(random_timelines(count)) for count in (3, 20))
    assert many[:3] == few and len(many) == 20
    assert {timeline.duration for timeline in many} == {10.0}
    assert {len(timeline.prompts) for timeline in many} == {3}


def test_the_cost_of_a_timeline_is_that_of_what_was_sampled_after_a_kill(tmp_path):
    costs = [Recorded(5, 2, 4.0, 1.0, 2**20), Recorded(5, 5, 10.0, 3.0, 2**21)]
    for number, cost in enumerate(costs, start=1):
        record_path(tmp_path, number, 2).write_text(json.dumps(cost._asdict()))
    (tmp_path / "killed.json").write_text('{"motions": 5}')
    row = describe_count(10, tmp_path, 2)
    assert (row["seconds_per_timeline"], row["peak_bytes"], row["loading_seconds"]) == (2.0, 2**21, 3.0)
    assert (row["killed_after"], row["sampled_after_resuming"]) == (5, 2)
    table = print_rows([row, row | {"seconds_per_timeline": 3.0, "killed_after": None}])
    assert [*table.columns[3].cells] == ["1.000", "1.500"] and [*table.columns[5].cells] == ["5 motions", "–"]


def test_a_folder_is_not_measured_with_two_settings(tmp_path):
    check_folder(Settings(steps=10, counts=(100,)), tmp_path)
    check_folder(Settings(steps=10, counts=(100, 1000)), tmp_path)
    with pytest.raises(SettingError, match=r"measured with other settings \(steps, threads\); choose another folder"):
        check_folder(Settings(steps=25, threads=1), tmp_path)


@pytest.mark.slow
def test_a_shard_samples_what_is_missing_of_it_and_records_how_much_that_was(tmp_path):
    stmc.save(tiny(), tmp_path / "model", "")
    settings = Settings(model=str(tmp_path / "model"), steps=1, output=str(tmp_path), device="cpu")
    (tmp_path / "timelines.txt").write_text("nod # 0 # 1 # head\n\nnod # 0 # 1 # head\n\nnod # 0 # 1 # head\n")
    (tmp_path / "motions").mkdir()
    for sampled in (2, 0):
        sample_shard(settings, tmp_path, 1)
        recorded = json.loads(record_path(tmp_path, 1, 2).read_text())
        assert (recorded["timelines"], recorded["sampled"]) == (2, sampled)
    assert len(list((tmp_path / "motions").glob("*.npz"))) == 2


@pytest.mark.slow
def test_the_command_ends_with_all_motions_and_a_second_run_repeats_no_shard(tmp_path):
    stmc.save(tiny(), tmp_path / "model", "")
    arguments = [
        f"model={tmp_path / 'model'}", f"output={tmp_path / 'out'}", "counts=[2,30]", "steps=2", "batch=1", "kill=0.3",
        "device=cpu",
    ]  # fmt: skip
    main = loaded("benchmark_scale").main
    assert main(arguments) == 0
    records = {path: path.read_text() for path in (tmp_path / "out").rglob("shard_*.json")}
    assert len(records) == 4
    assert len(list((tmp_path / "out" / "30" / "motions").glob("*.npz"))) == 30
    assert main(arguments) == 0
    assert {path: path.read_text() for path in records} == records
    assert [row["timelines"] for row in json.loads((tmp_path / "out" / "scale.json").read_text())] == [2, 30]
