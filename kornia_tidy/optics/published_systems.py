"""Nine published optical systems as plain data: lens, wavelengths, compositing and noise, each with its source.

A value that no accessible source states is a guess, and its entry in ``System.sources`` begins with that word. Masks
and cameras are made of them in ``camera/published_systems.py``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from kornia_tidy.checks import check_choice
from kornia_tidy.optics.materials import PMMA, cauchy_through
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH, Spectrum
from kornia_tidy.optics.thin_lens import ThinLensCamera

RGB = Spectrum.rgb()
GUESS = "guess"
"""First word in the source of a value that no accessible paper or code states."""


@dataclass(frozen=True)
class System:
    """A published optical system: the values of its parts and their sources.

    Args:
        name: name for :meth:`kornia_tidy.TiDyOptics.from_preset`.
        title: common name.
        paper: publication.
        known_for: its characteristic property in one phrase.
        mask: description of the mask.
        camera: function that returns lens and pixel pitch.
        sources: each value and where it was published; a guess begins with the word "guess".
        spectrum: wavelengths, one for each channel.
        compositing: how depth layers are combined: "gather", "scatter" or "occlusion".
        sigma: standard deviation of the read noise, in units of full scale.
        modulated: fraction of the light that the mask modulates; the rest passes as through no mask.
        smooth_iris: whether the iris is a disc with a smooth edge. False: the published grid of open and shut pixels.

    Example:
        >>> from kornia_tidy.optics.published_systems import published_system
        >>> system = published_system("ikoma2021")
        >>> round(system.camera().f_number, 1), system.compositing
        (6.3, 'occlusion')
        >>> system.guesses
        ('start',)
    """

    name: str
    title: str
    paper: str
    known_for: str
    mask: str
    camera: Callable[[], ThinLensCamera]
    sources: Mapping[str, str]
    spectrum: Spectrum = RGB
    compositing: str = "gather"
    sigma: float = 0.01
    modulated: float = 1.0
    smooth_iris: bool = True

    @property
    def guesses(self) -> tuple[str, ...]:
        """Names of the values that are guesses."""
        return tuple(name for name, source in self.sources.items() if source.startswith(GUESS))

    @property
    def year(self) -> int:
        """Year of publication."""
        return int(re.findall(r"\b20\d\d\b", self.paper)[-1])


# ---------------------------------------------------------------------- the PhaseCam3D family


def _implied_pitch(aperture_radius: float, image_distance: float) -> float:
    """Return the pixel pitch implied by a 27-point transform of mask pixels of 0.1 pupil radii at 530 nm, in metres."""
    return REFERENCE_WAVELENGTH * image_distance / (27 * aperture_radius / 10)


def _tidy_camera() -> ThinLensCamera:
    lens = ThinLensCamera.for_scene((0.2975, math.inf), (-20.0, 20.0))
    pitch = _implied_pitch(lens.aperture_radius, float(lens.image_distance))
    return ThinLensCamera.for_scene((0.2975, math.inf), (-20.0, 20.0), pixel_pitch=pitch)


def _phasecam_camera() -> ThinLensCamera:
    focus, diameter, limit = 0.85, 2.835e-3, 10.0  # metres, metres, radians
    dioptres = limit * REFERENCE_WAVELENGTH / (math.pi * (diameter / 2) ** 2)
    pitch = _implied_pitch(diameter / 2, 1 / (1 / 50e-3 - 1 / focus))
    return ThinLensCamera(50e-3, diameter, focus, pitch, (1 / (1 / focus + dioptres), 1 / (1 / focus - dioptres)))


_TIDY_LENS = {
    "defocus": "psi from -20 to 20 rad in 21 bins: paper, training details",
    "wavelengths": "610, 530, 470 nm: paper, training details",
    "index": "1.5 at every wavelength: code of PhaseCam3D, whose model the paper takes",
    "iris": "317 of 23 x 23 pixels: code of PhaseCam3D",
    "focal length": "50 mm: of PhaseCam3D's lens, and of CodedVO by the same first author",
    "focus": "guess: 0.595 m, at which psi = -20 is infinity",
    "aperture": "guess: 2.834 mm, so that psi is 20 at half that distance; PhaseCam3D's is 2.835 mm",
    "pixels": "7.56 um: implied by a 27-point transform at 530 nm in code of PhaseCam3D",
    "compositing": "gather: paper, equation 1",
    "noise": "guess: 0.01 as in code of PhaseCam3D; the paper is silent",
}
_TIDY_START = "heights uniform on [0, 1.2e-6] m: paper, ablation of the sequence length (extended depth of field)"
_TIDY_PAPER = "Shah, Kulshrestha, Metzler: TiDy-PSFs, ICCV 2023"


# ---------------------------------------------------------------------- Stanford and Hong Kong


def _ikoma_camera() -> ThinLensCamera:
    return ThinLensCamera(50e-3, 50e-3 / 6.3, 1.7, 6.45e-6, (1.0, 5.0))


def _chang_camera() -> ThinLensCamera:
    return ThinLensCamera(50e-3, 50e-3 / 8, 5 / 3, 6.45e-6, (1.0, 5.0), lens_material=PMMA)


SITZMANN_PLATE = cauchy_through(
    "the plate of Sitzmann et al.",
    "code of Sitzmann et al. (2018) at three wavelengths",
    ((460e-9, 1.499), (550e-9, 1.493), (640e-9, 1.488)),
)


def _sitzmann_camera() -> ThinLensCamera:
    focal_length = 1 / (1 / 35.5e-3 + 1 / 1.0)
    return ThinLensCamera(focal_length, 1356 * 3.69e-6, 1.0, 3.69e-6, (0.5, 1000.0), lens_material=SITZMANN_PLATE)


_LIU_SOURCES = {
    "lens": "guess: that of Ikoma et al., whose network and task the paper takes: 50 mm f/6.3 focused at 1.7 m",
    "depth": "guess: 1 to 5 m, as Ikoma et al.",
    "pixels": "guess: 6.45 um, as Ikoma et al.",
    "wavelengths": "guess: 632, 550, 450 nm, as Ikoma et al.",
    "index": "guess: NOA61, as Ikoma et al.",
    "compositing": "guess: occlusion, as Ikoma et al.",
    "noise": "guess: 0.003, as Ikoma et al.",
    "start": "guess: noise of heights uniform on [0, 1.2e-6] m",
}
_LIU = partial(
    System,
    paper="Liu et al.: Investigating deep optics model representation, Optics Express 30(20) 36973, 2022",
    camera=_ikoma_camera,
    spectrum=Spectrum((632e-9, 550e-9, 450e-9), RGB.weights),
    compositing="occlusion",
    sigma=0.003,
)


# ---------------------------------------------------------------------- the table

_ALL = (
    System(
        name="tidy-5",
        title="TiDy, five masks",
        paper=_TIDY_PAPER,
        known_for="five masks in one exposure: average PSFs that no single mask can have",
        mask="5 pixel-wise, 23 x 23, noise",
        camera=_tidy_camera,
        sources={**_TIDY_LENS, "masks": "five of 23 x 23 pixels: paper, training details", "start": _TIDY_START},
        smooth_iris=False,
    ),
    System(
        name="tidy-1",
        title="TiDy, one mask",
        paper=_TIDY_PAPER,
        known_for="one mask for the whole exposure",
        mask="1 pixel-wise, 23 x 23, noise",
        camera=_tidy_camera,
        sources={**_TIDY_LENS, "masks": "one of 23 x 23 pixels: paper, training details", "start": _TIDY_START},
        smooth_iris=False,
    ),
    System(
        name="fresnel",
        title="Fresnel lens",
        paper=f"{_TIDY_PAPER} (its baseline of 0 masks)",
        known_for="a fixed diffractive lens, which focuses each colour at another depth",
        mask="diffractive lens, fixed",
        camera=_tidy_camera,
        sources={
            **_TIDY_LENS,
            "masks": "a fixed Fresnel lens: paper, ablation of the sequence length",
            "strength": "guess: 10 rad, the largest round number that 23 pixels can sample",
        },
        smooth_iris=False,
    ),
    System(
        name="phasecam3d",
        title="PhaseCam3D",
        paper="Wu et al.: PhaseCam3D, ICCP 2019",
        known_for="a mask designed for the best depth estimate of a point (Fisher information)",
        mask="55 Zernikes, 23 x 23, Fisher",
        camera=_phasecam_camera,
        sources={
            "defocus": "psi from -10 to 10 rad in 21 bins: code",
            "wavelengths": "610, 530, 470 nm: code",
            "index": "1.5 at every wavelength: code",
            "iris": "317 of 23 x 23 pixels: code",
            "focal length": "50 mm: paper",
            "focus": "guess: 0.85 m, of CodedVO, which has this lens",
            "aperture": "guess: 2.835 mm, 21 mask pixels of 135 um",
            "pixels": "7.36 um: implied by a 27-point transform at 530 nm in the code",
            "compositing": "gather: code",
            "noise": "0.01: code",
            "masks": "55 Zernikes to radial order 9: code",
            "start": "a Fisher mask, as in the paper, but our own: theirs has no licence",
        },
        smooth_iris=False,
    ),
    System(
        name="ikoma2021",
        title="Ikoma et al.",
        paper="Ikoma et al.: Depth from Defocus with Learned Optics, ICCP 2021",
        known_for="a rotationally symmetric mask with round PSFs, and rendering with occlusion",
        mask="radial profile, 61 radii, noise",
        camera=_ikoma_camera,
        sources={
            "focal length": "50 mm: code",
            "aperture": "f/6.3: code",
            "focus": "1.7 m: code",
            "depth": "1 to 5 m: code",
            "pixels": "6.45 um: code; its colour filter mosaic is left out",
            "wavelengths": "632, 550, 450 nm: code",
            "index": "NOA61, Cauchy's equation: code",
            "compositing": "occlusion: code and paper",
            "noise": "0.003, the middle of 0.001 to 0.005: code",
            "diffraction": "0.7 of the light is modulated by the mask, 0.3 is not: code",
            "masks": "a radial profile: code, of 400 radii; 61 here, which 138 pixels across resolve",
            "start": "guess: noise at 13 radii; the code starts flat",
        },
        spectrum=Spectrum((632e-9, 550e-9, 450e-9), RGB.weights),
        compositing="occlusion",
        sigma=0.003,
        modulated=0.7,
    ),
    System(
        name="chang2019",
        title="Chang and Wetzstein",
        paper="Chang, Wetzstein: Deep Optics for Monocular Depth Estimation and 3D Object Detection, ICCV 2019",
        known_for="a single lens element: red, green and blue are in focus at different depths",
        mask="singlet, 55 Zernikes, flat",
        camera=_chang_camera,
        sources={
            "lens": "a single element with chromatic aberration: abstract; TiDy-PSFs, results",
            "shape": "guess: plano-convex, convex towards the scene, 3 mm thick; for lens='own' only",
            "focal length": "guess: 50 mm; no code, and the paper's numbers could not be read",
            "aperture": "guess: f/8",
            "focus": "guess: 1.67 m, the middle of the depths in dioptres",
            "depth": "guess: 1 to 5 m",
            "pixels": "guess: 6.45 um",
            "wavelengths": "guess: 610, 530, 470 nm",
            "index": "guess: PMMA",
            "compositing": "gather: TiDy-PSFs, background",
            "noise": "guess: 0.01",
            "masks": "a free-form surface: abstract",
            "modes": "guess: 55 Zernikes, as PhaseCam3D",
            "start": "flat: the singlet as it is",
        },
    ),
    _LIU(
        name="liu2022-pixelwise",
        title="Liu et al., pixel-wise",
        known_for="a free height in every pixel of the mask",
        mask="1 pixel-wise, 23 x 23, noise",
        sources={
            **_LIU_SOURCES,
            "masks": "a pixel-wise height map: TiDy-PSFs, results",
            "size": "guess: 23 x 23 pixels",
        },
    ),
    _LIU(
        name="liu2022-spiral",
        title="Liu et al., spiral",
        known_for="rings of vortex phase: the PSF rotates with depth",
        mask="13 spiral rings",
        sources={
            **_LIU_SOURCES,
            "masks": "orbital angular momentum: TiDy-PSFs, results",
            "formula": "guess: Prasad's spiral zones, as the paper's own could not be read; 13 of them, so that the "
            "PSF rotates less than once",
            "start": "guess: charges 1 to 13",
        },
    ),
    System(
        name="sitzmann2018",
        title="Sitzmann et al.",
        paper="Sitzmann et al.: End-to-end Optimization of Optics and Image Processing, ACM Trans. Graph. 37(4), 2018",
        known_for="extended depth of field: nearly the same blur at every depth, removed by one filter",
        mask="350 Zernikes, cubic",
        camera=_sitzmann_camera,
        sources={
            "focal length": "34.3 mm: a sensor 35.5 mm behind the plate, which is also the lens: code",
            "shape": "plano-convex with a radius of (n - 1) focal lengths: code; for lens='own' only",
            "thickness": "guess: 3 mm, convex towards the scene; for lens='own' only",
            "aperture": "5.00 mm: 1356 samples of 3.69 um: code",
            "focus": "1 m, that of the initial plate: code",
            "depth": "0.5 to 1000 m: code",
            "pixels": "3.69 um: code",
            "wavelengths": "640, 550, 460 nm: code",
            "index": "1.488, 1.493, 1.499 at these wavelengths, by Cauchy's equation between them: code",
            "compositing": "gather: code",
            "noise": "0.0105, the middle of 0.001 to 0.02: code",
            "masks": "350 Zernikes: code",
            "start": "guess: a cubic mask, as is usual for extended depth of field; the code starts flat",
        },
        spectrum=Spectrum((640e-9, 550e-9, 460e-9), RGB.weights),
        sigma=0.0105,
    ),
)

HEADINGS = ("name", "lens", "mask", "depth, m", "psi, rad", "noise", "guessed", "source")
SYSTEMS: dict[str, System] = {system.name: system for system in _ALL}
"""The published systems by name."""


def published_system(name: str) -> System:
    """Return a published system by its name.

    Raises:
        ValueError: if the name is unknown; the message lists the known ones.

    Example:
        >>> published_system("tidy-5").title
        'TiDy, five masks'
    """
    check_choice("the name of a published system", name, tuple(SYSTEMS))
    return SYSTEMS[name]


def systems_table(systems: Sequence[System]) -> list[str]:
    """Return the systems as lines of aligned columns, the headings first.

    Example:
        >>> print(systems_table([published_system("ikoma2021")])[1][:68])
        ikoma2021  50 mm f/6.3, focus 1.7 m  radial profile, 61 radii, noise
    """
    rows = [HEADINGS]
    for system in systems:
        camera = system.camera()
        (near, far), (lo, hi) = camera.depth_range, camera.defocus_range
        rows.append(
            (
                system.name,
                f"{camera.focal_length * 1e3:.3g} mm f/{camera.f_number:.3g}, focus {camera.focus_distance:.3g} m",
                system.mask,
                f"{near:.3g} to {far:g}",
                f"{hi:+.1f} to {lo:+.1f}",
                f"{system.sigma:g}",
                str(len(system.guesses)),
                system.paper,
            )
        )
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
