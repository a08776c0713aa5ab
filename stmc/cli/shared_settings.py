"""Settings that several commands share."""

from __future__ import annotations

from dataclasses import MISSING, dataclass

from stmc.settings.records import setting


@dataclass(frozen=True, kw_only=True)
class OnDevice:
    """Settings of commands that sample or measure."""

    device: str = setting("auto", "device to compute on: auto (a GPU if there is one), cpu, cuda, cuda:1, …")


@dataclass(frozen=True, kw_only=True)
class OnModel(OnDevice):
    """Settings of commands that load a model."""

    model: str | None = setting(
        None, "run directory, mdm_smpl_wide_fast, mdm_smpl_cmu or flow_mdm_wide; null: the bundled model"
    )


@dataclass(frozen=True, kw_only=True)
class Sharded:
    """Settings of commands that several processes or machines can share."""

    shard: str | None = setting(
        None,
        "3/64: compute only the third of 64 shards; all/64: only check which shards are complete; null: compute "
        "everything, or this process's shard under accelerate launch or torchrun",
    )


@dataclass(frozen=True, kw_only=True)
class Threaded:
    """Settings of commands that compute for long."""

    threads: int | None = setting(None, "number of CPU threads; null: PyTorch's default", at_least=1, at_most=1024)


@dataclass(frozen=True, kw_only=True)
class Trained(Threaded):
    """Settings of commands that train."""

    run: str = setting(MISSING, "folder for checkpoints, logs and the trained model; run again to resume")
    trusted: tuple[str, ...] = setting((), "your own packages that define parts")
    allow_changed_settings: bool = setting(
        False, "resume a run that began with other settings; the card lists the changes"
    )
    device: str = setting("auto", "device to compute on; auto: cuda if there is one", choices=("auto", "cpu", "cuda"))
    validation: int = setting(4, "number of batches for the validation loss", at_least=1)
    text_cache: str = setting("cache/text", "folder of embedded texts, shared with other runs")
