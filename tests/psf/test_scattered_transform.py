"""Light from scattered points: against sums over all points, at Gauss-Legendre points of each pixel."""

from __future__ import annotations

import math

import pytest
import torch

from kornia_tidy.kernels.scattered_ops import Points
from kornia_tidy.optics.quadrature import gauss_legendre
from kornia_tidy.psf.scattered_transform import scattered_energies, scattered_grid
from tests.base import BaseTester

WINDOW = 9


def drawn(highest: float, grid, count: int = 300) -> tuple[torch.Tensor, torch.Tensor, Points]:
    """Frequencies of points in a disc, (2, C, S), their moduli, and the points on the grid."""
    generator = torch.Generator().manual_seed(1)
    radius, turn, size, phase = torch.rand(4, count, generator=generator, dtype=torch.float64)
    angle = 2 * math.pi * turn
    frequency = highest * radius.sqrt() * torch.stack([angle.sin(), angle.cos()])
    place = frequency / grid.step + (grid.extent - 1) / 2
    values = torch.stack([*place, phase, size / size.sum()])[None, :, :, None]
    one = torch.ones(1, 1, dtype=torch.float64)
    return frequency, phase, Points(torch.zeros(count, dtype=torch.long), values, one, one)


class TestScatteredEnergies(BaseTester):
    @pytest.mark.parametrize("highest", [0.05, 0.27, 0.8])
    @pytest.mark.parametrize("tolerance", [1e-3, 1e-5, 1e-7])
    @pytest.mark.parametrize("shift", [0.0, 0.7])
    def test_feature_within_the_tolerance_of_sums_over_points(self, highest, tolerance, shift):
        """The field is off by the tolerance at most, relative to the sum of moduli, so light by twice as much."""
        grid = scattered_grid(highest, WINDOW, tolerance, abs(shift))
        frequency, phase, points = drawn(highest, grid)
        shifts = torch.tensor([[shift]], dtype=torch.float64)
        sums = (torch.stack([grid.sums(WINDOW, own, turns) for turns in (False, True)], 1) for own in (shifts, -shifts))
        one = torch.ones(1, dtype=torch.float64)
        found, mirrored = scattered_energies(one.expand(2, 1, 1) + 0j, one, points, grid, *sums)[0, 0, :, 0]
        nodes, weights = gauss_legendre(12)
        pixels = torch.arange(WINDOW, dtype=torch.float64) - WINDOW // 2
        field = points.values[0, 3, :, 0] * torch.exp(2j * math.pi * phase)
        down, across = (
            torch.exp(-2j * math.pi * (pixels[:, None] + nodes - s).flatten()[:, None] * own)
            for s, own in zip((shift, -shift), frequency, strict=True)
        )
        light = ((down * field) @ across.T).abs().square().view(WINDOW, 12, WINDOW, 12)
        expected = torch.einsum("paqb,a,b->pq", light, weights, weights)
        assert float((found - expected).abs().max()) <= 2 * tolerance
        if not shift:
            self.assert_close(mirrored, found.flip(0, 1), atol=1e-14, rtol=0)

    @pytest.mark.parametrize("tolerance", [1e-3, 1e-7])
    def test_feature_gradients_reach_waves_and_weights_alike_in_torch_and_c(self, tolerance, monkeypatch):
        grid = scattered_grid(0.3, WINDOW, tolerance)
        points = drawn(0.3, grid)[2]
        sums = [grid.sums(WINDOW, torch.zeros(1, 1, dtype=torch.float64))[:, None]] * 2
        found = []
        for _ in range(2):
            waves, weights = torch.tensor([[[1.0 + 0.5j], [0.2j]]]).requires_grad_(), torch.rand(2, requires_grad=True)
            weights.data[:] = torch.tensor([0.3, 0.7])
            light = scattered_energies(waves, weights, points, grid, *sums)
            found.append((light.detach(), *torch.autograd.grad(light.square().sum(), (waves, weights))))
            monkeypatch.setattr("kornia_tidy.psf.scattered_transform.compiled", lambda source, dtype: None)
        for one, two in zip(*found, strict=True):
            self.assert_close(one, two, rtol=1e-4, atol=1e-5 * float(two.abs().max()))
