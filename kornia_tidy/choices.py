"""Names that settings choose from, without their objects: torch is not imported, so that ``--help`` comes at once."""

from __future__ import annotations

from typing import Annotated

from kornia_tidy.fidelity import PRESETS
from kornia_tidy.settings import one_of

TASKS = ("edof", "depth", "joint")
COMPOSITING = ("gather", "scatter", "occlusion")
BORDERS = ("reflect", "replicate", "zero", "circular", "valid")
STRAY_LIGHT = ("renormalize", "veil", "discard")
COLOR_SPACES = ("srgb", "linear", "paper")
HOLES = ("error", "fill")  # how a camera and its adapters treat holes
STARTS = (
    "noise", "fisher, noise", "noisy fishers", "fisher, noisy fishers", "3 fishers, 2 noisy", "like fishers",
    "focal sweep", "flat",
)  # fmt: skip
MASK_FAMILIES = ("pixelwise", "fourier", "zernike", "radial", "spiral", "cubic", "none")
INVERSES = ("tikhonov", "wiener")
SYSTEMS = (
    "tidy-5", "tidy-1", "fresnel", "phasecam3d", "ikoma2021", "chang2019", "liu2022-pixelwise", "liu2022-spiral",
    "sitzmann2018",
)  # fmt: skip
LENSES = ("double-gauss-50mm", "triplet-50mm", "single-50mm", "phone-5.5mm")
SPLITS = ("train", "validation", "test", "all")
BESIDE = ("image", "depth", "mask")  # of a coded image
BETWEEN = ("random", "linear", "exponential")  # two masks, the phase while a modulator switches
MATERIALS = ("constant", "fused-silica", "pmma", "pdms", "noa61")
FLIPS, ROTATIONS = ("none", "left-right", "up-down"), (0, 90, 180, 270)
ORIENTATIONS = (1, 2, 4, 8)
KNOBS = (
    "preset", "layers", "layer_spacing", "pixel_tolerance", "window", "enclosed_energy", "stray_light", "double",
    "plan",
)  # fmt: skip
DEMOSAIC = (
    "bilinear", "half", "libraw_linear", "libraw_vng", "libraw_ppg", "libraw_ahd", "libraw_dcb", "libraw_dht",
    "libraw_markesteijn",
)  # fmt: skip
WHITE_BALANCES = ("as shot", "daylight", "auto", "none")
HIGHLIGHTS = ("clip", "keep")
PRETRAINED = ("joint-uncertain", "edof-5", "edof-designed", "edof-flat")
"""Shipped systems: task and number of masks. ``"edof-5"`` has the paper's lens of f/17.6. The
networks of ``"edof-designed"``, five masks of 92 x 92 pixels at f/22, and of ``"edof-flat"``, none at f/48, know light
of 500 to 57,000 electrons of white at f/17.6 in the same exposure time. ``"joint-uncertain"`` has five masks at f/28.5,
designed for image and depth, and a network that begins with the closed form: it returns a distribution of depth, so
that it tells how sure it is."""
REPLACED = {
    "joint-5": "joint-uncertain",
    "joint-1": "joint-uncertain",
    "joint-0": "joint-uncertain",
    "edof-1": "any-camera",
    "edof-0": "edof-flat",
}
"""Systems of earlier versions, and what took the place of each."""

Preset = Annotated[str, one_of(PRESETS)]
Compositing = Annotated[str, one_of(COMPOSITING)]
Border = Annotated[str, one_of(BORDERS)]
StrayLight = Annotated[str, one_of(STRAY_LIGHT)]
ColorSpace = Annotated[str, one_of(COLOR_SPACES)]
Start = Annotated[str, one_of(STARTS)]
Inverse = Annotated[str, one_of(INVERSES)]
