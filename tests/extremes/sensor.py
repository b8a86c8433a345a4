"""Rows of the sensor: light, noise, digitisation."""

from __future__ import annotations

import math

import torch

from kornia_tidy import SensorNoise
from tests.extremes.row import Row, difference, refusals, worst

GROUP = "Sensor"
SIGMAS = 6.0  # of the mean over N samples; chance of a fault in a test of this many: 2e-9


def _take(sensor: SensorNoise, level: float, count: int = 200_000) -> torch.Tensor:
    return sensor(torch.full((1, 1, 1, count), level), generator=torch.Generator().manual_seed(0)).double()


def _statistics(sensor: SensorNoise, level: float) -> float:
    """Error of mean and variance in units of their standard errors, of electrons that are Poisson, unclipped."""
    taken = _take(sensor, level)
    variance = float(sensor.std(torch.tensor(level, dtype=torch.float64)) ** 2)
    if variance == 0:
        return difference(taken, torch.full_like(taken, level))
    count = taken.numel()
    mean_error = abs(float(taken.mean()) - level) / math.sqrt(variance / count)
    # Kurtosis of a Poisson variable of mean m is 3 + 1/m.
    electrons = max(level * (sensor.full_well or math.inf), 1e-12)
    kurtosis = 3 + (0.0 if math.isinf(electrons) else 1 / electrons)
    spread = variance * math.sqrt((kurtosis - 1) / count)
    return worst([mean_error, abs(float(taken.var()) - variance) / spread])


def _finite(sensor: SensorNoise, *levels: float) -> float:
    return worst([0.0 if bool(_take(sensor, level, 1000).isfinite().all()) else math.nan for level in levels])


def _one_bit() -> float:
    taken = _take(SensorNoise(0.0, bits=1), 0.5, 1000)
    return difference(taken, taken.round())


def _negative() -> float:
    """Round-off below zero, as transforms leave it, is dark."""
    taken = _take(SensorNoise(0.0, full_well=1e4), -2e-9, 1000)
    return float(taken.abs().max())


def rows() -> list[Row]:
    """Return the rows of the sensor."""
    wide = {"clip": False}
    standard = "exact mean and variance, in standard errors of 200,000 samples"
    return [
        Row(GROUP, "light, electrons", "0 (full well 1e4)",
            lambda: _statistics(SensorNoise(0.0, full_well=1e4), 0.0), 0.0, "no electrons"),
        Row(GROUP, "light, electrons", "-2e-5, round-off of a transform", _negative, 0.0, "no electrons"),
        *(Row(GROUP, "light, electrons", text,
              lambda well=well: _statistics(SensorNoise(0.0, full_well=well, **wide), 0.5), SIGMAS, standard)
          for text, well in (("0.5 (full well 1)", 1.0), ("5", 10.0), ("5e4", 1e5), ("5e6", 1e7), ("5e11", 1e12))),
        Row(GROUP, "light, electrons", "1e12", lambda: _statistics(SensorNoise(0.0, full_well=1e12, **wide), 1.0),
            SIGMAS, standard),
        Row(GROUP, "light, full scale", "1e-30, 1e6, 1e30 (HDR)",
            lambda: _finite(SensorNoise(0.01, full_well=1e4, **wide), 1e-30, 1e6, 1e30), 0.0, "finite"),
        Row(GROUP, "read noise, full scale", "0", lambda: _statistics(SensorNoise(0.0), 0.25), 0.0, "the light itself"),
        Row(GROUP, "read noise, full scale", "1e-6, 0.01, 10", lambda: worst(
            [_statistics(SensorNoise(sigma, **wide), 0.5) for sigma in (1e-6, 0.01, 10.0)]), SIGMAS, standard),
        Row(GROUP, "bits", "1", _one_bit, 0.0, "0 and 1 alone"),
        Row(GROUP, "settings", "sigma -1, NaN; full well 0, -1, NaN; dark -1; bits 0",
            refusals(lambda: SensorNoise(-1.0), lambda: SensorNoise(math.nan), lambda: SensorNoise(full_well=0.0),
                     lambda: SensorNoise(full_well=-1.0), lambda: SensorNoise(full_well=math.nan),
                     lambda: SensorNoise(dark=-1.0), lambda: SensorNoise(bits=0)), None),
    ]  # fmt: skip
