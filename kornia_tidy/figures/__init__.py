"""Figures drawn with matplotlib: overview of the library, depth maps, PSFs, systems, estimates, photon transfer."""

from kornia_tidy.figures.depth import depth_at, draw_depth
from kornia_tidy.figures.explained import explain
from kornia_tidy.figures.style import require_matplotlib

__all__ = ["depth_at", "draw_depth", "explain", "require_matplotlib"]
