"""From a defocus map and a PSF bank to the irradiance on the sensor.

An image in linear light, its defocus and a PSF bank come in; the blurred image goes out. Read ``compositing.py`` first:
gather, scatter and occlusion; how each is computed stands in ``backends/``.
"""

from kornia_tidy.render.compositing import gather, occlusion, render, scatter
from kornia_tidy.render.layers import assign_layers, layer_weights

__all__ = [
    "assign_layers",
    "gather",
    "layer_weights",
    "occlusion",
    "render",
    "scatter",
]
