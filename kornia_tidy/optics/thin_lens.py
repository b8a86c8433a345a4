"""Thin-lens camera: depth to defocus, the quadratic phase of a scene point at the edge of the pupil."""

from __future__ import annotations

import math
import warnings
from typing import Any

import torch
from torch import Tensor, nn

from kornia_tidy.checks import check_depth, check_metres, check_number, check_part, check_positive, check_values
from kornia_tidy.mode import Mode, torch_mode
from kornia_tidy.optics.materials import Material
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH, check_wavelength
from kornia_tidy.optics.units import OTHER_FOCUS, like_infinity, warn_of_metres, warn_once

FASTEST = 0.5  # f-number at a numerical aperture of 1, the limit of a lens in air
# Limits in metres: from microscope objectives to telescopes, and from the smallest pixels to those of thermal cameras.
FOCAL_LENGTHS, DIAMETERS, PITCHES = (1e-5, 10.0), (1e-6, 10.0), (1e-7, 1e-3)
LONG = 1.2  # metres; few lenses have a longer focal length, and those of telephones have as many millimetres
NEAREST_DEPTH = 1e-18  # metres
_LENGTHS = ("focal_length", "aperture_diameter", "focus_distance", "pixel_pitch", "depth_range", "lens_material")
DEFAULT_DIAMETER = 2.835e-3  # metres; psi of the paper's range at the default focus


def thin_lens_defocus(depth: Tensor, aperture_radius: float, focus_distance: float | Tensor) -> Tensor:
    r"""Return the defocus phase at the pupil edge of a thin lens.

    .. math:: \psi(z) = \frac{\pi R^2}{\lambda_0} \left( \frac{1}{z} - \frac{1}{z_f} \right)

    Args:
        depth: distance to the scene in metres, any shape; ``inf`` is allowed and exact.
        aperture_radius: pupil radius R in metres.
        focus_distance: distance z_f in metres that is in focus; may be ``inf``.

    Returns:
        Defocus in radians at 530 nm, same shape and dtype as ``depth``.

    Convention:
        - Positive is nearer than focus. At another wavelength multiply by 530 nm / wavelength.
        - The phase over the pupil is defocus * rho**2, with rho = 1 at the edge.
        - :meth:`ThinLensCamera.defocus` checks depths. Here those below 1e-18 m count as that, with a gradient of 0.

    Source: Goodman, Introduction to Fourier Optics, section 6.4.

    Example:
        >>> import torch
        >>> thin_lens_defocus(torch.tensor([0.2975, float("inf")]), 1.4175e-3, 0.595).round(decimals=2)
        tensor([ 20.0200, -20.0200])
    """
    scale = math.pi * aperture_radius**2 / REFERENCE_WAVELENGTH
    focus = _at_least_float32(focus_distance) if isinstance(focus_distance, Tensor) else focus_distance
    wide = depth.to(torch.promote_types(depth.dtype, torch.float32))
    # Infinite depth has an inverse of exactly zero.
    return (wide.clamp(min=NEAREST_DEPTH).reciprocal_() - 1 / focus).mul_(scale).to(depth.dtype)


def _depth_range(value: tuple[float, float]) -> tuple[float, float]:
    """Return the nearest and farthest depth of a range, or raise."""
    if isinstance(value, str) or not hasattr(value, "__len__") or len(value) != 2:
        raise TypeError(f"depth_range must be two numbers, (near, far) in metres, got {value!r}")
    near, far = value
    for end in (near, far):
        check_number("depth_range", end, "metres")
    if not 0 < near < far:
        raise ValueError(f"depth_range must be (near, far) with 0 < near < far in metres, got {(near, far)}")
    return near, far


def check_lens(focal_length: float, focus_distance: float | Tensor, f_number: float | None, pixel_pitch: float) -> None:
    """Raise ``ValueError`` unless a lens of these lengths and of this f-number can be made."""
    check_metres("focal_length", focal_length, *FOCAL_LENGTHS, "50 mm is 50e-3")
    if focal_length > LONG:
        warn_once(
            None, "focal_length", f"focal_length is {focal_length:g} m: if these are millimetres, multiply by 0.001"
        )
    check_metres("pixel_pitch", pixel_pitch, *PITCHES, "8 um is 8e-6")
    check_number("focus_distance", focus_distance, "metres")
    if not (focus := number_of(focus_distance)) > focal_length:
        raise ValueError(f"focus_distance must be beyond the focal length {focal_length} m, got {focus}")
    if f_number is not None:
        check_positive("f_number", f_number)
        if f_number < FASTEST * (1 - 1e-9):
            raise ValueError(f"f_number must be at least {FASTEST}, the limit of a lens in air, got {f_number}")


def number_of(value: float | Tensor) -> float:
    """Return a number that may be learnt."""
    return float(value.detach()) if isinstance(value, Tensor) else float(value)


def _at_least_float32(value: Tensor) -> Tensor:
    """Cast half precision to float32: its rounding would shift the defocus by up to a twentieth of a radian."""
    return value.to(torch.promote_types(value.dtype, torch.float32))


class ThinLensCamera(nn.Module):
    r"""A thin lens in front of a sensor: converts metric depth to defocus and sets the sampling of the PSFs.

    Args:
        focal_length: in metres.
        aperture_diameter: diameter of the pupil in metres. Default: 2.835 mm, f/17.6 at 50 mm.
        focus_distance: distance in focus, in metres; ``inf`` is allowed. A float stays fixed. A tensor becomes a
            learnable parameter; then the PSF sampling changes with it, and a capture no longer compiles to a single
            graph.
        pixel_pitch: distance between the sensor's pixels in metres.
        depth_range: nearest and farthest depth in metres that the PSFs cover. Default: from half the focus distance to
            infinity, which is symmetric in defocus.
        lens_material: glass of a single-element lens, which has chromatic aberration; ``focal_length`` is then the one
            at 530 nm. Default: a lens corrected for colour.
        f_number: focal length over diameter of the pupil, in place of ``aperture_diameter``.

    Shape:
        - ``defocus(depth)``: any shape to the same shape.

    Raises:
        ValueError: if a length is out of range (focal length 0.01 mm to 10 m, aperture 1 um to 10 m, pixels 0.1 um to
            1 mm), the lens is faster than f/0.5, both ``aperture_diameter`` and ``f_number`` are given, the focus
            distance is not beyond the focal length, ``depth_range`` is empty, or it is missing for a focus at infinity.
        TypeError: if an argument is of another type.

    Convention:
        - Defocus is in radians at the pupil edge at 530 nm, positive nearer than focus.
        - The PSF is sampled with the image distance s' = 1 / (1/f - 1/z_f), not with the focal length.

    Source: Goodman, Introduction to Fourier Optics, sections 5.1 and 6.4; the default lens spans the range of
    Shah et al., TiDy-PSFs (ICCV 2023): psi from -20 at infinity to +20 at 0.2975 m.

    Example:
        >>> import torch
        >>> camera = ThinLensCamera()
        >>> camera.defocus(torch.tensor([0.298, 0.595, float("inf")])).round(decimals=2)
        tensor([ 19.9500,  -0.0000, -20.0200])
        >>> round(camera.f_number, 1), round(float(camera.image_distance), 5)
        (17.6, 0.05459)
        >>> ThinLensCamera(f_number=8).aperture_diameter
        0.00625
    """

    def __init__(
        self,
        focal_length: float = 50e-3,
        aperture_diameter: float | None = None,
        focus_distance: float | Tensor = 0.595,
        pixel_pitch: float = 8e-6,
        depth_range: tuple[float, float] | None = None,
        lens_material: Material | None = None,
        f_number: float | None = None,
    ) -> None:
        super().__init__()
        if f_number is not None and aperture_diameter is not None:
            raise ValueError(
                f"aperture_diameter or f_number sets the aperture, got both: {aperture_diameter} and {f_number}"
            )
        check_lens(focal_length, focus_distance, f_number, pixel_pitch)
        if f_number is not None:
            aperture_diameter = focal_length / f_number
        elif aperture_diameter is None:
            aperture_diameter = DEFAULT_DIAMETER
        check_metres("aperture_diameter", aperture_diameter, *DIAMETERS, "2.8 mm is 2.8e-3")
        if focal_length < FASTEST * aperture_diameter * (1 - 1e-9):
            raise ValueError(
                f"aperture_diameter must be at most {focal_length / FASTEST:g} m, which is f/{FASTEST}, for a focal "
                f"length of {focal_length:g} m, got {aperture_diameter:g} (2.8 mm is 2.8e-3)"
            )
        if lens_material is not None:
            check_part("lens_material", lens_material, Material, "a material such as kornia_tidy.optics.PMMA")
        self.focal_length = focal_length
        self.aperture_diameter = aperture_diameter
        self.pixel_pitch = pixel_pitch
        self.lens_material = lens_material
        self.focus_distance: float | Tensor = (focus := number_of(focus_distance))
        if isinstance(focus_distance, Tensor):
            del self.focus_distance  # a parameter may not shadow an attribute
            self.focus_distance = nn.Parameter(focus_distance.detach().clone())
        if depth_range is None and math.isinf(focus):
            raise ValueError("a camera focused at infinity needs depth_range=(near, far) in metres, got None")
        near, far = _depth_range(depth_range) if depth_range is not None else (focus / 2, math.inf)
        self.depth_range = (near, far)
        hyperfocal = focal_length * aperture_diameter / pixel_pitch  # infinity is within a pixel
        farthest = min(like_infinity(self.aperture_radius), hyperfocal)
        warn_of_metres(["focus_distance"], [focus], focal_length, farthest)
        if depth_range is not None:
            warn_of_metres(["depth_range"], [near], focal_length, min(farthest, OTHER_FOCUS * focus))
        scale = math.pi * self.aperture_radius**2 / REFERENCE_WAVELENGTH
        # Plain numbers, so that the defocus nodes of a PSF bank do not move with a learnable focus.
        self.defocus_range = (scale * (1 / far - 1 / focus), scale * (1 / near - 1 / focus))

    @property
    def aperture_radius(self) -> float:
        """Radius of the pupil in metres."""
        return self.aperture_diameter / 2

    @property
    def f_number(self) -> float:
        """Focal length over aperture diameter."""
        return self.focal_length / self.aperture_diameter

    @property
    def image_distance(self) -> float | Tensor:
        """Distance s' from the lens to the sensor in metres, 1 / (1/f - 1/z_f)."""
        focus = self.focus_distance
        return 1 / (1 / self.focal_length - 1 / (_at_least_float32(focus) if isinstance(focus, Tensor) else focus))

    def chromatic_defocus(self, wavelength: float) -> float:
        r"""Return the chromatic focal shift: defocus at a wavelength minus defocus at 530 nm, the same at every depth.

        The optical power of a single element is proportional to its index minus one, so

        .. math:: \Delta\psi(\lambda) = \frac{\pi R^2}{\lambda_0} \left( \frac{1}{f} - \frac{1}{f(\lambda)} \right),
            \qquad f(\lambda) = f \, \frac{n(\lambda_0) - 1}{n(\lambda) - 1}

        Args:
            wavelength: in metres.

        Returns:
            Radians at 530 nm, as all defocus; 0 for a lens corrected for colour. It is negative for blue, which
            focuses nearer to the lens.

        Source: Goodman, Introduction to Fourier Optics, section 5.1 (lensmaker's equation); Chang and Wetzstein, ICCV
        2019, for chromatic aberration as a depth cue.

        Example:
            >>> from kornia_tidy.optics.materials import PMMA
            >>> lens = ThinLensCamera(lens_material=PMMA)
            >>> [round(lens.chromatic_defocus(w), 2) for w in (610e-9, 530e-9, 470e-9)]
            [1.8, 0.0, -2.08]
        """
        check_wavelength("wavelength", wavelength)
        if self.lens_material is None:
            return 0.0
        power = (self.lens_material.index(wavelength) - 1) / (self.lens_material.index(REFERENCE_WAVELENGTH) - 1)
        return math.pi * self.aperture_radius**2 / REFERENCE_WAVELENGTH * (1 - power) / self.focal_length

    def defocus(self, depth: Tensor, check_inputs: bool = True) -> Tensor:
        """Return the defocus map of a depth map at 530 nm. See :func:`thin_lens_defocus`.

        Args:
            depth: metres, any shape; ``inf`` is allowed.
            check_inputs: refuse NaN, zero and negative depths, unless values are unknown, as while compiling.

        Returns:
            Radians, same shape and dtype.

        Raises:
            ValueError: if a depth is NaN or not positive.
        """
        looks = check_inputs and depth.numel() and Mode.GRAPH not in torch_mode()
        if looks and (depth.is_meta or not bool(depth.detach().amin() > 0)):  # NaN too
            check_depth(depth)
        return thin_lens_defocus(depth, self.aperture_diameter / 2, self.focus_distance)

    def depth(self, defocus: Tensor) -> Tensor:
        r"""Return the depth map of a defocus map, the inverse of :meth:`defocus`.

        .. math:: 1 / z = 1 / z_{far} + (\psi - \psi_{far}) \, \lambda_0 / (\pi R^2)

        The formula starts at the far end of the range, so that the defocus of infinity gives ``inf`` exactly.

        Args:
            defocus: radians, any shape.

        Returns:
            Metres, same shape and dtype; ``inf`` for the defocus of infinity and for any lower value.

        Example:
            >>> import torch
            >>> camera = ThinLensCamera()
            >>> camera.depth(camera.defocus(torch.tensor([0.3, 1.5, float("inf")])))
            tensor([0.3000, 1.5000,    inf])
        """
        scale = math.pi * self.aperture_radius**2 / REFERENCE_WAVELENGTH
        inverse = 1 / self.depth_range[1] + (_at_least_float32(defocus) - self.defocus_range[0]) / scale
        if isinstance(self.focus_distance, Tensor):  # a learnable focus may have moved since the range was computed
            far = inverse.new_tensor(self.depth_range[1])
            inverse = inverse + (self.defocus_range[0] - self.defocus(far, check_inputs=False)) / scale
        return inverse.clamp(min=0).reciprocal().to(defocus.dtype)

    def resized(self, scale: float) -> ThinLensCamera:
        """Return this camera for images resized by ``scale``: the pixel pitch changes, so PSFs keep their metric size.

        Args:
            scale: new image side over old, positive; 0.5 halves the sides and doubles the pitch.

        Example:
            >>> ThinLensCamera(pixel_pitch=8e-6).resized(0.5).pixel_pitch
            1.6e-05
        """
        check_positive("scale", scale)
        return self.changed(pixel_pitch=self.pixel_pitch / scale)

    def changed(self, **arguments: Any) -> ThinLensCamera:
        """Return this camera with other arguments. A learnable focus stays one, with a parameter of the new camera's.

        Example:
            >>> ThinLensCamera().changed(focus_distance=1.0).extra_repr()[:30]
            '50 mm f/17.6, focus at 1 m, pi'
        """
        return ThinLensCamera(**{name: getattr(self, name) for name in _LENGTHS} | arguments)

    @classmethod
    def for_scene(
        cls,
        depth_range: tuple[float, float],
        defocus_range: tuple[float, float] = (-20.0, 20.0),
        focal_length: float = 50e-3,
        pixel_pitch: float = 8e-6,
        lens_material: Material | None = None,
    ) -> ThinLensCamera:
        r"""Return the camera whose focus and aperture map a range of depths onto a range of defocus.

        Two equations, :math:`\psi(z_{far}) = \psi_{lo}` and :math:`\psi(z_{near}) = \psi_{hi}`, determine R and z_f.

        Args:
            depth_range: nearest and farthest depth in metres; the farthest may be ``inf``.
            defocus_range: defocus at the farthest and at the nearest depth in radians, lo < hi and lo <= 0 <= hi.
            focal_length: in metres.
            pixel_pitch: in metres.
            lens_material: glass of a single element. Default: a lens corrected for colour.

        Raises:
            ValueError: if a range is empty, or the lens would be faster than f/0.5.

        Example:
            >>> import torch
            >>> camera = ThinLensCamera.for_scene((0.5, 4.0))
            >>> camera.defocus(torch.tensor([0.5, 4.0])).round(decimals=3)
            tensor([ 20., -20.])
        """
        near, far = _depth_range(depth_range)
        lo, hi = defocus_range
        if not (lo <= 0 <= hi and lo < hi):
            raise ValueError(f"defocus_range must be (lo, hi) with lo <= 0 <= hi and lo < hi, got {defocus_range}")
        scale = (hi - lo) / (1 / near - 1 / far)
        inverse_focus = 1 / far - lo / scale
        focus = math.inf if inverse_focus == 0 else 1 / inverse_focus
        radius = math.sqrt(scale * REFERENCE_WAVELENGTH / math.pi)
        if focal_length < FASTEST * 2 * radius:
            raise ValueError(
                f"depths from {near:g} to {far:g} m need an aperture of {2 * radius:.3g} m for a defocus from {lo:g} "
                f"to {hi:g} rad, and a focal length of {focal_length:g} m allows {focal_length / FASTEST:g} m: if they "
                f"are millimetres, multiply them by 0.001 (--depth-scale 0.001); else ask for less defocus"
            )
        return cls(focal_length, 2 * radius, focus, pixel_pitch, depth_range, lens_material)

    def extra_repr(self) -> str:
        """Return a one-line description of the lens."""
        near, far = self.depth_range
        lo, hi = self.defocus_range
        return (
            f"{self.focal_length * 1e3:g} mm f/{self.f_number:.3g}, focus at {number_of(self.focus_distance):.4g} m, "
            f"pixels of {self.pixel_pitch * 1e6:.3g} um, depths {near:.4g} to {far:.4g} m (psi {hi:+.2f} to {lo:+.2f})"
            f"{'' if self.lens_material is None else ', a single element of ' + self.lens_material.name}"
        )


class DefocusRange(nn.Module):
    r"""A camera for depth maps that hold normalised disparity: maps [0, 1] linearly to a range of defocus.

    The paper's data set has such maps. The camera that it is given only sets the size of the PSF on the sensor.

    Args:
        lo: defocus in radians at a disparity of 0.
        hi: defocus in radians at a disparity of 1.
        camera: aperture, image distance and pixel pitch of the PSFs. Default: :class:`ThinLensCamera`.
        lens: deprecated name of ``camera``, with a warning.

    Raises:
        ValueError: if ``lo`` is not below ``hi``, or both words are given.
        TypeError: if ``camera`` is not a ThinLensCamera.

    Convention:
        - Defocus is in radians at the pupil edge at 530 nm, positive nearer than focus, so 1 is nearest.

    Source: Wu et al., PhaseCam3D (ICCP 2019), section 4; Shah et al., TiDy-PSFs (ICCV 2023), section 5.

    Example:
        >>> import torch
        >>> DefocusRange(-20, 20).defocus(torch.tensor([0.0, 0.5, 1.0]))
        tensor([-20.,   0.,  20.])
    """

    def __init__(
        self,
        lo: float = -20.0,
        hi: float = 20.0,
        camera: ThinLensCamera | None = None,
        *,
        lens: ThinLensCamera | None = None,
    ) -> None:
        super().__init__()
        if lens is not None:
            if camera is not None:
                raise ValueError("a DefocusRange takes camera= or its old word lens=, not both")
            warnings.warn("DefocusRange(lens=...) is now DefocusRange(camera=...)", FutureWarning, stacklevel=2)
            camera = lens
        if not (math.isfinite(lo) and math.isfinite(hi) and lo < hi):
            raise ValueError(f"a defocus range must be finite with lo < hi, got lo={lo}, hi={hi}")
        self.defocus_range = (float(lo), float(hi))
        self.lens = ThinLensCamera() if camera is None else camera  # the name in states
        check_part("camera", self.lens, ThinLensCamera, "a ThinLensCamera")

    @property
    def aperture_radius(self) -> float:
        """Radius of the pupil in metres."""
        return self.lens.aperture_radius

    @property
    def image_distance(self) -> float | Tensor:
        """Distance from the lens to the sensor in metres."""
        return self.lens.image_distance

    @property
    def pixel_pitch(self) -> float:
        """Distance between the sensor's pixels in metres."""
        return self.lens.pixel_pitch

    def chromatic_defocus(self, wavelength: float) -> float:
        """Return the chromatic focal shift of the lens. See :meth:`ThinLensCamera.chromatic_defocus`."""
        return self.lens.chromatic_defocus(wavelength)

    def defocus(self, depth: Tensor, check_inputs: bool = True) -> Tensor:
        """Return the defocus map of a normalised disparity map.

        Args:
            depth: normalised disparity in [0, 1], any shape; the result has the same shape and dtype.
            check_inputs: refuse NaN and values outside [0, 1], unless values are unknown, as while compiling.

        Raises:
            ValueError: if a value is NaN or outside [0, 1].
        """
        if check_inputs and depth.numel() and Mode.GRAPH not in torch_mode():
            check_values("depth", depth)
            lowest, highest = torch.aminmax(depth.detach())
            if not bool((lowest >= 0) & (highest <= 1)):  # False for NaN too
                bad = depth[~((depth >= 0) & (depth <= 1))][0].item()
                raise ValueError(
                    f"depth of a DefocusRange must be a normalised disparity in [0, 1], got {bad}: metres need a "
                    f"ThinLensCamera"
                )
        lo, hi = self.defocus_range
        return (lo + (hi - lo) * _at_least_float32(depth)).to(depth.dtype)

    def resized(self, scale: float) -> DefocusRange:
        """Return this camera for images resized by ``scale``. See :meth:`ThinLensCamera.resized`."""
        return DefocusRange(*self.defocus_range, self.lens.resized(scale))

    def extra_repr(self) -> str:
        """Return a one-line description of the range."""
        lo, hi = self.defocus_range
        return f"normalised disparity 0 to 1 means psi {lo:+.4g} to {hi:+.4g} rad"
