"""What a mask is good for as one number, and searches that lower it, without an image or a network.

A lens comes in; Fisher information about depth, the error of the best linear restoration, or designed masks go out.
Read ``objectives.py`` first.
"""

from kornia_tidy.mask_design.fisher_information import crlb
from kornia_tidy.mask_design.non_convexity import autocorrelation_witness
from kornia_tidy.mask_design.objectives import design, restoration_error

__all__ = [
    "autocorrelation_witness",
    "crlb",
    "design",
    "restoration_error",
]
