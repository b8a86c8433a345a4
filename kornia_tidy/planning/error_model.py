r"""How far one capture of a scene is from another at a different fidelity, told without taking either.

Two captures differ, at a pixel whose defocus is :math:`\psi`, by the image convolved with the difference
:math:`\Delta_\psi` of two PSFs. How much that is depends on where in depth the image has its light. So the light is
told apart by octave j and by bin of defocus b, see :mod:`kornia_tidy.planning.depth_energy`, and within an octave all
of it is taken to have the spectrum :math:`\hat S_j` of the image as a whole, of sum one. Where pixels take light in
(gather)

.. math::
    \mathrm{MSE} = \sum_{j, b} E_{jb} \sum_f \hat S_j(f) \, |\Delta_b(f)|^2

with the power :math:`E_{jb}` of the light within reach of the pixels at b. Where pixels spread their light (scatter),
what those at b and b' spread adds up, or cancels:

.. math::
    \mathrm{MSE} = \sum_{j, b, b'} C_{jbb'} \sum_f \hat S_j(f) \, \mathrm{Re} \, \Delta_b(f) \overline{\Delta_{b'}(f)}

with the products :math:`C_{jbb'}` of the light at b and at b'.

Of layers, every :math:`\Delta_b` is a linear combination of a few PSFs: they are band-limited in :math:`\psi`, so those
at some sixty Chebyshev nodes carry all others, and layers and spacing only change the coefficients. What is left of the
images is the matrix of the products of these with each other, one for each channel and octave. What window, points a
pixel and wavelengths change is known in size, at some depths: differences at two depths are then taken as alike or as
unlike, whichever makes more.

This is an estimate: an octave's light is taken to lie at random within it. The safety factors of
:mod:`kornia_tidy.planning.planner` stand for what that leaves out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kornia_tidy.planning.scene_light import SceneLight, interpolation
from kornia_tidy.psf.defocus_interpolation import TAPS, fine_layer_matrix, fine_nodes, guarded
from kornia_tidy.render.layers import assign_layers

_NEGLIGIBLE = 1e-3  # of an octave's power: the frequencies that have least of it do not count


def chebyshev_nodes(lo: float, hi: float, count: int) -> Tensor:
    """Return the Chebyshev points of the first kind on [lo, hi], ascending, (count,) float64.

    Example:
        >>> chebyshev_nodes(0, 2, 3).round(decimals=3).tolist()
        [0.134, 1.0, 1.866]
    """
    angle = (torch.arange(count, dtype=torch.float64) + 0.5) * (math.pi / count)
    return (lo + hi) / 2 - (hi - lo) / 2 * angle.cos()


def chebyshev_weights(at: Tensor, nodes: Tensor) -> Tensor:
    r"""Return the weights that take values at Chebyshev nodes to other places: rows of Lagrange polynomials.

    Args:
        at: (A,) places within the nodes' range, float64.
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
    r"""Return how many Chebyshev nodes carry a function of defocus with a given bandwidth to about 1e-6.

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
    """Return which PSFs a pixel at some defocus is blurred with, by the layers between which it lies.

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


class LayerErrors:
    """Root mean square differences, on one scene, between captures that differ in their layers.

    Args:
        nodes: Chebyshev nodes that carry the PSFs of the masks, see :func:`nodes_needed`.
        psfs: (n, C, P, P) PSFs there, not normalised.
        light: of the scene.
    """

    def __init__(self, nodes: Tensor, psfs: Tensor, light: SceneLight) -> None:
        self._nodes, self._light = nodes, light
        shapes = light.shapes(psfs.shape[-1])
        self._products = torch.stack([_products(own, shape) for own, shape in zip(psfs.unbind(1), shapes, strict=True)])

    def rows(self, nodes: Sequence[float], layers: str, band: float) -> Tensor:
        """Return the coefficients of what the scene's pixels are blurred with, (b, n)."""
        weights, at = layer_coefficients(self._light.psi, nodes, layers, band)
        return weights @ chebyshev_weights(torch.tensor(at, dtype=torch.float64), self._nodes)

    def own_rows(self) -> Tensor:
        """Return the coefficients of a PSF of its own for each depth, (b, n)."""
        return chebyshev_weights(self._light.psi, self._nodes)

    def __call__(self, ours: Tensor, theirs: Tensor) -> float:
        """Return the difference between captures of these coefficients, full scale 1."""
        difference = ours - theirs
        responses = difference @ self._products  # (C, octaves, b, n)
        alone = (responses * difference).sum(-1)
        squares = [
            ((own @ difference.float()) * responses).sum((1, 2, 3)) if own.ndim == 4 else (own * alone).sum((1, 2))
            for own in self._light.energies
        ]
        return math.sqrt(max(0.0, *(float(each.mean()) for each in squares)))


def _products(psfs: Tensor, shapes: Tensor) -> Tensor:
    """Return the products of PSFs of one channel with each other in each octave, (octaves, n, n).

    In float64: of layers close to each other all but a millionth cancels.
    """
    size = shapes.shape[-2]
    spectra = torch.view_as_real(torch.fft.rfft2(psfs.double(), s=(size, size)).flatten(1))
    products = []
    for weight in shapes.flatten(1):
        ordered = weight.sort(descending=True).values
        counts = weight >= ordered[int((ordered.cumsum(0) < 1 - _NEGLIGIBLE).sum())]
        own = spectra[:, counts]
        products.append((own * weight[counts, None]).flatten(1) @ own.flatten(1).mT)
    return torch.stack(products)


def change_error(nodes: Sequence[float], changes: Tensor, light: SceneLight) -> float:
    """Return the root mean square difference that changes of PSFs make on a scene.

    Args:
        nodes: ascending defocus in radians where the changes are known; in between they are as large as there.
        changes: (len(nodes), C, P, P).
        light: of the scene.
    """
    shapes = light.shapes(changes.shape[-1])
    power = torch.fft.rfft2(changes, s=(shapes.shape[-2],) * 2).abs().square()
    known = (power.double().transpose(0, 1).flatten(2) @ shapes.flatten(2).mT).clamp(min=0)  # (C, nodes, octaves)
    squares = interpolation(light.grid, nodes) @ known
    return math.sqrt(max(light.mean_square(squares.mT)))
