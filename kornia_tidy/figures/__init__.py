"""Figures drawn with matplotlib: overview, depth maps, PSFs, lenses, systems, estimates, photon transfer."""

from kornia_tidy.figures.depth import depth_at, draw_depth
from kornia_tidy.figures.explained import explain
from kornia_tidy.figures.field import draw_lens
from kornia_tidy.figures.style import require_matplotlib

__all__ = ["depth_at", "draw_depth", "draw_lens", "explain", "require_matplotlib"]
