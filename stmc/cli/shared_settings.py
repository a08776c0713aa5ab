"""Settings that several commands have."""

from __future__ import annotations

from dataclasses import MISSING, dataclass

from stmc.settings.records import setting


@dataclass(frozen=True, kw_only=True)
class OnDevice:
    """Of a command that samples or measures."""

    device: str = setting("auto", "where to compute: auto (the GPU if there is one), cpu, cuda, cuda:1, …")


@dataclass(frozen=True, kw_only=True)
class OnModel(OnDevice):
    """Of a command that asks a model."""

    model: str | None = setting(
        None, "run directory, mdm_smpl_wide_fast, mdm_smpl_cmu or flow_mdm_wide; null: the bundled model"
    )


@dataclass(frozen=True, kw_only=True)
class Sharded:
    """Of a command that several processes or machines can share."""

    shard: str | None = setting(
        None,
        "3/64: only the third of 64 shares; all/64: only check which shares are complete; null: everything, or "
        "this process's share where accelerate launch or torchrun started several",
    )


@dataclass(frozen=True, kw_only=True)
class Threaded:
    """Of a command that computes for long."""

    threads: int | None = setting(None, "threads of the CPU; null: PyTorch's own choice", at_least=1, at_most=1024)


@dataclass(frozen=True, kw_only=True)
class Trained(Threaded):
    """Of a command that trains."""

    run: str = setting(MISSING, "folder for checkpoints, logs and the trained model; run again to resume")
    trusted: tuple[str, ...] = setting((), "your own packages that hold classes of the parts")
    allow_changed_settings: bool = setting(
        False, "resume although the run began with other settings; the card lists the changes"
    )
    device: str = setting("auto", "where to compute; auto: cuda if there is one", choices=("auto", "cpu", "cuda"))
    validation: int = setting(4, "number of batches for the validation loss", at_least=1)
    text_cache: str = setting("cache/text", "folder of embedded texts, shared with other runs")
