"""What keys of configurations were called before: run directories, checkpoints and tables of earlier versions can be
read all the same.

Knows names; knows no file.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

RENAMED: Mapping[str, str] = {"spread": "noise_scale", "late": "stitch_from", "window": "fixed_length"}
"""Every key that has another name now, wherever it stands in a run directory's config."""

RENAMED_SETTINGS: Mapping[str, str] = {
    "training.rate": "training.lr",
    "training.final_rate": "training.final_lr_ratio",
    "training.decay": "training.ema_decay",
    "training.clip": "training.grad_clip",
    "data.corpus.least": "data.dataset.min_clips",
    "data.corpus": "data.dataset",
    "data.sampling.silent": "data.sampling.text_dropout",
    "data.sampling.crops": "data.sampling.uncond_crop_prob",
    "data.sampling.composed": "data.sampling.compose_prob",
    "data.sampling.composed_legs": "data.sampling.compose_legs_prob",
    "data.sampling.hosts": "data.sampling.receivers",
    "data.derive": "data.auxiliary_loss",
    "objective.weights.feet": "objective.weights.foot_velocity",
    "start": "init_from",
    "sentences": "false_negative_encoder",
    "similar": "false_negative_threshold",
}
"""The settings of trainings that have another name now, by their whole path (these old names are too common to be
renamed wherever they stand); settings below them move with them."""

RENAMED_CLASSES: Mapping[str, str] = {
    "stmc.representation.SmplRepresentation": "stmc.motion.representation.SmplRepresentation",
    "stmc.representation.BabelRepresentation": "stmc.motion.representation.BabelRepresentation",
    "stmc.representation.HumanML3DRepresentation": "stmc.motion.representation.HumanML3DRepresentation",
    "stmc.evaluators.TmrObjective": "stmc.training.TmrObjective",
    "stmc.data.dataset.Dataset": "stmc.training.data.dataset.Dataset",
    "stmc.data.dataset.Corpus": "stmc.training.data.dataset.Dataset",
    "stmc.data.prolonging.Prolonging": "stmc.training.data.prolonging.Prolonging",
    "stmc.data.feet.FootVelocity": "stmc.training.data.foot_velocity.FootVelocity",
    "stmc.data.feet.FootSteps": "stmc.training.data.foot_velocity.FootVelocity",
    "stmc.data.sources.bandai_clips.BandaiClips": "stmc.data.sources.bandai.bandai_clips.BandaiClips",
    "stmc.data.sources.cmu_clips.CmuClips": "stmc.data.sources.cmu.cmu_clips.CmuClips",
    "stmc.data.sources.edited_clips.EditedClips": "stmc.data.sources.edited.edited_clips.EditedClips",
    "stmc.data.sources.annotated_amass.AnnotatedAmass": "stmc.data.sources.amass.annotated_amass.AnnotatedAmass",
    "stmc.data.sources.humanml3d.ProcessedHumanML3D": "stmc.data.sources.humanml3d.humanml3d_folder.ProcessedHumanML3D",
}
"""Values of `_target_` in run directories and in the settings of trainings."""

RENAMED_ARGUMENTS: Mapping[str, Mapping[str, str]] = {
    "stmc.denoisers.FlowMdm": {"horizon": "attention_window", "skipped": "stochastic_depth"},
    "stmc.denoisers.MotionDiffuse": {
        "read_width": "text_latent_width",
        "read_feedforward": "text_feedforward",
        "read_layers": "text_layers",
        "read_heads": "text_heads",
    },
}
"""Of classes: arguments that have another name now, beside the class as `_target_`."""

RENAMED_IN_RECORDS: Mapping[str, str] = {"spread": "noise_scale", "late": "stitch_from", "absolute": "ape_steps"}
"""Of the settings in records of results."""

RENAMED_COLUMNS: Mapping[str, str] = {"rate": "lr", "loss_feet": "loss_foot_velocity"}
"""Those of the tables that trainings write."""


ONE_RECORD = ("stmc.data.batches.Sampling", "stmc.training.data.batches.Sampling")
"""The record that had the settings of all recipes of batches, at `data.sampling` of trainings."""

_RECIPES = "stmc.training.data"
BALANCED, PACKED = f"{_RECIPES}.balanced_batches.BalancedBatches", f"{_RECIPES}.packed_rows.PackedRows"
EPOCHS, RECORDED = f"{_RECIPES}.epoch_batches.EpochBatches", f"{_RECIPES}.recorded_rows.RecordedRows"

_CROPPING = (
    *("shortest", "trim", "trimmed", "uncond_crop_prob", "crop_shortest", "crop_longest"),
    *("from_start_prob", "slowest", "fastest"),
)
_BALANCING = ("balance", "emphasis", "pool", "pieces", "receivers", "joined_prob")

WITHOUT_EFFECT: Mapping[str, Mapping[str, tuple[Any, ...] | None]] = {
    BALANCED: {"order": None, "drop_last": None, "trimmed": ("either_end",), "texts_per_row": ([1, 1],)},
    PACKED: {"order": None, "drop_last": None, "trimmed": ("either_end",)},
    EPOCHS: {
        **dict.fromkeys(("order", *_BALANCING)),
        "trimmed": ("in_all",),
        "compose_prob": (0,),
        "compose_legs_prob": (0,),
        "texts_per_row": ([1, 1],),
    },
    RECORDED: dict.fromkeys(
        ("order", *_CROPPING, *_BALANCING, "compose_prob", "compose_legs_prob", "texts_per_row"),
    ),
}
"""The settings of `ONE_RECORD` that today's recipe lacks, with the values that changed no batch; None: no value did."""


def with_new_names(config: Any) -> Any:
    """A config of plain mappings and lists with today's keys; one that has both keeps today's."""
    if isinstance(config, Mapping):
        inner = {key: with_new_names(value) for key, value in config.items()}
        if "_target_" in inner:
            inner["_target_"] = _new_class(inner["_target_"])
        names = {**RENAMED, **_arguments(config.get("_target_"))}
        old = {names[key]: value for key, value in inner.items() if key in names}
        return old | {key: value for key, value in inner.items() if key not in names}
    return [with_new_names(each) for each in config] if isinstance(config, list) else config


def with_new_paths(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings by their whole paths, `training.lr`, with today's, and with today's recipe of batches."""
    renamed = {}
    for path, value in settings.items():
        above, _, name = path.rpartition(".")
        own = _arguments(settings.get(f"{above}._target_")).get(name, name)
        today = _new_path(f"{above}.{own}" if above else own)
        renamed[today] = _new_class(value)
    return _with_a_recipe(renamed)


def _with_a_recipe(settings: dict[str, Any]) -> dict[str, Any]:
    """Settings by their whole paths with today's recipe of batches. A setting that changed batches and that the recipe
    lacks stays, so that the training is refused as one of other settings."""
    place = "data.sampling."
    own = {path.removeprefix(place): value for path, value in settings.items() if path.startswith(place)}
    if own.get("_target_") not in ONE_RECORD:
        return settings
    one_text = own.get("texts_per_row", [1, 1]) == [1, 1]
    recipe = {"rows": RECORDED, "epochs": EPOCHS}.get(str(own.get("order")), BALANCED if one_text else PACKED)
    own = {"trimmed": "either_end"} | own | {"_target_": recipe}
    if own.get("trim") == 0:
        del own["trimmed"]
    idle = WITHOUT_EFFECT[recipe]
    lost = [each for each in own if (name := each.partition(".")[0]) in idle and _is_idle(own[each], idle[name])]
    others = {path: value for path, value in settings.items() if not path.startswith(place)}
    return others | {f"{place}{name}": value for name, value in own.items() if name not in lost}


def _is_idle(value: Any, values: tuple[Any, ...] | None) -> bool:
    return values is None or value in values


def _new_class(value: Any) -> Any:
    return RENAMED_CLASSES.get(value, value) if isinstance(value, str) else value


def _arguments(target: Any) -> Mapping[str, str]:
    return RENAMED_ARGUMENTS.get(target, {}) if isinstance(target, str) else {}


def _new_path(path: str) -> str:
    for old, new in RENAMED_SETTINGS.items():
        if path == old or path.startswith(f"{old}."):
            return new + path.removeprefix(old)
    return path
