"""Importer of MotionDiffuse: `opt.txt`, `model/latest.tar`, `meta/mean.npy` and `meta/std.npy`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from stmc.composing.sampling import Sampling
from stmc.model import Model
from stmc.run.published.torch_checkpoint import (
    CheckpointError,
    Imported,
    build_parts,
    check_size,
    describe_weights,
    drop_prefix,
    fill,
    identity_statistics,
    read_checkpoint,
    read_statistics,
    size_of,
    state_dict,
)

CHECKPOINT = Path("model/latest.tar")
DEFAULTS = {
    "dataset_name": "t2m",
    "num_layers": "8",
    "latent_dim": "512",
    "diffusion_steps": "1000",
    "no_clip": "False",
    "no_eff": "False",
}
"""Defaults of the published code for settings that `opt.txt` lacks."""
CHOICES = {"dataset_name": ("t2m",), "no_clip": ("False",), "no_eff": ("False",)}
"""Values that this library supports."""
FPS, FEATURES = 20, 263


def read(folder: Path, checkpoint: Path | None = None, text_model: str | None = None) -> Imported:
    """Read the model of a folder.

    Args:
        folder: Folder of the checkpoint.
        checkpoint: File of the weights; None uses `model/latest.tar`.
        text_model: Folder or hub name of CLIP's weights; None uses the published ones on the hub. The copy in the
            checkpoint is ignored.

    Raises:
        CheckpointError: If a file is missing, damaged, does not fit, or is not supported.
    """
    checkpoint = folder / CHECKPOINT if checkpoint is None else checkpoint
    settings = _settings(folder / "opt.txt")
    content = read_checkpoint(checkpoint)
    if "encoder" not in content:
        raise CheckpointError(f"{checkpoint} has no encoder; it must be a checkpoint of MotionDiffuse")
    weights = drop_prefix(state_dict(content["encoder"], f"{checkpoint}: encoder"), "clip.")
    config = _describe_parts(settings, weights, str(checkpoint), text_model)
    parts = build_parts(config, weights, folder / "opt.txt", f"{checkpoint}: encoder")
    network = parts["denoiser"]
    fill(network, weights, f"{checkpoint}: encoder")
    model = Model(
        **parts,
        motion_statistics=read_statistics(folder / "meta" / "mean.npy", folder / "meta" / "std.npy", FEATURES),
        text_statistics=identity_statistics(parts["text_encoder"].width),
        skeleton=parts["representation"].skeleton,
        fps=FPS,
        longest=config["denoiser"]["frames"],
        prediction="eps",
        sampling=Sampling(guidance=1.0, noise_scale="std"),
        config=config,
    )
    facts = (
        "MotionDiffuse (Zhang et al. 2022), text to motion, trained on HumanML3D.",
        describe_weights(checkpoint, content.get("ep")),
        "Sampled as published: the textbook's DDPM, without guidance.",
    )
    return Imported(model, "MotionDiffuse", facts)


def _settings(path: Path) -> dict[str, Any]:
    """Read the lines `name: value` of `opt.txt`, with defaults for missing ones and sizes as numbers."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise CheckpointError(f"{path} cannot be read: {error}") from error
    stored = {name.strip(): value.strip() for name, colon, value in (line.partition(":") for line in lines) if colon}
    settings: dict[str, Any] = DEFAULTS | stored
    for name, choices in CHOICES.items():
        if settings[name] not in choices:
            raise CheckpointError(
                f"{path}: {name} is {settings[name]:.60}, but only {' or '.join(choices)} can be imported"
            )
    for name in ("num_layers", "latent_dim", "diffusion_steps"):
        value = settings[name]
        settings[name] = check_size(int(value) if value.isdecimal() and len(value) < 10 else value, name, path)
    return settings


def _describe_parts(
    settings: Mapping[str, Any], weights: Mapping[str, Tensor], place: str, text_model: str | None
) -> dict[str, Any]:
    return {
        "denoiser": {
            "_target_": "stmc.denoisers.MotionDiffuse",
            "features": FEATURES,
            "text_width": size_of(weights, "text_pre_proj.weight", 1, place),
            "width": settings["latent_dim"],
            "layers": settings["num_layers"],
            "frames": size_of(weights, "sequence_embedding", 0, place),
        },
        "schedule": {"_target_": "stmc.diffusion.Schedule.linear", "steps": settings["diffusion_steps"]},
        "text_encoder": {"_target_": "stmc.text.ClipTokens"} | ({} if text_model is None else {"source": text_model}),
        "representation": {"_target_": "stmc.motion.representation.HumanML3DRepresentation"},
    }
