r"""Error model: prediction of the mean square difference between captures at two fidelities, without rendering.

At a pixel with defocus :math:`\psi`, two captures differ by the image convolved with the difference
:math:`\Delta_\psi` of two PSFs. The size of this difference depends on the depths of the image's light. The light is
therefore split by octave j and by bin of defocus b, see :mod:`kornia_tidy.accuracy.depth_energy`. Within an octave it
is assumed to have the spectrum :math:`\hat S_j` of the whole image, normalised to a sum of one. For gather, where each
pixel collects light,

.. math::
    \mathrm{MSE} = \sum_{j, b} E_{jb} \sum_f \hat S_j(f) \, |\Delta_b(f)|^2

with the power :math:`E_{jb}` of the light within reach of the pixels at b. For scatter, where each pixel spreads its
light, the contributions of bins b and b' add up or cancel:

.. math::
    \mathrm{MSE} = \sum_{j, b, b'} C_{jbb'} \sum_f \hat S_j(f) \, \mathrm{Re} \, \Delta_b(f) \overline{\Delta_{b'}(f)}

with the products :math:`C_{jbb'}` of the light at b and at b'.

The sums over f are computed at some depths of the scene, and the power between them is interpolated. Where bins add up
in amplitude, differences at two depths are assumed equal or independent, whichever gives the larger error.

This is an estimate, which assumes that the light of an octave has random phases. The safety factors of
:mod:`kornia_tidy.accuracy.planning.planner` cover the deviation of real scenes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kornia_tidy.accuracy.scene_light import SceneLight, interpolation
from kornia_tidy.psf.defocus_interpolation import TAPS, fine_layer_matrix, fine_nodes, guarded
from kornia_tidy.render.scene import assign_layers


def layer_coefficients(psi: Tensor, nodes: Sequence[float], layers: str, band: float) -> tuple[Tensor, Sequence[float]]:
    """Return the interpolation weights of the layers' PSFs for pixels at some defocus.

    Args:
        psi: (b,) defocus in radians.
        nodes: of the layers, evenly spaced.
        layers: their kind.
        band: highest frequency of a PSF along defocus, for ``"bandlimited"``.

    Returns:
        (b, n) weights and the defocus of the n PSFs, which for cubic and band-limited layers go beyond the nodes.

    Example:
        >>> weights, at = layer_coefficients(torch.tensor([0.5]), (0.0, 2.0, 4.0), "linear", 1.2)
        >>> weights.tolist(), at
        ([[0.75, 0.25, 0.0]], (0.0, 2.0, 4.0))
    """
    if layers not in TAPS:
        return interpolation(psi, nodes, layers), nodes
    fine, samples, cut = fine_nodes(nodes), guarded(nodes, TAPS[layers] // 2), band if layers == "bandlimited" else None
    pixels, at = psi.double().view(1, 1, 1, -1), torch.tensor(fine, dtype=torch.float64)
    lower, fraction = (each.flatten() for each in assign_layers(pixels, at, "linear"))
    even = samples[0], samples[1] - samples[0], len(samples)
    pairs = [fine_layer_matrix(*even, fine[low : low + 2], cut) for low in lower.tolist()]
    below, above = torch.tensor(pairs, dtype=torch.float64).unbind(1)
    return torch.lerp(below, above, fraction[:, None]), samples


def change_error(nodes: Sequence[float], changes: Tensor, light: SceneLight, *, alternate: bool = False) -> float:
    """Return the root mean square error on a scene from changes of the PSFs.

    Args:
        nodes: ascending defocus in radians at which the changes are given. In between, their power is interpolated.
        changes: (len(nodes), C, P, P).
        light: of the scene.
        alternate: whether the changes of PSFs at similar depths may have opposite signs, as those of layers do.
    """
    shapes = light.shapes(changes.shape[-1])
    known = torch.stack([_power_in_octaves(change, shapes) for change in changes])  # (nodes, C, octaves)
    squares = torch.einsum("bn,ncj->cjb", interpolation(light.psi, nodes), known.clamp(min=0))
    return math.sqrt(max(0.0, *light.mean_square(squares, alternate)))


def _power_in_octaves(change: Tensor, shapes: Tensor) -> Tensor:
    """Return the mean square of light of power one in each octave, (C, octaves), behind a change of PSFs (C, P, P)."""
    power = torch.fft.rfft2(change, s=(shapes.shape[-2],) * 2).abs().square().double()
    return torch.einsum("cuv,cjuv->cj", power, shapes)
