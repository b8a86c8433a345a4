"""Settings of a training run: those of the system that is trained, and data, optimiser and duration of the run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

from kornia_tidy.checks import check_choice, check_positive
from kornia_tidy.inference.heads import CLOSED_FORMS, FIXED
from kornia_tidy.inference.settings import SystemSettings
from kornia_tidy.inference.trained import TrainedSystem
from kornia_tidy.reconstruction.head import check_count
from kornia_tidy.reconstruction.metrics import SSIM_WINDOW
from kornia_tidy.training.noisy_crops import TOLD_ERROR, check_electrons, check_noise_error, check_noise_range
from kornia_tidy.training.task_loss import LOSSES

SCHEDULES = ("constant", "cosine")
PRECISIONS = ("32-true", "bf16-mixed", "16-mixed")  # of the network; optics always run in float32
LEARN = {
    "both": "masks and network",
    "network": "the network behind fixed optics",
    "refiner": "the second network behind fixed optics, after the first",
    "masks": "the masks, through a network that stays as it is",
}
FIXED_OPTICS = ("network", "refiner")

NETWORK_RUN: dict[str, Any] = {
    "learn": "network", "head": "nafnet", "closed_form": True, "width": 16, "size": 256, "crop": None, "scenes": 1000,
    "validation_scenes": 24, "batch": 4, "lr": 2e-3, "schedule": "cosine", "loss": "charbonnier", "epochs": 24,
}  # fmt: skip
"""Settings of a run of the network alone that differ from the defaults, which are the paper's for both."""

JOINT_RUN: dict[str, Any] = {"depth_classes": 21, "refocus": 9, "depth_weight": 0.03}
"""Settings of a run for image and depth that begins with the closed form: the loss of a distribution of depth is about
a hundred times that of an image."""


@dataclass(frozen=True, kw_only=True)
class TrainingSettings(SystemSettings):
    """A training run. The defaults are the paper's, with our camera; see :func:`kornia_tidy.training.run.train`.

    Checkpoints and ``settings.json`` hold all of them in one dictionary.

    Args:
        learn: ``"both"``, masks and network together; or ``"network"`` alone behind fixed optics: scenes are rendered
            once, see :class:`~kornia_tidy.training.noise_free.NoiseFreeCaptures`, and crop, gain and noise are drawn
            for each step, see :class:`~kornia_tidy.training.noisy_crops.NoisyCrops`; or ``"refiner"``: as
            ``"network"``, but only the second network of ``refined`` is learnt, and depth stays as it is; or
            ``"masks"``: they are learnt through a network that stays as it is, with noise drawn for each scene.
        design: gradient steps that optimise the masks for the task before training, without scenes or network, see
            :func:`~kornia_tidy.training.designed.design_masks`; for the task ``"edof"`` only. 0: none. A fixed lens
            is not changed.
        data: name of the data, see :data:`kornia_tidy.training.data_sets.SCENES`.
        root: folder of the data, where they are files. None: ``data/NAME``.
        size: side of the scenes in pixels; larger scenes are cropped, at random for training.
        crop: side of the crops of the captures in pixels, for fixed optics. None: whole captures.
        noise_range: least and largest standard deviation of read noise, in units of full scale, where not masks and
            network are learnt together; the sensor's own noise is that of scores afterwards.
        noise_error: largest factor by which the noise told to the network is wrong, for fixed optics: how well
            the noise of later captures will be known. 1: exactly.
        electrons: least and largest number of electrons of a white pixel at the reference f-number, for the captures
            with shot noise, likewise. A smaller aperture gets fewer in the same exposure time. None: 500
            to 60,000 at every f-number.
        reference_f_number: f-number at which the electrons are counted.
        scenes: number of training scenes, for data whose number of scenes is not fixed.
        validation_scenes: largest number of validation scenes.
        augment: flip scenes and vary their brightness by 0.8 to 1.1, as PhaseCam3D does; not for fixed optics.
        lr: learning rate of the network.
        lr_metres: learning rate of the masks in metres of height.
        schedule: of both rates: ``"constant"``, or ``"cosine"``: a rise over the first tenth of the steps, then a fall
            to zero.
        batch: scenes in a batch.
        accumulate: batches in a step of the optimiser.
        epochs: passes over the data.
        pretrain_epochs: earlier passes in which only the network is trained, with a fixed Fresnel lens. The paper
            takes 300 for the tasks edof and joint.
        patience: epochs without improvement after which the run stops. None: it does not stop early.
        ema: decay of the exponential moving average of the network's weights. 0: none.
        depth_weight: of the depth loss in the joint task.
        image_weight: of the image loss in the joint task.
        loss: name of the loss, see :data:`kornia_tidy.training.task_loss.LOSSES`.
        precision: of the network.
        channels_last: keep the channels of a pixel together in the network's memory, which is faster in bfloat16.
        **system: the settings of :class:`~kornia_tidy.inference.settings.SystemSettings`.

    Raises:
        ValueError: if a value is not allowed.

    Example:
        >>> TrainingSettings(task="depth", masks=5).lr_metres
        1e-08
    """

    learn: str = "both"
    design: int = 0
    data: str = "photographic-leaves"
    root: str | None = None
    size: int = 278
    crop: int | None = None
    noise_range: tuple[float, float] = (1e-3, 0.03)
    noise_error: float = TOLD_ERROR
    electrons: tuple[float, float] | None = None
    reference_f_number: float = 17.6
    scenes: int = 5077
    validation_scenes: int = 64
    augment: bool = True
    lr: float = 1e-4
    lr_metres: float = 1e-8
    schedule: str = "constant"
    batch: int = 32
    accumulate: int = 1
    epochs: int = 300
    pretrain_epochs: int = 0
    patience: int | None = None
    ema: float = 0.999
    depth_weight: float = 1.0
    image_weight: float = 1.0
    loss: str = "mse"
    precision: str = "32-true"
    channels_last: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("learn", self.learn, tuple(LEARN))
        if self.learn == "refiner" and not self.refined:
            raise ValueError("learn='refiner' needs the second network of refined=True")
        if self.learn == "masks" and not self.masks:
            raise ValueError("learn='masks' needs masks to learn, got masks=0, a fixed lens")
        check_choice("loss", self.loss, tuple(LOSSES))
        check_choice("precision", self.precision, PRECISIONS)
        check_choice("schedule", self.schedule, SCHEDULES)
        for name in ("lr", "lr_metres", "reference_f_number"):
            check_positive(name, getattr(self, name))
        for name in ("size", "scenes", "validation_scenes", "batch", "accumulate", "epochs"):
            check_count(name, getattr(self, name), 1)
        for name in ("pretrain_epochs", "design"):
            check_count(name, getattr(self, name), 0)
        if self.design and self.task != "edof":
            raise ValueError(f"masks can be designed before training for the task 'edof' only, got {self.task!r}")
        if self.patience is not None and self.patience < 1:
            raise ValueError(f"patience must be 1 epoch or more, got {self.patience}")
        object.__setattr__(self, "noise_range", tuple(self.noise_range))  # JSON has no tuples
        check_noise_range(self.noise_range)
        check_noise_error(self.noise_error)
        if self.electrons is not None:
            object.__setattr__(self, "electrons", tuple(self.electrons))
            check_electrons(self.electrons)
        if self.crop is not None:
            check_count("crop", self.crop, 1)
            if self.crop > self.size:
                raise ValueError(f"crop must be at most the size of the scenes, {self.size}, got {self.crop}")
        side = self.crop or self.size
        if self.loss == "psnr-ssim" and side < SSIM_WINDOW:
            raise ValueError(f"loss 'psnr-ssim' needs images of at least {SSIM_WINDOW} pixels a side, got {side}")
        if not 0 <= self.ema < 1:
            raise ValueError(f"ema must be in [0, 1), got {self.ema}")

    @property
    def fixed_optics(self) -> bool:
        """Whether the masks stay as they are, so that each scene is rendered once."""
        return self.learn in FIXED_OPTICS

    @classmethod
    def of(cls, system: TrainedSystem) -> Self:
        """Return the settings of the run that trained a system.

        Raises:
            ValueError: if the system's checkpoint holds a name that is unknown or a value that is not allowed.
        """
        try:
            return cls.from_dict({**system.settings.as_dict(), **system.run})
        except ValueError as error:
            raise ValueError(f"the checkpoint's settings of its run cannot be used: {error}") from error


def usual_settings(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the defaults of a training run that differ from those of :class:`TrainingSettings`.

    Where only the network learns they are those of :data:`NETWORK_RUN`, without the closed form where the head cannot
    have it or does without: networks of three channels, heads without a network, and ``residual``. The closed form is
    Wiener's; runs for image and depth with it have the defaults of :data:`JOINT_RUN` too.

    Args:
        given: settings that the user chose, by name.

    Example:
        >>> usual_settings({"learn": "network"})["width"], usual_settings({"learn": "both"})
        (16, {})
        >>> usual_settings({"task": "joint", "closed_form": True})
        {'inverse': 'wiener', 'depth_classes': 21, 'refocus': 9, 'depth_weight': 0.03}
    """
    usual = dict(NETWORK_RUN) if given.get("learn", "both") != "both" else {}
    if given.get("head") in (*FIXED, *CLOSED_FORMS):
        usual.pop("closed_form", None)
        usual.pop("width", None)
    elif given.get("residual"):
        usual.pop("closed_form", None)
    if {**usual, **given}.get("closed_form"):
        usual["inverse"] = "wiener"
        if given.get("task") == "joint":
            usual |= JOINT_RUN
    return usual


def differences(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """Return the entries in which two descriptions differ, each as ``name (one / other)``.

    Example:
        >>> differences({"masks": 5, "task": "edof"}, {"masks": 3, "task": "edof"})
        ['masks (5 / 3)']
    """
    names = dict.fromkeys([*one, *other])
    return [f"{n} ({one.get(n)} / {other.get(n)})" for n in names if one.get(n) != other.get(n)]
