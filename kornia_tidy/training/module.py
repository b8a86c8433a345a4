"""Lightning module of optics, network and loss, with separate learning rates of masks and network."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from typing import Any, NamedTuple, Self

import lightning.pytorch as pl
import torch
from torch import Tensor, nn

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.psf.camera_settings import EXTRA_STATE
from kornia_tidy.psf.field_bank import FieldBank
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.reconstruction.depth_distribution import fit_temperature
from kornia_tidy.reconstruction.head import takes_noise
from kornia_tidy.reconstruction.joint_closed_form import JointClosedFormHead
from kornia_tidy.reconstruction.layered_joint import LayeredJointHead
from kornia_tidy.reconstruction.metrics import psnr, rmse
from kornia_tidy.reconstruction.tasks import centre_crop, depth_logits, normalised_inverse_depth, split_maps
from kornia_tidy.reconstruction.trained import (
    build_head,
    build_optics,
    check_weights,
    describe,
    fix_window,
    psfs_to_store,
    update_psfs,
)
from kornia_tidy.seeds import keyed_seed
from kornia_tidy.sensor.sensor import SensorNoise
from kornia_tidy.training.average import MovingAverage
from kornia_tidy.training.designed import design_masks
from kornia_tidy.training.drawn_sensors import SensorEach, with_sensor
from kornia_tidy.training.noisy_crops import random_sensor
from kornia_tidy.training.random_state import seeded
from kornia_tidy.training.scenes import Broken
from kornia_tidy.training.settings import TrainingSettings, differences
from kornia_tidy.training.task_loss import LOSSES, task_loss

STEPPED = "weights_stepped"  # entry of a checkpoint: the number of weights with a state in the optimiser
BETAS = (0.99, 0.999)  # of Adam, as the paper has them
HELD_OUT_STEP = 4  # the temperature is fitted to every fourth pixel of every fourth row


class BatchResult(NamedTuple):
    """Captures of a batch, the network's estimates and the true maps."""

    coded: Tensor
    """Captures, (B, 3, H, W)."""
    estimate: dict[str, Tensor]
    """Estimated maps by name, float32."""
    truth: dict[str, Tensor]
    """True maps by name: ``"image"`` is the all-in-focus scene, ``"depth"`` its normalised inverse depth in [0, 1]."""
    mask: Tensor
    """bool (B, 1, H, W), True where depth is known."""
    logits: Tensor | None = None
    """Those of the distribution of depth, (B, D, H, W) in float32, if the network estimates one."""


def cosine_rate(progress: float, warm_up: float = 0.1) -> float:
    """Return the factor of a learning rate after a fraction of a run: linear warm-up from 0.1, then cosine decay to 0.

    Args:
        progress: fraction of the run that is over.
        warm_up: fraction of the run in which the rate rises.

    Source: Loshchilov and Hutter, SGDR (ICLR 2017), without restarts.

    Example:
        >>> [round(cosine_rate(share), 3) for share in (0.0, 0.1, 0.55, 1.0)]
        [0.1, 1.0, 0.5, 0.0]
    """
    if progress < warm_up:
        return 0.1 + 0.9 * progress / warm_up
    return (1 + math.cos(math.pi * min(1.0, (progress - warm_up) / (1 - warm_up)))) / 2


class TidyTraining(pl.LightningModule):
    """Trains a camera's masks together with the network that reads its captures, by one Adam optimiser.

    Batches are mappings of ``"image"`` (B, 3, H, W), ``"depth"`` (B, 1, H, W) and, optionally, ``"mask"`` (bool, True
    where depth is known) and ``"noise_seed"`` (int, the seed of the sensor's noise; without it noise is drawn from the
    global generator). Batches of :class:`~kornia_tidy.training.noisy_crops.NoisyCrops`, which hold captures, are for
    fixed optics.

    A network with an argument ``noise`` of ``forward`` receives the standard deviation of the captures' noise in each
    pixel, (B, 3, H, W), in linear light with full scale 1.

    Args:
        optics: the camera. Its PSF window stays the same during training; checkpoints hold it.
        head: the network, (B, 3, H, W) to (B, C, H, W): C = 3 for edof, 1 for depth, 4 (depth first) for joint, or
            D + 3 with a distribution of depth over D classes, which is then trained by
            :func:`~kornia_tidy.reconstruction.depth_distribution.distribution_loss`.
        settings: those of camera, network and run; checkpoints hold them to rebuild both. None: camera and network were
            made otherwise, and a checkpoint cannot rebuild them.
        sensors: draws the sensor of each scene by torch's global generator, for a network that knows the level of the
            noise. None: the camera's own.
        **run: settings that differ, such as ``task="joint"`` or ``lr=1e-3``, by the names of
            :class:`~kornia_tidy.training.settings.TrainingSettings`.

    Raises:
        ValueError: if a value is not allowed.

    Convention:
        - ``Trainer(precision="bf16-mixed")`` applies only to the network: optics and losses stay in float32.
        - Batch normalisation uses the statistics of each process's own batches.

    Source: Shah et al., TiDy-PSFs (ICCV 2023), section 4.4: Adam with betas 0.99 and 0.999, 1e-8 m for the masks and
    1e-4 for the network; mean squared errors, weighted 1 and 1 for the joint task.
    """

    def __init__(
        self,
        optics: TiDyOptics,
        head: nn.Module,
        settings: TrainingSettings | None = None,
        *,
        sensors: Callable[[], SensorNoise] | None = None,
        **run: Any,
    ) -> None:
        super().__init__()
        self.run = (TrainingSettings() if settings is None else settings).replace(**run)
        self.settings = None if settings is None else self.run
        self.optics = optics.requires_grad_(requires_grad=False) if self.run.fixed_optics else optics
        refiner = head.refiner if isinstance(head, JointClosedFormHead) else None
        if self.run.learn == "refiner" and refiner is None:
            raise ValueError("learn='refiner' needs a JointClosedFormHead with a refiner")
        if self.run.learn in {"refiner", "masks"}:
            head.requires_grad_(requires_grad=False)
        if self.run.learn == "refiner" and refiner is not None:
            refiner.requires_grad_()
        self.memory_format = torch.channels_last if self.run.channels_last else torch.contiguous_format
        self.head = head.to(memory_format=self.memory_format) if self.run.channels_last else head  # ty: ignore[no-matching-overload]
        self.takes_noise, self.sensors = takes_noise(head), sensors
        self.average = MovingAverage(head, self.run.ema) if self.run.ema and self.run.learn != "masks" else None
        self._held_out: list[tuple[Tensor, ...]] = []  # distributions of depth of validation scenes, with the truth

    @classmethod
    def from_settings(
        cls,
        settings: TrainingSettings,
        *,
        psfs: PSFBank | FieldBank | None = None,
        design: bool = True,
        progress: bool = False,
    ) -> TidyTraining:
        """Return the module that settings describe; the network's weights are drawn from the global generator.

        Args:
            settings: of the system and the run.
            psfs: measured PSFs, for settings with ``measured``.
            design: design the masks first if the settings ask for it; not needed if masks are loaded afterwards.
            progress: show a progress bar of the design.
        """
        optics = build_optics(settings, psfs)
        if design and settings.design and settings.masks:
            design_masks(optics, settings.design, progress=progress)
            optics.fidelity = optics.fidelity.replace(window=settings.window)
            fix_window(optics)  # for the designed masks
        sensors = partial(random_sensor, settings, optics.camera) if settings.learn == "masks" else None
        return cls(optics, build_head(settings), settings, sensors=sensors, window=optics.window)

    def train(self, mode: bool = True) -> Self:
        """Set the training mode; a network that is not learnt stays in that of evaluation."""
        super().train(mode)
        if self.run.learn == "masks":
            self.head.eval()
        return self

    def forward(self, coded: Tensor, noise: Tensor | None = None) -> Tensor:
        """Return the network's estimates from captures; in eval mode those of its moving average.

        Args:
            coded: captures, (B, 3, H, W).
            noise: standard deviation of their noise, (B, 3, H, W), for a network that is conditioned on it. None: that
                of the camera's sensor.
        """
        network = self.head if self.training or self.average is None else self.average
        if not self.run.fixed_optics:  # else the PSFs are those of on_fit_start
            update_psfs(network, self.optics)
        coded = coded.contiguous(memory_format=self.memory_format)
        return network(coded, noise=noise) if self.takes_noise else network(coded)

    def reconstruct(self, batch: dict[str, Any]) -> BatchResult:
        """Estimate the maps of a batch's captures, or of its scenes, which are photographed first.

        Raises:
            ValueError: if one of the batch's scenes cannot be used.
        """
        if isinstance(batch, Broken):
            raise ValueError(batch.reason)
        if "coded" in batch:
            coded, mask, noise = batch["coded"], batch["mask"], batch.get("noise")
            truth = {"image": batch["image"], "depth": batch["inverse_depth"]}
        else:
            coded, truth, mask, noise = self._photograph(batch)
        output = self(coded, noise).float()
        return BatchResult(coded, split_maps(self.run.task, output), truth, mask, depth_logits(self.run.task, output))

    def _photograph(self, batch: dict[str, Any]) -> tuple[Tensor, dict[str, Tensor], Tensor, Tensor | None]:
        """Return captures, true maps, the mask of known depth and, with ``sensors``, the noise of a batch of scenes."""
        seed = batch.get("noise_seed")
        drawn = None if seed is None else torch.Generator(self.device).manual_seed(seed)
        sensor = self.optics.sensor if self.sensors is None else self._drawn_sensors(len(batch["image"]), seed)
        with with_sensor(self.optics, sensor):
            sample = self.optics({"image": batch["image"], "depth": batch["depth"]}, generator=drawn)
        told = sensor.std(self.optics.decode(sample["image"].detach())) if isinstance(sensor, SensorEach) else None
        coded, depth = sample["image"], sample["depth"]
        truth = {
            "image": sample["all_in_focus"],
            "depth": normalised_inverse_depth(self.optics.camera, depth.float()),
        }
        mask = batch.get("mask")
        mask = torch.ones_like(depth, dtype=torch.bool) if mask is None else mask
        return coded, truth, centre_crop(mask, *coded.shape[-2:]), told

    def _drawn_sensors(self, count: int, seed: int | None) -> SensorEach:
        assert self.sensors is not None
        with nullcontext() if seed is None else seeded(keyed_seed(seed, "sensors")):
            return SensorEach([self.sensors() for _ in range(count)])

    def training_step(self, batch: dict[str, Any], batch_idx: int) -> Tensor:
        """Return the loss of a batch."""
        result = self.reconstruct(batch)
        loss = self._loss(result)
        self.log("loss", loss.detach(), prog_bar=True, batch_size=len(result.coded))
        return loss

    def validation_step(self, batch: dict[str, Any], batch_idx: int) -> None:
        """Log the mean over all scenes of the loss, of each map's root mean squared error, and of the image's PSNR.

        The PSNR is that of the image clipped to [0, 1], as it would be shown.
        """
        result = self.reconstruct(batch)
        loss = self._loss(result)
        scores = {"val_loss": loss}
        for name, maps in result.estimate.items():
            errors = rmse(maps, result.truth[name], result.mask if name == "depth" else None)
            scores[f"val_{name}_rmse"] = errors.nanmean()
            if name == "image":
                scores["val_image_psnr"] = psnr(maps.clamp(0, 1), result.truth[name]).mean()
        self.log_dict(scores, batch_size=len(result.coded), sync_dist=True, prog_bar=True)
        if result.logits is not None:
            maps = result.logits, result.truth["depth"], result.mask
            self._held_out.append(tuple(part[..., ::HELD_OUT_STEP, ::HELD_OUT_STEP] for part in maps))

    def _loss(self, result: BatchResult) -> Tensor:
        weights = {"depth": self.run.depth_weight, "image": self.run.image_weight}
        return task_loss(LOSSES[self.run.loss], result.estimate, result.truth, result.mask, weights, result.logits)

    def on_validation_epoch_start(self) -> None:
        """Begin to collect distributions of depth of the validation scenes, at a temperature of 1."""
        self._held_out.clear()
        self._set_temperature(1.0)

    def on_validation_epoch_end(self) -> None:
        """Fit the temperature of the distribution of depth to the validation scenes."""
        if self._held_out:
            self._set_temperature(fit_temperature(*(torch.cat(parts) for parts in zip(*self._held_out, strict=True))))
            self._held_out.clear()

    def _set_temperature(self, temperature: float) -> None:
        for module in self.modules():
            if isinstance(module, JointClosedFormHead | LayeredJointHead):
                module.temperature.fill_(temperature)

    def adam(self) -> torch.optim.Optimizer:
        """Return the optimiser, before its first step: one Adam, with the masks' rate in metres of height."""
        if self.run.fixed_optics:
            return torch.optim.AdamW((w for w in self.head.parameters() if w.requires_grad), lr=self.run.lr)
        groups = self.optics.parameter_groups(self.run.lr_metres, self.run.lr)
        groups = [group for group in groups if list(group["params"])]  # a fixed lens has none
        if self.run.learn == "both":
            groups.append({"params": list(self.head.parameters()), "lr": self.run.lr})
        return torch.optim.Adam(groups, lr=self.run.lr, betas=BETAS)

    def configure_optimizers(self) -> Any:
        """Return the optimiser, and the schedule of its rates unless they are constant."""
        adam = self.adam()
        if self.run.schedule == "constant":
            return adam

        def rate(step: int) -> float:
            # Not before the first step: asking for the number of steps sets up the data, and a resumed run would then
            # begin its epoch anew.
            return cosine_rate(step / max(1, int(self.trainer.estimated_stepping_batches)) if step else 0.0)

        schedule = torch.optim.lr_scheduler.LambdaLR(adam, rate)
        return {"optimizer": adam, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def on_fit_start(self) -> None:
        """Hand the PSFs of fixed optics to the network and its average."""
        if self.run.fixed_optics:
            with torch.no_grad():
                for network in (self.head, self.average):
                    if network is not None:
                        update_psfs(network, self.optics)

    def on_train_start(self) -> None:
        """Cache all PSFs of a fixed lens: their rounding depends on which PSFs are computed together."""
        with torch.no_grad():
            self.optics.psf_bank()

    def optimizer_step(self, *args: Any, **kwargs: Any) -> None:
        """Take a step of the optimiser and update the moving average."""
        super().optimizer_step(*args, **kwargs)
        if self.average is not None:
            self.average.update(self.head)

    # ------------------------------------------------------------------ checkpoints

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add settings, task and description of camera and network, and how many weights the optimiser has stepped."""
        if "optimizer_states" in checkpoint:
            checkpoint[STEPPED] = sum(len(optimiser["state"]) for optimiser in checkpoint["optimizer_states"])
        checkpoint["settings"] = None if self.settings is None else self.settings.as_dict()
        checkpoint["task"] = self.run.task
        checkpoint["description"] = describe(self.optics, self.head)
        if psfs := psfs_to_store(self.optics):
            checkpoint["psfs"] = psfs

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Raise ``ValueError`` for a checkpoint of another camera or network, before its weights are loaded.

        Raises:
            ValueError: if task, camera, network or weights differ; the message names the difference.
        """
        here = {"task": self.run.task, **describe(self.optics, self.head)}
        stored = {"task": checkpoint.get("task"), **checkpoint.get("description", {})}
        if f"optics.{EXTRA_STATE}" in checkpoint["state_dict"]:  # it holds all of the fidelity, and restores the window
            here["fidelity"] = stored.get("fidelity", "")
        if other := differences(stored, here):
            raise ValueError(f"the checkpoint does not fit (checkpoint / here): {'; '.join(other)}")
        check_weights(self, checkpoint["state_dict"], "the checkpoint")
