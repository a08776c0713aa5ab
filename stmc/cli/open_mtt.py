"""Rebuild the open benchmark: `stmc open_mtt cache=[cache/bandai,cache/cmu]`.

Every action that held-out recordings show becomes an atomic prompt; the command lists the actions that it leaves out.
It then reports how well an evaluator retrieves the text of each prompt among all texts, given held-out clips and
compositions of two clips.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import NamedTuple

import numpy as np
import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

import stmc
from stmc.cli.commands import command
from stmc.data.cache import HELD_OUT, Cache, Clip, read_caches
from stmc.data.sources.contents import CONTENTS
from stmc.evaluation.benchmarks.atomic_prompts import (
    LONGEST,
    MEAN,
    SHORTEST,
    AtomicPrompt,
    sample_timelines,
    write_atomic_prompts,
)
from stmc.evaluation.metrics.retrieval import cosines, ranks
from stmc.evaluators import Evaluator
from stmc.motion.body import BodyPart
from stmc.motion.representation import SmplRepresentation
from stmc.settings.records import setting

PLAIN = "normal"
MOST_CLIPS, PARTNERS = 12, 4
"""Maximum number of clips per prompt for the retrieval report, and number of compositions per clip."""
SHORT_CLIP = 1.5
"""Length in seconds; shorter clips are ground truth only if there is no longer one."""
MAX_STRETCH, MIN_LONGEST = 1.5, 4.0
"""Longest prompt of a non-cyclic action, as a multiple of its longest clip, and at least in seconds."""
MAX_WORST = 10


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of `stmc open-mtt`."""

    cache: tuple[str, ...] = setting(("cache/bandai", "cache/cmu"), "folders of prepared data")
    evaluator: str | None = setting(None, "run directory of the evaluator; null: the bundled one")
    output: str = setting("stmc/assets/open_mtt", "folder for the prompts and timelines")
    count: int = setting(500, "number of timelines", at_least=1)
    seed: int = setting(0, "seed of the timelines", at_least=0)


class Found(NamedTuple):
    """Retrieval of a prompt's motions: ranks of its text among all texts (0 is best), and the texts ranked first."""

    places: tuple[int, ...]
    first: tuple[str, ...]

    def recall(self, count: int) -> float:
        """Return the fraction of motions whose own text is among the first `count`."""
        return fmean(place < count for place in self.places)


@command("open_mtt", Settings)
def main(config: DictConfig) -> None:
    console, folder = Console(), Path(config.output)
    cache = read_caches(list(config.cache))
    prompts = atomic_prompts(cache)
    timelines = sample_timelines(prompts, config.count, np.random.default_rng(config.seed))
    write_atomic_prompts(prompts, folder / "prompts.json")
    stmc.Timeline.write_all(timelines, folder / "timelines.json")
    console.print(f"{len(prompts)} atomic prompts, {len(timelines)} timelines in {folder.resolve()}")
    console.print(f"no held-out clip shows {', '.join(find_omitted(cache, prompts)) or 'nothing'}")
    evaluator = stmc.load_evaluator(config.evaluator)
    print_report(console, prompts, rank_texts(evaluator, prompts, single_motions(cache, prompts)), "alone")
    composed = rank_texts(evaluator, prompts, composed_motions(cache, prompts))
    print_report(console, prompts, composed, "with another clip on other body parts")


def atomic_prompts(cache: Cache) -> list[AtomicPrompt]:
    """Return one prompt for every content that an unmirrored held-out clip shows.

    The text is the content's first sentence; contents with the same sentence share a prompt.
    """
    clips = [clip for clip in cache.clips if clip.split in HELD_OUT and not clip.mirrored and cache.texts[clip.texts]]
    shown = sorted({clip.content for clip in clips})
    texts = {CONTENTS[name].sentences[0]: name for name in reversed(shown)}
    return [prompt(cache, text, name) for text, name in sorted(texts.items(), key=lambda item: item[1])]


def prompt(cache: Cache, text: str, name: str) -> AtomicPrompt:
    """Return the prompt of a content, with its ground truth.

    The ground truth is the held-out clip whose length is closest to the mean of prompts; clips that are short, of the
    validation split or in a style are used only if there is no other.
    """

    def seconds(clip: Clip) -> float:
        return (clip.end - clip.start) / cache.fps

    clip = min(
        (clip for clip in cache.held_out(text) if not clip.mirrored and clip.content == name),
        key=lambda clip: (
            seconds(clip) < SHORT_CLIP,
            HELD_OUT.index(clip.split),
            clip.style != PLAIN,
            abs(seconds(clip) - MEAN),
            clip.name,
        ),
    )
    content, own = CONTENTS[name], [each for each in cache.clips if each.content == name]
    once = min(LONGEST, round(max(MIN_LONGEST, MAX_STRETCH * max(map(seconds, own))), 1))
    end = min(seconds(clip), LONGEST) if content.cyclic else seconds(clip)
    longest = LONGEST if content.cyclic else once
    return AtomicPrompt(text, content.parts, clip.name, 0.0, end, SHORTEST, longest, content.cyclic)


def find_omitted(cache: Cache, prompts: list[AtomicPrompt]) -> list[str]:
    """List the contents of the cache whose text is not a prompt."""
    texts = {prompt.text for prompt in prompts}
    names = {clip.content for clip in cache.clips if cache.texts[clip.texts]}
    return sorted(name for name in names if CONTENTS[name].sentences[0] not in texts)


def own_clips(cache: Cache, prompts: list[AtomicPrompt]) -> dict[str, list[Clip]]:
    """Return for each text the held-out clips that it describes, including mirror images."""
    rng, chosen = np.random.default_rng(0), {}
    for prompt in prompts:
        clips = cache.held_out(prompt.text)
        chosen[prompt.text] = [clips[index] for index in rng.permutation(len(clips))[:MOST_CLIPS]]
    return chosen


def single_motions(cache: Cache, prompts: list[AtomicPrompt]) -> dict[str, list[torch.Tensor]]:
    """Return for each text the features of the held-out clips that it describes."""
    longest = int(LONGEST * cache.fps)
    return {
        text: [cache.features[clip.start : clip.end][:longest] for clip in clips]
        for text, clips in own_clips(cache, prompts).items()
    }


def composed_motions(cache: Cache, prompts: list[AtomicPrompt]) -> dict[str, list[torch.Tensor]]:
    """Return for each text the features of compositions of its clips with clips of other texts.

    The other texts are drawn uniformly among those that claim none of its body parts. A text of the whole body has no
    compositions.
    """
    rng, chosen = np.random.default_rng(0), own_clips(cache, prompts)
    motions: dict[str, list[torch.Tensor]] = {prompt.text: [] for prompt in prompts}
    for prompt in prompts:
        others = [other.text for other in prompts if not other.parts & prompt.parts]
        for clip in chosen[prompt.text] if others else ():
            for text in rng.choice(others, size=PARTNERS):
                partner = chosen[text][rng.integers(len(chosen[text]))]
                if shows_whole(prompt, clip, partner):
                    motions[prompt.text].append(compose_clips(cache, clip, partner)[: int(LONGEST * cache.fps)])
    return motions


def shows_whole(prompt: AtomicPrompt, clip: Clip, partner: Clip) -> bool:
    """Return whether a composition of two clips shows the prompt in full; a non-cyclic action must not be cut."""
    lasts, others = clip.end - clip.start, partner.end - partner.start
    return prompt.cyclic or BodyPart.LEGS in prompt.parts or others >= lasts


def compose_clips(cache: Cache, clip: Clip, partner: Clip) -> torch.Tensor:
    """Return the features of `clip` with the partner's body parts replaced by those of the partner."""
    own, other = (cache.features[each.start : each.end] for each in (clip, partner))
    body, guest, parts = (own, other, partner.parts) if BodyPart.LEGS in clip.parts else (other, own, clip.parts)
    body = body[: len(own)].clone()
    columns = [column for part in parts for column in SmplRepresentation.layout.columns[BodyPart(part)]]
    shared = min(len(body), len(guest))
    body[:shared, columns] = guest[:shared, columns]
    return body


def rank_texts(
    evaluator: Evaluator, prompts: list[AtomicPrompt], motions: dict[str, list[torch.Tensor]]
) -> dict[str, Found]:
    """Rank all texts for the motions of each prompt; prompts without motions are left out."""
    texts = [prompt.text for prompt in prompts]
    rows = [(number, motion) for number, text in enumerate(texts) for motion in motions[text]]
    scores = cosines(evaluator.motions([motion for _, motion in rows]), evaluator.texts(texts))
    right = torch.tensor([number for number, _ in rows])
    places = ranks(scores, right[:, None] == torch.arange(len(texts)))
    first = [texts[index] for index in scores.argmax(dim=1).tolist()]
    return {
        text: Found(
            tuple(places[right == number].tolist()),
            tuple(best for best, (own, _) in zip(first, rows, strict=True) if own == number),
        )
        for number, text in enumerate(texts)
        if motions[text]
    }


def print_report(console: Console, prompts: list[AtomicPrompt], results: dict[str, Found], how: str) -> None:
    """Print the mean over prompts, chance, and the worst prompts with the texts that they are mistaken for."""
    means = [100 * fmean(each.recall(count) for each in results.values()) for count in (1, 3)]
    chance = [100 * count / len(prompts) for count in (1, 3)]
    title = f"{how}, {len(results)} prompts: R@1 {means[0]:.1f}% (chance {chance[0]:.1f}), "
    table = Table("worst prompts", "R@1", "R@3", "mistaken for", title=f"{title}R@3 {means[1]:.1f}% ({chance[1]:.1f})")
    for text, each in sorted(results.items(), key=lambda item: (item[1].recall(3), item[1].recall(1)))[:MAX_WORST]:
        mistaken = Counter(best for best in each.first if best != text).most_common(2)
        table.add_row(text, f"{each.recall(1):.0%}", f"{each.recall(3):.0%}", ", ".join(best for best, _ in mistaken))
    console.print(table)
