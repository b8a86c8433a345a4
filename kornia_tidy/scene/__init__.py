"""Geometry: from a defocus map and a PSF bank to the irradiance on the sensor."""

from kornia_tidy.scene.compositing import gather, render, scatter
from kornia_tidy.scene.layers import assign_layers, layer_weights

__all__ = ["assign_layers", "gather", "layer_weights", "render", "scatter"]
