"""From motion capture to motions to look at, as a user goes: the scripts, on a toy data set."""

import csv
import hashlib
import io
import json
import re
from concurrent.futures import ThreadPoolExecutor
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.bandai_files import about, bvh_text, posed
from helpers.motions import standing_still
from helpers.scripts import configured, loaded, script
from helpers.scripts import run as in_this_process
from helpers.source_folders import Serial
from helpers.tiny_model import tiny

import stmc
from stmc.data import preparation
from stmc.data.cache import Cache
from stmc.run import CARD, CONFIG, STATISTICS, WEIGHTS, fingerprint
from stmc.settings.records import SettingError

TIMELINES = """\
walk forwards # 0 # 2 # legs
raise the left arm # 0.5 # 1.5 # left arm

raise the right arm # 0 # 1 # right arm
"""


def clip(content: str, number: int) -> stmc.Motion:
    """A second and a half of walking, or of one raised arm."""
    time = torch.arange(45 + number, dtype=torch.float64) / 30
    zero = torch.zeros_like(time)
    hanging = {f"{side}_shoulder": about("z", zero + sign * 1.3) for side, sign in (("left", -1), ("right", 1))}
    if content == "walk":
        hanging["left_hip"] = about("x", 0.4 * torch.sin(6 * time + number))
        hanging["right_hip"] = about("x", -0.4 * torch.sin(6 * time + number))
        return posed(hanging, torch.stack([zero, -(1.0 + 0.02 * number) * time, zero + 0.9], dim=-1))
    hanging["left_shoulder"] = about("z", -1.3 + (2.6 - 0.05 * number) * torch.sin(2 * time) ** 2)
    return posed(hanging, torch.stack([zero, zero, zero + 0.9], dim=-1))


@pytest.fixture(scope="module")
def work(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("work")


@pytest.fixture(scope="module")
def source(work) -> Path:
    """Ten clips of one content, so that each part of the split has one, five of another, and one that is broken."""
    folder = work / "dataset"
    folder.mkdir()
    for content, count in (("walk", 10), ("raise-up-left-hand", 5)):
        for number in range(count):
            text = bvh_text(clip(content, number))
            (folder / f"dataset-1_{content}_normal_{number:03d}.bvh").write_text(text)
    (folder / "dataset-1_bow_normal_001.bvh").write_text(text[: len(text) // 2])
    return folder


def preparing(work: Path, source: Path) -> tuple[str, ...]:
    return (f"source={source}", f"folder={work / 'cache'}", "workers=1")


@pytest.fixture(scope="module")
def prepared(work, source) -> tuple[Path, str]:
    """The folder of the cache, and what was said meanwhile."""
    said = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(said):
        patch.setattr(preparation, "ProcessPoolExecutor", Serial)
        in_this_process("prepare", "prepare", *preparing(work, source))
    return work / "cache", " ".join(said.getvalue().split())


def training(work: Path) -> tuple[str, ...]:
    small = ("denoiser=mdm_smpl_small", "denoiser.width=32", "denoiser.feedforward=64", "denoiser.layers=1")
    few = ("training.steps=4", "training.log_every=2", "training.validate_every=4", "training.checkpoint_every=4")
    batches = ("data.sampling.rows=4", "data.sampling.pool=2", "validation=1")
    drawing = ("draw_every=4", "draw=['nod # 0 # 1 # head']")
    places = (f"run={work / 'run'}", f"data.folder={work / 'cache'}", f"text_cache={work / 'texts'}")
    return (
        *places,
        *small,
        *few,
        *batches,
        *drawing,
        "device=cpu",
        "threads=1",
        "training.warmup=1",
        "noise_scale=std",
    )


@pytest.fixture(scope="module")
def trained(work, prepared) -> Path:
    in_this_process("train", "train", *training(work))
    return work / "run"


@pytest.fixture(scope="module")
def timeline(work) -> Path:
    (work / "two.txt").write_text(TIMELINES)
    return work / "two.txt"


@pytest.fixture(scope="module")
def sampled(work, trained, timeline) -> Path:
    in_this_process("sample", "sample", *sampling(work, timeline))
    return work / "out"


def sampling(work: Path, timeline: Path) -> tuple[str, ...]:
    return (f"timeline={timeline}", f"model={work / 'run'}", f"output={work / 'out'}", "steps=2", "device=cpu")


def test_preparing_makes_a_cache_and_names_what_it_skipped(prepared):
    folder, said = prepared
    cache = Cache.read(folder)
    assert len(cache.clips) == 30
    assert {clip.content for clip in cache.clips} == {"walk", "raise-up-left-hand", "raise-up-right-hand"}
    assert {clip.split for clip in cache.clips} == {"train", "val", "test"}
    assert "skipped dataset-1_bow_normal_001" in said
    assert "30 clips" in said


def test_preparing_again_sees_that_nothing_changed(prepared, source, capsys):
    before = {path: path.stat().st_mtime_ns for path in prepared[0].iterdir()}
    in_this_process("prepare", "prepare", f"source={source}", f"folder={prepared[0]}")
    assert "is up to date" in " ".join(capsys.readouterr().out.split())
    assert {path: path.stat().st_mtime_ns for path in prepared[0].iterdir()} == before


@pytest.mark.slow
def test_the_scripts_as_processes_prepare_train_and_sample_and_leave_nothing_where_they_were_started(tmp_path, source):
    (tmp_path / "two.txt").write_text(TIMELINES)
    here = tmp_path / "here"
    assert "30 clips" in script("prepare", *preparing(tmp_path, source), folder=here).stdout
    script("train", *training(tmp_path), folder=here)
    script("sample", *sampling(tmp_path, tmp_path / "two.txt"), folder=here)
    assert len(list((tmp_path / "out").iterdir())) == 8
    assert list(here.iterdir()) == []


@pytest.mark.slow
def test_preparing_what_is_not_there_is_a_sentence_and_no_traceback(work):
    done = script("prepare", f"source={work / 'nowhere'}", folder=work / "here", check=False)
    assert done.returncode == 2
    assert len(done.stdout.splitlines()) == 1
    assert "nowhere does not exist" in done.stdout


def test_training_leaves_a_model_logs_checkpoints_and_pictures(trained, work):
    run = trained
    model = stmc.load(run)
    assert model.fps == 20
    assert model.own_sampling.noise_scale == "std"
    assert {CARD, CONFIG, STATISTICS, WEIGHTS, "train.csv", "validation.csv"} <= {path.name for path in run.iterdir()}
    with (run / "train.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["step"] for row in rows] == ["2", "4"]
    assert all(float(row["loss"]) > 0 for row in rows)
    assert list((run / "checkpoints").glob("*.pt"))
    assert list((run / "pictures").glob("*.png"))
    assert list((run / "tensorboard").iterdir())
    assert str(work) not in (run / CONFIG).read_text(), "a run can be moved"


def test_a_training_without_a_teacher_resumes_what_was_begun_before_there_were_any(trained):
    newest = max((trained / "checkpoints").glob("*.pt"))
    described = torch.load(newest, weights_only=True)["described"]
    assert "init_from" in described and "teacher" not in described


@pytest.fixture(scope="module")
def distilling(work, trained) -> tuple[str, ...]:
    return (*training(work), f"run={work / 'distilled'}", f"init_from={trained}", "+objective.distilled_guidance=2.5")


def test_a_distilled_model_loads_says_of_what_it_is_one_and_needs_no_guidance(work, trained, distilling):
    in_this_process("train", "train", *distilling)
    teacher, student = stmc.load(trained), stmc.load(work / "distilled")
    assert (teacher.own_sampling.guidance, student.own_sampling.guidance) == (2.5, 1)
    torch.testing.assert_close(student.motion_statistics.std, teacher.motion_statistics.std, atol=0, rtol=0)
    card = (work / "distilled" / CARD).read_text()
    assert f"Distilled from {trained}" in card and "with guidance 2.5" in card
    plans = student.plans([stmc.Timeline.parse("walk # 0 # 1\nnod # 1 # 2")])
    assert "guidance 1," in repr(student.guided(plans))
    [motion] = student.generate("walk # 0 # 1", seed=0, steps=2)
    assert len(motion) == 20


def test_a_distilled_model_is_otherwise_sampled_as_its_teacher(work, trained, distilling):
    train = loaded("train")
    teacher = replace(stmc.load(trained), sampling=stmc.Sampling(guidance=4, stitch_from=0.2))
    own = train.default_sampling(configured("train", *distilling), teacher)
    assert dict(own.given) == {"noise_scale": "std", "guidance": 1, "stitch_from": 0.2}
    asked = train.default_sampling(configured("train", *distilling, "guidance=1.5"), teacher)
    assert asked.guidance == 1.5


FEW_STEPS = ("+schedule.spacing=trailing", "+objective.steps=2", "+objective.teacher_steps=4")


def test_a_model_of_few_steps_is_distilled_and_remembers_how_it_is_sampled(work, trained, distilling):
    in_this_process("train", "train", *distilling, *FEW_STEPS, f"run={work / 'few'}")
    student = stmc.load(work / "few")
    settings = student.settings()
    assert (settings.steps, settings.sampler, settings.guidance) == (2, "ddim", 1)
    assert student.schedule.spaced(settings.steps) == (49, 99)
    assert "Its 2 steps of DDIM replace 4 of that model" in (work / "few" / CARD).read_text()
    further = ("objective.distilled_guidance=1", "objective.steps=1", "objective.teacher_steps=2")
    again = (*distilling, *FEW_STEPS, *further, f"init_from={work / 'few'}", f"run={work / 'fewer'}")
    in_this_process("train", "train", *again)
    assert stmc.load(work / "fewer").settings().steps == 1


@pytest.mark.parametrize("steps", [1, 2, 4, 10])
def test_a_model_of_few_steps_is_stitched_from_the_first_on_whatever_its_teacher_is(trained, distilling, steps):
    teacher = replace(stmc.load(trained), sampling=stmc.Sampling(stitch_from=0.2))
    config = configured("train", *distilling, f"+objective.steps={steps}", "+objective.teacher_steps=20")
    assert loaded("train").default_sampling(config, teacher).stitch_from == 0


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["+objective.teacher_steps=4"], r"teacher_steps=4 needs objective\.steps, such as 4"),
        (["+objective.steps=3", "+objective.teacher_steps=4"], r"\(4\) must be a multiple of steps \(3\)"),
        (["+objective.steps=2", "+objective.teacher_steps=4"], "use a schedule with spacing=trailing"),
        (["+objective.steps=two"], "objective.steps"),
    ],
)
def test_steps_that_cannot_be_distilled_are_refused_before_the_data_are_read(distilling, settings, message):
    with pytest.raises(ValueError, match=message):
        in_this_process("train", "train", *distilling, *settings, "data.folder=nowhere")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["schedule.steps=50"], "schedule is .*'steps': 100.* there and .*'steps': 50.* here"),
        (["objective.prediction=eps"], "objective.prediction is x0 there and eps here"),
        (["text_encoder=clip"], "text_encoder is .*MiniLM.* there and .*Clip"),
        (["representation=humanml3d"], "representation is .*SmplRepresentation.* there and .*HumanML3D"),
    ],
)
def test_a_model_of_other_predictions_is_not_distilled(distilling, settings, message):
    with pytest.raises(ValueError, match=message):
        in_this_process("train", "train", *distilling, *settings)


def test_a_model_with_a_text_for_every_frame_is_not_distilled(trained, distilling):
    model = stmc.load(trained)
    model.denoiser.per_frame_text = True
    with pytest.raises(ValueError, match="choose a denoiser of one text per motion"):
        loaded("train").find_teacher(configured("train", *distilling), model)


def test_a_model_of_another_frame_rate_is_not_distilled(trained, distilling, monkeypatch):
    model = replace(stmc.load(trained), fps=30)
    monkeypatch.setattr(stmc, "load", lambda *_, **__: model)
    with pytest.raises(ValueError, match="has 30 frames per second, the data 20"):
        in_this_process("train", "train", *distilling)


def test_a_network_that_knows_a_text_for_every_frame_learns_of_one_that_does_not(work, trained):
    flow = ("denoiser=flow_mdm_small", "denoiser.heads=1", "data/sampling=packed", "data.sampling.texts_per_row=[1,3]")
    own = [setting for setting in training(work) if not setting.startswith(("run=", "denoiser="))]
    taught = (*flow, f"teacher={trained}", "+objective.distilled_guidance=2.5", f"run={work / 'flow'}")
    in_this_process("train", "train", *own, *taught)
    teacher, student = stmc.load(trained), stmc.load(work / "flow")
    assert student.network.per_frame_text and student.own_sampling.guidance == 1
    torch.testing.assert_close(student.motion_statistics.std, teacher.motion_statistics.std, atol=0, rtol=0)
    assert f"Distilled from {trained}" in (work / "flow" / CARD).read_text()
    [motion] = student.generate("walk # 0 # 1\nnod # 1 # 2", method="flow_mdm", seed=0, steps=2)
    assert len(motion) == 40


def test_distilling_needs_a_model_to_distil(work):
    with pytest.raises(
        SettingError, match=r"distilled_guidance=2\.5 needs a model to distil: init_from=RUN or teacher=RUN"
    ):
        in_this_process("train", "train", *training(work), "+objective.distilled_guidance=2.5")
    with pytest.raises(SettingError, match=r"teacher=mdm_smpl_wide needs objective\.distilled_guidance"):
        in_this_process("train", "train", *training(work), "teacher=mdm_smpl_wide")


def test_sampling_writes_each_timeline_s_motion_as_npz_bvh_and_page(sampled):
    folder = sampled
    names = [f"two_{number:04d}_0.{kind}" for number in (0, 1) for kind in ("bvh", "html", "json", "npz")]
    assert sorted(path.name for path in folder.iterdir()) == names
    for name, frames in (("two_0000_0", 40), ("two_0001_0", 20)):
        with np.load(folder / f"{name}.npz", allow_pickle=False) as archive:
            assert archive["poses"].shape == (frames, 156)
            assert archive["joints"].shape == (frames, 24, 3)
            assert float(archive["mocap_framerate"]) == 20
        assert f"Frames: {frames}" in (folder / f"{name}.bvh").read_text()
        page = (folder / f"{name}.html").read_text()
        assert "raise the" in page
        assert stmc.read(folder / f"{name}.npz").frames == frames


def test_sampling_again_makes_nothing_but_what_is_missing(sampled, work, timeline):
    folder = sampled
    (folder / "two_0001_0.bvh").unlink()
    before = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
    in_this_process("sample", "sample", *sampling(work, timeline))
    after = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
    assert "two_0001_0.bvh" in after
    assert {name for name in before if after[name] == before[name]} == {name for name in before if "0000" in name}


# The decisions of the sampling script, without a process each --------------------------------------------------------


@pytest.fixture(scope="module")
def sample():
    return loaded("sample")


def settings(*overrides: str):
    """The record of the settings that are typed."""
    return loaded("sample").main.check(configured("sample", *overrides))


@pytest.fixture
def run(tmp_path) -> Path:
    return stmc.save(tiny(), tmp_path / "run", "")


def job_of(sample, config, timeline: stmc.Timeline, name: str = "nod", seed: int = 0):
    return sample.Job(f"{name}_{seed}", sample.request_of(config, [timeline], [seed]))


def jobs_left(sample, config, timeline: str = TIMELINES.split("\n\n")[1]) -> int:
    seeds, folder = range(config.seed, config.seed + config.samples), sample.open_folder(config)
    jobs = [job_of(sample, config, stmc.Timeline.parse(timeline), seed=seed) for seed in seeds]
    return sum(not folder.is_finished(job) for job in jobs)


def test_a_motion_is_made_again_where_anything_it_depends_on_has_changed(sample, run, tmp_path):
    base = (f"output={tmp_path / 'out'}", f"model={run}", "formats=[npz]", "steps=2")
    config, timeline = settings(*base), stmc.Timeline.parse(TIMELINES.split("\n\n")[1])
    [motion] = tiny().generate(timeline, steps=2)
    sample.open_folder(config).save(motion, job_of(sample, config, timeline))
    assert jobs_left(sample, config) == 0
    for change in ("guidance=2", "overlap=0.6", "method=sinc", "sampler=ddim", "noise_scale=std", "seed=1", "fps=30"):
        assert jobs_left(sample, settings(*base, change)) == 1, change
    assert jobs_left(sample, settings(*base, "clean_feet=false")) == 1
    assert jobs_left(sample, settings(*base[:3], "steps=3")) == 1
    assert jobs_left(sample, settings(*base, "samples=3")) == 2
    assert jobs_left(sample, settings(*base[:2], "steps=2", "formats=[npz,bvh]")) == 1
    assert jobs_left(sample, config, "raise the right arm # 0 # 1.00001 # right arm") == 1
    assert jobs_left(sample, config, "raise the right arm # 0 # 1 # left arm") == 1
    for change in ("batch=3", "device=cpu"):
        assert jobs_left(sample, settings(*base, change)) == 0, change
    moved = run.rename(tmp_path / "moved")
    assert jobs_left(sample, settings(base[0], *base[2:], f"model={moved}")) == 0
    stmc.save(tiny(longest=99), moved, "")
    assert jobs_left(sample, settings(base[0], *base[2:], f"model={moved}")) == 1


def test_feet_are_cleaned_and_files_are_of_all_kinds_where_that_is_asked(sample, run, tmp_path):
    kinds = ["npz", "bvh", "glb", "csv", "xml", "webp"]
    config = settings(
        f"model={run}", f"output={tmp_path}", f"formats=[{','.join(kinds)}]", "clean_feet=true", "fps=5", "steps=2"
    )
    job = job_of(sample, config, stmc.Timeline.parse("nod # 0 # 1"))
    with sample.Progress(disable=True) as progress:
        [motion] = sample.generate(stmc.load(run), [job], progress)
    [raw] = stmc.load(run).generate(job.timeline, steps=2, clean_feet=False)
    assert torch.equal(motion.joints, stmc.clean_feet(raw).joints) and not torch.equal(motion.joints, raw.joints)
    paths = sample.open_folder(config).save(motion, job)
    assert [path.suffix[1:] for path in paths] == kinds and all(path.stat().st_size for path in paths)
    written = stmc.read(tmp_path / "nod_0.npz")
    assert torch.allclose(written.joints, motion.resampled(5).joints, atol=1e-4)


def test_what_is_kept_changed_and_constrained_decides_what_a_motion_becomes(sample, run, tmp_path):
    """By the contents of the files, wherever they are."""
    timeline = stmc.Timeline.parse("walk # 0 # 2")
    [motion] = tiny().generate(timeline, steps=2)
    stmc.write(motion, tmp_path / "old.npz")
    (tmp_path / "beside.json").write_text('[{"heading": {"angle": 1, "start": 1.5}}]')
    base = (f"output={tmp_path / 'out'}", f"model={run}", "formats=[npz]", "steps=2")
    keep = (f"keep={tmp_path / 'old.npz'}", 'change=["1 # 2"]', f"constraints={tmp_path / 'beside.json'}")
    config = settings(*base, *keep)
    folder, job = sample.open_folder(config), job_of(sample, config, timeline, "walk")
    [changed] = tiny().sample(job.request)
    assert (changed.joints - motion.joints)[:20].abs().max() < 1e-5
    assert (changed.joints - motion.joints)[25:35].abs().max() > 1e-3
    folder.save(changed, job)
    assert folder.is_finished(job_of(sample, config, timeline, "walk"))
    for other in (keep[:1], keep[:2], keep[:1] + keep[2:], keep[2:]):
        assert not folder.is_finished(job_of(sample, settings(*base, *other), timeline, "walk"))
    (tmp_path / "beside.json").write_text('[{"heading": {"angle": 2, "start": 1.5}}]')
    assert not folder.is_finished(job_of(sample, config, timeline, "walk"))


def test_the_motion_that_a_keyframe_names_decides_what_a_motion_becomes(sample, run, tmp_path):
    """By its pose: a file of constraints says only where it lies."""
    timeline, pose = stmc.Timeline.parse("walk # 0 # 2"), tmp_path / "pose.npz"
    motions = tiny().generate([timeline] * 2, steps=2)
    stmc.write(motions[0], pose)
    (tmp_path / "beside.json").write_text(json.dumps([{"keyframe": {"motion": str(pose), "at": 1}}]))
    config = settings(f"output={tmp_path}", f"model={run}", f"constraints={tmp_path / 'beside.json'}", "formats=[npz]")
    sample.open_folder(config).save(motions[0], job_of(sample, config, timeline))
    assert sample.open_folder(config).is_finished(job_of(sample, config, timeline))
    stmc.write(motions[1], pose)
    assert not sample.open_folder(config).is_finished(job_of(sample, config, timeline))


def test_a_moved_model_is_the_same_and_another_model_in_its_place_is_not(sample, run, tmp_path):
    before = fingerprint(run)
    moved = run.rename(tmp_path / "moved")
    assert fingerprint(moved) == before
    (moved / WEIGHTS).write_bytes((moved / WEIGHTS).read_bytes()[:-1] + b"\0")
    assert fingerprint(moved) != before


def test_a_motion_whose_record_is_damaged_or_files_are_gone_is_made_again(sample, run, tmp_path):
    config = settings(f"output={tmp_path / 'out'}", f"model={run}", "formats=[npz]", "steps=2")
    timeline = stmc.Timeline.parse(TIMELINES.split("\n\n")[1])
    [motion] = tiny().generate(timeline, steps=2)
    for damage in (lambda out: (out / "nod_0.json").write_text("{"), lambda out: (out / "nod_0.npz").unlink()):
        sample.open_folder(config).save(motion, job_of(sample, config, timeline))
        assert jobs_left(sample, config) == 0
        damage(tmp_path / "out")
        assert jobs_left(sample, config) == 1


def test_a_motion_whose_files_cannot_be_written_is_not_taken_for_finished(sample, run, tmp_path, monkeypatch):
    config = settings(f"output={tmp_path / 'out'}", f"model={run}", "formats=[npz,bvh]", "steps=2")
    timeline = stmc.Timeline.parse(TIMELINES.split("\n\n")[1])
    [motion] = tiny().generate(timeline, steps=2)
    with monkeypatch.context() as patch, pytest.raises(OSError, match="no space"):
        fails = lambda *_, **__: (_ for _ in ()).throw(OSError("no space left on device"))  # noqa: E731
        patch.setattr("stmc.cli.sample_folder.export", fails)
        sample.open_folder(config).save(motion, job_of(sample, config, timeline))
    assert jobs_left(sample, config) == 1
    assert not list((tmp_path / "out").iterdir())


def saved(sample, run, out: Path, *changes: str, seed: int = 0) -> tuple:
    """A motion of `seed` as `stmc sample` puts it into the folder."""
    config = settings(f"output={out}", f"model={run}", "steps=2", *changes)
    timeline = stmc.Timeline.parse(TIMELINES.split("\n\n")[1])
    [motion] = tiny().generate(timeline, steps=2, seed=seed)
    sample.open_folder(config).save(motion, job_of(sample, config, timeline))
    return config, motion


def test_files_of_an_earlier_request_are_removed_or_made_again_and_never_declared_finished(sample, run, tmp_path):
    saved(sample, run, tmp_path / "out", "formats=[npz,bvh]")
    assert jobs_left(sample, saved(sample, run, tmp_path / "out", "formats=[glb]")[0]) == 0
    assert {path.suffix for path in (tmp_path / "out").iterdir()} == {".npz", ".bvh", ".glb", ".json"}, "of one request"
    config, _ = saved(sample, run, tmp_path / "out", "formats=[bvh]", "guidance=2", seed=1)
    assert jobs_left(sample, config) == 0
    assert {path.suffix for path in (tmp_path / "out").iterdir()} == {".bvh", ".json"}, (
        "those of the first request are gone"
    )
    both = settings(f"output={tmp_path / 'out'}", f"model={run}", "steps=2", "guidance=2", "formats=[npz,bvh]")
    assert jobs_left(sample, both) == 1


def test_a_file_that_is_not_its_record_s_is_made_again(sample, run, tmp_path):
    config, _ = saved(sample, run, tmp_path / "out", "formats=[npz,bvh]")
    record = json.loads((tmp_path / "out" / "nod_0.json").read_text())
    assert record["files"] == {
        kind: hashlib.sha256((tmp_path / "out" / f"nod_0.{kind}").read_bytes()).hexdigest() for kind in ("npz", "bvh")
    }
    whole = (tmp_path / "out" / "nod_0.bvh").read_bytes()
    (tmp_path / "out" / "nod_0.bvh").write_bytes(whole.replace(b"1", b"2", 1))
    assert jobs_left(sample, config) == 1
    (tmp_path / "out" / "nod_0.bvh").write_bytes(whole)
    assert jobs_left(sample, config) == 0
    for former in (record | {"files": ["npz"]}, {key: record[key] for key in record if key != "files"}, [1], "x"):
        (tmp_path / "out" / "nod_0.json").write_text(json.dumps(former))
        assert jobs_left(sample, config) == 1


def test_two_runs_in_one_folder_leave_each_motion_with_its_own_record(sample, run, tmp_path):
    """Whoever comes last, a motion and its record are of one request."""

    def put(number: int) -> None:
        config = configs[number % 2]
        sample.open_folder(config).save(motions[number % 2], job_of(sample, config, timeline))

    common = (f"output={tmp_path / 'out'}", f"model={run}", "steps=2", "formats=[npz,bvh,csv]")
    configs = [settings(*common, f"guidance={guidance}") for guidance in (1, 2)]
    timeline = stmc.Timeline.parse(TIMELINES.split("\n\n")[1])
    motions = [tiny().generate(timeline, steps=2, seed=seed)[0] for seed in (0, 1)]
    with ThreadPoolExecutor(4) as pool:
        for _ in range(5):
            list(pool.map(put, range(4)))
            record = json.loads((tmp_path / "out" / "nod_0.json").read_text())
            motion = stmc.read(tmp_path / "out" / "nod_0.npz")
            assert torch.allclose(motion.joints, motions[record["guidance"] - 1].joints, atol=1e-5)
            assert sorted(record["files"]) == ["bvh", "csv", "npz"]
            for kind, digest in record["files"].items():
                assert hashlib.sha256((tmp_path / "out" / f"nod_0.{kind}").read_bytes()).hexdigest() == digest
    assert sorted(path.suffix for path in (tmp_path / "out").iterdir()) == [".bvh", ".csv", ".json", ".npz"]


def test_less_memory_means_smaller_batches_and_the_same_motions(sample, run, tmp_path, monkeypatch):
    config = settings(f"model={run}", "steps=2", "sampler=ddim", "clean_feet=false")
    timelines = [stmc.Timeline.parse("nod # 0 # 1 # head")] * 5
    jobs = [job_of(sample, config, timeline, seed=seed) for seed, timeline in enumerate(timelines)]
    model, tried, sampled = tiny(), [], stmc.Model.sample

    def on_little_memory(self, request, progress):
        tried.append(len(request.timelines))
        if len(request.timelines) > 2:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return sampled(self, request, progress)

    monkeypatch.setattr(stmc.Model, "sample", on_little_memory)
    with sample.Progress(disable=True) as progress:
        made = list(sample.sample_missing(model, jobs, {job.name for job in jobs}, 4, progress))
    assert tried == [4, 2, 2, 1]
    assert [job for job, _ in made] == jobs
    monkeypatch.undo()
    whole = model.generate(timelines, seed=0, steps=2, sampler=stmc.ddim, clean_feet=False)
    for (_, motion), expected in zip(made, whole, strict=True):
        torch.testing.assert_close(motion.joints, expected.joints, atol=1e-4, rtol=0)


def test_in_bf16_a_run_that_goes_on_makes_the_batches_of_one_that_was_not_stopped(sample, run, monkeypatch):
    timelines = [stmc.Timeline.parse(f"nod # 0 # {seconds} # head") for seconds in (2, 2, 1)]
    config, tried = settings(f"model={run}", "steps=2"), []
    jobs = [job_of(sample, config, timeline, seed=seed) for seed, timeline in enumerate(timelines)]

    def watched(self, request, progress):
        tried.append(list(request.seeds))
        return [standing_still(number + 1) for number in request.seeds]

    monkeypatch.setattr(stmc.Model, "sample", watched)
    for precision, expected in (("bf16", [[0, 1]]), ("fp32", [[1]])):
        tried.clear()
        with sample.Progress(disable=True) as progress:
            made = list(sample.sample_missing(replace(tiny(), precision=precision), jobs, {"nod_1"}, 2, progress))
        assert tried == expected
        assert [(job.name, len(motion)) for job, motion in made] == [("nod_1", 2)]


def test_sampling_tells_each_motion_in_a_line_and_writes_the_frame_rate_that_was_asked_for(
    sample, run, tmp_path, capsys
):
    output = tmp_path / "out"
    asked = ("nod # 0 # 1 # head", str(output), f"model={run}", "steps=2", "samples=2", "fps=30", "formats=bvh,npz")
    assert sample.main([*asked]) == 0
    told = capsys.readouterr()
    assert told.err == ""
    assert [line.partition(":")[0] for line in told.out.splitlines()] == [
        "nod_0",
        "nod_1",
        "motions in " + str(output),
    ]
    assert "Frame Time: 0.0333" in (output / "nod_0.bvh").read_text()
    assert stmc.read(output / "nod_1.npz").fps == 30
    assert sample.main([*asked, "--json", "samples=3"]) == 0
    [line] = capsys.readouterr().out.splitlines()
    line = json.loads(line)
    assert (line["name"], line["seed"], line["files"]) == (
        "nod_2", 2, [str(output / f"nod_2.{kind}") for kind in ("bvh", "npz")]
    )  # fmt: skip


def test_a_typed_timeline_never_replaces_another(sample, run, tmp_path):
    output = tmp_path / "out"

    def written(timeline: str, *more: str) -> set[str]:
        output.mkdir(exist_ok=True)
        before = {path.name: path.read_bytes() for path in output.iterdir()}
        assert sample.main([timeline, str(output), f"model={run}", "steps=1", "formats=bvh", *more]) == 0
        assert {name: (output / name).read_bytes() for name in before} == before
        return {path.stem for path in output.iterdir()} - {name.rpartition(".")[0] for name in before}

    assert written("nod # 0 # 1 # head") == {"nod_0"}
    assert written("shake # 0 # 1 # head") == {"shake_0"}
    assert written("nod # 0 # 1.5 # head") == {"nod-2_0"}
    assert written("nod # 0 # 1 # head", "samples=2") == {"nod_1"}
    assert written("nod # 0 # 1.5 # head") == set()
    assert written("nod # 0 # 1.25", "suggest_parts=true") == {"nod-3_0"}
    assert written("nod # 0 # 1.25", "suggest_parts=true") == set()


def test_sampling_runs_with_a_folder_of_one_s_own_configurations(sample, run, tmp_path):
    (tmp_path / "configs").mkdir()
    given = [f"model={run}", "--config-dir", str(tmp_path / "configs"), "steps=1", "formats=bvh"]
    assert sample.main(["nod # 0 # 1 # head", str(tmp_path / "out"), *given]) == 0
    assert (tmp_path / "out" / "nod_0.bvh").exists()


@pytest.mark.parametrize(
    ("formats", "told"),
    [
        (["npz"], ""),
        (["npz", "bvh"], ": open .bvh in Blender"),
        (["npz", "glb", "bvh", "html"], ": open .glb or .bvh in Blender, .html in a browser"),
    ],
)
def test_the_last_line_names_programs_for_the_formats_that_were_written(sample, formats, told):
    assert sample.hint(formats) == told


def test_a_text_without_seconds_is_answered_with_the_form_of_a_timeline(sample, tmp_path, capsys):
    assert sample.main(["walk", str(tmp_path)]) == 2
    assert "timeline='walk': no such file; with its seconds it is a timeline: 'walk # 0 # 4'" in capsys.readouterr().err


def test_a_log_hears_of_the_steps_now_and_then(sample, monkeypatch):
    monkeypatch.setattr(sample, "LOG_SECONDS", 0)
    console = sample.Console(file=io.StringIO())
    with sample.progress_bars(console) as progress:
        task = progress.add_task("", total=3)
        assert list(sample.track_steps(range(3), 3, progress, task, 8)) == [0, 1, 2]
    assert "denoising 8: step 3 of 3" in console.file.getvalue()


def test_the_page_shows_the_transitions_that_were_sampled(sample, run, tmp_path):
    two = "walk # 0 # 2 # legs\nrun # 2 # 4 # legs"
    common = (two, f"model={run}", "steps=2", "formats=html")
    for number, (setting, width) in enumerate((("overlap=0.5", 0.5), ("overlap=1", 1.0), ("method=sinc", None))):
        output = tmp_path / str(number)
        assert sample.main([*common, f"output={output}", setting]) == 0
        page = (output / "walk_run_0.html").read_text()
        spans = re.findall(r'class="span change"[^>]*style="left:([\d.]+)%;width:([\d.]+)%', page)
        assert {round(4 * float(span) / 100, 2) for _, span in spans} == ({width} if width else set())


def test_the_page_shows_the_constraints_that_were_sampled_with(sample, run, tmp_path):
    path = tmp_path / "constraints.json"
    path.write_text('[{"heading": {"angle": 0.5, "start": 0.5, "end": 1}}]')
    common = ("walk # 0 # 2", f"model={run}", "steps=2", "formats=html", f"output={tmp_path}", f"constraints={path}")
    assert sample.main([*common]) == 0
    assert re.search(r'>heading</div><div class="row part demand"', (tmp_path / "walk_0.html").read_text())


def test_the_record_of_a_motion_can_be_read_by_people(sampled):
    record = json.loads((sampled / "two_0000_0.json").read_text())
    assert record["seed"] == 0
    assert record["prompts"][0] == ["walk forwards", 0.0, 2.0, ["legs"]]
