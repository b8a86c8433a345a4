"""PSFs of a mask sequence by exact propagation: no depth and no colour at which they alias."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import torch
from torch import Tensor

from kornia_tidy.checks import check_metres
from kornia_tidy.kernels.precision import has_float64
from kornia_tidy.mode import Mode, torch_mode
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH, Spectrum
from kornia_tidy.psf.energies import energy_matrices, intensity_energies, pixel_energies
from kornia_tidy.psf.propagation import sensor_kernels
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.psf.psf_cache import MEMORY
from kornia_tidy.psf.pupil import Pupil, gapped_cells, gapped_pupil_field, pupil_field

Geometry = tuple[int, int, float, float, float]  # window, cells, cell pitch, extent, tolerance
Gaps = tuple[int, float] | None  # cells along a side of a mask pixel and its fill factor, where that is not 1
_STEPS = (1e-15, 1e-4)  # m; the PSF of one pixel of the largest takes a tenth of a second
_MOST_BYTES = 256 << 20  # of matrices on an accelerator


def exact_psf_bank(
    phase: Tensor,
    weights: Tensor,
    pupil: Pupil,
    spectrum: Spectrum,
    dispersion: Sequence[float],
    defocus: Sequence[float],
    pixel_step: float | Tensor,
    window: int,
    tolerance: float = 1e-2,
    chromatic_defocus: Sequence[float] | None = None,
    each_state: bool = False,
    remember: bool = True,
) -> PSFBank:
    r"""Return the PSFs of a mask sequence with every mask pixel and sensor pixel integrated.

    .. math:: h_{dc} = \sum_\lambda s_c(\lambda) \sum_k w_k h_{dk\lambda} \Big/ \sum_\lambda s_c(\lambda)

    Args:
        phase: radians at 530 nm, (K, N, N).
        weights: share of the exposure of each mask, (K,), summing to one.
        pupil: the aperture.
        spectrum: wavelengths and how the channels weight them.
        dispersion: for each wavelength, the factor from phase at 530 nm to phase there.
        defocus: nodes in radians at 530 nm, ascending.
        pixel_step: a sensor pixel in the pupil, pitch * R / image distance, in metres, at most 1e-4; divided by a
            wavelength it is the pixel's side in cycles per pupil radius. May carry gradients.
        window: side P of the PSFs in pixels, odd.
        tolerance: error allowed to the integrals over sensor pixels, see :func:`sensor_kernels`.
        chromatic_defocus: defocus of each wavelength in addition to the nodes', in radians at 530 nm.
            Default: nothing, a lens corrected for colour.
        each_state: return the PSFs of each mask, not their average: (D, K C, P, P), those of a mask follow each other.
        remember: keep the sensor kernels, some hundred KiB for each depth and colour, for the next PSFs of this lens.

    Returns:
        A bank whose PSFs sum to their energy; where the spectrum has a basis, one for each channel and reflectance.

    Raises:
        ValueError: if the step is not a length, as where it is given in cycles.

    Convention:
        - Where ``pupil.fill_factor`` is below 1, the gaps between the squares that modulate are integrated as exactly:
          their light keeps its phase. The matrices then have twice the columns: the bank of the default masks at 41 px
          takes 1.4 times as long, 1.2 times with its gradients (one core).

    Source: design of the matrix transform: Soummer et al. 2007; average over masks: Shah et al. 2023, equation 4.

    Example:
        >>> flat, pupil = torch.zeros(1, 23, 23), Pupil(torch.ones(23, 23), 0.1)
        >>> bank = exact_psf_bank(flat, torch.ones(1), pupil, Spectrum.monochrome(), [1.0], [0.0], 2e-7, 23)
        >>> bank.psfs.shape
        torch.Size([1, 1, 23, 23])
    """
    if not torch_mode():
        step = float(pixel_step.detach()) if isinstance(pixel_step, Tensor) else pixel_step
        check_metres("pixel_step", step, *_STEPS, "pitch * R / image distance, such as 2.1e-7; cycles times wavelength")
    per_channel = spectrum.plane_weights
    cells = pupil.amplitude.shape[-1]
    gaps = None if pupil.fill_factor == 1 else (cells // phase.shape[-1], pupil.fill_factor)
    field = pupil_field if gaps is None else gapped_pupil_field
    shifts = chromatic_defocus or [0.0] * len(spectrum.wavelengths)
    geometry = (window, cells, pupil.cell_pitch, pupil.extent, tolerance)
    dtype = torch.complex128 if phase.dtype == torch.float64 else torch.complex64

    lens, waves = (pixel_step, geometry, gaps, dtype, remember), list(zip(spectrum.wavelengths, shifts, strict=True))

    if phase.device.type != "cpu" and not torch_mode() & Mode.TRACED and isinstance(pixel_step, float):
        columns = cells if gaps is None else 2 * cells
        if len(defocus) * len(spectrum.wavelengths) * window * columns**2 * dtype.itemsize // 2 <= _MOST_BYTES:

            def matrices_of(nodes: tuple[float, ...]) -> tuple[Tensor, ...]:  # made on the CPU
                made = energy_matrices([_kernels(nodes, *wave, *lens, torch.device("cpu")) for wave in waves])
                return tuple(matrix.to(phase.device) for matrix in made)

            left, pixels = MEMORY.recall(("matrices", *waves, *lens, phase.device), tuple(defocus), matrices_of)
            make = _constants_of.__wrapped__ if pupil.amplitude.requires_grad else _constants_of
            scales, amplitude, share = make(pupil, tuple(dispersion), per_channel, phase.device, phase.dtype)
            nodes = _nodes_of(tuple(defocus), phase.device, phase.dtype)
            light = field(phase, amplitude, scales)
            if each_state:  # in the place of more wavelengths
                light, weights = light.transpose(0, 1).flatten(0, 1)[:, None], torch.ones_like(weights[:1])
                left, pixels = (x.repeat(1, len(phase), *[1] * (x.ndim - 2)) for x in (left, pixels))
            energies = intensity_energies(light, weights.to(phase.dtype), left, pixels)
            by_state = energies.unflatten(1, (-1, len(share[0])))
            psfs = torch.einsum("dswyx,cw->dscyx", by_state, share).flatten(1, 2)
            return PSFBank(psfs, nodes, psfs.sum((2, 3)))
    if each_state:
        rest = spectrum, dispersion, defocus, pixel_step, window, tolerance, chromatic_defocus
        one, masks = torch.ones_like(weights[:1]), [slice(k, k + 1) for k in range(len(phase))]
        banks = [exact_psf_bank(phase[k], one, pupil.of_masks(k), *rest, remember=remember) for k in masks]
        psfs, energies = (torch.cat(own, 1) for own in zip(*((b.psfs, b.energy) for b in banks), strict=True))
        return PSFBank(psfs, banks[0].defocus, energies)

    psfs = phase.new_zeros(len(defocus), len(per_channel), window, window)
    for w in range(len(spectrum.wavelengths)):
        kernels = _kernels(defocus, *waves[w], *lens, phase.device)
        light = pixel_energies(field(phase, pupil.amplitude, dispersion[w]), weights, kernels)
        energies = light / pupil.light
        share = phase.new_tensor([channel[w] for channel in per_channel])
        psfs = psfs + energies[:, None] * share[:, None, None]
    return PSFBank(psfs, phase.new_tensor(defocus), psfs.sum((2, 3)))


@lru_cache(maxsize=16)
def _constants_of(
    pupil: Pupil,
    dispersion: tuple[float, ...],
    per_channel: tuple[tuple[float, ...], ...],
    device: torch.device,
    dtype: torch.dtype,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return dispersion, amplitude, and share of the light by channel and wavelength, on an accelerator."""
    with torch.inference_mode(False):
        scales = torch.tensor(dispersion, dtype=torch.float64)[:, None, None, None]
        share = torch.tensor(per_channel, dtype=dtype) / pupil.light
        if has_float64(device):  # otherwise its digits are split on the CPU
            scales = scales.to(device)
        return scales, pupil.amplitude.to(dtype).to(device), share.to(device)


@lru_cache(maxsize=1024)  # a scene's layers are some that follow each other
def _nodes_of(defocus: tuple[float, ...], device: torch.device, dtype: torch.dtype) -> Tensor:
    with torch.inference_mode(False):
        return torch.tensor(defocus, dtype=dtype).to(device)


def _kernels(
    defocus: Sequence[float],
    wavelength: float,
    shift: float,
    pixel_step: float | Tensor,
    geometry: Geometry,
    gaps: Gaps,
    dtype: torch.dtype,
    remember: bool,
    device: torch.device,
) -> Tensor:
    """Return the sensor kernels at a wavelength, remembered where the geometry is fixed."""
    if not has_float64(device):
        step = pixel_step.cpu() if isinstance(pixel_step, Tensor) else pixel_step
        return _kernels(defocus, wavelength, shift, step, geometry, gaps, dtype, remember, torch.device("cpu")).to(
            device
        )
    spans = None if gaps is None else gapped_cells(geometry[1], *gaps)
    at, step = tuple((p + shift) * (REFERENCE_WAVELENGTH / wavelength) for p in defocus), pixel_step / wavelength
    if isinstance(step, Tensor):  # a learnable focus sends its gradient through them
        return sensor_kernels(at, step.double(), *geometry, device, spans).to(dtype)
    if torch_mode() & Mode.TRACED or not remember:
        return sensor_kernels(at, step, *geometry, device, spans).to(dtype)
    key = "kernels", step, geometry, gaps, device, dtype, torch.get_num_threads()
    return MEMORY.recall(key, at, lambda psi: (sensor_kernels(psi, step, *geometry, device, spans).to(dtype),))[0]
