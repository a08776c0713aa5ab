"""Former names of configuration keys: they keep run directories, checkpoints and tables of old versions readable."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

RENAMED: Mapping[str, str] = {"spread": "noise_scale", "late": "stitch_from", "window": "fixed_length"}
"""Renamed keys, anywhere in a run directory's config."""

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
"""Renamed settings of trainings, by full path, since these old names are too common to be renamed everywhere. Settings
below them move with them."""

RENAMED_CLASSES: Mapping[str, str] = {
    "stmc.representation.SmplRepresentation": "stmc.motion.representation.SmplRepresentation",
    "stmc.representation.BabelRepresentation": "stmc.motion.representation.BabelRepresentation",
    "stmc.representation.HumanML3DRepresentation": "stmc.motion.representation.HumanML3DRepresentation",
    "stmc.evaluators.TmrObjective": "stmc.training.TmrObjective",
    "stmc.data.dataset.Dataset": "stmc.training.data.dataset.Dataset",
    "stmc.data.dataset.Corpus": "stmc.training.data.dataset.Dataset",
    "stmc.data.prolonging.Prolonging": "stmc.training.data.prolonging.Prolonging",
    "stmc.data.feet.FootVelocity": "stmc.training.data.limb_velocity.FootVelocity",
    "stmc.data.feet.FootSteps": "stmc.training.data.limb_velocity.FootVelocity",
    "stmc.data.sources.bandai_clips.BandaiClips": "stmc.data.sources.bandai.bandai_clips.BandaiClips",
    "stmc.data.sources.cmu_clips.CmuClips": "stmc.data.sources.cmu.cmu_clips.CmuClips",
    "stmc.data.sources.edited_clips.EditedClips": "stmc.data.sources.edited.edited_clips.EditedClips",
    "stmc.data.sources.annotated_amass.AnnotatedAmass": "stmc.data.sources.amass.annotated_amass.AnnotatedAmass",
    "stmc.data.sources.humanml3d.ProcessedHumanML3D": "stmc.data.sources.humanml3d.humanml3d_folder.ProcessedHumanML3D",
}
"""Renamed classes: values of `_target_` in run directories and in the settings of trainings."""

RENAMED_ARGUMENTS: Mapping[str, Mapping[str, str]] = {
    "stmc.denoisers.FlowMdm": {"horizon": "attention_window", "skipped": "stochastic_depth"},
    "stmc.denoisers.MotionDiffuse": {
        "read_width": "text_latent_width",
        "read_feedforward": "text_feedforward",
        "read_layers": "text_layers",
        "read_heads": "text_heads",
    },
}
"""Renamed arguments of classes, which stand beside the class as `_target_`."""

RENAMED_IN_RECORDS: Mapping[str, str] = {"spread": "noise_scale", "late": "stitch_from", "absolute": "ape_steps"}
"""Renamed settings in records of results."""
RENAMED_COLUMNS: Mapping[str, str] = {"rate": "lr", "loss_feet": "loss_foot_velocity"}
"""Renamed columns of the tables that trainings write."""
ONE_RECORD = ("stmc.data.batches.Sampling", "stmc.training.data.batches.Sampling")
"""The former record with the settings of all batch recipes, at `data.sampling` of trainings."""
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
    RECORDED: dict.fromkeys(("order", *_CROPPING, *_BALANCING, "compose_prob", "compose_legs_prob", "texts_per_row")),
}
"""Settings of `ONE_RECORD` that a current recipe lacks, with the values that had no effect; None: no value had any."""


def with_new_names(config: Any) -> Any:
    """Replace former keys in a config of plain mappings and lists. If both keys are present, the current one wins."""
    if isinstance(config, Mapping):
        inner = {key: with_new_names(value) for key, value in config.items()}
        if "_target_" in inner:
            inner["_target_"] = _new_class(inner["_target_"])
        names = {**RENAMED, **_renamed_arguments(config.get("_target_"))}
        old = {names[key]: value for key, value in inner.items() if key in names}
        return old | {key: value for key, value in inner.items() if key not in names}
    return [with_new_names(item) for item in config] if isinstance(config, list) else config


def with_new_paths(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Replace former settings, by full path such as `training.lr`, by current ones and the current batch recipe."""
    renamed = {}
    for path, value in settings.items():
        above, _, name = path.rpartition(".")
        argument = _renamed_arguments(settings.get(f"{above}._target_")).get(name, name)
        renamed[_new_path(f"{above}.{argument}" if above else argument)] = _new_class(value)
    return _replace_one_record(renamed)


def _replace_one_record(settings: dict[str, Any]) -> dict[str, Any]:
    """Replace `ONE_RECORD` by the current batch recipe.

    A setting that had an effect and that the recipe lacks stays, so that the training is rejected for its settings.
    """
    prefix = "data.sampling."
    record = {path.removeprefix(prefix): value for path, value in settings.items() if path.startswith(prefix)}
    if record.get("_target_") not in ONE_RECORD:
        return settings
    one_text = record.get("texts_per_row", [1, 1]) == [1, 1]
    recipe = {"rows": RECORDED, "epochs": EPOCHS}.get(str(record.get("order")), BALANCED if one_text else PACKED)
    record = {"trimmed": "either_end"} | record | {"_target_": recipe}
    if record.get("trim") == 0:
        del record["trimmed"]
    idle = WITHOUT_EFFECT[recipe]
    dropped = [
        path for path in record if (name := path.partition(".")[0]) in idle and _is_idle(record[path], idle[name])
    ]
    others = {path: value for path, value in settings.items() if not path.startswith(prefix)}
    return others | {f"{prefix}{name}": value for name, value in record.items() if name not in dropped}


def _is_idle(value: Any, values: tuple[Any, ...] | None) -> bool:
    return values is None or value in values


def _new_class(value: Any) -> Any:
    return RENAMED_CLASSES.get(value, value) if isinstance(value, str) else value


def _renamed_arguments(target: Any) -> Mapping[str, str]:
    return RENAMED_ARGUMENTS.get(target, {}) if isinstance(target, str) else {}


def _new_path(path: str) -> str:
    for old, new in RENAMED_SETTINGS.items():
        if path == old or path.startswith(f"{old}."):
            return new + path.removeprefix(old)
    return path
