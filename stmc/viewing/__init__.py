"""Views of motions and timelines: pages, films, film strips and figures, with one colour per prompt in all of them.

This package does not know models and sampling. It is a tier above `assign`, which assigns body parts to prompts.
Drawing modules are imported on first use, so that the help of commands does not import them.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from stmc.io.extras import named_extra

if TYPE_CHECKING:  # for editors and the reference
    from stmc.viewing.film import render_film
    from stmc.viewing.plan_figure import plot_plan
    from stmc.viewing.strip import film_strip
    from stmc.viewing.timeline_figure import plot_timeline
    from stmc.viewing.web import html_frame, render_html, view

_LATER = {"render_film": "film", "plot_plan": "plan_figure", "film_strip": "strip", "plot_timeline": "timeline_figure"}
_LATER |= dict.fromkeys(("html_frame", "render_html", "view"), "web")

__all__ = ["film_strip", "html_frame", "plot_plan", "plot_timeline", "render_film", "render_html", "view"]


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module 'stmc.viewing' has no attribute {name!r}")
    with named_extra():
        return getattr(import_module(f"stmc.viewing.{_LATER[name]}"), name)
