"""Lightning data module of training and validation scenes, divided among the processes of a run."""

from __future__ import annotations

from typing import Any

import lightning.pytorch as pl
from torch.utils.data import Dataset

from kornia_tidy.training.scenes import SceneLoader


class SceneData(pl.LightningDataModule):
    """Loads scenes reproducibly and resumably by :class:`~kornia_tidy.training.scenes.SceneLoader`.

    Use it with ``Trainer(use_distributed_sampler=False)``, as it divides the scenes among processes itself.

    Args:
        train: map-style data set of ``{"image", "depth"}``, with ``"mask"`` where depth is not known everywhere.
        validation: data set of the same kind.
        batch: scenes in a batch.
        seed: of order, augmentation and noise.
        augment: flip training scenes and vary their brightness.
        workers: processes that load scenes.
    """

    def __init__(
        self,
        train: Dataset,
        validation: Dataset,
        batch: int = 32,
        seed: int = 0,
        augment: bool = False,
        workers: int = 0,
    ) -> None:
        super().__init__()
        self.train, self.validation = train, validation
        self.batch, self.seed, self.augment, self.workers = batch, seed, augment, workers

    def train_dataloader(self) -> SceneLoader:
        """Return this process's share of the training scenes, in another order in each epoch."""
        return SceneLoader(self.train, self.batch, augment=self.augment, **self._shared())

    def val_dataloader(self) -> SceneLoader:
        """Return this process's share of the validation scenes, in the same order in each epoch."""
        return SceneLoader(self.validation, self.batch, train=False, **self._shared())

    def _shared(self) -> dict[str, Any]:
        rank, world = (0, 1) if self.trainer is None else (self.trainer.global_rank, self.trainer.world_size)
        return {"seed": self.seed, "workers": self.workers, "rank": rank, "world": world}
