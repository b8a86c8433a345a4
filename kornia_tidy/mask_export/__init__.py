"""Masks leave the computer: frames for a spatial light modulator, heights for a printer, and back."""

from kornia_tidy.mask_export.frame_files import SLMFrames, read_slm_frames, write_slm_frames
from kornia_tidy.mask_export.mask_files import read_heights, write_heights
from kornia_tidy.mask_export.placement import PanelPlacement
from kornia_tidy.mask_export.printing import write_stl
from kornia_tidy.mask_export.timing import FrameTime, frame_times

__all__ = [
    "FrameTime",
    "PanelPlacement",
    "SLMFrames",
    "frame_times",
    "read_heights",
    "read_slm_frames",
    "write_heights",
    "write_slm_frames",
    "write_stl",
]
