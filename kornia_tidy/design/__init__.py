"""Mask design: objectives of a mask computed from only its PSFs, their minimisation, and co-design with the aperture.

A lens or its PSF bank comes in. The error of the best linear restoration, that of depth by texture, the Cramér-Rao
bound on a point's depth, or designed masks go out. No image and no network is needed. ``non_convexity.py`` shows which
averages of PSFs no single mask has. Read ``objectives.py`` first; for aperture, focus and masks together, and whether
the masks pay, ``co_design.py``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from kornia_tidy.lazy import importer

if TYPE_CHECKING:
    from kornia_tidy.design.candidates import Candidate
    from kornia_tidy.design.co_design import CoDesign, Effort, co_design, planned_work
    from kornia_tidy.design.depth_confusion import depth_confusion
    from kornia_tidy.design.design_report import design_files
    from kornia_tidy.design.design_task import DesignTask
    from kornia_tidy.design.fisher_information import crlb
    from kornia_tidy.design.non_convexity import autocorrelation_bound
    from kornia_tidy.design.objectives import design, restoration_error
    from kornia_tidy.design.verdict import Finalist, Verdict

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

__getattr__ = importer(__name__)
