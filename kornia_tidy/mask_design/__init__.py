"""Mask design: objectives of a mask computed from its PSFs alone, and their minimisation by gradient descent.

A lens or its PSF bank comes in. The Cramér-Rao bound on depth, the error of the best linear restoration, or designed
masks go out. No image and no network is needed. ``non_convexity.py`` shows which averages of PSFs no single mask has.
Read ``objectives.py`` first.
"""

from kornia_tidy.mask_design.fisher_information import crlb
from kornia_tidy.mask_design.non_convexity import autocorrelation_bound
from kornia_tidy.mask_design.objectives import design, restoration_error

__all__ = [
    "autocorrelation_bound",
    "crlb",
    "design",
    "restoration_error",
]
