"""Limits of a PSF model: the types of its parts, and the defocus that its PSFs can hold."""

from __future__ import annotations

import math

from torch import Tensor, nn

from kornia_tidy.checks import check_part
from kornia_tidy.fidelity import Fidelity
from kornia_tidy.optics.lens.lens import Lens
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH, Spectrum
from kornia_tidy.optics.thin_lens import DefocusRange, ThinLensCamera

PARTS: dict[str, tuple[type, str, str]] = {
    "masks": (nn.Module, "phase masks such as PixelwiseMask(5)", "dispersion"),
    "camera": (nn.Module, "a camera such as ThinLensCamera() or DefocusRange()", "chromatic_defocus"),
    "modulator": (nn.Module, "a modulator such as DwellTimes()", ""),
    "spectrum": (Spectrum, "a Spectrum such as Spectrum.rgb()", ""),
    "fidelity": (Fidelity, "a Fidelity such as Fidelity.preset('balanced')", ""),
}
"""Of each part its type, an example for people, and an attribute that its type must have."""

WIDEST_BLUR = 10  # times the largest window, which then holds 1.3 % of the light: 1 / (pi / 4 * 100)
LEAST_WINDOW = 41  # px; a smaller limit than that of the presets asks for small PSFs, whatever the lens
WIDEST_DISC = 257  # px; up to here the window holds the lens's disc
USUAL_WINDOW = 65  # px; small pictures have smaller ones, which says nothing of the lens
MOST_LAYERS = 4096
MOST_DEFOCUS = 2e4  # rad of a node that is asked for: half a second, which grows with the square


def check_defocus_range(
    defocus_range: tuple[float, float], step: float | Tensor, fidelity: Fidelity, window: int | None
) -> None:
    """Refuse a range of defocus with too many layers or too wide PSFs, before any work.

    Out of focus a point is a disc, by rays of diameter ``2 |psi| 530 nm / (pi s)`` pixels: the gradient of the phase
    ``psi rho^2`` at the edge of the pupil.

    Args:
        defocus_range: in radians.
        step: s, a sensor pixel seen from the pupil in metres.
        fidelity: how many layers, and the largest window.
        window: side of the PSFs in pixels if it is fixed.

    Raises:
        ValueError: if the range does not ascend, there are more than 4096 layers, or a disc is wider than 10 of the
            largest windows (at least of 65 px).

    Example:
        >>> check_defocus_range((-20.0, 20.0), 2.1e-7, Fidelity(), None)
        >>> check_defocus_range((-19375.0, 19375.0), 2e-7, Fidelity(), None)
        Traceback (most recent call last):
        ValueError: a defocus from -1.938e+04 to 1.938e+04 rad needs 19375 layers of PSFs 32686 px wide, of which at \
most 4096 and 650 px are allowed: give lengths in metres, choose a smaller aperture or depth_range, or raise \
Fidelity.max_window or layer_spacing
    """
    lo, hi = defocus_range
    if not lo < hi:  # True for NaN
        raise ValueError(f"defocus_range must be (lo, hi) with lo < hi, got {(lo, hi)}")
    size = float(step.detach()) if isinstance(step, Tensor) else step
    blur, layers = 2 * max(-lo, hi) * REFERENCE_WAVELENGTH / (math.pi * size), (hi - lo) / fidelity.layer_spacing
    widest = WIDEST_BLUR * max(window or 0, fidelity.max_window, USUAL_WINDOW)
    if blur > widest or layers > MOST_LAYERS:
        raise ValueError(
            f"a defocus from {lo:.4g} to {hi:.4g} rad needs {layers:.0f} layers of PSFs {blur:.0f} px wide, of which "
            f"at most {MOST_LAYERS} and {widest} px are allowed: give lengths in metres, choose a smaller aperture or "
            f"depth_range, or raise Fidelity.max_window or layer_spacing"
        )


def fitting_lens(
    lens: Lens | str, camera: ThinLensCamera | DefocusRange, fidelity: Fidelity, spectrum: Spectrum
) -> Lens:
    """Return a lens that is the camera's: the one given, or the one of a name at the camera's aperture and focus.

    Args:
        lens: a lens, or a name.
        camera: whose focal length, f-number and focus must be the lens's.
        fidelity: how exactly to compute.
        spectrum: wavelengths that the lens of a name is made for.

    Raises:
        TypeError: if it is neither.
        ValueError: if no lens has this name, or it is not the camera's.

    Example:
        >>> fitting_lens("single-50mm", ThinLensCamera(), Fidelity(), Spectrum.rgb()).name
        'single-50mm'
        >>> fitting_lens("triplet-50mm", ThinLensCamera(35e-3), Fidelity(), Spectrum.rgb())
        Traceback (most recent call last):
        ValueError: the focal length of the lens 'triplet-50mm' must be the camera's, got 0.0499917 m and 0.035 m: \
take lens.camera(pixel_pitch) or ThinLensCamera(focal_length=0.0499917, ...)
    """
    check_part("lens", lens, (Lens, str), "a Lens or the name of one such as 'double-gauss-50mm'")
    if fidelity.propagation == "paper":
        raise ValueError("fidelity 'paper' means an ideal lens, got a lens: leave it out, or use another fidelity")
    own = camera.lens if isinstance(camera, DefocusRange) else camera
    if isinstance(own.focus_distance, Tensor):
        raise ValueError("the focus of a camera with a lens must be a number, got a parameter that is learnt")
    if own.lens_material is not None:
        raise ValueError(
            f"a lens has its own colours, and the camera is a single element of {own.lens_material.name}: leave "
            f"lens_material out"
        )
    if isinstance(lens, str):
        waves = {*spectrum.wavelengths, REFERENCE_WAVELENGTH}
        lens = Lens.named(lens, own.f_number, own.focus_distance, sorted(waves))
    for attribute, words, unit in _LENS_VALUES:
        its, cameras = getattr(lens, attribute), getattr(own, attribute)
        if not (its == cameras or abs(its - cameras) <= _ALIKE * cameras):
            raise ValueError(
                f"the {words} of the lens {lens.name!r} must be the camera's, got {its:.6g}{unit} and "
                f"{cameras:.6g}{unit}: take lens.camera(pixel_pitch) or ThinLensCamera({attribute}={its:.6g}, ...)"
            )
    return lens


_ALIKE = 1e-3  # of lengths of a lens and its camera
_LENS_VALUES = (
    ("focal_length", "focal length", " m"),
    ("f_number", "f-number", ""),
    ("focus_distance", "focus", " m"),
)
