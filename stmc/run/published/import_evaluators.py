"""Importers of published evaluators: a run of TMR, and the `finest.tar` of Guo et al.

Names and shapes of their weights are those of `stmc.evaluators`; sizes are derived from the weights.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from stmc.diffusion.statistics import Statistics
from stmc.diffusion.tensors import resolve_device
from stmc.evaluators import Evaluator, GuoEvaluator, MatchingEvaluator
from stmc.io.arrays import ArraysError, read_npy
from stmc.motion.representation import BabelRepresentation, HumanML3DRepresentation
from stmc.run import EVALUATOR_PARTS
from stmc.run.published.torch_checkpoint import (
    CheckpointError,
    Imported,
    build_parts,
    fill,
    identity_statistics,
    read_checkpoint,
    read_json,
    read_tensor_statistics,
    size_of,
    state_dict,
)
from stmc.text.glove import Glove

WEIGHTS, CHECKPOINT = Path("last_weights"), Path("logs/checkpoints/last.ckpt")
PARTS = ("motion_encoder", "text_encoder", "motion_decoder")
STATISTICS = Path("stats/humanml3d/guoh3dfeats")
"""Path of the statistics in TMR's own folder, two levels above a run: per dimension, unlike HumanML3D's `Std.npy`."""
FPS, BABEL_FPS, HEADS = 20, 30, 4
DISTILBERT = "distilbert/distilbert-base-uncased"
SECTIONS = ("movement_encoder", "text_encoder", "motion_encoder")


def read_tmr(folder: Path, statistics: Path | None = None, text_model: str | None = None) -> Imported:
    """Read the evaluator of a run of TMR on HumanML3D's 263 features, with DistilBERT's tokens as texts.

    Args:
        folder: Folder of the run.
        statistics: Folder of `mean.pt` and `std.pt`; None uses TMR's own folder, above the run.
        text_model: Folder or hub name of DistilBERT's weights; None uses the hub.

    Raises:
        CheckpointError: If a file is missing or does not fit.
    """
    weights = _weights(folder)
    place = str(folder)
    sizes = {
        "features": size_of(weights, "motion_encoder.projection.weight", 1, place),
        "text_width": size_of(weights, "text_encoder.projection.weight", 1, place),
        "width": size_of(weights, "motion_encoder.tokens", 1, place),
        "feedforward": size_of(weights, "motion_encoder.seqTransEncoder.layers.0.linear1.weight", 0, place),
        "layers": sum(name.startswith("motion_encoder.") and name.endswith("norm1.weight") for name in weights),
        "heads": HEADS,
        "variational": size_of(weights, "motion_encoder.tokens", 0, place) == 2,
    }
    representation = HumanML3DRepresentation()
    moments = statistics or folder.absolute().parent.parent / STATISTICS
    if sizes["features"] != representation.width:
        raise CheckpointError(f"{folder} was trained on {sizes['features']} features, not HumanML3D's 263")
    text = {"_target_": "stmc.text.Tokens", "source": text_model or DISTILBERT, "width": sizes["text_width"]}
    config = {
        "network": {"_target_": "stmc.evaluators.Tmr"} | sizes,
        "text_encoder": text,
        "representation": {"_target_": "stmc.motion.representation.HumanML3DRepresentation"},
    }
    parts = build_parts(config, weights, folder, place, EVALUATOR_PARTS)
    fill(parts["network"], weights, place)
    evaluator = Evaluator(
        **parts,
        motion_statistics=read_tensor_statistics(moments / "mean.pt", moments / "std.pt", representation.width),
        text_statistics=identity_statistics(sizes["text_width"]),
        fps=FPS,
        config=config,
    )
    facts = ("TMR (Petrovich et al. 2023) on HumanML3D's 263 features.", f"Texts: tokens of {text['source']}.")
    return Imported(evaluator, "TMR", facts)


def read_guo(file: Path) -> GuoEvaluator:
    """Read the networks of Guo et al. from `finest.tar`.

    Raises `CheckpointError` if weights are missing or do not fit.
    """
    content = read_checkpoint(file)
    if missing := [section for section in SECTIONS if section not in content]:
        raise CheckpointError(f"{file} holds no {', '.join(missing)}; it must be the finest.tar of an evaluator")
    weights = {
        f"{section}.{name}": value
        for section in SECTIONS
        for name, value in state_dict(content[section], f"{file}: {section}").items()
    }

    def size(name: str, dimension: int) -> int:
        return size_of(weights, name, dimension, str(file))

    evaluator = GuoEvaluator(
        seen=size("movement_encoder.main.0.weight", 1),
        movements=(size("movement_encoder.main.0.weight", 0), size("movement_encoder.main.3.weight", 0)),
        motion_hidden=size("motion_encoder.hidden", 2),
        words=size("text_encoder.pos_emb.weight", 0),
        text_hidden=size("text_encoder.hidden", 2),
        width=size("motion_encoder.output_net.3.weight", 0),
    )
    fill(evaluator, weights, str(file))
    return evaluator


def read_guo_evaluator(
    weights: str | Path,
    statistics: str | Path,
    glove: str | Path,
    device: torch.device | str = "cpu",
    longest: int = 196,
) -> MatchingEvaluator:
    """Read the complete evaluator of Guo et al., or FlowMDM's for BABEL, from the published files.

    Args:
        weights: `text_mot_match/model/finest.tar`.
        statistics: Folder of the evaluator's own mean and standard deviation, which differ from HumanML3D's `Mean.npy`:
            `mean.npy` and `std.npy` (`Comp_v6_KLD01/meta`), or `t2m_mean.npy` and `t2m_std.npy`; for BABEL
            `rfeats_mean.pt` and `rfeats_std.pt`.
        glove: Folder of the word vectors.
        device: Device of the networks.
        longest: Number of frames to which motions are padded; see `MatchingEvaluator`.

    Raises:
        CheckpointError: If weights or statistics are missing or do not fit.
        ArraysError: If word vectors are missing or do not fit.
    """
    network = read_guo(Path(weights).expanduser()).to(resolve_device(device))
    words, vectors = network.text_encoder.pos_emb.out_features, Glove.read(glove)
    if vectors.vectors.shape[1] != words:
        raise ArraysError(f"{glove}: vectors have {vectors.vectors.shape[1]} numbers, but {weights} needs {words}")
    folder, babel = Path(statistics).expanduser(), BabelRepresentation()
    if network.seen == babel.width:
        names = (folder / "rfeats_mean.pt", folder / "rfeats_std.pt")
        moments = read_tensor_statistics(*names, babel.width)
        return MatchingEvaluator(network, moments, vectors, BABEL_FPS, babel, longest)
    return MatchingEvaluator(network, _read_guo_statistics(folder), vectors, FPS, longest=longest)


def _read_guo_statistics(folder: Path) -> Statistics:
    width, moments = HumanML3DRepresentation().width, []
    prefix = "t2m_" if (folder / "t2m_mean.npy").is_file() else ""
    for name in (f"{prefix}mean.npy", f"{prefix}std.npy"):
        if not (folder / name).is_file():
            raise CheckpointError(f"{folder / name} does not exist; Comp_v6_KLD01/meta next to the evaluator holds it")
        moments.append(torch.from_numpy(read_npy(folder / name)).float())
        if moments[-1].shape != (width,):
            raise CheckpointError(f"{folder / name} must hold {width} numbers, not {list(moments[-1].shape)}")
    return Statistics(*moments)


def is_tmr(folder: Path) -> bool:
    """Return whether a folder is a run of TMR: its weights have TMR's names, or its settings name no diffusion."""
    if (folder / WEIGHTS / f"{PARTS[0]}.pt").is_file():
        return True
    return (folder / "config.json").is_file() and "diffusion" not in read_json(folder / "config.json")


def _weights(folder: Path) -> Mapping[str, Tensor]:
    """Read weights from `last_weights`, with one file per part, or from the last checkpoint of the run."""
    if (folder / WEIGHTS).is_dir():
        return {
            f"{part}.{name}": value
            for part in PARTS
            for path in [folder / WEIGHTS / f"{part}.pt"]
            for name, value in state_dict(read_checkpoint(path), str(path)).items()
        }
    content = read_checkpoint(folder / CHECKPOINT)
    weights = state_dict(content.get("state_dict"), f"{folder / CHECKPOINT}: state_dict")
    return {name: value for name, value in weights.items() if name.startswith(PARTS)}
