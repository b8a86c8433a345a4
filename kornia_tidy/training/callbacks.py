"""Callbacks of a training run: checkpoints from which it resumes bit for bit, CSV logs, and pictures."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from lightning.pytorch.loggers import TensorBoardLogger

from kornia_tidy.files import csv_bytes, read_text, write_bytes
from kornia_tidy.training.pictures import draw_pictures
from kornia_tidy.training.random_state import own_random_state, random_states, set_random_state

LAST, BEST = "last.safetensors", "best.safetensors"


class SaveCheckpoints(pl.Callback):
    """Saves the run every few steps and after each epoch, saves the best weights, and stops the run early.

    A run that resumes from ``last.safetensors`` ends with the same weights as one that was never stopped: bit for bit
    with one process on a CPU, or wherever the operations themselves are deterministic. A checkpoint holds the states
    of the global generators of all processes.

    Args:
        folder: the folder of the run.
        every: steps of the optimiser between saves within an epoch.
        monitor: name of the score to minimise.
        patience: epochs without improvement after which training stops. None: it does not stop early.
    """

    def __init__(self, folder: str | Path, every: int = 100, monitor: str = "val_loss", patience: int | None = None):
        self.folder, self.every, self.monitor, self.patience = Path(folder), every, monitor, patience
        self.best, self.waited = math.inf, 0
        self._saved_step = 0
        self._pending: Any = None

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Start counting steps, and stop a resumed run that had stopped early."""
        self._saved_step = trainer.global_step
        self._stop_if_old(trainer)

    def on_train_batch_start(self, *args: Any, **kwargs: Any) -> None:
        """Restore the generators of a resumed run: nothing between this hook and the first step draws from them."""
        if self._pending is not None:
            set_random_state(own_random_state(self._pending))
            self._pending = None

    def on_train_batch_end(self, trainer: pl.Trainer, *args: Any, **kwargs: Any) -> None:
        """Save the run within an epoch; after the last step, :meth:`on_train_epoch_end` saves it."""
        step = trainer.global_step
        last = trainer.fit_loop.epoch_loop.batch_progress.current.ready == trainer.num_training_batches
        if step % self.every == 0 and step != self._saved_step and not last:
            self._save(trainer)

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Save the weights if their score is the best so far."""
        if trainer.sanity_checking or self.monitor not in trainer.callback_metrics:
            return
        score = float(trainer.callback_metrics[self.monitor])
        if score < self.best:
            self.best, self.waited = score, 0
            trainer.save_checkpoint(self.folder / BEST, weights_only=True)
        else:
            self.waited += 1
        self._stop_if_old(trainer)

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Save the run at the end of an epoch."""
        self._save(trainer)

    def state_dict(self) -> dict[str, Any]:
        """Return the best score, the epochs since, and the generators' states; all processes must call it."""
        return {"best": self.best, "waited": self.waited, "random": random_states()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the state that :meth:`state_dict` returned."""
        self.best, self.waited, self._pending = state_dict["best"], state_dict["waited"], state_dict["random"]

    def _save(self, trainer: pl.Trainer) -> None:
        trainer.save_checkpoint(self.folder / LAST)
        self._saved_step = trainer.global_step

    def _stop_if_old(self, trainer: pl.Trainer) -> None:
        if self.patience is not None and self.waited >= self.patience:
            trainer.should_stop = True


class WriteLog(pl.Callback):
    """Writes ``training.csv``, one line per step, and ``validation.csv``, one per epoch; a resumed run appends.

    Args:
        folder: the folder of the run.
        every: steps between the lines of ``training.csv``.
    """

    def __init__(self, folder: str | Path, every: int = 1) -> None:
        self.folder, self.every = Path(folder), every
        self._since, self._step = 0.0, 0

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Drop the lines of steps that a resumed run takes again."""
        self._since, self._step = time.perf_counter(), trainer.global_step
        if trainer.is_global_zero:
            for name in ("training.csv", "validation.csv"):
                drop_rows_after(self.folder / name, trainer.global_step)

    def on_train_batch_end(self, trainer: pl.Trainer, *args: Any, **kwargs: Any) -> None:
        """Write a line for a step."""
        step = trainer.global_step
        if step == self._step or step % self.every:
            return
        seconds = (time.perf_counter() - self._since) / (step - self._step)
        row = {"epoch": trainer.current_epoch, "step": step, "loss": float(trainer.callback_metrics["loss"])}
        self._write(trainer, "training.csv", {**row, "seconds_a_step": round(seconds, 4)})
        self._since, self._step = time.perf_counter(), step

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Write a line for an epoch."""
        if trainer.sanity_checking:
            return
        scores = {k: float(v) for k, v in sorted(trainer.callback_metrics.items()) if k.startswith("val_")}
        row = {"epoch": trainer.current_epoch, "step": trainer.global_step, **scores}
        self._write(trainer, "validation.csv", row)
        self._since = time.perf_counter()

    def _write(self, trainer: pl.Trainer, name: str, row: Mapping[str, float]) -> None:
        if trainer.is_global_zero:
            append_row(self.folder / name, row)


class DrawPictures(pl.Callback):
    """Draws masks, PSFs and estimates after validation, into PNG files and TensorBoard.

    Args:
        folder: folder of the PNG files.
        every: epochs between pictures.
    """

    def __init__(self, folder: str | Path, every: int = 1) -> None:
        self.folder, self.every = Path(folder), every
        self._batch: Any = None

    def on_validation_batch_start(
        self, trainer: pl.Trainer, pl_module: Any, batch: Any, batch_idx: int, dataloader_idx: int = 0
    ) -> None:
        """Keep the first batch, which is drawn."""
        if batch_idx == 0 and trainer.is_global_zero:
            self._batch = batch

    @torch.no_grad()
    def on_validation_end(self, trainer: pl.Trainer, pl_module: Any) -> None:
        """Draw the pictures of an epoch."""
        if self._batch is None or trainer.sanity_checking or trainer.current_epoch % self.every:
            return
        pictures = draw_pictures(
            pl_module.optics, pl_module.reconstruct(self._batch), self.folder, trainer.current_epoch
        )
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                for name, picture in pictures.items():
                    logger.experiment.add_image(name, picture, trainer.global_step)
        self._batch = None


def append_row(path: Path, row: Mapping[str, float]) -> None:
    """Append a line to a CSV file; a new file starts with a heading."""
    heading = [] if path.exists() else [row]
    with path.open("ab") as file:
        file.write(csv_bytes([*heading, row.values()]))


def drop_rows_after(path: Path, step: int) -> None:
    """Drop lines of later steps, and incomplete lines, from a CSV file."""
    if not path.exists() or not path.stat().st_size:
        return
    # Only of numbers, without quotes; csv.reader stops at a block of zeros, as a power cut may leave.
    heading, *rows = [line.split(",") for line in read_text(path, "replace").splitlines()] or [[]]
    place = heading.index("step") if "step" in heading else 0
    kept = [row for row in rows if len(row) == len(heading) and row[place].isdigit() and int(row[place]) <= step]
    write_bytes(path, csv_bytes([heading, *kept]))
