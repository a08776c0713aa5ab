"""Films of the studio: jobs that draw them, and the files of the newest ones.

This module knows motions and timelines; it knows no HTTP and no pages.
"""

from __future__ import annotations

import itertools
from collections import OrderedDict
from collections.abc import Callable
from functools import partial
from pathlib import Path

from stmc.composing import Progress
from stmc.motion.motion import Motion
from stmc.timeline import Timeline
from stmc.viewing.exports import EXPORTS, FILMS
from stmc.viewing.studio.job_queue import Job, JobQueue, report_progress
from stmc.viewing.studio.request_errors import RequestError
from stmc.viewing.studio.storage import check_film, own_folder

MOST_FILMS = 4
"""Maximum number of stored films, the newest."""

STAGE = "film"
"""Stage of these jobs: its steps are pictures."""


class Films(JobQueue):
    """The queue of films, which its thread draws one after the other beside sampling; the newest films stay as files.

    A film has its file once it is complete. One that fails or is cancelled leaves none, and a new studio none of
    before, since the jobs that name them are forgotten.
    """

    def __init__(self, folder: Path | str, render: Callable[..., None] | None = None) -> None:
        self.render = render or _render
        self._folder = own_folder(folder)
        for path in self._folder.iterdir():
            if path.suffix in FILMS and path.is_file():
                path.unlink()
        self._files: OrderedDict[str, Path] = OrderedDict()
        super().__init__("studio films")

    def add(self, motion: Motion, kind: str, timeline: Timeline | None = None) -> Job:
        """Queue a film.

        Raises `RequestError` for a motion that is too long, for a missing package, and if too many films wait.

        Args:
            motion: Motion to show.
            kind: Name of a format, such as "webp".
            timeline: Timeline whose prompts give colours and texts, or None.
        """
        check_film(motion, kind)
        [check] = [each.check for each in EXPORTS if each.name == kind]
        try:
            if check is not None:
                check()
        except ModuleNotFoundError as error:
            raise RequestError(501, str(error)) from None
        return self.put(partial(self._draw, motion, kind, timeline))

    def path(self, name: str) -> Path:
        """Return the file of the film of a job. Raises `RequestError` if there is none, or none yet."""
        path = self._files.get(name)
        if path is None or not path.is_file():
            raise RequestError(404, "there is no such film: it is not complete, or newer ones have replaced it")
        return path

    def _draw(self, motion: Motion, kind: str, timeline: Timeline | None, job: Job) -> None:
        """Draw a film into a file, and remove the oldest one beyond `MOST_FILMS`."""
        path, drawn = self._folder / f"{job.name}.{kind}", itertools.count()

        def report() -> None:
            job.check()
            job.emit("progress", stage=STAGE, step=min(next(drawn), motion.frames), steps=motion.frames)

        try:
            self.render(motion, path, timeline, progress=report_progress(report))
            job.check()
            path.chmod(0o600)
        except BaseException:
            path.unlink(missing_ok=True)
            raise
        self._files[job.name] = path
        while len(self._files) > MOST_FILMS:
            self._files.popitem(last=False)[1].unlink(missing_ok=True)


def _render(motion: Motion, path: Path, timeline: Timeline | None, progress: Progress) -> None:
    from stmc.viewing.film import render_film  # not at the top: only films need to draw

    render_film(motion, path, timeline, progress=progress)
