r"""PSFs between the depths they were computed for: the intensity of a PSF is band-limited in defocus.

The field holds :math:`e^{i\psi\rho^2}` with :math:`\rho^2` from 0 to its largest value, so its squared modulus, as a
function of :math:`\psi`, has no frequency above :math:`\Omega = \max\rho^2 \, \lambda_0 / \lambda` radians a radian.
Samples closer than :math:`\pi / \Omega` carry every depth between them. Cubic and band-limited layers find the PSFs of
fine layers from them, which a pixel mixes linearly.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from kornia_tidy.psf.psf_bank import PSFBank

TAPS = {"cubic": 4, "bandlimited": 10}
SHARE_OF_NYQUIST = 0.7  # distance of samples over pi / band up to which ten taps interpolate
FINE_SPACING = 0.35  # radians between interpolated PSFs; between those, linear layers err by less than a thousandth


def defocus_band(max_rho2: float, shortest_wavelength: float, reference_wavelength: float) -> float:
    """Return the highest frequency of a PSF along defocus, in radians per radian at the reference wavelength.

    Example:
        >>> round(math.pi / defocus_band(1.0, 470e-9, 530e-9), 2)  # samples must be closer than this, in radians
        2.79
    """
    return max_rho2 * reference_wavelength / shortest_wavelength


def interpolable_spacing(band: float) -> float:
    """Return the largest distance of samples in radians from which ten taps find every PSF of the band.

    Near the limit of Nyquist, ten taps err by thousandths of full scale, as for masks of one or two pixels a side.

    Example:
        >>> round(interpolable_spacing(defocus_band(1.145, 470e-9, 530e-9)), 2)
        1.7
    """
    return SHARE_OF_NYQUIST * math.pi / band


def fine_nodes(nodes: Sequence[float]) -> tuple[float, ...]:
    """Return nodes over the same range, at most ``FINE_SPACING`` apart, the given nodes included.

    Example:
        >>> fine_nodes((0.0, 0.5, 1.0))
        (0.0, 0.25, 0.5, 0.75, 1.0)
    """
    spacing = (nodes[-1] - nodes[0]) / (len(nodes) - 1)
    step = _fine_step(spacing)
    return tuple(nodes[0] + step * i for i in range(round(spacing / step) * (len(nodes) - 1) + 1))


def _fine_step(spacing: float) -> float:
    return spacing / math.ceil(spacing / FINE_SPACING)


def guarded(nodes: Sequence[float], guards: int) -> tuple[float, ...]:
    """Return evenly spaced nodes with as many more at either end.

    Example:
        >>> guarded((0.0, 1.0), 2)
        (-2.0, -1.0, 0.0, 1.0, 2.0, 3.0)
    """
    spacing = (nodes[-1] - nodes[0]) / (len(nodes) - 1)
    return tuple(nodes[0] + spacing * i for i in range(-guards, len(nodes) + guards))


def interpolation_matrix(
    start: float, spacing: float, count: int, targets: tuple[float, ...], band: float | None
) -> tuple[tuple[float, ...], ...]:
    r"""Return the weights that give PSFs at any defocus from evenly spaced ones.

    Each target uses the taps around it: four by the cubic convolution of Keys, or ten chosen so that every function of
    the band is met with the least mean square error (:math:`w = (G + \epsilon)^{-1} g`, with
    :math:`G_{ij} = \mathrm{sinc}(\Omega(\psi_i - \psi_j)/\pi)`). Weights are scaled to sum to one: white stays white.

    Args:
        start: first sample in radians.
        spacing: distance of the samples in radians.
        count: number of samples; all taps of all targets must lie among them.
        targets: where PSFs are wanted, in radians.
        band: highest frequency from :func:`defocus_band`, or None for the cubic.

    Returns:
        (targets, count) numbers.

    Source: Keys, IEEE Trans. ASSP 29, 1153 (1981); Yen, IRE Trans. Circuit Theory 3, 251 (1956).

    Example:
        >>> interpolation_matrix(0.0, 1.0, 5, (1.0, 1.5), None)
        ((0.0, 1.0, 0.0, 0.0, 0.0), (-0.0625, 0.5625, 0.5625, -0.0625, 0.0))
    """
    taps = TAPS["cubic" if band is None else "bandlimited"]
    position = (np.asarray(targets, dtype=float) - start) / spacing
    first = np.floor(position + 1e-9).astype(int) - (taps // 2 - 1)
    first = np.where(first + taps > count, count - taps, np.maximum(first, 0))
    index = first[:, None] + np.arange(taps)
    away = position[:, None] - index
    if band is None:
        x = np.abs(away)
        weights = np.where(x < 1, 1.5 * x**3 - 2.5 * x**2 + 1, -0.5 * x**3 + 2.5 * x**2 - 4 * x + 2) * (x < 2)
    else:
        scale = band * spacing / math.pi
        gram = np.sinc(scale * (np.arange(taps)[:, None] - np.arange(taps)))
        # The small term keeps float32 round-off of the samples from growing.
        weights = np.linalg.solve(gram + 1e-7 * np.eye(taps), np.sinc(scale * away).T).T
    matrix = np.zeros((len(position), count))
    np.put_along_axis(matrix, index, weights / weights.sum(1, keepdims=True), 1)
    return tuple(map(tuple, matrix.tolist()))


def fine_layer_matrix(
    start: float, spacing: float, count: int, targets: tuple[float, ...], band: float | None
) -> tuple[tuple[float, ...], ...]:
    r"""Return the weights that give the PSFs of fine layers, between which pixels mix linearly, from the computed ones.

    A straight line through two points of a curve lies to one side of it, off by up to :math:`h^2 f'' / 8`. Layers are
    moved back by half of that, :math:`(f(\psi - h) - 2 f(\psi) + f(\psi + h)) / 16`, so that the error between layers
    is as large as that at the layers, with the opposite sign: half the worst error, 0.47 times the root mean square.

    Args:
        start: see :func:`interpolation_matrix`.
        spacing: see there.
        count: see there.
        targets: layers that follow one another, of :func:`fine_nodes`.
        band: see there.

    Returns:
        (targets, count) numbers.

    Example:
        >>> weights = np.array(fine_layer_matrix(0.0, 1.0, 7, (3.0,), None))
        >>> bend = (np.arange(7) - 3) ** 2 / 2  # a second derivative of one
        >>> (weights @ bend).round(6) == round(-(1 / 3) ** 2 / 16, 6)
        array([ True])
    """
    step = _fine_step(spacing)
    around = (targets[0] - step, *targets, targets[-1] + step)
    points = np.array(interpolation_matrix(start, spacing, count, around, band))
    return tuple(map(tuple, (points[1:-1] - np.diff(points, 2, axis=0) / 16).tolist()))


# As torch.compiler.assume_constant_result does, see propagation.py: NumPy is not traced.
setattr(fine_layer_matrix, "_dynamo_marked_constant", True)  # noqa: B010


def interpolated_bank(
    bank: PSFBank, nodes: tuple[float, ...], targets: tuple[float, ...], band: float | None
) -> PSFBank:
    """Return the PSFs of fine layers from those of a bank. See :func:`fine_layer_matrix`.

    Args:
        bank: PSFs before anything is done about stray light.
        nodes: their defocus in radians, evenly spaced.
        targets: defocus of the fine layers in radians, ascending; each needs as many nodes on both sides as the
            interpolation takes.
        band: highest frequency from :func:`defocus_band`, or None for cubic interpolation.

    Returns:
        A bank at the targets; gradients reach the given one.

    Example:
        >>> import torch
        >>> depths = torch.arange(5.0)
        >>> bank = PSFBank(depths.reshape(5, 1, 1, 1) / 10, depths, depths[:, None] / 10)
        >>> interpolated_bank(bank, (0.0, 1.0, 2.0, 3.0, 4.0), (5 / 3, 2.0), None).energy.flatten()
        tensor([0.1667, 0.2000])
    """
    spacing = (nodes[-1] - nodes[0]) / (len(nodes) - 1)
    matrix = fine_layer_matrix(nodes[0], spacing, len(nodes), targets, band)
    psfs = (bank.psfs.new_tensor(matrix) @ bank.psfs.flatten(1)).unflatten(1, bank.psfs.shape[1:])
    return PSFBank(psfs, psfs.new_tensor(targets), psfs.sum((2, 3)))


def not_negative(bank: PSFBank) -> PSFBank:
    """Return interpolated PSFs without what interpolation put below zero, with the same light.

    They are nearer to the truth then, and occlusion divides by sums of their parts. Planes of a basis of spectra may be
    negative.

    Args:
        bank: PSFs that are intensities.

    Example:
        >>> import torch
        >>> psfs = torch.zeros(1, 1, 3, 3)
        >>> psfs[0, 0, 1] = torch.tensor([-0.5, 1.0, 0.5])
        >>> not_negative(PSFBank(psfs, torch.zeros(1), torch.ones(1, 1))).psfs[0, 0, 1]
        tensor([0.0000, 0.6667, 0.3333])
    """
    psfs = bank.psfs.clamp(min=0)
    scale = bank.energy / psfs.sum((2, 3)).clamp(min=1e-30)
    return PSFBank(psfs * scale[..., None, None], bank.defocus, bank.energy)
