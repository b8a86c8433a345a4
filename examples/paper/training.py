"""Training of optics and network under a budget of steps, and scores on painted and real scenes.

All experiments with a network share it, so that a table compares systems and not trainings: the same painted scenes,
steps, learning rates and noise for each row. It uses the library's Lightning module and data loader.
"""

from __future__ import annotations

import logging
import statistics
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.utils.data import Dataset

from kornia_tidy import Fidelity, PixelwiseMask, SensorNoise, ThinLensCamera, TiDyOptics
from kornia_tidy.data.patches import central_crop
from kornia_tidy.inference.settings import SystemSettings
from kornia_tidy.inference.tasks import MAPS, metres, normalised_inverse_depth
from kornia_tidy.inference.trained import TrainedSystem, build_head, fix_window, update_psfs
from kornia_tidy.masks.base import PhaseMasks
from kornia_tidy.seeds import keyed_seed
from kornia_tidy.sensor.exposure import exposed_sensor

ELECTRONS, F_NUMBER = 2000.0, 17.6
"""Electrons of a white pixel at f/17.6. Other f-numbers have the same exposure time.

The noise at a fifth of full scale is then 0.01, which is that of PhaseCam3D; TiDy-PSFs states none.
"""
REFERENCE = ThinLensCamera()  # depths of all scenes are painted for it, and stretched to the range of other cameras

BALANCED = Fidelity.preset("balanced")


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Extent of all trainings and scores at one scale.

    Args:
        size: side of painted scenes in pixels.
        scenes: number of painted scenes for training.
        batch: scenes in a step.
        steps: of the optimiser.
        width: channels of the first level of U-Nets.
        scored: number of other painted scenes that are scored.
        real: largest number of real scenes that are scored.
        real_size: side of their middle in pixels.
        seeds: trainings of each row, with other initial masks, weights and orders of the scenes.
        lr: learning rate of the network.
        lr_metres: learning rate of the masks in metres of height.
        schedule: of both, see :class:`~kornia_tidy.training.settings.TrainingSettings`.
        residual: image networks estimate the difference to the capture, which needs fewer steps.
        fidelity: by which PSFs are computed.
        accelerator: of Lightning.
    """

    size: int = 64
    scenes: int = 96
    batch: int = 4
    steps: int = 60
    width: int = 8
    scored: int = 16
    real: int = 12
    real_size: int = 160
    seeds: int = 2
    lr: float = 2e-3
    lr_metres: float = 6e-8
    schedule: str = "cosine"
    residual: bool = True
    fidelity: Fidelity = BALANCED
    accelerator: str = "cpu"

    @property
    def words(self) -> str:
        """The budget in words, for tables."""
        return (
            f"{self.steps:,} steps of {self.batch} of {self.scenes:,} painted scenes of {self.size} px, U-Nets of "
            f"width {self.width}, learning rates {self.lr:g} and {self.lr_metres:g} m ({self.schedule}); scored on "
            f"{self.scored} other painted scenes and {self.real} real ones of {self.real_size} px; seeds {self.seeds}"
        )


SMALL = Fidelity.preset("draft").replace(window=23)
BUDGETS = {
    "smoke": Budget(size=48, scenes=2, batch=2, steps=2, width=2, scored=2, real=0, seeds=1, fidelity=SMALL),
    "cpu": Budget(),
    "gpu": Budget(
        seeds=3, size=256, scenes=5077, batch=32, steps=10_000, width=32, scored=64, real=35, real_size=512, lr=1e-3,
        accelerator="gpu",
    ),
    "paper": Budget(
        seeds=3, size=256, scenes=5077, batch=32, steps=47_400, width=64, scored=419, real=35, real_size=512, lr=1e-4,
        lr_metres=1e-8, schedule="constant", residual=False, accelerator="gpu",
    ),
}  # fmt: skip
"""By scale. The one called ``"paper"`` has the paper's rates, batch, network and 300 passes over its 5,077 scenes."""


# ---------------------------------------------------------------------- cameras


def sensor_at(f_number: float) -> SensorNoise:
    """Return the sensor of a camera, with shot and read noise, for the same exposure time at every f-number."""
    return exposed_sensor(f_number, ELECTRONS, F_NUMBER)


def camera_with(masks: PhaseMasks, fidelity: Fidelity, lens: ThinLensCamera = REFERENCE, **parts: Any) -> TiDyOptics:
    """Return a camera with masks and the sensor of equal exposure time; its PSF window stays as it is now."""
    parts = {"sensor": sensor_at(lens.f_number), **parts}
    return fix_window(TiDyOptics(masks, lens, fidelity=fidelity, **parts))


def flat_lens(f_number: float, focus: float, fidelity: Fidelity) -> TiDyOptics:
    """Return a lens without masks over the depths of :data:`REFERENCE`.

    Args:
        f_number: focal length over aperture.
        focus: in focus, in parts of the range of inverse depth: 0 is the far end.
        fidelity: by which PSFs are computed.
    """
    distance = float(metres(REFERENCE, torch.tensor(focus, dtype=torch.float64)))
    lens = ThinLensCamera(
        REFERENCE.focal_length,
        REFERENCE.focal_length / f_number,
        distance,
        REFERENCE.pixel_pitch,
        REFERENCE.depth_range,
    )
    return camera_with(PixelwiseMask(1, initial="flat"), fidelity, lens).requires_grad_(requires_grad=False)


def pinhole(fidelity: Fidelity) -> TiDyOptics:
    """Return a camera whose captures are in focus everywhere: a small aperture before pixels wider than its PSF."""
    lens = ThinLensCamera(50e-3, 0.5e-3, REFERENCE.focus_distance, 300e-6, REFERENCE.depth_range)
    optics = camera_with(PixelwiseMask(1, initial="flat"), fidelity, lens, sensor=sensor_at(F_NUMBER))
    return optics.requires_grad_(requires_grad=False)


FLAT = tuple((f_number, focus) for f_number in (17.6, 25.0, 35.0, 50.0, 71.0) for focus in (0.0, 0.4, 0.5, 1.0))


@lru_cache
def best_flat(task: str, budget: Budget) -> tuple[float, float]:
    """Return f-number and focus of the lens without masks whose closed form is best on painted scenes.

    They are chosen among :data:`FLAT` on eight scenes that are neither trained on nor scored.

    Args:
        task: ``"edof"`` or ``"depth"``.
        budget: scenes and fidelity.
    """
    tuned = painted(budget, "validation", min(8, budget.scored))
    wanted = FLAT if budget.scored > 2 else FLAT[-2:]

    def merit(lens: tuple[float, float]) -> float:
        optics = flat_lens(*lens, budget.fidelity)
        scores = mean_scores(closed_form_system(optics, task), tuned)
        return scores["psnr"] if task == "edof" else -scores["rmse"]

    return max(wanted, key=merit)


# ---------------------------------------------------------------------- scenes


class ForCamera(Dataset):
    """Scenes whose depths are stretched, linearly in dioptres, from the range of one camera to that of another."""

    def __init__(self, scenes: Dataset[Any], camera: ThinLensCamera) -> None:
        self.scenes, self.camera = scenes, camera

    def __len__(self) -> int:
        """Return the number of scenes."""
        return len(cast("Any", self.scenes))

    def __getitem__(self, index: int) -> dict[str, Any]:
        """Return a scene."""
        sample = self.scenes[index]
        return {**sample, "depth": metres(self.camera, normalised_inverse_depth(REFERENCE, sample["depth"]))}


@lru_cache
def painted(budget: Budget, split: str, count: int) -> Dataset[Any]:
    """Return painted scenes of a split, ``"train"``, ``"validation"`` or ``"test"``; they stay in memory."""
    from kornia_tidy.data.photographic_leaves import PhotographicLeaves  # noqa: PLC0415 (after --help)
    from kornia_tidy.data.remembered import Remembered  # noqa: PLC0415

    seed = keyed_seed("paper", split)
    return Remembered(PhotographicLeaves(count, budget.size, budget.size, depth_range=REFERENCE.depth_range, seed=seed))


@lru_cache
def real(most: int, size: int) -> list[dict[str, Any]]:
    """Return real scenes of ``../shared/data``, evenly drawn from the list; none where the folder is missing.

    Depths are stretched over the range of :data:`REFERENCE`; the middle of each picture is kept.
    """
    from kornia_tidy.commands.demo import stretched  # noqa: PLC0415
    from tests.scenes import ENTRIES, load_scene  # noqa: PLC0415

    scenes = []
    for name in list(ENTRIES)[:: -(-len(ENTRIES) // most)] if most and ENTRIES else []:
        image, depth, known = load_scene(name)
        sample = {"image": image.expand(3, -1, -1), "depth": stretched(depth, known, REFERENCE), "mask": known}
        height, width = (min(size, side) for side in image.shape[-2:])
        scenes.append({**central_crop(sample, (height, width)), "name": name})
    return scenes


# ---------------------------------------------------------------------- training and scores


def train(optics: TiDyOptics, task: str, budget: Budget, seed: int, **head: Any) -> TrainedSystem:
    """Train masks and network together, from the camera's masks and random weights.

    Args:
        optics: the camera, trained in place. Masks that require no gradient stay as they are.
        task: ``"edof"``, ``"depth"`` or ``"joint"``.
        budget: steps, scenes and learning rates.
        seed: of weights, order and noise.
        **head: settings of the network, see :class:`~kornia_tidy.inference.settings.SystemSettings`.

    Returns:
        The system in eval mode.
    """
    import lightning.pytorch as pl  # noqa: PLC0415 (so that --help needs no extra)

    from kornia_tidy.training.data_module import SceneData  # noqa: PLC0415
    from kornia_tidy.training.module import TidyTraining  # noqa: PLC0415

    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    settings = head_settings(task, budget, **head)
    torch.manual_seed(keyed_seed("paper", "weights", seed))
    network = build_head(settings)
    module = TidyTraining(
        optics, network, task, lr=budget.lr, lr_metres=budget.lr_metres, schedule=budget.schedule, ema=0
    )
    scenes = ForCamera(painted(budget, "train", budget.scenes), cast("ThinLensCamera", optics.camera))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=UserWarning, module="lightning")
        warnings.filterwarnings("ignore", message=".*LeafSpec", category=FutureWarning)
        trainer = pl.Trainer(
            max_steps=budget.steps,
            accelerator=budget.accelerator,
            devices=1,
            limit_val_batches=0,
            num_sanity_val_steps=0,
            use_distributed_sampler=False,
            logger=False,
            enable_checkpointing=False,
            enable_model_summary=False,
            enable_progress_bar=budget.accelerator != "cpu",
        )
        trainer.fit(module, SceneData(scenes, scenes, budget.batch, keyed_seed("paper", "order", seed), augment=True))
    return system_of(module.cpu().optics, network, settings, budget.steps)


def head_settings(task: str, budget: Budget, **head: Any) -> SystemSettings:
    """Return the settings of a network: the paper's attention U-Net, of the budget's width, unless others are given."""
    usual: dict[str, Any] = {"head": "attention-unet", "width": budget.width}
    if "image" in MAPS[task] and not head.get("closed_form"):
        usual["residual"] = budget.residual
    return SystemSettings(task=task, **{**usual, **head})


def system_of(optics: TiDyOptics, head: nn.Module, settings: SystemSettings, steps: int) -> TrainedSystem:
    """Return a system in eval mode whose maps are clipped to [0, 1], as images are when they are shown."""
    with torch.no_grad():
        update_psfs(head, optics)
    return TrainedSystem(optics.eval(), nn.Sequential(head, nn.Hardtanh(0.0, 1.0)).eval(), settings, steps)


def closed_form_system(optics: TiDyOptics, task: str) -> TrainedSystem:
    """Return a camera with the closed form of a task instead of a network: nothing is trained.

    The image is :class:`~kornia_tidy.reconstruction.ClosedFormHead`'s, Tikhonov deconvolution and a bilateral filter.
    The depth is the mean of :func:`~kornia_tidy.reconstruction.depth_likelihood.depth_likelihood`.
    """
    settings = SystemSettings(task=task)
    return system_of(optics, ClosedForms(optics, task), settings, 0)


class ClosedForms(nn.Module):
    """Maps of a task from a capture, without a network. See :func:`closed_form_system`."""

    def __init__(self, optics: TiDyOptics, task: str, layers: int = 11) -> None:
        from kornia_tidy.reconstruction.closed_form_head import ClosedFormHead  # noqa: PLC0415
        from kornia_tidy.reconstruction.depth_likelihood import likelihood_filters  # noqa: PLC0415

        super().__init__()
        self.task, self.encoded = task, optics.color_space == "srgb"
        self.image = ClosedFormHead(encoded=self.encoded)
        if "depth" in MAPS[task]:
            lo, hi = optics.camera.defocus_range
            with torch.no_grad():
                psfs = optics.psf_bank(3, defocus=torch.linspace(lo, hi, layers, dtype=torch.float64).tolist()).psfs
                psfs = psfs.flip((-2, -1)) if optics.fidelity.correlate else psfs
                sensor = cast("SensorNoise", optics.sensor)
                noise = float(sensor.std(torch.tensor(0.2))) / psfs.shape[1] ** 0.5  # of the mean of the colours
                self.filters = likelihood_filters(psfs.mean(1).float(), max(noise, 4e-3))

    def forward(self, coded: Tensor) -> Tensor:
        """Return depth, image, or depth and image."""
        maps = []
        if "depth" in MAPS[self.task]:
            maps.append(self._depth(coded))
        if "image" in MAPS[self.task]:
            maps.append(self.image(coded))
        return torch.cat(maps, 1)

    def _depth(self, coded: Tensor) -> Tensor:
        from kornia.color import rgb_to_linear_rgb  # noqa: PLC0415

        from kornia_tidy.reconstruction.depth_likelihood import depth_likelihood  # noqa: PLC0415

        light = (rgb_to_linear_rgb(coded) if self.encoded else coded).mean(1, keepdim=True)
        likelihood = depth_likelihood(light, *self.filters).softmax(1)
        places = torch.linspace(0, 1, likelihood.shape[1])
        return torch.einsum("bdhw,d->bhw", likelihood, places)[:, None]


def depth_limit(optics: TiDyOptics) -> float:
    """Return the bound on the error of a bright point's depth, as a fraction of the range.

    See :func:`~kornia_tidy.mask_design.candidates.depth_bound`; depths are uniform over the range.
    """
    from kornia_tidy.mask_design.candidates import depth_bound  # noqa: PLC0415
    from kornia_tidy.mask_design.design_task import DesignTask  # noqa: PLC0415

    lens = cast("ThinLensCamera", optics.camera)
    task = DesignTask(electrons=ELECTRONS, reference_f_number=F_NUMBER, depth_weight=1.0)
    with torch.no_grad():
        return float(depth_bound(task, optics.psf_model, lens.f_number))


def constant_depth(budget: Budget) -> dict[str, float]:
    """Return the depth errors of the mean normalised inverse depth of the training scenes, which sees no capture."""
    from kornia_tidy.reconstruction.metrics import rmse  # noqa: PLC0415

    seen = painted(budget, "train", budget.scenes)
    depths = (normalised_inverse_depth(REFERENCE, seen[index]["depth"]) for index in range(budget.scenes))
    mean = statistics.fmean(float(depth.mean()) for depth in depths)
    found = {}
    for where, scenes in scored_sets(budget).items():
        errors = []
        for index in range(len(cast("Any", scenes))):
            truth = normalised_inverse_depth(REFERENCE, scenes[index]["depth"])[None]
            known = scenes[index].get("mask", torch.ones_like(truth[0], dtype=torch.bool))[None]
            errors.append(float(rmse(torch.full_like(truth, mean), truth, known)))
        if errors:
            found[f"{where}_rmse"] = statistics.fmean(errors)
    return found


SCORES = {"image_psnr": "psnr", "image_ssim": "ssim", "image_rmse": "image_rmse", "depth_rmse": "rmse"}


def mean_scores(system: TrainedSystem, scenes: Sequence[Any] | Dataset[Any]) -> dict[str, float]:
    """Return the means over scenes of a system's scores, by the names in :data:`SCORES`; none without scenes.

    The noise of a scene is the same for all systems, as far as their light is.
    """
    from kornia_tidy.training.evaluation import evaluate, mean_row  # noqa: PLC0415

    if not len(cast("Any", scenes)):
        return {}
    rows = evaluate(system, ForCamera(cast("Dataset[Any]", scenes), cast("ThinLensCamera", system.optics.camera)))
    means = mean_row(rows)
    return {short: means[name] for name, short in SCORES.items() if name in means}


def scores_of(system: TrainedSystem, budget: Budget) -> dict[str, float]:
    """Return a system's scores on painted scenes that it was not trained on, and on real ones, as ``painted_psnr``."""
    return {
        f"{where}_{name}": value
        for where, scenes in scored_sets(budget).items()
        for name, value in mean_scores(system, scenes).items()
    }


def scored_sets(budget: Budget) -> dict[str, Any]:
    """Return the painted scenes that are scored, and the real ones."""
    return {"painted": painted(budget, "test", budget.scored), "real": real(budget.real, budget.real_size)}


def prefixed(prefix: str, scores: dict[str, float]) -> dict[str, float]:
    """Return scores under names that begin with what restored the captures, such as ``network_painted_psnr``."""
    return {f"{prefix}_{name}": value for name, value in scores.items()}


def trained_scores(
    make: Callable[[], TiDyOptics], task: str, budget: Budget, seed: int, **head: Any
) -> dict[str, float]:
    """Return the scores of a camera's network after training, and of the closed form before and after it."""
    optics = make()
    found = prefixed("start", scores_of(closed_form_system(optics, task), budget))
    system = train(optics, task, budget, seed, **head)
    found |= prefixed("network", scores_of(system, budget))
    return found | prefixed("closed", scores_of(closed_form_system(system.optics, task), budget))


def mean_and_error(values: Sequence[float]) -> str:
    """Return a mean and its standard error over seeds as text; without the error for one value.

    Example:
        >>> mean_and_error([1.0, 2.0, 3.0]), mean_and_error([1.5])
        ('2.00 ± 0.58', '1.50')
    """
    mean = statistics.fmean(values)
    digits = 2 if abs(mean) >= 2 else 4
    if len(values) < 2:
        return f"{mean:.{digits}f}"
    return f"{mean:.{digits}f} ± {statistics.stdev(values) / len(values) ** 0.5:.{digits}f}"
