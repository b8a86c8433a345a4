"""PSF calibration: the PSFs of a camera measured from captures of point sources, and the mask retrieved from them.

Captures of a point at several depths come in. A PSF bank with its uncertainty, or fitted masks, go out. Read
``measured_psfs.py`` first.
"""

from kornia_tidy.lab.calibration.psf.dithering import ResolvedPSF, resolve_psf
from kornia_tidy.lab.calibration.psf.exposures import capture_variance, merge_exposures
from kornia_tidy.lab.calibration.psf.measured_camera import measured_camera
from kornia_tidy.lab.calibration.psf.measured_psfs import MeasuredPSFs, PointReport, diffraction_cutoff, measure_psfs
from kornia_tidy.lab.calibration.psf.phase_retrieval import MaskFit, fit_masks, retrieve_mask
from kornia_tidy.lab.calibration.psf.point_images import PointImage, point_images
from kornia_tidy.lab.calibration.psf.registration import register

__all__ = [
    "MaskFit",
    "MeasuredPSFs",
    "PointImage",
    "PointReport",
    "ResolvedPSF",
    "capture_variance",
    "diffraction_cutoff",
    "fit_masks",
    "measure_psfs",
    "measured_camera",
    "merge_exposures",
    "point_images",
    "register",
    "resolve_psf",
    "retrieve_mask",
]
