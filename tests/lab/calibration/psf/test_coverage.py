"""Simulated calibrations with disturbances: the uncertainty covers the error, or a sentence says what is wrong.

The captures come from known PSFs on a grid of ninths of a pixel, Poisson light, read noise and a converter; nothing of
the measurement makes them.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from kornia_tidy import PixelwiseMask, SensorNoise, Spectrum, ThinLensCamera
from kornia_tidy.lab.calibration.psf import diffraction_cutoff, measure_psfs, point_images
from kornia_tidy.masks import fisher_mask
from tests.base import BaseTester
from tests.lab.calibration.psf.captures import FINE, exposed, on_pixels, point_light

WINDOW, SIDE = 21, 81
CAMERA = ThinLensCamera()
SENSOR = SensorNoise.physical(10500, 2.4)
CUTOFF = diffraction_cutoff(CAMERA, 530e-9)
INSIDE = slice(SIDE // 2 - WINDOW // 2, SIDE // 2 + WINDOW // 2 + 1)
EXPOSURES = (torch.ones(1), torch.tensor([1.0, 8.0]))
DISTANCES = (0.5, 0.6, 0.8)
KINDS = ("none", "gradient", "dust", "point", "saturation", "all")


@pytest.fixture(scope="module")
def lights():
    """Coded and flat light of a point, on ninths of pixels, by distance."""
    starts = {"coded": fisher_mask(), "flat": "flat"}
    return {
        (name, z): point_light(
            PixelwiseMask(1, initial=start), float(CAMERA.defocus(torch.tensor(z))), SIDE, Spectrum.monochrome(), CAMERA
        )
        for name, start in starts.items()
        for z in DISTANCES
    }


@dataclass(frozen=True)
class Outcome:
    """Error of a measured PSF in units of its uncertainty and the true PSF, or the sentence that came instead."""

    error: Tensor | None = None
    truth: Tensor | None = None
    sentence: str = ""


def calibration(lights, kind, seed) -> Outcome:
    """Simulate one calibration of one distance from 12 places of the point, with one exposure or two."""
    generator = torch.Generator().manual_seed(seed)

    def draw(low, high):
        return low + (high - low) * float(torch.rand(1, generator=generator))

    name, z = list(lights)[int(draw(0, len(lights)))]
    fine, flat, exposures = lights[name, z], lights["flat", z], EXPOSURES[int(draw(0, 2))]
    steps = torch.arange(SIDE, dtype=torch.float64) - SIDE // 2
    background, transmission, level, diameter = torch.zeros(SIDE, SIDE).double(), torch.ones(SIDE, SIDE), 1.0, 0.0
    if kind in {"gradient", "all"}:
        slope, angle = draw(0, 1e-3), draw(0, 2 * math.pi)
        background = slope * (math.cos(angle) * steps[:, None] + math.sin(angle) * steps)
        background = background - background.min()
    if kind in {"dust", "all"}:
        radius = torch.hypot(steps[:, None] - draw(-6, 6), steps - draw(-6, 6))
        transmission = 1 - draw(0, 0.5) * (draw(1, 4) + 0.5 - radius).clamp(0, 1)
    seen = fine
    if kind in {"point", "all"}:
        pixels = draw(0, 0.7)
        diameter = pixels * CAMERA.pixel_pitch * z / float(CAMERA.image_distance)
        seen = through_a_pinhole(fine, pixels)
    if kind in {"saturation", "all"}:
        level = draw(0.6, 1)  # of the sensor, which is told to saturate at 0.95
    peak = draw(0.2, 0.9)
    brightest, widest = on_pixels(seen).max(), on_pixels(flat).max()
    images = []
    for _ in range(12):
        ninths = tuple(int(draw(-4, 5) // 1) + FINE * int(draw(-5, 6) // 1) for _ in range(2))
        coded = (peak * on_pixels(seen, ninths) / brightest + background) * transmission
        clear = (0.6 * on_pixels(flat, ninths) / widest + background) * transmission
        frames = exposed(coded, exposures, generator, 10500, 2.4, 0.003).clamp(max=level)
        reference = exposed(clear, torch.ones(1), generator, 10500, 2.4, 0.003)[0].clamp(max=level)
        images += point_images(frames, exposures, SENSOR, WINDOW, reference=reference)
    truth = on_pixels(fine)[0, INSIDE, INSIDE].double()
    truth = truth / truth.sum()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            measured = measure_psfs({z: images}, CAMERA, WINDOW, CUTOFF, diameter)
        except (ValueError, UserWarning) as sentence:
            return Outcome(sentence=str(sentence))
    return Outcome((measured.bank.psfs[0, 0] - truth) / measured.uncertainty[0, 0], truth)


def through_a_pinhole(fine, pixels):
    """Convolve light on ninths of a pixel with a disc of a diameter in pixels, by its transform."""
    rows, columns = (f(fine.shape[-1], 1 / FINE, dtype=torch.float64) for f in (torch.fft.fftfreq, torch.fft.rfftfreq))
    x = math.pi * pixels * torch.hypot(rows[:, None], columns)
    transfer = torch.where(x > 1e-6, 2 * torch.special.bessel_j1(x) / x.clamp(min=1e-6), 1.0)
    return torch.fft.irfft2(torch.fft.rfft2(fine.double()) * transfer, fine.shape[-2:])


def drawn_values(outcomes) -> Iterator[bool]:
    """Draw two values of each PSF, one of them in proportion to the light; yield whether the uncertainty covers it."""
    generator = torch.Generator().manual_seed(1)
    for one in outcomes:
        if one.error is not None:
            covered = one.error.abs().flatten() < 1.96
            yield bool(covered[int(torch.randint(len(covered), (1,), generator=generator))])
            yield bool(covered[int(torch.multinomial(one.truth.flatten(), 1, generator=generator))])


def tail(successes, trials, chance):
    """Return the probability of at most that many successes."""
    return sum(math.comb(trials, k) * chance**k * (1 - chance) ** (trials - k) for k in range(successes + 1))


class TestCoverage(BaseTester):
    @pytest.mark.takes_seconds
    def test_feature_the_uncertainty_covers_the_error_in_a_few_calibrations(self, lights):
        """So few covered values would come in one of 10,000 runs, were 95 % of all covered."""
        outcomes = [calibration(lights, kind, 1000 + n) for n, kind in enumerate(KINDS * 3)]
        covered = list(drawn_values(outcomes))
        assert len(covered) >= 12
        assert tail(sum(covered), len(covered), 0.95) > 1e-4
        assert not any(one.sentence for one in outcomes[::6])  # none without a disturbance

    @pytest.mark.slow
    @pytest.mark.timeout(1200)
    def test_feature_the_uncertainty_covers_the_error_or_a_sentence_says_why(self, lights):
        """300 calibrations: 95 % within 1.96 standard deviations, two points allowed for all values together."""
        outcomes = {kind: [calibration(lights, kind, 50 * k + n) for n in range(50)] for k, kind in enumerate(KINDS)}
        assert not any(one.sentence for one in outcomes["none"])
        everything = [one for several in outcomes.values() for one in several]
        told = [one for one in everything if one.error is not None]
        errors, light = torch.stack([one.error for one in told]), torch.stack([one.truth for one in told])
        covered = (errors.abs() < 1.96).double()
        assert 0.93 < float(covered.mean()) < 0.97
        assert 0.93 < float((covered * light).sum() / light.sum()) < 0.97
        drawn = list(
            drawn_values(everything)
        )  # a share of 93 to 97 % would give so few or so many in one of 1,000 runs
        assert tail(sum(drawn), len(drawn), 0.93) > 1e-3
        assert 1 - tail(sum(drawn) - 1, len(drawn), 0.97) > 1e-3
