"""Plan of a gathered capture through a fast lens without a mask: wide blur by rays, with its error.

The error is that of the PSFs: at depths of the scene, half way between layers, where it is largest, a point of light is
captured and compared with the exact PSF. So it is the error of the lens's own aperture on the scene's own light.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from typing import Any

import torch
from torch import Tensor

from kornia_tidy.accuracy.costs import bank_work, rendering_work
from kornia_tidy.accuracy.error_model import change_error
from kornia_tidy.accuracy.planning.planner import FLOAT32_ERROR, PlannedScene
from kornia_tidy.accuracy.planning.render_plan import RenderPlan
from kornia_tidy.psf.geometric_psf import blur_radius
from kornia_tidy.psf.wide_blur import WideBlur
from kornia_tidy.psf.wide_psfs import held_nodes
from kornia_tidy.render.dispatch import Rendering
from kornia_tidy.render.pieces import pieces_of, render_piece

SAFETY = 1.5  # measured errors are up to 1.2 times the formula
_DEPTHS = 16  # of the scene at which PSFs are compared


@torch.no_grad()
def plan_rays(optics: Any, blur: WideBlur, scene: PlannedScene, defocus: Tensor, tolerance: float) -> RenderPlan:
    """Return the plan of a gathered capture through wide blur, whether or not it is within the tolerance.

    Args:
        optics: a :class:`~kornia_tidy.TiDyOptics`.
        blur: of its lens.
        scene: its light.
        defocus: (B, 1, H, W) radians.
        tolerance: root mean square error allowed, full scale 1.
    """
    planner, fidelity, model = scene.planner, optics.fidelity, optics.psf_model
    error, rounding = _ray_error(optics, blur, scene), FLOAT32_ERROR * scene.level
    held = held_nodes(blur, defocus)
    nodes = {psi for _, own in held for psi in own}
    exact = [psi for psi in nodes if blur_radius(psi, model.pixel_step) < blur.ray_radius]
    images = scene.images, planner.channels
    grids = [(defocus[..., :: group.grid, :: group.grid], group.window, own) for group, own in held]
    works = [rendering_work(at, *images, own, window, border="replicate") for at, window, own in grids]
    spectrum = planner.spectrum_of(fidelity.wavelengths)
    works.append(bank_work(model, spectrum, 1, fidelity.replace(window=blur.window), len(exact)))
    return RenderPlan(
        fidelity=fidelity,
        reference=scene.reference,
        tolerance=tolerance,
        error_parts=((f"geometric optics from {blur.ray_radius:.1f} px of radius on", error), ("float32", rounding)),
        operations=sum(work.operations for work in works),
        reference_operations=scene.operations(scene.reference),
        memory_bytes=min(optics.memory_budget, sum(work.memory for work in works)),
        layers=(len(nodes), len(blur.nodes)),
        window=blur.window,
        wavelengths=(len(spectrum.wavelengths), len(planner.spectrum.wavelengths)),
    )


def _ray_error(optics: Any, blur: WideBlur, scene: PlannedScene) -> float:
    """Return the root mean square error, full scale 1, of a capture through wide blur."""
    nodes, psi = blur.nodes, scene.light.depths(_DEPTHS)
    layers = sorted({min(max(bisect_right(nodes, each), 1), len(nodes) - 1) for each in psi})
    middles = [(nodes[i - 1] + nodes[i]) / 2 for i in layers]
    squares = [change_error(middles, each, scene.light) ** 2 for each in _ray_changes(optics, blur, scene, middles)]
    return SAFETY * math.sqrt(sum(squares) / len(squares))


def _ray_changes(optics: Any, blur: WideBlur, scene: PlannedScene, nodes: list[float]) -> Tensor:
    """Return the changes of PSFs, (places, D, C, P, P), for points at places within a pixel of the coarsest grid."""
    planner, window = scene.planner, blur.window
    places = sorted({0, max(group.grid for group in blur.groups) // 2})
    side = window + places[-1]
    point = torch.zeros(len(places), planner.channels, side, side, dtype=torch.float64)
    for image, place in zip(point, places, strict=True):
        image[:, window // 2 + place, window // 2 + place] = 1
    changes = point.new_zeros(len(places), len(nodes), *point.shape[1:])
    exact = planner.psfs(nodes, window, optics.fidelity.pixel_tolerance, None)
    for i, psi in enumerate(nodes):
        at = torch.full((1, 1, side, side), psi, dtype=torch.float64)
        for piece in pieces_of(optics.psf_model, planner.channels, torch.float64, at):
            changes[:, i] += render_piece(point, at, piece, Rendering("gather", "zero"))
        for own, place in zip(changes[:, i], places, strict=True):
            own[:, place : place + window, place : place + window] -= exact[i]
    return changes
