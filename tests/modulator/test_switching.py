"""Switching within the exposure: states, times and weights of the transitions."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from kornia_tidy import DwellTimes, Fidelity, PixelwiseMask, TiDyOptics
from kornia_tidy.modulator.switching import Switching, random_phases, sampled_response
from tests import oracle
from tests.base import BaseTester

SMALL = Fidelity(window=9, layer_spacing=20.0, stray_light="discard")
MEASURED = (0.0, 0.5, 1.1, 1.0)
KINDS = ["random", "linear", "exponential", MEASURED]


class TestSwitching(BaseTester):
    @pytest.mark.parametrize("between", KINDS)
    def test_smoke(self, between, device, dtype):
        phase = torch.rand(3, 5, 5).to(device, dtype)
        states, weights = Switching(4e-3, between=between)(phase)
        assert (states.device.type, states.dtype, weights.dtype) == (device.type, dtype, dtype)
        self.assert_close(states[:3], phase, rtol=0, atol=0)
        assert "4 ms a transition in an exposure of 100 ms" in repr(Switching(4e-3, between=between))

    def test_exception(self):
        with pytest.raises(ValueError, match=r"^5 transitions of 20.5 ms must fit .* of 100 ms, got 102.5 ms$"):
            Switching(20.5e-3)(torch.zeros(6, 5, 5))
        for time in (-1e-3, float("nan"), float("inf")):
            with pytest.raises(ValueError, match="switching_time must be zero or positive"):
                Switching(time)
        with pytest.raises(ValueError, match="exposure must be positive"):
            Switching(1e-3, exposure=0)
        with pytest.raises(ValueError, match="samples must be positive"):
            Switching(1e-3, samples=0)
        with pytest.raises(ValueError, match="between must be one of 'random', 'linear', 'exponential', got 'cubic'"):
            Switching(1e-3, between="cubic")
        for response in ((1.0,), (0.0, float("nan"))):
            with pytest.raises(ValueError, match="at least two finite samples"):
                Switching(1e-3, between=response)

    @pytest.mark.parametrize("between", KINDS)
    @pytest.mark.parametrize("masks", [1, 2, 5])
    @pytest.mark.parametrize("cyclic", [False, True])
    def test_cardinality(self, between, masks, cyclic):
        swaps = (masks if cyclic else masks - 1) if masks > 1 else 0
        each = 1 if between == "random" else 4
        states, weights = Switching(2e-3, between=between, cyclic=cyclic, samples=4)(torch.rand(masks, 6, 6))
        assert states.shape == (masks + each * swaps, 6, 6)
        assert weights.shape == (masks + each * swaps,)
        self.assert_close(weights[masks:].sum(), torch.tensor(0.02 * swaps))

    @pytest.mark.parametrize("between", KINDS)
    def test_cardinality_masks_longer_along_one_axis(self, between):
        states, _ = Switching(2e-3, between=between)(torch.rand(3, 6, 10))
        assert states.shape[1:] == (6, 10)

    @settings(max_examples=60)
    @given(
        masks=st.integers(1, 16),
        time=st.floats(0, 16e-3),
        kind=st.sampled_from(KINDS),
        cyclic=st.booleans(),
        shares=st.lists(st.floats(1e-3, 1), min_size=16, max_size=16),
        dtype=st.sampled_from([torch.float32, torch.float64]),
    )
    def test_feature_weights_sum_to_one_to_k_units_in_the_last_place(self, masks, time, kind, cyclic, shares, dtype):
        exposure = max(0.1, masks * time)
        switching = Switching(time, exposure, kind, DwellTimes(shares[:masks]), cyclic)
        _, weights = switching(torch.zeros(masks, 3, 3, dtype=dtype))
        assert float(weights.min()) >= 0
        assert abs(math.fsum(weights.tolist()) - 1) <= masks * torch.finfo(dtype).eps

    @pytest.mark.parametrize("time", [1e-3, 16e-3])
    def test_feature_weights_are_those_of_the_oracle(self, time):
        for cyclic in (False, True):
            dwell, between = oracle.switching_shares(5, 0.1, time, cyclic)
            _, weights = Switching(time, cyclic=cyclic)(torch.zeros(5, 3, 3, dtype=torch.float64))
            self.assert_close(weights, torch.from_numpy(np.concatenate([dwell, between])), rtol=1e-12, atol=0)

    @pytest.mark.parametrize("between", KINDS)
    def test_feature_no_switching_time_is_the_ideal_and_a_short_one_is_near(self, between):
        masks = PixelwiseMask(3)
        ideal = TiDyOptics(masks, fidelity=SMALL).psf_bank().psfs
        for time, within in ((0.0, 1e-7), (1e-9, 1e-7)):
            psfs = TiDyOptics(masks, modulator=Switching(time, between=between), fidelity=SMALL).psf_bank().psfs
            self.assert_close(psfs, ideal, rtol=0, atol=within)

    def test_feature_swaps_may_fill_the_exposure(self):
        states, weights = Switching(25e-3, between="linear")(torch.rand(5, 4, 4))
        assert states.shape[0] == 5 + 4 * 8
        assert float(weights[:5].abs().max()) == 0

    @pytest.mark.parametrize("between", ["linear", "exponential", MEASURED])
    def test_gradcheck(self, between):
        def mean_field(phase):
            states, weights = Switching(20e-3, between=between, cyclic=True, samples=3)(phase)
            return torch.einsum("k,kyx->yx", weights, states.cos())

        self.gradcheck(mean_field, (6 * torch.rand(3, 4, 4),))

    @pytest.mark.parametrize("between", KINDS)
    def test_dynamo(self, between):
        module, phase = Switching(8e-3, between=between), torch.rand(3, 5, 5)
        compiled = torch.compile(module, backend="eager", fullgraph=True)
        for got, expected in zip(compiled(phase), module(phase), strict=True):
            self.assert_close(got, expected, rtol=0, atol=0)


class TestRandomStates(BaseTester):
    def test_feature_the_seed_alone_decides(self):
        phase = torch.rand(3, 23, 23)
        before = torch.get_rng_state()
        first, second = Switching(4e-3)(phase)[0], Switching(4e-3)(phase)[0]
        self.assert_close(first, second, rtol=0, atol=0)
        self.assert_close(first, Switching(4e-3)(phase.double())[0], rtol=0, atol=1e-6)
        assert torch.equal(torch.get_rng_state(), before)
        assert not torch.equal(first[3:], Switching(4e-3, seed=1)(phase)[0][3:])
        assert not torch.equal(first[3], first[4])

    def test_feature_their_mean_field_is_zero(self):
        """A random pattern is the worst state: its mean field, and so its peak, vanishes."""
        patterns = random_phases(0, 50, 64, 64)
        assert float(torch.polar(torch.ones_like(patterns), patterns).mean().abs()) < 5 / math.sqrt(patterns.numel())
        assert 0 <= float(patterns.min()) < float(patterns.max()) < 2 * math.pi


class TestResponse(BaseTester):
    def test_feature_exponential_solves_the_equation_of_relaxation(self):
        """Against SciPy's solution of tau r' = 1 - r with r(0) = 0 and tau from the rise time."""
        rise = 5e-3
        tau = rise / (math.log(0.9) - math.log(0.1))
        swap = math.log(100) * tau
        response, _ = sampled_response("exponential", 7)
        time = (np.polynomial.legendre.leggauss(7)[0] + 1) / 2 * swap
        solved = solve_ivp(lambda _, r: (1 - r) / tau, (0, swap), [0.0], t_eval=time, rtol=1e-10, atol=1e-12)
        self.assert_close(response, torch.from_numpy(solved.y[0]), rtol=0, atol=1e-8)
        assert 1 - math.exp(-swap / tau) == pytest.approx(0.99, abs=1e-12)

    def test_feature_measured_samples_are_joined_by_straight_lines(self):
        response, weights = sampled_response(MEASURED, 6)
        nodes, expected = np.polynomial.legendre.leggauss(6)
        curve = np.interp((nodes + 1) / 2, np.linspace(0, 1, 4), MEASURED)
        self.assert_close(response, torch.from_numpy(curve), rtol=0, atol=1e-14)
        self.assert_close(weights, torch.from_numpy(expected / 2), rtol=0, atol=1e-14)

    @pytest.mark.parametrize("between", ["linear", (0.0, 1.0)])
    def test_feature_a_straight_swap_has_the_mean_of_its_phasors(self, between):
        """The mean of exp(i u D) over u in [0, 1] is exp(i D/2) sinc(D/2pi), and quadrature reaches it."""
        step = torch.linspace(-7, 7, 25, dtype=torch.float64).reshape(1, 5, 5)
        states, weights = Switching(0.1, between=between)(torch.cat([torch.zeros_like(step), step]))
        phasors = torch.polar(torch.ones_like(states), states)
        mean = torch.einsum("s,syx->yx", weights.to(phasors), phasors)
        expected = torch.exp(0.5j * step[0]) * torch.sinc(step[0] / (2 * math.pi))
        self.assert_close(torch.view_as_real(mean), torch.view_as_real(expected), rtol=0, atol=1e-9)

    @pytest.mark.parametrize(
        ("between", "samples", "error"), [("linear", 6, 2e-4), ("exponential", 8, 3e-3), ("exponential", 12, 3e-5)]
    )
    @torch.no_grad()
    def test_feature_the_error_of_the_sampling_is_the_documented_one(self, between, samples, error):
        masks = PixelwiseMask(2, generator=torch.Generator().manual_seed(0))
        fidelity = Fidelity(window=23, layer_spacing=20.0, stray_light="discard", double=True)
        few, many = (
            TiDyOptics(masks, modulator=Switching(0.1, between=between, samples=n), fidelity=fidelity).psf_bank().psfs
            for n in (samples, 40)
        )
        measured = float(((few - many).abs().sum((2, 3)) / many.sum((2, 3))).max())
        assert error / 10 < measured < error
