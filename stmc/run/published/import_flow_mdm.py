"""Importer of FlowMDM: `model000500000.pt` or `model001300000.pt`, `args.json` and statistics.

The statistics are those of the data: HumanML3D's `Mean.npy` and `Std.npy`, BABEL's `rfeats_mean.pt` and
`rfeats_std.pt`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from stmc.composing.sampling import Sampling
from stmc.denoisers.flow_mdm_layers import HEAD, ROTARY_DIM, frequencies
from stmc.diffusion.statistics import Statistics
from stmc.model import Model
from stmc.run.published.torch_checkpoint import (
    CheckpointError,
    Imported,
    build_parts,
    check_size,
    drop_prefix,
    drop_tables,
    fill,
    identity_statistics,
    only_file,
    read_checkpoint,
    read_json,
    read_statistics,
    read_tensor_statistics,
    size_of,
    state_dict,
)
from stmc.settings.records import quote


class Data(NamedTuple):
    """Properties that follow from the training data and are not in `args.json`."""

    representation: str
    fps: int
    longest: int
    absolute: int
    guidance: float
    tokens: int | None


DATA = {
    "humanml": Data("HumanML3DRepresentation", 20, 196, 60, 2.5, 22),
    "babel": Data("BabelRepresentation", 30, 250, 125, 1.5, None),
}
DEFAULTS = {"noise_schedule": "cosine", "diffusion_steps": 1000, "rpe_horizon": -1}
TABLES = ("sequence_pos_encoder.pe", "embed_timestep.sequence_pos_encoder.pe", "t_pos_encoder.pe")
ROTARY = "seqTransEncoder.attn_layers.rotary_pos_emb."
FREQUENCIES = f"{ROTARY}relative.inv_freq"


def is_flow_mdm(args: Path) -> bool:
    """Return whether an `args.json` is FlowMDM's and not MDM's: it names the window of attention."""
    return "rpe_horizon" in read_json(args)


def read(path: Path, statistics: Path | None = None, text_model: str | None = None) -> Imported:
    """Read the model of a `.pt` file, or of the only one in a folder, with `args.json` next to it.

    The steps with absolute positions, and the guidance, are the paper's for the data set.

    Args:
        path: File of the weights, or its folder.
        statistics: Folder of the mean and standard deviation of training; None uses the folder of the weights.
        text_model: Folder or hub name of CLIP's weights; None uses the published ones on the hub.

    Raises:
        CheckpointError: If a file is missing, damaged, does not fit, or is not supported.
    """
    path = only_file(path, "model*.pt") if path.is_dir() else path
    args = path.parent / "args.json"
    settings = _settings(args)
    data = DATA[settings["dataset"]]
    weights = drop_prefix(state_dict(read_checkpoint(path), str(path)), "clip_model.")
    config = _describe_parts(settings, weights, str(path), text_model)
    fitting = drop_prefix({name: value for name, value in weights.items() if name not in TABLES}, ROTARY)
    parts = build_parts(config, fitting, args, str(path))
    network, representation = parts["denoiser"], parts["representation"]
    learned = drop_prefix(drop_tables(weights, TABLES, network.positions, path), ROTARY)
    _check_frequencies(weights, path)
    fill(network, learned, str(path))
    folder = path.parent if statistics is None else statistics
    model = Model(
        **parts,
        motion_statistics=_statistics(folder, settings["dataset"], representation.width),
        text_statistics=identity_statistics(parts["text_encoder"].width),
        skeleton=representation.skeleton,
        fps=data.fps,
        longest=data.longest,
        sampling=Sampling(guidance=data.guidance, noise_scale="std"),
        config=config,
    )
    steps, first = settings["diffusion_steps"], network.absolute_from
    facts = (
        f"FlowMDM (Barquero et al. 2024), {steps} steps, trained on {settings['dataset']}.",
        f"Weights: {path.name}.",
        f"Sampled as published: steps {first} to {steps - 1} with absolute positions, the textbook's DDPM, guidance "
        f"{data.guidance}; sequences of several texts with method=flow_mdm.",
        "FlowMDM's licence allows non-commercial research only, and forbids redistribution of its files.",
    )
    return Imported(model, "FlowMDM", facts)


def _settings(path: Path) -> dict[str, Any]:
    settings = DEFAULTS | read_json(path)
    for name, choices in (("dataset", tuple(DATA)), ("noise_schedule", ("cosine", "linear"))):
        if not isinstance(settings.get(name), str) or settings[name] not in choices:
            raise CheckpointError(f"{path}: {name} must be {' or '.join(choices)}, not {quote(settings.get(name))}")
    for name in ("diffusion_steps", "rpe_horizon"):
        check_size(settings[name], name, path)
    return settings


def _describe_parts(
    settings: Mapping[str, Any], weights: Mapping[str, Tensor], place: str, text_model: str | None
) -> dict[str, Any]:
    """Describe the parts: sizes from the weights, everything else from the settings and the data set."""
    data, steps = DATA[settings["dataset"]], settings["diffusion_steps"]

    def size(name: str, dimension: int) -> int:
        return size_of(weights, name, dimension, place)

    layers = "seqTransEncoder.attn_layers.layers."
    source = {} if text_model is None else {"source": text_model}
    limit = {} if data.tokens is None else {"tokens": data.tokens}
    return {
        "denoiser": {
            "_target_": "stmc.denoisers.FlowMdm",
            "features": size("output_process.poseFinal.weight", 0),
            "text_width": size("embed_text.weight", 1),
            "absolute_from": max(0, steps - data.absolute + 1),  # with few steps all are absolute
            "width": size("embed_text.weight", 0),
            "feedforward": size(f"{layers}1.1.ff.0.0.weight", 0),
            "layers": sum(name.endswith(".to_q.weight") for name in weights),
            "heads": size(f"{layers}0.1.to_q.weight", 0) // HEAD,
            "attention_window": settings["rpe_horizon"],
        },
        "schedule": {"_target_": f"stmc.diffusion.Schedule.{settings['noise_schedule']}", "steps": steps},
        "text_encoder": {
            "_target_": "stmc.text.EmptyAsZeros",
            "encoder": {"_target_": "stmc.text.Clip", "weights": "fp16"} | limit | source,
        },
        "representation": {"_target_": f"stmc.motion.representation.{data.representation}"},
    }


def _check_frequencies(weights: Mapping[str, Tensor], path: Path) -> None:
    expected = frequencies(ROTARY_DIM // 2).float()
    actual = weights.get(FREQUENCIES, expected).float()
    if actual.shape != expected.shape or not torch.allclose(actual, expected, rtol=1e-2):
        raise CheckpointError(f"{path}: {FREQUENCIES} {list(actual.shape)} differs from FlowMDM's rotary positions")


def _statistics(folder: Path, dataset: str, width: int) -> Statistics:
    if dataset == "humanml":
        return read_statistics(folder / "Mean.npy", folder / "Std.npy", width)
    return read_tensor_statistics(folder / "rfeats_mean.pt", folder / "rfeats_std.pt", width)
