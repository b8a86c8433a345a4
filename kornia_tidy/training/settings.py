"""Settings of a training run: those of the system that is trained, and data, optimiser and duration of the run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Self

from kornia_tidy.design.settings import DesignSettings
from kornia_tidy.files import error_prefix
from kornia_tidy.reconstruction.head_names import CLOSED_FORMS, FIXED
from kornia_tidy.reconstruction.settings import SystemSettings
from kornia_tidy.settings import Count, CountOrNone, Factor, FNumber, Pixels, Unit, one_of

if TYPE_CHECKING:
    from kornia_tidy.reconstruction.trained import TrainedSystem

DATA = {
    "photographic-leaves": "painted, like photographs",
    "dead-leaves": "painted, with sharp outlines and full textures",
    "photo-collages": "cut out of your own photographs",
    "flying-things": "frames of FlyingThings3D, as published; the nearest points are put at the camera's near end",
    "flying-things-patches": "the paper's patches of them",
    "nyu": "NYU Depth v2, as published",
    "rgbd-folder": "your own folder, in which rgbd.json gives the pairs of files and the unit of depth",
}
"""Data sets by name."""
LOSS = {
    "mse": "the paper's",
    "l1": "Ikoma's of depth",
    "phasecam3d": "20 RMSE + RMSE of slopes",
    "charbonnier": "smooth l1",
    "psnr-ssim": "decibels of the error and of SSIM, for images",
}
SCHEDULES = ("constant", "cosine")
PRECISIONS = ("32-true", "bf16-mixed", "16-mixed")  # of the network; optics always run in float32
LEARN = {
    "both": "masks and network",
    "network": "the network behind fixed optics",
    "refiner": "the second network behind fixed optics, after the first",
    "masks": "the masks, through a fixed network",
}
FIXED_OPTICS = ("network", "refiner")
SSIM_WINDOW = 11  # px, that of kornia_tidy.reconstruction.metrics


NETWORK_RUN: dict[str, Any] = {
    "learn": "network", "head": "nafnet", "closed_form": True, "width": 16, "size": 256, "crop": None, "scenes": 1000,
    "validation_scenes": 24, "batch": 4, "lr": 2e-3, "schedule": "cosine", "loss": "charbonnier", "epochs": 24,
}  # fmt: skip
"""Settings of a run of only the network that differ from the defaults, which are the paper's for both."""

JOINT_RUN: dict[str, Any] = {"depth_classes": 21, "refocus": 9, "depth_weight": 0.03}
"""Settings of a run for image and depth that begins with the closed form: the loss of a distribution of depth is about
a hundred times that of an image."""


@dataclass(frozen=True, kw_only=True)
class SceneSettings:
    """Scenes.

    Args:
        data: where scenes come from, see :data:`DATA`. Published splits are kept; of a folder a tenth is for
            validation and a tenth for testing.
        root: folder of data that are files. None: data/NAME.
        size: side of the scenes; larger ones are cropped, at random for training.
        scenes: number for training, of patches and of scenes made here.
        validation_scenes: largest number for validation.
        crop: side of the crop of a capture in a step, for fixed optics. None: all of it.
        augment: flip scenes and vary their brightness by 0.8 to 1.1, as PhaseCam3D does; not for fixed optics.
    """

    data: Annotated[str, one_of(DATA)] = "photographic-leaves"
    root: Annotated[str, Unit("FOLDER")] | None = None
    size: Pixels = 278
    scenes: Count = 5077
    validation_scenes: Count = 64
    crop: Pixels | None = None
    augment: bool = True


@dataclass(frozen=True, kw_only=True)
class LightSettings:
    """Noise in training, where not masks and network are learnt together.

    Args:
        noise_range: least and largest standard deviation of the read noise, of full scale, drawn for half of the
            captures; the sensor's own noise is that of scores afterwards.
        noise_error: largest factor between the noise given to the network and the true one, for fixed optics: the
            expected error for later captures; 1: none.
        electrons: least and largest number of electrons of white at the reference f-number, drawn for the other half,
            which has shot noise: a smaller aperture gets fewer in the same exposure time. None: 500 to 60000 at any
            f-number.
        reference_f_number: f-number at which the electrons are counted.
    """

    noise_range: Annotated[tuple[float, float], Unit("LEAST LARGEST", "", 0, 1, above=True)] = (1e-3, 0.03)
    noise_error: Annotated[float, Unit("X", "", 1)] = 2.5
    electrons: Annotated[tuple[float, float], Unit("LEAST LARGEST", "electrons", 0, above=True)] | None = None
    reference_f_number: FNumber = DesignSettings.reference_f_number

    def check_light(self) -> None:
        """Raise ``ValueError`` if the ends of a range are out of order."""
        for name in ("noise_range", "electrons"):
            if (ends := getattr(self, name)) is not None:
                object.__setattr__(self, name, tuple(ends))  # JSON has no tuples
                if ends[0] > ends[1]:
                    raise ValueError(f"{name} must be least and largest, got {ends[0]} and {ends[1]}")


@dataclass(frozen=True, kw_only=True)
class LearningSettings:
    """Learning.

    Args:
        learn: the parts to learn. Behind fixed optics each scene is rendered once, see
            :class:`~kornia_tidy.training.noise_free.NoiseFreeCaptures`, and crop, gain and noise are drawn for each
            step, see :class:`~kornia_tidy.training.noisy_crops.NoisyCrops`; masks are learnt with noise drawn for each
            scene.
        design: gradient steps that design the masks before training, without scenes or network, see
            :func:`~kornia_tidy.training.designed.design_masks`; for the task edof only, 120 do.
        lr: learning rate of the network.
        lr_metres: learning rate of the masks in metres of height.
        schedule: of both rates; cosine: up over a tenth of the steps, then down to zero.
        batch: scenes in a batch.
        accumulate: batches in a step.
        epochs: passes over the scenes.
        pretrain_epochs: earlier passes of only the network, with a fixed Fresnel lens; the paper takes 300.
        patience: epochs without improvement after which the run stops. None: it does not stop early.
        ema: decay of the moving average of the network's weights; 0: none.
        loss: of image and depth, see :data:`LOSS`.
        depth_weight: of the depth loss in the task joint; beside psnr-ssim, which is in decibels, 10 or more.
        image_weight: of the image loss in the task joint.
        precision: of the network; optics stay in float32. bf16-mixed is faster on processors that compute in bfloat16
            (AMX or AVX-512 BF16), and far slower on others.
        channels_last: the network's memory holds the channels of a pixel together, which is faster in bfloat16.
    """

    learn: Annotated[str, one_of(LEARN)] = "both"
    design: CountOrNone = 0
    lr: Annotated[float, Unit("LR", "", 0, above=True)] = 1e-4
    lr_metres: Annotated[float, Unit("LR", "metres", 0, above=True)] = 1e-8
    schedule: Annotated[str, one_of(SCHEDULES)] = "constant"
    batch: Annotated[int, Unit("B", "", 1)] = 32
    accumulate: Count = 1
    epochs: Count = 300
    pretrain_epochs: CountOrNone = 0
    patience: Count | None = None
    ema: Annotated[float, Unit("D", "", 0)] = 0.999
    loss: Annotated[str, one_of(LOSS)] = "mse"
    depth_weight: Factor = 1.0
    image_weight: Factor = 1.0
    precision: Annotated[str, one_of(PRECISIONS)] = "32-true"
    channels_last: bool = False


@dataclass(frozen=True, kw_only=True)
class TrainingSettings(LearningSettings, LightSettings, SceneSettings, SystemSettings):
    """A training run. The defaults are the paper's, with our camera; see :func:`kornia_tidy.training.run.train`.

    Checkpoints and ``settings.json`` hold all of them in one dictionary.

    Raises:
        ValueError: if a value is not allowed.

    Example:
        >>> TrainingSettings(task="depth", masks=5).lr_metres
        1e-08
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_light()
        if self.learn == "refiner" and not self.refined:
            raise ValueError("learn='refiner' needs the second network of refined=True")
        if self.learn == "masks" and not self.masks:
            raise ValueError("learn='masks' needs masks to learn, got masks=0, a fixed lens")
        if self.design and self.task != "edof":
            raise ValueError(f"masks can be designed before training for the task 'edof' only, got {self.task!r}")
        if self.crop is not None and self.crop > self.size:
            raise ValueError(f"crop must be at most the size of the scenes, {self.size}, got {self.crop}")
        side = self.crop or self.size
        if self.loss == "psnr-ssim" and side < SSIM_WINDOW:
            raise ValueError(f"loss 'psnr-ssim' needs images of at least {SSIM_WINDOW} pixels a side, got {side}")
        if not self.ema < 1:
            raise ValueError(f"ema must be in [0, 1), got {self.ema}")

    @property
    def fixed_optics(self) -> bool:
        """Whether the masks are fixed, so that each scene is rendered once."""
        return self.learn in FIXED_OPTICS

    @classmethod
    def of(cls, system: TrainedSystem) -> Self:
        """Return the settings of the run that trained a system.

        Raises:
            ValueError: if the system's checkpoint holds a name that is unknown or a value that is not allowed.
        """
        with error_prefix("the checkpoint's settings of its run cannot be used"):
            return cls.from_dict({**system.settings.as_dict(), **system.run})


def usual_settings(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the defaults of a training run that differ from those of :class:`TrainingSettings`.

    Where only the network learns they are those of :data:`NETWORK_RUN`, without the closed form where the head cannot
    have it or does without: networks of three channels, heads without a network, and ``residual``. The closed form is
    Wiener's; runs for image and depth with it also have the defaults of :data:`JOINT_RUN`.

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
