r"""Non-convexity of the set of PSFs: an average of PSFs need not be the PSF of any single mask (theorem 1).

The Fourier transform of a PSF is the autocorrelation of the pupil field. Let u, v be the two points of the aperture
that are farthest apart along some direction. No other pair has the distance v - u, so for a single mask the
autocorrelation at v - u is one unit phasor, of modulus exactly 1. For an average over masks it is a mean of unit
phasors, of modulus below 1 unless they are equal. Then no single mask has this average as its PSF.
"""

from __future__ import annotations

import torch
from torch import Tensor

from kornia_tidy.psf.pupil import pupil_field

_DIRECTION = (1.0, 2**-0.5 - 0.5)  # irrational, so that no two grid points have the same projection on it


def extreme_points(aperture: Tensor) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the two open pixels of an aperture that are farthest apart along a generic direction.

    Args:
        aperture: (N, N), open where it is not zero.

    Returns:
        (row, column) of the first and of the last pixel along the direction.

    Example:
        >>> extreme_points(torch.ones(3, 3))
        ((0, 0), (2, 2))
    """
    points = torch.nonzero(aperture)
    along = points.double() @ points.new_tensor(_DIRECTION, dtype=torch.float64)
    first, last = points[along.argmin()], points[along.argmax()]
    return (int(first[0]), int(first[1])), (int(last[0]), int(last[1]))


def autocorrelation_bound(phase: Tensor, aperture: Tensor, weights: Tensor | None = None) -> Tensor:
    r"""Return the autocorrelation bound of non-convexity: 1 for a single mask, below 1 for an average that no mask has.

    .. math:: \left| \sum_k w_k (X_k \star X_k)_{v-u} \right|, \qquad X_k = A e^{i\phi_k}

    with the pupil fields X and the extreme points u, v of the aperture.

    Args:
        phase: K masks in radians, (K, N, N). A defocus added to all of them does not change the result.
        aperture: binary, (N, N).
        weights: fraction of the exposure of each mask, (K,). Default: equal.

    Returns:
        A number between 0 and 1, 0-dimensional float64.

    Raises:
        ValueError: if the aperture is not binary.

    Source: Shah et al., TiDy-PSFs (ICCV 2023), theorem 1 and its proof.

    Example:
        >>> opposite = torch.zeros(2, 4, 4, dtype=torch.float64)
        >>> opposite[1, 0, 0] = torch.pi
        >>> round(float(autocorrelation_bound(opposite[:1], torch.ones(4, 4))), 9)
        1.0
        >>> round(float(autocorrelation_bound(opposite, torch.ones(4, 4))), 9)
        0.0
    """
    if not bool(((aperture == 0) | (aperture == 1)).all()):
        raise ValueError("aperture must be binary, got values other than 0 and 1")
    masks, size = phase.shape[0], phase.shape[-1]
    weights = torch.full((masks,), 1 / masks, dtype=torch.float64) if weights is None else weights
    field = pupil_field(phase.double(), aperture, 1.0)
    # By way of the PSF, as a camera would measure it. Zero padding keeps lags from wrapping around.
    psf = torch.fft.fft2(field, s=(2 * size, 2 * size)).abs().square()
    average = torch.einsum("k,kyx->yx", weights.to(psf), psf)
    autocorrelation = torch.fft.ifft2(average)
    (y0, x0), (y1, x1) = extreme_points(aperture)
    return autocorrelation[(y1 - y0) % (2 * size), (x1 - x0) % (2 * size)].abs()
