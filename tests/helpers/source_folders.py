"""AMASS and HumanML3D as people have them on their disks, small and made up: what the tests prepare and train on."""

import json
import pickle
from concurrent.futures import Executor, Future
from pathlib import Path

import numpy as np
import torch
from einops import rearrange
from helpers.motions import walking

from stmc.motion.body_model import Skeleton
from stmc.motion.geometry import matrix_to_axis_angle
from stmc.motion.motion import Motion
from stmc.motion.representation import HumanML3DRepresentation
from stmc.motion.representation.humanml3d import features_to_joints

PUBLISHED = {
    "000000": ("KIT/3/kick_high_left02_poses", "train", (("someone walks and raises the right arm", 0.0, 3.0),)),
    "000001": ("BioMotionLab_NTroje/rub001/0000_treadmill_norm_poses", "train", (("a person walks", 0.0, 2.5),) * 2),
    "000002": ("CMU/01/01_01_poses", "val", (("walks", 0.0, 3.0), ("a man lifts his right arm", 0.5, 2.75))),
    "000003": ("ACCAD/Male2Walking_c3d/B1 - stand to walk_poses", "test", (("walking", 1.0, 2.0),)),
    "M000000": ("M/KIT/3/kick_high_left02_poses", "train", (("someone walks and raises the left arm", 0.0, 3.0),)),
}
"""HumanML3D's entries: id → AMASS's path, split, texts with seconds."""


class Serial(Executor):
    """Workers in this process and thread, for speed; their arguments are pickled, as on the way to another process.

    No threads: production has processes, and CPython's `ast`, which NumPy reads headers with, is not safe in threads.
    """

    def __init__(self, workers: int, **_: object) -> None: ...

    def submit(self, call, /, *given) -> Future:
        future = Future()
        try:
            future.set_result(call(*pickle.loads(pickle.dumps(given))))
        except Exception as error:
            future.set_exception(error)
        return future


def recorded(number: int = 0, fps: float = 120.0, seconds: float = 3.2) -> Motion:
    """Somebody walks; everybody in their own way."""
    return walking(seconds, fps, speed=1.0 + 0.1 * number, turn=0.2 - 0.1 * number)


def smplh_arrays(motion: Motion) -> dict[str, np.ndarray]:
    """The arrays of AMASS's SMPL-H files."""
    frames = motion.frames
    body = rearrange(matrix_to_axis_angle(motion.rotations), "frames joints axes -> frames (joints axes)").numpy()
    return {
        "trans": Skeleton.default().smpl_translation(motion.translation).numpy(),
        "gender": np.array("female"),
        "mocap_framerate": np.array(float(motion.fps)),
        "betas": np.linspace(-1, 1, 16),
        "dmpls": np.zeros((frames, 8)),
        "poses": np.concatenate([body, np.full((frames, 90), 0.1)], axis=1),
    }


def smplx_arrays(motion: Motion) -> dict[str, np.ndarray]:
    """The arrays of AMASS's SMPL-X files: `_stageii.npz`."""
    plain, frames = smplh_arrays(motion), motion.frames
    poses = np.concatenate([plain["poses"][:, :66], np.full((frames, 99), 0.1)], axis=1)
    return {
        "gender": np.array("neutral"),
        "surface_model_type": np.array("smplx"),
        "mocap_frame_rate": plain["mocap_framerate"],
        "mocap_time_length": np.array(frames / motion.fps),
        "markers_latent": np.zeros((53, 3)),
        "trans": plain["trans"],
        "poses": poses,
        "betas": np.zeros(16),
        "root_orient": poses[:, :3],
        "pose_body": poses[:, 3:66],
        "pose_hand": poses[:, 75:],
    }


def amass(folder: Path) -> Path:
    """The recordings of `PUBLISHED`, from several releases, at several frame rates, with all that lies beside them."""
    files = {
        "KIT/3/kick_high_left02_poses.npz": smplh_arrays(recorded(0, 100.0)),
        "BMLrub/rub001/0000_treadmill_norm_poses.npz": smplh_arrays(recorded(1)),
        "CMU/01/01_01_stageii.npz": smplx_arrays(recorded(2, 60.0)),
        "ACCAD/Male2Walking_c3d/B1_-_stand_to_walk_poses.npz": smplh_arrays(recorded(3)),
        "KIT/3/shape.npz": {"betas": np.zeros(16), "gender": np.array("male")},
        "CMU/01/neutral_stagei.npz": {"betas": np.zeros(16), "markers_latent": np.zeros((53, 3))},
    }
    for name, arrays in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        np.savez(folder / name, **arrays)
    (folder / "LICENSE.txt").write_text("none")
    return folder


def published(folder: Path, entries: dict = PUBLISHED, **changes: object) -> Path:
    """`annotations.json` and `splits/` as TMR and STMC publish them; `changes` replace whole entries."""
    table, splits = {}, {"train": [], "val": [], "test": []}
    for name, (path, split, texts) in entries.items():
        annotations = [
            {"seg_id": f"{name}_{place}", "text": text, "start": start, "end": end}
            for place, (text, start, end) in enumerate(texts)
        ]
        table[name] = {"path": path, "duration": max(end for _, _, end in texts), "annotations": annotations}
        splits[split].append(name)
    (folder / "splits").mkdir(parents=True)
    (folder / "annotations.json").write_text(json.dumps(table | changes), encoding="utf-8")
    for split, names in splits.items():
        (folder / "splits" / f"{split}.txt").write_text("\n".join([*names, *(changes if split == "train" else ())]))
    return folder


def babel(folder: Path) -> Path:
    """`train.json` and `val.json` as BABEL has them."""

    def label(text, **times):
        return {"raw_label": text, "proc_label": text, "seg_id": "a-b", "act_cat": [text]} | times

    frames = [
        label("walk", start_t=0.0, end_t=1.5),
        label("transition", start_t=1.5, end_t=1.75),
        label("raise right arm", start_t=1.75, end_t=3.0),
    ]
    whole = {"anntr_id": "x", "babel_lid": "y", "mul_act": False, "labels": [label("walking")]}
    kick = {"babel_sid": 1, "feat_p": "KIT/KIT/3/kick_high_left02_poses.npz", "dur": 3.2, "seq_ann": whole}
    rub = "BMLrub/BioMotionLab_NTroje/rub001/0000_treadmill_norm_poses.npz"
    folder.mkdir(parents=True, exist_ok=True)
    first = kick | {"frame_ann": whole | {"labels": frames}}
    (folder / "train.json").write_text(json.dumps({"1": first}))
    (folder / "val.json").write_text(json.dumps({"2": kick | {"feat_p": rub, "frame_ann": None}}))
    return folder


CAPTIONS = "a person walks in a circle.#a/DET person/NOUN walk/VERB in/ADP a/DET circle/NOUN#0.0#0.0\n"


def humanml3d(folder: Path, clips: int = 6) -> Path:
    """The folder that HumanML3D's notebooks leave: clips of 70 frames and more, each with its mirror image."""
    representation = HumanML3DRepresentation()
    for name in ("new_joint_vecs", "new_joints", "texts"):
        (folder / name).mkdir(parents=True)
    names, rows = [], []
    for number in range(clips):
        motion = walking(3.6 + 0.2 * number, 20.0, speed=1.0 + 0.1 * number, turn=0.3)
        for name, moved in ((f"{number:06d}", motion), (f"M{number:06d}", motion.mirrored())):
            features = representation.encode(moved).float()
            np.save(folder / "new_joint_vecs" / f"{name}.npy", features.numpy())
            np.save(folder / "new_joints" / f"{name}.npy", features_to_joints(features).numpy())
            (folder / "texts" / f"{name}.txt").write_text(
                CAPTIONS + f"someone walks {name}#someone/NOUN walk/VERB#nan#nan\n"
            )
            names.append(name)
            rows.append(features)
    part = "raises an arm#raise/VERB an/DET arm/NOUN#1.0#3.25\n"
    (folder / "texts" / "000001.txt").write_text(CAPTIONS + part)
    every = torch.cat(rows)
    np.save(folder / "Mean.npy", every.mean(dim=0).numpy())
    np.save(folder / "Std.npy", every.std(dim=0).clamp(min=1e-3).numpy())
    for split, listed in (("train", names[:-4]), ("val", names[-4:-2]), ("test", names[-2:])):
        (folder / f"{split}.txt").write_text("\n".join(listed) + "\n")
    (folder / "train_val.txt").write_text("\n".join(names[:-2]))
    (folder / "all.txt").write_text("\n".join(names))
    return folder
