"""Plan of a capture through measured PSFs: they are given, so that there is nothing to approximate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from kornia_tidy.planning.costs import rendering_work
from kornia_tidy.planning.render_plan import RenderPlan
from kornia_tidy.psf.psf_cache import nodes_around


@dataclass(frozen=True)
class MeasuredPlan(RenderPlan):
    """Plan of a capture through measured PSFs. See :class:`RenderPlan`."""

    def __str__(self) -> str:
        """Describe in words what the capture takes, and its cost."""
        window = self.fidelity.window
        return "\n".join(
            [
                f"measured PSFs of {window}x{window} px, mixed linearly between distances: no approximation to choose",
                f"  takes: {self.layers_present} of {self.layers_total} distances, those that the scene has",
                f"  costs: {self.operations:.2g} operations, and {self.memory_bytes / 2**20:.0f} MiB",
            ]
        )


def plan_measured(optics: Any, defocus: Tensor, images: tuple[int, int], tolerance: float) -> MeasuredPlan:
    """Return the plan of a capture through measured PSFs: all of them, linear between distances.

    Args:
        optics: a :class:`~kornia_tidy.TiDyOptics` with measured PSFs.
        defocus: (B or 1, 1, H, W) radians.
        images: number of images, and of their channels.
        tolerance: largest error allowed, root mean square of full scale.
    """
    model, (batch, channels) = optics.psf_model, images
    nodes, window = model.defocus_nodes, model.window
    fidelity = optics.fidelity.replace(layers="linear", window=window)
    options = {"compositing": optics.compositing, "border": optics.border, "double": fidelity.double}
    work = rendering_work(defocus, batch, channels, nodes, window, **options)
    return MeasuredPlan(
        fidelity=fidelity,
        reference=fidelity,
        tolerance=tolerance,
        predicted_error=0.0,
        operations=work.operations,
        memory_bytes=work.memory,
        reference_operations=work.operations,
        layers_present=len(nodes_around(nodes, defocus)),
        layers_total=len(nodes),
        states=1,
        wavelengths=channels,
        wavelengths_total=channels,
        light_held=model.fitted.held,
        reference_error=0.0,
        error_parts=(),
    )
