"""Clips made by editing prepared recordings: reproducible, mirrored, split by their recordings, and never trimmed."""

import dataclasses

import numpy as np
import pytest
import torch
from helpers.motions import walking

from stmc.data import preparation
from stmc.data.cache import Cache, Clip
from stmc.data.preparation import LayoutError
from stmc.data.sources.cmu.cmu_clips import encode_above_floor
from stmc.data.sources.contents import CONTENTS
from stmc.data.sources.edited import RECIPES, edited_clips
from stmc.data.sources.edited.edited_clips import EditedClips, RecordedBases, make
from stmc.data.sources.edited.recipe import Draft, Recipe, Unusable
from stmc.data.sources.edited.strides import repeat_strides
from stmc.editing import change_pace
from stmc.motion.body_model import Skeleton
from stmc.motion.motion import Motion
from stmc.motion.representation.smpl import SmplRepresentation
from stmc.settings.records import SettingError

BODY = Skeleton(Skeleton.default().offsets.double())


def recorded(splits=("train", "train", "val", "test"), content="walk") -> Cache:
    """Walks of four recordings, each with its mirror image."""
    clips, features, start = [], [], 0
    for number, split in enumerate(splits):
        for mirrored in (False, True):
            motion = walking(seconds=4.0, turn=0.0, speed=1.0 + 0.1 * number)
            motion = motion.mirrored() if mirrored else motion
            rows = encode_above_floor(Motion.posed(motion.rotations, motion.translation, motion.fps, BODY))
            name = f"{'M/' if mirrored else ''}0{number}_01/0"
            place = {"start": start, "end": start + len(rows)}
            clips.append(Clip(name, content, "normal", "key", ("legs",), True, mirrored, split, **place))
            features.append(rows)
            start += len(rows)
    return Cache(20, "smpl", torch.cat(features), tuple(clips), {"key": (("walk", 1.0),)})


def in_turn(jobs, workers):
    """As `in_parallel`, in this process."""
    for name, job in jobs:
        try:
            yield name, job and job[0](*job[1:])
        except ValueError as error:
            yield name, str(error)


def slower(bases, rng) -> Draft:
    base = bases["walk"][rng.integers(len(bases["walk"]))]
    return Draft(change_pace(base.motion, tempo=rng.uniform(0.7, 0.9)), base.recording)


SLOW = Recipe("walk-slow", "edited", slower, lambda motion: True, clips=6, once=False)


def test_bases_are_the_unmirrored_clips_as_they_were_recorded():
    bases = RecordedBases(recorded())
    assert list(bases) == ["walk"] and len(bases["walk"]) == 4
    assert {base.recording: bases.splits[base.recording] for base in bases["walk"]} == {
        "00_01": "train", "01_01": "train", "02_01": "val", "03_01": "test",
    }  # fmt: skip
    motion = bases["walk"][0].motion
    assert motion.joints.dtype == torch.float64 and motion.fps == 20
    whole = SmplRepresentation().encode(walking(seconds=4.0, turn=0.0, speed=1.0))
    assert torch.allclose(SmplRepresentation().encode(motion)[:, 1:], whole[:, 1:], atol=1e-5)


def test_a_clip_depends_on_its_name_alone_and_every_one_has_a_mirror_image():
    bases = RecordedBases(recorded())
    rows, skipped = make(SLOW, bases, bases.splits, 20)
    again, _ = make(dataclasses.replace(SLOW, clips=3), bases, bases.splits, 20)
    assert not skipped and len(rows) == 12 and len(again) == 6
    for (clip, features), (same, others) in zip(rows, again, strict=False):
        assert clip == same and torch.equal(features, others)
    for (clip, features), (image, reflected) in zip(rows[::2], rows[1::2], strict=True):
        assert (image.name, image.mirrored, image.split) == (f"M/{clip.name}", True, clip.split)
        motion, other = (SmplRepresentation().decode(each.double(), 20, BODY) for each in (features, reflected))
        assert (motion.mirrored().joints - other.joints).abs().max() < 1e-4


def test_instruments_have_no_mirror_images():
    bases = RecordedBases(recorded())
    rows, _ = make(dataclasses.replace(SLOW, clips=3, mirrors=False), bases, bases.splits, 20)
    assert len(rows) == 3 and not any(clip.mirrored for clip, _ in rows)
    assert {recipe.action for recipe in RECIPES if not recipe.mirrors} == {"guitar", "violin"}


def test_a_clip_is_kept_from_training_with_its_recording():
    bases = RecordedBases(recorded())
    rows, _ = make(dataclasses.replace(SLOW, clips=30), bases, bases.splits, 20)
    for clip, _ in rows:
        assert clip.split == bases.splits[clip.name.rpartition("/")[2]]
    assert {clip.split for clip, _ in rows} == {"train", "val", "test"}


def test_clips_know_their_origin_and_whether_they_begin_at_their_start():
    bases = RecordedBases(recorded())
    for origin, once, expected in (("edited", False, False), ("edited", True, True), ("authored", False, True)):
        recipe = dataclasses.replace(SLOW, origin=origin, once=once, clips=1)
        [(clip, _), _] = make(recipe, bases, bases.splits, 20)[0]
        assert (clip.style, clip.from_start, clip.content) == (origin, expected, "walk-slow")


def test_feet_are_clean_and_stand_on_the_floor():
    bases = RecordedBases(recorded())
    rows, _ = make(SLOW, bases, bases.splits, 20)
    for _, features in rows:
        motion = SmplRepresentation().decode(features.double(), 20, BODY)
        assert -0.02 < float(motion.joints[..., 2].min()) < 0.06


def test_a_draw_that_is_not_usable_is_drawn_again_and_a_clip_that_never_is_gets_named():
    bases, seen = RecordedBases(recorded()), []

    def moody(bases, rng) -> Draft:
        seen.append(1)
        if len(seen) % 3 == 1:
            raise Unusable("too short")
        if len(seen) % 3 == 2:
            raise SettingError("no path")
        return slower(bases, rng)

    rows, skipped = make(dataclasses.replace(SLOW, make=moody, clips=2), bases, bases.splits, 20)
    assert len(rows) == 4 and not skipped and len(seen) == 6
    never = dataclasses.replace(SLOW, accept=lambda motion: False, clips=2)
    with pytest.raises(ValueError, match="none of 2 clips could be made: none of 40 draws is usable"):
        make(never, bases, bases.splits, 20)


def test_preparing_takes_several_folders_and_says_what_is_wrong(tmp_path, monkeypatch):
    recorded().write(tmp_path / "one")
    recorded(content="run").write(tmp_path / "two")
    monkeypatch.setattr(edited_clips, "RECIPES", (SLOW,))
    both = EditedClips(f"{tmp_path / 'one'},{tmp_path / 'two'}")
    assert both.check() == EditedClips([tmp_path / "one", tmp_path / "two"]).check()
    assert both.fingerprint() != EditedClips(tmp_path / "one").fingerprint()
    monkeypatch.setattr(preparation, "in_parallel", in_turn)
    cache = both.prepared(tmp_path, 1, lambda jobs, total: jobs)
    assert {clip.content for clip in cache.clips} == {"walk-slow"} and len(cache.clips) == 12
    cache.write(tmp_path / "made")
    assert Cache.read(tmp_path / "made").clips == cache.clips
    for source in ("", str(tmp_path / "none")):
        with pytest.raises(LayoutError):
            EditedClips(source).check()
    dataclasses.replace(recorded(), representation="humanml3d").write(tmp_path / "other")
    with pytest.raises(ValueError, match="205 features"):
        EditedClips(tmp_path / "other").prepared(tmp_path, 1, lambda jobs, total: jobs)


def test_every_recipe_is_of_an_action_and_no_two_have_one_name():
    names = [(recipe.action, recipe.origin) for recipe in RECIPES]
    assert len(set(names)) == len(names) and all(action in CONTENTS for action, _ in names)
    assert all(recipe.clips >= 20 and recipe.origin in ("recorded", "edited", "authored") for recipe in RECIPES)
    assert all(not recipe.once or not CONTENTS[recipe.action].cyclic for recipe in RECIPES)


def test_a_recipe_s_clips_are_those_of_other_seeds():
    bases = RecordedBases(recorded())
    rows, _ = make(SLOW, bases, bases.splits, 20)
    assert len({len(features) for _, features in rows}) > 2
    assert np.unique([clip.name for clip, _ in rows]).size == len(rows)


def test_repeated_strides_walk_on_as_the_same_walk_would():
    short, long = walking(seconds=3.0, turn=0.0), walking(seconds=9.0, turn=0.0)
    repeated = repeat_strides(short, 9.0)
    assert repeated.frames == long.frames
    ahead = repeated.translation[-1, :2] - repeated.translation[0, :2]
    assert torch.allclose(ahead, long.translation[-1, :2] - long.translation[0, :2], atol=0.3), "9.8 metres ahead"
    longest_steps = [float(motion.joints.diff(dim=0).norm(dim=-1).max()) for motion in (repeated, short)]
    assert longest_steps[0] < 1.1 * longest_steps[1], "no jump at a seam"
    assert torch.equal(repeat_strides(long, 3.0).joints, long.joints)


def test_a_motion_without_two_frames_of_one_phase_cannot_be_repeated():
    with pytest.raises(Unusable, match="of one phase"):
        repeat_strides(walking(seconds=0.7, turn=0.0), 5.0)
