"""Electrons: from irradiance to digital numbers."""

from kornia_tidy.sensor.noise import SensorNoise, quantize
from kornia_tidy.sensor.shot import shot_noise

__all__ = ["SensorNoise", "quantize", "shot_noise"]
