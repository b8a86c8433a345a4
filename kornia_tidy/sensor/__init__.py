"""Electrons: from irradiance to digital numbers."""

from kornia_tidy.sensor.noise import SensorNoise, quantize
from kornia_tidy.sensor.raw_file import RawCapture, RawInfo
from kornia_tidy.sensor.shot import shot_noise

__all__ = ["RawCapture", "RawInfo", "SensorNoise", "quantize", "shot_noise"]
