"""Rows of what is shown during the exposure: defocus, heights, masks, weights, apertures."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kornia_tidy import DefocusRange, DwellTimes, PixelwiseMask, TiDyOptics
from kornia_tidy.optics import circular_aperture
from tests.extremes.lens import BOUND, CAPTURE
from tests.extremes.row import Row, difference, refusals, rounding, scene, worst

PSFS = "float64, relative to the brightest value of each PSF"
GROUP = "Masks and exposure"


def camera(heights: Tensor | None = None, masks: int = 1, size: int = 23, **options: object) -> TiDyOptics:
    """Return a camera without noise in linear light."""
    generator = torch.Generator().manual_seed(0)
    shown = PixelwiseMask(masks, size, generator=generator) if heights is None else PixelwiseMask(initial=heights)
    return TiDyOptics(shown, **{"sensor": None, "color_space": "linear", "fidelity": "draft", **options})


def random_heights(masks: int, size: int, highest: float) -> Tensor:
    """Return uniformly random heights in metres."""
    generator = torch.Generator().manual_seed(1)
    return highest * torch.rand(masks, size, size, generator=generator, dtype=torch.float64)


def capture(optics: TiDyOptics) -> float:
    """Return the rounding error of a capture of random depths."""
    image, depth = scene()
    return rounding(optics, image, depth)


def psf_error(optics: TiDyOptics, *defocus: float) -> float:
    """Return the largest error of PSFs in float32, relative to the brightest value of each."""
    with torch.no_grad():
        single = optics.psf_bank(dtype=torch.float32, defocus=defocus).psfs.double()
        double = optics.psf_bank(dtype=torch.float64, defocus=defocus).psfs
    return float(((single - double).abs() / double.amax((-2, -1), keepdim=True)).max())


def _geometric_error(psi: float, window: int = 33) -> float:
    """Relative error of the light in the middle of a flat mask's PSF, against a disc of even light."""
    optics = camera(torch.zeros(1, 23, 23), fidelity=camera().fidelity.replace(window=window))
    found = optics.psf_bank(dtype=torch.float64, defocus=(psi,)).energy.detach()
    lens = optics.camera
    distance = 1 / (1 / lens.focal_length - 1 / lens.focus_distance)
    radius = lens.aperture_diameter / 2
    disc = psi / math.pi * 530e-9 / radius * distance / lens.pixel_pitch  # pixels of the disc per radius of the pupil
    cell = 0.1 * disc
    expected = window**2 / (float(circular_aperture(23).sum()) * cell**2)
    return float((found / expected - 1).abs().max())


def _defocus(psi: float) -> float:
    """A scene of all defocus from -psi to psi."""
    optics = camera(camera=DefocusRange(-psi, psi), fidelity="balanced")
    image, _ = scene()
    disparity = torch.linspace(0, 1, 44, dtype=torch.float64).expand(1, 1, 40, 44).contiguous()
    return rounding(optics, image, disparity)


def _copies(count: int) -> float:
    """K copies of a mask against the mask alone."""
    one = random_heights(1, 23, 1e-6)
    image, depth = scene()
    with torch.no_grad():
        alone = camera(one)(image.float(), depth.float())
        many = camera(one.expand(count, -1, -1).contiguous())(image.float(), depth.float())
    return difference(many, alone)


def _weights(*weights: float) -> float:
    return capture(camera(masks=len(weights), modulator=DwellTimes(list(weights))))


def _one_hot() -> float:
    """Weights of one mask alone against that mask alone."""
    heights, (image, depth) = random_heights(3, 23, 1e-6), scene()
    with torch.no_grad():
        chosen = camera(heights, modulator=DwellTimes([0.0, 1.0, 0.0]))(image, depth)
        alone = camera(heights[1:2])(image, depth)
    return difference(chosen, alone)


def _aperture(pixels: Tensor) -> float:
    return capture(camera(aperture=pixels))


def _one_pixel() -> Tensor:
    amplitude = torch.zeros(23, 23)
    amplitude[11, 11] = 1.0
    return amplitude


def _obscured() -> Tensor:
    place = torch.linspace(-1, 1, 23)
    radius = (place[:, None].square() + place.square()).sqrt()
    return ((radius <= 1) & (radius > 0.95)).float()


def _broken(value: float) -> object:
    optics = camera()
    with torch.no_grad():
        optics.masks.phase[0, 3, 4] = value
    image, depth = scene()
    return optics(image, depth)


def _waves(heights: float) -> float:
    return capture(camera(random_heights(1, 23, heights)))


def rows() -> list[Row]:
    """Return the rows of masks and exposure."""
    flat = torch.zeros(1, 23, 23)
    return [
        Row(GROUP, "defocus, rad", "0 everywhere (flat mask)",
            lambda: psf_error(camera(flat, fidelity="balanced"), 0.0), BOUND, PSFS),
        Row(GROUP, "defocus, rad", "-20 ... 20", lambda: _defocus(20.0), BOUND, CAPTURE),
        Row(GROUP, "defocus, rad", "-200 ... 200", lambda: _defocus(200.0), BOUND, CAPTURE, slow=True),
        Row(GROUP, "defocus, rad", "1e3, 1e4 and -1e4, each alone, in a window of 33 px", lambda: worst(
            [psf_error(camera(fidelity=camera().fidelity.replace(window=33)), psi) for psi in (1e3, 1e4, -1e4)]),
            BOUND, PSFS, slow=True),
        Row(GROUP, "defocus, rad", "1e3, 1e4 and -1e4, light in the middle 33 px, flat mask", lambda: worst(
            [_geometric_error(psi) for psi in (1e3, 1e4, -1e4)]), 0.1, "geometric optics, relative",
            "float64; what is left is ripple of diffraction"),
        Row(GROUP, "defocus, rad", "-1e4 ... 1e4: 10,000 layers, blur of thousands of pixels",
            refusals(lambda: camera(camera=DefocusRange(-1e4, 1e4))), None),
        Row(GROUP, "layer spacing, rad", "1e-6: 40 million layers",
            refusals(lambda: TiDyOptics(fidelity=camera().fidelity.replace(layer_spacing=1e-6))), None),
        Row(GROUP, "window, px", "100001, 4097, 22, 0",
            refusals(*(lambda side=side: camera().fidelity.replace(window=side) for side in (100001, 4097, 22, 0))),
            None),
        Row(GROUP, "heights, m", "0", lambda: capture(camera(flat)), BOUND, CAPTURE),
        Row(GROUP, "heights, m", "to 1.2e-6 (the paper's)", lambda: _waves(1.2e-6), BOUND, CAPTURE),
        Row(GROUP, "heights, m", "to 1e-4 (94 waves)", lambda: _waves(1e-4), BOUND, CAPTURE),
        Row(GROUP, "heights, m", "to 1e-3 (943 waves)", lambda: _waves(1e-3), BOUND, CAPTURE),
        Row(GROUP, "heights, m", "1.1e-3, NaN, inf when made",
            refusals(lambda: camera(torch.full((1, 23, 23), 1.1e-3)), lambda: camera(torch.full((1, 23, 23), math.nan)),
                     lambda: camera(torch.full((1, 23, 23), math.inf))), None),
        Row(GROUP, "heights, rad", "NaN, inf, -inf in a parameter, as a diverged training leaves",
            refusals(*(lambda value=value: _broken(value) for value in (math.nan, math.inf, -math.inf))), None),
        Row(GROUP, "masks K", "1, 5, 64", lambda: worst([capture(camera(masks=count)) for count in (1, 5, 64)]), BOUND,
            CAPTURE, slow=True),
        Row(GROUP, "masks K", "256", lambda: capture(camera(masks=256)), BOUND, CAPTURE, slow=True),
        Row(GROUP, "masks K", "64 copies of one mask", lambda: _copies(64), 64 * 2**-23, "the mask alone, float32",
            "bound: a sum of 64 terms"),
        Row(GROUP, "masks K", "0, -1", refusals(lambda: PixelwiseMask(0), lambda: PixelwiseMask(-1)), None),
        Row(GROUP, "dwell times", "0 beside 1; 1e-30 beside 1", lambda: worst([
            _weights(0.0, 1.0), _weights(1e-30, 1.0)]), BOUND, CAPTURE),
        Row(GROUP, "dwell times", "one mask of three alone", _one_hot, 1e-12, "that mask alone, float64"),
        Row(GROUP, "dwell times", "all 0; negative; NaN; inf",
            refusals(*(lambda times=times: DwellTimes(times)
                       for times in ([0.0, 0.0], [1.0, -1.0], [math.nan, 1.0], [math.inf, 1.0]))), None),
        Row(GROUP, "dwell times", "1.7e308 beside 6e307", lambda: _weights(1.7e308, 6e307), BOUND, CAPTURE),
        Row(GROUP, "dwell times", "of no mask",
            refusals(lambda: DwellTimes()(torch.zeros(0, 23, 23)), lambda: DwellTimes([])), None),
        Row(GROUP, "aperture", "one pixel of 23x23", lambda: _aperture(_one_pixel()), BOUND, CAPTURE),
        Row(GROUP, "aperture", "ring of the outer 5 %", lambda: _aperture(_obscured()), BOUND, CAPTURE),
        Row(GROUP, "aperture", "empty; negative; NaN",
            refusals(lambda: camera(aperture=torch.zeros(23, 23)), lambda: camera(aperture=-torch.ones(23, 23)),
                     lambda: camera(aperture=torch.full((23, 23), math.nan))), None),
        Row(GROUP, "mask pixels", "1x1, 2x2, 7x5", lambda: worst([
            capture(camera(random_heights(1, 1, 1e-6))), capture(camera(random_heights(1, 2, 1e-6))),
            capture(camera(random_heights(1, 7, 1e-6)[:, :, :5].contiguous()))]), BOUND, CAPTURE),
        Row(GROUP, "mask pixels", "257x257", lambda: capture(camera(random_heights(1, 257, 1e-6))), BOUND, CAPTURE,
            slow=True),
        Row(GROUP, "mask pixels", "1024x1024", lambda: capture(camera(random_heights(1, 1024, 1e-7))), BOUND, CAPTURE,
            slow=True),
    ]  # fmt: skip
