"""Training of optics and network under a budget of steps, and scores on painted and real scenes.

All experiments with a network share it, so that a table compares systems and not trainings: the same painted scenes,
steps, learning rates and noise for each row. It uses the library's Lightning module and data loader.
"""

from __future__ import annotations

import logging
import statistics
import warnings
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, cast

import torch
from torch import nn
from torch.utils.data import Dataset

from examples.paper.cameras import REFERENCE, flat_lens
from examples.paper.closed_forms import TEMPERATURES, ClosedForms
from examples.paper.scenes import Budget, ForCamera, painted, scored_sets
from kornia_tidy import ThinLensCamera, TiDyOptics
from kornia_tidy.reconstruction.settings import SystemSettings
from kornia_tidy.reconstruction.tasks import MAPS, normalised_inverse_depth
from kornia_tidy.reconstruction.trained import TrainedSystem, build_head, update_psfs
from kornia_tidy.seeds import keyed_seed

TUNED = 8  # painted scenes on which settings are chosen


def train(optics: TiDyOptics, task: str, budget: Budget, seed: int, **head: Any) -> TrainedSystem:
    """Train masks and network together, from the camera's masks and random weights.

    Args:
        optics: the camera, trained in place. Masks that require no gradient stay as they are.
        task: ``"edof"``, ``"depth"`` or ``"joint"``.
        budget: steps, scenes and learning rates.
        seed: of weights, order and noise.
        **head: settings of the network, see :class:`~kornia_tidy.reconstruction.settings.SystemSettings`.

    Returns:
        The system in eval mode.
    """
    settings = head_settings(task, budget, **head)
    torch.manual_seed(keyed_seed("paper", "weights", seed))
    return fit(optics, build_head(settings), settings, budget, seed)


def fit(
    optics: TiDyOptics,
    network: nn.Module,
    settings: SystemSettings,
    budget: Budget,
    seed: int,
    before_step: Callable[[int], None] | None = None,
) -> TrainedSystem:
    """Train a camera's masks and a given network together.

    Args:
        optics: the camera, trained in place. Masks that require no gradient stay as they are.
        network: trained in place, from the weights that it has, in the mode that it is in.
        settings: task of the system.
        budget: steps, scenes and learning rates.
        seed: of the order of the scenes.
        before_step: function that is called with the number of each step before it.

    Returns:
        The system in eval mode.
    """
    import lightning.pytorch as pl  # noqa: PLC0415 (so that --help needs no extra)
    from lightning.pytorch.callbacks import LambdaCallback  # noqa: PLC0415

    from kornia_tidy.training.data_module import SceneData  # noqa: PLC0415
    from kornia_tidy.training.module import TidyTraining  # noqa: PLC0415

    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    rates = {"lr": budget.lr, "lr_metres": budget.lr_metres, "schedule": budget.schedule}
    module = TidyTraining(optics, network, task=settings.task, ema=0, **rates)
    scenes = ForCamera(painted(budget, "train", budget.scenes), cast("ThinLensCamera", optics.camera))
    callbacks = []
    if before_step is not None:
        callbacks.append(LambdaCallback(on_train_batch_start=lambda run, *_: before_step(run.global_step)))
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
            callbacks=callbacks,
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
    """Return a system in eval mode with maps clipped to [0, 1]."""
    with torch.no_grad():
        update_psfs(head, optics)
    return TrainedSystem(optics.eval(), nn.Sequential(head, nn.Hardtanh(0.0, 1.0)).eval(), settings, steps)


def closed_form_system(optics: TiDyOptics, task: str, budget: Budget) -> TrainedSystem:
    """Return a camera with the closed form of a task instead of a network: nothing is trained.

    The image is :class:`~kornia_tidy.reconstruction.ClosedFormHead`'s, Tikhonov deconvolution and a bilateral filter.
    The depth is the mean of :func:`~kornia_tidy.reconstruction.depth_likelihood.depth_likelihood`, at the temperature
    that is best on eight painted scenes which are neither trained on nor scored.
    """
    system = system_of(optics, ClosedForms(optics, task), SystemSettings(task=task), 0)
    if "depth" in MAPS[task]:
        best_temperature(system, painted(budget, "validation", min(TUNED, budget.scored)))
    return system


def best_temperature(system: TrainedSystem, scenes: Dataset[Any]) -> None:
    """Set the temperature of a closed form of depth to the one with the least error on some scenes."""
    forms = next(part for part in system.head.modules() if isinstance(part, ClosedForms))

    def error(temperature: float) -> float:
        forms.temperature = temperature
        return mean_scores(system, scenes)["rmse"]

    forms.temperature = min(TEMPERATURES, key=error)


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


def prefixed(prefix: str, scores: dict[str, float]) -> dict[str, float]:
    """Return scores under names that begin with what restored the captures, such as ``network_painted_psnr``."""
    return {f"{prefix}_{name}": value for name, value in scores.items()}


def trained_scores(
    make: Callable[[], TiDyOptics], task: str, budget: Budget, seed: int, **head: Any
) -> dict[str, float]:
    """Return the scores of a camera's network after training, and of the closed form before and after it."""
    optics = make()
    found = prefixed("start", scores_of(closed_form_system(optics, task, budget), budget))
    system = train(optics, task, budget, seed, **head)
    found |= prefixed("network", scores_of(system, budget))
    return found | prefixed("closed", scores_of(closed_form_system(system.optics, task, budget), budget))


FLAT = tuple((f_number, focus) for f_number in (17.6, 25.0, 35.0, 50.0, 71.0) for focus in (0.0, 0.4, 0.5, 1.0))


@lru_cache
def best_flat(task: str, budget: Budget) -> tuple[float, float]:
    """Return f-number and focus of the lens without masks that a closed form restores best.

    They are chosen among :data:`FLAT` on eight scenes that are neither trained on nor scored.

    Args:
        task: ``"edof"`` or ``"depth"``.
        budget: scenes and fidelity.
    """
    tuned = painted(budget, "validation", min(TUNED, budget.scored))
    wanted = FLAT if budget.scored > 2 else FLAT[-2:]

    def merit(lens: tuple[float, float]) -> float:
        optics = flat_lens(*lens, budget.fidelity)
        scores = mean_scores(closed_form_system(optics, task, budget), tuned)
        return scores["psnr"] if task == "edof" else -scores["rmse"]

    return max(wanted, key=merit)
