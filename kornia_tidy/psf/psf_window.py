"""The PSF window: the smallest square that holds as much of the light as a fidelity asks for."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import NamedTuple

from torch import Tensor

from kornia_tidy.fidelity import Fidelity
from kornia_tidy.psf.psf_bank import enclosing_window


class FittedWindow(NamedTuple):
    """A PSF window and the light that it holds.

    Args:
        side: in pixels, odd.
        held: least and largest share of the light in the window, over defocus and colour.
        enough: whether that is as much as the fidelity asks for.
    """

    side: int
    held: tuple[float, float]
    enough: bool = True

    def warn_if_small(self, fidelity: Fidelity, stacklevel: int) -> None:
        """Warn where the largest window allowed does not hold the light that the fidelity asks for."""
        if not self.enough:
            warnings.warn(
                f"the largest PSF window allowed, {self.side} px, holds {self.held[0]:.0%} of the light where it "
                f"should hold {fidelity.enclosed_energy:.0%}; the rest is handled by {fidelity.stray_light!r}: raise "
                f"Fidelity.max_window, lower Fidelity.enclosed_energy, or narrow the camera's depth_range",
                stacklevel=stacklevel,
            )


def fitted_window(psfs: Callable[[int], Tensor], fidelity: Fidelity, fixed: int | None = None) -> FittedWindow:
    """Choose a PSF window, computing PSFs no larger than it takes.

    Args:
        psfs: computes the PSFs to be held in a window of some side, (D, C, P, P).
        fidelity: says which share of the light the window must hold, and its largest side.
        fixed: side in pixels that is only to be measured.

    Example:
        >>> import torch
        >>> fitted_window(lambda side: torch.ones(1, 1, side, side) / 128, Fidelity(enclosed_energy=0.2, max_window=9))
        FittedWindow(side=7, held=(0.3828125, 0.3828125), enough=True)
    """
    size = fixed or min(33, fidelity.max_window)
    while True:
        found = psfs(size)
        window = fixed or enclosing_window(found, fidelity.enclosed_energy)
        if window is not None or size == fidelity.max_window:
            break
        size = min(2 * size - 1, fidelity.max_window)
    margin = (size - (window or size)) // 2
    shares = found[..., margin : size - margin, margin : size - margin].sum((2, 3))
    return FittedWindow(window or size, (float(shares.min()), float(shares.max())), window is not None)
