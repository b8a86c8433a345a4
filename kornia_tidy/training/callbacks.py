"""What happens beside training: checkpoints that a run goes on from to the bit, and a log that people can open."""

from __future__ import annotations

import csv
import io
import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from lightning.pytorch.loggers import TensorBoardLogger

from kornia_tidy.files import write_bytes
from kornia_tidy.training.pictures import draw_pictures
from kornia_tidy.training.random_state import own_random_state, random_states, set_random_state

LAST, BEST = "last.safetensors", "best.safetensors"


class SaveCheckpoints(pl.Callback):
    """Saves the run every few steps and at the end of each epoch; the best weights too, and stops when they are old.

    A run that goes on from ``last.safetensors`` ends with the same weights as one that never stopped: to the bit on
    one process and a CPU, or wherever the operations themselves are deterministic. The states of the global generators
    of all processes are saved.

    Args:
        folder: where to.
        every: steps of the optimiser between saves within an epoch.
        monitor: the score that is to fall.
        patience: epochs without improvement after which training stops. None: never.
    """

    def __init__(self, folder: str | Path, every: int = 100, monitor: str = "val_loss", patience: int | None = None):
        self.folder, self.every, self.monitor, self.patience = Path(folder), every, monitor, patience
        self.best, self.waited = math.inf, 0
        self._saved_step = 0
        self._pending: Any = None

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Begin counting, and stop a run that had stopped."""
        self._saved_step = trainer.global_step
        self._stop_if_old(trainer)

    def on_train_batch_start(self, *args: Any, **kwargs: Any) -> None:
        """Put the generators where they were: only here is all done that may draw from them on the way."""
        if self._pending is not None:
            set_random_state(own_random_state(self._pending))
            self._pending = None

    def on_train_batch_end(self, trainer: pl.Trainer, *args: Any, **kwargs: Any) -> None:
        """Save within an epoch. Its last step is saved when the epoch has been validated."""
        step = trainer.global_step
        last = trainer.fit_loop.epoch_loop.batch_progress.current.ready == trainer.num_training_batches
        if step % self.every == 0 and step != self._saved_step and not last:
            self._save(trainer)

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Keep the best weights."""
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
        """Save."""
        self._save(trainer)

    def state_dict(self) -> dict[str, Any]:
        """Return what a run needs to go on. All processes take part, as in every save."""
        return {"best": self.best, "waited": self.waited, "random": random_states()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take what :meth:`state_dict` returned."""
        self.best, self.waited, self._pending = state_dict["best"], state_dict["waited"], state_dict["random"]

    def _save(self, trainer: pl.Trainer) -> None:
        trainer.save_checkpoint(self.folder / LAST)
        self._saved_step = trainer.global_step

    def _stop_if_old(self, trainer: pl.Trainer) -> None:
        if self.patience is not None and self.waited >= self.patience:
            trainer.should_stop = True


class WriteLog(pl.Callback):
    """Writes ``training.csv``, a line a step, and ``validation.csv``, a line an epoch; a run that goes on adds to them.

    Args:
        folder: where to.
        every: steps between the lines of ``training.csv``.
    """

    def __init__(self, folder: str | Path, every: int = 1) -> None:
        self.folder, self.every = Path(folder), every
        self._since, self._step = 0.0, 0

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Forget lines of steps that will be taken again."""
        self._since, self._step = time.perf_counter(), trainer.global_step
        if trainer.is_global_zero:
            for name in ("training.csv", "validation.csv"):
                drop_rows_after(self.folder / name, trainer.global_step)

    def on_train_batch_end(self, trainer: pl.Trainer, *args: Any, **kwargs: Any) -> None:
        """Add a line for a step."""
        step = trainer.global_step
        if step == self._step or step % self.every:
            return
        seconds = (time.perf_counter() - self._since) / (step - self._step)
        row = {"epoch": trainer.current_epoch, "step": step, "loss": float(trainer.callback_metrics["loss"])}
        self._write(trainer, "training.csv", {**row, "seconds_a_step": round(seconds, 4)})
        self._since, self._step = time.perf_counter(), step

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Add a line for an epoch."""
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
    """Draws masks, PSFs and estimates after validation, as files and for TensorBoard.

    Args:
        folder: where to.
        every: epochs between pictures.
    """

    def __init__(self, folder: str | Path, every: int = 1) -> None:
        self.folder, self.every = Path(folder), every
        self._batch: Any = None

    def on_validation_batch_start(
        self, trainer: pl.Trainer, pl_module: Any, batch: Any, batch_idx: int, dataloader_idx: int = 0
    ) -> None:
        """Keep the first scenes."""
        if batch_idx == 0 and trainer.is_global_zero:
            self._batch = batch

    @torch.no_grad()
    def on_validation_end(self, trainer: pl.Trainer, pl_module: Any) -> None:
        """Draw."""
        if self._batch is None or trainer.sanity_checking or trainer.current_epoch % self.every:
            return
        pictures = draw_pictures(pl_module.optics, pl_module.see(self._batch), self.folder, trainer.current_epoch)
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                for name, picture in pictures.items():
                    logger.experiment.add_image(name, picture, trainer.global_step)
        self._batch = None


def append_row(path: Path, row: Mapping[str, float]) -> None:
    """Add a line to a CSV file, under a heading if it is new."""
    new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.writer(file)
        if new:
            writer.writerow(row)
        writer.writerow(row.values())


def drop_rows_after(path: Path, step: int) -> None:
    """Drop lines of later steps from a CSV file, and one that was cut short."""
    if not path.exists():
        return
    with path.open(newline="") as file:
        heading, *rows = list(csv.reader(file)) or [[]]
    place = heading.index("step") if "step" in heading else 0
    kept = [row for row in rows if len(row) == len(heading) and row[place].isdigit() and int(row[place]) <= step]
    text = io.StringIO(newline="")
    csv.writer(text).writerows([heading, *kept])
    write_bytes(path, text.getvalue().encode())
