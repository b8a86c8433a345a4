"""Scores of an estimate, and the depth estimates that know nothing of the capture."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path

import torch
from kornia.color import rgb_to_y, rgb_to_ycbcr
from kornia.filters import box_blur
from torch import Tensor

from kornia_tidy.reconstruction.metrics import psnr, rmse, ssim
from kornia_tidy.reconstruction.reliability import sparsification_curve
from tests.benchmarks.results.scenes import BenchScene

CONTRAST, NEIGHBOURHOOD = 0.01, 9  # standard deviation of the luma above which a pixel is textured; side in pixels
PERCEPTUAL_WEIGHTS = "alexnet-owt-7be5be79.pth"  # which torchvision would download
SURE = 0.7  # part of a scene's known pixels, the surest
Scores = dict[str, float]


def score(scene: BenchScene, maps: Mapping[str, Tensor]) -> Scores:
    """Return all scores of a restoration's maps by name."""
    scores = {}
    if "image" in maps:
        scores |= image_scores(scene, maps["image"])
    if "depth" in maps:
        scores |= depth_scores(scene, maps["depth"])
    if "deviation" in maps:
        scores["depth_surest"] = surest_error(scene, maps["depth"], maps["deviation"])
    return scores


def image_scores(scene: BenchScene, image: Tensor) -> Scores:
    """Return PSNR, SSIM and chroma PSNR, and LPIPS where its weights are on this machine."""
    pair = image, scene.image
    scores = {"psnr": psnr(*pair), "ssim": ssim(*pair), "chroma": chroma_psnr(*pair)}
    if (distance := perceptual_distance()) is not None:
        scores["lpips"] = distance(*pair)
    return {name: float(value) for name, value in scores.items()}


def chroma_psnr(prediction: Tensor, target: Tensor) -> Tensor:
    """Return the PSNR of the colour differences Cb and Cr of ITU-R BT.601, pooled over both, of RGB images."""
    ours, truth = (rgb_to_ycbcr(image)[:, 1:] for image in (prediction, target))
    return psnr(ours, truth)


def depth_scores(scene: BenchScene, inverse_depth: Tensor) -> Scores:
    """Return the RMSE in parts of the range over known pixels: all, textured and textureless ones, and their bias."""
    rough = local_contrast(scene.image) >= CONTRAST
    parts = {"": scene.known, "_textured": scene.known & rough, "_textureless": scene.known & ~rough}
    pair = inverse_depth, scene.inverse_depth
    scores = {f"depth{name}": float(rmse(*pair, part)) for name, part in parts.items()}
    blank = parts["_textureless"]
    bias = (inverse_depth - scene.inverse_depth)[blank].mean()  # NaN where nothing is textureless
    return {**scores, "depth_bias_textureless": float(bias)}


def surest_error(scene: BenchScene, inverse_depth: Tensor, deviation: Tensor) -> float:
    """Return the RMSE of depth, in parts of the range, over the 70 % of known pixels of least deviation."""
    return float(sparsification_curve(inverse_depth, deviation, scene.inverse_depth, scene.known, shares=(SURE,)))


def local_contrast(image: Tensor) -> Tensor:
    """Return the standard deviation of the luma of an sRGB image in squares of 9 pixels, (1, 1, H, W)."""
    luma = rgb_to_y(image.double())
    mean = box_blur(luma, NEIGHBOURHOOD)
    return (box_blur((luma - luma.mean()).square(), NEIGHBOURHOOD) - (mean - luma.mean()).square()).clamp(min=0).sqrt()


@cache
def perceptual_distance() -> Callable[[Tensor, Tensor], Tensor] | None:
    """Return LPIPS (Zhang et al., CVPR 2018, AlexNet) of torchmetrics; None where its weights would be downloaded."""
    weights = Path(torch.hub.get_dir()) / "checkpoints" / PERCEPTUAL_WEIGHTS
    if not weights.is_file() or any(importlib.util.find_spec(name) is None for name in ("torchvision", "torchmetrics")):
        return None
    from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

    return LearnedPerceptualImagePatchSimilarity("alex", normalize=True).eval()


# ---------------------------------------------------------------------- depth without a capture


def best_ramp(scenes: Sequence[BenchScene]) -> tuple[float, float]:
    """Return the depth at the top and the bottom edge of the vertical ramp with the least squared error over scenes.

    Scenes weigh the same; only pixels of known depth count.
    """
    normal, moment = torch.zeros(2, 2, dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
    for scene in scenes:
        known = scene.known[0, 0]
        if known.any():
            below = _height_in(known)[known]
            basis = torch.stack([1 - below, below])
            normal += basis @ basis.T / len(below)
            moment += basis @ scene.inverse_depth[0, 0][known].double() / len(below)
    top, bottom = torch.linalg.lstsq(normal, moment[:, None]).solution[:, 0].tolist()
    return top, bottom


def ramp(scene: BenchScene, top: float, bottom: float) -> Tensor:
    """Return a depth map that changes linearly from the top to the bottom of a scene."""
    below = _height_in(scene.known[0, 0])
    return (top + (bottom - top) * below).float()[None, None]


def constant(scene: BenchScene) -> Tensor:
    """Return the mean depth of a scene everywhere."""
    return scene.inverse_depth[scene.known].mean().expand_as(scene.inverse_depth)


def _height_in(plane: Tensor) -> Tensor:
    """Return the place of each pixel between the first row, 0, and the last one, 1."""
    rows, columns = plane.shape
    return torch.linspace(0, 1, rows, dtype=torch.float64)[:, None].expand(rows, columns)
