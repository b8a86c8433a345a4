"""From a defocus map and a PSF bank to the irradiance on the sensor.

An image in linear light, its defocus and a PSF bank (from ``psf/psf_model.py``) come in; the irradiance on the sensor
goes out. Read ``compositing.py`` first (gather, scatter, occlusion), then ``scene.py`` (the input of a backend) and
``dispatch.py`` (the choice of a backend).
"""

from kornia_tidy.render.compositing import gather, occlusion, render, scatter
from kornia_tidy.render.dispatch import explain
from kornia_tidy.render.layers import layer_weights
from kornia_tidy.render.scene import assign_layers, layered_scene

__all__ = [
    "assign_layers",
    "explain",
    "gather",
    "layer_weights",
    "layered_scene",
    "occlusion",
    "render",
    "scatter",
]
