r"""An independent model of the whole camera, to judge the library by: slow, plain, float64, NumPy alone.

Every function is the formula in its docstring, written from the physics and not from the library. There is no FFT, no
factorisation into rows and columns, no tile, and each state of an exposure is rendered by itself. Start
with ``psfs.py``; ``scene.py`` renders scenes with PSFs, ``values.py`` has sRGB and noise.

Units and conventions: metres and radians; psi is defocus in radians at the pupil's edge at 530 nm, positive nearer than
focus. Axes are (y, x), x to the right and y down. Arrays: heights (K, N, N), PSFs (D, C, P, P) with the chief ray in
the middle pixel and layers from far to near, images (C, H, W), maps of psi (H, W).
"""

from tests.oracle.psfs import channels, defocus, disc, fused_silica, image_distance, paper_psfs, psfs, switching_shares
from tests.oracle.scene import capture, layer_weights, retained_stray_light, stray_light
from tests.oracle.values import decode, encode, noise_moments

__all__ = [
    "capture",
    "channels",
    "decode",
    "defocus",
    "disc",
    "encode",
    "fused_silica",
    "image_distance",
    "layer_weights",
    "noise_moments",
    "paper_psfs",
    "psfs",
    "retained_stray_light",
    "stray_light",
    "switching_shares",
]
