"""Mask export: masks as frames for a spatial light modulator (SLM) and as height files.

Phase masks, or heights in metres, come in. Files go out, and can be read back to heights: a folder of SLM frames with a
timing sheet, NPY or safetensors. Read ``slm_frames.py`` first.
"""

from kornia_tidy.lab.mask_export.frame_files import SLMFrames, read_slm_frames, write_slm_frames
from kornia_tidy.lab.mask_export.mask_files import read_heights, write_heights
from kornia_tidy.lab.mask_export.placement import PanelPlacement
from kornia_tidy.lab.mask_export.response_file import read_response
from kornia_tidy.lab.mask_export.timing import FrameTime, frame_times

__all__ = [
    "FrameTime",
    "PanelPlacement",
    "SLMFrames",
    "frame_times",
    "read_heights",
    "read_response",
    "read_slm_frames",
    "write_heights",
    "write_slm_frames",
]
