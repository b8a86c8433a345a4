"""PSFs measured over depth: a bank to render and to restore with, how sure it is, and what became of each capture."""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import torch
from torch import Tensor

from kornia_tidy.calibration.psf.dithering import most_aliases
from kornia_tidy.calibration.psf.point_images import PointImage
from kornia_tidy.calibration.psf.registration import Registered, register
from kornia_tidy.calibration.psf.shrinkage import shrink
from kornia_tidy.checks import check_depth
from kornia_tidy.files import parse_json
from kornia_tidy.masks.base import MASK_SPAN
from kornia_tidy.optics.aperture import circular_aperture
from kornia_tidy.optics.thin_lens import ThinLensCamera
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.psf.pupil import Pupil
from kornia_tidy.tensor_files import read_tensors

MOST_MISFIT = 25.0  # residuals of five times the noise: more is no PSF of these captures


@dataclass(frozen=True)
class PointReport:
    """What became of one point image.

    Args:
        distance: of the point in metres.
        row: where its chief ray fell, in pixels of the sensor.
        column: as well.
        brightness: over the mean of those used at this distance; None if it was never used.
        misfit: mean square of its residuals in units of their variance, 1 is noise; None likewise.
        rejected: why it was not used, or None.
    """

    distance: float
    row: float
    column: float
    brightness: float | None
    misfit: float | None
    rejected: str | None


@dataclass(frozen=True, eq=False)
class MeasuredPSFs:
    """PSFs measured over depth.

    Args:
        bank: the PSFs, each summing to one: what light leaves the window is not seen and counted as none.
        uncertainty: (D, C, P, P) standard deviation of each, of the noise in the captures. What else there is, such as
            a point that moved between the frames, shows in the misfit of the reports.
        distances: (D,) in metres, of the bank's nodes: from far to near.
        reports: of every point image.
    """

    bank: PSFBank
    uncertainty: Tensor
    distances: Tensor
    reports: tuple[PointReport, ...] = ()

    def __post_init__(self) -> None:
        shape = tuple(self.bank.psfs.shape)
        if tuple(self.uncertainty.shape) != shape:
            raise ValueError(
                f"uncertainty must have the shape of the PSFs, {shape}, got {tuple(self.uncertainty.shape)}"
            )
        if tuple(self.distances.shape) != shape[:1]:
            raise ValueError(f"distances must have shape ({shape[0]},), one a PSF, got {tuple(self.distances.shape)}")

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write it all as safetensors, all or nothing; :meth:`PSFBank.load` reads the bank of it.

        Raises:
            FileNotFoundError: if the folder does not exist.
        """
        measured = {"measured.uncertainty": self.uncertainty, "measured.distances": self.distances}
        self.bank.save(path, measured, {"reports": json.dumps([asdict(report) for report in self.reports])})

    @classmethod
    def load(cls, path: str | os.PathLike[str], device: torch.device | str = "cpu") -> MeasuredPSFs:
        """Read what :meth:`save` wrote.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if the file is no PSF bank, or one that was not measured.
        """
        bank = PSFBank.load(path, device)
        stored, notes = read_tensors(path, "PSF bank", device)
        names = [name for name in ("measured.uncertainty", "measured.distances") if name in stored]
        tensors = {name.removeprefix("measured."): stored[name] for name in names}
        try:
            reports = tuple(PointReport(**report) for report in parse_json(notes.get("reports", "")))
            return cls(bank, reports=reports, **tensors)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{path} is a PSF bank, but not one that was measured: {error}") from None


def diffraction_cutoff(camera: ThinLensCamera, wavelength: float, pupil: Pupil | None = None) -> float:
    r"""Return the highest frequency that a lens passes in any direction: :math:`d R p / (\lambda s')` cycles per pixel.

    Args:
        camera: the lens, with its aperture's radius R, image distance s' and pixel pitch p.
        wavelength: the shortest in the channel, in metres.
        pupil: its aperture, of which d is the largest distance between two open points in pupil radii. Default: that of
            a lens with 23x23 mask pixels, whose corners reach beyond the disc: d = 2.14, along an axis 2.1, where the
            disc has 2.

    Source: Goodman, Introduction to Fourier Optics, section 7.2.

    Example:
        >>> round(diffraction_cutoff(ThinLensCamera(), 530e-9), 3)
        0.839
    """
    pupil = Pupil(circular_aperture(23), MASK_SPAN / 23) if pupil is None else pupil
    frequency = camera.aperture_radius * camera.pixel_pitch / (wavelength * float(camera.image_distance))
    return pupil.diameter * frequency


def measure_psfs(
    images: Mapping[float, Sequence[PointImage]],
    camera: ThinLensCamera,
    window: int,
    cutoff: float | Sequence[float] = 1.0,
) -> MeasuredPSFs:
    """Return the PSFs that point images at known distances show.

    Args:
        images: of each distance in metres, from :func:`point_images`.
        camera: what turns a distance into defocus.
        window: side P of the PSFs in pixels of the sensor, that of the images.
        cutoff: highest frequency that the lens passes in each channel, in cycles per pixel of the sensor, see
            :func:`diffraction_cutoff`.

    Raises:
        ValueError: if at some distance no image can be used, the PSFs found leave residuals of five times the noise
            and more, or the cutoffs are not one a channel.

    Warns:
        UserWarning: if there are fewer images than frequencies that they are to tell apart, before any work.

    Example:
        >>> from kornia_tidy import SensorNoise
        >>> from kornia_tidy.calibration.psf import point_images
        >>> x, camera = torch.arange(64.0), ThinLensCamera()
        >>> spot = lambda at: 0.8 * torch.exp(-((x[:, None] - 32) ** 2 + (x - at) ** 2) / 8)[None, None]
        >>> sensor = SensorNoise.physical(10500, 2.4)
        >>> points = [point_images(spot(at), torch.ones(1), sensor, 15)[0] for at in (31.7, 31.9, 32.1, 32.3)]
        >>> measured = measure_psfs({0.595: points}, camera, 15, diffraction_cutoff(camera, 530e-9))
        >>> measured.bank.psfs.shape, round(float(measured.bank.psfs.sum()), 4)
        (torch.Size([1, 1, 15, 15]), 1.0)
    """
    check_depth(torch.tensor(list(images)))
    limits = _limits(images, cutoff)
    _warn_of_few(images, limits)
    nodes = sorted((float(camera.defocus(torch.tensor(z, dtype=torch.float64))), z) for z in images)
    psfs, deviations, reports = [], [], []
    for _, distance in nodes:
        own = list(images[distance])
        good = [image for image in own if image.fault is None]
        reports += [
            PointReport(distance, *(_finer(image) * x for x in image.place), None, None, image.fault)
            for image in own
            if image.fault is not None
        ]
        if not good:
            faults = "; ".join(str(image.fault) for image in own) or "there is none"
            raise ValueError(f"no point image at {distance:g} m can be used: {faults}")
        found = register(good, limits)
        misfit = float(found.misfit[found.used].mean())
        if not misfit <= MOST_MISFIT:
            raise ValueError(
                f"the PSFs found at {distance:g} m do not explain their captures: residuals are {misfit**0.5:.1f} "
                f"times the noise, at most {MOST_MISFIT**0.5:g} are allowed"
            )
        reports += _reports(distance, good, found)
        psf, variance = (
            torch.stack([_central(getattr(one, name), good[0], window) for one in found.psfs])
            for name in ("psf", "variance")
        )
        total = psf.sum((1, 2))[:, None, None]
        psf, variance = shrink(psf / total, variance / total**2)
        psfs.append(psf.clamp(min=0))
        deviations.append(variance.sqrt())
    defocus = torch.tensor([psi for psi, _ in nodes], dtype=torch.float32)
    bank = PSFBank.from_measured(torch.stack(psfs).float(), defocus)
    distances = torch.tensor([distance for _, distance in nodes], dtype=torch.float64)
    return MeasuredPSFs(bank, torch.stack(deviations).float(), distances, tuple(reports))


def _limits(images: Mapping[float, Sequence[PointImage]], cutoff: float | Sequence[float]) -> list[float]:
    """The cutoff of each channel."""
    channels = 1 + max((channel for own in images.values() for image in own for channel in image.channels), default=0)
    limits = [cutoff] * channels if isinstance(cutoff, (int, float)) else list(cutoff)
    if len(limits) != channels:
        raise ValueError(f"cutoff must be one number, or one for each of {channels} channels, got {limits}")
    return limits


def _warn_of_few(images: Mapping[float, Sequence[PointImage]], limits: Sequence[float]) -> None:
    """Tell once, of the distance and the channel that lack most, that the prior must make up for missing places."""
    lacking = []
    for distance, own in images.items():
        good = [image for image in own if image.fault is None]
        for channel, limit in enumerate(limits if good else ()):
            planes = good[0].channels.count(channel)  # each sees the point at a place of its own
            wanted = -(-most_aliases(limit * _finer(good[0])) // planes)
            lacking.append((wanted - len(good), wanted, len(good), distance, channel))
    if lacking and max(lacking)[0] > 0:
        _, wanted, there, distance, channel = max(lacking)
        warnings.warn(
            f"{there} places of the point at {distance:g} m are too few to resolve channel {channel}, whose PSF is in "
            f"part a guess, which its noise does not tell: {wanted} are needed, half as many again are good",
            stacklevel=3,
        )


def _finer(image: PointImage) -> int:
    """Pixels of the sensor to one of the image."""
    return 1 if image.tile is None else len(image.tile)


def _central(psf: Tensor, image: PointImage, window: int) -> Tensor:
    """The window about the chief ray, which falls on the central pixel of the image."""
    first = _finer(image) * (image.light.shape[-1] // 2) - window // 2
    return psf[first : first + window, first : first + window]


def _reports(distance: float, images: Sequence[PointImage], found: Registered) -> list[PointReport]:
    reports = []
    for n, image in enumerate(images):
        misfit = float(found.misfit[n])
        row, column = (
            _finer(image) * (place - before + float(after))
            for place, before, after in zip(image.place, image.offset, found.offsets[n], strict=True)
        )
        words = None if found.used[n] else f"its residuals are {misfit**0.5:.1f} times the noise"
        reports.append(PointReport(distance, row, column, float(found.brightness[n]), misfit, words))
    return reports
