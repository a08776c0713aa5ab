"""Bodies: a skeleton of 24 joints with adult proportions, and SMPL meshes where the user has the files.

Knows rest poses and how rotations pose them; knows no time. Everything here speaks of pelvis positions, as `Motion`
does; `smpl_translation` is the one place that knows what SMPL adds to them.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.resources import files
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float, Int64
from torch import Tensor

from stmc.io.arrays import ArraysError, read_npz, read_pickle
from stmc.io.extras import named_extra
from stmc.motion.body import JOINTS, NUM_ROTATIONS, PARENTS
from stmc.motion.geometry import axis_angle_to_matrix, forward_kinematics, local_bones

if TYPE_CHECKING:  # slow to import
    import trimesh


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Bones of 24 joints in `body.JOINTS`' order, in SMPL's rest pose (x left, y up, z forward, metres).

    Examples:
        >>> stmc.Skeleton.default().rest.shape
        torch.Size([24, 3])
    """

    offsets: Float[Tensor, "24 3"]
    """Each joint's rest position relative to its parent; the first row is the rest position of the pelvis."""

    @classmethod
    def default(cls) -> Skeleton:
        """The bundled skeleton, with proportions of the training data (float32, CPU).

        Examples:
            >>> stmc.Skeleton.default().offsets.shape
            torch.Size([24, 3])
        """
        table = json.loads((files("stmc") / "assets" / "skeleton.json").read_text("utf-8"))
        return cls(torch.tensor([table[joint] for joint in JOINTS]))

    @classmethod
    def measured(
        cls,
        rotations: Float[Tensor, "frames 22 3 3"],
        joints: Float[Tensor, "frames 24 3"],
        pelvis: Float[Tensor, " 3"] | None = None,
    ) -> Skeleton:
        """The skeleton that a motion moves: its bones in their parents' frames, averaged over the frames.

        Exact where `joints` are posed by `rotations`. A motion does not tell where the rest `pelvis` is
        (metres; None: where the default skeleton's is).

        Examples:
            >>> [motion] = stmc.load().generate("walk # 0 # 1", steps=1)
            >>> body = stmc.load().skeleton
            >>> own = stmc.Skeleton.measured(motion.rotations, motion.joints)
            >>> torch.allclose(own.offsets, body.offsets, atol=1e-3)
            True
        """
        pelvis = cls.default().offsets[0] if pelvis is None else pelvis
        bones = local_bones(rotations, joints, PARENTS)[:, 1:]
        return cls(torch.cat([pelvis.to(joints)[None], bones.mean(dim=0)]))

    @property
    def rest(self) -> Float[Tensor, "24 3"]:
        """Joint positions in the rest pose, in SMPL's axes."""
        identity = torch.eye(3, dtype=self.offsets.dtype, device=self.offsets.device).expand(len(JOINTS), 3, 3)
        return self.offsets[0] + forward_kinematics(identity, self.offsets, PARENTS)

    def pose(
        self, rotations: Float[Tensor, "*batch 22 3 3"], translation: Float[Tensor, "*batch 3"]
    ) -> Float[Tensor, "*batch 24 3"]:
        """Joint positions of the body with these local rotations and the pelvis at `translation`.

        Examples:
            >>> stmc.Skeleton.default().pose(torch.eye(3).repeat(22, 1, 1), torch.zeros(3)).shape
            torch.Size([24, 3])
        """
        offsets = self.offsets.to(rotations)
        return translation[..., None, :] + forward_kinematics(rotations, offsets, PARENTS)

    def smpl_translation(self, pelvis: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """SMPL's `trans` for pelvis positions: less the rest pelvis, which SMPL adds whatever the rotation.

        Examples:
            >>> body = stmc.Skeleton.default()
            >>> bool((body.smpl_translation(body.rest[0]) == 0).all())
            True
        """
        return pelvis - self.offsets[0].to(pelvis)


_HANDS = {"smpl": (24, 22, 23), "smplh": (52, 22, 37), "smplx": (55, 25, 40)}
"""Of each kind: its number of joints, and the two that are our hands (SMPL's own; else the first index knuckles)."""

_GENDERS = ("neutral", "female", "male")

_SMPLX_SHAPES, _SMPLX_SHORT = 300, 10
"""Shape directions of SMPL-X's files with 400 directions, and of those with 20. The others are the face's."""

_AT_ONCE = 64
"""Frames skinned at once: 10,000 vertices of them take some 100 MB."""


@dataclass(frozen=True, eq=False)
class Body:
    """An SMPL, SMPL-H or SMPL-X body of one shape: a mesh, and the skeleton that moves it. See `load_body`."""

    skeleton: Skeleton
    """Its 24 joints: `skeleton.pose` and `vertices` agree."""
    faces: Int64[Tensor, "_ 3"]
    """Triangles as indexes of vertices."""
    v_template: Float[Tensor, "_ 3"]
    """Vertices of the shaped body in the rest pose, in SMPL's axes, metres."""
    posedirs: Float[Tensor, "_ _"]
    """What each entry of the rotation matrices (less the identity) adds to the vertices' coordinates."""
    J_regressor: Float[Tensor, "joints _"]
    """The bones' rest positions as sums of vertices."""
    lbs_weights: Float[Tensor, "_ joints"]
    """How much each bone moves each vertex."""
    parents: Int64[Tensor, " joints"]
    """Each bone's parent, -1 for the root."""
    mean_pose: Float[Tensor, "joints 3 3"]
    """Local rotations of the bones that a motion does not turn: hands at their mean pose."""

    def vertices(
        self, rotations: Float[Tensor, "frames 22 3 3"], translation: Float[Tensor, "frames 3"]
    ) -> Float[Tensor, "frames _ 3"]:
        """Mesh vertices in the world for local rotations and pelvis positions (both as a `Motion` has them)."""
        chunks = zip(rotations.split(_AT_ONCE), translation.split(_AT_ONCE), strict=True)
        return torch.cat([self._skinned(*chunk) for chunk in chunks])

    def meshes(
        self, rotations: Float[Tensor, "frames 22 3 3"], translation: Float[Tensor, "frames 3"]
    ) -> list[trimesh.Trimesh]:
        """The mesh of every frame, z up, in metres: trimesh writes each as `.obj`, `.ply`, `.glb` and more."""
        with named_extra():
            import trimesh  # not above: it is slow to import

        faces = self.faces.cpu().numpy()
        posed = self.vertices(rotations, translation).double().cpu().numpy()
        return [trimesh.Trimesh(vertices, faces, process=False) for vertices in posed]

    def _skinned(self, rotations: Tensor, translation: Tensor) -> Tensor:
        lbs = _smplx().lbs
        frames = len(translation)
        pose = torch.cat([rotations, self.mean_pose[NUM_ROTATIONS:].to(rotations).expand(frames, -1, 3, 3)], dim=1)
        vertices, _ = lbs(
            betas=pose.new_zeros(frames, 0),  # the template is shaped already
            pose=pose,
            v_template=self.v_template.to(pose),
            shapedirs=pose.new_zeros(*self.v_template.shape, 0),
            posedirs=self.posedirs.to(pose),
            J_regressor=self.J_regressor.to(pose),
            parents=self.parents.to(pose.device),
            lbs_weights=self.lbs_weights.to(pose),
            pose2rot=False,
        )
        return vertices + self.skeleton.smpl_translation(translation)[:, None]


def _smplx() -> ModuleType:
    """What poses bodies: only they need it."""
    with named_extra():
        return import_module("smplx.lbs")


def load_body(
    folder: str | Path, kind: str = "smpl", gender: str = "neutral", betas: Sequence[float] | None = None
) -> Body:
    """The body in the user's own SMPL, SMPL-H or SMPL-X file, `.npz` or `.pkl`.

    `folder` is where the files lie as downloaded (`basicmodel_neutral_lbs_10_207_0_v1.1.0.pkl`, `neutral/model.npz`,
    ...) or as smplx expects them (`smplh/SMPLH_NEUTRAL.npz`, ...), or one such file. `betas`: shape coefficients, zeros
    by default. Of a `.pkl`, only arrays are read; its code is not run, and chumpy is not needed.

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
    v_template = arrays["v_template"]
    if betas:
        v_template = v_template + _shape(arrays["shapedirs"], betas, kind, path)
    J_regressor = arrays["J_regressor"]
    rest = (J_regressor @ v_template)[[*range(NUM_ROTATIONS), left_hand, right_hand]]
    offsets = torch.stack([rest[joint] - (rest[parent] if parent >= 0 else 0) for joint, parent in enumerate(PARENTS)])
    return Body(
        skeleton=Skeleton(offsets),
        faces=arrays["f"].long(),
        v_template=v_template,
        posedirs=rearrange(arrays["posedirs"], "vertices axes blends -> blends (vertices axes)"),
        J_regressor=J_regressor,
        lbs_weights=arrays["weights"],
        parents=torch.tensor([-1, *arrays["kintree_table"][0, 1:].long().tolist()]),
        mean_pose=_mean_pose(arrays, bones),
    )


def _find(folder: Path, kind: str, gender: str) -> Path:
    if folder.is_file():
        return folder
    names = [f"{kind}_{gender}.npz", f"{gender}/model.npz", f"{kind}_{gender}.pkl", f"{gender}/model.pkl"]
    if kind == "smpl":
        letter = gender if gender == "neutral" else gender[0]
        names += [f"basicmodel_{letter}_lbs_10_207_0_v{version}.pkl" for version in ("1.1.0", "1.0.0")]
    places = [*names, *(f"{kind}/{name}" for name in names)]
    there = {path.relative_to(folder).as_posix().lower(): path for path in _below(folder, depth=3)}
    for place in places:  # names differ in case from one release to the next
        if place in there:
            return there[place]
    raise FileNotFoundError(f"no {kind} body for gender {gender!r} in {folder}; looked for {', '.join(places)}")


def _below(folder: Path, depth: int) -> list[Path]:
    """Files of at most `depth` names below `folder`."""
    return sorted(
        path for level in range(1, depth + 1) for path in folder.glob("/".join("*" * level)) if path.is_file()
    )


def _read(path: Path, kind: str) -> dict[str, Tensor]:
    """The arrays of a body, floats as float32; `ValueError` where one is missing, damaged or of the wrong shape."""
    wanted, hands = ["v_template", "shapedirs", "posedirs", "J_regressor", "weights", "kintree_table", "f"], []
    if kind != "smpl":
        hands = ["hands_meanl", "hands_meanr"]
    read = read_pickle if path.suffix == ".pkl" else read_npz
    try:
        arrays = read(path, wanted, hands)
    except ArraysError as error:
        raise ValueError(f"{path} is not a {kind} body: {error}") from error
    _check(arrays, path, kind)
    integer = ("f", "kintree_table")
    return {
        name: torch.from_numpy(array.astype(np.int64 if name in integer else np.float32))
        for name, array in arrays.items()
    }


def _check(arrays: Mapping[str, np.ndarray], path: Path, kind: str) -> None:
    """Raises `ValueError` unless the arrays fit one another and the kind of body."""
    for name, array in arrays.items():
        if array.dtype.kind not in "biuf":
            raise ValueError(f"{path}: {name} holds {array.dtype}, not numbers")
    bones, tree = _HANDS[kind][0], arrays["kintree_table"]
    if tree.ndim != 2 or tree.shape[1] != bones or list(tree[0, 1:NUM_ROTATIONS]) != list(PARENTS[1:NUM_ROTATIONS]):
        joints = tree.shape[-1] if tree.ndim else 0
        raise ValueError(f"{path} has {joints} joints; a {kind} body has {bones}, the first {NUM_ROTATIONS} as SMPL's")
    if (tree[0, 1:] < 0).any() or (tree[0, 1:] >= np.arange(1, bones)).any():
        raise ValueError(f"{path}: kintree_table has a joint before its parent")
    vertices = len(arrays["v_template"]) if arrays["v_template"].ndim else 0
    shapes = {
        "v_template": (vertices, 3),
        "shapedirs": (vertices, 3, None),
        "posedirs": (vertices, 3, 9 * (bones - 1)),
        "J_regressor": (bones, vertices),
        "weights": (vertices, bones),
        "f": (None, 3),
        "hands_meanl": (45,),
        "hands_meanr": (45,),
    }
    for name, shape in shapes.items():
        if name not in arrays:
            continue
        array = arrays[name]
        if array.ndim != len(shape) or any(
            want not in (None, got) for want, got in zip(shape, array.shape, strict=True)
        ):
            raise ValueError(f"{path}: {name} has shape {array.shape}; a {kind} body's is {shape}")
        if not (np.abs(array.astype(np.float64)) <= np.finfo(np.float32).max).all():
            raise ValueError(f"{path}: {name} has values that are not finite, or not in float32")
    if not ((arrays["f"] >= 0) & (arrays["f"] < vertices)).all():
        raise ValueError(f"{path}: f names vertices that do not exist; there are {vertices}")


def _shape(directions: Tensor, betas: Sequence[float], kind: str, path: Path) -> Tensor:
    known = directions.shape[-1]
    if kind == "smplx":  # the directions of the face's expressions follow those of the shape
        known = _SMPLX_SHAPES if known > _SMPLX_SHAPES else min(known, _SMPLX_SHORT)
    if len(betas) > known:
        raise ValueError(f"{len(betas)} betas, but {path} has {known}")
    return directions[..., : len(betas)] @ torch.tensor(list(betas), dtype=directions.dtype)


def _mean_pose(arrays: Mapping[str, Tensor], bones: int) -> Tensor:
    """Local rotations of a body at ease: fingers, the last 15 bones of each side, at their mean; the rest unturned."""
    turned = torch.zeros(bones, 3)
    if "hands_meanl" in arrays and "hands_meanr" in arrays:
        hands = torch.cat([arrays["hands_meanl"], arrays["hands_meanr"]])
        turned[-30:] = rearrange(hands, "(joints axes) -> joints axes", axes=3)
    return axis_angle_to_matrix(turned)
