"""Simulated captures of co-design candidates, and their scores after the best closed form."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import lru_cache
from statistics import fmean

import torch
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from torch import Tensor

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.data.dead_leaves import dead_leaves
from kornia_tidy.data.rgbd import Scene
from kornia_tidy.design.candidates import Candidate
from kornia_tidy.design.closed_forms import (
    DEPTHS,
    DepthLikelihood,
    WienerFilter,
    depth_filters,
    mean_depth,
    restorations,
    restored_by_depth,
)
from kornia_tidy.design.design_task import DesignTask, flat_mask
from kornia_tidy.fidelity import Fidelity
from kornia_tidy.modulator.modulator import DwellTimes
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.seeds import keyed_seed

DECISION = Fidelity("decision", pixel_tolerance=0.1, window=129, stray_light="veil")
"""PSFs of 129 px, and the light beyond them as a uniform background: narrower ones flatter coding."""

Scores = dict[str, dict[str, float]]
"""For "image" and "depth", the score in dB of each setting of the closed form."""


def candidate_optics(task: DesignTask, candidate: Candidate, fidelity: Fidelity = DECISION) -> TiDyOptics:
    """Return the camera of a candidate, with its sensor, for images in linear light.

    Example:
        >>> from kornia_tidy.design.candidates import flat_candidate
        >>> task = DesignTask()
        >>> round(candidate_optics(task, flat_candidate(task, 50.0, 0.5)).camera.f_number)
        50
    """
    masks = candidate.masks
    return TiDyOptics(
        flat_mask(task.mask_size) if masks is None else masks,
        task.camera(candidate.f_number, candidate.focus),
        DwellTimes() if masks is None else task.modulator,
        task.sensor(candidate.f_number),
        fidelity,
        color_space="linear",
        lens=task.real_lens(candidate.f_number, candidate.focus),
    )


def _banks(task: DesignTask, optics: TiDyOptics, defocus: list[float] | None = None) -> list[PSFBank]:
    """Return the PSFs of a camera at each of the task's places, of an ideal lens once."""
    if optics.lens is None:
        return [optics.psf_bank(defocus=defocus)]
    field = optics.psf_bank(defocus=defocus, field=task.places())
    return [field.at(index) for index in range(len(field.psfs))]


@torch.no_grad()
def score_candidate(task: DesignTask, candidate: Candidate, scenes: Sequence[Scene], seed: int = 0) -> Iterable[Scores]:
    """Yield the scores of a candidate on each scene, behind a real lens the mean over the task's places.

    Args:
        task: the task with the weight of depth: parts without a weight are not scored.
        candidate: flat lens or masks.
        scenes: images sRGB (3, H, W) in [0, 1], depth in metres.
        seed: of the noise, which is the same for all candidates as far as their light is.

    Yields:
        The score of each setting: PSNR of the sRGB image, and -20 log10 of the RMSE of inverse depth as a fraction of
        the range.
    """
    optics = candidate_optics(task, candidate)
    noise = task.noise(candidate.f_number)
    banks = _banks(task, optics)
    cameras = [optics] if optics.lens is None else [optics.with_bank(bank) for bank in banks]
    nodes = torch.linspace(*optics.camera.defocus_range, DEPTHS).tolist()
    banks_by_depth = _banks(task, optics, nodes) if task.depth_weight > 0 else banks

    @lru_cache(maxsize=len(banks))
    def forms(
        place: int, size: tuple[int, int]
    ) -> tuple[WienerFilter | None, DepthLikelihood | None, list[WienerFilter]]:
        bank, depths = banks[place], banks_by_depth[place]
        wiener = WienerFilter(bank, noise, task.statistics, size) if task.depth_weight < 1 else None
        likelihood = DepthLikelihood(depths, noise, task.statistics, size) if task.depth_weight > 0 else None
        by_depth = depth_filters(depths, noise, task.statistics, size) if wiener and likelihood else []
        return wiener, likelihood, by_depth

    def scores_at(place: int, scene: Scene, number: int) -> Scores:
        wiener, likelihood, by_depth = forms(place, (scene.image.shape[-2], scene.image.shape[-1]))
        depth = scene.depth.clamp(*task.depth_range)
        generator = torch.Generator().manual_seed(keyed_seed(seed, "noise", number))
        light = rgb_to_linear_rgb(scene.image.expand(3, -1, -1))[None]
        capture = cameras[place](light, depth[None], generator=generator)
        scores: Scores = {}
        probabilities = {} if likelihood is None else likelihood(capture)
        if wiener is not None:
            blended = restored_by_depth(capture, by_depth, probabilities) if by_depth else None
            images = restorations(capture, wiener, blended)
            truth, valid = linear_rgb_to_rgb(light), scene.valid[None].expand_as(light)
            scores["image"] = {name: _decibels(image - truth, valid) for name, image in images.items()}
        if probabilities:
            truth, valid = _normalised_inverse(depth[0], task.depth_range), scene.valid[0]
            scores["depth"] = {name: _decibels(mean_depth(p) - truth, valid) for name, p in probabilities.items()}
        return scores

    for number, scene in enumerate(scenes):
        found = [scores_at(place, scene, number) for place in range(len(banks))]
        yield {
            part: {name: fmean(at_place[part][name] for at_place in found) for name in settings}
            for part, settings in found[0].items()
        }


def leaf_scenes(count: int, size: int, depth_range: tuple[float, float], seed: int = 0) -> list[Scene]:
    """Return dead-leaves scenes without hard pixel edges: painted at twice the size and averaged in linear light.

    Args:
        count: number of scenes.
        size: side in pixels.
        depth_range: nearest and farthest depth in metres.
        seed: of all that is random.

    Example:
        >>> leaf_scenes(1, 32, (0.5, 4.0))[0].image.shape
        torch.Size([3, 32, 32])
    """
    scenes = []
    for number in range(count):
        leaves = max(40, size * size // 160)
        key = keyed_seed(seed, "leaves", number)
        image, depth = dead_leaves(2 * size, 2 * size, depth_range=depth_range, num_leaves=leaves, seed=key)
        light = torch.nn.functional.avg_pool2d(rgb_to_linear_rgb(image[None]), 2)
        scenes.append(Scene.whole(linear_rgb_to_rgb(light)[0], depth[:, ::2, ::2]))
    return scenes


def _normalised_inverse(depth: Tensor, depth_range: tuple[float, float]) -> Tensor:
    near, far = depth_range
    return (1 / depth - 1 / far) / (1 / near - 1 / far)


def _decibels(error: Tensor, valid: Tensor) -> float:
    squared = (error.square() * valid).sum() / valid.sum().clamp(min=1)
    return -10 * math.log10(max(float(squared), 1e-12))
