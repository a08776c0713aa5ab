"""Makes the open benchmark anew: `python scripts/open_mtt.py cache=cache/bandai evaluator=runs/tmr`.

Every content of the test split is an atomic prompt; a content in a style is one where the evaluator tells the style
while other body parts do something else. That is judged by compositions of *validation* clips, so that nothing is
chosen by what the test split looks like.
"""

import json
from functools import partial
from pathlib import Path

import hydra
import numpy as np
import torch
from omegaconf import DictConfig
from rich.console import Console

import stmc
from stmc.body import BodyPart
from stmc.data.cache import Cache, Clip
from stmc.data.sentences import CONTENTS, STYLES
from stmc.evaluators import Evaluator
from stmc.files import write_whole
from stmc.metrics.retrieval import cosines, ranks
from stmc.mtt import AtomicPrompt, construct
from stmc.representation import SmplRepresentation

PLAIN = "normal"
PARTNERS = 8
"""Compositions of each validation clip."""
Atom = tuple[str, str]
"""Content and style."""


@hydra.main(config_path="../configs", config_name="open_mtt", version_base="1.3")
def main(config: DictConfig) -> None:
    console, folder = Console(), Path(config.output)
    try:
        cache = Cache.read(Path(config.cache).expanduser())
        evaluator = stmc.load_evaluator(config.evaluator)
        heard = found(cache, evaluator, possible(cache))
        chosen = [atom for atom, share in heard.items() if atom[1] == PLAIN or share >= config.least]
        atoms = [prompt(cache, atom) for atom in chosen]
        timelines = construct(atoms, config.count, config.seed)
    except (ValueError, OSError) as error:
        raise SystemExit(str(error)) from error
    rows = [
        {"text": each.text, "body_parts": sorted(each.parts), "clip": each.clip, "start": each.start, "end": each.end}
        for each in atoms
    ]
    lines = "[\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]\n"
    write_whole(folder / "prompts.json", partial(Path.write_text, data=lines, encoding="utf-8"))
    stmc.Timeline.write_all(timelines, folder / "timelines.json")
    for (content, style), share in heard.items():
        console.print(f"{share:4.0%} {text((content, style))}{'' if (content, style) in chosen else ' (left out)'}")
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
    clips = [clip for clip in cache.clips if clip.split == "val" and clip.parts]
    texts, random, heard = evaluator.texts([text(atom) for atom in atoms]), np.random.default_rng(0), {}
    for atom in atoms:
        rivals = [number for number, other in enumerate(atoms) if other[0] == atom[0]]
        own = [clip for clip in clips if (clip.content, clip.style) == atom]
        partners = [clip for clip in clips if not set(clip.parts) & CONTENTS[atom[0]].parts]
        if len(rivals) == 1 or not own:
            heard[atom] = float(len(rivals) == 1)
            continue
        composed = [
            composition(cache, clip, partners[partner])
            for clip in own
            for partner in random.integers(len(partners), size=PARTNERS)
        ]
        right = torch.tensor([[atoms[number] == atom for number in rivals]]).expand(len(composed), -1)
        heard[atom] = float((ranks(cosines(evaluator.motions(composed), texts[rivals]), right) < 1).double().mean())
    return heard


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
    main()
