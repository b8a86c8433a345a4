"""What a capture costs: time and memory of the PSF bank and of the tiled rendering, by formula.

Occlusion-aware rendering has formulas of its own, see :mod:`kornia_tidy.render.occlusion_cost`.

Seconds are those of one core of a 2.5 GHz Xeon that does nothing else, after constants that were measured there. Other
machines are faster or slower, but what is cheaper here is mostly cheaper there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from kornia_tidy.fidelity import Fidelity
from kornia_tidy.optics.quadrature import gauss_legendre_order
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH
from kornia_tidy.psf.mutual_intensity import goes_in_c
from kornia_tidy.psf.propagation import energy_operations
from kornia_tidy.psf.pupil import Pupil
from kornia_tidy.render.backends.direct import can_go_directly, count_pairs, direct_cost, is_direct_faster
from kornia_tidy.render.backends.tile_plan import BLOCKS, choose_grid, tile_cost, transforms_cost
from kornia_tidy.render.layers import SAMPLE, Labels, assign_layers

BANK_RATE = {False: 52e9, True: 57e9}  # operations a second of a PSF bank in float32, and in float64, counted twice
BANK_RATE_C = {False: 90e9, True: 115e9}  # in C, by the mutual intensity

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

    @property
    def bandwidth(self) -> float:
        """Fastest change of a PSF with defocus: the pupil's largest squared radius, at the shortest wavelength."""
        cells = self.pupil.amplitude.shape[-1]
        edge = ((torch.arange(cells, dtype=torch.float64) - (cells - 1) / 2).abs() + 0.5) * self.pupil.cell_pitch
        squared = (edge[:, None] ** 2 + edge**2)[self.pupil.amplitude.cpu() > 0]
        return float(squared.max()) * REFERENCE_WAVELENGTH / min(self.wavelengths)


def bank_operations(geometry: BankGeometry, fidelity: Fidelity, layers: int) -> float:
    r"""Return the operations of an exact PSF bank.

    For each layer and wavelength as many as :func:`~kornia_tidy.psf.propagation.energy_operations` says, of its two
    ways the one with fewer.

    Example:
        >>> geometry = BankGeometry(5, Pupil(torch.ones(23, 23), 0.1), (530e-9,), 2e-7)
        >>> f"{bank_operations(geometry, Fidelity(window=65), 21):.1e}"
        '3.9e+08'
    """
    return _weight(fidelity) * layers * sum(min(ways) for ways in _operations(geometry, fidelity))


def bank_seconds(geometry: BankGeometry, fidelity: Fidelity, layers: int) -> float:
    """Return the time of an exact PSF bank, see :func:`bank_operations`, on one core of a 2.5 GHz Xeon."""
    in_c = goes_in_c(window_side(fidelity), torch.float64 if fidelity.double else torch.float32)
    products, intensity = BANK_RATE[fidelity.double], (BANK_RATE_C if in_c else BANK_RATE)[fidelity.double]
    each = sum(
        by_intensity / intensity if by_intensity < by_waves else by_waves / products
        for by_waves, by_intensity in _operations(geometry, fidelity)
    )
    return _weight(fidelity) * layers * each


def _operations(geometry: BankGeometry, fidelity: Fidelity) -> list[tuple[int, int]]:
    """Of a layer, for each wavelength: by either way."""
    cells, window = geometry.pupil.amplitude.shape[-1], window_side(fidelity)
    orders = (side // window for side in geometry.samples(fidelity))
    return [energy_operations(geometry.states, window, order, cells) for order in orders]


@dataclass(frozen=True)
class Tiles:
    """What the tiled renderer does for a scene.

    See :mod:`kornia_tidy.render.backends.tile_plan` and :mod:`kornia_tidy.render.backends.direct`.

    Args:
        size: side of the tiles' windows in pixels.
        blocks: pieces that the scene is cut into.
        pairs: blocks times the layers present in each.
        layers: layers present in the scene.
        pixels: of the output in one channel, over the batch.
        terms: layers that a pixel takes light from: 1 or 2.
        strips: pairs of a strip and a layer, in float32, where the scene can be convolved directly.
    """

    size: int
    blocks: int
    pairs: int
    layers: int
    pixels: int
    terms: int
    strips: int | None = None


def label_pixels(defocus: Tensor, batch: int, nodes: Sequence[float], mode: str) -> Labels:
    """Return the layers of each pixel, as the renderer finds them.

    Args:
        defocus: (B or 1, 1, H, W) radians.
        batch: images B.
        nodes: defocus of the layers that are rendered.
        mode: ``"nearest"`` or ``"linear"``.
    """
    lower, fraction = assign_layers(defocus, torch.tensor(nodes, dtype=defocus.dtype, device=defocus.device), mode)
    lower, fraction = (x[:, 0].expand(batch, -1, -1) for x in (lower, fraction))
    return Labels.of(lower, None if mode == "nearest" else fraction)


def count_tiles(labels: Labels, layers: int, window: int, *, gathers: bool = True) -> Tiles:
    """Cut up a scene as the renderer will, and count. Only every eighth row and column is looked at.

    Args:
        labels: from :func:`label_pixels`.
        layers: how many there are.
        window: side of the PSFs.
        gathers: pixels take light, which may go directly, and do not spread it.

    Example:
        >>> flat = label_pixels(torch.zeros(1, 1, 64, 64), 1, (-1.0, 0.0, 1.0), "linear")
        >>> count_tiles(flat, 3, 9).layers
        1
    """
    grid, sample = choose_grid(labels, layers, window), labels.every(SAMPLE)
    here = grid.present(sample, layers, SAMPLE)
    pairs, present = int(here.sum()), int(here.any(0).sum())
    directly = gathers and can_go_directly(labels, torch.float32)
    strips = count_pairs(labels, torch.float32) if directly else None
    terms = 1 if labels.layer_weight is None else 2
    return Tiles(grid.size, len(here), pairs, present, labels.layer_index.numel(), terms, strips)


def rendering_seconds(tiles: Tiles, channels: int, fidelity: Fidelity) -> float:
    """Return the time of the tiled renderer on one core of a 2.5 GHz Xeon, by transforms or directly.

    It is what the renderer itself chooses by: :func:`kornia_tidy.render.backends.tile_plan.transforms_cost`, with the
    spectra of the PSFs, or :func:`kornia_tidy.render.backends.direct.direct_cost`.

    Example:
        >>> f"{rendering_seconds(Tiles(128, 100, 400, 21, 2**20, 2), 3, Fidelity(window=23)):.1g}"
        '0.1'
    """
    direct, transforms = _nanoseconds(tiles, fidelity)
    faster = transforms if direct is None else min(direct, transforms)
    return _weight(fidelity) * channels * faster * 1e-9


def _nanoseconds(tiles: Tiles, fidelity: Fidelity) -> tuple[float | None, float]:
    """Of a channel in float32, directly, if it can be, and by transforms."""
    windows = tile_cost(tiles.size, tiles.blocks, tiles.pairs) + tile_cost(tiles.size, 0, tiles.layers)
    direct = None if tiles.strips is None else direct_cost(tiles.strips, window_side(fidelity))
    return direct, transforms_cost(windows, tiles.pixels, tiles.terms)


def memory_bytes(geometry: BankGeometry, channels: int, fidelity: Fidelity, layers: int, rendering: int) -> int:
    """Return the peak memory of a capture without gradients beyond the image: of the bank or the renderer, whichever.

    The bank holds its PSFs, and its kernels four times: as remembered, in one piece, and as real matrices.

    Args:
        geometry: of the bank.
        channels: of the image.
        fidelity: its window, points and precision count.
        layers: PSFs held.
        rendering: what the renderer takes, see :func:`rendering_bytes`; where layers hide one another,
            :func:`kornia_tidy.render.occlusion_cost.windows_bytes`.
    """
    real = 4 * _weight(fidelity)
    psfs = real * layers * channels * window_side(fidelity) ** 2
    kernels = 2 * real * layers * max(geometry.samples(fidelity)) * geometry.pupil.amplitude.shape[-1]
    return psfs + max(4 * kernels, rendering)


def rendering_bytes(tiles: Tiles, channels: int, fidelity: Fidelity) -> int:
    """Return what the renderer takes: spectra, the planes of a chunk of tiles in one channel, labels and sums.

    Directly it takes a padded image, labels and what it returns.
    """
    real = 4 * _weight(fidelity)
    direct, transforms = _nanoseconds(tiles, fidelity)
    if direct is not None and is_direct_faster(direct, transforms):
        return tiles.pixels * (2 * channels * real + 2 * 8)
    plane = 2 * real * tiles.size**2
    chunk = 3 * max(BLOCKS.chunk_bytes, plane * math.ceil(tiles.pairs / tiles.blocks))
    return 2 * tiles.layers * channels * plane + chunk + tiles.pixels * (4 * channels * real + 2 * 8)


def _weight(fidelity: Fidelity) -> int:
    return 2 if fidelity.double else 1


def window_side(fidelity: Fidelity) -> int:
    """Return the fixed window of a fidelity.

    Raises:
        ValueError: if it has none.
    """
    if fidelity.window is None:
        raise ValueError(f"a fidelity to plan with needs a fixed window, got window=None of {fidelity.name!r}")
    return fidelity.window
