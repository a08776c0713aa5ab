"""Film strips of motions: moments side by side in the colours of prompts, and the path from above."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.patches import Polygon

from stmc.motion.body_model import Body
from stmc.motion.motion import Motion
from stmc.motion.skins import PARTS, Skin, skin_of
from stmc.timeline import Timeline
from stmc.viewing.colours import as_rgb, mix, part_colours, transition_seconds
from stmc.viewing.figure import Figure
from stmc.viewing.timeline_figure import FAINT, INK, draw_tracks

_ELEVATION = math.radians(14.0)
_ASIDE = math.radians(38.0)
"""Angle of the camera to the side of the body's facing direction."""
_SUN = np.array([0.35, -0.55, 1.0])
_FLOOR, _LINE, _SHADOW = "#f4f5f7", "#dcdfe4", "#c9cdd4"
_LEGS = PARTS.index("legs")


def film_strip(
    motion: Motion,
    timeline: Timeline | None = None,
    frames: int = 8,
    overlap: int | float | None = None,
    body: Body | None = None,
    title: str = "",
) -> Figure:
    """Draw moments of a motion side by side, its path from above, and the timeline below.

    All pictures have the same scale and camera direction, and follow the pelvis over a floor of half-metre tiles, on
    which an arrow shows the facing direction of the pelvis. Colours are those of `part_colours`. The figure is not
    registered with pyplot. Raises `ValueError` for fewer than one moment.

    Args:
        motion: Motion to show.
        timeline: Timeline to draw below; None: no timeline and a single colour.
        frames: Number of moments.
        overlap: Length of transitions in seconds; None: as sampled.
        body: Body to draw; None: a mannequin.
        title: Title of the figure; by default the name of the timeline.

    Examples:
        >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1)
        >>> stmc.film_strip(motion, frames=2).savefig("walk.png")
    """
    if frames < 1:
        raise ValueError(f"frames must be at least 1, not {frames}")
    shown = np.unique(np.linspace(0, motion.frames - 1, frames).round().astype(int))
    overlap = transition_seconds(motion, overlap)
    colours = part_colours(timeline, motion.fps, motion.frames, overlap)
    stage = Stage.of(motion, body, colours, shown)
    plot = Figure(figsize=(1.72 * (len(shown) + 1), 3.0 + (0 if timeline is None else 2.4)), layout="constrained")
    tall = [1.0] if timeline is None else [3.0, 2.4]
    grid = plot.add_gridspec(len(tall), len(shown) + 1, height_ratios=tall)
    for column, frame in enumerate(shown.tolist()):
        stage.paint(plot.add_subplot(grid[0, column]), frame)
    _from_above(plot.add_subplot(grid[0, -1]), motion, shown, colours)
    if timeline is not None:
        axes = plot.add_subplot(grid[1, :])
        draw_tracks(axes, timeline, motion.fps, overlap)
        for frame in shown:
            axes.axvline(frame / motion.fps, color=INK, linewidth=0.8, linestyle=(0, (2, 2)), alpha=0.55)
    name = title or (timeline.name if timeline is not None else "")
    if name:
        plot.suptitle(name, x=0.01, ha="left", fontsize=11, color=INK, fontweight="bold")
    return plot


@dataclass(frozen=True)
class Stage:
    """A view of a motion from one direction: the body stays in the middle, and the floor moves below it."""

    motion: Motion
    skin: Skin
    colours: Float[np.ndarray, "frames parts 3"]
    camera: Float[np.ndarray, "3 3"]
    """Rows: right, up and towards the eye, in world coordinates. It sees the body's mean front from the side."""
    frame: tuple[float, float, float]
    """Extent in metres: to both sides, down and up."""

    @classmethod
    def of(
        cls, motion: Motion, body: Body | None, colours: Float[np.ndarray, "frames parts 3"], shown: np.ndarray
    ) -> Stage:
        """Fit the view to the frames `shown`.

        Args:
            motion: Motion to show.
            body: Body to draw; None: a mannequin.
            colours: Colours of body parts.
            shown: Frames that must fit.
        """
        x, y = motion.facing[:, :2].double().mean(dim=0).tolist()
        azimuth = math.atan2(y, x) - _ASIDE
        away = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
        right = np.array([-away[1], away[0], 0.0])
        eye = math.cos(_ELEVATION) * away + math.sin(_ELEVATION) * np.array([0.0, 0.0, 1.0])
        stage = cls(
            motion, skin_of(motion, body), colours, np.stack([right, np.cross(eye, right), eye]), (0.0, 0.0, 0.0)
        )
        seen = np.stack([(stage.vertices(frame) - stage.ground[frame]) @ stage.camera.T for frame in shown.tolist()])
        wide = max(0.55, float(np.abs(seen[..., 0]).max()) + 0.06)
        low, high = min(-0.16, float(seen[..., 1].min()) - 0.05), max(1.5, float(seen[..., 1].max()) + 0.08)
        return replace(stage, frame=(wide, low, high))

    @property
    def ground(self) -> Float[np.ndarray, "frames 3"]:
        """The path of the pelvis on the floor."""
        return self.motion.translation.double().cpu().numpy() * [1.0, 1.0, 0.0]

    def vertices(self, frame: int) -> Float[np.ndarray, "vertices 3"]:
        """Return the vertices of the body at one frame, in world coordinates."""
        return self.skin.posed(self.motion.trimmed(frame, frame + 1))[0]

    def paint(self, axes: Axes, frame: int) -> None:
        """Draw one frame of the motion and the whole path."""
        wide, low, high = self.frame
        axes.set(xlim=(-wide, wide), ylim=(low, high), aspect="equal", xticks=[], yticks=[])
        axes.spines[:].set_visible(False)
        path, legs, camera = self.ground, self.colours[:, _LEGS], self.camera
        rim = _floor(axes, path[frame], camera, wide)
        walked = (path - path[frame]) @ camera.T
        for line in (
            _path(axes, walked[: frame + 1], legs[: frame + 1], 2.2),
            _path(axes, walked[frame:], legs[frame:], 2.2, 0.25),
            _figure(axes, self.vertices(frame) - path[frame], self.skin, self.colours[frame], camera),
        ):
            line.set_clip_path(rim)
        _arrow(axes, self.motion.facing[frame].double().cpu().numpy(), camera)
        axes.set_title(f"{frame / self.motion.fps:.1f} s", fontsize=9, color=INK, pad=2)


def _floor(axes: Axes, centre: Float[np.ndarray, " 3"], camera: Float[np.ndarray, "3 3"], reach: float) -> Polygon:
    """Draw a round floor with half-metre tiles fixed in the world."""
    turn = np.linspace(0, 2 * np.pi, 60)
    rim = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1) * reach
    ground = Polygon((rim @ camera.T)[:, :2], facecolor=_FLOOR, linewidth=0, zorder=0)
    axes.add_patch(ground)
    lines = []
    for axis in (0, 1):
        first, last = math.ceil((centre[axis] - reach) * 2), math.floor((centre[axis] + reach) * 2)
        at = np.arange(first, last + 1) / 2 - centre[axis]
        half = np.sqrt(np.maximum(reach**2 - at**2, 0.0))
        ends = np.zeros((len(at), 2, 3))
        ends[:, :, axis] = at[:, None]
        ends[:, 0, 1 - axis], ends[:, 1, 1 - axis] = -half, half
        lines.append((ends @ camera.T)[..., :2])
    axes.add_collection(LineCollection(list(np.concatenate(lines)), colors=_LINE, linewidths=0.6, zorder=1))
    return ground


def _path(
    axes: Axes, points: np.ndarray, colours: np.ndarray, width: int | float, share: float = 0.8
) -> LineCollection:
    """Draw a line on the floor; its colours are mixed with that of the floor, keeping `share`."""
    segments = np.stack([points[:-1, :2], points[1:, :2]], axis=1)
    thinned = mix(as_rgb(_FLOOR), share, colours[:-1])
    line = LineCollection(list(segments), colors=thinned, linewidths=width, zorder=2)
    axes.add_collection(line)
    return line


def _arrow(axes: Axes, facing: Float[np.ndarray, " 3"], camera: Float[np.ndarray, "3 3"]) -> None:
    """Draw a flat arrow head on the floor in front of the pelvis."""
    aside = np.array([-facing[1], facing[0], 0.0])
    corners = np.stack([0.52 * facing, 0.36 * facing + 0.10 * aside, 0.40 * facing, 0.36 * facing - 0.10 * aside])
    axes.add_patch(Polygon((corners @ camera.T)[:, :2], facecolor=INK, linewidth=0, alpha=0.65, zorder=3))


def _figure(
    axes: Axes, vertices: np.ndarray, skin: Skin, colours: np.ndarray, camera: Float[np.ndarray, "3 3"]
) -> PolyCollection:
    """Draw the visible faces of the body, nearest last; return its shadow on the floor."""
    corners = vertices[skin.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    lit = normals @ _SUN > 0
    fallen = corners[lit] - corners[lit][..., 2:] / _SUN[2] * _SUN
    shadow = PolyCollection(
        (fallen @ camera.T)[..., :2], facecolors=_SHADOW, edgecolors=_SHADOW, linewidths=0.3, zorder=1.5
    )
    axes.add_collection(shadow)
    seen = corners @ camera.T
    nearest = np.argsort(seen[..., 2].mean(axis=1))
    nearest = nearest[(normals @ camera[2])[nearest] > 0]
    shade = _shade(_smooth(normals, skin)[nearest], camera)[:, None]
    base = colours[skin.parts[nearest]]
    painted = np.clip(np.where(shade < 1, base * shade, base + (1 - base) * (shade - 1)), 0.0, 1.0)
    axes.add_collection(
        PolyCollection(seen[nearest][..., :2], facecolors=painted, edgecolors=painted, linewidths=0.35, zorder=4)
    )
    return shadow


def _smooth(normals: np.ndarray, skin: Skin) -> np.ndarray:
    """Average face normals over the faces around each corner."""
    around = np.zeros((len(skin.vertices), 3))
    np.add.at(around, skin.faces.reshape(-1), np.repeat(normals, 3, axis=0))
    smooth = around[skin.faces].sum(axis=1)
    return smooth / np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-12)


def _shade(normals: np.ndarray, camera: Float[np.ndarray, "3 3"]) -> np.ndarray:
    """Return brightness, 1 for the plain colour: a light over the camera's left shoulder, sky, and a darker rim."""
    key = camera.T @ np.array([-0.5, 0.65, 0.75])
    diffuse = np.clip(normals @ (key / np.linalg.norm(key)), 0.0, 1.0)
    sky = 0.5 + 0.5 * normals[:, 2]
    rim = np.clip(normals @ camera[2], 0.0, 1.0) ** 0.5
    return (0.52 + 0.22 * sky + 0.56 * diffuse) * (0.74 + 0.26 * rim)


def _from_above(axes: Axes, motion: Motion, shown: np.ndarray, colours: np.ndarray) -> None:
    """Draw the path of the pelvis with an arrow head at each moment; x to the right, y up."""
    path = motion.translation.double().cpu().numpy()[:, :2]
    facing = motion.facing.double().cpu().numpy()[:, :2]
    middle = (path.min(axis=0) + path.max(axis=0)) / 2
    reach = max(0.75, float(np.ptp(path, axis=0).max()) / 2 * 1.15 + 0.15)
    axes.set(xlim=middle[0] + np.array([-reach, reach]), ylim=middle[1] + np.array([-reach, reach]), aspect="equal")
    axes.set_facecolor(_FLOOR)
    _path(axes, path, colours[:, _LEGS], 2.5)
    size = 0.085 * reach
    for frame in shown:
        front, aside = facing[frame] * size, np.array([-facing[frame, 1], facing[frame, 0]]) * size
        corners = path[frame] + np.stack([1.6 * front, -front + aside, -0.4 * front, -front - aside])
        axes.add_patch(Polygon(corners, facecolor=colours[frame, _LEGS], edgecolor="white", linewidth=0.6, zorder=4))
    step = next(step for step in (0.5, 1.0, 2.0, 5.0, 10.0, 50.0, 1e9) if 2 * reach / step <= 8)
    axes.set_xticks(np.arange(math.ceil((middle[0] - reach) / step), (middle[0] + reach) / step) * step, minor=False)
    axes.set_yticks(np.arange(math.ceil((middle[1] - reach) / step), (middle[1] + reach) / step) * step, minor=False)
    axes.grid(color=_LINE, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(length=0, labelbottom=False, labelleft=False)
    axes.spines[:].set_visible(False)
    axes.set_title(f"from above, {step:g} m grid", fontsize=8, color=FAINT, pad=2)
