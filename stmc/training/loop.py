"""The training loop. Step k is a function of the weights and of (seed, k, process), so killed runs resume exactly."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, nullcontext
from dataclasses import asdict, dataclass
from functools import reduce
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
from accelerate import Accelerator
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from torch import Tensor, nn

from stmc.run.precision import advise_precision
from stmc.settings.renamed import with_new_paths
from stmc.training.checkpoint import CheckpointError, Checkpoints
from stmc.training.ema import Ema
from stmc.training.logs import Board, Table
from stmc.training.loss import Batch, Objective
from stmc.training.optimizers import Optimizer, build_optimizers
from stmc.training.resuming import SettingsChanged, deciding_settings, differences
from stmc.training.speed import quick_attention, quicken_dropout

logger = logging.getLogger(__name__)

LARGEST_LR = 1.0
"""Maximum learning rate; with larger ones, losses become infinite within a few steps."""
ROUND = 16
"""Number of batches that `Settings.rounds` repeats together."""
_END = "lr_decay_steps"
_LOG_EVERY_SECONDS = 30.0
"""Seconds between two log lines of the loss if there is no terminal for the progress bar."""
Batches = Callable[[int, int], Sequence[Batch]]
"""(step, process) → the chunks of the process's share of the step's batch."""


@dataclass(frozen=True)
class Callback:
    """A function `call(step, model)` to run every `every` steps and after the last one.

    `model` is the moving average, in evaluation mode. Only the main process runs callbacks.
    """

    every: int
    call: Callable[[int, nn.Module], object]


@dataclass(frozen=True)
class Settings:
    """Settings of the training loop. Raises `ValueError` for values out of range.

    A finished run can be extended: set `lr_decay_steps` to its former `steps`, and it continues at its final learning
    rate.

    Args:
        steps: Total number of steps.
        lr: Peak of the learning rate, which rises linearly over `warmup` steps and then falls along a cosine.
        warmup: Number of steps until the peak.
        final_lr_ratio: Final learning rate as a fraction of the peak.
        lr_decay_steps: Step at which the final learning rate is reached; None: `steps`.
        optimizer: "adamw", or "muon" for the matrices of the network's layers and AdamW for the rest.
        weight_decay: Weight decay of the optimisers.
        grad_clip: Maximum norm of the gradient; None: unbounded.
        ema_decay: Decay of the moving average; 0: the average is the network itself.
        precision: Precision of the forward pass, "bf16" or "fp32".
        compile: Whether to compile the network.
        seed: Seed of batches, noise and dropout.
        log_every: Number of steps between rows of the log.
        validate_every: Number of steps between validations, a multiple of `log_every`.
        checkpoint_every: Number of steps between checkpoints, a multiple of `log_every`.
        keep: Number of checkpoints to keep.
        rounds: Number of times that every `ROUND` batches are learned, with the same noise, before the next come. Above
            1, the predictions of a costly teacher serve several updates.
    """

    steps: int
    lr: float = 3e-4
    warmup: int = 500
    final_lr_ratio: float = 0.02
    lr_decay_steps: int | None = None
    optimizer: Optimizer = "adamw"
    weight_decay: float = 0.01
    grad_clip: float | None = 1.0
    ema_decay: float = 0.999
    precision: Literal["bf16", "fp32"] = "bf16"
    compile: bool = False
    seed: int = 0
    log_every: int = 50
    validate_every: int = 1000
    checkpoint_every: int = 500
    keep: int = 2
    rounds: int = 1

    def __post_init__(self) -> None:
        if self.precision not in ("bf16", "fp32"):
            raise ValueError(f"unknown precision {self.precision!r}; choose bf16 or fp32")
        if self.optimizer not in get_args(Optimizer):
            raise ValueError(f"unknown optimizer {self.optimizer!r}; choose {' or '.join(get_args(Optimizer))}")
        for name in ("steps", "log_every", "rounds"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} ({getattr(self, name)}) must be at least 1")
        if not 0 < self.lr <= LARGEST_LR:
            raise ValueError(f"lr ({self.lr}) must be above 0 and at most {LARGEST_LR:g}")
        if self.decay_end < 1:
            raise ValueError(f"lr_decay_steps ({self.lr_decay_steps}) must be at least 1")
        for name in ("checkpoint_every", "validate_every"):
            every = getattr(self, name)
            if every < 1 or every % self.log_every:
                raise ValueError(f"{name} ({every}) must be a multiple of log_every ({self.log_every})")

    @property
    def decay_end(self) -> int:
        """The step at which the learning rate reaches its final value."""
        return self.steps if self.lr_decay_steps is None else self.lr_decay_steps

    def drawn_at(self, step: int) -> int:
        """Return the step whose batch and noise the update at `step` learns: with `rounds`, often an earlier one."""
        group, place = divmod(step, ROUND * self.rounds)
        return group * ROUND + place % ROUND

    def lr_at(self, step: int) -> float:
        """Return the learning rate of the update at `step`, counted from 0."""
        if step < self.warmup:
            return self.lr * (step + 1) / self.warmup
        progress = min(1.0, (step - self.warmup) / max(1, self.decay_end - self.warmup))
        return self.lr * (self.final_lr_ratio + (1 - self.final_lr_ratio) * (1 + math.cos(math.pi * progress)) / 2)


class Trainer:
    """Trainer of a network, which resumes from the newest checkpoint in `folder` if there is one.

    A run that began with other settings raises `SettingsChanged`, or resumes with `allow_changed_settings`; `changes`
    then lists what changed after which step. Two processes must not share a folder: see `stmc.io.files.lock_folder`.

    Args:
        network: Network to train, in place.
        objective: Objective to minimise.
        batches: Function that returns the chunks of a step's batch.
        folder: Folder for checkpoints and logs.
        settings: Settings of the loop.
        validation: Chunks of the validation data, which always get the same noise.
        callbacks: Functions to run regularly.
        accelerator: Accelerator; None: the default of Accelerate.
        described: Plain data of everything else that the result depends on.
        allow_changed_settings: Whether a run may resume with other settings.
    """

    def __init__(
        self,
        network: nn.Module,
        objective: Objective,
        batches: Batches,
        folder: Path,
        settings: Settings,
        validation: Sequence[Batch] = (),
        callbacks: Sequence[Callback] = (),
        accelerator: Accelerator | None = None,
        described: Mapping[str, Any] | None = None,
        allow_changed_settings: bool = False,
    ) -> None:
        self.objective, self.batches, self.settings = objective, batches, settings
        self.folder, self.validation, self.callbacks = Path(folder), validation, callbacks
        self.accelerator = accelerator or Accelerator()
        self.device = self.accelerator.device
        advise_precision(settings.precision, self.device)
        if self.device.type == "cpu":
            quicken_dropout(network)
        network.to(self.device).train()
        self.ema = Ema(network, settings.ema_decay)
        if settings.compile:
            network.compile(dynamic=True)
        moving = build_optimizers(network, settings.optimizer, settings.lr, settings.weight_decay)
        self._prepared, *self.optimizers = self.accelerator.prepare(network, *moving)
        own = {"training": asdict(settings) | {"lr_decay_steps": settings.decay_end}}
        own["processes"] = self.accelerator.num_processes  # each process draws its own batches
        if settings.rounds == 1:
            del own["training"]["rounds"]  # runs from before this setting existed can be resumed
        self.described, self.allow_changed = deciding_settings({**(described or {}), **own}), allow_changed_settings
        self.changes: list[str] = []
        self._last_logged = -math.inf  # time of the last log line
        self.checkpoints = Checkpoints(self.folder / "checkpoints", settings.keep)
        self.step = self._restore()

    @property
    def network(self) -> nn.Module:
        """The network without the wrappers of Accelerate."""
        return self.accelerator.unwrap_model(self._prepared)

    def run(self) -> nn.Module:
        """Train up to `settings.steps` and return the moving average.

        Raises `FloatingPointError` if a loss is not finite.
        """
        settings, main = self.settings, self.accelerator.is_main_process
        with ExitStack() as stack:
            if main:
                self._open_logs(stack)
            window, began = [], time.perf_counter()
            while self.step < settings.steps:
                window.append(self._update())
                self.step += 1
                if self.step % settings.log_every == 0 or self.step == settings.steps:
                    self._log(reduce(torch.add, window), len(window), time.perf_counter() - began)
                    window, began = [], time.perf_counter()
                if main:
                    self._run_periodic()
        self.accelerator.wait_for_everyone()
        return self.ema.model

    def _update(self) -> Tensor:
        """Make one optimiser step; return the summed terms, the number of frames, and the norm of the gradient."""
        settings, process = self.settings, self.accelerator.process_index
        drawn = settings.drawn_at(self.step)
        pieces, seed = self.batches(drawn, process), _seed(settings.seed, drawn, process)
        generator = torch.Generator(self.device).manual_seed(seed)
        frames = sum(piece.frames for piece in pieces)
        share = self.accelerator.reduce(torch.tensor(float(frames), device=self.device), "mean")  # DDP averages
        for optimizer in self.optimizers:
            for group in optimizer.param_groups:
                group["lr"] = settings.lr_at(self.step)
        totals: list[Tensor] = []
        with torch.random.fork_rng([self.device] if self.device.type == "cuda" else []):
            torch.manual_seed(seed)  # dropout draws from the global generator
            for piece in pieces:
                last = piece is pieces[-1]
                with nullcontext() if last else self.accelerator.no_sync(self._prepared):
                    terms = self._terms(self._prepared, piece, generator)
                    self.accelerator.backward(self.objective.weigh(terms) / share)
                totals.append(terms.detach())
        max_norm = math.inf if settings.grad_clip is None else settings.grad_clip
        norm = self.accelerator.clip_grad_norm_(self._prepared.parameters(), max_norm)
        for optimizer in self.optimizers:
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        self.ema.update(self.network, self.step)
        total = reduce(torch.add, totals)
        total = self.accelerator.reduce(torch.cat([total, total.new_tensor([frames])]), "sum")
        return torch.cat([total, norm.detach().reshape(1)])

    def _terms(self, network: nn.Module, piece: Batch, generator: torch.Generator) -> Tensor:
        half = self.settings.precision == "bf16"
        with torch.autocast(self.device.type, torch.bfloat16, enabled=half), quick_attention(self.device):
            return self.objective(network, piece, generator)

    def _means(self, terms: Tensor, frames: int | float) -> dict[str, float]:
        return self.objective.losses((terms / frames).double().cpu())

    def _log(self, sums: Tensor, steps: int, seconds: float) -> None:
        *_, frames, norm = sums.tolist()
        values = self._means(sums[:-2], frames)
        if not math.isfinite(values["loss"]):
            raise FloatingPointError(f"the loss of steps {self.step - steps + 1} to {self.step} is {values['loss']}")
        if not self.accelerator.is_main_process:
            return
        values |= {"gradient": norm / steps, "lr": self.settings.lr_at(self.step - 1)}
        values |= {"frames_per_second": frames / seconds, "steps_per_second": steps / seconds}
        self.table.write(self.step, values)
        self.board.write("train", self.step, values)
        speed = f"{values['steps_per_second']:.2f} steps/s"
        self.progress.update(self.task, completed=self.step, loss=f"loss {values['loss']:.4f}", speed=speed)
        if not self.progress.console.is_terminal and time.monotonic() - self._last_logged >= _LOG_EVERY_SECONDS:
            logger.info("step %d of %d: loss %.4f, %s", self.step, self.settings.steps, values["loss"], speed)
            self._last_logged = time.monotonic()

    def _run_periodic(self) -> None:
        """Run validation and callbacks if due, then save the checkpoint; a killed run repeats them after a resume."""
        settings, last = self.settings, self.step == self.settings.steps
        if self.validation and (last or self.step % settings.validate_every == 0):
            values = self.validate()
            self.validation_table.write(self.step, values)
            self.board.write("validation", self.step, values)
            logger.info("step %d of %d: validation loss %.4f", self.step, settings.steps, values["loss"])
        for callback in self.callbacks:
            if last or self.step % callback.every == 0:
                callback.call(self.step, self.ema.model)
        if last or self.step % settings.checkpoint_every == 0:
            self.checkpoints.save(self.step, self._state())

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        """Return losses of the moving average on the validation data, with fixed steps and noise."""
        generator = torch.Generator(self.device).manual_seed(_seed(self.settings.seed, 0, 2**31))
        terms = [self._terms(self.ema.model, piece, generator) for piece in self.validation]
        return self._means(reduce(torch.add, terms), sum(piece.frames for piece in self.validation))

    def _state(self) -> dict[str, object]:
        return {
            "model": self.network.state_dict(),
            "ema": self.ema.model.state_dict(),
            "optimizer": [optimizer.state_dict() for optimizer in self.optimizers],
            "described": self.described,
            "changes": self.changes,
        }

    def _restore(self) -> int:
        """Restore the newest checkpoint and return its step, or 0."""
        step = self.checkpoints.restore(self._fill, self.device)
        logger.info(
            "%s %s on %s: %d of %d steps done",
            "resuming" if step else "starting", self.folder, self.device.type, step, self.settings.steps,
        )  # fmt: skip
        return step

    def _fill(self, step: int, state: dict[str, Any]) -> None:
        """Restore the state after `step`; see `Checkpoints.restore`.

        Raises `SettingsChanged` for other settings, and `CheckpointError` for another network.
        """
        begun = with_new_paths(state["described"])
        changed = differences(begun, self.described)
        if changed and not self.allow_changed:
            longer = f" (to extend the run, set training.{_END}={begun[f'training.{_END}']})"
            raise SettingsChanged(
                f"{self.folder} began with other settings: {'; '.join(changed)}. Use the old settings"
                f"{longer if any(_END in change for change in changed) else ''}, choose another folder, or resume with "
                "the new settings: allow_changed_settings=true"
            )
        for part, module in (("model", self.network), ("ema", self.ema.model)):
            shapes = {name: value.shape for name, value in module.state_dict().items()}
            if shapes != {name: value.shape for name, value in state[part].items()}:
                raise CheckpointError("it belongs to another network")
        self.network.load_state_dict(state["model"])
        self.ema.model.load_state_dict(state["ema"])
        was = state["optimizer"]
        states = [was] if isinstance(was, dict) else was  # checkpoints from before Muon hold a single state
        if len(states) == len(self.optimizers):  # otherwise a new kind of optimiser starts from the weights alone
            for optimizer, each in zip(self.optimizers, states, strict=True):
                optimizer.load_state_dict(each)
        self.changes = [*state["changes"], *(f"after step {step}: {change}" for change in changed)]
        if changed:
            logger.warning("%s resumes with other settings: %s", self.folder, "; ".join(changed))

    def _open_logs(self, stack: ExitStack) -> None:
        losses = self.objective.names
        pace = ("gradient", "lr", "frames_per_second", "steps_per_second")
        self.table = Table(self.folder / "train.csv", (*losses, *pace), self.step)
        self.validation_table = Table(self.folder / "validation.csv", losses, self.step)
        self.board = Board(self.folder / "tensorboard", self.step)
        stack.callback(self.board.close)
        columns = (TextColumn("{task.fields[loss]}"), TextColumn("{task.fields[speed]}"))
        times = (TimeElapsedColumn(), TimeRemainingColumn(elapsed_when_finished=True))
        self.progress = stack.enter_context(Progress(BarColumn(), MofNCompleteColumn(), *columns, *times))
        self.task = self.progress.add_task("training", total=self.settings.steps, loss="", speed="")
        self.progress.update(self.task, completed=self.step)
        if self.step > self.settings.steps:
            logger.warning("the run already has %d steps; settings ask for %d", self.step, self.settings.steps)


def _seed(*parts: int) -> int:
    return int(np.random.SeedSequence(parts).generate_state(1, np.uint64)[0] >> 1)
