r"""How far one capture of a scene is from another at a different fidelity, told without taking either.

A pixel at defocus :math:`\psi` of two captures differs by the image convolved with the difference of two PSFs. Over an
image with the power spectrum S that makes a mean square of

.. math:: \mathrm{MSE} = \sum_\psi p(\psi) \sum_f S(f) \, |\Delta H_\psi(f)|^2

Every PSF in it is a linear combination of a few: PSFs are band-limited in :math:`\psi`, so those at some forty
Chebyshev nodes carry all others, and layers, spacing and window only change the coefficients. What is left of the
images is the matrix of the products of these forty with each other, one for each window and channel.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from kornia_tidy.fidelity import Fidelity
from kornia_tidy.optics.psf_bank import PSFBank
from kornia_tidy.scene.convolution import next_fast_size, pad_border
from kornia_tidy.scene.layers import layer_weights

CONTRAST = 0.3  # standard deviation of the light of an image not given, full scale 1: photographs have 0.13 to 0.35
GRID_RATIO = 1.5  # side of the grid of frequencies over the window
_BLOCK = 1024  # px; larger images are looked at block by block
_BINS = 256  # of the histogram of defocus
_REGIONS = 8  # of defocus, whose outlines scatter makes visible


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


def spectrum_size(window: int) -> int:
    """Return the side of the grid that PSFs of a window are compared on: half as much again keeps tails apart."""
    return next_fast_size(math.ceil(GRID_RATIO * window))


def power_spectrum(light: Tensor, border: str, size: int) -> Tensor:
    r"""Return the power spectrum of images, such that its sum times a filter's power is the mean square it leaves.

    Args:
        light: (B, C, H, W).
        border: what lies beyond the image, see :mod:`kornia_tidy.scene.convolution`. Made-up light counts too.
        size: side N of the frequency grid.

    Returns:
        (C, N, N // 2 + 1) float64 for the half spectrum, without the mean: PSFs that sum to one leave it alone.

    Example:
        >>> image = torch.rand(1, 1, 40, 40, dtype=torch.float64)
        >>> power = power_spectrum(image, "circular", 40)
        >>> bool(torch.isclose(power.sum(), image.var(correction=0)))
        True
    """
    if border == "replicate":  # edges drawn out into streaks are coarser than the image, mirrored or not: take either
        drawn_out = pad_border(light, int(size / GRID_RATIO) // 2, "replicate")
        return torch.maximum(*(power_spectrum(plane, "reflect", size) for plane in (light, drawn_out)))
    total, pixels = torch.zeros((), dtype=torch.float64), 0
    for top in range(0, light.shape[-2], _BLOCK):
        for left in range(0, light.shape[-1], _BLOCK):
            block = light[..., top : top + _BLOCK, left : left + _BLOCK]
            total = total + _covariance(_endless(block, border, size), size) * block[0, 0].numel()
            pixels += block[0, 0].numel()
    power = torch.fft.rfft2(total / pixels).real / size**2
    return _half_plane(power, size)


def natural_power(channels: int, size: int) -> Tensor:
    """Return the power spectrum of a typical photograph: 1 / f**2, with the standard deviation ``CONTRAST``.

    Source: Field, Relations between the statistics of natural images and the response properties of cortical cells,
    J. Opt. Soc. Am. A 4(12), 2379 (1987).

    Example:
        >>> round(float(natural_power(1, 64).sum().sqrt()), 6) == CONTRAST
        True
    """
    down, across = torch.fft.fftfreq(size, dtype=torch.float64), torch.fft.rfftfreq(size, dtype=torch.float64)
    squared = down[:, None] ** 2 + across**2
    squared[0, 0] = math.inf
    power = _half_plane(1 / squared[None], size)
    return (power * (CONTRAST**2 / power.sum())).expand(channels, -1, -1)


def region_power(light: Tensor, defocus: Tensor, border: str, size: int) -> Tensor:
    """Return the summed power spectra of an image's regions of like defocus, each cut out on black.

    Scatter blurs each region alone, so their outlines count, which gather does not see.

    Args:
        light: (B, C, H, W).
        defocus: (B, 1, H, W) or (1, 1, H, W) radians.
        border: as for :func:`power_spectrum`.
        size: side N of the frequency grid.
    """
    levels = np.quantile(defocus.double().cpu().numpy(), np.arange(1, _REGIONS) / _REGIONS)
    region = torch.bucketize(defocus, torch.as_tensor(levels).to(defocus).unique())
    regions = (light * (region == index) for index in range(int(region.max()) + 1))
    return torch.stack([power_spectrum(part, border, size) for part in regions]).sum(0)


def defocus_histogram(defocus: Tensor, lo: float, hi: float) -> tuple[Tensor, Tensor]:
    """Return the mean defocus of each bin that is not empty, and the share of the pixels in it, float64.

    Example:
        >>> defocus_histogram(torch.tensor([-30.0, 5.0, 5.0, 7.0]), -20, 20)
        (tensor([-20.,   5.,   7.], dtype=torch.float64), tensor([0.2500, 0.5000, 0.2500], dtype=torch.float64))
    """
    psi = defocus.detach().double().flatten().cpu().clamp(lo, hi)
    low, high = float(psi.min()), float(psi.max())
    index = ((psi - low) * (_BINS / max(high - low, 1e-9))).long().clamp(max=_BINS - 1)
    count = torch.bincount(index, minlength=_BINS).double()
    mean = torch.bincount(index, psi, minlength=_BINS) / count.clamp(min=1)
    return mean[count > 0], count[count > 0] / len(psi)


class PSFSurvey:
    """The PSFs of masks as they are now, at the nodes that carry all others, and their spectra for any window.

    Args:
        bank: gives the PSFs at some nodes, with the light outside their window left out.
        span: lowest and highest defocus in radians.
        bandwidth: see :func:`nodes_needed`.
    """

    def __init__(
        self, bank: Callable[[tuple[float, ...]], PSFBank], span: tuple[float, float], bandwidth: float
    ) -> None:
        lo, hi = span
        self.nodes = chebyshev_nodes(lo, hi, nodes_needed((hi - lo) / 2, bandwidth))
        self.psfs = bank(tuple(self.nodes.tolist())).psfs.detach().cpu()

    def cropped(self, window: int) -> Tensor:
        """Return the PSFs in a smaller window, (n, C, window, window)."""
        margin = (self.psfs.shape[-1] - window) // 2
        return self.psfs[..., margin : margin + window, margin : margin + window]

    def spectra(self, window: int, size: int) -> Tensor:
        """Return the spectra on a grid of a given side, (C, n, frequencies) complex64."""
        margin = (self.psfs.shape[-1] - window) // 2
        kept = torch.nn.functional.pad(self.cropped(window).float(), (margin,) * 4)  # the centre stays where it was
        return torch.fft.rfft2(kept, s=(size, size)).flatten(2).transpose(0, 1)

    def energy(self, psi: Tensor | tuple[float, ...], window: int) -> Tensor:
        """Return the share of the light in a window at some defocus, (len(psi), C) float64."""
        weights = chebyshev_weights(torch.as_tensor(psi, dtype=torch.float64), self.nodes)
        return weights @ self.cropped(window).double().sum((-2, -1))

    def own_rows(self, psi: Tensor | tuple[float, ...], window: int) -> Tensor:
        """Return the coefficients of the PSFs at some defocus, renormalised in their window, (C, len(psi), n)."""
        weights = chebyshev_weights(torch.as_tensor(psi, dtype=torch.float64), self.nodes)
        energy = self.energy(psi, window).clamp(min=torch.finfo(torch.float32).tiny)
        return weights / energy.T[..., None]

    def rows(self, psi: Tensor, nodes: tuple[float, ...], layers: str, window: int) -> Tensor:
        """Return the coefficients of what pixels take from layers at these nodes, (C, len(psi), n)."""
        at = torch.tensor(nodes, dtype=torch.float64)
        taken = layer_weights(psi.view(1, 1, 1, -1), at, layers)[0, :, 0].T
        return taken @ self.own_rows(nodes, window)


class SceneErrors:
    """Root mean square differences, on one scene, between captures that differ in layers, spacing and window.

    Args:
        survey: the PSFs.
        reference: what captures are compared with; its window is given.
        nodes: gives the nodes of a fidelity.
        psi: (b,) defocus in the scene, and
        share: the share of the pixels at each.
        power: see :func:`power_spectrum`; on the grid of ``spectrum_size(reference.window)``.
    """

    def __init__(
        self,
        survey: PSFSurvey,
        reference: Fidelity,
        nodes: Callable[[Fidelity], tuple[float, ...]],
        psi: Tensor,
        share: Tensor,
        power: Tensor,
    ) -> None:
        self._survey, self._nodes = survey, nodes
        self._psi, self._share = psi, share
        self._power = power
        self._window = int(reference.window or 0)
        self._size = spectrum_size(self._window)
        self._spectra = self._weighted(self._window)
        self._rows = survey.rows(psi, nodes(reference), reference.layers, self._window)
        self._products: dict[int, Tensor] = {}
        self._known: dict[tuple[str, float, int], float] = {}

    def __call__(self, fidelity: Fidelity) -> float:
        """Return the difference that a fidelity's layers, spacing and window make, full scale 1."""
        window = int(fidelity.window or 0)
        key = (fidelity.layers, fidelity.layer_spacing, window)
        if key not in self._known:
            self._known[key] = self._difference(
                self._survey.rows(self._psi, self._nodes(fidelity), fidelity.layers, window), window
            )
        return self._known[key]

    def of_reference(self) -> float:
        """Return the difference between the reference and PSFs of its window computed for each depth alone."""
        return self._difference(self._survey.own_rows(self._psi, self._window), self._window)

    def left_by(self, nodes: tuple[float, ...], psfs: Tensor) -> float:
        """Return the difference that changes of PSFs make, known at some defocus: in between, the larger neighbour.

        Args:
            nodes: ascending defocus in radians.
            psfs: the changes there, (len(nodes), C, P, P).
        """
        spectra = torch.fft.rfft2(psfs.double(), s=(self._size, self._size))
        squares = (_power(spectra) * self._power).sum((-2, -1)).mean(1).clamp(min=0)
        above = torch.bucketize(self._psi, torch.tensor(nodes, dtype=torch.float64)).clamp(max=len(nodes) - 1)
        worse = torch.maximum(squares[above], squares[(above - 1).clamp(min=0)])
        return math.sqrt(float(worse @ self._share))

    def _difference(self, rows: Tensor, window: int) -> float:
        difference = rows - self._rows if window == self._window else torch.cat([-self._rows, rows], dim=-1)
        squares = torch.einsum("cbi,cbi,b->c", difference @ self._product(window), difference, self._share)
        return math.sqrt(max(0.0, float(squares.mean())))

    def _weighted(self, window: int) -> Tensor:
        return torch.view_as_real(self._survey.spectra(window, self._size)).double()

    def _product(self, window: int) -> Tensor:
        """Products with each other of the PSFs in the reference's window, if it is another, and in this one."""
        if window not in self._products:
            own = self._spectra if window == self._window else self._weighted(window)
            folded = own * self._power.flatten(1)[:, None, :, None].to(own)
            inner = folded.flatten(2) @ own.flatten(2).mT
            if window == self._window:
                self._products[window] = inner
            else:
                outer, cross = self._product(self._window), folded.flatten(2) @ self._spectra.flatten(2).mT
                self._products[window] = torch.cat([torch.cat([outer, cross.mT], 2), torch.cat([cross, inner], 2)], 1)
        return self._products[window]


def _endless(block: Tensor, border: str, size: int) -> Tensor:
    """Make a block periodic the way its border continues it: mirrored, repeated, or alone in the dark."""
    height, width = block.shape[-2:]
    block = block.double()
    if border == "zero":  # the mean is light at the edge
        return torch.nn.functional.pad(block, (0, size, 0, size)) * math.sqrt(
            (height + size) * (width + size) / (height * width)
        )
    block = block - block.mean((0, 2, 3), keepdim=True)
    if border == "circular":
        return block
    return torch.nn.functional.pad(block, (0, max(0, width - 2), 0, max(0, height - 2)), mode="reflect")


def _covariance(plane: Tensor, size: int) -> Tensor:
    """Return the covariance of a periodic plane with itself at shifts up to half of ``size``, (C, size, size)."""
    height, width = plane.shape[-2:]
    power = _power(torch.fft.rfft2(plane)).mean(0) / (height * width)
    covariance = torch.fft.irfft2(power, s=(height, width)).cpu()
    lags = torch.fft.fftfreq(size, 1 / size).round().long()
    return covariance[:, (lags % height)[:, None], lags % width]


def _power(spectrum: Tensor) -> Tensor:
    return spectrum.real.square() + spectrum.imag.square()


def _half_plane(power: Tensor, size: int) -> Tensor:
    """Let columns that stand for two frequencies count twice, and drop the mean."""
    twice = torch.full((size // 2 + 1,), 2.0, dtype=torch.float64)
    twice[0] = 1
    if size % 2 == 0:
        twice[-1] = 1
    power = power * twice
    power[..., 0, 0] = 0
    return power
