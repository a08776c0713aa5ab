"""Looking at motions and timelines: pages, film strips and figures, one colour per prompt in all of them.

Knows nothing of models and sampling. It stands a tier above `assign`, which tells whom each body part obeys.
"""

from stmc.viewing.film import render_film
from stmc.viewing.plans import plot_plan
from stmc.viewing.strip import film_strip
from stmc.viewing.tracks import plot_timeline
from stmc.viewing.web import html_frame, render_html, view

__all__ = ["film_strip", "html_frame", "plot_plan", "plot_timeline", "render_film", "render_html", "view"]
