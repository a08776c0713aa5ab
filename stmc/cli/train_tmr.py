"""Train TMR, the evaluator: `stmc train_tmr runs/tmr data.folder=CACHE`."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from omegaconf import DictConfig, OmegaConf, open_dict

from stmc import training
from stmc.cli.commands import command
from stmc.cli.config_parts import build_part, resolve_config
from stmc.cli.shared_settings import Trained
from stmc.cli.training_data import read_training_data
from stmc.evaluation.metrics.retrieval import Retrieval, cosines, small_batches, t2m_m2t
from stmc.evaluators import Evaluator
from stmc.io.files import write_text
from stmc.run import EVALUATOR_PARTS, build, check, load_evaluator, save_evaluator
from stmc.settings.records import setting
from stmc.text import Cached, TextEncoder
from stmc.training import Objective
from stmc.training.data.batches import ClipBatches, Recipe
from stmc.training.data.dataset import Dataset
from stmc.training.data.pair_batches import PairBatches
from stmc.training.logs import Table

if TYPE_CHECKING:  # an extra, which the help does without
    import accelerate


@dataclass(frozen=True, kw_only=True)
class Settings(Trained):
    """Settings of `stmc train-tmr`."""

    objective: Mapping = setting({"_target_": "stmc.training.TmrObjective"}, "training objective")
    false_negative_encoder: Mapping | None = setting(
        None, "sentence encoder for data without shared texts (+text_encoder@false_negative_encoder=minilm)"
    )
    false_negative_threshold: float | int = setting(
        0.8, "cosine of two texts above which they are no negatives of each other", at_most=1
    )
    init_from: str | None = setting(None, "run directory of the same network to start from; null: fresh weights")


RECALL_COLUMNS = tuple(f"{direction}_R{rank}" for direction in ("t2m", "m2t") for rank in (1, 3, 10))
"""Columns of `retrieval.csv`: text to motion and motion to text."""


@command("train_tmr", Settings, ("run",))
def main(config: DictConfig) -> None:
    with training.begin(config.run, config.device) as accelerator:
        train(config, accelerator)


def train(config: DictConfig, accelerator: accelerate.Accelerator) -> None:
    """Train an evaluator, from the data to the run directory."""
    settings, recipe = build_part(config, "training", training.Settings), build_part(config, "data.sampling", Recipe)
    objective = build_part(config, "objective", Objective)
    sentences = build_false_negative_encoder(config)
    started = load_evaluator(config.init_from, trusted=config.trusted) if config.init_from else None
    cache, dataset = read_training_data(config, started.text_statistics if started else None, accelerator.device)
    batches, held_out = (
        PairBatches(ClipBatches(dataset, split, recipe, settings.seed), sentences, config.false_negative_threshold)
        for split in ("train", "val")
    )
    torch.manual_seed(settings.seed)
    folder = Path(config.run).expanduser()
    evaluator = build_evaluator(config, dataset)
    if started:
        evaluator.network.load_state_dict(started.network.state_dict())
        evaluator.network.restate(started.motion_statistics, dataset.motion.to("cpu"))
    check(evaluator, config.trusted)  # before the first step: refuse to train an evaluator that could not be loaded
    trainer: training.Trainer = training.Trainer(
        evaluator.network,
        objective,
        batches,
        folder,
        settings,
        validation=[piece for step in range(config.validation) for piece in held_out(step)],
        callbacks=[
            training.Callback(
                settings.validate_every,
                lambda step, network: table.write(
                    step, measure_recall(replace(evaluator, network=network), held_out, "val")
                ),
            ),
            training.Callback(
                settings.checkpoint_every,
                lambda step, network: export(
                    config, replace(evaluator, network=network), held_out, step, trainer.changes
                ),
            ),
        ],
        accelerator=accelerator,
        described=resolve_config(config) | {"cache": cache.fingerprint},
        allow_changed_settings=config.allow_changed_settings,
    )
    table: Table = Table(folder / "retrieval.csv", RECALL_COLUMNS, trainer.step)
    trainer.run()


def build_false_negative_encoder(config: DictConfig) -> Cached | None:
    """Build the encoder of sentences that tells false negatives, if there is one."""
    if not config.false_negative_encoder:
        return None
    return Cached(build_part(config, "false_negative_encoder", TextEncoder), config.text_cache)


def export(config: DictConfig, evaluator: Evaluator, held_out: PairBatches, step: int, changes: Sequence[str]) -> None:
    """Save the moving average as a run directory, with retrieval on the test split and the changes of settings."""
    folder = Path(config.run).expanduser()
    text = json.dumps({"step": step, "test": measure_retrieval(evaluator, held_out, "test")}, indent=1) + "\n"
    write_text(folder / "results.json", text)
    made = f"# Trained with stmc train_tmr, step {step}\n\n```yaml\n{OmegaConf.to_yaml(config, resolve=True)}```"
    changed = "".join(f"\n\nSettings changed {change}" for change in changes)
    card = f"{made}{changed}\n\nOn the test split:\n\n```json\n{text}```\n"
    save_evaluator(evaluator, folder, card, trusted=config.trusted)


def build_evaluator(config: DictConfig, dataset: Dataset) -> Evaluator:
    """Build the evaluator as it would be loaded from the run directory, with fresh weights."""
    with open_dict(config):
        config.network.update(features=dataset.features_width, text_width=dataset.text_width)
    described = resolve_config(config)
    parts = build(described, EVALUATOR_PARTS, config.trusted)
    return Evaluator(
        network=parts["network"],
        text_encoder=Cached(parts["text_encoder"], config.text_cache),
        representation=parts["representation"],
        motion_statistics=dataset.motion.to("cpu"),
        text_statistics=dataset.text.to("cpu"),
        fps=dataset.fps,
        config={part: described[part] for part in EVALUATOR_PARTS},
    )


def measure_recall(evaluator: Evaluator, pairs: PairBatches, split: str) -> dict[str, float]:
    """Measure the recall of every text that is true of a motion, by column of `RECALL_COLUMNS`."""
    retrieval = measure_retrieval(evaluator, pairs, split)["true"]
    return {
        f"{direction}_R{rank}": retrieval[direction]["recall"][rank] for direction in retrieval for rank in (1, 3, 10)
    }


def measure_retrieval(evaluator: Evaluator, pairs: PairBatches, split: str) -> dict:
    """Measure retrieval among the clips of a split, each with one of its sentences.

    There are three protocols: "all" (only the own pair counts), "true" (every pair whose text is true of the motion
    counts), and "guo" ("all" in batches of 32). "confused" lists the contents that are most often mistaken.
    """
    dataset = pairs.batches.dataset
    clips, sentences = pairs.draw(split)
    chosen = [dataset.clips[clip] for clip in clips]
    longest = int(pairs.batches.recipe.longest * dataset.fps)
    motions = evaluator.motions([dataset.features[clip.start : clip.end][:longest].cpu() for clip in chosen])
    texts = evaluator.texts([dataset.sentences[sentence] for sentence in sentences])
    table, right = cosines(texts, motions), pairs.belongs(sentences, clips)
    ways = {"all": t2m_m2t(table), "true": t2m_m2t(table, right)}
    if len(chosen) >= 32:
        ways["guo"] = small_batches(table, [clip.name for clip in chosen])
    return {name: dict(zip(("t2m", "m2t"), map(as_data, found), strict=True)) for name, found in ways.items()} | {
        "confused": count_confusions([clip.content for clip in chosen], table)
    }


def as_data(found: Retrieval) -> dict:
    """Return the retrieval measures as plain data."""
    return {"recall": found.recall, "median_rank": found.median_rank, "candidates": found.candidates}


def count_confusions(contents: list[str], table: torch.Tensor) -> list[tuple[str, str, int]]:
    """Count the pairs (content of a motion, other content of its best text), the most frequent first."""
    read = [contents[best] for best in table.argmax(dim=0).tolist()]
    mistakes = Counter((shown, taken) for shown, taken in zip(contents, read, strict=True) if shown != taken)
    return [(*pair, count) for pair, count in mistakes.most_common(12)]
