"""Masks of the published systems, and the parts of a camera made of a system's name.

Learnt masks are not included: most have no licence. Each system has the initial mask of its paper. If that is flat,
most systems here start from a mask with their characteristic property instead, and the entry "start" of
``System.sources`` says which.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import nn

from kornia_tidy.masks.base import MASK_SPAN, PhaseMasks
from kornia_tidy.masks.fresnel import FresnelLens
from kornia_tidy.masks.pixelwise import PixelwiseMask
from kornia_tidy.masks.radial import RadialMask
from kornia_tidy.masks.spiral import SpiralMask
from kornia_tidy.masks.zernike import ZernikeMask
from kornia_tidy.modulator.modulator import DiffractionEfficiency, DwellTimes
from kornia_tidy.optics.aperture import circular_aperture
from kornia_tidy.optics.lens.lens import Lens
from kornia_tidy.optics.lens.prescription import Prescription, Surface
from kornia_tidy.optics.materials import NOA61, PMMA
from kornia_tidy.optics.published_systems import SITZMANN_PLATE, SYSTEMS, System, published_system
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH, Spectrum
from kornia_tidy.sensor.sensor import SensorNoise


def published_parts(name: str, generator: torch.Generator | None = None, **overrides: Any) -> dict[str, Any]:
    """Return the arguments of :class:`kornia_tidy.TiDyOptics` for a published system.

    Args:
        name: of the system.
        generator: source of the noise of masks that start from noise. Default: the global generator.
        overrides: arguments that replace the system's. The iris is sampled on the pixels of given masks.
            ``lens="own"`` takes the single element of ``chang2019`` or ``sitzmann2018``, see :func:`single_element`.

    Returns:
        Keyword arguments by name.

    Raises:
        ValueError: if the name is unknown; the message lists the known ones. If ``lens="own"`` is asked of a system
            that is no single element.

    Example:
        >>> parts = published_parts("ikoma2021")
        >>> round(parts["camera"].f_number, 1), parts["compositing"], parts["masks"].phase.shape
        (6.3, 'occlusion', torch.Size([1, 138, 138]))
    """
    system = published_system(name)
    masks = overrides["masks"] if overrides.get("masks") is not None else MASKS[name](generator)
    size = min(masks.phase.shape[-2:])
    if overrides.get("lens") == "own":
        lens = single_element(system, overrides.get("spectrum"))
        own = system.camera()
        colourless = lens.camera(own.pixel_pitch, own.depth_range)  # the colours are those of the lens
        overrides = {"camera": colourless, "aperture": None, **overrides, "lens": lens}
    parts = {
        "camera": system.camera,
        "modulator": lambda: DwellTimes() if system.modulated == 1 else DiffractionEfficiency(system.modulated),
        "sensor": lambda: SensorNoise(system.sigma),
        "aperture": lambda: circular_aperture(size, MASK_SPAN / size, edges="area") if system.smooth_iris else None,
    }
    made = {part: make() for part, make in parts.items() if part not in overrides}
    return {"compositing": system.compositing, "spectrum": system.spectrum, **made, **overrides, "masks": masks}


def single_element(system: System, spectrum: Spectrum | None = None) -> Lens:
    r"""Return the lens of a published system that is a single element, traced from its surfaces.

    .. math:: R = (n(530\,\mathrm{nm}) - 1) \, f

    Args:
        system: ``chang2019`` or ``sitzmann2018``, whose cameras have a ``lens_material``.
        spectrum: wavelengths that the lens is for. Default: those of the system.

    Raises:
        ValueError: if the system is no single element.

    Convention:
        - Focal length, f-number, focus and material are those of the system; ``System.sources`` says which are guesses.
        - The initial plate of ``sitzmann2018`` is known to be plano-convex with this radius R. Its code approximates
          the sphere by a paraboloid.
        - The plano-convex shape of ``chang2019`` is assumed. For both systems so are a sphere towards the scene, a
          thickness of 3 mm, a stop with the mask at the sphere's vertex, and a field up to 5 mm.
        - Astigmatism and field curvature of a thin element in the stop follow from focal length and index, whatever its
          shape. Spherical aberration and coma are those of the assumed shape.

    Source: Welford, Aberrations of Optical Systems (1986), on the thin lens with the stop in contact.

    Example:
        >>> lens = single_element(published_system("sitzmann2018"))
        >>> round(lens.focal_length * 1e3, 2), round(lens.f_number, 2), lens.residual < 1e-3
        (34.28, 6.85, True)
    """
    camera = system.camera()
    glass = camera.lens_material
    if glass is None:
        elements = [name for name, other in SYSTEMS.items() if other.camera().lens_material is not None]
        raise ValueError(f"lens='own' is known of the single elements {' and '.join(elements)}, got {system.name!r}")
    radius = (glass.index(REFERENCE_WAVELENGTH) - 1) * camera.focal_length
    surfaces = Surface(0.0, is_stop=True), Surface(1 / radius, gap=_THICKNESS, glass=glass.name), Surface(0.0)
    element = Prescription(system.name, system.paper, surfaces, {glass.name: glass})
    waves = sorted({*(spectrum or system.spectrum).wavelengths, REFERENCE_WAVELENGTH})
    given = camera.f_number, float(camera.focus_distance), waves, _FIELD, camera.depth_range[0]
    return Lens.from_prescription(element, *given)


_THICKNESS, _FIELD = 3e-3, 5e-3  # m, both assumed


def _ikoma_masks(generator: torch.Generator | None) -> PhaseMasks:
    """Return a radial mask with a smooth random profile: noise at 13 radii, linear between them."""
    knots = 2.05 * torch.randn(1, 1, 13, generator=generator, dtype=torch.float32)
    profile = nn.functional.interpolate(knots, size=61, mode="linear", align_corners=True)[0]
    return RadialMask(1, 138, 61, initial=profile, material=NOA61)


def cubic_in_zernikes(strength: float, num_modes: int = 350) -> torch.Tensor:
    r"""Return the Zernike coefficients of a cubic mask without the tilt that would shift the image.

    .. math:: \alpha (x^3 + y^3) - \tfrac{3}{4} \alpha (x + y)

    The mean gradient of this phase over the pupil is zero, so the centroid of the PSF stays on the axis.

    Args:
        strength: alpha in radians at 530 nm, the cubic's phase at the pupil's edge on the x or y axis.
        num_modes: number M of polynomials, at least 10.

    Returns:
        (M,) radians rms, for :class:`~kornia_tidy.masks.ZernikeMask`.

    Source: Dowski and Cathey, Applied Optics 34(11) 1859 (1995).

    Example:
        >>> cubic_in_zernikes(8.0, 10).round(decimals=3)
        tensor([ 0.0000, -1.0000, -1.0000,  0.0000,  0.0000,  0.0000, -0.7070,  0.7070,
                 0.7070,  0.7070])
    """
    coefficients = torch.zeros(num_modes)
    third = strength / math.sqrt(128)  # x^3 = (Z(3,1) + Z(3,3)) / sqrt(128) + Z(1,1) / 4, and y^3 likewise
    coefficients[[7, 8, 9]], coefficients[6] = third, -third
    coefficients[[1, 2]] = strength / 4 - 0.75 * strength / 2  # Z(1,1) = 2x
    return coefficients


# fmt: off
FISHER_ZERNIKES = (
    0.0,  # radial order 0
    0.0, 0.0,  # radial order 1
    -0.63, 0.01, -0.68,  # radial order 2
    -0.11, -0.11, -0.14, -0.14,  # radial order 3
    0.0, 0.63, 0.0, 0.43, 0.0,  # radial order 4
    0.11, -0.08, -0.09, -0.12, -0.1, -0.14,  # radial order 5
    -0.22, 0.0, -0.03, 0.0, -0.13, 0.0, 0.03,  # radial order 6
    0.1, 0.11, -0.1, -0.09, -0.12, -0.12, -0.1, -0.1,  # radial order 7
    0.0, -0.17, 0.0, 0.24, 0.0, 0.05, 0.0, -0.02, 0.0,  # radial order 8
    -0.06, 0.1, 0.11, -0.08, -0.08, -0.08, -0.08, -0.1, -0.07, -0.09,  # radial order 9
)
# fmt: on
"""Zernike coefficients in radians rms of a mask designed for depth estimation, in the order of OSA/ANSI.

It minimises the Cramér-Rao bound on defocus, averaged over 11 depths from psi = -10 to 10 rad, to 0.0353 rad. The
setting is the lens of PhaseCam3D, and a point at an unknown position with 3000 photons a channel on a
background of 5 photons a pixel. The search was 250 steps of Adam at a rate of 0.05 without tilt, the best of 4 random
starts. See Shechtman et al., Physical Review Letters 113, 133902 (2014).
"""

CUBIC = 27.0
"""Strength of the initial cubic mask of Sitzmann's system, in radians at the pupil's edge."""

MASKS: dict[str, Callable[[torch.Generator | None], PhaseMasks]] = {
    "tidy-5": lambda generator: PixelwiseMask(5, generator=generator),
    "tidy-1": lambda generator: PixelwiseMask(1, generator=generator),
    "fresnel": lambda _: FresnelLens(),
    "phasecam3d": lambda _: ZernikeMask(1, 23, 55, initial=torch.tensor(FISHER_ZERNIKES)),
    "ikoma2021": _ikoma_masks,
    "chang2019": lambda _: ZernikeMask(1, 46, 55, initial="flat", material=PMMA),
    "liu2022-pixelwise": lambda generator: PixelwiseMask(1, 23, generator=generator, material=NOA61),
    "liu2022-spiral": lambda _: SpiralMask(1, 256, 13, initial="rotating", material=NOA61),
    "sitzmann2018": lambda _: ZernikeMask(1, 69, 350, initial=cubic_in_zernikes(CUBIC), material=SITZMANN_PLATE),
}
"""The initial masks of each published system, from the source of their noise."""
