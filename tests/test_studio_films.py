"""Films of the studio: their queue, their files, and that a cancelled one leaves nothing."""

import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.motions import walking
from helpers.studio import draw_nothing

from stmc.viewing.studio.films import Films
from stmc.viewing.studio.request_errors import RequestError

WALK = walking(seconds=0.5)


class Held:
    """A renderer that waits behind its first picture until it may go on, and writes a file behind the last."""

    def __init__(self) -> None:
        self.began, self.may, self.path = threading.Event(), threading.Event(), None

    def __call__(self, motion, path, timeline, progress) -> None:
        def waiting(pictures, total):
            for picture in progress(pictures, total=total):
                self.began.set()
                assert self.may.wait(timeout=60)
                yield picture

        self.path = path
        draw_nothing(motion, path, timeline, waiting)


@pytest.fixture
def held(tmp_path) -> Iterator[tuple[Held, Films]]:
    render = Held()
    films = Films(tmp_path, render)
    yield render, films
    render.may.set()
    films.close()


def files(folder: Path) -> list[Path]:
    return sorted(folder.iterdir())


def test_a_film_counts_its_pictures_and_has_a_file_once_it_is_done(held, tmp_path):
    render, films = held
    job = films.add(WALK, "webp")
    assert render.began.wait(timeout=60)
    assert job.events == [("progress", {"stage": "film", "step": 0, "steps": WALK.frames})]
    with pytest.raises(RequestError, match="not complete"):
        films.path(job.name)
    render.may.set()
    films.wait()
    last = {"stage": "film", "step": WALK.frames, "steps": WALK.frames}
    assert job.events == [("progress", last), ("done", {})]
    assert films.path(job.name).read_bytes() == b"film" and files(tmp_path) == [films.path(job.name)]


def test_a_cancelled_film_ends_before_its_next_picture_and_leaves_nothing(held, tmp_path):
    render, films = held
    running, waiting = films.add(WALK, "webp"), films.add(WALK, "gif")
    assert render.began.wait(timeout=60)
    assert len(files(tmp_path)) == 1 and files(tmp_path) != [render.path], "a temporary name"
    films.cancel(waiting.name)
    assert waiting.events[-1] == ("cancelled", {})
    films.cancel(running.name)
    render.may.set()
    films.wait()
    assert running.events == [("progress", {"stage": "film", "step": 0, "steps": WALK.frames}), ("cancelled", {})]
    assert files(tmp_path) == []


def test_a_film_that_is_cancelled_while_its_file_is_written_leaves_nothing_either(tmp_path):
    def render(motion, path, timeline, progress):
        draw_nothing(motion, path, timeline, progress)
        [job] = films._known.values()
        films.cancel(job.name)

    films = Films(tmp_path, render)
    job = films.add(WALK, "webp")
    films.wait()
    films.close()
    assert job.events[-1] == ("cancelled", {}) and files(tmp_path) == []


def test_a_film_that_fails_is_told_in_a_sentence_and_the_next_one_is_drawn(tmp_path):
    def render(motion, path, timeline, progress):
        if path.suffix == ".gif":
            path.write_bytes(b"half")
            raise OSError(28, "No space left on device")
        draw_nothing(motion, path, timeline, progress)

    films = Films(tmp_path, render)
    failed, done = films.add(WALK, "gif"), films.add(WALK, "webp")
    films.wait()
    films.close()
    assert failed.events[-1][0] == "failed" and "disk is full" in failed.events[-1][1]["error"]
    assert done.events[-1] == ("done", {}) and files(tmp_path) == [films.path(done.name)]


def test_only_the_newest_films_are_kept_and_a_new_studio_begins_without(tmp_path, monkeypatch):
    monkeypatch.setattr("stmc.viewing.studio.films.MOST_FILMS", 2)
    films = Films(tmp_path, draw_nothing)
    jobs = [films.add(WALK, "webp") for _ in range(3)]
    films.wait()
    with pytest.raises(RequestError, match="newer ones have replaced it"):
        films.path(jobs[0].name)
    assert files(tmp_path) == sorted(films.path(job.name) for job in jobs[1:])
    films.close()
    assert films.get(jobs[2].name).ended
    Films(tmp_path, draw_nothing).close()
    assert files(tmp_path) == []


def test_a_film_whose_package_is_missing_is_refused_before_it_waits(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    films = Films(tmp_path, draw_nothing)
    with pytest.raises(RequestError, match=r"pip install 'stmc\[film\]'") as refused:
        films.add(WALK, "mp4")
    films.close()
    assert refused.value.status == 501
