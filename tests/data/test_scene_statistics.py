from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy import integrate

from kornia_tidy.data import PHOTOGRAPHS, SceneStatistics
from tests.base import BaseTester


def scenes(exponent=2.0, knee=1 / 64, depths=(1.0,)):
    return SceneStatistics(exponent, knee, mean=0.3, spread=0.2, depths=depths)


class TestSpectrum(BaseTester):
    @pytest.mark.parametrize("exponent", [1.3, 2.0, 2.76, 4.5])
    @pytest.mark.parametrize("knee", [1 / 344, 0.05, 0.3])
    def test_feature_its_integral_over_all_frequencies_is_the_variance(self, exponent, knee):
        found = scenes(exponent, knee)

        def density(y, x):
            return float(found.spectrum(torch.tensor(math.hypot(x, y), dtype=torch.float64)))

        fine = 8 * sum(
            integrate.dblquad(density, lo, hi, 0, lambda x: x, epsabs=1e-7)[0]
            for lo, hi in ((0, 0.01), (0.01, 0.1), (0.1, 0.5))
        )
        assert fine == pytest.approx(0.04, rel=1e-4)

    def test_feature_it_falls_by_its_exponent_beyond_the_knee_and_is_flat_below(self):
        found = scenes(2.5, 1e-3)
        low, middle, high = found.spectrum(torch.tensor([1e-5, 0.1, 0.4], dtype=torch.float64)).tolist()
        assert middle / high == pytest.approx(4**2.5, rel=1e-3)
        assert low == pytest.approx(found.level * 1e3**2.5, rel=1e-3)

    def test_gradcheck(self):
        self.gradcheck(PHOTOGRAPHS.spectrum, (torch.rand(5),))

    @pytest.mark.parametrize(
        ("changed", "said"),
        [
            ({"exponent": 0}, "exponent must be positive and finite, got 0"),
            ({"knee": -1.0}, "knee must be positive and finite, got -1"),
            ({"mean": math.nan}, "mean must be positive and finite, got nan"),
            ({"spread": math.inf}, "spread must be positive and finite, got inf"),
            ({"depths": (0.5, 0.4)}, r"depths must be shares of pixels that add up to 1, got \(0.5, 0.4\)"),
            ({"depths": (1.5, -0.5)}, "depths must be shares of pixels"),
            ({"depths": ()}, "depths must be shares of pixels"),
        ],
    )
    def test_exception(self, changed, said):
        with pytest.raises(ValueError, match=said):
            SceneStatistics(**{"exponent": 2.0, "knee": 0.1, "mean": 0.3, "spread": 0.2, **changed})


class TestCellPower(BaseTester):
    @pytest.mark.parametrize("size", [1, 2, 7, 8, 66])
    def test_feature_cells_hold_the_variance_and_both_halves_of_the_plane(self, size):
        found = scenes(2.0, 0.2)
        cells = found.cell_power(size)
        assert cells.shape == (size, size // 2 + 1)
        assert float(cells.sum()) == pytest.approx(0.04)
        f = np.fft.fftfreq(size)
        plane = found.spectrum(torch.as_tensor(np.hypot(f[:, None], f))).numpy() / size**2
        plane[0, 0] = 0
        assert float(cells.sum() - cells[0, 0]) == pytest.approx(plane.sum())

    def test_feature_a_knee_within_one_cell_leaves_the_rest_to_frequency_zero(self):
        fine, coarse = PHOTOGRAPHS.cell_power(512), PHOTOGRAPHS.cell_power(64)
        high = [float(cells[size // 4].sum()) * size for cells, size in ((fine, 512), (coarse, 64))]
        assert high[1] == pytest.approx(high[0], rel=0.05)  # the power near f = 1/4 does not depend on the grid
        assert coarse[0, 0] > fine[0, 0] > 0


class TestLightAround(BaseTester):
    def test_feature_rises_from_the_shade_to_the_mean(self):
        distance = torch.tensor([0.0, 1.0, 10.0, 75.8, 1e6], dtype=torch.float64)
        around = PHOTOGRAPHS.light_around(distance)
        assert bool((around.diff() > 0).all())
        assert around[[0, -1]].tolist() == pytest.approx([0.293, 1.0])
        assert float(around[3]) == pytest.approx(1 - 0.707 / math.e)

    def test_feature_is_one_everywhere_in_linear_light(self):
        assert torch.equal(scenes().light_around(torch.rand(5)), torch.ones(5))


class TestDepthWeights(BaseTester):
    @pytest.mark.parametrize("count", [1, 2, 5, 40])
    def test_feature_are_the_share_of_pixels_nearest_to_each_node(self, count):
        """Against a dense sample of depths."""
        found = scenes(depths=(0.5, 0.1, 0.4))
        nodes = torch.linspace(-20.0, 15.0, count, dtype=torch.float64) if count > 1 else torch.zeros(1).double()
        position = (torch.arange(30000, dtype=torch.float64) + 0.5) / 30000
        share = torch.tensor([0.5, 0.1, 0.4], dtype=torch.float64)[(position * 3).long()] * 3 / 30000
        nearest = ((nodes[0] + position * (nodes[-1] - nodes[0]))[:, None] - nodes).abs().argmin(1)
        expected = torch.zeros(count, dtype=torch.float64).index_add(0, nearest, share)
        self.assert_close(found.depth_weights(nodes), expected, rtol=0, atol=2e-4)

    def test_convention_the_first_part_is_the_farthest(self):
        weights = scenes(depths=(1.0, 0.0)).depth_weights(torch.tensor([-20.0, -10.0, 0.0, 10.0, 20.0]))
        assert weights.tolist() == pytest.approx([0.25, 0.5, 0.25, 0, 0])

    def test_feature_without_a_distribution_equally_spaced_nodes_count_alike(self):
        weights = scenes().depth_weights(torch.linspace(-3, 3, 4))
        assert weights.tolist() == pytest.approx([1 / 6, 1 / 3, 1 / 3, 1 / 6])
