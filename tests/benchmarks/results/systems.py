"""Optical systems of the benchmark: shipped cameras with their networks, flat lenses by f-number, published presets."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import nn

from kornia_tidy import Fidelity, FresnelLens, PixelwiseMask, ThinLensCamera, TiDyOptics
from kornia_tidy.optics import SYSTEMS
from kornia_tidy.reconstruction.hub import from_pretrained
from kornia_tidy.reconstruction.pretrained import PRETRAINED, load_pretrained
from kornia_tidy.reconstruction.trained import TrainedSystem, load_trained

WINDOW = 129  # pixels; smaller windows that are scaled to sum one flatter coded apertures by 0.4 to 0.7 dB
FIDELITY = Fidelity.preset("balanced").replace(window=WINDOW, stray_light="veil")
FLAT = (17.6, 22.0, 25.0, 30.0, 35.0, 42.0, 50.0, 60.0, 71.0, 100.0)  # f-numbers, a factor of about 2^(1/4) apart
OCCLUDED = ("edof-5", "edof-designed", "edof-flat")  # these are measured on captures with occlusion, too
EARLIER = {"edof-1": Path(__file__).parents[3] / "examples" / "paper" / "systems" / "edof-1.safetensors"}
"""Systems that are no longer shipped."""
FOCAL_LENGTH = 50e-3  # m, of the flat lenses as of the shipped cameras


@dataclass(frozen=True, eq=False)
class System:
    """A camera without sensor and, where it has one, the network that was trained with it."""

    name: str
    kind: str
    """``"coded"``, ``"flat"``, ``"Fresnel"``, ``"published"``, ``"as trained"`` or ``"with occlusion"``."""
    optics: TiDyOptics
    """From linear light to linear light."""
    head: nn.Module | None
    task: str | None
    digest: str
    """Of weights and settings: another one means another system under the same name."""

    @property
    def f_number(self) -> float:
        """F-number of the lens."""
        return self.optics.camera.f_number

    @property
    def title(self) -> str:
        """The optics in words."""
        masks = self.optics.masks
        count = len(masks.phase)
        words = {
            "flat": "flat lens",
            "Fresnel": "Fresnel element of 10 rad, as in the paper",
            "published": f"{count} mask{'s' * (count > 1)} as before training",
            "with occlusion": f"{'flat lens' if self.optics.masks.is_flat() else f'K = {count}'}, with occlusion",
            "coded": f"K = {count}",
        }
        return f"{words[self.kind]}, f/{self.f_number:.3g}"


def available() -> dict[str, Callable[[], System]]:
    """Return a function for each system that the benchmark knows by name."""
    known: dict[str, Callable[[], System]] = {name: _shipped(name) for name in (*PRETRAINED, *EARLIER)}
    known |= {f"{name} with occlusion": _with_occlusion(name) for name in OCCLUDED}
    known |= {f"flat f/{number:g}": _flat(number) for number in FLAT}
    return known | {f"preset {name}": _published(name) for name in SYSTEMS}


def from_checkpoint(path: Path) -> System:
    """Return the system in a checkpoint of ``kornia-tidy train`` or in a folder of ``save_pretrained``.

    It is named as its file, or as the folder of ``best.safetensors``.
    """
    if path.is_dir():
        return of_trained(path.name, from_pretrained(path))
    name = path.stem if path.stem not in ("best", "last") else path.absolute().parent.name
    return of_trained(name, load_trained(path))


def of_trained(name: str, trained: TrainedSystem) -> System:
    """Return a trained system with the window of the benchmark; its network stays as it was trained."""
    lens = isinstance(trained.optics.masks, FresnelLens)
    kind = "Fresnel" if lens else "flat" if trained.optics.masks.is_flat() else "coded"
    return _system(name, kind, trained.optics, trained.head, trained.settings.task)


def _shipped(name: str) -> Callable[[], System]:
    earlier = EARLIER.get(name)
    return lambda: of_trained(name, load_pretrained(name) if earlier is None else load_trained(earlier))


def _with_occlusion(name: str) -> Callable[[], System]:
    """A shipped system whose captures have occlusion; its network learnt from captures without."""

    def make() -> System:
        trained = load_pretrained(name)
        trained.optics.compositing = "occlusion"
        return _system(f"{name} with occlusion", "with occlusion", trained.optics, trained.head, trained.settings.task)

    return make


def _flat(f_number: float) -> Callable[[], System]:
    def make() -> System:
        camera = ThinLensCamera(FOCAL_LENGTH, FOCAL_LENGTH / f_number)
        return _system(f"flat f/{f_number:g}", "flat", TiDyOptics(PixelwiseMask(1, initial="flat"), camera))

    return make


def _published(name: str) -> Callable[[], System]:
    def make() -> System:
        optics = TiDyOptics.from_preset(name, generator=torch.Generator().manual_seed(0))
        return _system(f"preset {name}", "published", optics)

    return make


def _system(
    name: str,
    kind: str,
    optics: TiDyOptics,
    head: nn.Module | None = None,
    task: str | None = None,
    fidelity: Fidelity = FIDELITY,
) -> System:
    assert isinstance(optics.camera, ThinLensCamera)
    optics.fidelity, optics.sensor, optics.color_space = fidelity, None, "linear"
    optics.eval()
    digest = hashlib.sha256()
    for part in (optics, *([] if head is None else [head.eval()])):
        for key, value in sorted(part.state_dict().items()):
            digest.update(key.encode() + value.detach().contiguous().numpy().tobytes())
    return System(name, kind, optics, head, task, digest.hexdigest()[:16])
