"""Looking at motions and timelines: pages, film strips and figures, one colour per prompt in all of them.

Knows nothing of models and sampling. It stands a tier above `assign`, which tells whom each body part obeys. What draws
is imported when it is first used: a command's help needs none of it.
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
