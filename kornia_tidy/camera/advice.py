"""Before a capture: the cheapest fidelity for a scene within an error, and the backend that renders the scene."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from torch import Tensor

from kornia_tidy.camera.samples import compute_dtype, read_sample, survey_defocus
from kornia_tidy.psf.pieces import pieces_of
from kornia_tidy.render.dispatch import Explanation, explain
from kornia_tidy.render.scene import layered_scene

if TYPE_CHECKING:
    from kornia_tidy.planning.render_plan import RenderPlan


def plan_capture(optics: Any, depth: Tensor, image: Tensor | None, tolerance: float) -> RenderPlan:
    """Return the cheapest fidelity for a scene within an error. See :meth:`TiDyOptics.plan`."""
    from kornia_tidy.planning.plan import plan_scene  # noqa: PLC0415 (a capture without a plan does not need it)

    shape = (len(optics.spectrum.weights), *depth.shape[-2:])
    blank = depth.new_zeros(()).expand(*depth.shape[:-3], *shape) if image is None else image
    sample = read_sample(blank, depth, optics)
    if len(sample.image) == 0 or len(sample.depth) == 0:
        found = f"{len(sample.image)} and {len(sample.depth)}"
        raise ValueError(f"a plan needs at least one image and its depth, got {found}")
    light = None if image is None else optics.decode(sample.image.to(sample.dtype))
    defocus = optics.defocus(sample.depth.to(compute_dtype(depth.dtype, optics.fidelity, depth.device)))
    return plan_scene(optics, defocus, light, (len(sample.image), sample.image.shape[1]), tolerance)


def explain_capture(optics: Any, image: Tensor, depth: Tensor) -> Explanation:
    """Return which backend renders a scene, of several pieces the first. See :meth:`TiDyOptics.explain`."""
    sample = read_sample(image, depth, optics)
    if len(sample.image) == 0:
        raise ValueError("an explanation needs at least one image, got a batch of none")
    light = optics.decode(sample.image.to(sample.dtype))
    defocus = optics.defocus(sample.depth.to(sample.dtype))
    reach, (batch, channels, height, width) = survey_defocus([defocus], optics).reach, light.shape
    given = optics.compositing, optics.memory_budget, defocus
    pieces = list(pieces_of(optics.psf_model, channels, sample.dtype, reach, *given))
    if pieces[0].window is not None:
        groups = ", ".join(f"{len(piece.bank().defocus)} on grids of {piece.grid} px" for piece in pieces)
        words = f"gather of {batch} x {channels} channels of {height}x{width} px, layers of wide blur: {groups}"
        return Explanation(words, "grids", {}, {})
    bank, rendering = pieces[0].bank(), optics.rendering(light.device)
    found = explain(
        layered_scene(
            light.repeat(1, bank.psfs.shape[1] // channels, 1, 1),
            defocus,
            bank.defocus,
            bank.psfs,
            bank.veil,
            compositing=rendering.compositing,
            layers=rendering.layers,
            border=rendering.border,
            correlate=rendering.correlate,
        )
    )
    return found if len(pieces) == 1 else replace(found, scene=f"{found.scene}, the first of {len(pieces)} pieces")
