"""Exact PSFs as one operator of torch: a compiled camera computes and remembers them as an eager one does.

A compiler would unfold the sums over masks, wavelengths and depths into a graph of complex operations, which it cannot
fuse, and would compute the PSFs anew for each capture.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from kornia_tidy.kernels.recomputed_ops import define_recomputed
from kornia_tidy.optics.spectrum import Spectrum
from kornia_tidy.psf.exact import exact_psf_bank
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.psf.psf_cache import MEMORY, values_of
from kornia_tidy.psf.pupil import Pupil

_LENS = (
    "Tensor phase, Tensor weights, Tensor amplitude, float cell_pitch, float fill_factor, float light,"
    " float[] wavelengths, float[] channel_weights, float[] basis, float[] dispersion, float[] chromatic_defocus,"
    " float[] defocus, float pixel_step, int window, float tolerance"
)
_TENSORS = 3


def operator_psf_bank(
    phase: Tensor,
    weights: Tensor,
    pupil: Pupil,
    spectrum: Spectrum,
    dispersion: Sequence[float],
    defocus: Sequence[float],
    pixel_step: float,
    window: int,
    tolerance: float,
    chromatic_defocus: Sequence[float],
) -> PSFBank:
    """Return the bank of :func:`kornia_tidy.psf.exact.exact_psf_bank` by the operator ``kornia_tidy::exact_psfs``.

    Args:
        phase: as there. Gradients reach phase and weights; they can be differentiated in turn.
        weights: as there.
        pupil: as there.
        spectrum: as there.
        dispersion: as there.
        defocus: as there.
        pixel_step: as there, a number.
        window: as there.
        tolerance: as there.
        chromatic_defocus: as there.

    Example:
        >>> flat, pupil = torch.zeros(1, 23, 23), Pupil(torch.ones(23, 23), 0.1)
        >>> lens = pupil, Spectrum.monochrome(), [1.0], [0.0], 2e-7, 23, 1e-2, [0.0]
        >>> operator_psf_bank(flat, torch.ones(1), *lens).psfs.shape
        torch.Size([1, 1, 23, 23])
    """
    rows, basis = ([x for row in table for x in row] for table in (spectrum.weights, spectrum.basis or ()))
    light = list(spectrum.wavelengths), rows, basis
    shown = phase, weights, pupil.amplitude, pupil.cell_pitch, pupil.fill_factor, pupil.light
    psfs = torch.ops.kornia_tidy.exact_psfs(
        *shown, *light, list(dispersion), list(chromatic_defocus), list(defocus), pixel_step, window, tolerance
    )
    return PSFBank(psfs, psfs.new_tensor(defocus), psfs.sum((2, 3)))


def _rows(numbers: Sequence[float], columns: int) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(numbers[first : first + columns]) for first in range(0, len(numbers), columns))


def _computed(*arguments: Any) -> Tensor:
    phase, weights, *pupil, waves, rows, basis, dispersion, shifts, nodes, step, window, tolerance = arguments
    spectrum = Spectrum(tuple(waves), _rows(rows, len(waves)), _rows(basis, len(waves)) or None)
    lens = Pupil(*pupil), spectrum, dispersion, nodes, step, window, tolerance
    return exact_psf_bank(phase, weights, *lens, chromatic_defocus=shifts).psfs


def _psfs(*arguments: Any) -> Tensor:
    shown, (*lens, nodes, step, window, tolerance) = arguments[:_TENSORS], arguments[_TENSORS:]
    parts = *(tuple(x) if isinstance(x, list) else x for x in lens), step, window, tolerance, torch.get_num_threads()

    def make(missing: tuple[float, ...]) -> tuple[Tensor]:
        return (_computed(*arguments[:-4], missing, step, window, tolerance),)

    with torch.autocast(arguments[0].device.type, enabled=False):
        return MEMORY.recall(values_of("operator", *shown, *parts), tuple(nodes), make)[0].clone()


def _psfs_fake(*arguments: Any) -> Tensor:
    waves, rows, basis, nodes, window = arguments[6], arguments[7], arguments[8], arguments[-4], arguments[-2]
    planes = len(rows) // len(waves) * (len(basis) // len(waves) if basis else 1)
    return arguments[0].new_empty(len(nodes), planes, window, window)


define_recomputed(
    "exact_psfs", _LENS, _TENSORS, _psfs, _psfs_fake, lambda *given: [(_computed(*given[:-1]), given[-1])], _computed
)
