"""The PSF bank: how a point spreads at each defocus and in each colour, averaged over the masks of one exposure."""

from __future__ import annotations

import json
import os
import tempfile
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from kornia_tidy.checks import check_choice
from kornia_tidy.optics.paper import PAPER_SIZE, paper_psfs
from kornia_tidy.optics.propagation import pixel_energies, sensor_kernels
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH, Spectrum

STRAY_LIGHT = ("renormalize", "veil", "discard")
_FORMAT = "kornia_tidy.psf_bank/1"


@dataclass(frozen=True, eq=False)
class PSFBank:
    """Point spread functions over defocus and colour.

    Args:
        psfs: (D, C, P, P), the share of a point's light in each pixel; P is odd and the centre is the chief ray.
        defocus: (D,) ascending nodes in radians at the pupil edge at 530 nm.
        energy: (D, C) share of the light inside the window, before anything is done about the rest.
        veil: (D, C) share of the light that is spread evenly over the image, or None.

    Raises:
        ValueError: if the shapes do not fit each other or the nodes do not ascend.

    Example:
        >>> bank = PSFBank(torch.ones(2, 3, 1, 1), torch.tensor([-1.0, 1.0]), torch.ones(2, 3))
        >>> bank.window, bank.psfs.dtype
        (1, torch.float32)
    """

    psfs: Tensor
    defocus: Tensor
    energy: Tensor
    veil: Tensor | None = None

    def __post_init__(self) -> None:
        shape = tuple(self.psfs.shape)
        if len(shape) != 4 or shape[2] != shape[3] or shape[2] % 2 == 0:
            raise ValueError(f"psfs must have shape (D, C, P, P) with P odd, got {shape}")
        if tuple(self.defocus.shape) != shape[:1]:
            raise ValueError(f"defocus must have shape ({shape[0]},) as psfs have, got {tuple(self.defocus.shape)}")
        for name, value in (("energy", self.energy), ("veil", self.veil)):
            if value is not None and tuple(value.shape) != shape[:2]:
                raise ValueError(f"{name} must have shape {shape[:2]} as psfs have, got {tuple(value.shape)}")

    @property
    def window(self) -> int:
        """Side P of the PSFs in pixels."""
        return self.psfs.shape[-1]

    def with_stray_light(self, kind: str) -> PSFBank:
        """Return a bank in which the light outside the window is dealt with.

        Args:
            kind: ``"renormalize"`` scales each PSF to a sum of one; ``"veil"`` keeps the PSFs and spreads what they
                miss over the image; ``"discard"`` loses it.
        """
        check_choice("stray_light", kind, STRAY_LIGHT)
        if kind == "renormalize":
            tiny = torch.finfo(self.energy.dtype).tiny  # a PSF without light stays without light
            return PSFBank(self.psfs / self.energy.clamp(min=tiny)[..., None, None], self.defocus, self.energy)
        veil = (1 - self.energy).clamp(min=0) if kind == "veil" else None
        return PSFBank(self.psfs, self.defocus, self.energy, veil)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the bank as safetensors, all or nothing.

        Raises:
            FileNotFoundError: if the folder does not exist.
        """
        path = Path(path)
        if not path.parent.is_dir():
            raise FileNotFoundError(f"cannot save a PSF bank to {path}: there is no folder {path.parent}")
        tensors = {"psfs": self.psfs, "defocus": self.defocus, "energy": self.energy, "veil": self.veil}
        present = {k: v.detach().cpu().contiguous() for k, v in tensors.items() if v is not None}
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        os.close(handle)
        try:
            save_file(present, temporary, metadata={"format": _FORMAT, "layout": json.dumps(["D", "C", "P", "P"])})
            os.replace(temporary, path)
        finally:
            Path(temporary).unlink(missing_ok=True)

    @classmethod
    def load(cls, path: str | os.PathLike[str], device: torch.device | str = "cpu") -> PSFBank:
        """Read a bank written by :meth:`save`.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if the file is not a PSF bank.
        """
        path = Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"there is no PSF bank at {path}")
        try:
            with safe_open(path, framework="pt", device=str(device)) as file:
                if (file.metadata() or {}).get("format") != _FORMAT:
                    raise ValueError(f"{path} is not a PSF bank of this library (its format is not {_FORMAT!r})")
                return cls(**{key: file.get_tensor(key) for key in file.keys()})  # noqa: SIM118 (not a dict)
        except (SafetensorError, TypeError) as error:
            raise ValueError(f"{path} is not a readable PSF bank: {error}") from None

    @classmethod
    def from_measured(cls, psfs: Tensor, defocus: Tensor) -> PSFBank:
        """Return a bank from measured PSFs, each scaled to a sum of one and counted as holding all the light.

        Args:
            psfs: (D, C, P, P), not negative.
            defocus: (D,) radians, ascending.

        Raises:
            ValueError: if a value is negative or not finite, a PSF holds no light, or the nodes do not ascend.
        """
        if not bool((torch.isfinite(psfs) & (psfs >= 0)).all()):
            raise ValueError(f"measured psfs must be finite and not negative, got a minimum of {float(psfs.min())}")
        if not bool((defocus.diff() > 0).all()):
            raise ValueError(f"defocus must ascend, got {defocus.tolist()}")
        total = psfs.sum((-2, -1))
        if not bool((total > 0).all()):
            raise ValueError("every measured psf must hold some light, got one that is all zero")
        return cls(psfs / total[..., None, None], defocus, torch.ones_like(total))


@dataclass(frozen=True, eq=False)
class Pupil:
    """The aperture on a grid of square cells, a whole number of them for each mask pixel.

    Args:
        amplitude: (n, n) in [0, 1].
        cell_pitch: side of a cell in pupil radii.

    Example:
        >>> from kornia_tidy.optics.aperture import circular_aperture
        >>> pupil = Pupil(circular_aperture(23), 0.1)
        >>> round(pupil.light, 2), round(pupil.extent, 2)
        (3.17, 1.05)
    """

    amplitude: Tensor
    cell_pitch: float
    light: float = field(init=False)
    """Light it lets through, in units of squared amplitude times pupil radii squared."""
    extent: float = field(init=False)
    """Half width of the open part in pupil radii; twice it bounds the frequencies in a PSF."""

    def __post_init__(self) -> None:
        size = self.amplitude.shape[-1]
        farthest = (torch.nonzero(self.amplitude) - (size - 1) / 2).abs().max()
        object.__setattr__(self, "light", float(self.amplitude.double().square().sum()) * self.cell_pitch**2)
        object.__setattr__(self, "extent", (float(farthest) + 0.5) * self.cell_pitch)


def pupil_field(phase: Tensor, aperture: Tensor, dispersion: float) -> Tensor:
    """Return the complex field behind the mask at one wavelength.

    Args:
        phase: radians at 530 nm, (K, N, N), float32 or float64.
        aperture: amplitude on the same grid or one with a whole number of cells for each mask pixel, (sN, sN).
        dispersion: factor that takes the phase at 530 nm to the wavelength.

    Returns:
        (K, sN, sN) complex.

    Example:
        >>> pupil_field(torch.zeros(1, 2, 2), torch.ones(4, 4), 1.0).shape
        torch.Size([1, 4, 4])
    """
    cells = aperture.shape[-1] // phase.shape[-1]
    angle = phase * dispersion
    amplitude = aperture.to(angle)
    cosine, sine = angle.cos(), angle.sin()
    if cells > 1:
        cosine, sine = (x.repeat_interleave(cells, -1).repeat_interleave(cells, -2) for x in (cosine, sine))
    return torch.complex(amplitude * cosine, amplitude * sine)


def exact_psf_bank(
    phase: Tensor,
    weights: Tensor,
    pupil: Pupil,
    spectrum: Spectrum,
    dispersion: Sequence[float],
    defocus: Sequence[float],
    pixel_step: float | Tensor,
    window: int,
    tolerance: float = 2e-2,
) -> PSFBank:
    r"""Return the PSFs of a mask sequence with every mask pixel and sensor pixel integrated.

    .. math:: h_{dc} = \sum_\lambda s_c(\lambda) \sum_k w_k h_{dk\lambda} \Big/ \sum_\lambda s_c(\lambda)

    Args:
        phase: radians at 530 nm, (K, N, N).
        weights: share of the exposure of each mask, (K,), summing to one.
        pupil: the aperture.
        spectrum: wavelengths and how the channels weight them.
        dispersion: for each wavelength, the factor from phase at 530 nm to phase there.
        defocus: nodes in radians at 530 nm, ascending.
        pixel_step: a sensor pixel in the pupil, pitch * R / image distance, in metres; divided by a wavelength it is
            the pixel's side in cycles per pupil radius. May carry gradients.
        window: side P of the PSFs in pixels, odd.
        tolerance: error allowed to the integrals over sensor pixels, see :func:`sensor_kernels`.

    Returns:
        A bank whose PSFs sum to their energy.

    Source: design of the matrix transform: Soummer et al. 2007; average over masks: Shah et al. 2023, equation 4.

    Example:
        >>> flat, pupil = torch.zeros(1, 23, 23), Pupil(torch.ones(23, 23), 0.1)
        >>> bank = exact_psf_bank(flat, torch.ones(1), pupil, Spectrum.monochrome(), [1.0], [0.0], 2e-7, 23)
        >>> bank.psfs.shape
        torch.Size([1, 1, 23, 23])
    """
    per_channel = spectrum.channel_weights
    psfs = phase.new_zeros(len(defocus), len(per_channel), window, window)
    for w, wavelength in enumerate(spectrum.wavelengths):
        kernels = _kernels(
            tuple(p * (REFERENCE_WAVELENGTH / wavelength) for p in defocus),
            pixel_step / wavelength,
            (window, pupil.amplitude.shape[-1], pupil.cell_pitch, pupil.extent, tolerance),
            phase.device,
            torch.complex128 if phase.dtype == torch.float64 else torch.complex64,
        )
        light = pixel_energies(pupil_field(phase, pupil.amplitude, dispersion[w]), weights, kernels)
        energies = light / pupil.light
        share = phase.new_tensor([channel[w] for channel in per_channel])
        psfs = psfs + energies[:, None] * share[:, None, None]
    return PSFBank(psfs, phase.new_tensor(defocus), psfs.sum((2, 3)))


def paper_psf_bank(
    phase: Tensor,
    weights: Tensor,
    aperture: Tensor,
    spectrum: Spectrum,
    dispersion: Sequence[float],
    defocus: Sequence[float],
) -> PSFBank:
    """Return the PSFs of the published discretisation; see :mod:`kornia_tidy.optics.paper`.

    Raises:
        ValueError: if mask or aperture are not 23x23.
    """
    if phase.shape[-1] != PAPER_SIZE or aperture.shape[-1] != PAPER_SIZE:
        raise ValueError(
            f"fidelity 'paper' is defined for masks and apertures of 23x23 pixels, got {phase.shape[-1]} and "
            f"{aperture.shape[-1]}"
        )
    nodes = phase.new_tensor(defocus)
    psfs = phase.new_zeros(len(defocus), len(spectrum.channel_weights), PAPER_SIZE, PAPER_SIZE)
    for w, wavelength in enumerate(spectrum.wavelengths):
        share = phase.new_tensor([channel[w] for channel in spectrum.channel_weights])
        one = paper_psfs(phase, weights, aperture, nodes, wavelength, dispersion[w])
        psfs = psfs + one[:, None] * share[:, None, None]
    return PSFBank(psfs, nodes, psfs.sum((2, 3)))


def enclosing_window(psfs: Tensor, share: float) -> int | None:
    """Return the smallest odd window, centred, that holds a share of the light in every PSF.

    Args:
        psfs: (..., P, P), each the share of a point's light in each pixel.
        share: between 0 and 1.

    Returns:
        Side in pixels, or None where even P does not hold it.

    Example:
        >>> psf = torch.zeros(5, 5)
        >>> psf[2, 2], psf[1, 2] = 0.7, 0.2
        >>> enclosing_window(psf, 0.5), enclosing_window(psf, 0.85), enclosing_window(psf, 0.95)
        (1, 3, None)
    """
    size = psfs.shape[-1]
    offset = (torch.arange(size, device=psfs.device) - size // 2).abs()
    ring = torch.maximum(offset[:, None], offset[None, :]).flatten()
    rings = psfs.new_zeros(*psfs.shape[:-2], size // 2 + 1).index_add(-1, ring, psfs.flatten(-2))
    held = rings.cumsum(-1).reshape(-1, size // 2 + 1).amin(0) >= share
    return 2 * int(held.long().argmax()) + 1 if bool(held.any()) else None


Geometry = tuple[int, int, float, float, float]  # window, cells, cell pitch, extent, tolerance
_CACHE: OrderedDict[tuple[object, ...], Tensor] = OrderedDict()
_CACHE_BYTES = 256 * 2**20


def _kernels(
    defocus: tuple[float, ...], step: float | Tensor, geometry: Geometry, device: torch.device, dtype: torch.dtype
) -> Tensor:
    """Return the sensor kernels, remembered where the geometry is fixed: they depend on nothing else."""
    if isinstance(step, Tensor):  # a learnable focus sends its gradient through them
        return sensor_kernels(defocus, step.double(), *geometry, device).to(dtype)
    if torch.compiler.is_compiling():
        return sensor_kernels(defocus, step, *geometry, device).to(dtype)
    key = (defocus, step, geometry, device, dtype)
    if key not in _CACHE:
        with torch.inference_mode(False), torch.no_grad():
            _CACHE[key] = sensor_kernels(defocus, step, *geometry, device).to(dtype)
        while len(_CACHE) > 1 and sum(kernels.nbytes for kernels in _CACHE.values()) > _CACHE_BYTES:
            _CACHE.popitem(last=False)
    _CACHE.move_to_end(key)
    return _CACHE[key]
