"""The evaluator of Guo et al. as its authors leave it on a disk, small and with random weights; HumanML3D beside it."""

import pickle
from pathlib import Path

import numpy as np
import torch
from helpers.source_folders import humanml3d

from stmc.evaluators import GuoEvaluator

WORDS = ("sos", "eos", "unk", "a", "person", "walk", "in", "circle", "someone", "an", "arm", "raise", "slowly")
SECTIONS = ("movement_encoder", "text_encoder", "motion_encoder")
WIDTH = 6
"""Of a word's vector; the true ones have 300."""


def glove(folder: Path) -> Path:
    """`our_vab_data.npy`, `our_vab_words.pkl`, `our_vab_idx.pkl`."""
    folder.mkdir(parents=True)
    np.save(folder / "our_vab_data.npy", np.random.default_rng(0).standard_normal((len(WORDS), WIDTH)))
    for name, content in (("words", list(WORDS)), ("idx", {word: place for place, word in enumerate(WORDS)})):
        (folder / f"our_vab_{name}.pkl").write_bytes(pickle.dumps(content))
    return folder


def network() -> GuoEvaluator:
    """Of true features, and small; weights so large that no rank hangs on rounding."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        made = GuoEvaluator(259, (16, 12), 10, WIDTH, 8, 7).eval().requires_grad_(False)
        for parameter in made.parameters():
            parameter.mul_(2 if parameter.ndim > 1 else 1)
    return made


def evaluator(folder: Path) -> dict[str, Path]:
    """The files of the evaluator below `folder`, by the names of the settings that want them."""
    made, meta = network(), folder / "Comp_v6_KLD01" / "meta"

    meta.mkdir(parents=True)
    torch.save({name: getattr(made, name).state_dict() for name in SECTIONS} | {"epoch": 3}, folder / "finest.tar")
    np.save(meta / "mean.npy", np.linspace(-0.1, 0.1, 263))
    np.save(meta / "std.npy", np.linspace(0.2, 0.6, 263))
    return {"weights": folder / "finest.tar", "statistics": meta, "glove": glove(folder / "glove")}


def dataset(folder: Path, clips: int = 18) -> Path:
    """HumanML3D's folder, all clips of which are the test split's."""
    humanml3d(folder, clips)
    (folder / "test.txt").write_text((folder / "all.txt").read_text())
    return folder
