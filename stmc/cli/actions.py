"""Ask a model for every action of its data that geometry can tell: `stmc actions model=RUN`.

With `texts=texts.txt`, ask for the 60 texts of MTT, each alone on its own body parts.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from pathlib import Path
from statistics import fmean, median
from typing import get_args

import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track
from rich.table import Table

import stmc
from stmc.cli.commands import command
from stmc.cli.shared_settings import OnModel
from stmc.data.cache import Cache, read_caches
from stmc.data.sources.contents import CONTENTS
from stmc.diffusion import NoiseScale
from stmc.evaluation.benchmarks.atomic_prompts import AtomicPrompt, read_texts
from stmc.evaluation.benchmarks.mtt_checks import MTT_CHECKS, confusions, mirror_words, same_meaning
from stmc.evaluation.benchmarks.novelty import success_by_distance
from stmc.evaluation.benchmarks.questions import QUESTIONS, rates
from stmc.evaluation.metrics.retrieval import cosines, ranks
from stmc.evaluators import Evaluator
from stmc.io.extras import require
from stmc.io.files import write_text, write_whole
from stmc.model import Precision
from stmc.motion.kinematics import foot_sliding, hand_step
from stmc.motion.motion import Motion
from stmc.motion.representation import Representation, SmplRepresentation
from stmc.settings.records import SettingError, setting
from stmc.text import MiniLM
from stmc.timeline import Prompt, Timeline

WINDOW = 4.0
"""Seconds of a cyclic clip that are asked at once, and of a cyclic content that are sampled."""

AMONG = 3
"""A content is found where the evaluator has it among its best so many."""

SHOWN = 0.75
"""The share of a text's samples that show it, where a model can do it: 6 of 8."""

CONFUSED = 0.2
"""The share of motions of one text that pass the check of another, from which on it is named."""


@dataclass(frozen=True, kw_only=True)
class Settings(OnModel):
    """Settings of `stmc actions`."""

    cache: tuple[str, ...] = setting(("cache/bandai", "cache/cmu"), "prepared data, for the contents and real motion")
    evaluator: str | None = setting(None, "run directory of what is to find the contents; null: the bundled one")
    contents: tuple[str, ...] = setting((), "what to ask for; none: all of the data that geometry can tell")
    seen: bool = setting(False, "ask with sentences of the training, not with those that it left out")
    sentences: int = setting(3, "of each content", at_least=1)
    samples: int = setting(8, "motions of each sentence", at_least=1)
    clips: int = setting(20, "real motions of each content", at_least=1)
    seed: int = setting(0, "of the first motion", at_least=0)
    guidance: float | int | None = setting(None, "how much the text weighs; null: the model's own", at_least=0)
    steps: int | None = setting(50, "of denoising, fast actions need many; null: as many as in training", at_least=1)
    clean_feet: bool = setting(False, "feet stay where they stand, and above the floor; false: as the model made them")
    noise_scale: str | None = setting(None, "of DDPM's noise; null: the model's own", choices=get_args(NoiseScale))
    texts: str | None = setting(None, "MTT's texts.txt: ask for its 60 texts, not for the contents of the data")
    paraphrases: str | None = setting(None, "JSON of other words for the texts, as in {text: words}")
    recorded: bool = setting(False, "judge the recordings of the cache that show the texts, not a model")
    seconds: float | int = setting(6.0, "that each text lasts", at_least=1)
    batch: int = setting(64, "motions of texts that are sampled at once", at_least=1)
    output: str = setting("outputs/actions", "folder of pictures and numbers")
    precision: str = setting("fp32", "of the denoiser; bf16 is fast on some processors", choices=get_args(Precision))


@command("actions", Settings, ("model", "evaluator", "output"))
def main(config: DictConfig) -> None:
    if config.texts:
        return calibrate(config) if config.recorded else ask_texts(config)
    require("matplotlib", "PIL")
    model, folder = stmc.load(config.model, device=config.device, precision=config.precision), Path(config.output)
    cache, results, console = read_caches(list(config.cache)), {}, Console()
    evaluator = stmc.load_evaluator(config.evaluator, device=config.device)
    finder = Finder(evaluator, {clip.content for clip in cache.clips})
    real = recorded(cache, model.representation, model.skeleton, config.clips)
    for name in track(chosen(config, set(real)), "Sampling", console=console):
        seconds = min(WINDOW, median(motion.duration for motion in real[name]))
        motions = {text: asked(config, model, name, text, seconds) for text in sentences(config, name)}
        shares = {text: fmean(map(QUESTIONS[name], several)) for text, several in motions.items()}
        known = rates(QUESTIONS[name], real[name], {other: real[other] for other in real if other != name})
        answers = {"shown": fmean(shares.values()), "ceiling": known.ceiling, "chance": known.chance}
        sampled = [motion for several in motions.values() for motion in several]
        plausible = {"sampled": plausibility(sampled), "real": plausibility(real[name])}
        heard = {"found": finder.found(name, sampled), "real_found": finder.found(name, real[name])}
        results[name] = answers | heard | plausible | {"sentences": shares}
        draw(folder / f"{name}.png", {f"{name}, recorded": real[name][0]} | {t: m[0] for t, m in motions.items()})
        write_text(folder / "actions.json", json.dumps(results, indent=1) + "\n")
    report(results, console)
    report_by_distance(results, console)


def chosen(config: DictConfig, recorded: set[str]) -> list[str]:
    """The contents to ask for. Raises `SettingError` where real motion, a question or a sentence is missing."""
    known = [name for name in QUESTIONS if name in recorded and CONTENTS[name].unseen]
    if not known:
        raise SettingError(f"cache={', '.join(config.cache)}: no content that geometry can tell")
    if missing := [name for name in config.contents if name not in known]:
        raise SettingError(f"contents={missing[0]}: choose from {', '.join(known)}")
    return list(config.contents) or known


def sentences(config: DictConfig, name: str) -> tuple[str, ...]:
    """Sentences that no training sees; or, where asked for, those that it does."""
    return (CONTENTS[name].sentences if config.seen else CONTENTS[name].unseen)[: config.sentences]


def asked(config: DictConfig, model: stmc.Model, name: str, text: str, seconds: float) -> list[Motion]:
    """The samples of a sentence on the content's body parts."""
    timeline = Timeline((Prompt(text, 0.0, round(seconds, 1), CONTENTS[name].parts),), name=f"{name}: {text}")
    return model.generate(
        [timeline] * config.samples,
        seed=config.seed,
        guidance=config.guidance,
        steps=config.steps,
        noise_scale=config.noise_scale,
        clean_feet=config.clean_feet,
    )


class Finder:
    """How often an evaluator has a content among its best `AMONG` of the `contents` of the data, each told by its first
    sentence."""

    def __init__(self, evaluator: Evaluator, contents: Collection[str]) -> None:
        self.evaluator = evaluator
        shown = (content.sentences[0] for name, content in CONTENTS.items() if name in contents)
        self.texts = list(dict.fromkeys(shown))
        self.latents = evaluator.texts(self.texts)

    def found(self, name: str, motions: Sequence[Motion]) -> float:
        """The share of the motions whose content, `name`, is found."""
        features = [self.evaluator.features(motion) for motion in motions]
        scores = cosines(self.evaluator.motions(features), self.latents)
        own = torch.tensor([text == CONTENTS[name].sentences[0] for text in self.texts])
        return float((ranks(scores, own.expand(len(motions), -1)) < AMONG).float().mean())


def plausibility(motions: Sequence[Motion]) -> dict[str, float | None]:
    """How far feet slide in a frame of contact (mean) and hands jump in a frame (most of all), in centimetres."""
    slides = [100 * foot_sliding(motion) for motion in motions]
    stands = [slide for slide in slides if not math.isnan(slide)]
    return {
        "sliding_cm": fmean(stands) if stands else None,
        "hand_step_cm": max(100 * hand_step(motion) for motion in motions),
    }


def draw(path: Path, motions: Mapping[str, Motion]) -> None:
    """Film strips of some motions, one below the other, each under its name."""
    from PIL import Image  # not above: it comes with an extra

    strips = []
    for name, motion in motions.items():
        drawn = BytesIO()
        stmc.film_strip(motion, title=name).savefig(drawn, format="png", dpi=60)
        strips.append(Image.open(drawn))
    page = Image.new("RGB", (max(strip.width for strip in strips), sum(strip.height for strip in strips)), "white")
    top = 0
    for strip in strips:
        page.paste(strip, (0, top))
        top += strip.height
    write_whole(path, partial(page.save, format="png"))


def recorded(
    cache: Cache, representation: Representation, skeleton: stmc.Skeleton, most: int
) -> dict[str, list[Motion]]:
    """Up to `most` real motions of every content, spread over its clips; of cyclic clips, windows."""
    places: dict[str, list[tuple[int, int]]] = {}
    window = round(WINDOW * cache.fps)
    for clip in cache.clips:
        if cache.texts[clip.texts] and not clip.mirrored:
            cut = clip.cyclic and clip.end - clip.start > window
            starts = range(clip.start, clip.end - window + 1, 2 * window) if cut else (clip.start,)
            ends = [(start, start + window if cut else clip.end) for start in starts]
            places.setdefault(clip.content, []).extend(ends)
    return {
        content: [
            representation.decode(cache.features[start:end], cache.fps, skeleton)
            for start, end in found[:: max(1, len(found) // most)][:most]
        ]
        for content, found in places.items()
    }


def report(results: dict, console: Console) -> None:
    """How often the samples show each content, beside how often real motion of it does, and real motion of others; how
    often the evaluator finds it; how far feet slide in them, and in real motion."""
    shares = ("shown", "ceiling", "chance", "found", "real_found")
    table = Table("content", "success", "real motion", "chance", "found", "real motion", "slide, cm", "real motion")
    for name, row in results.items():
        slides = [row[whose]["sliding_cm"] for whose in ("sampled", "real")]
        cells = ["" if slide is None else f"{slide:.1f}" for slide in slides]
        table.add_row(name, *(f"{row[column]:.0%}" for column in shares), *cells)
    means = [fmean(row[column] for row in results.values()) for column in shares]
    table.add_row("mean", *(f"{mean:.0%}" for mean in means))
    console.print(table)
    for whose in ("sampled", "real"):
        console.print(
            f"largest hand step, {whose}: {max(row[whose]['hand_step_cm'] for row in results.values()):.0f} cm"
        )


def ask_texts(config: DictConfig) -> None:
    """How many samples of each text of MTT show it, and their own side alone, and whether its prompt warns."""
    model = stmc.load(config.model, device=config.device, precision=config.precision)
    prompts = read_texts(config.texts)
    if unknown := [prompt.text for prompt in prompts if prompt.text not in MTT_CHECKS]:
        raise SettingError(f"texts={config.texts}: {unknown[0]!r} is none of MTT's {len(MTT_CHECKS)} texts")
    words = reworded(config.paraphrases, prompts)
    known = model.recognise(list(words.values())) if model.vocabulary else []
    warned = {text: not each.known for text, each in zip(words, known, strict=False)}
    results = {}
    for prompt, motions in zip(prompts, sampled_texts(config, model, prompts, words), strict=True):
        answers = [text_answers(prompt.text, motion) for motion in motions]
        results[prompt.text] = {"words": words[prompt.text], "warned": warned.get(prompt.text)} | {
            name: fmean(answer[name] for answer in answers) for name in answers[0]
        }
    write_text(Path(config.output) / "mtt_texts.json", json.dumps(results, indent=1) + "\n")
    report_texts(results, config.samples)


def reworded(path: str | None, prompts: Sequence[AtomicPrompt]) -> dict[str, str]:
    """The words to ask with, by the text. Raises `SettingError` where a text has none."""
    if path is None:
        return {prompt.text: prompt.text for prompt in prompts}
    table = json.loads(Path(path).read_text(encoding="utf-8"))
    if missing := [prompt.text for prompt in prompts if not isinstance(table.get(prompt.text), str)]:
        raise SettingError(f"paraphrases={path}: no words for {missing[0]!r}")
    return {prompt.text: table[prompt.text] for prompt in prompts}


def sampled_texts(
    config: DictConfig, model: stmc.Model, prompts: Sequence[AtomicPrompt], words: Mapping[str, str]
) -> Iterator[list[Motion]]:
    """The samples of one text after the other; those of several are made at once."""
    timelines = [Timeline((Prompt(words[each.text], 0.0, config.seconds, each.parts),)) for each in prompts]
    requests = [(timeline, config.seed + number) for timeline in timelines for number in range(config.samples)]
    motions: list[Motion] = []
    for start in track(range(0, len(requests), config.batch), "Sampling"):
        batch, seeds = zip(*requests[start : start + config.batch], strict=True)
        motions += model.generate(
            list(batch),
            seed=list(seeds),
            guidance=config.guidance,
            steps=config.steps,
            noise_scale=config.noise_scale,
            clean_feet=config.clean_feet,
        )
        while len(motions) >= config.samples:
            yield motions[: config.samples]
            motions = motions[config.samples :]


def text_answers(text: str, motion: Motion) -> dict[str, bool]:
    """Whether a motion shows a text, and its side alone (its mirror image does not); and which others it passes."""
    shown = MTT_CHECKS[text].shows(motion)
    sided = shown and (mirror_words(text) == text or not MTT_CHECKS[text].shows(motion.mirrored()))
    others = {other: check.shows(motion) for other, check in MTT_CHECKS.items() if other not in same_meaning(text)}
    return {"shown": shown, "sided": sided} | others


def report_texts(results: Mapping[str, Mapping], samples: int) -> None:
    """Each text with its samples, whether it warns and which others they pass; then how many texts are shown."""
    console, table = Console(), Table("text", "shown", "its side alone", "warns", "passes also")
    for text, row in results.items():
        counts = [f"{samples * row[name]:.0f}/{samples}" for name in ("shown", "sided")]
        name = text if row["words"] == text else f"{text}: {row['words']}"
        warns = {None: "?", True: "warns", False: ""}[row["warned"]]
        table.add_row(name, counts[0], counts[1] if mirror_words(text) != text else "", warns, others_passed(row))
    console.print(table)
    shown = {text: row["sided"] >= SHOWN for text, row in results.items()}
    silent = sum(not shown[text] and row["warned"] is False for text, row in results.items())
    warned = sum(shown[text] and bool(row["warned"]) for text, row in results.items())
    mean = fmean(row["shown"] for row in results.values())
    console.print(
        f"shown: {sum(shown.values())} of {len(results)} texts, in {SHOWN:.0%} of the samples or more; "
        f"mean {mean:.2f}; missed without a warning: {silent}; shown although warned of: {warned}",
        soft_wrap=True,
    )


def others_passed(row: Mapping) -> str:
    """The other texts whose checks are passed most often, above `CONFUSED`."""
    passed = sorted(((row[other], other) for other in MTT_CHECKS if row.get(other, 0) > CONFUSED), reverse=True)
    return ", ".join(f"{other} {share:.0%}" for share, other in passed[:3])


def calibrate(config: DictConfig) -> None:
    """Of each text, how often recorded motions of its own pass its check, and those of all other texts. A text that
    claims other body parts is not named: what its motions do with these is no part of it."""
    cache, representation = read_caches(list(config.cache)), SmplRepresentation()
    real = recorded(cache, representation, cache.skeleton or stmc.Skeleton.default(), config.clips)
    parts = {prompt.text: prompt.parts for prompt in read_texts(config.texts)}
    own = {text: [motion for action in MTT_CHECKS[text].actions for motion in real.get(action, [])] for text in parts}
    shares = confusions({text: motions for text, motions in own.items() if motions})
    write_text(Path(config.output) / "mtt_checks.json", json.dumps(shares, indent=1) + "\n")
    table = Table("text", "own motions", "pass", "others pass (mean)", f"passed by, above {CONFUSED:.0%}")
    for text in parts:
        others = {other: share for other, share in shares[text].items() if text not in same_meaning(other)}
        named = sorted(((share, other) for other, share in others.items() if parts[other] & parts[text]), reverse=True)
        worst = ", ".join(f"{other} {share:.0%}" for share, other in named if share > CONFUSED)
        passes = f"{shares[text][text]:.0%}" if own[text] else ""
        table.add_row(text, str(len(own[text])), passes, f"{fmean(others.values()):.1%}", worst)
    Console().print(table)


def report_by_distance(results: dict, console: Console) -> None:
    """How often the samples show sentences that are near to one of the training on these contents, and far from all."""
    shares = {text: share for row in results.values() for text, share in row["sentences"].items()}
    training = [text for name in results for text in CONTENTS[name].sentences]
    table = Table("cosine to the nearest training sentence", "sentences", "success")
    for name, count, success in success_by_distance(shares, training, MiniLM()):
        table.add_row(name, str(count), "" if success is None else f"{success:.0%}")
    console.print(table)
