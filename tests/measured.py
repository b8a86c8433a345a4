"""A camera that was measured: PSFs of a known lens as their measurement, and its noise."""

from __future__ import annotations

from pathlib import Path

import torch

from kornia_tidy import PixelwiseMask, PSFBank, ThinLensCamera, TiDyOptics
from kornia_tidy.lab.calibration.noise.photon_transfer import PhotonTransfer, TransferLine, write_json
from kornia_tidy.lab.calibration.psf import MeasuredPSFs
from kornia_tidy.masks import initial_heights

DISTANCES = (2.5, 0.9, 0.55, 0.4)  # metres, by rising defocus
LENS = ThinLensCamera(depth_range=(0.4, 2.5))
HEIGHTS = initial_heights("focal sweep", torch.Generator().manual_seed(0))
GAIN, READ_NOISE, BLACK, WHITE = 2.7, 3.0, 256.0, 4095.0  # electrons a count, electrons, counts


def sweep(**options) -> TiDyOptics:
    """The camera behind the measurement."""
    return TiDyOptics(PixelwiseMask(initial=HEIGHTS), LENS, fidelity="draft", **options)


def measured_psfs(channels: int = 3, distances: tuple[float, ...] = DISTANCES) -> MeasuredPSFs:
    """Its PSFs at some distances, without an error."""
    places = torch.tensor(distances, dtype=torch.float64)
    with torch.no_grad():
        bank = sweep().psf_bank(channels, defocus=LENS.defocus(places).tolist())
    bank = PSFBank.from_measured(bank.psfs, bank.defocus)
    return MeasuredPSFs(bank, torch.zeros_like(bank.psfs), places, camera=LENS)


def measured_noise(iso: float | None = 800.0, white: float = WHITE) -> PhotonTransfer:
    """A noise that was measured at one gain."""
    return PhotonTransfer(
        "", iso, "flats", BLACK, white, TransferLine(GAIN, 0.01, READ_NOISE, 0.01, 0.0, 1.0, 9), {}, ()
    )


def write_measurements(folder: Path) -> None:
    """Write ``bank.safetensors`` and ``noise.json``."""
    measured_psfs().save(folder / "bank.safetensors")
    write_json(folder / "noise.json", measured_noise())
