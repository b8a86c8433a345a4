"""Mask design: objectives of a mask computed from its PSFs alone, their minimisation, and co-design with the aperture.

A lens or its PSF bank comes in. The error of the best linear restoration, that of depth by texture, the Cramér-Rao
bound on a point's depth, or designed masks go out. No image and no network is needed. ``non_convexity.py`` shows which
averages of PSFs no single mask has. Read ``objectives.py`` first; for aperture, focus and masks together, and whether
the masks pay, ``co_design.py``.
"""

from kornia_tidy.mask_design.candidates import Candidate
from kornia_tidy.mask_design.co_design import CoDesign, Effort, co_design, planned_work
from kornia_tidy.mask_design.depth_confusion import depth_confusion
from kornia_tidy.mask_design.design_report import design_files
from kornia_tidy.mask_design.design_task import DesignTask
from kornia_tidy.mask_design.fisher_information import crlb
from kornia_tidy.mask_design.non_convexity import autocorrelation_bound
from kornia_tidy.mask_design.objectives import design, restoration_error
from kornia_tidy.mask_design.verdict import Finalist, Verdict

__all__ = [
    "Candidate",
    "CoDesign",
    "DesignTask",
    "Effort",
    "Finalist",
    "Verdict",
    "autocorrelation_bound",
    "co_design",
    "crlb",
    "depth_confusion",
    "design",
    "design_files",
    "planned_work",
    "restoration_error",
]
