"""Camera raw files: decoding in a separate process, tags, colour, demosaicing, and simulated raw files.

A raw file, DNG among them, comes in; ``decoder.py`` reads it, and a capture with its levels and filter array goes out
(``capture.py``, read it first), which ``develop.py`` turns into a picture. ``simulation.py`` goes the other way, and
``dng_writer.py`` writes DNGs.
"""

from kornia_tidy.lab.raw.capture import RawCapture, RawInfo
from kornia_tidy.lab.raw.develop import develop
from kornia_tidy.lab.raw.simulation import simulate_raw, simulate_scene

__all__ = [
    "RawCapture",
    "RawInfo",
    "develop",
    "simulate_raw",
    "simulate_scene",
]
