"""The studio: a page on the user's own machine where timelines are written, sampled, edited and taken away.

A server for that page alone: it checks timelines, samples them one after the other, keeps motions and documents, and
hands out files. What is edited, and how, is the page's business (`assets/studio`); how timelines are sampled, the
library's. Knows models, exports and views.
"""

from stmc.viewing.studio.jobs import Job, Jobs, Stage
from stmc.viewing.studio.server import application
from stmc.viewing.studio.sessions import Sessions
from stmc.viewing.studio.stores import Documents, Motions

__all__ = ["Documents", "Job", "Jobs", "Motions", "Sessions", "Stage", "application"]
