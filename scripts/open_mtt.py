"""Makes the open benchmark anew: `python scripts/open_mtt.py cache=cache/bandai evaluator=runs/tmr`.

Every content of the test split is an atomic prompt; a content in a style is one where the evaluator tells the style
while other body parts do something else. That is judged by compositions of *validation* clips, so that nothing is
chosen by what the test split looks like.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from omegaconf import DictConfig
from rich.console import Console

import stmc
from stmc.benchmarks.atomic_prompts import AtomicPrompt, sample_timelines, write_atomic_prompts
from stmc.body import BodyPart
from stmc.commands import command
from stmc.data.cache import Cache, Clip
from stmc.data.sources.bandai_sentences import CONTENTS, STYLES
from stmc.evaluators import Evaluator
from stmc.metrics.retrieval import cosines, ranks
from stmc.representation import SmplRepresentation
from stmc.settings import setting

PLAIN = "normal"
PARTNERS = 8
"""Compositions of each validation clip."""
Atom = tuple[str, str]
"""Content and style."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    cache: str = setting("cache/bandai", "prepared data")
    evaluator: str | None = setting(None, "run directory; null: the bundled one")
    output: str = setting("stmc/assets/open_mtt", "folder of the prompts and timelines")
    min_accuracy: float | int = setting(
        0.6, "share of a style's compositions in which the evaluator must tell it from others", at_least=0, at_most=1
    )
    count: int = setting(500, "timelines", at_least=1)
    seed: int = setting(0, "of the timelines", at_least=0)


@command("open_mtt", Settings)
def main(config: DictConfig) -> None:
    console, folder = Console(), Path(config.output)
    cache = Cache.read(Path(config.cache).expanduser())
    evaluator = stmc.load_evaluator(config.evaluator)
    heard = found(cache, evaluator, possible(cache))
    chosen = [atom for atom, share in heard.items() if atom[1] == PLAIN or share >= config.min_accuracy]
    atoms = [prompt(cache, atom) for atom in chosen]
    timelines = sample_timelines(atoms, config.count, config.seed)
    random = np.random.default_rng(0)
    places = [standing(cache, evaluator, "test", atom, chosen, random) for atom in chosen]
    write_atomic_prompts(atoms, folder / "prompts.json")
    stmc.Timeline.write_all(timelines, folder / "timelines.json")
    for (content, style), share in heard.items():
        console.print(f"{share:4.0%} {text((content, style))}{'' if (content, style) in chosen else ' (left out)'}")
    shares = [100 * float(np.mean([float((each < count).double().mean()) for each in places])) for count in (1, 3)]
    console.print(f"compositions of test clips, mean of all prompts: R@1 {shares[0]:.1f}%, R@3 {shares[1]:.1f}%")
    console.print(f"{len(atoms)} atomic prompts, {len(timelines)} timelines in {folder.resolve()}")


def possible(cache: Cache) -> list[Atom]:
    """The contents of the test split, each plain and in every style of which it has at least two clips; of contents
    that are told in the same words the first by name."""
    clips = [clip for clip in cache.clips if clip.split == "test" and not clip.mirrored]
    names = sorted({clip.content for clip in clips}, reverse=True)
    contents = {text((name, PLAIN)): name for name in names}.values()
    styled = [(clip.content, clip.style) for clip in clips if clip.style != PLAIN]
    often = [atom for atom in sorted(set(styled)) if styled.count(atom) > 1]
    return [(content, PLAIN) for content in reversed(contents)] + often


def text(atom: Atom) -> str:
    content, style = atom
    sentence = CONTENTS[content].sentences[0]
    return sentence if style == PLAIN else f"{sentence} {STYLES[style][0]}"


def found(cache: Cache, evaluator: Evaluator, atoms: list[Atom]) -> dict[Atom, float]:
    """Of each atom, the share of the compositions with its validation clips in which its text is the best among those
    of its content; 1 where the content has no other."""
    heard, random = {}, np.random.default_rng(0)
    for atom in atoms:
        rivals = [other for other in atoms if other[0] == atom[0]]
        places = standing(cache, evaluator, "val", atom, rivals, random) if len(rivals) > 1 else torch.zeros(1)
        heard[atom] = float((places < 1).double().mean()) if len(places) else 0.0
    return heard


def standing(
    cache: Cache, evaluator: Evaluator, split: str, atom: Atom, rivals: list[Atom], random: np.random.Generator
) -> torch.Tensor:
    """Where the atom's text stands (0 is best) among its rivals' for each composition with one of its clips."""
    clips = [clip for clip in cache.clips if clip.split == split and clip.parts]
    own = [clip for clip in clips if (clip.content, clip.style) == atom]
    partners = [clip for clip in clips if not set(clip.parts) & CONTENTS[atom[0]].parts]
    composed = [
        composition(cache, clip, partners[partner])
        for clip in own
        for partner in random.integers(len(partners), size=PARTNERS)
    ]
    if not composed:
        return torch.zeros(0)
    scores = cosines(evaluator.motions(composed), evaluator.texts([text(rival) for rival in rivals]))
    return ranks(scores, torch.tensor([[rival == atom for rival in rivals]]).expand(len(composed), -1))


def composition(cache: Cache, clip: Clip, partner: Clip) -> torch.Tensor:
    """Features of what `clip` shows, for as long as it lasts, while the partner's parts do what the partner shows."""
    own, other = (cache.features[each.start : each.end] for each in (clip, partner))
    body, guest, parts = (own, other, partner.parts) if BodyPart.LEGS in clip.parts else (other, own, clip.parts)
    body = body[: len(own)].clone()
    columns = [column for part in parts for column in SmplRepresentation.layout.columns[BodyPart(part)]]
    shared = min(len(body), len(guest))
    body[:shared, columns] = guest[:shared, columns]
    return body


def prompt(cache: Cache, atom: Atom) -> AtomicPrompt:
    """The atom with its ground truth: its first clip of the test split."""
    own = (clip for clip in cache.clips if clip.split == "test" and not clip.mirrored)
    clip = min((each for each in own if (each.content, each.style) == atom), key=lambda each: each.name)
    return AtomicPrompt(text(atom), CONTENTS[atom[0]].parts, clip.name, 0.0, (clip.end - clip.start) / cache.fps)


if __name__ == "__main__":
    sys.exit(main())
