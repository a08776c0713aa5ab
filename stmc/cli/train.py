"""Train a denoiser: `stmc train runs/mine data.folder=CACHE`; on several devices: `accelerate launch -m stmc train`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import torch
from omegaconf import DictConfig, OmegaConf, open_dict

import stmc
from stmc import training
from stmc.cli.commands import command
from stmc.cli.config_parts import build_part, resolve_config
from stmc.cli.shared_settings import Trained
from stmc.cli.training_data import read_training_data
from stmc.composing.sampling import Sampling
from stmc.data.cache import Cache
from stmc.denoisers import Network
from stmc.diffusion import NoiseScale, Schedule, tensors
from stmc.io.files import write_whole
from stmc.model import Model
from stmc.run import PARTS, build, check
from stmc.run.configs import PARTIAL, TARGET
from stmc.settings.records import SettingError, check_value, quote, record_of, setting
from stmc.text import Cached, TextEncoder
from stmc.text.vocabulary import sentence_encoder
from stmc.training import Denoising, GuidedTeacher, MultistepTeacher, RememberingTeacher
from stmc.training.data.batches import ClipBatches, Recipe
from stmc.training.data.dataset import Dataset
from stmc.training.data.vocabularies import vocabulary_of
from stmc.training.loss import Teacher

if TYPE_CHECKING:  # an extra, which the help does without
    import accelerate

DRAWN_TIMELINES = ("walk forwards # 0 # 6 # legs\nraise the right arm # 2 # 5 # right arm", "turn left # 0 # 5 # legs")


@dataclass(frozen=True, kw_only=True)
class Settings(Trained):
    """Settings of `stmc train`."""

    objective: Mapping = setting(
        {"prediction": "x0", "weights": {}},
        "prediction: quantity that the denoiser predicts (x0, eps, v or score); weights: loss weights of fields other "
        "than 1; timestep_alpha: above 1, noisy steps are drawn more often; energy_floor: weigh small motions as much "
        "as large ones; distilled_guidance: guidance scale of the teacher whose predictions are learned; steps: number "
        "of sampling steps to train; teacher_steps: number of the teacher's steps that these replace",
    )
    noise_scale: str = setting(
        "variance", "scale of DDPM's noise when the model is sampled", choices=get_args(NoiseScale)
    )
    guidance: float | int | None = setting(
        None, "default guidance scale when the model is sampled; null: 2.5, or 1 for a distilled model"
    )
    init_from: str | None = setting(None, "run directory of the same denoiser to start from; null: fresh weights")
    teacher: str | None = setting(
        None, "run directory of another denoiser to distil with distilled_guidance; null: init_from"
    )
    draw_every: int = setting(2000, "number of steps between pictures", at_least=1)
    draw: tuple[str, ...] = setting(DRAWN_TIMELINES, "timelines to draw pictures of")


@command("train", Settings, ("run",))
def main(config: DictConfig) -> None:
    with training.begin(config.run, config.device) as accelerator:
        train(config, accelerator)


def train(config: DictConfig, accelerator: accelerate.Accelerator) -> None:
    """Train a denoiser, from the data to the run directory."""
    settings, recipe = build_part(config, "training", training.Settings), build_part(config, "data.sampling", Recipe)
    check_parts(config)
    started = stmc.load(config.init_from, trusted=config.trusted) if config.init_from else None
    distilled = find_teacher(config, stmc.load(config.teacher, trusted=config.trusted) if config.teacher else started)
    cache, dataset = read_training_data(
        config,
        started.text_statistics if started else None,
        accelerator.device,
        distilled.motion_statistics if distilled else None,
    )
    held_out = ClipBatches(dataset, "val", recipe, settings.seed)
    torch.manual_seed(settings.seed)
    sampling = default_sampling(config, distilled)
    model = start_model(build_model(config, dataset, cache, sampling, int(recipe.longest * dataset.fps)), started)
    check_texts(recipe, model.network)
    check(model, config.trusted)  # before the first step: refuse to train a model that could not be loaded
    trainer: training.Trainer = training.Trainer(
        model.network,
        build_objective(config, dataset, model, distilled),
        ClipBatches(dataset, "train", recipe, settings.seed),
        Path(config.run).expanduser(),
        settings,
        validation=[piece for step in range(config.validation) for piece in held_out(step)],
        callbacks=[
            training.Callback(
                settings.checkpoint_every,
                lambda step, network: export(config, replace(model, denoiser=network), step, trainer.changes),
            ),
            training.Callback(
                config.draw_every, lambda step, network: draw(config, replace(model, denoiser=network), step)
            ),
        ],
        accelerator=accelerator,
        described=describe_run(config, cache),
        allow_changed_settings=config.allow_changed_settings,
    )
    trainer.run()


def start_model(model: Model, started: Model | None) -> Model:
    """Load the weights of the model that training starts from, if there is one, and return `model`."""
    if started:
        model.network.load_state_dict(started.network.state_dict())
        model.network.restate(started.motion_statistics, model.motion_statistics)
    return model


def describe_run(config: DictConfig, cache: Cache) -> dict[str, Any]:
    """Return everything that decides the trained weights; a run resumes only with an equal description."""
    described = resolve_config(config) | {"cache": cache.fingerprint}
    if config.teacher is None:
        del described["teacher"]  # runs from before this setting existed can be resumed
    return described


def check_texts(recipe: Recipe, denoiser: Network) -> None:
    """Raise `ValueError` for rows of several texts if the denoiser takes one text per motion."""
    if recipe.several_texts and not denoiser.per_frame_text:
        raise ValueError(
            f"data.sampling: {type(recipe).__name__} makes rows of several texts, which require a denoiser with "
            f"per_frame_text, such as denoiser=flow_mdm_small, not {type(denoiser).__name__}; for other "
            "denoisers use data/sampling=balanced, which has one text per row"
        )


def check_parts(config: DictConfig) -> None:
    """Check that the parts can be built, before the data are read, which takes minutes."""
    described = resolve_config(config)
    reading = build(described, {part: PARTS[part] for part in ("representation", "text_encoder")}, config.trusted)
    widths = {"features": reading["representation"].width, "text_width": reading["text_encoder"].width}
    if not isinstance(described["denoiser"], dict):
        raise SettingError(f"denoiser={quote(described['denoiser'])}: must be a table with `_target_`")
    described["denoiser"] |= widths
    with torch.random.fork_rng(devices=[]):
        built = build(described, {part: PARTS[part] for part in ("denoiser", "schedule")}, config.trusted)
    settings = dict(config.objective)
    check_value("objective.distilled_guidance", settings.pop("distilled_guidance", None), float | int | None)
    check_steps(config, built["schedule"], settings.pop("teacher_steps", None))
    settings.pop("weights", None)  # may name fields that only the data add
    checked = OmegaConf.create({"objective": {TARGET: "stmc.training.Denoising", PARTIAL: True} | settings})
    build_part(checked, "objective")(schedule=built["schedule"])
    unbuilt: dict[str, Any] = {PARTIAL: True}  # names and settings; the data are missing yet
    for part in ("data.dataset", "data.prolonging", "data.auxiliary_loss"):
        if OmegaConf.select(config, part) is not None:
            build_part(config, part, **unbuilt)


def check_steps(config: DictConfig, schedule: Schedule, teacher_steps: int | None) -> None:
    """Raise `ValueError` unless few steps of sampling, if any, can be distilled from `teacher_steps` of a teacher."""
    objective = config.objective
    check_value("objective.steps", objective.get("steps"), int | None)
    check_value("objective.teacher_steps", teacher_steps, int | None)
    if teacher_steps is None:
        return
    if objective.get("steps") is None or objective.get("distilled_guidance") is None:
        raise SettingError(
            f"objective.teacher_steps={teacher_steps} needs objective.steps, such as 4, and "
            "objective.distilled_guidance, such as 2"
        )
    MultistepTeacher(lambda batch, noisy, t: noisy, schedule, objective.steps, teacher_steps)


def find_teacher(config: DictConfig, teacher: Model | None) -> Model | None:
    """Return the teacher whose guided predictions are learned, or None if training learns from the data.

    Raises `ValueError` if the teacher is missing or incompatible with this training: another representation, noise
    schedule or prediction, a text for every frame, or another text encoder if training starts from the teacher.
    """
    guidance = config.objective.get("distilled_guidance")
    if guidance is None:
        if config.teacher:
            raise SettingError(f"teacher={config.teacher} needs objective.distilled_guidance, such as 2")
        return None
    if teacher is None:
        raise SettingError(
            f"objective.distilled_guidance={guidance} needs a model to distil: init_from=RUN or teacher=RUN"
        )
    described = resolve_config(config)
    reading = () if config.teacher else ("text_encoder",)  # another model may have its own text encoder
    wanted = {part: described[part] for part in ("schedule", "representation", *reading)}
    wanted |= {"objective.prediction": config.objective.prediction, "schedule": noise_levels(wanted["schedule"])}
    has = {**teacher.config, "objective.prediction": teacher.prediction}
    has["schedule"] = noise_levels(has["schedule"])
    differing = [
        f"{part} is {has[part]} there and {value} here" for part, value in wanted.items() if has[part] != value
    ]
    named = teacher_path(config)
    if differing:
        raise ValueError(f"{named} cannot be distilled by this training: {'; '.join(differing)}")
    if teacher.network.per_frame_text:
        raise ValueError(
            f"{named} cannot be distilled: {type(teacher.denoiser).__name__} has a text for every frame; "
            "choose a denoiser of one text per motion, such as MdmSmpl"
        )
    return teacher


def noise_levels(schedule: Mapping) -> dict:
    """Return the description of a schedule without its spacing, which concerns sampling alone."""
    return {name: value for name, value in schedule.items() if name != "spacing"}


def teacher_path(config: DictConfig) -> str | None:
    """Return the run directory of the distilled model."""
    return config.teacher or config.init_from


def build_objective(config: DictConfig, dataset: Dataset, model: Model, distilled: Model | None) -> Denoising:
    """Build the objective of `model`: learn from the data, or from the guided predictions of a distilled model."""
    auxiliary, settings = config.data.auxiliary_loss, dict(config.objective)
    guidance, teacher_steps = settings.pop("distilled_guidance", None), settings.pop("teacher_steps", None)
    auxiliary_loss = build_part(config, "data.auxiliary_loss", dataset=dataset) if auxiliary else None
    fields = dict(dataset.layout.slices)
    if auxiliary_loss:
        fields[auxiliary_loss.name] = slice(dataset.features_width, None)
    teacher: Teacher | None = build_teacher(config, dataset, distilled, guidance) if distilled else None
    if teacher is not None and teacher_steps:
        steps = settings["steps"], teacher_steps
        teacher = MultistepTeacher(teacher, model.schedule, *steps, prediction=model.prediction)
    if teacher is not None and config.training.get("rounds", 1) > 1:
        batches = config.validation + training.loop.ROUND  # twice as many: a validation must not drop those of a round
        teacher = RememberingTeacher(teacher, 2 * batches * config.data.sampling.get("pieces", 1))
    return Denoising(model.schedule, fields=fields, auxiliary_loss=auxiliary_loss, teacher=teacher, **settings)


def build_teacher(config: DictConfig, dataset: Dataset, distilled: Model, guidance: float | int) -> GuidedTeacher:
    """Return the distilled model as a teacher; it encodes the data set's sentences with its own text encoder."""
    if distilled.fps != dataset.fps:
        raise ValueError(f"{teacher_path(config)} has {distilled.fps:g} frames per second, the data {dataset.fps:g}")
    device = dataset.motion.mean.device
    assert isinstance(distilled.text_encoder, TextEncoder)  # it was loaded
    reading = replace(distilled, text_encoder=Cached(distilled.text_encoder, config.text_cache))
    texts, words = tensors.pad(list(reading.embed(dataset.sentences).values()))
    denoiser = distilled.to(device).network
    if config.training.compile:
        denoiser.compile(dynamic=True)
    return GuidedTeacher(denoiser, guidance, texts.to(device), words.to(device))


def default_sampling(config: DictConfig, distilled: Model | None = None) -> Sampling:
    """Return the model's sampling defaults: those of the teacher without guidance for a distilled model.

    A model of few steps is sampled in these, by DDIM, and stitched from the first on. With four steps, its transitions
    are then as smooth as the teacher's, and neither action success, retrieval nor FID changes measurably.
    """
    guidance = 1 if distilled and config.guidance is None else config.guidance
    values = {"noise_scale": config.noise_scale, "guidance": guidance}
    if steps := config.objective.get("steps"):
        values |= {"steps": steps, "sampler": "ddim", "stitch_from": 0.0}
    own = record_of(Sampling, values)
    return own.with_defaults(distilled.sampling) if distilled else own


def build_model(config: DictConfig, dataset: Dataset, cache: Cache, sampling: Sampling, longest: int) -> Model:
    """Build the model as it would be loaded from the run directory, with fresh weights.

    Args:
        config: Configuration of the command.
        dataset: Training data, which give statistics, skeleton and frame rate.
        cache: Prepared data, which give the vocabulary.
        sampling: Sampling defaults.
        longest: Maximum number of frames of a motion.
    """
    with open_dict(config):
        config.denoiser.update(features=dataset.features_width, text_width=dataset.text_width)
    described = resolve_config(config)
    parts = build(described, trusted=config.trusted)
    representation, encoder = parts["representation"], Cached(parts["text_encoder"], config.text_cache)
    return Model(
        denoiser=parts["denoiser"],
        schedule=parts["schedule"],
        text_encoder=encoder,
        representation=representation,
        motion_statistics=dataset.motion.to("cpu"),
        text_statistics=dataset.text.to("cpu"),
        skeleton=dataset.skeleton or representation.skeleton,
        fps=dataset.fps,
        longest=longest,
        prediction=config.objective.prediction,
        sampling=sampling,
        vocabulary=vocabulary_of(cache, dataset.min_clips, sentence_encoder(encoder), dataset.joined),
        config={part: described[part] for part in PARTS},
    )


def export(config: DictConfig, model: Model, step: int, changes: Sequence[str]) -> None:
    """Save the moving average as a run directory, with a card that lists settings and their changes."""
    folder = Path(config.run).expanduser()
    settings = OmegaConf.to_yaml(config, resolve=True)
    card = f"# Trained with stmc train, step {step}\n\n"
    if guidance := config.objective.get("distilled_guidance"):
        card += (
            f"Distilled from {teacher_path(config)}: one pass predicts what that model does with guidance {guidance}. "
            f"Its own guidance is {model.own_sampling.guidance:g}.\n\n"
        )
    if teacher_steps := config.objective.get("teacher_steps"):
        card += f"Its {config.objective.steps} steps of DDIM replace {teacher_steps} of that model.\n\n"
    card += f"```yaml\n{settings}```\n"
    changed = "".join(f"\nSettings changed {change}\n" for change in changes)
    stmc.save(model, folder, card + changed, trusted=config.trusted)


def draw(config: DictConfig, model: Model, step: int) -> None:
    """Draw the timelines of `config.draw` with a fixed seed, to show the progress of training."""
    folder = Path(config.run).expanduser() / "pictures"
    timelines = [stmc.Timeline.parse(text) for text in config.draw]
    steps = model.sampling.steps or 25
    motions = model.generate(timelines, seed=[0] * len(timelines), steps=steps, sampler=stmc.ddim, clean_feet=False)
    for number, (timeline, motion) in enumerate(zip(timelines, motions, strict=True)):
        picture = partial(stmc.film_strip(motion, timeline).savefig, format="png", dpi=80)
        write_whole(folder / f"{number}_{step:07d}.png", picture)
