"""Stitching, complete sampling runs and the padding on MTT: parity with the published code."""

import functools
import zlib
from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import checked, golden, golden_sets
from helpers.collages import FPS, last, padding_of, plans_of, timeline
from torch import Tensor

from stmc.composing import METHODS, NULL, Run, collage, crop_lengths, guided_crops, sinc, smooth_seams
from stmc.composing.sampling import Sampling
from stmc.denoisers import MdmSmpl
from stmc.diffusion import Schedule, ddpm
from stmc.diffusion.statistics import Statistics
from stmc.motion.body import BodyPart
from stmc.motion.representation import SmplRepresentation
from stmc.timeline import Timeline
from stmc.timeline.planning import Plan


def golden_columns(folder, layout: str) -> dict[BodyPart, list[int]]:
    return {BodyPart(part): own for part, own in golden(folder, "body_part_indexes.json")[layout].items()}


@functools.cache
@functools.cache
def mtt(folder) -> dict[int, Timeline]:
    return {
        entry["id"]: timeline(*[(str(i), *frames, *parts) for i, (*frames, parts) in enumerate(entry["prompts"])])
        for entry in golden(folder, "mtt_plans.json.gz")["timelines"]
    }


@pytest.mark.golden
@pytest.mark.parametrize("layout", ["smplrifke", "guoh3dfeats"])
@pytest.mark.parametrize("folder", golden_sets("stmc"))
def test_stitching_is_that_of_the_published_code(folder, layout):
    data, columns = golden(folder, f"stitch_{layout}.npz"), golden_columns(folder, layout)
    timelines = [mtt(folder)[i] for i in data["timeline_ids"]]
    overlap = int(data["overlap"])
    for overlap_of_plan, name in [(overlap, "ext"), (0, "noext")]:
        plans = plans_of(*timelines, overlap=overlap_of_plan)
        assert crop_lengths(plans) == tuple(data[f"lengths_{name}"])
        crops = torch.from_numpy(data[f"crops_{name}"]).float()
        composite = sinc(crops, plans, columns)
        assert torch.equal(composite, torch.from_numpy(data[f"composite_{name}"]).float())
        smooth = smooth_seams(composite, plans_of(*timelines, overlap=0), columns, overlap)
        if (expected := data.get(f"lerp_{'noext' if name == 'noext' else 'on_ext'}")) is not None:
            torch.testing.assert_close(smooth, torch.from_numpy(expected), atol=1e-4, rtol=0)


def golden_network(folder, data: dict) -> MdmSmpl:
    config = golden(folder, "sampling_meta.json")["config"]
    network = MdmSmpl(
        config["nfeats"],
        config["tx_dim"],
        config["latent_dim"],
        config["ff_size"],
        config["num_layers"],
        config["num_heads"],
        registers=config["nb_registers"],
    )
    weights = {}
    for name, value in network.state_dict().items():
        rng = np.random.default_rng(zlib.crc32(f"{data['weight_seed']}:{name}".encode()))
        weight = rng.standard_normal(tuple(value.shape)).astype(np.float32) * np.float32(0.05)
        norm = name.endswith("weight") and (".norm" in name or name.startswith("tx_embedding.3"))
        weights[name] = torch.from_numpy(weight + 1 if norm else weight)
    network.load_state_dict(weights)
    return network.eval()


class GoldenRun:
    """The published sampling runs: one network, one stream of noise for the whole batch, spread "variance"."""

    def __init__(self, folder) -> None:
        self.data = golden(folder, "sampling.npz")
        self.columns = golden_columns(folder, "smplrifke")
        self.schedule = Schedule.cosine(int(self.data["T"]))
        self.network = golden_network(folder, self.data)
        self.timelines, row = [], 0
        for prompts in golden(folder, "sampling_meta.json")["timelines"]:
            named = [(str(row + i), a, b, *parts) for i, (a, b, parts) in enumerate(prompts)]
            self.timelines.append(timeline(*named))
            row += len(prompts)

    def embeddings(self, stats: bool = False) -> dict[str, Tensor]:
        mean, std = (self.data["text_mean"], self.data["text_std"]) if stats else (0, 1)
        table = {str(i): tx for i, tx in enumerate(self.data["tx"])} | {NULL: self.data["tx_uncond"]}
        return {text: torch.from_numpy(np.float32((tx - mean) / (std + 1e-12))) for text, tx in table.items()}

    def draw(self, seed: str = "noise_seed"):
        rng = np.random.default_rng(int(self.data[seed]))
        return lambda shape: torch.from_numpy(rng.standard_normal(tuple(shape)).astype(np.float32))

    @torch.no_grad()
    def stmc(self, weight: float, stats: bool = False) -> tuple[list[Tensor], list[Tensor]]:
        """x_t before, and x0 after, every step."""
        plans = plans_of(*self.timelines, overlap=int(self.data["overlap"]))
        assert crop_lengths(plans) == tuple(self.data["lengths_stmc"])
        crops = guided_crops(self.network, self.schedule, plans, self.embeddings(stats), weight)
        composed, states = collage(crops, plans, self.columns), []

        def predict(x: Tensor, t: int) -> Tensor:
            states.append(x)
            return composed(x, t)

        draw = self.draw()
        x = draw(self.data["noise_shape_stmc"])
        return states, list(ddpm(predict, self.schedule, x, draw, noise_scale="variance"))

    @torch.no_grad()
    def crops(self, plans: list[Plan], shape, seed: str) -> Tensor:
        draw = self.draw(seed)
        crops = guided_crops(self.network, self.schedule, plans, self.embeddings(), float(self.data["guidance"]))
        return last(ddpm(crops, self.schedule, draw(shape), draw, noise_scale="variance"))


def assert_golden(actual: Tensor, expected: np.ndarray) -> None:
    torch.testing.assert_close(actual, torch.from_numpy(expected), atol=1e-5, rtol=0)


def a_complete_run_of_stmc_is_that_of_the_published_code(folder):
    run = GoldenRun(folder)
    states, x0 = run.stmc(float(run.data["guidance"]))
    assert len(x0) == run.schedule.steps
    kept = [int(key.removeprefix("x0pred_t")) for key in run.data if key.startswith("x0pred_t")]
    assert kept
    for t in kept:
        at = len(x0) - 1 - t
        assert_golden(x0[at], run.data[f"x0pred_t{t}"])
        assert_golden(states[at + 1], run.data[f"xt_after_t{t}"])
    assert_golden(x0[-1], run.data["x0_stmc"])


@pytest.mark.golden
@pytest.mark.parametrize("folder", golden_sets("stmc"))
@pytest.mark.slow
def test_the_method_stmc_paper_is_the_published_code_s(folder, monkeypatch):
    golden_run = GoldenRun(folder)
    draw, shape = golden_run.draw(), golden_run.data["noise_shape_stmc"]
    monkeypatch.setattr(Run, "noise", lambda self, plans, seeds=None: lambda _=None: draw(shape))
    method, layout = METHODS["stmc_paper"], SmplRepresentation().layout
    assert {part: set(own) for part, own in layout.columns.items()} == {
        part: set(own) for part, own in golden_run.columns.items()
    }
    asked = Sampling(steps=100, sampler="ddpm", guidance=float(golden_run.data["guidance"]), overlap=0.5)
    run = Run(
        timelines=golden_run.timelines,
        seeds=(0,) * len(golden_run.timelines),
        sampling=replace(asked, **method.fixed),
        schedule=golden_run.schedule,
        fps=FPS,
        longest=200,
        overlap=int(golden_run.data["overlap"]),
        layout=layout,
        statistics=Statistics(torch.zeros(205), torch.ones(205)),
        guided=lambda plans, guidance: guided_crops(
            golden_run.network, golden_run.schedule, plans, golden_run.embeddings(), guidance
        ),
        guided_sequences=lambda plans, guidance: pytest.fail("no sequences are needed"),
        fixed_length=None,
        device=torch.device("cpu"),
        progress=lambda steps, total: steps,
    )
    with torch.no_grad():
        assert_golden(method.sample(run), golden_run.data["x0_stmc"])


def a_run_without_guidance_is_that_of_the_published_code(folder):
    run = GoldenRun(folder)
    assert_golden(run.stmc(1.0)[1][-1], run.data["x0_stmc_guidance1"])


def a_run_with_statistics_is_that_of_the_published_code(folder):
    run = GoldenRun(folder)
    x0 = run.stmc(float(run.data["guidance"]), stats=True)[1][-1]
    mean, std = (torch.from_numpy(run.data[f"motion_{name}"]) for name in ("mean", "std"))
    assert_golden(x0 * (std + 1e-12) + mean, run.data["x0_stmc_with_stats"])


def sinc_with_and_without_lerp_is_that_of_the_published_code(folder):
    run = GoldenRun(folder)
    plans = plans_of(*run.timelines, overlap=0)
    assert crop_lengths(plans) == tuple(run.data["lengths_sinc"])
    crops = run.crops(plans, run.data["noise_shape_sinc"], "noise_seed")
    x0 = sinc(crops, plans, run.columns)
    assert_golden(x0, run.data["x0_sinc"])
    assert_golden(smooth_seams(x0, plans, run.columns, int(run.data["overlap"])), run.data["x0_sinc_lerp"])


def text_to_motion_is_that_of_the_published_code(folder):
    run = GoldenRun(folder)
    lengths = run.data["text_lengths"].tolist()
    plans = plans_of(*[timeline((str(i), 0, length)) for i, length in enumerate(lengths)])
    x0 = run.crops(plans, run.data["x0_text"].shape, "text_noise_seed")
    assert_golden(x0, run.data["x0_text"])


@pytest.mark.golden
@pytest.mark.parametrize("folder", golden_sets("stmc"))
@pytest.mark.slow
def test_runs_are_those_of_the_published_code(folder, subtests):
    checks = (
        a_complete_run_of_stmc_is_that_of_the_published_code,
        sinc_with_and_without_lerp_is_that_of_the_published_code,
        text_to_motion_is_that_of_the_published_code,
    )
    checked(subtests, checks, folder)


@pytest.mark.slow
@pytest.mark.golden
@pytest.mark.parametrize("folder", golden_sets("stmc"))
def test_runs_without_guidance_and_with_statistics_are_those_of_the_published_code(folder, subtests):
    checks = (
        a_run_without_guidance_is_that_of_the_published_code,
        a_run_with_statistics_is_that_of_the_published_code,
    )
    checked(subtests, checks, folder)


@pytest.mark.golden
@pytest.mark.parametrize("folder", golden_sets("stmc"))
@pytest.mark.parametrize("count", [64, pytest.param(None, marks=pytest.mark.slow)])
def test_less_than_15_percent_of_the_frames_denoised_for_mtt_are_padding(folder, count):
    plans = plans_of(*list(mtt(folder).values())[:count])
    assert padding_of(plans) < 0.15
    for batch in (1, 8, 32):
        shares = [padding_of(plans[i : i + batch]) for i in range(0, len(plans), batch)]
        assert max(shares) < 0.15
