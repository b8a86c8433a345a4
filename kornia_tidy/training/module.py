"""Optics, network and loss as one Lightning module, with a learning rate for each."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import lightning.pytorch as pl
import torch
from torch import Tensor, nn

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.checks import check_choice, check_positive
from kornia_tidy.inference.tasks import MAPS, centre_crop, nearness, split_maps
from kornia_tidy.inference.trained import build_head, build_optics, check_weights, describe, fix_window, look_through
from kornia_tidy.psf.camera_settings import EXTRA_STATE
from kornia_tidy.reconstruction.losses import mse_loss
from kornia_tidy.reconstruction.metrics import rmse
from kornia_tidy.training.average import MovingAverage
from kornia_tidy.training.designed import design_masks
from kornia_tidy.training.scenes import Broken
from kornia_tidy.training.settings import SCHEDULES, TrainingSettings, differences
from kornia_tidy.training.task_loss import LOSSES, Loss, task_loss


class Seen(NamedTuple):
    """A batch as camera and network see it."""

    coded: Tensor
    """(B, 3, H, W), the captures."""
    estimate: dict[str, Tensor]
    """The network's maps by name, float32."""
    truth: dict[str, Tensor]
    """What they should be: ``"image"`` the scene in focus, ``"depth"`` its nearness in [0, 1]."""
    mask: Tensor
    """bool (B, 1, H, W), True where depth is known."""


def cosine_rate(progress: float, warm_up: float = 0.1) -> float:
    """Return the factor of a learning rate at a share of a run: up from a tenth in a straight line, down as a cosine.

    Source: Loshchilov and Hutter, SGDR (ICLR 2017), without restarts.

    Example:
        >>> [round(cosine_rate(share), 3) for share in (0.0, 0.1, 0.55, 1.0)]
        [0.1, 1.0, 0.5, 0.0]
    """
    if progress < warm_up:
        return 0.1 + 0.9 * progress / warm_up
    return (1 + math.cos(math.pi * min(1.0, (progress - warm_up) / (1 - warm_up)))) / 2


class TidyTraining(pl.LightningModule):
    """Trains a camera's masks and the network that reads its captures, by one Adam.

    Batches are mappings of ``"image"`` (B, 3, H, W), ``"depth"`` (B, 1, H, W), and, where they have them, ``"mask"``
    (bool, True where depth is known) and ``"noise_seed"`` (an int that the sensor's noise follows from; without it
    noise comes from the global generator).

    Args:
        optics: the camera. Masks in training keep its PSF window, which checkpoints tell.
        head: the network, (B, 3, H, W) to (B, C, H, W): C = 3 for edof, 1 for depth, 4 (depth first) for joint.
        task: ``"edof"``, ``"depth"`` or ``"joint"``. Depth is learnt as :func:`~kornia_tidy.inference.tasks.nearness`.
        loss: of a map, its truth and its validity; the same for all maps.
        lr: learning rate of the network, and of what the optics may learn besides masks.
        lr_metres: learning rate of the masks, in metres of height.
        betas: Adam's.
        schedule: of both rates: ``"constant"``, or ``"cosine"``: up in a tenth of the run's steps, then down to zero.
        ema: decay of the network's moving average, which validation and checkpoints' readers use. 0: none.
        depth_weight: of the depth loss in the joint task.
        image_weight: of the image loss in the joint task.
        settings: what camera and network were made from, so that a checkpoint can make them again.

    Raises:
        ValueError: if a value is not allowed.

    Convention:
        - ``Trainer(precision="bf16-mixed")`` concerns the network alone: optics and losses stay in float32.
        - Batch normalisation has the statistics of each process's own batches, as usual.

    Source: Shah et al., TiDy-PSFs (ICCV 2023), section 4.4: Adam with betas 0.99 and 0.999, 1e-8 m for the masks and
    1e-4 for the network; mean squared errors, weighted 1 and 1 for the joint task.
    """

    def __init__(
        self,
        optics: TiDyOptics,
        head: nn.Module,
        task: str = "edof",
        loss: Loss = mse_loss,
        *,
        lr: float = 1e-4,
        lr_metres: float = 1e-8,
        betas: tuple[float, float] = (0.99, 0.999),
        schedule: str = "constant",
        ema: float = 0.999,
        depth_weight: float = 1.0,
        image_weight: float = 1.0,
        settings: TrainingSettings | None = None,
    ) -> None:
        super().__init__()
        check_choice("task", task, tuple(MAPS))
        check_choice("schedule", schedule, SCHEDULES)
        check_positive("lr", lr)
        check_positive("lr_metres", lr_metres, "metres")
        self.optics = optics
        self.head = head
        self.average = MovingAverage(head, ema) if ema else None
        self.task, self.loss, self.settings = task, loss, settings
        self.lr, self.lr_metres, self.betas, self.schedule = lr, lr_metres, betas, schedule
        self.weights = {"depth": depth_weight, "image": image_weight}

    @classmethod
    def from_settings(cls, settings: TrainingSettings, *, design: bool = True, progress: bool = False) -> TidyTraining:
        """Return the module that settings describe; the network's weights come from the global generator.

        Args:
            settings: of camera, network and learning.
            design: design masks if the settings say so; in vain where masks are loaded next.
            progress: show a progress bar of that.
        """
        optics = build_optics(settings)
        if design and settings.design and settings.masks:
            design_masks(optics, settings.design, progress=progress)
            optics.fidelity = optics.fidelity.replace(window=settings.window)
            fix_window(optics)  # that of the masks as they are now
        return cls(
            optics,
            build_head(settings),
            settings.task,
            LOSSES[settings.loss],
            lr=settings.lr,
            lr_metres=settings.lr_metres,
            schedule=settings.schedule,
            ema=settings.ema,
            depth_weight=settings.depth_weight,
            image_weight=settings.image_weight,
            settings=settings.replace(window=optics.window),
        )

    def forward(self, coded: Tensor) -> Tensor:
        """Return what the network makes of captures; its moving average, once training is over or looked at."""
        network = self.head if self.training or self.average is None else self.average
        look_through(network, self.optics)
        return network(coded)

    def see(self, batch: dict[str, Any]) -> Seen:
        """Photograph the scenes of a batch and let the network look at the captures.

        Raises:
            ValueError: if the batch tells that one of its scenes is broken.
        """
        if isinstance(batch, Broken):
            raise ValueError(batch.reason)
        seed = batch.get("noise_seed")
        noise = None if seed is None else torch.Generator(self.device).manual_seed(seed)
        sample = self.optics({"image": batch["image"], "depth": batch["depth"]}, generator=noise)
        coded = sample["image"]
        estimate = {name: maps.float() for name, maps in split_maps(self.task, self(coded)).items()}
        truth = {"image": sample["all_in_focus"], "depth": nearness(self.optics.camera, sample["depth"].float())}
        mask = batch.get("mask")
        mask = torch.ones_like(sample["depth"], dtype=torch.bool) if mask is None else mask
        return Seen(coded, estimate, truth, centre_crop(mask, *coded.shape[-2:]))

    def training_step(self, batch: dict[str, Any], batch_idx: int) -> Tensor:
        """Return the loss of a batch."""
        seen = self.see(batch)
        loss = task_loss(self.loss, seen.estimate, seen.truth, seen.mask, self.weights)
        self.log("loss", loss.detach(), prog_bar=True, batch_size=len(seen.coded))
        return loss

    def validation_step(self, batch: dict[str, Any], batch_idx: int) -> None:
        """Log the mean over all scenes of the loss and of each map's root mean squared error."""
        seen = self.see(batch)
        scores = {"val_loss": task_loss(self.loss, seen.estimate, seen.truth, seen.mask, self.weights)}
        for name, maps in seen.estimate.items():
            errors = rmse(maps, seen.truth[name], seen.mask if name == "depth" else None)
            scores[f"val_{name}_rmse"] = errors.nanmean()
        self.log_dict(scores, batch_size=len(seen.coded), sync_dist=True, prog_bar=True)

    def configure_optimizers(self) -> Any:
        """Return one Adam: masks in metres of height, all else at the network's rate; and its schedule, if there is."""
        groups = self.optics.parameter_groups(self.lr_metres, self.lr)
        groups = [group for group in groups if list(group["params"])]  # a fixed lens has none
        groups.append({"params": list(self.head.parameters()), "lr": self.lr})
        adam = torch.optim.Adam(groups, lr=self.lr, betas=self.betas)
        if self.schedule == "constant":
            return adam
        steps = int(self.trainer.estimated_stepping_batches)
        schedule = torch.optim.lr_scheduler.LambdaLR(adam, lambda step: cosine_rate(step / max(1, steps)))
        return {"optimizer": adam, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def on_train_start(self) -> None:
        """Compute all PSFs at once: those of a fixed lens are remembered, and rounded by what is computed with them."""
        with torch.no_grad():
            self.optics.psf_bank()

    def optimizer_step(self, *args: Any, **kwargs: Any) -> None:
        """Take a step, and let the average follow."""
        super().optimizer_step(*args, **kwargs)
        if self.average is not None:
            self.average.update(self.head)

    # ------------------------------------------------------------------ what a checkpoint holds besides weights

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add what camera and network are."""
        checkpoint["settings"] = None if self.settings is None else self.settings.as_dict()
        checkpoint["task"] = self.task
        checkpoint["description"] = describe(self.optics, self.head)

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuse a checkpoint of another camera or network, before anything of it is loaded.

        Raises:
            ValueError: naming what differs.
        """
        here = {"task": self.task, **describe(self.optics, self.head)}
        stored = {"task": checkpoint.get("task"), **checkpoint.get("description", {})}
        if f"optics.{EXTRA_STATE}" in checkpoint["state_dict"]:  # it tells the fidelity in full, and the window to take
            here["fidelity"] = stored.get("fidelity", "")
        if other := differences(stored, here):
            raise ValueError(f"the checkpoint does not fit (checkpoint / here): {'; '.join(other)}")
        check_weights(self, checkpoint["state_dict"], "the checkpoint")
