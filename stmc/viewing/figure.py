"""The matplotlib figure of all drawings, which notebooks display."""

from __future__ import annotations

import io

import matplotlib.figure


class Figure(matplotlib.figure.Figure):
    """A figure that is not registered with pyplot, so it can be freed; notebooks display it nevertheless."""

    def _repr_png_(self) -> bytes:
        """Return the picture for IPython, which displays figures only if pyplot was imported."""
        picture = io.BytesIO()
        self.savefig(picture, format="png", dpi=96, bbox_inches="tight")
        return picture.getvalue()
