"""Lens and light: thin lens and defocus, aperture, materials, spectrum, lenses as tables, published systems as data.

Distances, wavelengths and names of materials and cameras come in. Defocus in radians, aperture amplitudes, refractive
indices and channel weights of wavelengths go out. ``quadrature.py`` integrates over pupil cells; ``units.py`` warns of
inputs in a wrong unit. Read ``thin_lens.py`` first, which has the default lens.
"""

from kornia_tidy.optics.aperture import annular_aperture, circular_aperture
from kornia_tidy.optics.lens.lens import Lens, LensRangeWarning
from kornia_tidy.optics.materials import FUSED_SILICA, NOA61, PDMS, PMMA, Material, cauchy_through, constant_index
from kornia_tidy.optics.published_systems import SYSTEMS, System, published_system, systems_table
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH, Spectrum, camera_spectrum
from kornia_tidy.optics.thin_lens import DefocusRange, ThinLensCamera, thin_lens_defocus

__all__ = [
    "FUSED_SILICA",
    "NOA61",
    "PDMS",
    "PMMA",
    "REFERENCE_WAVELENGTH",
    "SYSTEMS",
    "DefocusRange",
    "Lens",
    "LensRangeWarning",
    "Material",
    "Spectrum",
    "System",
    "ThinLensCamera",
    "annular_aperture",
    "camera_spectrum",
    "cauchy_through",
    "circular_aperture",
    "constant_index",
    "published_system",
    "systems_table",
    "thin_lens_defocus",
]
