from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.signal import correlate2d
from torch import Tensor

from kornia_tidy.design.non_convexity import autocorrelation_bound, extreme_points
from kornia_tidy.masks import FresnelLens, PixelwiseMask, mask_coordinates
from kornia_tidy.optics import annular_aperture, circular_aperture
from tests.base import BaseTester
from tests.polygons import polygon_aperture

APERTURES = {
    "disc": circular_aperture(23),
    "small disc": circular_aperture(8, 0.3),
    "ring": annular_aperture(23, 0.1, inner=0.5),
    "hexagon": polygon_aperture(23, 0.1, sides=6),
    "turned triangle": polygon_aperture(31, 0.1, sides=3, rotation=0.4),
    "square": torch.ones(9, 9, dtype=torch.float64),
    "two holes": torch.zeros(7, 7, dtype=torch.float64).index_put(
        (torch.tensor([1, 5]), torch.tensor([2, 3])), torch.tensor(1.0).double()
    ),
}


def defocus(size: int, radians: float) -> Tensor:
    x = mask_coordinates(size)
    return radians * (x[:, None] ** 2 + x**2)


def masks_of(kind: str, size: int) -> Tensor:
    noise = 2 * math.pi * torch.rand(size, size, dtype=torch.float64)
    kinds = {
        "random": noise,
        "flat": torch.zeros_like(noise),
        "Fresnel": FresnelLens(size=size).phase[0].double(),
        "defocused": noise + defocus(size, 20.0),
        "strongly defocused": noise + defocus(size, -300.0),
        "paper's start": PixelwiseMask(1, size=size).phase[0].detach().double(),
    }
    return kinds[kind][None]


def bound_by_direct_sums(phase: Tensor, aperture: Tensor, weights: Tensor) -> float:
    """Return the bound from autocorrelations by SciPy's direct sums, at the lag of the two extreme points."""
    size = phase.shape[-1]
    total = np.zeros((2 * size - 1, 2 * size - 1), complex)
    for one, weight in zip(phase.numpy(), weights.numpy(), strict=True):
        field = aperture.numpy() * np.exp(1j * one)
        total += weight * correlate2d(field, field)
    (y0, x0), (y1, x1) = extreme_points(aperture)
    return abs(total[size - 1 + y1 - y0, size - 1 + x1 - x0])


@pytest.mark.parametrize("aperture", APERTURES.values(), ids=APERTURES.keys())
class TestAutocorrelationBound(BaseTester):
    @pytest.mark.parametrize("kind", ["random", "flat", "Fresnel", "defocused", "strongly defocused", "paper's start"])
    def test_feature_is_one_for_every_single_mask(self, aperture, kind):
        phase = masks_of(kind, aperture.shape[-1])
        assert abs(float(autocorrelation_bound(phase, aperture)) - 1) < 1e-9

    def test_feature_matches_direct_sums(self, aperture):
        phase = torch.cat([masks_of("random", aperture.shape[-1]) for _ in range(3)])
        weights = torch.tensor([0.5, 0.3, 0.2], dtype=torch.float64)
        expected = bound_by_direct_sums(phase, aperture, weights)
        assert float(autocorrelation_bound(phase, aperture, weights)) == pytest.approx(expected, abs=1e-9)

    def test_feature_no_other_pair_of_points_is_as_far_apart(self, aperture):
        (y0, x0), (y1, x1) = extreme_points(aperture)
        points = {tuple(p) for p in torch.nonzero(aperture).tolist()}
        pairs = [(y, x) for y, x in points if (y + y1 - y0, x + x1 - x0) in points]
        assert pairs == [(y0, x0)]


class TestWeights(BaseTester):
    @staticmethod
    def opposite() -> Tensor:
        """Return two masks with opposite autocorrelations at the extreme points."""
        phase = torch.zeros(2, 5, 5, dtype=torch.float64)
        phase[1, 0, 0] = math.pi
        return phase

    @pytest.mark.parametrize(("weights", "expected"), [((0.5, 0.5), 0.0), ((0.75, 0.25), 0.5), ((1.0, 0.0), 1.0)])
    def test_feature_weights_are_those_of_the_mean_of_phasors(self, weights, expected):
        bound = autocorrelation_bound(self.opposite(), torch.ones(5, 5), torch.tensor(weights))
        assert float(bound) == pytest.approx(expected, abs=1e-9)

    def test_feature_equal_thirds_are_exact(self):
        phase = torch.zeros(3, 5, 5, dtype=torch.float64)
        assert abs(float(autocorrelation_bound(phase, torch.ones(5, 5))) - 1) < 1e-9

    def test_exception_a_soft_aperture_is_refused(self):
        with pytest.raises(ValueError, match="aperture must be binary, got values other than 0 and 1"):
            autocorrelation_bound(self.opposite(), 0.5 * torch.ones(5, 5))
