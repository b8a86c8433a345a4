"""Light: from phase masks and defocus to point spread functions."""

from kornia_tidy.optics.aperture import annular_aperture, circular_aperture, polygon_aperture
from kornia_tidy.optics.camera import DefocusRange, ThinLensCamera, thin_lens_defocus
from kornia_tidy.optics.exact import exact_psf_bank
from kornia_tidy.optics.initial_masks import fisher_mask, initial_heights
from kornia_tidy.optics.materials import FUSED_SILICA, NOA61, PDMS, PMMA, Material, cauchy_through, constant_index
from kornia_tidy.optics.modulator import DiffractionEfficiency, DwellTimes, LearnableDwellTimes, SpatialLightModulator
from kornia_tidy.optics.paper import AliasingWarning, paper_psf_bank
from kornia_tidy.optics.phase_masks import (
    CubicMask,
    FourierMask,
    FresnelLens,
    PhaseMasks,
    PixelwiseMask,
    RadialMask,
    SpiralMask,
    ZernikeMask,
)
from kornia_tidy.optics.phase_panel import GreyLevels, PixelCrosstalk, StrokeError
from kornia_tidy.optics.psf_bank import PSFBank
from kornia_tidy.optics.pupil import Pupil
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH, Spectrum, camera_spectrum
from kornia_tidy.optics.state_bank import StateBank
from kornia_tidy.optics.switching import Switching
from kornia_tidy.optics.witness import autocorrelation_witness

__all__ = [
    "FUSED_SILICA",
    "NOA61",
    "PDMS",
    "PMMA",
    "REFERENCE_WAVELENGTH",
    "AliasingWarning",
    "CubicMask",
    "DefocusRange",
    "DiffractionEfficiency",
    "DwellTimes",
    "FourierMask",
    "FresnelLens",
    "GreyLevels",
    "LearnableDwellTimes",
    "Material",
    "PSFBank",
    "PhaseMasks",
    "PixelCrosstalk",
    "PixelwiseMask",
    "Pupil",
    "RadialMask",
    "SpatialLightModulator",
    "Spectrum",
    "SpiralMask",
    "StateBank",
    "StrokeError",
    "Switching",
    "ThinLensCamera",
    "ZernikeMask",
    "annular_aperture",
    "autocorrelation_witness",
    "camera_spectrum",
    "cauchy_through",
    "circular_aperture",
    "constant_index",
    "exact_psf_bank",
    "fisher_mask",
    "initial_heights",
    "paper_psf_bank",
    "polygon_aperture",
    "thin_lens_defocus",
]
