"""Plans of random cameras: lens, aperture, masks, modulator, spectrum, compositing, border, scene and tolerance drawn.

``python -m tests.accuracy.plan_campaign 0 1000`` plans a thousand scenes, takes the captures of both plan and
reference, and prints how many errors were beyond the tolerance asked, and the largest. A third of the lenses blur
widely: they are fast and without a mask. Where rays are planned the reference is a PSF of its own for each depth. With
``--real`` all cameras have a real lens, somewhere in its field, and the reference has places for a tolerance of 1e-3.
Each seed is a trial, so a range can be cut in pieces; ``--record`` keeps every outcome.
"""

from __future__ import annotations

import argparse
import json
import math
import platform
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor, nn

from kornia_tidy import DefocusRange, FresnelLens, NoMask, PixelwiseMask, Spectrum, ThinLensCamera, TiDyOptics
from kornia_tidy.accuracy import RenderPlan
from kornia_tidy.accuracy.planning import planner
from kornia_tidy.accuracy.planning.plan import LEAST_TOLERANCE, plan_scene
from kornia_tidy.accuracy.planning.planner import REFERENCE
from kornia_tidy.masks import CubicMask, FourierMask, PhaseMasks, RadialMask, SpiralMask, ZernikeMask
from kornia_tidy.modulator import DiffractionEfficiency, DwellTimes, GreyLevels, SpatialLightModulator
from kornia_tidy.optics import REFERENCE_WAVELENGTH, Lens, annular_aperture, camera_spectrum, circular_aperture
from kornia_tidy.render.borders import cropped
from kornia_tidy.render.coarse_gather import gather_group
from kornia_tidy.render.stray_light import spread_evenly
from tests.accuracy.adversarial_scenes import BORDERS, COMPOSITINGS, SCENES
from tests.accuracy.planning_rig import Rig, smooth
from tests.polygons import polygon_aperture

TOLERANCES = (1e-2, 3e-3, 1e-3, 1e-4, 1e-5)
NARROW = 65  # px that the reference's window may have here: of random masks it would have 257, and take minutes
MOST_DEPTHS = 12  # of a scene behind a wide lens, whose reference computes a PSF for each of them
LARGEST_DISC = 26.0  # px; radius of the discs of wide lenses here

Masks = Callable[[torch.Generator], PhaseMasks]
MASKS: dict[str, Masks] = {
    "flat": lambda g: PixelwiseMask(1, 23, initial="flat"),
    "none": lambda g: NoMask(46),
    "noise": lambda g: PixelwiseMask(2, 15, generator=g),
    "learned": lambda g: PixelwiseMask(initial=0.5e-6 * smooth((1, 23, 23), 2.0, g)),
    "cubic": lambda g: CubicMask(20.0, 15),
    "Zernike": lambda g: ZernikeMask(2, 23, 15, generator=g),
    "radial": lambda g: RadialMask(1, 23, generator=g),
    "spiral": lambda g: SpiralMask(1, 32, generator=g),
    "Fourier": lambda g: FourierMask(1, 23, 3, generator=g),
    "Fresnel": lambda g: FresnelLens(10.0),
    "strong Fresnel": lambda g: FresnelLens(40.0),
}
REAL = {
    "double-gauss-50mm": (8.0, 17.6),
    "triplet-50mm": (8.0, 16.0),
    "single-50mm": (11.0, 17.6),
    "phone-5.5mm": (5.6,),
}
FLAT = ("flat", "flat", "none")
APERTURES: dict[str, Callable[[int, torch.Generator], Tensor | None]] = {
    "default": lambda n, g: None,
    "smooth disc": lambda n, g: circular_aperture(n, 2.3 / n, edges="area"),
    "ring": lambda n, g: annular_aperture(n, 2.3 / n, _between(0.3, 0.75, g)),
    "triangle": lambda n, g: polygon_aperture(n, 2.3 / n, 3, _between(0, 6.3, g)),
    "pixels": lambda n, g: _with_one((torch.rand(n, n, generator=g) > 0.6).double()),
    "grey pixels": lambda n, g: torch.rand(n, n, generator=g, dtype=torch.float64),
}
MODULATORS: dict[str, Callable[[int, torch.Generator], nn.Module]] = {
    "equal": lambda k, g: DwellTimes(),
    "dwell times": lambda k, g: DwellTimes((torch.rand(k, generator=g) + 0.1).tolist()),
    "efficiency": lambda k, g: DiffractionEfficiency(_between(0.6, 0.95, g)),
    "panel": lambda k, g: SpatialLightModulator(GreyLevels(4), DwellTimes(), fill_factor=_between(0.8, 0.95, g)),
}
SPECTRA: dict[str, Callable[[], Spectrum]] = {
    "RGB": Spectrum.rgb,
    "camera": lambda: camera_spectrum(samples=7),
    "reflectances": lambda: camera_spectrum(samples=6, reflectance=True),
}


@dataclass(frozen=True)
class Trial:
    """A plan that was checked.

    Args:
        seed: of everything drawn.
        lenses: kind of the lens: "real", "wide" for a fast one without a mask, or "other".
        drawn: what was drawn, by name.
        tolerance: root mean square error asked, full scale 1.
        predicted: error of the plan.
        measured: the same, between the captures of plan and reference.
        plan: the fidelity's name.
    """

    seed: int
    lenses: str
    drawn: dict[str, Any]
    tolerance: float
    predicted: float
    measured: float
    plan: str

    @property
    def ratio(self) -> float:
        """Error measured over the tolerance."""
        return self.measured / self.tolerance


def trial(seed: int, real: bool = False) -> Trial:
    """Draw a camera and a scene, plan, and compare the capture with that of the reference."""
    g = torch.Generator().manual_seed(seed)
    lenses = "real" if real else "wide" if seed % 3 == 2 else "other"
    optics, drawn = {"real": _real_camera, "wide": _wide_camera, "other": _camera}[lenses](g)
    light, defocus, kind = _scene(optics, lenses, g)
    drawn |= {"scene": kind, "size": list(light.shape[-2:])}
    tolerance = _one(TOLERANCES[: 4 if real else 5], g)  # places of a field keep to no less
    with warnings.catch_warnings(), patch.object(planner, "REFERENCE", REFERENCE.replace(max_window=NARROW)):
        warnings.simplefilter("ignore")  # that windows this narrow do not hold the light they should
        plan = plan_scene(optics, defocus, light, light.shape[:2], tolerance)
        measured = (_ray_error if plan.fidelity.window is None else _error)(optics, light, defocus, plan)
    return Trial(seed, lenses, drawn, tolerance, plan.predicted_error, measured, plan.fidelity.name)


def _error(optics: TiDyOptics, light: Tensor, defocus: Tensor, plan: RenderPlan) -> float:
    if plan.fidelity.replace(name="") == plan.reference.replace(name=""):
        return 0.0
    reference = plan.reference if optics.lens is None else plan.reference.replace(field_tolerance=LEAST_TOLERANCE)
    return Rig(optics).error(light, defocus, plan.fidelity, reference)


@torch.no_grad()
def _ray_error(optics: TiDyOptics, light: Tensor, defocus: Tensor, plan: RenderPlan) -> float:
    """The error against the reference's PSFs at each depth of the scene."""
    window = plan.window
    exact = optics.with_fidelity(REFERENCE.replace(window=window))
    nodes = tuple(defocus.double().unique().tolist())
    bank = exact.psf_bank(light.shape[1], torch.float64, nodes if len(nodes) > 1 else (nodes[0], nodes[0] + 1.0))
    margin, every = window // 2 if optics.border == "valid" else 0, torch.ones_like(defocus, dtype=torch.bool)
    reference = gather_group(light.double(), defocus.double(), bank, every, 1, margin, optics.border)
    index = torch.bucketize(defocus.double(), bank.defocus)[:, 0]
    stray = (1 - bank.psfs.sum((2, 3)))[index].movedim(-1, 1) * spread_evenly(light.double(), window, optics.border)
    reference = reference + cropped(stray, margin)
    ours = Rig(optics).capture(light, defocus, plan.fidelity)
    return float((cropped(ours, (ours.shape[-1] - reference.shape[-1]) // 2) - reference).square().mean().sqrt())


# ---------------------------------------------------------------------- what is drawn


def _one(choices: Sequence[Any], g: torch.Generator) -> Any:
    return choices[int(torch.randint(len(choices), (), generator=g))]


def _between(lo: float, hi: float, g: torch.Generator) -> float:
    return lo + (hi - lo) * float(torch.rand((), generator=g))


def _with_one(amplitude: Tensor) -> Tensor:
    amplitude[len(amplitude) // 2, len(amplitude) // 2] = 1
    return amplitude


def _camera(g: torch.Generator) -> tuple[TiDyOptics, dict[str, Any]]:
    compositing, border, kind = _one(COMPOSITINGS, g), _one(BORDERS, g), _one(sorted(MASKS), g)
    masks = MASKS[kind](g)
    count, size = masks.phase.shape[0], masks.phase.shape[-1]
    modulator = _one(sorted(MODULATORS), g)
    aperture = _one(("default", "ring") if kind == "none" else sorted(APERTURES), g)
    spectrum = _one(("RGB", "RGB", "camera", "reflectances"), g)
    if compositing == "occlusion" and spectrum == "reflectances":  # refused
        spectrum = "camera"
    if _between(0, 1, g) < 0.6:
        half = _one((4.0, 10.0, 20.0, 40.0), g)
        lens = DefocusRange(-half, _one((half, half / 2, 1.0), g))
    else:
        depths = (_between(0.3, 1.0, g), _one((2.0, 10.0, math.inf), g))
        span = (_between(-20, -2, g), _between(2, 20, g))
        lens = ThinLensCamera.for_scene(depths, span, pixel_pitch=_between(4e-6, 9e-6, g))
    optics = TiDyOptics(
        masks,
        lens,
        MODULATORS[modulator](count, g),
        None,
        fidelity=REFERENCE.replace(window=3),
        compositing=compositing,
        border=border,
        spectrum=SPECTRA[spectrum](),
        aperture=APERTURES[aperture](size, g),
    )
    names = {"masks": kind, "modulator": modulator, "aperture": aperture, "spectrum": spectrum}
    span = [round(psi, 3) for psi in lens.defocus_range]
    return optics, {"compositing": compositing, "border": border, **names, "defocus": span}


def _wide_camera(g: torch.Generator) -> tuple[TiDyOptics, dict[str, Any]]:
    border, kind = _one(BORDERS, g), _one(FLAT, g)
    masks = MASKS[kind](g)
    while True:
        pitch, number, focal = _between(4e-6, 8e-6, g), _between(1.2, 5.0, g), _between(20e-3, 90e-3, g)
        focus = focal * _between(20, 100, g)
        step = pitch * focal / (2 * number) * (1 / focal - 1 / focus)
        if step >= REFERENCE_WAVELENGTH:
            break
    per_pixel = math.pi * step / REFERENCE_WAVELENGTH  # radians of defocus for a pixel of the disc's radius
    far, near = _between(1, LARGEST_DISC, g), _between(1, LARGEST_DISC, g)
    if max(far, near) < 19:
        far = 19 + 0.3 * far
    phase_of_one_per_metre = math.pi * (focal / (2 * number)) ** 2 / REFERENCE_WAVELENGTH
    ends = [1 / focus + psi * per_pixel / phase_of_one_per_metre for psi in (near, -far)]
    depths = (1 / ends[0], 1 / ends[1] if ends[1] > 0 else math.inf)
    lens = ThinLensCamera(focal, focal / number, focus, pitch, depths)
    aperture = _one(sorted(APERTURES), g) if kind == "flat" else "default"
    spectrum = _one(("RGB", "RGB", "camera"), g)
    optics = TiDyOptics(
        masks,
        lens,
        sensor=None,
        border=border,
        spectrum=SPECTRA[spectrum](),
        aperture=APERTURES[aperture](masks.phase.shape[-1], g),
    )
    names = {"masks": kind, "aperture": aperture, "spectrum": spectrum, "f_number": round(number, 2)}
    span = [round(psi, 1) for psi in lens.defocus_range]
    return optics, {"compositing": "gather", "border": border, **names, "defocus": span, "step": step}


def _real_camera(g: torch.Generator) -> tuple[TiDyOptics, dict[str, Any]]:
    compositing, border, kind = _one(COMPOSITINGS, g), _one(BORDERS, g), _one(sorted(MASKS), g)
    masks = MASKS[kind](g)
    name = _one(sorted(REAL), g)
    number, pitch = _one(REAL[name], g), _between(3e-6, 9e-6, g)
    lens = _named(name, number)
    phase_of_one_per_metre = math.pi * (lens.focal_length / (2 * number)) ** 2 / REFERENCE_WAVELENGTH
    ends = [1 / lens.focus_distance + psi / phase_of_one_per_metre for psi in (_between(1, 15, g), -_between(1, 15, g))]
    camera = lens.camera(pitch, (1 / ends[0], 1 / ends[1] if ends[1] > 0 else math.inf))
    turn, height = _between(0, 2 * math.pi, g), _between(0, 0.9, g) * float(lens.table.field[0]) / pitch
    optics = TiDyOptics(
        masks,
        camera,
        sensor=None,
        fidelity=REFERENCE.replace(window=3),
        compositing=compositing,
        border=border,
        lens=lens,
        field_center=(height * math.sin(turn), height * math.cos(turn)),
    )
    names = {"lens": name, "f_number": number, "masks": kind, "pitch": pitch, "height": height}
    span = [round(psi, 3) for psi in camera.defocus_range]
    return optics, {"compositing": compositing, "border": border, **names, "defocus": span}


@lru_cache
def _named(name: str, f_number: float) -> Lens:
    return Lens.named(name, f_number, 0.6)


def _scene(optics: TiDyOptics, lenses: str, g: torch.Generator) -> tuple[Tensor, Tensor, str]:
    wide = lenses == "wide"
    kind = _one(sorted(set(SCENES) - {"tiny"}) if wide else sorted(SCENES), g)
    sides = (40, 48, 63) if wide else (33, 40, 48, 127) if lenses == "real" else (33, 40, 48, 63)
    sides = (1, 2, 3, 5, 8, 13) if kind == "tiny" else sides
    size = _one(sides, g), _one(sides, g)
    if wide and optics.border == "valid":
        size = size[0] + optics.window, size[1] + optics.window
    light, at = SCENES[kind](size, torch.Generator().manual_seed(int(torch.randint(2**31, (), generator=g))))
    lo, hi = optics.camera.defocus_range
    share = (at + 20) / 40
    if wide:
        steps = torch.rand(MOST_DEPTHS - 1, generator=g).sort().values
        share = (torch.bucketize(share, steps) + _between(0, 1, g)) / MOST_DEPTHS
    return light, (lo + (hi - lo) * share).float(), kind


# ---------------------------------------------------------------------- the command


def report(trials: Sequence[Trial]) -> str:
    """Return how many plans were beyond their tolerance, and the largest errors, for wide lenses and for others."""
    lines = []
    for lenses in ("wide", "real", "other"):
        own = sorted((each for each in trials if each.lenses == lenses), key=lambda each: -each.ratio)
        if not own:
            continue
        beyond = sum(each.ratio > 1 for each in own)
        reference = sum(each.measured == 0 for each in own)
        lines.append(
            f"{lenses} lenses: {len(own)} plans, {beyond} beyond the tolerance, "
            f"{reference} are the reference, worst {own[0].ratio:.3f} of the tolerance"
        )
        lines += [f"  {each}" for each in own if each.ratio > 1] or [f"  {own[0]}"]
    return "\n".join(lines)


def main() -> None:
    """Judge a range of seeds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("first", type=int)
    parser.add_argument("beyond", type=int)
    parser.add_argument("--real", action="store_true", help="cameras with a real lens")
    parser.add_argument("--record", type=Path, help="file that a line of JSON is added to for each trial")
    options = parser.parse_args()
    torch.set_num_threads(1)
    start, trials = time.process_time(), []
    for seed in range(options.first, options.beyond):
        began = time.process_time()
        trials.append(trial(seed, options.real))
        if options.record:
            line = {**asdict(trials[-1]), "seconds": round(time.process_time() - began, 2)}
            with options.record.open("a") as file:
                file.write(json.dumps(line) + "\n")
    print(report(trials))
    print(f"{time.process_time() - start:.0f} s of one core, {platform.processor() or platform.machine()}")


if __name__ == "__main__":
    main()
