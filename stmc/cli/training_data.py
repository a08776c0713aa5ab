"""Training data of denoisers and evaluators, as the settings of a command describe them."""

from __future__ import annotations

import logging
from dataclasses import replace

import torch
from omegaconf import OmegaConf

from stmc.cli.commands import Config
from stmc.cli.config_parts import build_part, resolve_config
from stmc.data.cache import Cache, read_caches
from stmc.data.sources.joined import joined_sentences
from stmc.diffusion.statistics import Statistics
from stmc.run import PARTS, build
from stmc.settings.records import SettingError, quote
from stmc.text import Cached
from stmc.training.data.dataset import Dataset
from stmc.training.data.prolonging import Prolonging

logger = logging.getLogger(__name__)


def read_training_data(
    config: Config,
    text_statistics: Statistics | None,
    device: torch.device,
    motion_statistics: Statistics | None = None,
) -> tuple[Cache, Dataset]:
    """Read the caches of `data.folder` as one, extend them as `data.prolonging` says, and build the data set.

    Args:
        config: Configuration, with the representation and the text encoder.
        text_statistics: Statistics of the network that training starts from; None: those of the data set.
        device: Device of the data set.
        motion_statistics: Statistics of the teacher; None: those of the data set.
    """
    described = resolve_config(config)
    parts = build(described, {part: PARTS[part] for part in ("representation", "text_encoder")}, config.trusted)
    layout = parts["representation"].layout
    logger.info("reading %s", config.data.folder)
    cache = read_caches(folders(config))
    if config.data.prolonging:
        cache = build_part(config, "data.prolonging", Prolonging)(cache, layout)
    if motion_statistics:
        cache = replace(cache, statistics=motion_statistics)
    joined = joined_sentences({clip.content for clip in cache.clips}) if config.data.sampling.get("joined_prob") else {}
    dataset = build_part(
        config,
        "data.dataset",
        Dataset,
        cache=cache,
        encoder=Cached(parts["text_encoder"], config.text_cache),
        layout=layout,
        text=text_statistics,
        device=device,
        joined=joined,
    )
    return cache, dataset


def folders(config: Config) -> str | list[str]:
    """Return the folders of the prepared data. Raises `SettingError` if `data.folder` names none."""
    folder = config.data.folder
    folder = OmegaConf.to_container(folder) if OmegaConf.is_config(folder) else folder
    names = [folder] if isinstance(folder, str) else list(folder or ())
    if not names or not all(isinstance(name, str) and name for name in names):
        raise SettingError(f"data.folder={quote(folder)}: must be the folder of a prepared cache, or a list of them")
    return names
