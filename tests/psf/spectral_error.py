"""How many wavelengths are enough: what PSFs lose by fewer."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from kornia_tidy.optics.spectrum import Spectrum
from kornia_tidy.psf.psf_model import PSFModel


@torch.no_grad()
def spectral_error(lens: PSFModel, few: Spectrum, many: Spectrum, defocus: Sequence[float] | None = None) -> float:
    """Return how far a lens's PSFs of some wavelengths are from those of many more.

    Args:
        lens: its masks, camera, window and fidelity count; its own spectrum does not.
        few: wavelengths in question.
        many: wavelengths taken for the truth, with the same channels.
        defocus: nodes in radians. Default: the lens's.

    Returns:
        The sum over pixels of the absolute difference, averaged over nodes and channels; a PSF sums to one. For five
        random masks, the Nikon in D65, the default lens and 61 wavelengths as the truth: 3 are off by 0.100, 7 by
        0.016, 11 by 0.0055, 16 by 0.0016 and 31 by 0.0003; ``Spectrum.rgb()`` by 0.11.

    Example:
        >>> from kornia_tidy import PixelwiseMask
        >>> from kornia_tidy.optics.spectrum import camera_spectrum
        >>> lens = PSFModel(PixelwiseMask(1, initial="flat"))
        >>> few, some, many = (camera_spectrum(samples=n) for n in (2, 6, 18))
        >>> spectral_error(lens, some, many, [-20.0, 0.0]) < spectral_error(lens, few, many, [-20.0, 0.0])
        True
    """
    banks = []
    for spectrum in (few, many):
        fidelity = lens.fidelity.replace(window=lens.window)
        other = lens.replace(spectrum=spectrum, fidelity=fidelity)
        banks.append(other.psf_bank(defocus=defocus).psfs)
    return float((banks[0] - banks[1]).abs().sum((2, 3)).mean())
