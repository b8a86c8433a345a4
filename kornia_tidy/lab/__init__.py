"""Masks leave the computer: frames for a spatial light modulator, heights for a printer, and back."""

from kornia_tidy.lab.frame_files import SLMFrames, read_slm_frames, write_slm_frames
from kornia_tidy.lab.mask_files import read_heights, write_heights
from kornia_tidy.lab.placement import PanelPlacement
from kornia_tidy.lab.printing import write_stl
from kornia_tidy.lab.timing import FrameTime, frame_times

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
