"""Films: as many pictures as frames, as long as the motion, drawn without a display, and read by pillow."""

import importlib.util
from itertools import pairwise

import numpy as np
import pytest
from helpers.motions import walking
from PIL import Image

from stmc.timeline import Timeline
from stmc.viewing import render_film

WALK = walking(seconds=1.0).trimmed(0, 12)
TIMELINE = Timeline.parse("walk # 0 # 0.6\nwave with $x # 0.2 # 0.6 # right arm")


def frames(path) -> list[np.ndarray]:
    with Image.open(path) as image:
        shown = []
        for number in range(image.n_frames):
            image.seek(number)
            shown.append(np.asarray(image.convert("RGB")).astype(int))
        return shown


@pytest.mark.parametrize("kind", ["webp", "gif"])
def test_a_film_has_a_picture_for_every_frame_and_moves(kind, tmp_path):
    drawn = []

    def progress(pictures, total):
        drawn.append(total)
        for picture in pictures:
            yield picture
            drawn.append(total)

    render_film(WALK, tmp_path / f"walk.{kind}", TIMELINE, fps=5, progress=progress)
    assert drawn == [3, 3, 3, 3]
    pictures = frames(tmp_path / f"walk.{kind}")
    assert len(pictures) == 3
    assert all(np.abs(one - other).mean() > 0.2 for one, other in pairwise(pictures))
    with Image.open(tmp_path / f"walk.{kind}") as image:
        assert image.size == (480, 560)
        durations = []
        for number in range(image.n_frames):
            image.seek(number)
            image.load()
            durations.append(image.info["duration"])
    assert sum(durations) == 600
    assert [path.name for path in tmp_path.iterdir()] == [f"walk.{kind}"]


def test_a_video_is_written_where_ffmpeg_is_and_refused_with_a_reason_where_it_is_not(tmp_path):
    if importlib.util.find_spec("imageio_ffmpeg") is None:
        with pytest.raises(ModuleNotFoundError, match=r"stmc\[film\]"):
            render_film(WALK, tmp_path / "walk.mp4")
        assert not list(tmp_path.iterdir())
        return
    import imageio_ffmpeg

    render_film(WALK, tmp_path / "walk.mp4", TIMELINE)
    count, seconds = imageio_ffmpeg.count_frames_and_secs(str(tmp_path / "walk.mp4"))
    assert (count, seconds) == (WALK.frames, pytest.approx(WALK.duration, abs=0.06))


def test_a_film_whose_drawing_is_interrupted_leaves_the_file_of_before_and_nothing_else(tmp_path):
    def interrupted(pictures, total):
        yield next(pictures)
        raise InterruptedError

    path = tmp_path / "walk.webp"
    path.write_bytes(b"of before")
    with pytest.raises(InterruptedError):
        render_film(WALK, path, fps=2, progress=interrupted)
    assert list(tmp_path.iterdir()) == [path] and path.read_bytes() == b"of before"


def test_another_suffix_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"'\.avi'; choose from \.webp"):
        render_film(WALK, tmp_path / "walk.avi")


@pytest.mark.parametrize("kind", ["webp", "gif"])
def test_an_animation_of_too_many_pictures_is_refused_before_one_is_drawn(kind, tmp_path):
    with pytest.raises(ValueError, match=rf"a \.{kind} film has at most 1,200 pictures, not 1,201; film as \.mp4"):
        render_film(walking(seconds=60.05), tmp_path / f"walk.{kind}")
    assert list(tmp_path.iterdir()) == []
