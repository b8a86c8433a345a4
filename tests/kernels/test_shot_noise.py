"""Shot noise against SciPy's Poisson distribution."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from kornia_tidy.kernels import shot_noise as shot
from kornia_tidy.kernels.shot_noise import GAUSSIAN_FROM, poisson_quantile
from kornia_tidy.sensor import shot_noise
from tests.base import BaseTester

needs_more_than_half = pytest.mark.parametrize("wide", [torch.float32, torch.float64], ids=str)


def sorted_draws(rate: float, count: int) -> torch.Tensor:
    """Return draws at ``count`` evenly spaced u: the sampler's own distribution, without sampling error."""
    uniform = (torch.arange(count, dtype=torch.float64) + 0.5) / count
    return shot_noise(torch.full_like(uniform, rate), uniform)


class TestShotNoise(BaseTester):
    def test_exception_names_both_shapes(self, device):
        with pytest.raises(ValueError, match=r"shape of electrons, \(1, 3\), got \(3,\)"):
            shot_noise(torch.ones(1, 3, device=device), torch.ones(3, device=device))

    def test_feature_gaussian_branch_error_at_the_threshold(self):
        """Mean and variance exact, total variation 0.025 after rounding: the figures beside GAUSSIAN_FROM."""
        out = sorted_draws(GAUSSIAN_FROM, 1 << 18)
        assert abs(out.mean().item() - GAUSSIAN_FROM) < 1e-4
        assert abs(out.var().item() - GAUSSIAN_FROM) < 5e-3
        law = torch.bincount(out.round().long(), minlength=100).double().numpy() / out.numel()
        distance = 0.5 * np.abs(law - stats.poisson.pmf(np.arange(law.size), GAUSSIAN_FROM)).sum()
        assert 0.0245 < distance < 0.0255

    @needs_more_than_half
    def test_feature_gaussian_branch_is_the_normal_quantile(self, device, wide):
        """At u on the grid of random numbers, multiples of 2^-24, to both ends."""
        uniform = torch.tensor([1, 2, 17, 1 << 20, 1 << 23, 15 << 20, (1 << 24) - 1], device=device, dtype=wide) / 2**24
        expected = 1e4 + 100 * stats.norm.ppf(uniform.double().cpu().numpy())
        out = shot_noise(torch.full_like(uniform, 1e4), uniform)
        self.assert_close(out.cpu(), torch.from_numpy(expected), rtol=1e-6, atol=0.0)

    @given(rate=st.floats(0, 24.999), uniform=st.floats(1e-12, 1 - 1e-12))
    @settings(max_examples=300)
    def test_property_below_the_threshold_it_is_the_poisson_quantile(self, rate, uniform):
        out = shot_noise(torch.tensor(rate, dtype=torch.float64), torch.tensor(uniform, dtype=torch.float64)).item()
        expected = stats.poisson.ppf(uniform, rate)
        if out != expected:  # allowed only if u lies on a step of the distribution, to the rounding of either sum
            assert abs(stats.poisson.cdf(min(out, expected), rate) - uniform) < 1e-14

    def test_feature_all_draws_of_an_image_equal_the_poisson_quantile(self, device):
        """No pixel differs, for float32 u either. At u = 0 SciPy returns -1, one below the least count."""
        rate, uniform = 25 * torch.rand(1 << 17, device=device), torch.rand(1 << 17, device=device)
        rate = rate.clamp(max=24.999)
        expected = stats.poisson.ppf(uniform.double().cpu().numpy(), rate.double().cpu().numpy())
        assert np.array_equal(shot_noise(rate, uniform).cpu().numpy(), np.maximum(expected, 0))

    def test_feature_float32_sums_differ_only_on_a_step(self, device):
        """On a device without float64 under one pixel in 3e4 differs, each with u within 4e-6 of a step."""
        rate, uniform = 25 * torch.rand(1 << 16, device=device), torch.rand(1 << 16, device=device)
        out = poisson_quantile(rate, uniform).double().cpu().numpy()
        rate, uniform = rate.double().cpu().numpy(), uniform.double().cpu().numpy()
        expected = np.maximum(stats.poisson.ppf(uniform, rate), 0)
        off = np.flatnonzero(out != expected)
        assert off.size <= 2
        assert np.all(np.abs(stats.poisson.cdf(np.minimum(out, expected)[off], rate[off]) - uniform[off]) < 4e-6)

    def test_feature_on_a_step_it_takes_the_lower_count(self, device):
        """P(X <= 0) = exp(-λ) >= u holds with equality."""
        rate = torch.tensor([0.1, 1.0, 5.0, 20.0], device=device, dtype=torch.float64)
        assert shot_noise(rate, torch.exp(-rate)).tolist() == [0.0] * 4
        assert shot_noise(rate, torch.exp(-rate) * (1 + 1e-15)).tolist() == [1.0] * 4

    def test_feature_no_electrons_expected_gives_none(self, device, dtype):
        """For every u, and for FFT round-off below zero too."""
        uniform = torch.tensor([0.0, 1e-30, 0.5, 1 - 6e-8, 1.0], device=device, dtype=dtype)
        for rate in (0.0, -0.0, -2e-9, -1.0):
            assert shot_noise(torch.full_like(uniform, rate), uniform).tolist() == [0.0] * 5

    @pytest.mark.parametrize("rate", [1e-30, 1e-9, 0.1, 10.0, 24.99, 25.0, 1e3, 1e6, 1e8])
    @needs_more_than_half
    def test_feature_the_ends_of_u_stay_within_nine_sigma(self, device, wide, rate):
        """SciPy's quantiles 1e-16 from either end lie within 8.3 sigma + 12 electrons of the mean."""
        uniform = torch.tensor([0.0, 1e-38, 1e-7, 1 - 1e-7, 1.0], device=device, dtype=wide)
        out = shot_noise(torch.full_like(uniform, rate), uniform)
        assert (out >= 0).all()
        assert (out.double() - rate).abs().max().item() < 9 * rate**0.5 + 13
        assert (out.diff() >= 0).all()

    def test_feature_the_loop_is_long_enough(self):
        """The largest count, at the largest u after clamping, is below the limit of the loop."""
        for dtype in (np.float32, np.float64):
            last = 1 - 32 * float(np.finfo(dtype).eps)
            assert stats.poisson.ppf(last, GAUSSIAN_FROM) < shot._MAX_COUNT
        assert sorted_draws(24.999, 3)[-1] < shot._MAX_COUNT

    def test_feature_gradient_below_the_threshold_is_one(self, device, dtype):
        electrons = torch.tensor([0.0, 1e-20, 0.5, 24.0], device=device, dtype=dtype, requires_grad=True)
        shot_noise(electrons, torch.rand(4, device=device)).sum().backward()
        assert electrons.grad is not None
        assert electrons.grad.tolist() == [1.0, 1.0, 1.0, 1.0]

    @needs_more_than_half
    def test_feature_gradient_of_negative_round_off_is_zero(self, device, wide):
        electrons = torch.tensor([-2e-9, -1.0], device=device, dtype=wide, requires_grad=True)
        shot_noise(electrons, torch.rand(2, device=device)).sum().backward()
        assert electrons.grad is not None
        assert electrons.grad.tolist() == [0.0, 0.0]

    @needs_more_than_half
    def test_feature_gradient_above_the_threshold_flows_through_both_terms(self, device, wide):
        electrons = torch.tensor([25.0, 100.0, 1e6], device=device, dtype=wide, requires_grad=True)
        uniform = torch.tensor([0.9, 0.2, 0.999], device=device, dtype=wide)
        shot_noise(electrons, uniform).sum().backward()
        quantile = stats.norm.ppf(uniform.double().cpu().numpy())
        expected = 1 + quantile / (2 * np.sqrt([25.0, 100.0, 1e6]))
        assert electrons.grad is not None
        self.assert_close(electrons.grad.cpu(), torch.from_numpy(expected), rtol=1e-5)

    def test_feature_its_operator_is_fit_for_compilers(self, device, dtype):
        """torch.library.opcheck passes: schema, fake shapes and strides, tracing with dynamic shapes."""
        rate = 50 * torch.rand(2, 3, 4, 5, device=device, dtype=dtype)
        for layout in (torch.contiguous_format, torch.channels_last):
            torch.library.opcheck(shot._dim_counts_operator, (rate.to(memory_format=layout), torch.rand_like(rate)))

    def test_feature_recording_a_graph_gives_the_same_counts(self, device, dtype, monkeypatch):
        """While a CUDA graph is recorded values cannot be read back; the recording is simulated here."""
        rate = 50 * torch.rand(2, 3, 16, 16, device=device, dtype=dtype)
        uniform = torch.rand_like(rate)
        waiting = shot_noise(rate, uniform)
        monkeypatch.setattr(shot, "_unread", lambda _: True)
        assert torch.equal(shot_noise(rate, uniform), waiting)
