"""Measure how often samples show the action of their text: `stmc actions model=RUN`.

Geometric checks judge every action of the model's data that they can recognise. With `texts=texts.txt`, the command
samples the 60 texts of MTT instead, each alone on its own body parts. `record=true` stores success rates in the run
directory; `prompts=prompts.json` calibrates the warnings of the model.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from io import BytesIO
from itertools import chain
from pathlib import Path
from statistics import fmean, median
from typing import Any, get_args

import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track
from rich.table import Table

import stmc
from stmc.cli.action_plausibility import (
    has_frozen,
    measure_plausibility,
    measure_rest,
    share_lively,
    split_rest,
)
from stmc.cli.action_reports import CONFUSED, print_by_distance, print_report, print_texts
from stmc.cli.commands import command
from stmc.cli.shared_settings import OnModel
from stmc.data.cache import Cache, read_caches
from stmc.data.sources.contents import CONTENTS
from stmc.diffusion import NoiseScale
from stmc.evaluation.benchmarks.atomic_prompts import AtomicPrompt, read_texts
from stmc.evaluation.benchmarks.calibrating import calibrate_thresholds, rates_of_warnings, read_prompts
from stmc.evaluation.benchmarks.mtt_checks import MTT_CHECKS, confusions, mirror_words, same_meaning
from stmc.evaluation.benchmarks.questions import QUESTIONS, rates
from stmc.evaluation.metrics.retrieval import cosines, ranks
from stmc.evaluators import Evaluator
from stmc.io.extras import require
from stmc.io.files import write_text, write_whole
from stmc.io.untrusted import MOST_BYTES, UnreadableError, load_json, quote, read_text
from stmc.model import Precision
from stmc.motion.motion import Motion
from stmc.motion.representation import Representation, SmplRepresentation
from stmc.run import calibrate
from stmc.settings.records import SettingError, setting
from stmc.text.vocabulary import Trial
from stmc.timeline import Prompt, Timeline

WINDOW = 4.0
"""Length in seconds of the windows of cyclic clips, and the maximum length of samples."""
RANKED_BEST = 3
"""A content counts as found if the evaluator ranks it among this many best."""


@dataclass(frozen=True, kw_only=True)
class Settings(OnModel):
    """Settings of `stmc actions`."""

    cache: tuple[str, ...] = setting(
        ("cache/bandai", "cache/cmu"), "folders of prepared data: the source of contents and real motion"
    )
    evaluator: str | None = setting(None, "run directory of the evaluator that finds contents; null: the bundled one")
    contents: tuple[str, ...] = setting(
        (), "contents to sample; empty: all contents of the data that geometry can recognise"
    )
    seen: bool = setting(False, "use sentences of the training instead of held-out ones")
    sentences: int = setting(3, "number of sentences of each content", at_least=1)
    samples: int = setting(8, "number of motions of each sentence", at_least=1)
    clips: int = setting(20, "maximum number of real motions of each content", at_least=1)
    seed: int = setting(0, "seed of the first motion", at_least=0)
    guidance: float | int | None = setting(
        None, "classifier-free guidance scale; null: the model's default", at_least=0
    )
    steps: int | None = setting(50, "denoising steps, fast actions need many; null: as many as in training", at_least=1)
    after: float | int = setting(
        0.0, "seconds by which samples of one-shot actions last longer: do people freeze then?", at_least=0
    )
    clean_feet: bool = setting(False, "remove foot sliding and floor penetration after sampling")
    noise_scale: str | None = setting(
        None, "scale of DDPM's noise; null: the model's default", choices=get_args(NoiseScale)
    )
    texts: str | None = setting(None, "MTT's texts.txt: sample its 60 texts instead of the contents of the data")
    paraphrases: str | None = setting(
        None, "JSON file {text: paraphrase} of the sentences to sample instead of MTT's texts"
    )
    recorded: bool = setting(False, "check recordings of the cache that show the texts instead of samples")
    seconds: float | int = setting(6.0, "duration of each text", at_least=1)
    batch: int = setting(64, "number of motions of texts to sample at once", at_least=1)
    record: bool = setting(False, "store success rates, or thresholds, in the model's run directory")
    prompts: str | None = setting(
        None, "JSON file of in- and out-of-vocabulary prompts: calibrate the model's warnings"
    )
    output: str = setting("outputs/actions", "folder for pictures and numbers")
    precision: str = setting(
        "fp32", "precision of the denoiser; bf16 is fast on some processors", choices=get_args(Precision)
    )


@command("actions", Settings, ("model", "evaluator", "output"))
def main(config: DictConfig) -> None:
    if config.prompts:
        return calibrate_warnings(config)
    if config.texts:
        return calibrate_checks(config) if config.recorded else evaluate_texts(config)
    require("matplotlib", "PIL")
    model, folder = load_model(config), Path(config.output)
    cache, results, trials, console = read_caches(list(config.cache)), {}, {}, Console()
    evaluator = stmc.load_evaluator(config.evaluator, device=config.device)
    finder = Finder(evaluator, {clip.content for clip in cache.clips})
    real = real_motions(cache, model.representation, model.skeleton, config.clips)
    for name in track(choose_contents(config, set(real)), "Sampling", console=console):
        seconds = min(WINDOW, median(motion.duration for motion in real[name]))
        after = 0.0 if CONTENTS[name].cyclic else config.after
        longer = {text: sample_sentence(config, model, name, text, seconds + after) for text in sentences(config, name)}
        motions, rests = split_rest(longer, after)
        answers = check_geometry(name, motions, real) | measure_rest(rests, real)
        sampled = [motion for several in motions.values() for motion in several]
        plausible = {"sampled": measure_plausibility(sampled), "real": measure_plausibility(real[name])}
        found = {text: finder.finds(name, several) for text, several in motions.items()}
        retrieval = {"found": fmean(chain(*found.values())), "real_found": fmean(finder.finds(name, real[name]))}
        results[name] = answers | retrieval | plausible | {"lively": share_lively(real[name], len(sampled))}
        energy = plausible["real"]["energy"]
        assert energy is not None  # only sliding may be
        for text, several in motions.items():
            pairs = zip(found[text], several, strict=True)
            alive = fmean(hit and not has_frozen(motion, energy) for hit, motion in pairs)
            trials[text] = make_trial(config, model, name, several, answers["sentences"].get(text), alive)
        draw(folder / f"{name}.png", {f"{name}, recorded": real[name][0]} | {t: m[0] for t, m in motions.items()})
        write_text(folder / "actions.json", json.dumps(results, indent=1) + "\n")
    print_report(results, console)
    print_by_distance(results, console)
    record(config, model, trials)


def check_geometry(name: str, motions: Mapping[str, Sequence[Motion]], real: Mapping[str, Sequence[Motion]]) -> dict:
    """Measure how often samples, real motion of a content and real motion of others show it; None without a check."""
    if name not in QUESTIONS:
        return {"shown": None, "ceiling": None, "chance": None, "sentences": {}}
    question = QUESTIONS[name]
    shares = {text: fmean(map(question, several)) for text, several in motions.items()}
    known = rates(question, real[name], {other: real[other] for other in real if other != name})
    return {"shown": fmean(shares.values()), "ceiling": known.ceiling, "chance": known.chance, "sentences": shares}


def make_trial(
    config: DictConfig,
    model: stmc.Model,
    action: str,
    motions: Sequence[Motion],
    geometry: float | None,
    evaluator: float | None = None,
) -> Trial:
    """Return the record that a run directory keeps of a sentence's samples."""
    settings = model.settings(guidance=config.guidance, steps=config.steps, noise_scale=config.noise_scale)
    assert settings.steps is not None
    return Trial(action, len(motions), geometry, evaluator, settings.steps, settings.guidance, config.seed)


def record(config: DictConfig, model: stmc.Model, trials: Mapping[str, Trial]) -> None:
    """Store trials in the model's run directory beside those of other sentences if `record` is set."""
    if config.record:
        assert model.vocabulary is not None  # see `load_model`
        path = calibrate(config.model, model.vocabulary.calibration.with_trials(trials))
        Console().print(f"success of {len(trials)} sentences stored in {path}", soft_wrap=True, markup=False)


def load_model(config: DictConfig) -> stmc.Model:
    """Load the model. Raises `SettingError` if results are to be stored and the model has no vocabulary."""
    model = stmc.load(config.model, device=config.device, precision=config.precision)
    if (config.record or config.prompts) and model.vocabulary is None:
        raise SettingError(f"model={config.model}: has no vocabulary, so there is nothing to calibrate")
    return model


def choose_contents(config: DictConfig, available: set[str]) -> list[str]:
    """Choose the contents to sample. Raises `SettingError` if one lacks real motion, a check or a held-out sentence."""
    checked = {CONTENTS[name].sentences for name in QUESTIONS}  # walks to either side are called walks
    others = [name for name, content in CONTENTS.items() if config.record and content.sentences not in checked]
    known = [name for name in (*QUESTIONS, *others) if name in available and CONTENTS[name].unseen]
    if not known:
        raise SettingError(f"cache={', '.join(config.cache)}: has no content that geometry can recognise")
    if missing := [name for name in config.contents if name not in known]:
        raise SettingError(f"contents={missing[0]}: choose from {', '.join(known)}")
    return list(config.contents) or known


def sentences(config: DictConfig, name: str) -> tuple[str, ...]:
    """Return held-out sentences of a content, or training sentences if `seen` is set."""
    return (CONTENTS[name].sentences if config.seen else CONTENTS[name].unseen)[: config.sentences]


def sample_sentence(config: DictConfig, model: stmc.Model, name: str, text: str, seconds: float) -> list[Motion]:
    """Sample a sentence on the content's body parts."""
    timeline = Timeline((Prompt(text, 0.0, round(seconds, 1), CONTENTS[name].parts),), name=f"{name}: {text}")
    return generate(config, model, [timeline] * config.samples, config.seed)


def generate(config: DictConfig, model: stmc.Model, timelines: list[Timeline], seed: int | list[int]) -> list[Motion]:
    """Generate motions with the settings of the command."""
    settings = {name: config[name] for name in ("guidance", "steps", "noise_scale", "clean_feet")}
    return model.generate(timelines, seed=seed, **settings)


class Finder:
    """Retrieval by an evaluator: a content is found if it ranks among the best `RANKED_BEST` of the data's `contents`.

    The first sentence of a content stands for it.
    """

    def __init__(self, evaluator: Evaluator, contents: Collection[str]) -> None:
        self.evaluator = evaluator
        shown = (content.sentences[0] for name, content in CONTENTS.items() if name in contents)
        self.texts = list(dict.fromkeys(shown))
        self.latents = evaluator.texts(self.texts)

    def finds(self, name: str, motions: Sequence[Motion]) -> list[bool]:
        """Tell of which motions the evaluator finds the content `name`."""
        features = [self.evaluator.features(motion) for motion in motions]
        scores = cosines(self.evaluator.motions(features), self.latents)
        own = torch.tensor([text == CONTENTS[name].sentences[0] for text in self.texts])
        return (ranks(scores, own.expand(len(motions), -1)) < RANKED_BEST).tolist()


def draw(path: Path, motions: Mapping[str, Motion]) -> None:
    """Draw film strips of named motions, one below the other."""
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


def real_motions(
    cache: Cache, representation: Representation, skeleton: stmc.Skeleton, most: int
) -> dict[str, list[Motion]]:
    """Return up to `most` real motions of each content, spread over its clips; windows of cyclic clips."""
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


def evaluate_texts(config: DictConfig) -> None:
    """Measure how many samples of each text of MTT show it, and show it on its own side only; report warnings."""
    model = load_model(config)
    prompts = read_texts(config.texts)
    if unknown := [prompt.text for prompt in prompts if prompt.text not in MTT_CHECKS]:
        raise SettingError(f"texts={config.texts}: {unknown[0]!r} is not one of MTT's {len(MTT_CHECKS)} texts")
    words = read_paraphrases(config.paraphrases, prompts)
    known = model.recognise(list(words.values())) if model.vocabulary else []
    warned = {text: not each.works for text, each in zip(words, known, strict=False)}
    results: dict[str, dict[str, Any]] = {}
    trials: dict[str, Trial] = {}
    for prompt, motions in zip(prompts, sample_texts(config, model, prompts, words), strict=True):
        answers = [check_text(prompt.text, motion) for motion in motions]
        results[prompt.text] = {"words": words[prompt.text], "warned": warned.get(prompt.text)} | {
            name: fmean(answer[name] for answer in answers) for name in answers[0]
        }
        action = find_action(prompt.text, model)
        trials[words[prompt.text]] = make_trial(config, model, action, motions, results[prompt.text]["sided"])
    write_text(Path(config.output) / "mtt_texts.json", json.dumps(results, indent=1) + "\n")
    print_texts(results, config.samples)
    record(config, model, trials)


def find_action(text: str, model: stmc.Model) -> str:
    """Return the action of a text of MTT: the first in the model's vocabulary, or else the first of all."""
    actions = MTT_CHECKS[text].actions
    known = {content.name for content in model.vocabulary.contents} if model.vocabulary else ()
    return next((action for action in actions if action in known), actions[0])


def calibrate_warnings(config: DictConfig) -> None:
    """Choose the recogniser's thresholds from listed prompts and held-out sentences.

    Prints the rates of warnings with the old and the new thresholds, and stores the new ones if `record` is set.
    """
    model = load_model(config)
    assert model.vocabulary is not None
    before, contents = model.vocabulary.calibration, {content.name for content in model.vocabulary.contents}
    inside, unknown = read_prompts(config.prompts)
    known = {text: name for name in CONTENTS if name in contents for text in CONTENTS[name].unseen}
    known |= {text: action for text, action in inside.items() if action in contents}
    texts = [*known, *unknown, *MTT_CHECKS]
    # by score alone: the thresholds are for prompts that nobody has tested
    found = {each.text: replace(each, tested=False) for each in model.recognise(texts)}
    if not found:
        raise SettingError(f"prompts={config.prompts}: comparing prompts needs MiniLM, which is not available")
    after = calibrate_thresholds(before, known, unknown, found)
    console = Console(soft_wrap=True, highlight=False)
    for name, calibration in (("before", before), ("after", after)):
        console.print(f"{name}: {rates_of_warnings(calibration, known, unknown, found)}")
    console.print(f"threshold: {after.threshold}", *(f"{name} {each}" for name, each in after.thresholds.items()))
    if config.record:
        console.print(f"stored in {calibrate(config.model, after)}", markup=False)


def read_paraphrases(path: str | None, prompts: Sequence[AtomicPrompt]) -> dict[str, str]:
    """Return the sentence to sample for each text. Raises `SettingError` for an unreadable file or a missing text."""
    if path is None:
        return {prompt.text: prompt.text for prompt in prompts}
    try:
        table = load_json(read_text(Path(path), MOST_BYTES))
    except UnreadableError as error:
        raise SettingError(f"paraphrases={path}: {error}") from None
    if not isinstance(table, dict):
        raise SettingError(f"paraphrases={path}: must be an object of text: paraphrase, not {quote(table)}")
    if missing := [prompt.text for prompt in prompts if not isinstance(table.get(prompt.text), str)]:
        raise SettingError(f"paraphrases={path}: has no sentence for {missing[0]!r}")
    return {prompt.text: table[prompt.text] for prompt in prompts}


def sample_texts(
    config: DictConfig, model: stmc.Model, prompts: Sequence[AtomicPrompt], words: Mapping[str, str]
) -> Iterator[list[Motion]]:
    """Yield the samples of each text in turn; one batch may hold several texts."""
    timelines = [Timeline((Prompt(words[each.text], 0.0, config.seconds, each.parts),)) for each in prompts]
    requests = [(timeline, config.seed + number) for timeline in timelines for number in range(config.samples)]
    motions: list[Motion] = []
    for start in track(range(0, len(requests), config.batch), "Sampling"):
        batch, seeds = zip(*requests[start : start + config.batch], strict=True)
        motions += generate(config, model, list(batch), list(seeds))
        while len(motions) >= config.samples:
            yield motions[: config.samples]
            motions = motions[config.samples :]


def check_text(text: str, motion: Motion) -> dict[str, bool]:
    """Check whether a motion shows a text, does so on its own side only (its mirror image fails), and passes others."""
    shown = MTT_CHECKS[text].shows(motion)
    sided = shown and (mirror_words(text) == text or not MTT_CHECKS[text].shows(motion.mirrored()))
    others = {other: check.shows(motion) for other, check in MTT_CHECKS.items() if other not in same_meaning(text)}
    return {"shown": shown, "sided": sided} | others


def calibrate_checks(config: DictConfig) -> None:
    """Measure how often recorded motions of each text, and of all others, pass the check of the text.

    The table names confusions only between texts that share body parts.
    """
    cache, representation = read_caches(list(config.cache)), SmplRepresentation()
    real = real_motions(cache, representation, cache.skeleton or stmc.Skeleton.default(), config.clips)
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
