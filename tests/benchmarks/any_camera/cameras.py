"""Random cameras in three pools: for training, for choices, and for scores. A pool is drawn by a fixed seed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import torch

from kornia_tidy import Fidelity, FresnelLens, NoMask, PixelwiseMask, PSFBank, ThinLensCamera, TiDyOptics
from kornia_tidy.masks import CubicMask, FourierMask, PhaseMasks, RadialMask, SpiralMask, ZernikeMask, initial_heights
from kornia_tidy.optics import REFERENCE_WAVELENGTH, Lens
from kornia_tidy.reconstruction.pretrained import PRETRAINED, load_pretrained
from kornia_tidy.reconstruction.trained import TrainedSystem, closed_form_bank, load_trained
from kornia_tidy.seeds import keyed_seed

ELEMENT = "single-50mm"
WINDOW = 129  # px of the PSFs, as those of the shipped systems
EARLIER = Path(__file__).parents[3] / "examples" / "paper" / "systems"  # that are no longer shipped
SHIPPED = ("edof-1", "edof-5", "edof-designed", "edof-flat")
FAMILIES = ("pixelwise", "fourier", "zernike", "radial", "spiral", "focal sweep", "like fishers", "flat", "flat")
STRENGTH = (0.3, 1.2)  # factor of the phase of random masks, uniform in its logarithm
DEFOCUS = (0.7, 22.0)  # rad, half of the range of a camera, uniform in its logarithm
AIRY = (0.15, 4.0)  # pixels in the wavelength times the f-number
WIDEST = 50.0  # px, blur of the ends of the range
FOCAL_LENGTHS = (4e-3, 60e-3)  # m
NEAREST = 8.0  # focal lengths


@dataclass(frozen=True)
class Pool:
    """How many cameras of which kind are drawn."""

    count: int
    f_numbers: tuple[float, float]
    pitches: tuple[float, float]
    families: tuple[str, ...]
    hard: int = 0
    """Number of them, the first, that have no masks or are slower than f/25."""


POOLS = {
    "training": Pool(48, (5.0, 50.0), (2.5e-6, 9e-6), FAMILIES),
    "sharp": Pool(16, (5.0, 16.0), (5e-6, 9.5e-6), ("flat",)),  # as those above, for training
    "lenses": Pool(20, (5.0, 30.0), (2.5e-6, 9e-6), ("flat",)),
    "slow": Pool(12, (25.0, 50.0), (2.5e-6, 9e-6), FAMILIES),
    "sweeps": Pool(10, (5.0, 30.0), (2.5e-6, 9e-6), ("focal sweep", "like fishers")),
    "corner": Pool(8, (14.0, 22.0), (4e-6, 8e-6), FAMILIES),  # in the field of a single element
    "edge": Pool(8, (14.0, 22.0), (4e-6, 9e-6), ("focal sweep", "focal sweep", "spiral", "flat")),  # further out there
    "kinoforms": Pool(8, (4.0, 30.0), (2e-6, 10e-6), ("kinoform",)),
    "wide": Pool(12, (4.0, 60.0), (2e-6, 10e-6), FAMILIES),
    "validation": Pool(8, (4.5, 55.0), (2.2e-6, 9.5e-6), FAMILIES, hard=3),
    "test": Pool(12, (4.0, 60.0), (2e-6, 10e-6), (*FAMILIES, "cubic", "fresnel"), hard=5),
}

BESIDE_TRAINING = ("sharp", "lenses", "slow", "sweeps", "corner", "edge", "kinoforms", "wide")
BEHIND_AN_ELEMENT = {"corner": (0.4, 0.9), "edge": (0.75, 1.0)}  # places, in halves of its field


def pool_names(pool: str) -> list[str]:
    """Return the names of the cameras of a pool; of training: shipped ones, drawn ones, sharp ones, others."""
    drawn = [f"{pool}-{index:02d}" for index in range(POOLS[pool].count)]
    if pool != "training":
        return drawn
    return [*SHIPPED, *drawn, *(name for other in BESIDE_TRAINING for name in pool_names(other))]


def own_system(name: str) -> TrainedSystem:
    """Return a system that is shipped, or was, with its own network."""
    return load_pretrained(name) if name in PRETRAINED else load_trained(EARLIER / f"{name}.safetensors")


def camera(name: str) -> TiDyOptics:
    """Return a camera by its name, noise-free, with all of its stray light."""
    if name in SHIPPED:
        optics = own_system(name).optics
    else:
        pool, _, index = name.rpartition("-")
        draw = _behind_an_element if pool in BEHIND_AN_ELEMENT else _drawn
        optics = draw(POOLS[pool], name, int(index))
    optics.sensor = None
    return optics.eval().requires_grad_(requires_grad=False)


class _Draw:
    """Numbers that follow from the name of a camera."""

    def __init__(self, name: str, index: int) -> None:
        self.generator = torch.Generator().manual_seed(keyed_seed(name, index))

    def uniform(self, ends: tuple[float, float]) -> float:
        """Return a number uniform in its logarithm."""
        low, high = (math.log(end) for end in ends)
        return math.exp(low + (high - low) * float(torch.rand((), generator=self.generator, dtype=torch.float64)))

    def whole(self, count: int) -> int:
        """Return a number below the count."""
        return int(torch.randint(count, (), generator=self.generator))


def _behind_an_element(pool: Pool, name: str, index: int) -> TiDyOptics:
    draw = _Draw(name, index)
    family, masks = pool.families[index % len(pool.families)], 1 + draw.whole(8)
    f_number, pitch, focus = draw.uniform(pool.f_numbers), draw.uniform(pool.pitches), draw.uniform((0.5, 2.0))
    lens = Lens.named(ELEMENT, f_number, focus)
    shape = _masks(family, masks, draw.uniform(STRENGTH), draw.generator)
    height, angle = (
        lens.field / pitch * draw.uniform(BEHIND_AN_ELEMENT[name.partition("-")[0]]),
        math.tau * draw.whole(360) / 360,
    )
    place = height * math.sin(angle), height * math.cos(angle)
    fidelity = Fidelity.preset("balanced").replace(window=WINDOW, stray_light="veil")
    return TiDyOptics(shape, lens.camera(pitch), lens=lens, fidelity=fidelity, field_center=place)


def _drawn(pool: Pool, name: str, index: int) -> TiDyOptics:
    draw = _Draw(name, index)
    random, uniform, whole = draw.generator, draw.uniform, draw.whole
    families = ("flat",) if index < pool.hard and index % 2 else pool.families
    slowest = (25.0, pool.f_numbers[1]) if index < pool.hard and not index % 2 else pool.f_numbers
    family, masks = families[whole(len(families))], 1 + whole(8)
    while True:
        f_number, pitch, focal_length = uniform(slowest), uniform(pool.pitches), uniform(FOCAL_LENGTHS)
        airy = REFERENCE_WAVELENGTH * f_number / pitch
        per_dioptre = math.pi * (focal_length / (2 * f_number)) ** 2 / REFERENCE_WAVELENGTH
        most = min(DEFOCUS[1], math.pi * WIDEST / (4 * airy), per_dioptre / (2 * NEAREST * focal_length))
        if AIRY[0] <= airy <= AIRY[1] and most >= DEFOCUS[0]:
            break
    dioptres = 2 * uniform((DEFOCUS[0], most)) / per_dioptre
    far = whole(2) * (1 / (NEAREST * focal_length) - dioptres) * 0.5  # infinity, or nearer
    focus = far + dioptres * (0.35 + 0.3 * float(torch.rand((), generator=random)))
    lens = ThinLensCamera(
        focal_length,
        f_number=f_number,
        focus_distance=1 / focus,
        pixel_pitch=pitch,
        depth_range=(1 / (far + dioptres), 1 / far if far else math.inf),
    )
    shape = _masks(family, masks, uniform(STRENGTH), random)
    fidelity = Fidelity.preset("balanced").replace(window=WINDOW, stray_light="veil")
    return TiDyOptics(shape, lens, fidelity=fidelity)


def local_bank(optics: TiDyOptics, layers: int) -> PSFBank:
    """Return the PSFs that the closed form takes, those of the camera's place in the field behind a lens."""
    if optics.lens is None:
        return closed_form_bank(optics, layers)
    nodes = torch.linspace(*optics.camera.defocus_range, layers, dtype=torch.float64).tolist()
    return optics.psf_bank(3, defocus=nodes, field=[optics.field_center]).at(0)


def _masks(family: str, count: int, strength: float, random: torch.Generator) -> PhaseMasks:
    if family == "flat":
        return NoMask()
    if family == "fresnel":
        return FresnelLens()
    if family == "cubic":
        return CubicMask(60 * strength * torch.rand(1, generator=random))
    if family in {"focal sweep", "like fishers"}:
        return PixelwiseMask(initial=initial_heights(family, random)[:count])
    if family == "spiral":
        return SpiralMask(count, 46, generator=random)
    if family == "kinoform":  # heights of several waves, less whole ones
        whole = ZernikeMask(count, 23, generator=random)
        wave = REFERENCE_WAVELENGTH / (whole.material.index(REFERENCE_WAVELENGTH) - 1)
        return PixelwiseMask(initial=(4 * strength * whole.heights().detach()).remainder(wave))
    kinds = {"pixelwise": PixelwiseMask, "fourier": FourierMask, "zernike": ZernikeMask, "radial": RadialMask}
    masks = kinds[family](count, 23, generator=random)
    with torch.no_grad():
        for parameter in masks.parameters():
            parameter.mul_(strength)
    return masks


def in_words(optics: TiDyOptics) -> str:
    """Return masks and lens in a line of a table."""
    lens = optics.camera
    assert isinstance(lens, ThinLensCamera)
    low, high = lens.defocus_range
    kind = type(optics.masks).__name__.removesuffix("Mask")
    return (
        f"{kind}, K = {len(optics.masks.phase)}, f/{lens.f_number:.1f}, {lens.focal_length * 1e3:.0f} mm, "
        f"{lens.pixel_pitch * 1e6:.1f} um, {low:.1f} to {high:.1f} rad"
    )
