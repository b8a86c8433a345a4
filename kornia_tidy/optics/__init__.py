"""Lens and light: thin lens and defocus, aperture, materials, spectrum.

Distances, wavelengths and colours come in; defocus in radians, apertures, refractive indices and weights of wavelengths
go out. Read ``thin_lens.py`` first.
"""

from kornia_tidy.optics.aperture import annular_aperture, circular_aperture, polygon_aperture
from kornia_tidy.optics.materials import FUSED_SILICA, NOA61, PDMS, PMMA, Material, cauchy_through, constant_index
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH, Spectrum, camera_spectrum
from kornia_tidy.optics.thin_lens import DefocusRange, ThinLensCamera, thin_lens_defocus

__all__ = [
    "FUSED_SILICA",
    "NOA61",
    "PDMS",
    "PMMA",
    "REFERENCE_WAVELENGTH",
    "DefocusRange",
    "Material",
    "Spectrum",
    "ThinLensCamera",
    "annular_aperture",
    "camera_spectrum",
    "cauchy_through",
    "circular_aperture",
    "constant_index",
    "polygon_aperture",
    "thin_lens_defocus",
]
