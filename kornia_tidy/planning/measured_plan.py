"""Plan of a capture through measured PSFs: they are given, so that there is nothing to approximate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from kornia_tidy.checks import check_positive
from kornia_tidy.planning.render_plan import RenderPlan
from kornia_tidy.planning.rendering_cost import count_work, label_pixels, rendering_bytes, rendering_seconds
from kornia_tidy.render.borders import pad_border


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
                f"  costs: some {self.seconds:.2g} s, and {self.memory_bytes / 2**20:.0f} MiB",
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
    check_positive("tolerance", tolerance)
    model, (batch, channels) = optics.psf_model, images
    nodes, window, threads = model.defocus_nodes, model.window, torch.get_num_threads()
    labels = label_pixels(_seen(optics, defocus, window // 2), batch, nodes, "linear")
    work = count_work(labels, len(nodes), window, optics.compositing)
    fidelity = optics.fidelity.replace(layers="linear", window=window)
    seconds = rendering_seconds(work, channels, double=fidelity.double, threads=threads)
    return MeasuredPlan(
        fidelity=fidelity,
        reference=fidelity,
        tolerance=tolerance,
        predicted_error=0.0,
        seconds=seconds,
        memory_bytes=rendering_bytes(work, channels, double=fidelity.double, threads=threads),
        reference_seconds=seconds,
        layers_present=work.layers,
        layers_total=len(nodes),
        states=1,
        wavelengths=channels,
        wavelengths_total=channels,
        light_held=model.fitted.held,
        reference_error=0.0,
        error_parts=(),
    )


def _seen(optics: Any, defocus: Tensor, margin: int) -> Tensor:
    """Return the defocus of the rendered pixels: cropped for the border ``valid``, padded for scatter and occlusion."""
    gathers, border = optics.compositing == "gather", optics.border
    if border == "valid" and optics.compositing != "occlusion":
        height, width = defocus.shape[-2:]
        return defocus[..., margin : height - margin, margin : width - margin]
    return defocus if gathers else pad_border(defocus, margin, "replicate" if border == "zero" else border)
