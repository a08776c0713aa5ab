"""Importer of MDM: `model000200000.pt`, `args.json`, and HumanML3D's `Mean.npy` and `Std.npy`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from stmc.composing.sampling import Sampling
from stmc.denoisers import MdmDecoder, MdmEncoder
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
    state_dict,
)
from stmc.settings.records import quote

DEFAULTS = {
    "dataset": "humanml",
    "arch": "trans_enc",
    "text_encoder_type": "clip",
    "emb_trans_dec": False,
    "layers": 8,
    "latent_dim": 512,
    "cond_mask_prob": 0.1,
    "unconstrained": False,
    "noise_schedule": "cosine",
    "diffusion_steps": 1000,
    "sigma_small": True,
    "mask_frames": False,
    "use_ema": False,
    "pred_len": 0,
    "context_len": 0,
    "multi_target_cond": False,
}
"""Defaults of the published code for settings that `args.json` lacks."""
CHOICES = {
    "dataset": ("humanml",),
    "arch": ("trans_enc", "trans_dec"),
    "text_encoder_type": ("clip", "bert"),
    "noise_schedule": ("cosine", "linear"),
    "unconstrained": (False,),
    "sigma_small": (True,),
    "pred_len": (0,),
    "context_len": (0,),
    "multi_target_cond": (False,),
}
"""Values that this library supports."""
TABLES = ("sequence_pos_encoder.pe", "embed_timestep.sequence_pos_encoder.pe")
FRAMES, FPS, FEATURES = 196, 20, 263
DISTILBERT = "distilbert/distilbert-base-uncased"


def read(path: Path, statistics: Path | None = None, text_model: str | None = None) -> Imported:
    """Read the model of a `.pt` file, or of the only one in a folder, with `args.json` next to it.

    Args:
        path: File of the weights, or its folder.
        statistics: Folder of the `Mean.npy` and `Std.npy` of training, HumanML3D's own; None uses the folder of the
            weights.
        text_model: Folder or hub name of the text encoder's weights; None uses the published ones on the hub.

    Raises:
        CheckpointError: If a file is missing, damaged, does not fit, or is not supported.
    """
    path = only_file(path, "model*.pt") if path.is_dir() else path
    settings, names = _settings(path.parent / "args.json")
    weights = drop_prefix(_weights(read_checkpoint(path), settings, path), "clip_model.")
    leading = _leading_token(settings, names)
    config = _describe_parts(settings, leading, text_model)
    learned = {name: value for name, value in weights.items() if name not in TABLES}
    parts = build_parts(config, learned, path.parent / "args.json", str(path))
    network = parts["denoiser"]
    fill(network, drop_tables(weights, TABLES, network.positions, path), str(path))
    folder = path.parent if statistics is None else statistics
    model = Model(
        **parts,
        motion_statistics=read_statistics(folder / "Mean.npy", folder / "Std.npy", FEATURES),
        text_statistics=identity_statistics(parts["text_encoder"].width),
        skeleton=parts["representation"].skeleton,
        fps=FPS,
        longest=FRAMES,
        sampling=Sampling(guidance=2.5 if settings["cond_mask_prob"] else 1.0, noise_scale="std"),
        config=config,
    )
    facts = [
        f"MDM (Tevet et al. 2023), {settings['arch']}, {settings['diffusion_steps']} steps, trained on HumanML3D.",
        f"Weights: {path.name}{', their moving average' if settings['use_ema'] else ''}.",
        "Sampled as published: the textbook's DDPM, guidance 2.5"
        + (", every crop with 196 frames in sight." if network.fixed_length else "."),
    ]
    if leading is not None:
        facts.append(f"The decoder's leading token encodes the {leading.replace('_', ' ')}.")
    return Imported(model, "MDM", tuple(facts))


def _settings(path: Path) -> tuple[dict[str, Any], set[str]]:
    """Return the settings, with defaults for missing ones, and the names of those in the file."""
    stored = read_json(path)
    settings = DEFAULTS | stored
    if "unconstrained" not in stored and "cond_mode" in stored:  # before August 2022
        settings["unconstrained"] = "text" not in str(stored["cond_mode"])
    for name, choices in CHOICES.items():
        if not any(settings[name] is choice or settings[name] == choice for choice in choices):
            raise CheckpointError(
                f"{path}: {name} is {quote(settings[name])}, but only {' or '.join(map(repr, choices))} can be imported"
            )
    for name in ("layers", "latent_dim", "diffusion_steps"):
        check_size(settings[name], name, path)
    if settings["arch"] == "trans_enc" and settings["text_encoder_type"] == "bert":
        raise CheckpointError(
            f"{path}: trans_enc does not support bert; the published encoder reads CLIP's sentences only"
        )
    return settings, set(stored)


def _weights(content: dict[str, Any], settings: Mapping[str, Any], path: Path) -> dict[str, Tensor]:
    """Return the flat mapping of old files, or one of the two in files with a moving average."""
    if "model" not in content and "model_avg" not in content:
        return state_dict(content, str(path))
    name = "model_avg" if settings["use_ema"] else "model"
    if name not in content:
        raise CheckpointError(f"{path} has no {name}, but args.json has use_ema {settings['use_ema']}")
    return state_dict(content[name], f"{path}: {name}")


def _leading_token(settings: Mapping[str, Any], names: set[str]) -> str | None:
    """Return the kind of the leading token.

    The version of the code that supports several text encoders, and names the encoder in `args.json`, encodes the step
    alone.
    """
    if settings["arch"] == "trans_enc" or not settings["emb_trans_dec"]:
        return None
    return "step" if "text_encoder_type" in names else "step_and_text"


def _describe_parts(settings: Mapping[str, Any], leading: str | None, text_model: str | None) -> dict[str, Any]:
    encoder = MdmEncoder if settings["arch"] == "trans_enc" else MdmDecoder
    bert = settings["text_encoder_type"] == "bert"
    source = {} if text_model is None else {"source": text_model}
    texts = (
        {"_target_": "stmc.text.Tokens", "source": DISTILBERT, "width": 768} | source
        if bert
        else {"_target_": "stmc.text.Clip", "tokens": 22, "weights": "fp16"} | source
    )
    return {
        "denoiser": {
            "_target_": f"stmc.denoisers.{encoder.__name__}",
            "features": FEATURES,
            "text_width": 768 if bert else 512,
            "width": settings["latent_dim"],
            "layers": settings["layers"],
            "fixed_length": None if settings["mask_frames"] else FRAMES,
        }
        | ({} if leading is None else {"leading": leading}),
        "schedule": {
            "_target_": f"stmc.diffusion.Schedule.{settings['noise_schedule']}",
            "steps": settings["diffusion_steps"],
        },
        "text_encoder": {"_target_": "stmc.text.EmptyAsZeros", "encoder": texts},
        "representation": {"_target_": "stmc.motion.representation.HumanML3DRepresentation"},
    }
