"""Round-off bounds by error analysis, for any order of summation and with or without fused multiply-add.

Source: Higham, Accuracy and Stability of Numerical Algorithms, 2nd edition, 3.1 and 3.5 (complex arithmetic: 3.6).
"""

from __future__ import annotations

import torch
from torch import Tensor


def gamma(roundings: int, dtype: torch.dtype) -> float:
    r"""Return the relative error of a number that was rounded n times on its way.

    .. math:: \gamma_n = \frac{n u}{1 - n u}

    with the unit round-off u, half of ``torch.finfo(dtype).eps``. A sum of n products in any order is off by no more
    than this share of the sum of their magnitudes (each product is rounded once, and added at most n - 1 times).

    Args:
        roundings: n.
        dtype: in which is computed.

    Example:
        >>> f"{gamma(1000, torch.float32):.1e}"
        '6.0e-05'
    """
    errors = roundings * torch.finfo(dtype).eps / 2
    assert errors < 1, f"{roundings} roundings in {dtype} may leave no digit"
    return errors / (1 - errors)


def magnitude(numbers: Tensor) -> Tensor:
    """Return |Re| + |Im| of complex numbers: sums and products of these bound the real products that numbers become."""
    parts = torch.view_as_real(numbers.detach().resolve_conj()).abs()
    return parts.sum(-1)
