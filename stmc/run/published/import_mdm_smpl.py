"""Importer of STMC's MDM-SMPL: a run of Lightning with `config.json` and `logs/checkpoints/last.ckpt`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from stmc.diffusion import Prediction
from stmc.diffusion.statistics import Statistics
from stmc.model import Model
from stmc.run.published.torch_checkpoint import (
    CheckpointError,
    Imported,
    build_parts,
    check_size,
    describe_weights,
    fill,
    read_checkpoint,
    read_json,
    size_of,
    state_dict,
    statistics_plus_epsilon,
)
from stmc.settings.records import quote

CHECKPOINT = Path("logs/checkpoints/last.ckpt")
LONGEST = 10.0
"""Duration in seconds of the longest training clips."""
REPRESENTATIONS = {"smplrifke": "SmplRepresentation", "guoh3dfeats": "HumanML3DRepresentation"}
PREDICTIONS: Mapping[str, Prediction] = {
    "x": "x0",
    "x0": "x0",
    "eps": "eps",
    "epsilon": "eps",
    "v": "v",
    "score": "score",
}
CLIP = ("ViT-B/32", "clip", "openai/clip-vit-base-patch32")


def read(folder: Path, checkpoint: Path | None = None, text_model: str | None = None) -> Imported:
    """Read the model of a run directory.

    Args:
        folder: Folder of the run.
        checkpoint: File of the weights; None uses the last checkpoint.
        text_model: Folder or hub name of the text encoder's weights; None uses the published ones on the hub.

    Raises:
        CheckpointError: If settings, weights or statistics are missing, invalid or do not fit.
    """
    checkpoint = folder / CHECKPOINT if checkpoint is None else checkpoint
    settings = read_json(folder / "config.json")
    content = read_checkpoint(checkpoint)
    if "state_dict" not in content:
        raise CheckpointError(f"{checkpoint} has no state_dict; it must be a checkpoint of PyTorch Lightning")
    weights = state_dict(content["state_dict"], f"{checkpoint}: state_dict")
    denoiser = {
        name.removeprefix("denoiser."): value for name, value in weights.items() if name.startswith("denoiser.")
    }
    config = _describe_parts(settings, denoiser, folder / "config.json", str(checkpoint), text_model)
    parts = build_parts(config, denoiser, folder / "config.json", f"{checkpoint}: denoiser")
    network = parts["denoiser"]
    fill(network, denoiser, f"{checkpoint}: denoiser")
    rest = {name: value for name, value in weights.items() if not name.startswith("denoiser.")}
    motion = _statistics(rest, "motion", parts["representation"].width, checkpoint)
    text = _statistics(rest, "text", parts["text_encoder"].width, checkpoint)
    if unknown := [name for name in rest if not name.startswith(("motion_normalizer.", "text_normalizer."))]:
        raise CheckpointError(f"{checkpoint} has weights of another model: {', '.join(unknown)}")
    fps = _fps(settings, folder / "config.json")
    model = Model(
        **parts,
        motion_statistics=motion,
        text_statistics=text,
        skeleton=parts["representation"].skeleton,
        fps=fps,
        longest=int(LONGEST * fps),
        prediction=_prediction(settings, folder / "config.json"),
        config=config,
    )
    facts = (
        "MDM-SMPL (Petrovich et al. 2024), trained with the code of STMC.",
        describe_weights(checkpoint, content.get("epoch")),
        "Sampled as published: DDPM's noise scaled by the posterior's variance, guidance 2.5.",
    )
    return Imported(model, "MDM-SMPL", facts)


def _fps(settings: Mapping[str, Any], path: Path) -> float | int:
    fps = _setting(settings, "data.motion_loader.fps", path)
    if isinstance(fps, bool) or not isinstance(fps, (int, float)) or not 0 < fps <= 1000:
        raise CheckpointError(f"{path}: data.motion_loader.fps must be a positive number up to 1000, not {quote(fps)}")
    return fps


def _describe_parts(
    settings: Mapping[str, Any], weights: Mapping[str, Tensor], path: Path, place: str, text_model: str | None
) -> dict[str, Any]:
    """Describe the parts: sizes from the weights, everything else from the settings."""
    features = _setting(settings, "motion_features", path)
    if not isinstance(features, str) or features not in REPRESENTATIONS:
        raise CheckpointError(f"{path}: motion_features must be {' or '.join(REPRESENTATIONS)}, not {quote(features)}")
    text_width = size_of(weights, "tx_embedding.0.weight", 1, place)
    options = _setting(settings, "diffusion.denoiser", path)
    options = options if isinstance(options, Mapping) else {}
    if options.get("activation", "gelu") != "gelu":
        raise CheckpointError(f"{path}: activation must be gelu, not {quote(options['activation'])}")
    layers = {name.split(".")[2] for name in weights if name.startswith("seqTransEncoder.layers.")}
    return {
        "denoiser": {
            "_target_": "stmc.denoisers.MdmSmpl",
            "features": size_of(weights, "skel_embedding.weight", 1, place),
            "text_width": text_width,
            "width": size_of(weights, "registers", 1, place),
            "feedforward": size_of(weights, "seqTransEncoder.layers.0.linear1.weight", 0, place),
            "layers": len(layers),
            "heads": options.get("num_heads", 8),
            "dropout": options.get("dropout", 0.1),
            "registers": size_of(weights, "registers", 0, place),
        },
        "schedule": _schedule(settings, path),
        "text_encoder": _text_encoder(settings, path, text_width, text_model),
        "representation": {"_target_": f"stmc.motion.representation.{REPRESENTATIONS[features]}"},
    }


def _schedule(settings: Mapping[str, Any], path: Path) -> dict[str, Any]:
    schedule = _setting(settings, "diffusion.schedule", path)
    kinds = [kind for kind in ("cosine", "linear") if kind in str(schedule).lower()]
    steps = _setting(settings, "diffusion.timesteps", path)
    if len(kinds) != 1:
        raise CheckpointError(f"{path}: diffusion.schedule must be cosine or linear, not {quote(schedule)}")
    offset = {"s": schedule["s"]} if isinstance(schedule, Mapping) and "s" in schedule else {}
    return {
        "_target_": f"stmc.diffusion.Schedule.{kinds[0]}",
        "steps": check_size(steps, "diffusion.timesteps", path),
    } | offset


def _text_encoder(settings: Mapping[str, Any], path: Path, width: int, text_model: str | None) -> dict[str, Any]:
    name = _setting(settings, "data.text_encoder.modelname", path)
    pooled = _setting(settings, "data.text_encoder.mean_pooling", path)
    if name in CLIP:
        return {"_target_": "stmc.text.Clip"} | ({} if text_model is None else {"source": text_model})
    if not isinstance(name, str):
        raise CheckpointError(f"{path}: data.text_encoder.modelname must be the name of a model, not {quote(name)}")
    if pooled:
        raise CheckpointError(
            f"{path}: mean_pooling of {quote(name)} is not supported; use CLIP, or tokens of any model"
        )
    return {"_target_": "stmc.text.Tokens", "source": text_model or name, "width": width}


def _prediction(settings: Mapping[str, Any], path: Path) -> Prediction:
    prediction = _setting(settings, "diffusion.prediction", path)
    if not isinstance(prediction, str) or prediction not in PREDICTIONS:
        raise CheckpointError(f"{path}: prediction must be one of {', '.join(PREDICTIONS)}, not {quote(prediction)}")
    return PREDICTIONS[prediction]


def _statistics(weights: Mapping[str, Tensor], side: str, width: int, path: Path) -> Statistics:
    values = []
    for moment in ("mean", "std"):
        name = f"{side}_normalizer.{moment}"
        if size_of(weights, name, 0, str(path)) != width or weights[name].ndim != 1:
            raise CheckpointError(f"{path}: {name} must hold {width} numbers, not {list(weights[name].shape)}")
        values.append(weights[name])
    mean, std = values
    return statistics_plus_epsilon(mean, std, f"{path}: {side}_normalizer")


def _setting(settings: Mapping[str, Any], name: str, path: Path) -> Any:
    value: Any = settings
    for key in name.split("."):
        if not isinstance(value, Mapping) or key not in value:
            raise CheckpointError(f"{path} has no setting {name}")
        value = value[key]
    return value
