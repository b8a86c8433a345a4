r"""Error model: prediction of the mean square difference between captures at two fidelities, without rendering.

At a pixel with defocus :math:`\psi`, two captures differ by the image convolved with the difference
:math:`\Delta_\psi` of two PSFs. The size of this difference depends on the depths of the image's light. The light is
therefore split by octave j and by bin of defocus b, see :mod:`kornia_tidy.planning.depth_energy`. Within an octave it
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

PSFs are band-limited in :math:`\psi`, so those at some sixty Chebyshev nodes give all others by interpolation, and the
kind and spacing of the layers only change the coefficients.

This is an estimate, which assumes that the light of an octave has random phases. The safety factors of
:mod:`kornia_tidy.planning.planner` cover the deviation of real scenes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kornia_tidy.planning.scene_light import SceneLight, interpolation
from kornia_tidy.psf.defocus_interpolation import TAPS, fine_layer_matrix, fine_nodes, guarded
from kornia_tidy.render.layers import assign_layers


def chebyshev_nodes(lo: float, hi: float, count: int) -> Tensor:
    """Return the Chebyshev points of the first kind on [lo, hi], ascending, (count,) float64.

    Example:
        >>> chebyshev_nodes(0, 2, 3).round(decimals=3).tolist()
        [0.134, 1.0, 1.866]
    """
    angle = (torch.arange(count, dtype=torch.float64) + 0.5) * (math.pi / count)
    return (lo + hi) / 2 - (hi - lo) / 2 * angle.cos()


def chebyshev_weights(at: Tensor, nodes: Tensor) -> Tensor:
    r"""Return the weights of polynomial interpolation from Chebyshev nodes to other positions.

    Args:
        at: (A,) positions within the nodes' range, float64.
        nodes: (n,) from :func:`chebyshev_nodes`.

    Returns:
        (A, n); rows add up to one.

    Source: Berrut and Trefethen, Barycentric Lagrange interpolation, SIAM Review 46(3), 501 (2004), equation 5.1.

    Example:
        >>> nodes = chebyshev_nodes(0, 4, 3)
        >>> weights = chebyshev_weights(torch.tensor([1.0, 3.5], dtype=torch.float64), nodes)
        >>> (weights @ nodes**2).round(decimals=6).tolist()
        [1.0, 12.25]
    """
    count = len(nodes)
    angle = (torch.arange(count, dtype=torch.float64) + 0.5) * (math.pi / count)
    barycentric = angle.sin() * (1 - 2 * (torch.arange(count) % 2))
    distance = at[:, None] - nodes
    on_node = distance == 0
    terms = torch.where(on_node.any(1, keepdim=True), on_node, barycentric / torch.where(on_node, 1, distance))
    return terms / terms.sum(1, keepdim=True)


def nodes_needed(half_range: float, bandwidth: float) -> int:
    r"""Return the number of Chebyshev nodes that interpolate a band-limited function of defocus to about 1e-6.

    The Chebyshev coefficients of :math:`e^{i b L t}` are Bessel functions :math:`J_n(b L)`, which vanish beyond
    :math:`n = b L` faster than any exponential.

    Args:
        half_range: L in radians of defocus.
        bandwidth: b, the largest squared radius of the pupil times 530 nm over the shortest wavelength.

    Example:
        >>> nodes_needed(20.0, 1.25)
        43
    """
    order = half_range * bandwidth
    return math.ceil(order + 4 * order ** (1 / 3) + 6)


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
    mode = "nearest" if layers == "nearest" else "linear"
    taken_from = fine_nodes(nodes) if layers in TAPS else tuple(nodes)
    at = torch.tensor(taken_from, dtype=torch.float64)
    lower, fraction = (each.flatten() for each in assign_layers(psi.double().view(1, 1, 1, -1), at, mode))
    weights = torch.zeros(len(psi), len(at), dtype=torch.float64)
    row = torch.arange(len(psi))
    weights[row, lower] = 1 - fraction
    weights[row, (lower + 1).clamp(max=len(at) - 1)] += fraction
    if layers not in TAPS:
        return weights, nodes
    samples = guarded(nodes, TAPS[layers] // 2)
    matrix = fine_layer_matrix(
        samples[0], samples[1] - samples[0], len(samples), taken_from, band if layers == "bandlimited" else None
    )
    return weights @ torch.tensor(matrix, dtype=torch.float64), samples


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
    spectrum = torch.fft.rfft2(change, s=(shapes.shape[-2],) * 2)
    power = (spectrum.real.square() + spectrum.imag.square()).double()
    return torch.einsum("cuv,cjuv->cj", power, shapes)
