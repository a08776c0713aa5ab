"""Every YAML under configs/ composes, and everything it describes can be built: constructors are the schema."""

import dataclasses
import inspect
import logging.config
from functools import partial

import pytest
import torch
from helpers.motions import walk
from helpers.scripts import ROOT, configured
from helpers.toy_data import LetterCounts
from hydra.utils import get_object, instantiate
from omegaconf import DictConfig, ListConfig, OmegaConf

from stmc.data.cache import Cache, Clip
from stmc.motion.representation import SmplRepresentation
from stmc.training.data.dataset import Dataset

CONFIGS = ROOT / "configs"
NAMES = sorted(str(path.relative_to(CONFIGS).with_suffix("")) for path in CONFIGS.rglob("*.yaml"))
CLIP = Clip("walk-1", "walk", "normal", "walk", ("legs",), True, False, "train", 0, 12)
LEFT_OUT = ("13_11", "16_08", "dataset-1_walk_elderly_000", "dataset-1_walk_masculine_000")
"""Recordings that `train_tmr_mtt` leaves out by pattern."""
CACHE = Cache(
    20,
    "smpl",
    SmplRepresentation().encode(walk()).float(),
    tuple(dataclasses.replace(CLIP, name=name) for name in (*(f"walk-{number}" for number in range(5)), *LEFT_OUT)),
    {"walk": (("walk", 1.0),)},
)
DATASET = Dataset(CACHE, LetterCounts(), SmplRepresentation.layout, min_clips=1)
FROM_THE_DATA = {
    "features": 11,
    "text_width": 8,
    "cache": CACHE,
    "encoder": LetterCounts(),
    "source": ".",
    "annotations": ".",
    "layout": SmplRepresentation.layout,
    "dataset": DATASET,
}
"""Arguments that a script supplies, not a YAML."""

NETWORKS = ("stmc.denoisers.", "stmc.evaluators.")
"""Their weights are many, and nothing is asked of them here: they get none."""


def described(node) -> list[DictConfig]:
    """Every part of a config that says what to build, the outermost only."""
    if not OmegaConf.is_dict(node):
        return []
    if "_target_" in node:
        return [node]
    return [found for key in given(node) for found in described(node[key])]


def given(node: DictConfig) -> list[str]:
    """The keys with a value of their own: what is missing, or is said elsewhere, describes nothing here."""
    return [key for key in node if not OmegaConf.is_missing(node, key) and not OmegaConf.is_interpolation(node, key)]


def check_keywords(node: DictConfig) -> None:
    """All of them are parameters, also of the parts within."""
    known = inspect.signature(get_object(node["_target_"])).parameters
    assert {key for key in node if not key.startswith("_")} <= set(known), node
    for inner in (found for key in given(node) for found in described(node[key])):
        check_keywords(inner)


@pytest.mark.parametrize("name", NAMES)
def test_every_config_describes_what_can_be_built(name):
    group, _, choice = name.partition("/")  # a benchmark may choose an experiment: only where there is one
    parts = choice and group == "benchmark"
    config = configured("evaluate", f"{group}={choice}") if parts else configured(name)
    if name.startswith("hydra/job_logging"):
        logging.config.DictConfigurator(OmegaConf.to_container(OmegaConf.load(CONFIGS / f"{name}.yaml")))
        return
    for node in described(config):
        if node.get("_partial_"):  # what a script completes, with what only a run has
            check_keywords(node)
            continue
        lists = {key: tuple(value) for key, value in node.items() if isinstance(value, ListConfig)}
        others = {key: value for key, value in node.items() if key not in lists}
        build = partial(instantiate(others, _partial_=True), **lists)
        parameters = inspect.signature(build.func).parameters
        with torch.device("meta" if node["_target_"].startswith(NETWORKS) else "cpu"):
            built = build(**{key: value for key, value in FROM_THE_DATA.items() if key in parameters})
        assert built is not None


def test_every_size_that_data_decides_is_left_to_the_data():
    for name in NAMES:
        text = (CONFIGS / f"{name}.yaml").read_text(encoding="utf-8")
        assert not {"features:", "text_width:"} & set(text.split()), name


def test_what_no_constructor_knows_is_an_error():
    config = configured("denoiser/mdm_smpl", "+denoiser.depth=3")
    with pytest.raises(Exception, match="depth"):
        instantiate(config.denoiser, features=11, text_width=8)


@pytest.mark.parametrize("benchmark", ["mtt", "humanml3d", "flow_mdm_babel", "flow_mdm_humanml3d"])
def test_published_benchmarks_are_of_full_precision_unless_told_otherwise(benchmark):
    assert configured("evaluate", f"benchmark={benchmark}").precision == "fp32"
    assert configured("evaluate", f"benchmark={benchmark}", "precision=bf16").precision == "bf16"
