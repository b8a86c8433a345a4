"""Fidelity: the settings of the speed-accuracy trade-off, and presets of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from numbers import Integral

from kornia_tidy.checks import check_choice, check_count, check_number, check_part, check_positive

LAYERS = ("nearest", "linear", "cubic", "bandlimited")
WIDEST_WINDOW = 4095  # pixels; a PSF of three colours then takes 0.19 GiB


@dataclass(frozen=True)
class Fidelity:
    """Settings of the speed-accuracy trade-off. Presets: ``paper``, ``draft``, ``balanced``, ``reference``.

    Errors of the preset ``reference``, as the root mean square error of a capture, full scale 1:

    - light beyond its window, which is the smallest that holds 97 % but at most 257 px; the rest is spread evenly over
      the image. Against windows of 513 and 641 px, on dead leaves: 9e-4 for five random masks (95 % held) and a flat
      one (43 px), 7e-4 for a smooth one and Fresnel lenses. On photographs, which are brighter on one side than on the
      other, more: with a random mask 1.2e-3 on Middlebury's Motorcycle, 2.5e-3 on Aloe. For the five random masks
      385 px would be at 4e-4, for 2.2 times the PSFs' time and memory. The table shows the effect of borders.
    - depths between its layers: 1.5e-6 for random masks, against linear layers 1/64 rad apart (linear layers 1 rad
      apart: 4e-5); up to 1e-4 for a flat mask in focus on black and white shapes.
    - integration over sensor pixels: 5e-12, and rounding.
    - sampling of the spectrum: the reference uses all wavelengths of the camera's spectrum. The error from sampling a
      continuous spectrum at these wavelengths is not included.

    Errors against the reference are therefore true errors down to some 2e-3. Smaller ones compare layers, quadrature
    points and precision for the light within the window.

    The borders, against PSFs of 801 px and the border's continuation of the image (160 x 200 px, one depth, psi = 0,
    530 nm), for white, one half black and the other white, and dead leaves:

    ======================  =======================  =======================
    border                  random mask, 257 px      flat mask, 43 px
    ======================  =======================  =======================
    ``"reflect"``           0, 3.3e-3, 1.1e-3        0, 5.1e-3, 9.0e-4
    ``"replicate"``         0, 5.9e-3, 2.0e-3        0, 5.3e-3, 9.2e-4
    ``"circular"``          0, 6.2e-3, 1.3e-3        0, 3.7e-3, 7.2e-4
    ``"zero"``              8.9e-4, 9.5e-4, 3.5e-4   1.0e-3, 3.2e-3, 6.7e-4
    ``"zero"``, occlusion   1e-6, 2.0e-3, 4.1e-4     1e-6, 2.9e-3, 6.0e-4
    ======================  =======================  =======================

    Where the border continues the image, the error of the stray light is the difference of the light there from the
    image's mean, at most the share of stray light times the contrast. With ``"zero"`` only as much is spread as stays
    in the image (:func:`kornia_tidy.render.stray_light.share_within`), which is nothing for a window of ``2 *
    max(height, width) - 1`` pixels: then nothing is left out. Of the other choices, ``"renormalize"`` gives white right
    but for ``"zero"`` (3.3e-2 with the random mask), and ``"discard"`` darkens it by all that is lost (3.8e-2) but for
    ``"zero"`` (2.1e-3). With ``"valid"`` the light beyond the image is unknown; the image's mean replaces it.

    :meth:`kornia_tidy.TiDyOptics.plan` chooses layers by tolerance: of all kinds and spacings, the cheapest with an
    error on the scene within the tolerance. On 35 photographs with a random mask that was ``"nearest"`` 4 or 8 rad
    apart for 1e-1 and mostly for 1e-2, ``"linear"`` 2 or 4 rad apart for 1e-3, 1 rad for 1e-4, 0.5 rad or ``"cubic"`` 1
    rad apart for 1e-5, and ``"bandlimited"`` for 1e-6.

    Args:
        name: name of the fidelity, for messages.
        propagation: ``"exact"`` integrates every pixel of the mask and of the sensor; ``"paper"`` is the published
            discretisation (one FFT on the 23x23 pupil, point samples), which wraps light around beyond psi = 14.7.
        pixel_tolerance: error allowed to the integral over a sensor pixel of the finest pattern the pupil can make
            there. That of a whole PSF (L1, in its window) was at most an eighth of it with three points a pixel or
            more, which every published system has, a sixth with two and 0.3 of it with one. ``"balanced"`` stays
            below 0.1 %, ``"draft"`` below 3 % and ``"reference"`` below 1e-6, for masks of every family and 400 to
            700 nm (``tests/psf/test_exact.py``). Only for exact propagation.
        layers: interpolation of PSFs over defocus: ``"nearest"``, ``"linear"``, ``"cubic"``, or ``"bandlimited"``,
            which is nearly exact and takes more layers where the aperture and the wavelengths ask for it: see
            :func:`kornia_tidy.psf.defocus_interpolation.interpolable_spacing`. Gradients to depth converge more
            slowly than images: with layers 2 rad apart they are off by 24 to 37 % (linear), 9 to 18 % (cubic) and 4 to
            7 % (band-limited), relative L2 on textured ramps of depth behind random masks.
        layer_spacing: distance between the computed PSFs in radians of defocus.
        wavelengths: at most so many, where the camera's spectrum has more: neighbours then stand together for one, see
            :func:`kornia_tidy.psf.spectral_binning.bin_spectrum`. Default: all that the spectrum has.
        window: side of the PSFs in pixels, odd. Default: measured, by the next two.
        enclosed_energy: share of the light that the PSF window must hold, at focus and at both ends of the range.
        max_window: largest side of the PSF window in pixels. Where it holds less than ``enclosed_energy`` because the
            defocus disc of the lens is wider, the window is that of the disc, up to 257 px, unless it is below 41 px.
        stray_light: treatment of the light outside the window. ``"renormalize"`` scales the window to sum one,
            ``"veil"`` spreads the light evenly over the image (with the border ``"zero"`` only the part that stays
            inside it), and ``"discard"`` drops it.
        double: compute in float64 whatever the type of the image; in float32 on a device without float64, such as
            Apple's ``mps``.
        correlate: rotate PSFs by 180 degrees, as the PhaseCam3D family does.
        occlusion_states: time average for occlusion-aware compositing, for which averaging PSFs is not exact.
            ``"each"`` renders every state of the exposure and averages the images. ``"mean"`` renders once with the
            average PSFs, in a fifth of the time for five masks. With five random masks, the Aloe scene and
            ``balanced``, its error is 1.6e-5 RMS of full scale, 5e-4 at most.
        wide_blur: layers and PSFs of a lens without a mask, of f/5.6 or faster on pixels of 6 um. ``"rays"`` spaces
            layers by the radius of the disc, convolves large discs on coarser grids, and takes geometric-optics PSFs
            for them, see :mod:`kornia_tidy.psf.wide_blur`. ``"waves"`` keeps evenly spaced layers of exact PSFs in one
            window. Any mask that is not flat is always rendered by waves.
        field_tolerance: relative error (L2) that PSFs of a real lens may have between the places over the picture at
            which they are computed; there are as many of these as it takes, see
            :func:`kornia_tidy.psf.field_nodes.field_nodes`.

    Raises:
        ValueError: if a value is not allowed.

    Example:
        >>> Fidelity.preset("balanced").layers
        'linear'
        >>> Fidelity.preset("draft").replace(layer_spacing=2.0).name
        'draft, changed'
    """

    name: str = "balanced"
    propagation: str = "exact"
    pixel_tolerance: float = 1e-2
    layers: str = "linear"
    layer_spacing: float = 2.0
    wavelengths: int | None = None
    window: int | None = None
    enclosed_energy: float = 0.8
    max_window: int = 65
    stray_light: str = "renormalize"
    double: bool = False
    correlate: bool = False
    occlusion_states: str = "each"
    wide_blur: str = "rays"
    field_tolerance: float = 2e-2

    def __post_init__(self) -> None:
        check_choice("propagation", self.propagation, ("exact", "paper"))
        check_choice("layers", self.layers, LAYERS)
        check_choice("stray_light", self.stray_light, ("renormalize", "veil", "discard"))
        check_choice("occlusion_states", self.occlusion_states, ("each", "mean"))
        check_choice("wide_blur", self.wide_blur, ("rays", "waves"))
        check_positive("pixel_tolerance", self.pixel_tolerance)
        check_positive("field_tolerance", self.field_tolerance)
        check_positive("layer_spacing", self.layer_spacing, "radians")
        check_part("name", self.name, str, "a text")
        for flag in ("double", "correlate"):
            check_choice(flag, getattr(self, flag), (False, True))
        check_number("enclosed_energy", self.enclosed_energy)
        if not 0 < self.enclosed_energy < 1:
            raise ValueError(f"enclosed_energy must be between 0 and 1, got {self.enclosed_energy}")
        if self.wavelengths is not None:
            check_count("wavelengths", self.wavelengths)
        for name, side in (("window", self.window), ("max_window", self.max_window)):
            if side is not None and (not isinstance(side, Integral) or side < 1 or side % 2 == 0):
                raise ValueError(f"{name} must be an odd number of pixels, got {side}")
            if side is not None and side > WIDEST_WINDOW:
                raise ValueError(
                    f"{name} must be at most {WIDEST_WINDOW} pixels, got {side}: a PSF of three colours would take "
                    f"{3 * 4 * side**2 / 2**30:.3g} GiB, at each depth"
                )

    @property
    def blurs_by_rays(self) -> bool:
        """Whether these settings allow the approximations of wide blur."""
        usual = self.layers in ("nearest", "linear") and self.stray_light == "renormalize" and not self.correlate
        return self.wide_blur == "rays" and self.propagation == "exact" and self.window is None and usual

    @classmethod
    def preset(cls, name: str) -> Fidelity:
        """Return a preset by name.

        ``draft`` is for previews, ``balanced`` (the default) for training, ``reference`` for measuring the errors of
        the others, and ``paper`` for reproducing published numbers.

        Raises:
            ValueError: if no preset has this name.
        """
        check_choice("fidelity", name, tuple(PRESETS))
        return PRESETS[name]

    @classmethod
    def of(cls, value: str | Fidelity) -> Fidelity:
        """Return a fidelity unchanged, or the preset of a name.

        Raises:
            ValueError: if no preset has this name.
            TypeError: if it is neither.
        """
        if isinstance(value, str):
            return cls.preset(value)
        check_part("fidelity", value, Fidelity, f"a Fidelity or one of {', '.join(map(repr, PRESETS))}")
        return value

    def replace(self, **changes: object) -> Fidelity:
        """Return a copy with some settings changed, and a name that says so."""
        return replace(self, **{"name": f"{self.name.removesuffix(', changed')}, changed", **changes})


PRESETS = {
    "paper": Fidelity("paper", propagation="paper", layers="nearest", stray_light="discard", correlate=True),
    "draft": Fidelity(
        "draft",
        pixel_tolerance=1e-1,
        layers="nearest",
        enclosed_energy=0.6,
        max_window=41,
        occlusion_states="mean",
        field_tolerance=1e-1,
    ),
    "balanced": Fidelity(),
    "reference": Fidelity(
        "reference",
        pixel_tolerance=1e-6,
        layers="bandlimited",
        layer_spacing=1.0,
        enclosed_energy=0.97,
        max_window=257,
        stray_light="veil",
        double=True,
        field_tolerance=1e-2,
    ),
}
