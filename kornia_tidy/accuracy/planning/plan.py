"""Plan of a scene: measured PSFs have nothing to choose, fast lenses without a mask rays or waves, all others much."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from torch import Tensor

from kornia_tidy.accuracy.costs import rendering_work
from kornia_tidy.accuracy.planning.planner import PlannedScene, Planner
from kornia_tidy.accuracy.planning.render_plan import RenderPlan
from kornia_tidy.accuracy.planning.wide_plan import plan_rays
from kornia_tidy.checks import check_positive
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH
from kornia_tidy.optics.thin_lens import DefocusRange
from kornia_tidy.psf.psf_cache import nodes_around

OF_FIELD = 0.3  # of the tolerance, for PSFs between places of the field
# Root mean square error over that of the light, for a field_tolerance of one; measured .001 to .034, with gather,
# scatter and occlusion, noise and leaves, five masks, one and none, at the corner of a single element.
FIELD_ERROR = 0.035
INDEX, LEAST_CURVED = 1.5, 1.0  # of a single element, and rad that show in PSFs
LEAST_TOLERANCE, MOST_TOLERANCE = 1e-3, 0.3  # of the field


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
    if optics.lens is not None:
        return _through_lens(optics, scene, (defocus.shape[-2], defocus.shape[-1]), tolerance)
    left_out = _lens_left_out(optics, defocus.shape[-2], defocus.shape[-1])
    if (blur := planner.wide_blur) is not None:
        rays = plan_rays(optics, blur, scene, defocus, tolerance)
        if rays.predicted_error <= tolerance or not planner.allows(scene.reference, *defocus.shape[-2:]):
            return replace(rays, left_out=left_out)
    return replace(scene.plan(tolerance), left_out=left_out)


def _lens_left_out(optics: Any, height: int, width: int) -> str:
    r"""Return what a real lens would change in a picture, in words, by the curved field of a single thin element.

    .. math:: \psi(h) = -\frac{\pi}{2 \lambda_0} \left( 2 + \frac{1}{n} \right) \frac{(R h / s')^2}{f}

    Source: Welford, Aberrations of Optical Systems (1986), chapter 12: its medial focus, with the stop at the element.
    """
    camera = optics.camera.lens if isinstance(optics.camera, DefocusRange) else optics.camera
    y, x = optics.field_center
    corner = math.hypot(abs(y) + height / 2, abs(x) + width / 2) * camera.pixel_pitch
    bent = (2 + 1 / INDEX) * (camera.aperture_radius * corner / float(camera.image_distance)) ** 2
    psi = math.pi / (2 * REFERENCE_WAVELENGTH) * bent / camera.focal_length
    if psi < LEAST_CURVED:
        return ""
    return (
        f"a real lens (lens=): in the corner, {corner * 1e3:.2g} mm from the axis, a single element of this aperture "
        f"focuses {psi:.2g} rad nearer, a good lens less"
    )


def _through_lens(optics: Any, scene: PlannedScene, size: tuple[int, int], tolerance: float) -> RenderPlan:
    """Return the plan behind a real lens: that of the axis within a part of the tolerance, and places over the field.

    A place's PSFs count as those of the axis, though they take longer. Occlusion counts as on the axis.
    """
    between = OF_FIELD * tolerance / max(FIELD_ERROR * scene.level, 1e-9)
    between = min(max(between, LEAST_TOLERANCE), MOST_TOLERANCE)
    error = FIELD_ERROR * scene.level * between
    plan = scene.plan(tolerance - error if error < tolerance else tolerance)
    fidelity = plan.fidelity.replace(name=f"planned, tolerance {tolerance:g}", field_tolerance=between)
    field = optics.psf_model.with_fidelity(fidelity).field_of(size, optics.field_center)
    work = scene.work_over_field(plan.fidelity, field)
    return replace(
        plan,
        fidelity=fidelity,
        tolerance=tolerance,
        operations=work.operations,
        reference_operations=scene.work_over_field(plan.reference, field).operations,
        memory_bytes=work.memory,
        error_parts=(*plan.error_parts, ("PSFs between places of the field", error)),
        field=field.nodes,
    )


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
        error_parts=(),
        operations=work.operations,
        reference_operations=work.operations,
        memory_bytes=work.memory,
        layers=(len(nodes_around(nodes, defocus)), len(nodes)),
        window=window,
        wavelengths=(channels, channels),
    )
