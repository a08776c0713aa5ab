"""Ask a model for every action of its data that geometry can tell: `stmc actions model=RUN`.

With `texts=texts.txt`, ask for the 60 texts of MTT, each alone on its own body parts. `record=true` stores in the run
directory how often samples show what they were asked for; `prompts=prompts.json` calibrates when the model warns.
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
from stmc.cli.action_reports import CONFUSED, report, report_by_distance, report_texts
from stmc.cli.commands import command
from stmc.cli.shared_settings import OnModel
from stmc.data.cache import Cache, read_caches
from stmc.data.sources.contents import CONTENTS
from stmc.diffusion import NoiseScale
from stmc.evaluation.benchmarks.atomic_prompts import AtomicPrompt, read_texts
from stmc.evaluation.benchmarks.calibrating import calibrated, rates_of_warnings, read_prompts
from stmc.evaluation.benchmarks.mtt_checks import MTT_CHECKS, confusions, mirror_words, same_meaning
from stmc.evaluation.benchmarks.questions import QUESTIONS, rates
from stmc.evaluation.metrics.retrieval import cosines, ranks
from stmc.evaluators import Evaluator
from stmc.io.extras import require
from stmc.io.files import write_text, write_whole
from stmc.model import Precision
from stmc.motion.kinematics import foot_sliding, hand_step
from stmc.motion.motion import Motion
from stmc.motion.representation import Representation, SmplRepresentation
from stmc.run import calibrate
from stmc.settings.records import SettingError, setting
from stmc.text.vocabulary import Trial
from stmc.timeline import Prompt, Timeline

WINDOW = 4.0
"""Seconds of a cyclic clip that are asked at once, and of a cyclic content that are sampled."""

AMONG = 3
"""A content is found where the evaluator has it among its best so many."""


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
    record: bool = setting(False, "store the success of each sentence, or the thresholds, in the model's run directory")
    prompts: str | None = setting(None, "JSON of prompts that the model knows and does not: calibrate its warnings")
    output: str = setting("outputs/actions", "folder of pictures and numbers")
    precision: str = setting("fp32", "of the denoiser; bf16 is fast on some processors", choices=get_args(Precision))


@command("actions", Settings, ("model", "evaluator", "output"))
def main(config: DictConfig) -> None:
    if config.prompts:
        return calibrate_warnings(config)
    if config.texts:
        return calibrate_checks(config) if config.recorded else ask_texts(config)
    require("matplotlib", "PIL")
    model, folder = loaded(config), Path(config.output)
    cache, results, trials, console = read_caches(list(config.cache)), {}, {}, Console()
    evaluator = stmc.load_evaluator(config.evaluator, device=config.device)
    finder = Finder(evaluator, {clip.content for clip in cache.clips})
    real = recorded(cache, model.representation, model.skeleton, config.clips)
    for name in track(chosen(config, set(real)), "Sampling", console=console):
        seconds = min(WINDOW, median(motion.duration for motion in real[name]))
        motions = {text: asked(config, model, name, text, seconds) for text in sentences(config, name)}
        answers = geometry_answers(name, motions, real)
        sampled = [motion for several in motions.values() for motion in several]
        plausible = {"sampled": plausibility(sampled), "real": plausibility(real[name])}
        found = {text: finder.found(name, several) for text, several in motions.items()}
        heard = {"found": fmean(found.values()), "real_found": finder.found(name, real[name])}
        results[name] = answers | heard | plausible
        for text, several in motions.items():
            trials[text] = trial(config, model, name, several, answers["sentences"].get(text), found[text])
        draw(folder / f"{name}.png", {f"{name}, recorded": real[name][0]} | {t: m[0] for t, m in motions.items()})
        write_text(folder / "actions.json", json.dumps(results, indent=1) + "\n")
    report(results, console)
    report_by_distance(results, console)
    record(config, model, trials)


def geometry_answers(name: str, motions: Mapping[str, Sequence[Motion]], real: Mapping[str, Sequence[Motion]]) -> dict:
    """How often samples of each sentence show a content, real motion of it, and real motion of others; None where
    geometry cannot tell."""
    if name not in QUESTIONS:
        return {"shown": None, "ceiling": None, "chance": None, "sentences": {}}
    question = QUESTIONS[name]
    shares = {text: fmean(map(question, several)) for text, several in motions.items()}
    known = rates(question, real[name], {other: real[other] for other in real if other != name})
    return {"shown": fmean(shares.values()), "ceiling": known.ceiling, "chance": known.chance, "sentences": shares}


def trial(
    config: DictConfig,
    model: stmc.Model,
    action: str,
    motions: Sequence[Motion],
    geometry: float | None,
    evaluator: float | None = None,
) -> Trial:
    """What a run directory keeps of a sentence's samples."""
    settings = model.settings(guidance=config.guidance, steps=config.steps, noise_scale=config.noise_scale)
    return Trial(action, len(motions), geometry, evaluator, settings.steps, settings.guidance, config.seed)


def record(config: DictConfig, model: stmc.Model, trials: Mapping[str, Trial]) -> None:
    """Store trials in the model's run directory, where that is asked for, beside those of other sentences."""
    if config.record:
        path = calibrate(config.model, model.vocabulary.calibration.with_trials(trials))
        Console().print(f"success of {len(trials)} sentences stored in {path}", soft_wrap=True, markup=False)


def loaded(config: DictConfig) -> stmc.Model:
    """The model. Raises `SettingError` where success cannot be stored, since no prompt would be compared with it."""
    model = stmc.load(config.model, device=config.device, precision=config.precision)
    if (config.record or config.prompts) and model.vocabulary is None:
        raise SettingError(f"model={config.model}: has no vocabulary, so there is nothing to calibrate")
    return model


def chosen(config: DictConfig, recorded: set[str]) -> list[str]:
    """The contents to ask for. Raises `SettingError` where real motion, a question or a sentence is missing."""
    told = {CONTENTS[name].sentences for name in QUESTIONS}  # walks to either side are called walks
    others = [name for name, each in CONTENTS.items() if config.record and each.sentences not in told]
    known = [name for name in (*QUESTIONS, *others) if name in recorded and CONTENTS[name].unseen]
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


def ask_texts(config: DictConfig) -> None:
    """How many samples of each text of MTT show it, and their own side alone, and whether its prompt warns."""
    model = loaded(config)
    prompts = read_texts(config.texts)
    if unknown := [prompt.text for prompt in prompts if prompt.text not in MTT_CHECKS]:
        raise SettingError(f"texts={config.texts}: {unknown[0]!r} is none of MTT's {len(MTT_CHECKS)} texts")
    words = reworded(config.paraphrases, prompts)
    known = model.recognise(list(words.values())) if model.vocabulary else []
    warned = {text: not each.works for text, each in zip(words, known, strict=False)}
    results, trials = {}, {}
    for prompt, motions in zip(prompts, sampled_texts(config, model, prompts, words), strict=True):
        answers = [text_answers(prompt.text, motion) for motion in motions]
        results[prompt.text] = {"words": words[prompt.text], "warned": warned.get(prompt.text)} | {
            name: fmean(answer[name] for answer in answers) for name in answers[0]
        }
        action = asked_action(prompt.text, model)
        trials[words[prompt.text]] = trial(config, model, action, motions, results[prompt.text]["sided"])
    write_text(Path(config.output) / "mtt_texts.json", json.dumps(results, indent=1) + "\n")
    report_texts(results, config.samples)
    record(config, model, trials)


def asked_action(text: str, model: stmc.Model) -> str:
    """The action that a text of MTT asks for: the first of those whose clips show it that the model knows, if any."""
    actions = MTT_CHECKS[text].actions
    known = {content.name for content in model.vocabulary.contents} if model.vocabulary else ()
    return next((action for action in actions if action in known), actions[0])


def calibrate_warnings(config: DictConfig) -> None:
    """Choose the recogniser's thresholds by listed prompts and by sentences that no training sees; print how well the
    model warns with its old ones and with these, and store these where that is asked for."""
    model = loaded(config)
    before, contents = model.vocabulary.calibration, {content.name for content in model.vocabulary.contents}
    inside, unknown = read_prompts(config.prompts)
    known = {text: name for name in CONTENTS if name in contents for text in CONTENTS[name].unseen}
    known |= {text: action for text, action in inside.items() if action in contents}
    texts = [*known, *unknown, *MTT_CHECKS]
    found = {each.text: each for each in model.recognise(texts)}
    if not found:
        raise SettingError(f"prompts={config.prompts}: MiniLM, by which prompts are compared, cannot be had")
    after = calibrated(before, known, unknown, found)
    console = Console(soft_wrap=True, highlight=False)
    for name, calibration in (("before", before), ("after", after)):
        console.print(f"{name}: {rates_of_warnings(calibration, known, unknown, found)}")
    console.print(f"threshold: {after.threshold}", *(f"{name} {each}" for name, each in after.thresholds.items()))
    if config.record:
        console.print(f"stored in {calibrate(config.model, after)}", markup=False)


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


def calibrate_checks(config: DictConfig) -> None:
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
