"""Geometry: from a defocus map and a PSF bank to the irradiance on the sensor."""

from kornia_tidy.scene.compositing import gather, occlusion, render, scatter
from kornia_tidy.scene.layers import assign_layers, layer_weights

__all__ = ["assign_layers", "gather", "layer_weights", "occlusion", "render", "scatter"]
