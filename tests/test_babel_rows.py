"""BABEL's rows of consecutive actions: which follow each other, where they meet, what features they have, and what a
training batch is made of."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.joblib_files import joblib_bytes
from helpers.scripts import configured, run
from helpers.source_folders import Serial, amass, babel, recorded, smplh_arrays
from helpers.toy_data import LetterCounts
from hydra.utils import instantiate
from torch.testing import assert_close

from stmc.data import preparation
from stmc.data.cache import Cache
from stmc.data.preparation import LayoutError
from stmc.data.sources.amass.amass_recordings import read_recording
from stmc.data.sources.babel.babel_rows import chains, consecutive, read_babel_labels
from stmc.data.sources.babel.composition_references import babel_references
from stmc.motion.body_model import Skeleton
from stmc.motion.representation import BabelRepresentation
from stmc.run import load
from stmc.training.data.batches import ClipBatches
from stmc.training.data.dataset import NULL, Dataset
from stmc.training.data.pair_batches import PairBatches
from stmc.training.data.recorded_rows import RecordedRows

REPRESENTATION = BabelRepresentation()
WALK, SIT, RISE, LEAD = "walk", "sit", "rise", "transition"


# Which follow each other ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("labels", "expected"),
    [
        ({(0, 50): WALK}, []),
        ({(0, 50): WALK, (45, 90): SIT}, [((0, 50), (45, 90))]),
        ({(0, 50): WALK, (60, 90): SIT}, []),
        ({(0, 50): WALK, (50, 60): LEAD, (60, 90): SIT}, [((0, 50), (60, 90))]),
        ({(0, 10): LEAD, (10, 60): WALK}, [((0, 10), (10, 60))]),
        ({(0, 50): WALK, (10, 40): SIT}, []),
        ({(0, 150): WALK, (140, 260): SIT}, [((0, 150),)]),
        (
            {(0, 50): WALK, (50, 90): SIT, (90, 150): RISE},
            [((0, 50), (50, 90), (90, 150)), ((50, 90), (90, 150))],
        ),
        (
            {(0, 50): WALK, (40, 60): LEAD, (60, 90): SIT, (90, 270): RISE},
            [((0, 50), (60, 90)), ((60, 90),)],
        ),
        (
            {(0, 50): WALK, (40, 90): SIT, (45, 95): RISE},
            [((0, 50), (40, 90), (45, 95)), ((0, 50), (45, 95)), ((40, 90), (45, 95))],
        ),
    ],
)
def test_rows_are_actions_that_overlap_or_that_a_transition_joins(labels, expected):
    """By hand; the longest row has 200 frames."""
    assert sorted(chains(labels, 200)) == sorted(expected)


def test_a_row_has_ten_texts_at_most():
    labels = {(10 * number, 10 * number + 11): f"{number}" for number in range(14)}
    assert max(map(len, chains(labels, 200))) == 10


def test_two_actions_meet_in_the_middle_of_what_they_share_or_of_what_lies_between():
    """As the published code has it, whose spans include their last frame: the middle one belongs to the first."""
    assert consecutive([(0, 50)]) == [0, 50]
    assert consecutive([(0, 50), (60, 90)]) == [0, 56, 90]
    assert consecutive([(5, 50), (40, 90), (90, 120)]) == [5, 46, 91, 120]


# Labels ---------------------------------------------------------------------------------------------------------------


def test_labels_are_processed_ones_of_frames_with_their_transitions_and_spelt_right(tmp_path):
    folder = babel(tmp_path / "texts")
    (tmp_path / "spelling.json").write_text(json.dumps({"raise right arm": "lift"}))
    found = read_babel_labels(folder, tmp_path / "spelling.json")
    [entry] = found.entries
    assert [(each.text, each.start, each.end) for each in entry.segments] == [
        ("walk", 0.0, 1.5), ("transition", 1.5, 1.75), ("lift", 1.75, 3.0)
    ]  # fmt: skip
    assert (entry.split, entry.mirrored) == ("train", False) and found.skipped == (("2", "no labels of frames"),)


@pytest.mark.parametrize("content", ["[", '["a"]', '{"a": 3}'])
def test_corrections_that_are_none_are_an_error(content, tmp_path):
    (tmp_path / "spelling.json").write_text(content)
    with pytest.raises(LayoutError, match=r"spelling\.json"):
        read_babel_labels(babel(tmp_path / "texts"), tmp_path / "spelling.json")


def test_a_label_that_cannot_be_meant_is_named_and_the_others_stay(tmp_path):
    folder = babel(tmp_path)
    content = json.loads((folder / "train.json").read_text())
    content["1"]["frame_ann"]["labels"][1]["end_t"] = "soon"
    (folder / "train.json").write_text(json.dumps(content))
    found = read_babel_labels(folder)
    assert len(found.entries[0].segments) == 2
    assert ("1", "label 'transition': start_t 1.5 and end_t 'soon' must be seconds") in found.skipped


# Features -------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    return amass(tmp_path_factory.mktemp("amass"))


@pytest.fixture(scope="module")
def folder(source, tmp_path_factory):
    """The cache as the command makes it, of a recording for training and of the same for validation."""
    place = tmp_path_factory.mktemp("rows")
    labels = json.loads((babel(place / "texts") / "train.json").read_text())
    (place / "texts" / "val.json").write_text(json.dumps({"2": labels["1"]}))
    config = configured("prepare", "data=babel_flow")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(preparation, "ProcessPoolExecutor", Serial)
        preparing = instantiate(config.data.preparation, source=source, annotations=place / "texts")
        preparing.check()
        made = preparing.prepared(place / "pieces", 1, lambda pieces, total: pieces)
    replace(made, fingerprint="rows").write(place / "cache")
    return place / "cache"


def recording(source):
    path = source / "KIT/3/kick_high_left02_poses.npz"
    return read_recording(path, Skeleton.default()).resampled(30)


def test_a_row_for_training_has_the_features_of_a_motion_that_begins_with_it(folder, source):
    cache, motion = Cache.read(folder), recording(source)
    rows = [clip for clip in cache.clips if clip.split == "train"]
    assert [(clip.content, clip.texts and cache.texts[clip.texts][0][0]) for clip in rows] == [
        ("1-0", "walk"), ("1-0", "raise right arm")
    ]  # fmt: skip
    assert rows[0].end == rows[1].start and cache.fps == 30
    # 0 to 1.5 s and 1.75 to 3 s, or 45 and 52 to 90 frames: the middle of the gap is 45 + 7 // 2.
    assert [clip.end - clip.start for clip in rows] == [49, 41]
    features = cache.features[rows[0].start : rows[1].end]
    assert_close(features, REPRESENTATION.encode(motion.trimmed(0, 90)).float(), atol=1e-4, rtol=0)


def test_for_evaluation_there_are_single_actions_and_the_whole_recording_as_it_stands(folder, source):
    cache, motion = Cache.read(folder), recording(source)
    *single, whole = (clip for clip in cache.clips if clip.split == "val")
    assert [cache.texts[clip.texts][0][0] for clip in single] == ["walk", "transition", "raise right arm"]
    last = cache.features[single[2].start : single[2].end]
    assert_close(last, REPRESENTATION.encode(motion.trimmed(52, 90)).float(), atol=1e-4, rtol=0)
    assert cache.texts[whole.texts] == ()
    stands = REPRESENTATION.differentiate(motion.rotations, motion.translation).float()
    assert_close(cache.features[whole.start : whole.end], stands, atol=1e-4, rtol=0)
    found = babel_references(folder)
    assert [clip.captions[0].text for clip in found.clips] == ["walk", "raise right arm"]
    assert len(found.windows) == len(motion) // 30


# TEACH's processed recordings -----------------------------------------------------------------------------------------


def processed(folder, name: str = "KIT/KIT/3/kick_high_left02_poses.npz", **changes):
    """The folder that TEACH's authors share, with one recording, at 30 frames a second."""
    arrays = smplh_arrays(recorded(0, 30.0))
    entry = {"poses": arrays["poses"], "trans": arrays["trans"], "fps": 30, "fname": name, "babel_id": "1"}
    entry |= {"joint_positions": np.zeros((len(arrays["poses"]), 73, 3))}
    folder.mkdir()
    (folder / "train.pth.tar").write_bytes(joblib_bytes([entry | changes], None))
    return folder


def prepared(source, texts, scratch, config: str = "babel_flow_processed") -> Cache:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(preparation, "ProcessPoolExecutor", Serial)
        preparing = instantiate(configured("prepare", f"data={config}").data.preparation, source, texts)
        preparing.check()
        return preparing.prepared(scratch, 1, lambda pieces, total: pieces)


def test_processed_recordings_give_the_rows_that_amass_s_own_give(tmp_path):
    """The same movement, as AMASS's file at 30 frames a second and as TEACH's processed one, gives the same cache."""
    texts, file = babel(tmp_path / "texts"), tmp_path / "amass/KIT/3/kick_high_left02_poses.npz"
    file.parent.mkdir(parents=True)
    np.savez(file, **smplh_arrays(recorded(0, 30.0)))
    expected = prepared(tmp_path / "amass", texts, tmp_path / "pieces", "babel_flow")
    found = prepared(processed(tmp_path / "teach"), texts, tmp_path / "others")
    assert found.clips == expected.clips and len(found.clips) == 2 and found.fps == 30
    assert torch.equal(found.features, expected.features)


def test_what_processed_files_lack_is_named(tmp_path):
    texts = babel(tmp_path / "texts")
    labels = json.loads((texts / "train.json").read_text())
    other = labels["1"] | {"feat_p": "CMU/CMU/01/01_01_poses.npz"}
    (texts / "train.json").write_text(json.dumps(labels | {"3": other}))
    skipped = prepared(processed(tmp_path / "teach"), texts, tmp_path / "pieces").skipped
    assert ("3", "not in train.pth.tar: CMU/01/01_01_poses") in skipped
    with pytest.raises(LayoutError, match=r"has none of the 2 annotated recordings.*found SFU/SFU/1/walk\.npz"):
        prepared(processed(tmp_path / "other", "SFU/SFU/1/walk.npz"), texts, tmp_path / "pieces")
    with pytest.raises(LayoutError, match=r"expected train\.pth\.tar and val\.pth\.tar"):
        prepared(texts, texts, tmp_path / "pieces")
    (tmp_path / "teach/val.pth.tar").write_bytes(b"cos\nsystem\n.")
    with pytest.raises(LayoutError, match=r"val\.pth\.tar: refused to run os\.system"):
        prepared(tmp_path / "teach", texts, tmp_path / "pieces")


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"poses": np.full((96, 156), np.nan)}, "not finite: poses from frame 0 on"),
        ({"poses": np.zeros((96, 72))}, "wrong variant: poses has 72 columns"),
        ({"trans": np.zeros((4, 3))}, "wrong shape"),
        ({"fps": 0}, "absurd frame rate"),
    ],
)
def test_processed_recordings_that_cannot_be_used_are_named(changes, reason, tmp_path):
    texts = babel(tmp_path / "texts")
    (texts / "val.json").write_text((texts / "train.json").read_text())
    with pytest.raises(ValueError, match=f"no clip could be used.*1: {reason}"):
        prepared(processed(tmp_path / "teach", **changes), texts, tmp_path / "pieces")


# Batches --------------------------------------------------------------------------------------------------------------


class OneWord(LetterCounts):
    """The first word of each text."""

    def encode(self, texts):
        words, lengths = super().encode(texts)
        return words[:, :1], torch.ones_like(lengths)


def several(folder, rows: int = 7) -> Cache:
    """The row many times over, under other names."""
    cache = Cache.read(folder)
    row = [clip for clip in cache.clips if clip.split == "train"]
    clips = [replace(clip, content=f"{number}", name=f"{clip.name}/{number}") for number in range(rows) for clip in row]
    return replace(cache, clips=(*clips, *(clip for clip in cache.clips if clip.split == "val")))


def batches(cache: Cache, encoder=None, **settings) -> ClipBatches:
    dataset = Dataset(cache, encoder or OneWord(), REPRESENTATION.layout, min_clips=0)
    return ClipBatches(dataset, "train", RecordedRows(**settings))


def test_a_row_of_a_batch_is_all_its_clips_with_their_texts_as_they_were_recorded(folder):
    cache = several(folder)
    made = batches(cache, rows=3, text_dropout=0.0)
    [plan] = made.plans(0)
    assert plan.row.tolist() == [0, 0, 1, 1, 2, 2] and not plan.fade.any()
    [batch] = made(0)
    row = [clip for clip in cache.clips if clip.split == "train"][:2]
    features = made.dataset.motion.normalise(cache.features[row[0].start : row[1].end])
    assert_close(batch.motion, features.expand(3, -1, -1), atol=1e-5, rtol=0)
    assert batch.segment.tolist() == [[0] * 49 + [1] * 41] * 3
    assert batch.text.shape[1] == 2 and not torch.equal(batch.text[0, 0], batch.text[0, 1])


def test_every_row_comes_once_an_epoch_and_texts_are_dropped_each_by_itself(folder):
    made = batches(several(folder, 40), rows=8, text_dropout=0.25)
    plans = [plan for step in range(5) for plan in made.plans(step)]
    contents = [made.dataset.clips[clip].content for plan in plans for clip in plan.body.clip[::2]]
    assert sorted(contents, key=int) == [f"{number}" for number in range(40)]
    dropped = np.concatenate([plan.sentence == NULL for plan in plans]).reshape(-1, 2)
    assert 0.1 < dropped.mean() < 0.4 and (dropped[:, 0] != dropped[:, 1]).any()


def test_rows_of_several_texts_are_refused_where_they_cannot_be_read(folder):
    with pytest.raises(ValueError, match="RecordedRows needs a text encoder that returns one word per text"):
        batches(several(folder), LetterCounts(), rows=3)
    with pytest.raises(ValueError, match="pairs need one text per row: RecordedRows makes rows of several"):
        PairBatches(batches(several(folder), rows=3))


# Settings -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "steps", "window", "absolute", "guidance", "frames"),
    [("babel", 1_300_000, 100, 124, 1.5, (30, 200)), ("humanml3d", 500_000, 150, 59, 2.5, (70, 199))],
)
def test_the_trainings_are_the_papers_setting_by_setting(name, steps, window, absolute, guidance, frames):
    config = configured(f"train_flow_{name}")
    training, recipe = config.training, instantiate(config.data.sampling)
    assert (training.steps, training.lr, training.final_lr_ratio, training.warmup) == (steps, 1e-4, 1.0, 0)
    assert (training.weight_decay, training.grad_clip, training.ema_decay, training.precision) == (0, None, 0, "fp32")
    assert (recipe.rows, recipe.text_dropout, recipe.drop_last) == (64, 0.1, True)
    assert (getattr(recipe, "uncond_crop_prob", 0.0), getattr(recipe, "trim", 0.0)) == (0.0, 0.0)
    assert (config.guidance, config.noise_scale, config.schedule.steps) == (guidance, "std", 1000)
    network = config.denoiser
    assert (1000 - network.absolute_from, network.attention_window) == (absolute, window)
    assert (network.width, network.layers, network.heads, network.feedforward) == (512, 8, 4, 1024)
    assert (network.dropout, network.stochastic_depth, network.positions) == (0.1, 0.1, "blended")
    lengths = config.data.preparation.shortest, config.data.preparation.get("longest", 199)
    fps = config.data.preparation.get("fps", 1)
    assert tuple(round(each * fps) for each in lengths) == frames


@pytest.mark.slow
def test_the_command_trains_on_the_rows_and_the_run_samples_several_texts(folder, tmp_path):
    cache = several(folder)
    held_out = [replace(clip, split="val", content="held out") for clip in cache.clips[:2]]
    replace(cache, clips=(*cache.clips, *held_out)).write(tmp_path / "cache")
    sizes = {"width": 16, "feedforward": 32, "layers": 1, "heads": 2}
    settings = [f"denoiser.{name}={value}" for name, value in sizes.items()]
    settings += [f"run={tmp_path / 'run'}", f"data.folder={tmp_path / 'cache'}", f"text_cache={tmp_path / 'texts'}"]
    settings += ["device=cpu", "threads=1", "training.steps=2", "validation=1"]
    settings += ["draw=['w # 0 # 1']", "data.sampling.rows=3"]
    run("train", "train_flow_babel", "text_encoder=minilm", "~text_encoder.encoder", *settings)
    model = load(tmp_path / "run")
    assert (model.fps, model.longest, model.own_sampling.guidance) == (30, 200, 1.5)
    assert model.own_sampling.ape_steps == 0.124
    [motion] = model.generate("walk # 0 # 1\nsit # 1 # 2", steps=2, method="flow_mdm")
    assert motion.frames == 60
