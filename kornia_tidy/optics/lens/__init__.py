"""Real lenses: prescriptions, a sequential ray tracer, and lenses as tables of their wavefronts.

Surfaces and glasses come in as plain data; wavefronts over the stop at any field point, depth and wavelength go out.
Read ``lens.py`` first, then ``joined_rays.py``: which rays a wavefront is made of. The ideal lens that cameras have by
default is ``../thin_lens.py``.
"""

from kornia_tidy.optics.lens.named_lenses import NAMED_LENSES
from kornia_tidy.optics.lens.prescription import Prescription

__all__ = ["NAMED_LENSES", "Prescription"]
