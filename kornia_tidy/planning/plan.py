"""Plan of a scene: measured PSFs have nothing to choose, fast lenses without a mask rays or waves, all others much."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from kornia_tidy.checks import check_positive
from kornia_tidy.planning.costs import rendering_work
from kornia_tidy.planning.planner import Planner
from kornia_tidy.planning.render_plan import RenderPlan
from kornia_tidy.planning.wide_plan import plan_rays
from kornia_tidy.psf.psf_cache import nodes_around


def plan_scene(
    optics: Any, defocus: Tensor, light: Tensor | None, images: tuple[int, int], tolerance: float
) -> RenderPlan:
    """Return the cheapest way to capture a scene within an error.

    Args:
        optics: a :class:`~kornia_tidy.TiDyOptics`.
        defocus: (B, 1, H, W) or (1, 1, H, W) radians.
        light: (B, C, H, W) linear light. Default: a typical photograph.
        images: number of images, and of their channels.
        tolerance: root mean square error allowed, full scale 1.
    """
    check_positive("tolerance", tolerance)
    if optics.psf_model.measured is not None:
        return _measured(optics, defocus, images, tolerance)
    planner = Planner(optics, images[1])
    scene = planner.scene(defocus, light)
    if (blur := planner.wide_blur) is None:
        return scene.plan(tolerance)
    rays = plan_rays(optics, blur, scene, defocus, tolerance)
    exact = rays.predicted_error > tolerance and planner.allows(scene.reference, *defocus.shape[-2:])
    return scene.plan(tolerance) if exact else rays


def _measured(optics: Any, defocus: Tensor, images: tuple[int, int], tolerance: float) -> RenderPlan:
    """Return the plan of a capture through measured PSFs: they are given, and mixed linearly between distances."""
    nodes, window, channels = optics.defocus_nodes, optics.window, images[1]
    fidelity = optics.fidelity.replace(layers="linear", window=window)
    options = {"compositing": optics.compositing, "border": optics.border, "double": fidelity.double}
    work = rendering_work(defocus, *images, nodes, window, **options)
    return RenderPlan(
        fidelity=fidelity,
        reference=fidelity.replace(name="measured PSFs"),
        tolerance=tolerance,
        predicted_error=0.0,
        error_parts=(),
        operations=work.operations,
        reference_operations=work.operations,
        memory_bytes=work.memory,
        layers=(len(nodes_around(nodes, defocus)), len(nodes)),
        window=window,
        wavelengths=(channels, channels),
    )
