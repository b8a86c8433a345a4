"""Rows of the lens: depth, focus, aperture, wavelength."""

from __future__ import annotations

import math
from fractions import Fraction

import torch

from kornia_tidy import Fidelity, PixelwiseMask, Spectrum, ThinLensCamera, TiDyOptics
from kornia_tidy.optics import thin_lens_defocus
from tests.extremes.row import Row, difference, refusals, rounding, scene, worst

LENS, CAPTURE = "the lens law in rational numbers, in ulp of the larger term", "float64, full scale 1"
BOUND = 1e-4  # of full scale, float32 against float64
INF = math.inf


def optics(masks: int = 1, fidelity: str | Fidelity = "draft", **options: object) -> TiDyOptics:
    """Return a camera without noise in linear light, with random masks."""
    generator = torch.Generator().manual_seed(0)
    return TiDyOptics(
        PixelwiseMask(masks, generator=generator), sensor=None, color_space="linear", fidelity=fidelity, **options
    )


def _defocus_error(depths: list[float], focus: float) -> float:
    """Defocus in float32 against rational arithmetic, in units of the float32 spacing at the larger of its terms."""
    radius = 1.4175e-3
    scale = Fraction(math.pi * radius**2 / 530e-9)
    errors = []
    for depth in depths:
        single = torch.tensor(depth, dtype=torch.float32)
        found = float(thin_lens_defocus(single, radius, focus))
        near = Fraction(0) if math.isinf(depth) else 1 / Fraction(float(single))
        far = Fraction(0) if math.isinf(focus) else 1 / Fraction(focus)
        size = float(scale * max(near, far)) or 1.0
        errors.append(abs(float(Fraction(found) - scale * (near - far))) / (size * 2**-24))
    return worst(errors)


def _depths(*values: float) -> float:
    """A capture of a scene at these depths alone, in columns."""
    image, _ = scene()
    depth = torch.tensor(values, dtype=torch.float64)[torch.arange(44) % len(values)].expand(1, 1, 40, 44)
    return rounding(optics(), image, depth.contiguous())


def _checkerboard(near: float, far: float) -> float:
    image, depth = scene()
    rows, columns = torch.arange(40)[:, None], torch.arange(44)
    return rounding(optics(), image, torch.where((rows + columns) % 2 == 0, near, far).to(depth).expand_as(depth))


def _one_odd_pixel() -> float:
    image, depth = scene()
    depth = torch.full_like(depth, INF)
    depth[..., 20, 14] = 1e-6
    return rounding(optics(), image, depth)


def _clamped() -> float:
    """Depths beyond the range are those of its ends."""
    camera, (image, _) = optics(), scene()
    near, far = camera.camera.depth_range
    shape = (1, 1, 40, 44)
    nearer, ends = camera(image, torch.full(shape, 1e-6).double()), camera(image, torch.full(shape, near).double())
    assert math.isinf(far)
    return difference(nearer, ends)


def _lens(**lens: float) -> float:
    image, _ = scene()
    camera = ThinLensCamera(**lens)
    near, far = camera.depth_range
    nearness = torch.linspace(1 / far if math.isfinite(far) else 0.0, 1 / near, 44, dtype=torch.float64)
    depth = nearness.reciprocal().expand(1, 1, 40, 44).contiguous()
    return rounding(optics(camera=camera, fidelity="balanced"), image, depth)


def _wavelength(metres: float) -> float:
    image, depth = scene()
    spectrum = Spectrum((metres,), ((1.0,),) * 3)
    return rounding(optics(spectrum=spectrum), image, depth)


def _with_depth(value: float) -> object:
    image, depth = scene()
    depth[..., 3, 4] = value
    return optics()(image, depth)


def rows() -> list[Row]:
    """Return the rows of the lens."""
    depths = [10.0**power for power in range(-6, 13)] + [INF, 0.595, math.nextafter(0.595, 1)]
    infinity = torch.tensor(INF)
    return [
        Row("Depth and lens", "depth, m", "1e-6 ... 1e12, inf, focus at 0.595 and at infinity",
            lambda: max(_defocus_error(depths, 0.595), _defocus_error(depths, INF)), 6.0, LENS,
            "at most 5 roundings and that of the focus: cancellation near focus costs no more than the terms have"),
        Row("Depth and lens", "depth, m", "1e-6 ... 1e12 and inf beside each other",
            lambda: _depths(1e-6, 1e-3, 0.3, 1.0, 1e6, 1e12, INF), BOUND, CAPTURE),
        Row("Depth and lens", "depth, m", "one value everywhere: 0.2975, 0.595, inf",
            lambda: worst([_depths(value) for value in (0.2975, 0.595, INF)]), BOUND, CAPTURE),
        Row("Depth and lens", "depth, m", "checkerboard of 1e-6 and inf", lambda: _checkerboard(1e-6, INF), BOUND,
            CAPTURE),
        Row("Depth and lens", "depth, m", "one pixel at 1e-6 m, the rest at infinity", _one_odd_pixel, BOUND, CAPTURE),
        Row("Depth and lens", "depth, m", "nearer than the camera's range", _clamped, 1e-12,
            "the end of the range, float64", "clamped; counted in clamped_pixels"),
        Row("Depth and lens", "depth, m", "0, -1, NaN, -inf",
            refusals(*(lambda value=value: _with_depth(value) for value in (0.0, -1.0, math.nan, -INF))), None),
        Row("Depth and lens", "focus, m", "macro 0.0501 (50 mm lens), depth range 0.05005 to 0.05015",
            lambda: _lens(focus_distance=0.0501, depth_range=(0.05005, 0.05015)), BOUND, CAPTURE),
        Row("Depth and lens", "focus, m", "infinity, depths from 10 m",
            lambda: _lens(focus_distance=INF, depth_range=(10.0, INF)), BOUND, CAPTURE),
        Row("Depth and lens", "focus, m", "infinity without a depth range; 0.05 m, the focal length",
            refusals(lambda: ThinLensCamera(focus_distance=INF), lambda: ThinLensCamera(focus_distance=infinity),
                     lambda: ThinLensCamera(focus_distance=0.05)), None),
        Row("Depth and lens", "f-number", "f/0.5 (focused at 1 m, depths 0.999 to 1.001 m)",
            lambda: _lens(aperture_diameter=0.1, focus_distance=1.0, depth_range=(0.999, 1.001)), BOUND, CAPTURE),
        Row("Depth and lens", "f-number", "f/2.8, f/500", lambda: worst([
            _lens(aperture_diameter=0.05 / 2.8, focus_distance=2.0, depth_range=(1.9, 2.1)),
            _lens(aperture_diameter=1e-4)]), BOUND, CAPTURE),
        Row("Depth and lens", "f-number", "f/0.49; apertures 0, NaN, 11 m",
            refusals(*(lambda value=value: ThinLensCamera(aperture_diameter=value)
                       for value in (0.05 / 0.49, 0.0, math.nan, 11.0))), None),
        Row("Depth and lens", "f-number", "f/0.5 at default depths: PSFs 19,000 px wide",
            refusals(lambda: TiDyOptics(camera=ThinLensCamera(aperture_diameter=0.1))), None),
        Row("Depth and lens", "pixel pitch, m", "1e-7 and 1e-3",
            lambda: worst([_lens(pixel_pitch=1e-3), _lens(pixel_pitch=1e-7, aperture_diameter=5e-5)]), BOUND, CAPTURE,
            slow=True),
        Row("Depth and lens", "pixel pitch and focal length, m", "0, 1e-8, 1e-2; 1e-6, 11, NaN",
            refusals(*(lambda value=value: ThinLensCamera(pixel_pitch=value) for value in (0.0, 1e-8, 1e-2)),
                     *(lambda value=value: ThinLensCamera(focal_length=value) for value in (1e-6, 11.0, math.nan))),
            None),
        Row("Depth and lens", "wavelength, m", "200 nm, 530 nm, 2 um, 20 um",
            lambda: worst([_wavelength(value) for value in (200e-9, 530e-9, 2e-6, 20e-6)]), BOUND, CAPTURE),
        Row("Depth and lens", "wavelength, m", "530, 0, NaN, 21 um",
            refusals(*(lambda value=value: Spectrum((value,), ((1.0,),)) for value in (530.0, 0.0, math.nan, 21e-6))),
            None),
    ]  # fmt: skip
