"""Makes the open benchmark anew: `python scripts/open_mtt.py cache=cache/bandai evaluator=runs/tmr`.

Every content of the test split is an atomic prompt; a content in a style is one where the evaluator finds the style by
ear in the *validation* split, so that nothing is chosen by what the test split looks like.
"""

import json
from functools import partial
from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig
from rich.console import Console

import stmc
from stmc.data.cache import Cache, Clip
from stmc.data.sentences import CONTENTS, STYLES
from stmc.evaluators import Evaluator
from stmc.files import write_whole
from stmc.metrics.retrieval import cosines, ranks
from stmc.mtt import AtomicPrompt, construct

PLAIN = "normal"
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
    """Of each atom, the share of its validation clips whose best text is its own, among the texts of all."""
    shown: dict[Atom, list[Clip]] = {atom: [] for atom in atoms}
    for clip in cache.clips:
        if clip.split == "val" and (clip.content, clip.style) in shown:
            shown[clip.content, clip.style].append(clip)
    texts, heard = evaluator.texts([text(atom) for atom in atoms]), {}
    for number, (atom, clips) in enumerate(shown.items()):
        heard[atom] = 0.0
        if clips:
            motions = evaluator.motions([cache.features[clip.start : clip.end] for clip in clips])
            right = torch.zeros(len(clips), len(atoms), dtype=torch.bool)
            right[:, number] = True
            heard[atom] = float((ranks(cosines(motions, texts), right) < 1).double().mean())
    return heard


def prompt(cache: Cache, atom: Atom) -> AtomicPrompt:
    """The atom with its ground truth: its first clip of the test split."""
    own = (clip for clip in cache.clips if clip.split == "test" and not clip.mirrored)
    clip = min((each for each in own if (each.content, each.style) == atom), key=lambda each: each.name)
    return AtomicPrompt(text(atom), CONTENTS[atom[0]].parts, clip.name, 0.0, (clip.end - clip.start) / cache.fps)


if __name__ == "__main__":
    main()
