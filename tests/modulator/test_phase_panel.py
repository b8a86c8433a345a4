"""Grey levels, phase gain and crosstalk against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.stats import norm

from kornia_tidy.modulator.phase_panel import GreyLevels, PixelCrosstalk, StrokeError, crosstalk_kernel, nearest_level
from tests.base import BaseTester


def turns_apart(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Return the signed phase difference in radians, modulo 2 pi."""
    return (a - b + math.pi).remainder(2 * math.pi) - math.pi


class TestGreyLevels(BaseTester):
    def test_exception(self):
        for bits in (0, 11, 2.0, -1):
            with pytest.raises(ValueError, match="bits must be a whole number from 1 to 10"):
                GreyLevels(bits)
        with pytest.raises(ValueError, match="phase_range must be positive"):
            GreyLevels(8, phase_range=0)

    @pytest.mark.parametrize(
        ("response", "sentence"),
        [
            ([0.0, 1.0, 2.0], "must have 4 phases, one for each level of 2 bits, got 3$"),
            ([[0.0, 1.0, 2.0, 6.0]], r"must have 4 phases, one for each level of 2 bits, got the shape \(1, 4\)$"),
            ([0.0, 1.0, math.nan, 6.0], "from 0 to 4 pi rad, got nan at level 2: .* interpolate unknown ones$"),
            ([0.0, 1.0, 2.0, math.inf], "from 0 to 4 pi rad, got inf at level 3: "),
            ([0.0, -1.0, -2.0, -6.0], "got -1 at level 1: add a constant to all phases, which changes no PSF"),
            ([0.0, 120.0, 240.0, 360.0], "got 120 at level 1: multiply degrees by pi / 180"),
            ([0.0, 3.0, 2.9, 6.0], "rise or fall throughout, got 2.9 at level 2 after 3: smooth noise, .* np.unwrap$"),
            ([6.0, 2.9, 3.0, 0.0], "rise or fall throughout, got 3 at level 2 after 2.9: "),
            ([2.0, 2.0, 2.0, 2.0], "must rise or fall, got 2 at every level$"),
            (np.ma.masked_equal([0.0, 1.0, 2.0, 9.0], 9), "1 of its 4 values are masked"),
        ],
    )
    def test_exception_responses_that_no_panel_has(self, response, sentence):
        with pytest.raises(ValueError, match=sentence):
            GreyLevels(2, response=response)

    def test_feature_responses_may_fall_be_flat_at_places_and_be_rounded(self):
        for response in ((4.0, 4.0, 2.0, 0.0), (-5e-4, 1.0, 6.0, 12.5668), (1.0, 2.0, 5.0, 5.0)):
            assert GreyLevels(2, response=response).levels.tolist() == list(response)

    @pytest.mark.parametrize("bits", range(1, 11))
    def test_feature_error_variance_and_efficiency_are_those_of_theory(self, bits):
        """The phase error is uniform over one step: variance step^2 / 12 and efficiency sinc^2(2^-b)."""
        wanted = 12 * math.pi * torch.rand(400, 500, dtype=torch.float64) - 20
        error = turns_apart(GreyLevels(bits)(wanted), wanted)
        step = 2 * math.pi / 2**bits
        assert float(error.abs().max()) <= step / 2 + 1e-12
        assert float(error.square().mean()) == pytest.approx(step**2 / 12, rel=0.02)
        efficiency = float(error.cos().mean() ** 2 + error.sin().mean() ** 2)
        assert efficiency == pytest.approx(np.sinc(2.0**-bits) ** 2, abs=5e-3)

    @settings(max_examples=100)
    @given(levels=st.lists(st.floats(0, 9), min_size=1, max_size=20), wanted=st.floats(-30, 30))
    def test_feature_the_nearest_level_is_chosen_whatever_their_order(self, levels, wanted):
        phases = torch.tensor(levels, dtype=torch.float64)
        target = torch.tensor(wanted, dtype=torch.float64)
        chosen = phases[nearest_level(target, phases)]
        assert abs(float(turns_apart(chosen, target))) <= float(turns_apart(phases, target).abs().min()) + 1e-9

    def test_feature_a_short_stroke_shows_its_nearer_end(self):
        panel = GreyLevels(8, phase_range=math.pi)
        top = math.pi * 255 / 256
        shown = panel(torch.tensor([1.3 * math.pi, 1.9 * math.pi]))
        self.assert_close(shown, torch.tensor([top, 0.0]))

    def test_feature_a_measured_response_is_written_through(self):
        """Frames computed with the measured curve show the wanted phase to half the local step."""
        grey = np.linspace(0, 1, 1024)
        curve = 2.2 * math.pi * grey**1.8
        panel = GreyLevels(10, response=curve.tolist())
        wanted = 2 * math.pi * torch.rand(2, 23, 23, dtype=torch.float64)
        frames = panel.frames(wanted).numpy()
        assert frames.min() >= 0
        assert frames.max() <= 1023
        shown = np.interp(frames / 1023, grey, curve)
        widest = np.diff(curve).max()  # step between levels, where the curve is steepest
        assert float(turns_apart(torch.from_numpy(shown), wanted).abs().max()) < widest / 2
        self.assert_close(panel(wanted), torch.from_numpy(shown), rtol=0, atol=1e-12)

    def test_feature_the_gradient_goes_straight_through(self):
        phase = torch.rand(2, 3, 3, requires_grad=True)
        GreyLevels(1)(phase).sum().backward()
        assert torch.equal(phase.grad, torch.ones_like(phase))

    def test_feature_half_precision_masks_are_shown_exactly(self):
        panel = GreyLevels(10).half()
        self.assert_close(panel(torch.full((1, 1, 1), 3.0)), torch.full((1, 1, 1), 489 * 2 * math.pi / 1024))

    def test_dynamo(self):
        panel, phase = GreyLevels(3), 6 * torch.rand(2, 5, 5)
        compiled = torch.compile(panel, backend="eager", fullgraph=True)
        self.assert_close(compiled(phase), panel(phase), rtol=0, atol=0)


class TestStrokeError(BaseTester):
    def test_exception(self):
        with pytest.raises(ValueError, match="gain must be positive"):
            StrokeError(0.0)

    @pytest.mark.parametrize("gain", [0.9, 1.05])
    def test_feature_a_blazed_grating_loses_the_closed_form(self, gain):
        """First order of a ramp of g 2 pi: sinc^2(1 - g)."""
        ramp = 2 * math.pi * (torch.arange(4096, dtype=torch.float64) + 0.5) / 4096
        shown = StrokeError(gain)(ramp)
        first = torch.polar(torch.ones_like(ramp), shown - ramp).mean()
        assert float(first.abs() ** 2) == pytest.approx(np.sinc(1 - gain) ** 2, abs=1e-6)


class TestPixelCrosstalk(BaseTester):
    def test_exception(self):
        with pytest.raises(ValueError, match="sigma must be positive"):
            PixelCrosstalk(0.0)

    @pytest.mark.parametrize("sigma", [0.1, 0.4, 1.5])
    def test_feature_the_kernel_is_the_mean_of_a_blurred_pixel(self, sigma):
        """Against a single pixel blurred by SciPy's Gaussian and averaged over each pixel by SciPy's quadrature."""
        kernel = crosstalk_kernel(sigma)
        reach = len(kernel) // 2
        for d in range(-min(reach, 3), min(reach, 3) + 1):
            edges = (d - 0.5, d + 0.5)
            blurred = quad(lambda x: norm.cdf((x + 0.5) / sigma) - norm.cdf((x - 0.5) / sigma), *edges, epsabs=1e-12)
            assert float(kernel[d + reach]) == pytest.approx(blurred[0], abs=1e-9)
        assert float(kernel.sum()) == pytest.approx(1, abs=1e-12)
