"""From the pupil to point spread functions: propagation, interpolation over defocus, the PSF bank and its cache.

Masks, modulator, camera, spectrum and fidelity come in as a PSF model; PSFs at each layer's defocus go out as a bank.
Read ``psf_model.py`` first, from which layers get them; ``psf_cache.py`` remembers them, ``exact.py`` and ``paper.py``
are the two propagations.
"""

from kornia_tidy.psf.exact import exact_psf_bank
from kornia_tidy.psf.field_bank import FieldBank
from kornia_tidy.psf.learnable_aperture import LearnableAperture
from kornia_tidy.psf.paper import AliasingWarning, paper_psf_bank
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.psf.psf_model import PSFModel
from kornia_tidy.psf.pupil import Pupil

__all__ = [
    "AliasingWarning",
    "FieldBank",
    "LearnableAperture",
    "PSFBank",
    "PSFModel",
    "Pupil",
    "exact_psf_bank",
    "paper_psf_bank",
]
