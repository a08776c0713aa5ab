"""Bodies: a skeleton of 24 joints with adult proportions, and SMPL meshes if the user has the files.

Bodies have rest poses and are posed by rotations; they are independent of time. All functions use pelvis positions, as
`Motion` does; only `smpl_translation` converts them to SMPL's translations.
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

MOST_BYTES = 2**29
"""Maximum size of a body's arrays; those of SMPL-X have 233 MB."""


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Bones of 24 joints in the order of `body.JOINTS`, in SMPL's rest pose (x left, y up, z forward, metres).

    Examples:
        >>> stmc.Skeleton.default().rest.shape
        torch.Size([24, 3])
    """

    offsets: Float[Tensor, "24 3"]
    """Each joint's rest position relative to its parent; the first row is the rest position of the pelvis."""

    @classmethod
    def default(cls) -> Skeleton:
        """Return the bundled skeleton, with proportions of the training data (float32, CPU).

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
        """Measure the skeleton of a motion: its bones in their parents' frames, averaged over the frames.

        The result is exact if `rotations` pose the `joints`.

        Args:
            rotations: Local rotations, [frames, 22, 3, 3].
            joints: Joint positions in metres, [frames, 24, 3].
            pelvis: Rest position of the pelvis in metres, which a motion does not determine; None uses that of the
                default skeleton.

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
        """Compute the joint positions for local rotations, with the pelvis at `translation`.

        Examples:
            >>> stmc.Skeleton.default().pose(torch.eye(3).repeat(22, 1, 1), torch.zeros(3)).shape
            torch.Size([24, 3])
        """
        offsets = self.offsets.to(rotations)
        return translation[..., None, :] + forward_kinematics(rotations, offsets, PARENTS)

    def smpl_translation(self, pelvis: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Convert pelvis positions to SMPL's `trans`.

        The result is the position minus the rest pelvis, which SMPL adds whatever the rotation.

        Examples:
            >>> body = stmc.Skeleton.default()
            >>> bool((body.smpl_translation(body.rest[0]) == 0).all())
            True
        """
        return pelvis - self.offsets[0].to(pelvis)


_HANDS = {"smpl": (24, 22, 23), "smplh": (52, 22, 37), "smplx": (55, 25, 40)}
"""For each kind: its number of joints, and the two joints that serve as hands (SMPL's own; otherwise the first index
knuckles)."""

_GENDERS = ("neutral", "female", "male")

_SMPLX_SHAPES, _SMPLX_SHORT = 300, 10
"""Shape directions of SMPL-X files with 400 directions, and of those with 20. The others describe the face."""
_FRAMES_AT_ONCE = 64
"""Number of frames skinned at once: 10,000 vertices in 64 frames take some 100 MB."""


@dataclass(frozen=True, eq=False)
class Body:
    """An SMPL, SMPL-H or SMPL-X body of one shape: a mesh, and the skeleton that moves it. See `load_body`."""

    skeleton: Skeleton
    """The 24 joints; `skeleton.pose` and `vertices` agree."""
    faces: Int64[Tensor, "_ 3"]
    """Triangles as vertex indices."""
    v_template: Float[Tensor, "_ 3"]
    """Vertices of the shaped body in the rest pose, in SMPL's axes, metres."""
    posedirs: Float[Tensor, "_ _"]
    """Contribution of each entry of the rotation matrices (minus the identity) to the vertex coordinates."""
    J_regressor: Float[Tensor, "joints _"]
    """Weights of the vertices that give the rest positions of the bones."""
    lbs_weights: Float[Tensor, "_ joints"]
    """Weight of each bone at each vertex (linear blend skinning)."""
    parents: Int64[Tensor, " joints"]
    """Index of each bone's parent, -1 for the root."""
    mean_pose: Float[Tensor, "joints 3 3"]
    """Local rotations of the bones that a motion does not rotate: hands in their mean pose."""

    def vertices(
        self, rotations: Float[Tensor, "frames 22 3 3"], translation: Float[Tensor, "frames 3"]
    ) -> Float[Tensor, "frames _ 3"]:
        """Compute mesh vertices in the world from local rotations and pelvis positions, as in a `Motion`."""
        chunks = zip(rotations.split(_FRAMES_AT_ONCE), translation.split(_FRAMES_AT_ONCE), strict=True)
        return torch.cat([self._skin(*chunk) for chunk in chunks])

    def meshes(
        self, rotations: Float[Tensor, "frames 22 3 3"], translation: Float[Tensor, "frames 3"]
    ) -> list[trimesh.Trimesh]:
        """Build the mesh of every frame, z up, in metres; trimesh writes it as `.obj`, `.ply`, `.glb` and more."""
        with named_extra():
            import trimesh  # not above: it is slow to import

        faces = self.faces.cpu().numpy()
        posed = self.vertices(rotations, translation).double().cpu().numpy()
        return [trimesh.Trimesh(vertices, faces, process=False) for vertices in posed]

    def _skin(self, rotations: Tensor, translation: Tensor) -> Tensor:
        lbs = _smplx().lbs
        frames = len(translation)
        pose = torch.cat([rotations, self.mean_pose[NUM_ROTATIONS:].to(rotations).expand(frames, -1, 3, 3)], dim=1)
        vertices, _ = lbs(
            betas=pose.new_zeros(frames, 0),  # the template includes the shape
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
    """Import the module that poses bodies; nothing else needs it."""
    with named_extra():
        return import_module("smplx.lbs")


def load_body(
    folder: str | Path, kind: str = "smpl", gender: str = "neutral", betas: Sequence[float] | None = None
) -> Body:
    """Load a body from the user's own SMPL, SMPL-H or SMPL-X file, `.npz` or `.pkl`.

    Only arrays are read from a `.pkl`: its code is not executed, and chumpy is not needed.

    Args:
        folder: Folder of the files as downloaded (`basicmodel_neutral_lbs_10_207_0_v1.1.0.pkl`, `neutral/model.npz`,
            ...) or as smplx expects them (`smplh/SMPLH_NEUTRAL.npz`, ...), or the path of one such file.
        kind: "smpl", "smplh" or "smplx".
        gender: "neutral", "female" or "male".
        betas: Shape coefficients; zeros by default.

    Raises:
        FileNotFoundError: If no file is found; the message lists the candidates.
        ValueError: If the kind or gender is unknown, or the file is not a body of this kind.
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
    candidates = [*names, *(f"{kind}/{name}" for name in names)]
    present = {path.relative_to(folder).as_posix().lower(): path for path in _below(folder, depth=3)}
    for candidate in candidates:  # releases differ in the case of names
        if candidate in present:
            return present[candidate]
    raise FileNotFoundError(f"no {kind} body for gender {gender!r} in {folder}; looked for {', '.join(candidates)}")


def _below(folder: Path, depth: int) -> list[Path]:
    """List the files at most `depth` levels below `folder`."""
    return sorted(
        path for level in range(1, depth + 1) for path in folder.glob("/".join("*" * level)) if path.is_file()
    )


def _read(path: Path, kind: str) -> dict[str, Tensor]:
    """Read the arrays of a body, floats as float32; raise `ValueError` if one is missing, damaged or misshapen."""
    required, hands = ["v_template", "shapedirs", "posedirs", "J_regressor", "weights", "kintree_table", "f"], []
    if kind != "smpl":
        hands = ["hands_meanl", "hands_meanr"]
    try:
        if path.suffix == ".pkl":
            arrays = read_pickle(path, required, hands)
        else:
            arrays = read_npz(path, required, hands, MOST_BYTES)
    except ArraysError as error:
        raise ValueError(f"{path} is not a {kind} body: {error}") from error
    _check(arrays, path, kind)
    integer = ("f", "kintree_table")
    return {
        name: torch.from_numpy(array.astype(np.int64 if name in integer else np.float32))
        for name, array in arrays.items()
    }


def _check(arrays: Mapping[str, np.ndarray], path: Path, kind: str) -> None:
    """Raise `ValueError` unless the arrays match each other and the kind of body."""
    for name, array in arrays.items():
        if array.dtype.kind not in "biuf":
            raise ValueError(f"{path}: {name} has dtype {array.dtype}; it must be numeric")
    bones, tree = _HANDS[kind][0], arrays["kintree_table"]
    if tree.ndim != 2 or tree.shape[1] != bones or list(tree[0, 1:NUM_ROTATIONS]) != list(PARENTS[1:NUM_ROTATIONS]):
        joints = tree.shape[-1] if tree.ndim else 0
        raise ValueError(
            f"{path} has {joints} joints; a {kind} body has {bones}, and the first {NUM_ROTATIONS} are SMPL's"
        )
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
            expected not in (None, actual) for expected, actual in zip(shape, array.shape, strict=True)
        ):
            raise ValueError(f"{path}: {name} has shape {array.shape}; a {kind} body's is {shape}")
        if not (np.abs(array.astype(np.float64)) <= np.finfo(np.float32).max).all():
            raise ValueError(f"{path}: {name} has values that are not finite, or not in float32")
    if not ((arrays["f"] >= 0) & (arrays["f"] < vertices)).all():
        raise ValueError(f"{path}: f names vertices that do not exist; there are {vertices}")


def _shape(directions: Tensor, betas: Sequence[float], kind: str, path: Path) -> Tensor:
    count = directions.shape[-1]
    if kind == "smplx":  # the directions of facial expressions follow those of the shape
        count = _SMPLX_SHAPES if count > _SMPLX_SHAPES else min(count, _SMPLX_SHORT)
    if len(betas) > count:
        raise ValueError(f"{len(betas)} betas, but {path} has {count} shape directions")
    return directions[..., : len(betas)] @ torch.tensor(list(betas), dtype=directions.dtype)


def _mean_pose(arrays: Mapping[str, Tensor], bones: int) -> Tensor:
    """Return local rotations: the fingers, the last 15 bones of each side, in their mean pose, the rest at identity."""
    rotations = torch.zeros(bones, 3)
    if "hands_meanl" in arrays and "hands_meanr" in arrays:
        hands = torch.cat([arrays["hands_meanl"], arrays["hands_meanr"]])
        rotations[-30:] = rearrange(hands, "(joints axes) -> joints axes", axes=3)
    return axis_angle_to_matrix(rotations)
