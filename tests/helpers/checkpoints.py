"""Small checkpoints in the three published formats, written as their authors' code writes them."""

import json
from pathlib import Path

import numpy as np
import torch
import transformers
from test_text import END, VOCABULARY, save_tokenizer
from torch import nn

from stmc.denoisers import MdmDecoder, MdmEncoder, MdmSmpl, MotionDiffuse, Network

SMALL = {"latent_dim": 16, "layers": 1}
CLIP_PARTS = {"text_projection": torch.ones(2, 2), "visual.conv1.weight": torch.ones(2)}
"""Names of the copy of CLIP that some checkpoints hold."""


def seeded(make) -> Network:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return make().eval().requires_grad_(False)


def statistics(folder: Path, mean: str, std: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    np.save(folder / mean, rng.standard_normal(263).astype(np.float32))
    np.save(folder / std, rng.uniform(0.5, 1.5, 263).astype(np.float32))


def mdm(folder: Path, network: Network | None = None, name: str = "model000200000.pt", wrap=dict, **args) -> Network:
    """As MDM's training writes them: parameters themselves, both tables of positions, perhaps a copy of CLIP."""
    network = network or seeded(lambda: MdmEncoder(263, 512, width=16, layers=1))
    statistics(folder, "Mean.npy", "Std.npy")
    tables = {
        name: network.positions[:, None].clone()
        for name in ("sequence_pos_encoder.pe", "embed_timestep.sequence_pos_encoder.pe")
    }
    weights = {key: nn.Parameter(value.clone()) for key, value in network.state_dict().items()}
    copy = {f"clip_model.{key}": value for key, value in CLIP_PARTS.items()}
    torch.save(wrap(weights | tables | copy), folder / name)
    (folder / "args.json").write_text(json.dumps({"dataset": "humanml", "batch_size": 64} | SMALL | args))
    return network


def mdm_decoder(text_width: int = 512, leading=None) -> Network:
    return seeded(lambda: MdmDecoder(263, text_width, width=16, layers=1, leading=leading))


OPTIONS = """\
------------ Options -------------
batch_size: 128
dataset_name: t2m
feat_bias: 5
is_train: True
name: t2m_motiondiffuse
{more}
-------------- End ----------------
"""


def motion_diffuse(
    folder: Path, more: str = "num_layers: 1\nlatent_dim: 16", network: Network | None = None, **content
) -> Network:
    network = network or seeded(lambda: MotionDiffuse(263, 512, width=16, layers=1))
    statistics(folder / "meta", "mean.npy", "std.npy")
    copy = {f"clip.{key}": value for key, value in CLIP_PARTS.items()}
    (folder / "model").mkdir(exist_ok=True)
    state = {"encoder": network.state_dict() | copy, "ep": 49, "total_it": 1000, "opt_encoder": {}}
    torch.save(state | content, folder / "model" / "latest.tar")
    (folder / "opt.txt").write_text(OPTIONS.format(more=more))
    return network


def mdm_smpl(folder: Path, weights: dict | None = None, network: Network | None = None, **changes) -> Network:
    network = network or seeded(lambda: MdmSmpl(205, 512, width=16, feedforward=32, layers=1, heads=2))
    draw = torch.Generator().manual_seed(0)
    state = {f"denoiser.{name}": value for name, value in network.state_dict().items()}
    for side, width in (("motion", 205), ("text", 512)):
        state[f"{side}_normalizer.mean"] = torch.randn(width, generator=draw)
        state[f"{side}_normalizer.std"] = 0.5 + torch.rand(width, generator=draw)
    content = {
        "epoch": 9999, "global_step": 12, "pytorch-lightning_version": "2.0.8", "state_dict": state | (weights or {}),
        "loops": {"fit_loop": {}}, "callbacks": {"ModelCheckpoint{}": {"dirpath": "logs", "best_model_score": None}},
        "optimizer_states": [{"state": {}, "param_groups": [{"lr": 1e-4}]}], "lr_schedulers": [],
    }  # fmt: skip
    (folder / "logs" / "checkpoints").mkdir(parents=True)
    torch.save(content, folder / "logs" / "checkpoints" / "last.ckpt")
    settings = {
        "motion_features": "smplrifke",
        "data": {
            "motion_loader": {"fps": 20.0},
            "text_encoder": {"modelname": "ViT-B/32", "mean_pooling": True},
        },
        "diffusion": {
            "denoiser": {"_target_": "src.model.TransformerDenoiser", "num_heads": 2, "dropout": 0.1},
            "schedule": {"_target_": "src.model.CosineSchedule"},
            "timesteps": 100,
            "prediction": "x",
        },
    }
    for place, value in changes.items():
        *above, last = place.split("__")
        node = settings
        for key in above:
            node = node[key]
        node[last] = value
    (folder / "config.json").write_text(json.dumps(settings))
    return network


def clip(folder: Path) -> Path:
    """Random weights with CLIP's widths and positions, and a tokenizer of a few words."""
    torch.manual_seed(0)
    config = transformers.CLIPTextConfig(
        vocab_size=len(VOCABULARY), hidden_size=512, intermediate_size=8, projection_dim=512, num_hidden_layers=1,
        num_attention_heads=2, max_position_embeddings=77, bos_token_id=1, eos_token_id=END, pad_token_id=END,
    )  # fmt: skip
    transformers.CLIPTextModelWithProjection(config).save_pretrained(folder)
    save_tokenizer(folder)
    return folder
