"""The figure of matplotlib that all drawings are: a notebook shows it. Knows nothing of what is drawn."""

from __future__ import annotations

import io

import matplotlib.figure


class Figure(matplotlib.figure.Figure):
    """A figure that pyplot does not know, so that nothing keeps it; notebooks show it all the same."""

    def _repr_png_(self) -> bytes:
        """The picture, for IPython, which knows no figures unless pyplot was imported."""
        picture = io.BytesIO()
        self.savefig(picture, format="png", dpi=96, bbox_inches="tight")
        return picture.getvalue()
