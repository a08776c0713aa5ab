"""The studio: a local page for writing, sampling, editing and exporting timelines.

The server checks timelines, samples them one after the other, plays streams, stores motions, characters and documents,
and exports files. The page (`assets/studio`) implements editing, and the library sampling. This package knows models,
exports and views.
"""

from stmc.viewing.studio.character_storage import Characters
from stmc.viewing.studio.job_queue import Job
from stmc.viewing.studio.jobs import Jobs, Stage
from stmc.viewing.studio.sampling_turns import Turns
from stmc.viewing.studio.server import application
from stmc.viewing.studio.sessions import Sessions, program_token
from stmc.viewing.studio.storage import Documents, Motions
from stmc.viewing.studio.streams import Streams

__all__ = [
    "Characters",
    "Documents",
    "Job",
    "Jobs",
    "Motions",
    "Sessions",
    "Stage",
    "Streams",
    "Turns",
    "application",
    "program_token",
]
