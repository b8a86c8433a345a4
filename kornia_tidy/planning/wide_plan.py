"""Plan of a gathered capture through a fast lens without a mask: wide blur by rays, with its error.

The error is that of the PSFs: at depths of the scene, half way between layers, where it is largest, a point of light is
captured and compared with the exact PSF. So it is the error of the lens's own aperture on the scene's own light.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from kornia_tidy.planning.costs import bank_operations
from kornia_tidy.planning.error_model import change_error
from kornia_tidy.planning.planner import FLOAT32_ERROR, PlannedScene
from kornia_tidy.planning.psf_samples import PSFSamples
from kornia_tidy.planning.render_plan import RenderPlan
from kornia_tidy.psf.geometric_psf import blur_radius
from kornia_tidy.psf.pieces import pieces_of
from kornia_tidy.psf.wide_blur import WideBlur
from kornia_tidy.psf.wide_psfs import held_nodes
from kornia_tidy.render.exposure import Rendering, render_pieces

SAFETY = 1.5  # measured errors are up to 1.2 times the formula
_DEPTHS = 16  # of the scene at which PSFs are compared
# As many as take the time measured: 0.13 to 0.2 s for 3 x 512 x 512 pixels and some 60 layers, at 5e10 a second.
_PIXEL_OPERATIONS = 5000  # of a channel's pixel, for its two layers
_LAYER_OPERATIONS = 100  # of a channel's pixel of the grid, for each layer
_BYTES_A_VALUE = 48


@dataclass(frozen=True)
class WidePlan(RenderPlan):
    """Plan of a capture through wide blur. See :class:`RenderPlan`; the fidelity's window is left open.

    Args:
        groups: grid of each group of layers in sensor pixels, and the number of its layers that the scene holds.
        ray_radius: radius in pixels from which on PSFs are geometric.
        window: side of the largest window in pixels.
    """

    groups: tuple[tuple[int, int], ...] = ()
    ray_radius: float = 0.0
    window: int = 0

    def __str__(self) -> str:
        """Describe in words the approximations, their error and the cost."""
        coarse = sorted({grid for grid, _ in self.groups if grid > 1})
        names = f" and on grids of {', '.join(map(str, coarse))} pixels" if coarse else ""
        missed = f", above the tolerance of {self.tolerance:g}" if self.predicted_error > self.tolerance else ""
        return "\n".join(
            [
                f"{self.fidelity.name}, wide blur by rays: error {self.predicted_error:.1e} of full scale against "
                f"exact PSFs of every depth{missed}",
                f"  computes: {self.layers_present} of {self.layers_total} layers, spaced by the radius of the defocus "
                f"disc, convolved on the sensor's pixels{names}",
                f"  approximates: discs of {self.ray_radius:.1f} pixels of radius and more by geometric optics; "
                f"wide_blur='waves' computes all of them exactly",
                f"  holds: at least {self.light_held[0]:.0%} of the light of every depth, in windows up to "
                f"{self.window} px",
                f"  costs: {self.operations:.2g} operations, and {self.memory_bytes / 2**20:.0f} MiB",
            ]
        )


@torch.no_grad()
def plan_rays(optics: Any, blur: WideBlur, scene: PlannedScene, defocus: Tensor, tolerance: float) -> WidePlan:
    """Return the plan of a gathered capture through wide blur, whether or not it is within the tolerance.

    Args:
        optics: a :class:`~kornia_tidy.TiDyOptics`.
        blur: of its lens.
        scene: its light.
        defocus: (B, 1, H, W) radians.
        tolerance: root mean square error allowed, full scale 1.
    """
    samples, model, fidelity = scene.samples, optics.psf_model, optics.fidelity
    error, rounding = _ray_error(optics, blur, scene), FLOAT32_ERROR * scene.level
    held = held_nodes(blur, defocus)
    exact = [psi for _, nodes in held for psi in nodes if blur_radius(psi, model.pixel_step) < blur.ray_radius]
    geometry, pixels = samples.geometry(fidelity), scene.images * defocus[0].numel() * samples.channels
    operations = bank_operations(geometry, fidelity.replace(window=blur.window), len(exact))
    work = sum(len(nodes) / group.grid**2 for group, nodes in held)
    operations += pixels * (_PIXEL_OPERATIONS + _LAYER_OPERATIONS * work)
    return WidePlan(
        fidelity=fidelity,
        reference=scene.reference,
        tolerance=tolerance,
        predicted_error=error + rounding,
        error_parts=(("rays", error), ("float32", rounding)),
        operations=operations,
        memory_bytes=min(optics.memory_budget, _BYTES_A_VALUE * pixels),
        reference_operations=scene.operations(scene.reference),
        layers_present=len({psi for _, nodes in held for psi in nodes}),
        layers_total=len(blur.nodes),
        states=1,
        wavelengths=len(geometry.wavelengths),
        wavelengths_total=len(samples.spectrum.wavelengths),
        light_held=model.fitted.held,
        reference_error=0.0,
        groups=tuple((group.grid, len(nodes)) for group, nodes in held),
        ray_radius=blur.ray_radius,
        window=blur.window,
    )


def _ray_error(optics: Any, blur: WideBlur, scene: PlannedScene) -> float:
    """Return the root mean square error, full scale 1, of a capture through wide blur."""
    nodes, psi = blur.nodes, scene.light.depths(_DEPTHS)
    layers = sorted({min(max(bisect_right(nodes, each), 1), len(nodes) - 1) for each in psi})
    middles = [(nodes[i - 1] + nodes[i]) / 2 for i in layers]
    squares = [change_error(middles, each, scene.light) ** 2 for each in _ray_changes(optics, blur, scene, middles)]
    return SAFETY * math.sqrt(sum(squares) / len(squares))


def _ray_changes(optics: Any, blur: WideBlur, scene: PlannedScene, nodes: list[float]) -> list[Tensor]:
    """Return the changes of PSFs, (D, C, P, P), for points at two places within a pixel of the coarsest grid."""
    samples: PSFSamples = scene.samples
    places, window, channels = sorted({0, max(group.grid for group in blur.groups) // 2}), blur.window, samples.channels
    side = window + places[-1]
    point = torch.zeros(len(places), channels, side, side, dtype=torch.float64)
    for image, place in zip(point, places, strict=True):
        image[:, window // 2 + place, window // 2 + place] = 1
    changes = point.new_zeros(len(places), len(nodes), channels, side, side)
    exact = samples.psfs(nodes, window, optics.fidelity.pixel_tolerance, None)
    for i, psi in enumerate(nodes):
        at = torch.full((1, 1, side, side), psi, dtype=torch.float64)
        pieces = pieces_of(optics.psf_model, channels, torch.float64, at)
        changes[:, i] = render_pieces(point, at, pieces, Rendering("gather", "zero"))
        for own, place in zip(changes[:, i], places, strict=True):
            own[:, place : place + window, place : place + window] -= exact[i]
    return list(changes)
