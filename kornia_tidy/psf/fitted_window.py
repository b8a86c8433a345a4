"""The PSF window: the smallest square that holds as much of the light as a fidelity asks for."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from kornia_tidy.fidelity import Fidelity
from kornia_tidy.psf.psf_bank import enclosing_window


def fitted_window(
    psfs: Callable[[int], Tensor], fidelity: Fidelity, fixed: int | None = None
) -> tuple[int, tuple[float, float], bool]:
    """Choose a PSF window, computing PSFs no larger than it takes.

    Args:
        psfs: computes the PSFs to be held in a window of some side, (D, C, P, P).
        fidelity: says which share of the light the window must hold, and its largest side.
        fixed: side in pixels that is only to be measured.

    Returns:
        The side in pixels, the least and the largest share of the light in it, and whether that is enough.

    Example:
        >>> import torch
        >>> fitted_window(lambda side: torch.ones(1, 1, side, side) / 128, Fidelity(enclosed_energy=0.6, max_window=9))
        (9, (0.6328125, 0.6328125), True)
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
    return window or size, (float(shares.min()), float(shares.max())), window is not None
