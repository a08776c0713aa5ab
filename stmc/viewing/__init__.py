"""Looking at motions and timelines: pages, film strips and figures, one colour per prompt in all of them.

Knows nothing of models and sampling. It stands a tier above `assign`, which tells whom each body part obeys.
"""

from stmc.viewing.plans import plot_plan
from stmc.viewing.strip import pictures
from stmc.viewing.tracks import figure
from stmc.viewing.web import frame, page, view

__all__ = ["figure", "frame", "page", "pictures", "plot_plan", "view"]
