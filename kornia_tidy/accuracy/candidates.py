"""Candidates of a plan: the reference, and its cheaper variants in layers, windows, wavelengths and precision."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from kornia_tidy.fidelity import Fidelity

REFERENCE = Fidelity.preset("reference")
LAYER_SPACINGS = {
    "nearest": (8.0, 4.0, 2.0, 1.0),
    "linear": (8.0, 4.0, 2.0, 1.0, 0.5, 0.25),
    "cubic": (2.0, 1.0),
    "bandlimited": (2.0, 1.0),
}
PIXEL_TOLERANCES = (1e-1, 2e-2, 1e-3, 1e-6)
WINDOW_STRAY_LIGHT = ("veil", "renormalize")  # the better one depends on window and image
RATIO = 1.2  # between successive candidates of the window and of the number of wavelengths


def layer_kinds() -> Iterator[Fidelity]:
    """Yield the reference with each kind and spacing of layers."""
    for layers, spacings in LAYER_SPACINGS.items():
        for spacing in spacings:
            yield replace(REFERENCE, layers=layers, layer_spacing=spacing)


def window_steps(largest: int) -> tuple[int, ...]:
    """Return the candidate window sides, ascending, each about a fifth narrower than the next.

    Example:
        >>> window_steps(41)
        (3, 5, 7, 9, 11, 13, 15, 17, 21, 25, 29, 35, 41)
    """
    windows = [largest]
    while windows[0] > 3:
        windows.insert(0, min(windows[0] - 2, 2 * int(windows[0] / RATIO / 2) + 1))
    return tuple(windows)


def wavelength_steps(fewest: int, all_of_them: int) -> tuple[int, ...]:
    """Return the candidate numbers of wavelengths, ascending, below the number of the spectrum.

    Example:
        >>> wavelength_steps(1, 31)
        (1, 2, 3, 4, 5, 6, 8, 10, 13, 16, 20, 25)
    """
    counts = [all_of_them]
    while counts[0] > fewest:
        counts.insert(0, max(fewest, min(counts[0] - 1, int(counts[0] / RATIO))))
    return tuple(counts[:-1])
