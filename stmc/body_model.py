"""Bodies: a skeleton of 24 joints with adult proportions, and SMPL meshes where the user has the files.

Knows rest poses and how rotations pose them; knows no time. Everything here speaks of pelvis positions, as `Motion`
does; `smpl_translation` is the one place that knows what SMPL adds to them.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float, Int64
from smplx.lbs import lbs
from torch import Tensor

from stmc.body import JOINTS, PARENTS, ROTATED
from stmc.geometry import axis_angle_to_matrix, forward_kinematics, global_rotations


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Bones of 24 joints in `body.JOINTS`' order, in SMPL's rest pose (x left, y up, z forward, metres)."""

    offsets: Float[Tensor, "24 3"]
    """Each joint's rest position relative to its parent; the first row is the rest position of the pelvis."""

    @classmethod
    def default(cls) -> Skeleton:
        """The bundled skeleton, with proportions of the training data (float32, CPU)."""
        table = json.loads((files("stmc") / "assets" / "skeleton.json").read_text("utf-8"))
        return cls(torch.tensor([table[joint] for joint in JOINTS]))

    @classmethod
    def measured(
        cls,
        rotations: Float[Tensor, "frames 22 3 3"],
        joints: Float[Tensor, "frames 24 3"],
        pelvis: Float[Tensor, " 3"],
    ) -> Skeleton:
        """The skeleton that a motion moves: its bones in their parents' frames, averaged over the frames.

        Exact where `joints` are posed by `rotations`. A motion does not tell where the rest `pelvis` is.
        """
        parents = list(PARENTS[1:])
        bones = joints[:, 1:] - joints[:, parents]
        turned = global_rotations(rotations, PARENTS)[:, parents].mT @ bones[..., None]
        return cls(torch.cat([pelvis.to(joints)[None], turned[..., 0].mean(dim=0)]))

    @property
    def rest(self) -> Float[Tensor, "24 3"]:
        """Joint positions in the rest pose, in SMPL's axes."""
        identity = torch.eye(3, dtype=self.offsets.dtype, device=self.offsets.device).expand(len(JOINTS), 3, 3)
        return self.offsets[0] + forward_kinematics(identity, self.offsets, PARENTS)

    def pose(
        self, rotations: Float[Tensor, "*batch 22 3 3"], translation: Float[Tensor, "*batch 3"]
    ) -> Float[Tensor, "*batch 24 3"]:
        """Joint positions of the body with these local rotations and the pelvis at `translation`."""
        offsets = self.offsets.to(rotations)
        return translation[..., None, :] + forward_kinematics(rotations, offsets, PARENTS)

    def smpl_translation(self, pelvis: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """SMPL's `trans` for pelvis positions: less the rest pelvis, which SMPL adds whatever the rotation."""
        return pelvis - self.offsets[0].to(pelvis)


_HANDS = {"smpl": (24, 22, 23), "smplh": (52, 22, 37), "smplx": (55, 25, 40)}
"""Of each kind: its number of joints, and the two that are our hands (SMPL's own; else the first index knuckles)."""

_GENDERS = ("neutral", "female", "male")

_AT_ONCE = 64
"""Frames skinned at once: 10,000 vertices of them take some 100 MB."""


@dataclass(frozen=True, eq=False)
class Body:
    """An SMPL, SMPL-H or SMPL-X body of one shape: a mesh, and the skeleton that moves it. See `load_body`."""

    skeleton: Skeleton
    """Its 24 joints: `skeleton.pose` and `vertices` agree."""
    faces: Int64[Tensor, "_ 3"]
    """Triangles as indexes of vertices."""
    template: Float[Tensor, "_ 3"]
    """Vertices of the shaped body in the rest pose, in SMPL's axes, metres."""
    pose_blends: Float[Tensor, "_ _"]
    """What each entry of the rotation matrices (less the identity) adds to the vertices' coordinates."""
    regressor: Float[Tensor, "joints _"]
    """The bones' rest positions as sums of vertices."""
    weights: Float[Tensor, "_ joints"]
    """How much each bone moves each vertex."""
    parents: Int64[Tensor, " joints"]
    """Each bone's parent, -1 for the root."""
    relaxed: Float[Tensor, "joints 3 3"]
    """Local rotations of the bones that a motion does not turn: hands at their mean pose."""

    def vertices(
        self, rotations: Float[Tensor, "frames 22 3 3"], translation: Float[Tensor, "frames 3"]
    ) -> Float[Tensor, "frames _ 3"]:
        """Mesh vertices in the world for local rotations and pelvis positions (both as a `Motion` has them)."""
        chunks = zip(rotations.split(_AT_ONCE), translation.split(_AT_ONCE), strict=True)
        return torch.cat([self._skinned(*chunk) for chunk in chunks])

    def _skinned(self, rotations: Tensor, translation: Tensor) -> Tensor:
        frames = len(translation)
        pose = torch.cat([rotations, self.relaxed[ROTATED:].to(rotations).expand(frames, -1, 3, 3)], dim=1)
        vertices, _ = lbs(
            betas=pose.new_zeros(frames, 0),  # the template is shaped already
            pose=pose,
            v_template=self.template.to(pose),
            shapedirs=pose.new_zeros(*self.template.shape, 0),
            posedirs=self.pose_blends.to(pose),
            J_regressor=self.regressor.to(pose),
            parents=self.parents.to(pose.device),
            lbs_weights=self.weights.to(pose),
            pose2rot=False,
        )
        return vertices + self.skeleton.smpl_translation(translation)[:, None]


def load_body(
    folder: str | Path, kind: str = "smpl", gender: str = "neutral", betas: Sequence[float] | None = None
) -> Body:
    """The body in the user's own SMPL, SMPL-H or SMPL-X file.

    `folder` is where the files lie as downloaded or as smplx expects them (`SMPL_NEUTRAL.npz`,
    `smplh/neutral/model.npz`, ...), or one such file. `betas`: shape coefficients, zeros by default. Only plain arrays
    are read: a `.pkl` must be converted to `.npz` first, since unpickling runs the file's code.

    Raises `FileNotFoundError` naming the places looked at, `ValueError` for an unknown kind or gender, or a file that
    is not a body of this kind.
    """
    if kind not in _HANDS:
        raise ValueError(f"unknown kind of body {kind!r}; choose from {', '.join(_HANDS)}")
    if gender not in _GENDERS:
        raise ValueError(f"unknown gender {gender!r}; choose from {', '.join(_GENDERS)}")
    path = _find(Path(folder), kind, gender)
    arrays = _read(path, kind)
    bones, left_hand, right_hand = _HANDS[kind]
    template = arrays["v_template"]
    if betas:
        template = template + _shape(arrays["shapedirs"], betas, path)
    regressor = arrays["J_regressor"]
    rest = (regressor @ template)[[*range(ROTATED), left_hand, right_hand]]
    offsets = torch.stack([rest[joint] - (rest[parent] if parent >= 0 else 0) for joint, parent in enumerate(PARENTS)])
    return Body(
        skeleton=Skeleton(offsets),
        faces=arrays["f"].long(),
        template=template,
        pose_blends=rearrange(arrays["posedirs"], "vertices axes blends -> blends (vertices axes)"),
        regressor=regressor,
        weights=arrays["weights"],
        parents=torch.tensor([-1, *arrays["kintree_table"][0, 1:].long().tolist()]),
        relaxed=_relaxed(arrays, bones),
    )


def _find(folder: Path, kind: str, gender: str) -> Path:
    name = f"{kind.upper()}_{gender.upper()}.npz"
    places = [folder / name, folder / kind / name, folder / gender / "model.npz", folder / kind / gender / "model.npz"]
    for path in [folder, *places]:
        if path.is_file():
            return path
    looked = ", ".join(str(path) for path in places)
    raise FileNotFoundError(
        f"no {kind} body for gender {gender!r}; looked for {looked}. Pickled models (.pkl) are not read"
    )


def _read(path: Path, kind: str) -> dict[str, Tensor]:
    """The arrays of a body, floats as float32; `ValueError` where one is missing, pickled or of the wrong shape."""
    wanted = ["v_template", "shapedirs", "posedirs", "J_regressor", "weights", "kintree_table", "f"]
    try:
        with np.load(path, allow_pickle=False) as archive:
            hands = [name for name in ("hands_meanl", "hands_meanr") if name in archive]
            arrays = {name: archive[name] for name in wanted + hands}
    except (KeyError, ValueError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path} is no {kind} body in .npz format: {error}") from error
    bones = _HANDS[kind][0]
    parents = arrays["kintree_table"][0]
    if len(parents) != bones or list(parents[1:ROTATED]) != list(PARENTS[1:ROTATED]):
        raise ValueError(f"{path} has {len(parents)} joints; a {kind} body has {bones}, the first {ROTATED} as SMPL's")
    integer = ("f", "kintree_table")
    return {
        name: torch.from_numpy(array.astype(np.int64 if name in integer else np.float32))
        for name, array in arrays.items()
    }


def _shape(directions: Tensor, betas: Sequence[float], path: Path) -> Tensor:
    if len(betas) > directions.shape[-1]:
        raise ValueError(f"{len(betas)} betas, but {path} has {directions.shape[-1]}")
    return directions[..., : len(betas)] @ torch.tensor(list(betas), dtype=directions.dtype)


def _relaxed(arrays: dict[str, Tensor], bones: int) -> Tensor:
    """Local rotations of a body at ease: fingers, the last 15 bones of each side, at their mean; the rest unturned."""
    turned = torch.zeros(bones, 3)
    if "hands_meanl" in arrays and "hands_meanr" in arrays:
        hands = torch.cat([arrays["hands_meanl"], arrays["hands_meanr"]])
        turned[-30:] = rearrange(hands, "(joints axes) -> joints axes", axes=3)
    return axis_angle_to_matrix(turned)
