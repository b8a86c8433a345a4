"""Plan of a capture through a fast lens without a mask: the approximations of wide blur, with their errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from kornia_tidy.checks import check_positive
from kornia_tidy.planning.bank_cost import bank_operations
from kornia_tidy.planning.candidates import REFERENCE
from kornia_tidy.planning.psf_samples import PSFSamples
from kornia_tidy.planning.render_plan import RenderPlan
from kornia_tidy.psf.geometric_psf import blur_radius
from kornia_tidy.psf.wide_blur import GRID_ERROR, LAYER_ERROR, RAY_TOLERANCE, SCENE_DEVIATION, BlurGroup
from kornia_tidy.psf.wide_psfs import held_nodes

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
        """Describe in words the approximations, their errors and the cost."""
        (_, rays), (_, layers), (_, grids) = self.error_parts
        coarse = sorted({grid for grid, _ in self.groups if grid > 1})
        names = f" and on grids of {', '.join(map(str, coarse))} pixels (error {grids:.1e})" if coarse else ""
        missed = f", above the tolerance of {self.tolerance:g}" if self.predicted_error > self.tolerance else ""
        return "\n".join(
            [
                f"{self.fidelity.name}, wide blur by rays: error {self.predicted_error:.1e} of full scale against "
                f"exact PSFs of every depth{missed}",
                f"  computes: {self.layers_present} of {self.layers_total} layers, spaced by the radius of the defocus "
                f"disc (error {layers:.1e}), convolved on the sensor's pixels{names}",
                f"  approximates: discs of {self.ray_radius:.1f} pixels of radius and more by geometric optics (error "
                f"{rays:.1e}); wide_blur='waves' computes all of them exactly",
                f"  holds: at least {self.light_held[0]:.0%} of the light of every depth, in windows up to "
                f"{self.window} px",
                f"  costs: {self.operations:.2g} operations, and {self.memory_bytes / 2**20:.0f} MiB",
            ]
        )


def plan_wide(optics: Any, defocus: Tensor, light: Tensor | None, tolerance: float) -> WidePlan | None:
    """Return the plan of a gathered capture through wide blur; None for other lenses.

    There is one way to compute it. Where its error is above the tolerance the plan says so, and what is exact.

    Args:
        optics: a :class:`~kornia_tidy.TiDyOptics`.
        defocus: (B, 1, H, W) radians.
        light: (B, C, H, W) linear light. Default: a typical photograph.
        tolerance: largest error allowed, root mean square of full scale.
    """
    model = optics.psf_model
    if optics.compositing != "gather" or (blur := model.wide_blur) is None:
        return None
    contrast = 1.0 if light is None else float(light.double().std(correction=0)) / SCENE_DEVIATION
    check_positive("tolerance", tolerance)
    channels = len(optics.spectrum.weights) if light is None else light.shape[1]
    held: list[tuple[BlurGroup, tuple[float, ...]]] = held_nodes(blur, defocus)
    step, samples = float(model.pixel_step), PSFSamples(optics, channels)
    exact = [psi for _, nodes in held for psi in nodes if blur_radius(psi, step) < blur.ray_radius]
    fidelity = optics.fidelity
    small = fidelity.replace(window=min(blur.window, 2 * int(1.2 * blur.ray_radius + 4) + 1))
    pixels = defocus.numel() * channels
    work = sum(len(nodes) / group.grid**2 for group, nodes in held)
    operations = bank_operations(samples.geometry(small), small, len(exact))
    operations += pixels * (_PIXEL_OPERATIONS + _LAYER_OPERATIONS * work)
    reference = REFERENCE.replace(window=blur.window)
    span = float(defocus.max() - defocus.min()) / reference.layer_spacing
    waves = bank_operations(samples.geometry(reference), reference, max(1, round(span)))
    parts = (("rays", RAY_TOLERANCE), ("layers", LAYER_ERROR), ("grids", GRID_ERROR))
    return WidePlan(
        fidelity=fidelity,
        reference=reference,
        tolerance=tolerance,
        predicted_error=blur.error * contrast,
        operations=operations,
        memory_bytes=min(optics.memory_budget, _BYTES_A_VALUE * pixels),
        reference_operations=max(waves, operations),
        layers_present=len({psi for _, nodes in held for psi in nodes}),
        layers_total=len(blur.nodes),
        states=1,
        wavelengths=len(model.spectrum_of(channels).wavelengths),
        wavelengths_total=len(model.spectrum_of(channels).wavelengths),
        light_held=model.fitted.held,
        reference_error=0.0,
        error_parts=tuple((name, value * contrast) for name, value in parts),
        groups=tuple((group.grid, len(nodes)) for group, nodes in held),
        ray_radius=blur.ray_radius,
        window=blur.window,
    )
