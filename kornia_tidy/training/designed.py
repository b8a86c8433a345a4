"""Mask design before training, without scenes or network: it takes seconds where training takes hours."""

from __future__ import annotations

from torch import Tensor
from tqdm import tqdm

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.data.scene_statistics import PHOTOGRAPHS
from kornia_tidy.design.objectives import design, restoration_error

LEAST_SIGMA = 1e-3  # in units of full scale; without noise every blur can be inverted
SCENE_SPREAD = PHOTOGRAPHS.spread
LR_METRES = 8e-8


def design_masks(lens: TiDyOptics, steps: int, sigma: float = 0.01, *, progress: bool = False) -> list[float]:
    """Optimise a camera's masks in place for extended depth of field, by the error of the best linear restoration.

    End-to-end training then starts from these masks, as a short training moves masks little: random masks trained for
    640 steps with a small network stay worse than masks after 120 steps of this function, from any focal sweep.

    Args:
        lens: the camera. Only its masks are changed.
        steps: gradient steps.
        sigma: noise in units of full scale; at least 0.001 is assumed. Less noise allows masks that blur more.
            Training uses the default whatever the sensor: with a noise of 0.002, networks behind one mask designed for
            0.002 ended 0.2 dB below those behind one mask designed for 0.01 (for each of three seeds); behind five
            masks both were equal.
        progress: show a progress bar.

    Returns:
        The :func:`~kornia_tidy.design.objectives.restoration_error` before each step, averaged over colours,
        with the largest window that the fidelity allows.

    Raises:
        ValueError: if the steps are not positive.

    Example:
        >>> from kornia_tidy import PixelwiseMask, TiDyOptics
        >>> history = design_masks(TiDyOptics(PixelwiseMask(1), fidelity="draft"), 10)
        >>> len(history), history[-1] < history[0]
        (10, True)
    """
    fidelity = lens.fidelity
    # Light outside the window must be lost: renormalisation would reward masks that throw it there.
    lens.fidelity = fidelity.replace(window=fidelity.max_window, stray_light="discard")
    bar = tqdm(total=steps, desc="design", leave=False, disable=not progress)

    def error() -> Tensor:
        bar.update()
        return restoration_error(lens.psf_bank(), max(sigma, LEAST_SIGMA) / SCENE_SPREAD)

    try:
        return design(lens.masks, error, steps, LR_METRES)
    finally:
        bar.close()
        lens.fidelity = fidelity
