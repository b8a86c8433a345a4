"""Small saved cameras of many kinds, each with a capture, as an earlier version of the package wrote them.

``python -m tests.camera.checkpoints FOLDER`` writes those of the installed version. The files in ``checkpoints/`` were
written by commit b24c93b; they stay as they are. A kind that a later version brings gets a file of its own.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from kornia_tidy import DefocusRange, Fidelity, PSFBank, SensorNoise, Spectrum, ThinLensCamera, TiDyOptics
from kornia_tidy.camera import camera_of_state
from kornia_tidy.masks import CubicMask, FourierMask, FresnelLens, PixelwiseMask, RadialMask, SpiralMask, ZernikeMask
from kornia_tidy.modulator import (
    DiffractionEfficiency,
    DwellTimes,
    GreyLevels,
    LearnableDwellTimes,
    PixelCrosstalk,
    SpatialLightModulator,
    StrokeError,
    Switching,
)
from kornia_tidy.optics import FUSED_SILICA, PDMS, SYSTEMS, annular_aperture, camera_spectrum
from kornia_tidy.reconstruction.pretrained import PRETRAINED, load_pretrained
from kornia_tidy.reconstruction.settings import SystemSettings
from kornia_tidy.reconstruction.state_file import write_state
from kornia_tidy.reconstruction.trained import build_head, build_optics, load_trained

FOLDER = Path(__file__).parent / "checkpoints"
RETIRED = Path(__file__).parents[2] / "examples" / "paper" / "systems"  # systems that are no longer shipped
SIDE = 32  # pixels of the scene
SYSTEM, BANK = "system.safetensors", "bank.safetensors"
OTHERS = "captures.safetensors"  # by these two and by the shipped systems
CAPTURE = "capture"  # the entry beside those of the state: every second pixel, in float32


def small(masks: Any = None, **options: Any) -> TiDyOptics:
    """Return a camera of small masks and PSFs."""
    fidelity = options.pop("fidelity", Fidelity(window=15, layer_spacing=4.0))
    return TiDyOptics(masks or pixels(), fidelity=fidelity, **{"sensor": None, **options})


def pixels(count: int = 2, side: int = 7, **options: Any) -> PixelwiseMask:
    """Return pixelwise masks of noise."""
    return PixelwiseMask(count, side, generator=torch.Generator().manual_seed(5), **options)


def measured_bank() -> PSFBank:
    """Return PSFs as of a measured lens."""
    psfs = torch.linspace(0.1, 1, 150).reshape(2, 3, 5, 5).square()
    return PSFBank.from_measured(psfs, torch.tensor([-8.0, 9.0]))


def kept_aperture(kind: str) -> torch.Tensor:
    """Return the aperture that a file holds: the library makes no such shape any more."""
    state = load_file(FOLDER / f"{kind}.safetensors")
    state.pop(CAPTURE)
    aperture = camera_of_state(state).aperture
    assert isinstance(aperture, torch.Tensor)
    return aperture


def _noise() -> dict[str, Any]:
    return {"generator": torch.Generator().manual_seed(6)}


KINDS: dict[str, Callable[[], TiDyOptics]] = {
    "default": lambda: TiDyOptics(PixelwiseMask(**_noise())),
    "pixelwise clamped": lambda: small(pixels(constraint="clamp", max_height=1e-6)),
    "pixelwise of PDMS": lambda: small(pixels(constraint="sigmoid", max_height=2e-6, material=PDMS)),
    "zernike": lambda: small(ZernikeMask(2, 15, num_modes=10, **_noise())),
    "radial": lambda: small(RadialMask(2, 15, **_noise())),
    "spiral": lambda: small(SpiralMask(2, 15, **_noise())),
    "fourier": lambda: small(FourierMask(2, 15, 2, **_noise())),
    "cubic": lambda: small(CubicMask((8.0, 3.0), 15)),
    "fresnel lens": lambda: small(FresnelLens(8.0, 15)),
    "flat": lambda: small(PixelwiseMask(1, initial="flat")),
    "unequal times": lambda: small(modulator=DwellTimes((3, 1))),
    "learnt times": lambda: small(modulator=LearnableDwellTimes((3, 1))),
    "switching": lambda: small(modulator=Switching(4e-3, dwell=DwellTimes((3, 1)), samples=2)),
    "efficiency": lambda: small(modulator=DiffractionEfficiency(0.8)),
    "light modulator": lambda: small(
        modulator=SpatialLightModulator(
            DwellTimes(), GreyLevels(4), StrokeError(1.1), PixelCrosstalk(0.3), fill_factor=0.9
        )
    ),
    "monochrome": lambda: small(spectrum=Spectrum.monochrome()),
    "spectrum": lambda: small(spectrum=camera_spectrum(samples=4)),
    "reflectance": lambda: small(spectrum=camera_spectrum(samples=3, reflectance=True)),
    "ring": lambda: small(pixels(side=23), aperture=annular_aperture(23, 0.1, 0.4)),
    "hexagon": lambda: small(pixels(side=23), aperture=kept_aperture("hexagon")),
    "noise": lambda: small(sensor=SensorNoise(0.01, full_well=2000.0, dark=20.0)),
    "unclipped": lambda: small(sensor=SensorNoise(0.2, clip=False)),
    "bits": lambda: small(sensor=SensorNoise(0.0, bits=10)),
    "range of defocus": lambda: small(camera=DefocusRange(-12.0, 15.0)),
    "learnt focus": lambda: small(camera=ThinLensCamera(focus_distance=torch.tensor(0.7), depth_range=(0.4, 9.0))),
    "one glass": lambda: small(camera=ThinLensCamera(f_number=16.0, lens_material=FUSED_SILICA)),
    "fast lens": lambda: small(
        PixelwiseMask(1, initial="flat"),
        camera=ThinLensCamera(focus_distance=2.0, depth_range=(1.8, 40.0), f_number=4.0),
        fidelity="balanced",
    ),
    "scatter": lambda: small(compositing="scatter", border="zero"),
    "occlusion": lambda: small(compositing="occlusion", border="replicate"),
    "linear circular": lambda: small(color_space="linear", border="circular"),
    "valid": lambda: small(border="valid"),
    "paper": lambda: TiDyOptics(pixels(1, 23), DefocusRange(-14.0, 14.0), sensor=None, fidelity="paper"),
    "draft": lambda: small(fidelity="draft"),
    "band-limited": lambda: small(fidelity=Fidelity(window=15, layers="bandlimited", layer_spacing=1.0, double=True)),
    "cubic layers": lambda: small(fidelity=Fidelity(window=15, layers="cubic", stray_light="veil", correlate=True)),
    "mean states": lambda: small(
        compositing="occlusion", fidelity=Fidelity(window=15, stray_light="discard", occlusion_states="mean")
    ),
    "measured": lambda: small().with_bank(measured_bank()),
    **{name: lambda name=name: TiDyOptics.from_preset(name, border="replicate", **_noise()) for name in SYSTEMS},
}
"""How cameras of each kind are made; loaded weights replace those that a new one starts from."""


def scene(optics: TiDyOptics) -> tuple[Tensor, Tensor]:
    """Return an image (1, C, 32, 32) and depths of all the camera's range, by formulas alone."""
    place = torch.arange(SIDE * SIDE, dtype=torch.float64)
    shades = torch.stack([(place * (0.381966 + 0.1 * c)).remainder(1) for c in range(len(optics.spectrum.weights))])
    image = 0.1 + 0.7 * shades.reshape(1, -1, SIDE, SIDE)
    lo, hi = optics.camera.defocus_range
    steps = (place.reshape(1, 1, SIDE, SIDE) // 100).clamp(max=9) / 9
    nearness = 0.02 + 0.96 * steps
    far = isinstance(optics.camera, ThinLensCamera)
    return image.float(), (optics.camera.depth(lo + (hi - lo) * nearness) if far else nearness).float()


@torch.no_grad()
def capture_of(optics: TiDyOptics) -> Tensor:
    """Return every second pixel of a capture, with noise by a formula."""
    image, depth = scene(optics)
    uniform = (torch.arange(image.numel(), dtype=torch.float64) * 0.754877).remainder(1).reshape(image.shape)
    values = {"read": 2 * uniform - 1, "shot": uniform}
    params = {name: values[name].to(field) for name, field in optics.draw(image).items() if name in values}
    if optics.border == "valid":
        params = {}
    return optics(image, depth, params=params or None)[0, :, ::2, ::2].float().contiguous()


def system() -> dict[str, Any]:
    """Return the state of a small trained system, camera and network, as training writes it."""
    settings = SystemSettings(masks=2, head="plain", width=4, window=9, fidelity="draft", depth_range=(0.5, 2.0))
    torch.manual_seed(7)
    optics, head = build_optics(settings), build_head(settings)
    weights = {
        f"{part}.{key}": value
        for part, own in (("optics", optics), ("head", head))
        for key, value in own.state_dict().items()
    }
    return {"settings": settings.as_dict(), "state_dict": weights, "global_step": 3}


def other_cameras(folder: Path) -> Iterator[tuple[str, TiDyOptics]]:
    """Yield cameras by name: of a trained system's file, of measured PSFs, of systems that are or were shipped."""
    yield "system", load_trained(folder / SYSTEM).optics
    yield "bank", small().with_bank(PSFBank.load(folder / BANK))
    systems = {path.stem: load_trained(path) for path in sorted(RETIRED.glob("*.safetensors"))}
    systems |= {name: load_pretrained(name) for name in PRETRAINED}
    for name, trained in systems.items():
        optics = trained.optics
        optics.border = "replicate"  # for a scene that is smaller than their PSFs
        yield name, optics


def main(folder: Path) -> None:
    """Write a file for each kind."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, make in KINDS.items():
        optics = make()
        with torch.no_grad():
            for parameter in optics.parameters():
                parameter.mul_(0.7)  # weights that differ from those of a new camera, behind a window that is known
        state = {key: value.contiguous() for key, value in optics.state_dict().items()}
        save_file({**state, CAPTURE: capture_of(optics)}, folder / f"{name.replace(' ', '_')}.safetensors")
    write_state(folder / SYSTEM, system())
    measured_bank().save(folder / BANK)
    save_file({name: capture_of(optics) for name, optics in other_cameras(folder)}, folder / OTHERS)


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main(Path(sys.argv[1]))
