from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.special import eval_jacobi
from torch import Tensor

from kornia_tidy.masks import ZernikeMask, mask_axes
from kornia_tidy.optics import circular_aperture
from kornia_tidy.optics.zernike import zernike_polynomials
from tests.base import BaseTester
from tests.masks.strong import strong

TWO_MASKS = {"Zernike": lambda **o: ZernikeMask(2, num_modes=15, **o)}
ONE_MASK = {
    "Zernike": lambda g: ZernikeMask(1, generator=g),
    "strong Zernike": lambda g: strong(ZernikeMask(1, generator=g), 4),
}
OVER_PUPIL = True


def disc_quadrature(order: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return nodes y, x and weights of a disc quadrature that is exact for polynomials of degree below 2 * order."""
    nodes, weights = np.polynomial.legendre.leggauss(order)
    azimuth = 2 * math.pi * torch.arange(2 * order + 1, dtype=torch.float64) / (2 * order + 1)
    radius = torch.from_numpy(np.sqrt((nodes + 1) / 2))[:, None]
    share = torch.from_numpy(weights / 2)[:, None].expand(-1, len(azimuth)) / len(azimuth)
    return radius * azimuth.sin(), radius * azimuth.cos(), share


class TestZernikePolynomials(BaseTester):
    @pytest.mark.parametrize("count", [55, 350])
    def test_feature_orthonormal_on_the_disc(self, count):
        y, x, share = disc_quadrature(40)
        polynomials = zernike_polynomials(count, y, x).flatten(1)
        gram = polynomials * share.flatten() @ polynomials.T
        self.assert_close(gram, torch.eye(count, dtype=torch.float64), rtol=0, atol=1e-12)

    @pytest.mark.parametrize(("n", "m"), [(25, 1), (24, 0), (25, 25), (60, 2)])
    def test_feature_high_orders_equal_jacobi_polynomials(self, n, m):
        """At high order the sum of monomials fails by cancellation: at order 60 its terms reach 1e21."""
        radius = torch.linspace(0, 1, 101, dtype=torch.float64)
        index = (n * (n + 2) + m) // 2
        polynomial = zernike_polynomials(index + 1, torch.zeros(()), radius)[index]
        jacobi = radius.numpy() ** m * eval_jacobi((n - m) // 2, 0, m, 2 * radius.numpy() ** 2 - 1)
        norm = math.sqrt((2 if m else 1) * (n + 1))
        self.assert_close(polynomial / norm, torch.from_numpy(jacobi), rtol=0, atol=1e-12)

    def test_exception_number_of_modes(self):
        with pytest.raises(ValueError, match="num_modes must be positive"):
            zernike_polynomials(0, torch.zeros(1), torch.zeros(1))


class TestZernikeMask(BaseTester):
    @pytest.mark.parametrize("size", [23, 24, (24, 38), (41, 23)])
    def test_feature_a_quarter_mirrored_is_the_whole(self, size):
        """Against each of 350 polynomials evaluated on all pixels."""
        y, x = mask_axes(size)
        inward = torch.hypot(y, x).clamp(min=1)
        expected = zernike_polynomials(350, y / inward, x / inward)
        masks = ZernikeMask(size=size, num_modes=350, initial=torch.eye(350))
        self.assert_close(masks.phase.detach().double(), expected, rtol=0, atol=1e-5)

    def test_feature_noise_is_as_rough_as_the_start_of_the_paper(self):
        phase = ZernikeMask(200, 100).phase.detach()
        inside = phase[:, circular_aperture(100, 0.023).bool()]
        assert float(inside.square().mean().sqrt()) == pytest.approx(2.05, rel=0.05)

    def test_feature_pixels_hold_the_value_at_their_centre(self):
        masks = ZernikeMask(initial=torch.eye(55)[[2, 4]])
        assert float(masks.phase[0, 11, 21].detach()) == pytest.approx(2.0, abs=1e-6)  # 2 x at x = 1
        assert float(masks.phase[1, 21, 11].detach()) == pytest.approx(math.sqrt(3), abs=1e-6)
