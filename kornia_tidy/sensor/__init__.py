"""Sensor: converts irradiance to the values that a camera records, with shot, dark and read noise.

A linear-light image in units of full scale comes in. The same image with noise, quantised and clipped, goes out. Read
``sensor.py`` first, which adds the noise; ``steps.py`` has shot noise and quantisation as functions,
``fixed_pattern.py`` the differences between pixels, ``exposure.py`` the light that an f-number admits.
"""

from kornia_tidy.sensor.exposure import electrons_at, exposed_sensor, full_well_of
from kornia_tidy.sensor.fixed_pattern import draw_pattern
from kornia_tidy.sensor.sensor import Sensor, SensorNoise
from kornia_tidy.sensor.steps import quantize, shot_noise

__all__ = [
    "Sensor",
    "SensorNoise",
    "draw_pattern",
    "electrons_at",
    "exposed_sensor",
    "full_well_of",
    "quantize",
    "shot_noise",
]
