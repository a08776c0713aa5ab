"""Imported models sample as their publishers' loops do, from the first step to the last, through `generate`."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from helpers import checkpoints, published_loops
from test_published_flow_mdm import write as write_flow_mdm
from torch import Tensor

import stmc
from stmc.composing import METHODS
from stmc.denoisers import MdmEncoder, MdmSmpl, MotionDiffuse
from stmc.run.published import convert

LIMIT = 2e-5
"""Of the largest clean value, in normalised features."""

SEED, OVERLAP = 3, 10
TWO_TRACKS = [("walk forwards", 0, 40, ["legs"]), ("raise the right arm", 12, 30, ["right arm"])]
CROPS = ["walk forwards", "raise the right arm", "", ""]
"""Of the timeline above: its prompts, and a transition where the arm begins and one where it ends."""
ONE_TRACK = [("walk forwards", 0, 30), ("turn left", 30, 45), ("raise the arm", 45, 60)]

SLOW = pytest.mark.slow
SIZES = [
    pytest.param("small", id="small"),
    pytest.param("published", id="published", marks=SLOW),
]
"""Networks of a few weights, in the default tier, and those of the published sizes."""


def timeline(prompts: list[tuple], fps: int = 20) -> stmc.Timeline:
    return stmc.Timeline.parse(
        "\n".join(f"{text} # {start / fps} # {end / fps} # {' # '.join(parts)}" for text, start, end, parts in prompts)
    )


def imported(folder, write: Callable) -> tuple[stmc.Model, torch.nn.Module]:
    """Through `stmc import` and `stmc.load`, with the network that was written."""
    network = write(folder / "theirs")
    convert(folder / "theirs", folder / "ours", text_model=str(checkpoints.clip(folder / "clip")))
    return stmc.load(folder / "ours"), network


def sampled(model: stmc.Model, asked: stmc.Timeline, method: str) -> Tensor:
    """The normalised features that `generate` makes motions of."""
    made = []

    def watched(run) -> Tensor:
        made.append(METHODS[method].sample(run))
        return made[-1]

    model.generate(asked, seed=SEED, method=replace(METHODS[method], sample=watched))
    return made[0][0]


def words_of(model: stmc.Model, texts: list[str]) -> list[Tensor]:
    words, lengths = model.text_encoder.encode(texts)
    return [row[:length] for row, length in zip(words, lengths.tolist(), strict=True)]


def agree(ours: Tensor, theirs: Tensor) -> None:
    apart = float((ours[: len(theirs)] - theirs).abs().max() / theirs.abs().max())
    assert apart < LIMIT, f"{apart:.2g} of {float(theirs.abs().max()):.3g}"


def of_two_tracks(model: stmc.Model, answer, left: list[float], window: int | None, root: bool) -> Tensor:
    columns = {part.value: list(own) for part, own in model.representation.layout.columns.items()}
    prompts = [(start, end, parts) for _, start, end, parts in TWO_TRACKS]
    return published_loops.stmc(answer, left, prompts, columns, OVERLAP, SEED, window, root)


@pytest.mark.parametrize("size", SIZES)
@torch.inference_mode()
def test_mdm_is_sampled_as_in_its_published_integration(tmp_path, size):
    """All crops see 196 frames; the schedule of 50 steps is that of the authors' later weights."""
    published = size == "published"
    steps = 50 if published else 12
    network = checkpoints.seeded(lambda: MdmEncoder(263, 512, **({} if published else {"width": 16, "layers": 1})))
    sizes = {"latent_dim": 512, "layers": 8} if published else {}
    model, network = imported(tmp_path, lambda folder: checkpoints.mdm(folder, network, diffusion_steps=steps, **sizes))
    words = words_of(model, CROPS)
    answer = published_loops.guided_answer(network, words, torch.zeros(1, 512), 2.5)
    theirs = of_two_tracks(model, answer, published_loops.cosine(steps), 196, root=True)
    agree(sampled(model, timeline(TWO_TRACKS), "stmc_paper"), theirs)


@pytest.mark.parametrize("size", SIZES)
@torch.inference_mode()
def test_motion_diffuse_is_sampled_as_in_its_published_integration(tmp_path, size):
    published = size == "published"
    steps = 40 if published else 25
    network = checkpoints.seeded(lambda: MotionDiffuse(263, 512, **({} if published else {"width": 16, "layers": 1})))
    sizes = "num_layers: 8\nlatent_dim: 512" if published else "num_layers: 1\nlatent_dim: 16"
    model, network = imported(
        tmp_path,
        lambda folder: checkpoints.motion_diffuse(folder, f"{sizes}\ndiffusion_steps: {steps}", network),
    )
    left = published_loops.linear(steps)
    words = [network.encode_text(each[None])[0] for each in words_of(model, CROPS)]
    theirs = of_two_tracks(model, published_loops.noise_answer(network.denoise, words, left), left, None, root=True)
    agree(sampled(model, timeline(TWO_TRACKS), "stmc_paper"), theirs)


@pytest.mark.parametrize("size", SIZES)
@torch.inference_mode()
def test_mdm_smpl_is_sampled_as_in_its_published_code(tmp_path, size):
    """The one of the four whose noise is scaled by the variance (R1)."""
    published = size == "published"
    network = checkpoints.seeded(
        lambda: MdmSmpl(205, 512) if published else MdmSmpl(205, 512, width=16, feedforward=32, layers=1, heads=2)
    )
    heads = {"diffusion__denoiser__num_heads": 8} if published else {}
    model, network = imported(tmp_path, lambda folder: checkpoints.mdm_smpl(folder, network=network, **heads))
    state = torch.load(tmp_path / "theirs/logs/checkpoints/last.ckpt", weights_only=True)["state_dict"]
    mean, std = (state[f"text_normalizer.{moment}"] for moment in ("mean", "std"))
    *words, null = ((each - mean) / (std + 1e-12) for each in words_of(model, [*CROPS, ""]))
    answer = published_loops.guided_answer(network, words, null, 2.5)
    theirs = of_two_tracks(model, answer, published_loops.cosine(100), None, root=False)
    agree(sampled(model, timeline(TWO_TRACKS), "stmc_paper"), theirs)


FLOW_MDM = {"width": 512, "feedforward": 1024, "layers": 8, "heads": 4}


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize(
    ("dataset", "fps", "absolute", "scale", "window"), [("humanml", 20, 60, 2.5, 150), ("babel", 30, 125, 1.5, 100)]
)
@torch.inference_mode()
def test_flow_mdm_is_sampled_as_in_its_published_code(tmp_path, size, dataset, fps, absolute, scale, window):
    sizes = FLOW_MDM | {"attention_window": window} if size == "published" else {}
    steps = 160 if size == "published" else absolute + 5
    model, network = imported(tmp_path, lambda folder: write_flow_mdm(folder, dataset, steps=steps, **sizes))
    texts, lengths = zip(*((text, end - start) for text, start, end in ONE_TRACK), strict=True)
    words = network.embed_text(torch.cat(words_of(model, list(texts))))
    more = {"null": network.embed_text(torch.zeros(1, 512)), "absolute": absolute, "scale": scale, "seed": SEED}
    width, left = model.representation.width, published_loops.cosine(steps)
    asked = timeline([(*prompt, ["legs", "left arm", "right arm", "head", "spine"]) for prompt in ONE_TRACK], fps)
    theirs = published_loops.flow_mdm(network.blended, words, lengths, width, left, more)
    agree(sampled(model, asked, "flow_mdm"), theirs)
    if size == "small":  # a single text, by STMC's rule, is the same loop, with every frame in one crop
        alone = timeline([("turn left", 0, 40, ["legs"])], fps)
        theirs = published_loops.flow_mdm(network.blended, words[1:2], [40], width, left, more)
        agree(sampled(model, alone, "stmc_paper"), theirs)
