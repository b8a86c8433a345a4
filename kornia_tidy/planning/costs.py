"""The work and the memory of a capture before it is taken."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from kornia_tidy.fidelity import Fidelity
from kornia_tidy.optics.quadrature import gauss_legendre_order
from kornia_tidy.psf.energies import energy_operations
from kornia_tidy.psf.pupil import Pupil
from kornia_tidy.render.backend import Work
from kornia_tidy.render.dispatch import choose
from kornia_tidy.render.layers import assign_layers
from kornia_tidy.render.scene import scene_of_layers

_points = cache(gauss_legendre_order)


@dataclass(frozen=True)
class BankGeometry:
    """What the cost of a PSF bank depends on, beside the fidelity.

    Args:
        states: masks shown during the exposure, K.
        pupil: the aperture.
        wavelengths: in metres.
        pixel_step: a sensor pixel in the pupil, see :func:`kornia_tidy.psf.exact.exact_psf_bank`.
    """

    states: int
    pupil: Pupil
    wavelengths: tuple[float, ...]
    pixel_step: float

    def samples(self, fidelity: Fidelity) -> list[int]:
        """Return the samples along a side of the field on the sensor, for each wavelength."""
        phases = (2 * math.pi * self.pupil.extent * self.pixel_step / wavelength for wavelength in self.wavelengths)
        return [window_side(fidelity) * _points(phase, fidelity.pixel_tolerance) for phase in phases]


def bank_operations(geometry: BankGeometry, fidelity: Fidelity, layers: int) -> float:
    r"""Return the operations of an exact PSF bank.

    For each layer and wavelength as many as :func:`~kornia_tidy.psf.energies.energy_operations` says, of its two
    ways the one with fewer.

    Example:
        >>> geometry = BankGeometry(5, Pupil(torch.ones(23, 23), 0.1), (530e-9,), 2e-7)
        >>> f"{bank_operations(geometry, Fidelity(window=65), 21):.1e}"
        '3.9e+08'
    """
    cells, window = geometry.pupil.amplitude.shape[-1], window_side(fidelity)
    orders = [side // window for side in geometry.samples(fidelity)]
    ways = [energy_operations(geometry.states, window, order, cells) for order in orders]
    return (2 if fidelity.double else 1) * layers * sum(min(each) for each in ways)


def memory_bytes(geometry: BankGeometry, channels: int, fidelity: Fidelity, layers: int, rendering: int) -> int:
    """Return the peak memory of a capture without gradients beyond the image: of the bank or the renderer, whichever.

    The bank holds its PSFs, and its kernels four times: as remembered, in one piece, and as real matrices.

    Args:
        geometry: of the bank.
        channels: of the image.
        fidelity: its window, points and precision count.
        layers: PSFs held.
        rendering: what the renderer takes, see :func:`rendering_work`.
    """
    real = 8 if fidelity.double else 4
    psfs = real * layers * channels * window_side(fidelity) ** 2
    kernels = 2 * real * layers * max(geometry.samples(fidelity)) * geometry.pupil.amplitude.shape[-1]
    return psfs + max(4 * kernels, rendering)


def window_side(fidelity: Fidelity) -> int:
    """Return the fixed window of a fidelity.

    Raises:
        ValueError: if it has none.
    """
    if fidelity.window is None:
        raise ValueError(f"a fidelity to plan with needs a fixed window, got window=None of {fidelity.name!r}")
    return fidelity.window


def rendering_work(
    defocus: Tensor,
    batch: int,
    channels: int,
    nodes: Sequence[float],
    window: int,
    *,
    layers: str = "linear",
    compositing: str = "gather",
    border: str = "reflect",
    double: bool = False,
) -> Work:
    """Return the work of rendering a scene through a bank, from the layers of its pixels.

    Args:
        defocus: (B or 1, 1, H, W) radians.
        batch: images B.
        channels: of the images.
        nodes: defocus of the layers that are rendered.
        window: side of the PSFs.
        layers: ``"nearest"`` or ``"linear"``.
        compositing: ``"gather"``, ``"scatter"`` or ``"occlusion"``.
        border: what lies beyond the image.
        double: in float64.

    Example:
        >>> flat = torch.zeros(1, 1, 64, 64)
        >>> rendering_work(flat, 1, 3, (-1.0, 0.0, 1.0), 5).operations == 3 * 64**2 * 2 * 2 * 5**2
        True
    """
    dtype = torch.float64 if double else torch.float32
    index, weight = assign_layers(defocus, torch.tensor(nodes, dtype=defocus.dtype, device=defocus.device), layers)
    weight = weight.to(dtype) if layers == "linear" else None
    image = torch.zeros((), dtype=dtype, device=defocus.device).expand(batch, channels, *defocus.shape[-2:])
    psfs = image.new_zeros(()).expand(len(nodes), channels, window, window)
    scene = scene_of_layers(image, index, weight, psfs, None, border, compositing, dtype)
    return choose(scene).work(scene)
