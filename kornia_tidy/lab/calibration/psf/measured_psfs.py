"""Measured PSFs over depth: a PSF bank for rendering and restoration, its uncertainty, and a report on each capture."""

from __future__ import annotations

import json
import math
import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, cast

import torch
from torch import Tensor
from torch.nn.functional import pad

from kornia_tidy.checks import check_depth
from kornia_tidy.files import error_prefix, parse_json
from kornia_tidy.lab.calibration.psf.disturbances import (
    check_clipping,
    check_diameter,
    image_diameter,
    share_around,
    warn_of_light_around,
    warn_of_still_point,
)
from kornia_tidy.lab.calibration.psf.dithering import most_aliases
from kornia_tidy.lab.calibration.psf.point_images import PointImage
from kornia_tidy.lab.calibration.psf.registration import Registered, register
from kornia_tidy.lab.calibration.psf.shrinkage import shrink
from kornia_tidy.masks.base import MASK_SPAN
from kornia_tidy.optics.aperture import circular_aperture
from kornia_tidy.optics.spectrum import check_wavelength
from kornia_tidy.optics.thin_lens import ThinLensCamera
from kornia_tidy.optics.units import like_infinity, warn_of_metres
from kornia_tidy.psf.field_bank import FieldBank
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.psf.pupil import Pupil
from kornia_tidy.tensor_files import read_tensors

LENS = ("focal_length", "aperture_diameter", "focus_distance", "pixel_pitch")  # metres
ONE_DISTANCE = 0.01  # of it, on either side: the range of a camera that was measured at one distance
# A lens' light falls with the cube of the radius, or a little slower or faster. Of the mean light between window and
# annulus this share, and its doubt, is in the annulus too, where it was taken for background.
TAIL, TAIL_DOUBT = 0.4, 0.3
LEVEL = (1 + TAIL) ** 2 + 1.8 * TAIL**2  # variance of the background so corrected, by that of the annulus
MOST_MISFIT = 25.0  # residuals of five times the noise; with larger ones the PSF does not describe the captures


GOOD_NOISE = 0.02  # in L1


@dataclass(frozen=True)
class PointReport:
    """Report on one point image in the measurement.

    Args:
        distance: distance of the point in metres.
        row: row of the chief ray, in pixels of the sensor.
        column: column of the chief ray, in pixels of the sensor.
        brightness: relative to the mean of the images used at this distance; None if the image has a fault.
        misfit: mean square of the residuals in units of their variance, 1 for pure noise; None if the image has a
            fault.
        rejected: reason for which the image was not used, or None.
    """

    distance: float
    row: float
    column: float
    brightness: float | None
    misfit: float | None
    rejected: str | None


@dataclass(frozen=True, eq=False)
class MeasuredPSFs:
    """PSFs measured over depth, at one place of the picture or at several.

    Args:
        bank: the PSFs, each summing to one. Light outside the window was not measured and is ignored. Of several
            places, see :meth:`over_field`, a :class:`~kornia_tidy.psf.FieldBank`.
        uncertainty: (D, C, P, P), or with a field (F, D, C, P, P): standard deviation of each value: from the noise
            and the scatter of the captures, the background, the light around the window, the position and the diameter
            of the point. The truth lies within 1.96 of it for 95 % of the values; docs/calibration.md has figures, and
            says what no capture reveals.
        distances: (D,) distance in metres of each node of the bank, from far to near.
        reports: one for each point image.
        camera: the lens, which turns distance into defocus. None if unknown, as of files of earlier versions.
    """

    bank: PSFBank | FieldBank
    uncertainty: Tensor
    distances: Tensor
    reports: tuple[PointReport, ...] = ()
    camera: ThinLensCamera | None = None

    def __post_init__(self) -> None:
        shape = tuple(self.bank.psfs.shape)
        if tuple(self.uncertainty.shape) != shape:
            raise ValueError(
                f"uncertainty must have the shape of the PSFs, {shape}, got {tuple(self.uncertainty.shape)}"
            )
        if self.distances.shape != self.bank.defocus.shape:
            raise ValueError(
                f"distances must have shape ({len(self.bank.defocus)},), one a PSF, got {tuple(self.distances.shape)}"
            )

    @classmethod
    def over_field(
        cls,
        measured: Sequence[MeasuredPSFs],
        field: Sequence[tuple[float, float]],
        light: Sequence[float] | None = None,
    ) -> MeasuredPSFs:
        """Return the measurement of a camera at several places of its picture, whose file ``--psfs`` takes.

        Args:
            measured: of each place, at the same distances.
            field: the places, y and x in sensor pixels from the lens's axis.
            light: of an even scene at each place over that on the axis. Default: 1, no vignetting.

        Raises:
            TypeError: if the places are not numbers.
            ValueError: if there is not one place for each measurement, or they differ in distances, colours or window.

        Example:
            >>> camera, distances = ThinLensCamera(depth_range=(0.5, 0.8)), torch.tensor([0.8, 0.5])
            >>> bank = PSFBank.from_measured(torch.rand(2, 3, 5, 5), camera.defocus(distances))
            >>> one = MeasuredPSFs(bank, torch.zeros(2, 3, 5, 5), distances, camera=camera)
            >>> MeasuredPSFs.over_field([one, one], [(0, 0), (300, 400)]).bank.psfs.shape
            torch.Size([2, 2, 3, 5, 5])
        """
        bank = FieldBank.from_measured([cast("PSFBank", one.bank) for one in measured], field, light)
        uncertainty = torch.stack([one.uncertainty for one in measured]) * bank.light[..., None, None]
        reports = tuple(report for one in measured for report in one.reports)
        return cls(bank, uncertainty, measured[0].distances, reports, measured[0].camera)

    def known_camera(self) -> ThinLensCamera:
        """Return the lens.

        Raises:
            ValueError: if it is unknown.
        """
        if self.camera is None:
            raise ValueError(
                "the measured PSFs come without the lens that turns distance into defocus: measure them again with "
                "kornia-tidy raw calibrate-psf, or take TiDyOptics(camera=...).with_bank(bank)"
            )
        return self.camera

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the measurement as a safetensors file, whose bank the ``load`` of its class reads.

        Args:
            path: file to write; after an error no partial file remains.

        Raises:
            FileNotFoundError: if the folder does not exist.
        """
        measured = {"measured.uncertainty": self.uncertainty, "measured.distances": self.distances}
        notes = {"reports": json.dumps([asdict(report) for report in self.reports])}
        if self.camera is not None:
            notes["camera"] = json.dumps({name: float(getattr(self.camera, name)) for name in LENS})
        self.bank.save(path, measured, notes)

    @classmethod
    def load(cls, path: str | os.PathLike[str], device: torch.device | str = "cpu") -> MeasuredPSFs:
        """Read a measurement from a file written by :meth:`save`.

        Args:
            path: file to read.
            device: device of the tensors.

        Raises:
            FileNotFoundError: if the file is missing.
            ValueError: if the file is not a PSF bank, or a bank that was not measured.
        """
        found, notes = read_tensors(path, "PSF bank", device)
        bank = (FieldBank if notes.get("format") == FieldBank.form else PSFBank).load(path, device)
        names = [name for name in ("measured.uncertainty", "measured.distances") if name in found]
        tensors: dict[str, Any] = {name.removeprefix("measured."): found[name] for name in names}
        with error_prefix(f"{path} is a PSF bank, but not one that was measured", TypeError):
            reports = tuple(PointReport(**report) for report in parse_json(notes.get("reports", "")))
            measured = cls(bank, reports=reports, **tensors)
            return replace(measured, camera=_lens(notes["camera"], measured)) if "camera" in notes else measured

    def in_words(self) -> list[tuple[str, str]]:
        """Return the omitted captures, and the accuracy at each distance, as topics and texts."""
        topics = [
            ("left out", f"the point at {r.distance:g} m, row {r.row:.1f}, column {r.column:.1f}: {r.rejected}")
            for r in self.reports
            if r.rejected is not None
        ]
        noise = (2 / torch.pi) ** 0.5 * self.uncertainty.sum((-2, -1))
        noise = noise if noise.ndim == 2 else noise.amax(0)  # of the worst place
        for distance, psi, own in zip(self.distances, self.bank.defocus, noise, strict=True):
            used = [r for r in self.reports if r.distance == float(distance) and r.rejected is None]
            times = (sum(r.misfit or 0.0 for r in used) / len(used)) ** 0.5
            words = " ".join(f"{100 * float(x):.2g}" for x in own)
            told = f"{len(used)} point images, residuals {times:.2g} times the noise, noise {words} % in L1"
            topics.append(("PSF", f"{float(distance):g} m, psi {float(psi):+.2f} rad: {told}"))
            if (worst := float(own.max())) > GOOD_NOISE:
                more = math.ceil(len(used) * (worst / GOOD_NOISE) ** 2)
                remedy = f"about {more} point images, or one more and far longer exposure"
                topics.append(("", f"{remedy}, bring it to {GOOD_NOISE:.0%}"))
        return topics


def _lens(text: str, measured: MeasuredPSFs) -> ThinLensCamera:
    """Return the lens of a file over the distances that were measured."""
    values = parse_json(text)
    if not isinstance(values, dict) or set(values) != set(LENS):
        raise ValueError(f"its lens must be given by {', '.join(LENS)}, got {text!r:.200}")
    camera = _over(ThinLensCamera(**values, depth_range=(1.0, 2.0)), measured.distances)
    nodes = camera.defocus(measured.distances)
    if not torch.allclose(nodes, measured.bank.defocus.double(), rtol=1e-3, atol=0.01):
        raise ValueError("the defocus of its PSFs is not that of its lens at its distances")
    return camera


def _over(camera: ThinLensCamera, distances: Tensor) -> ThinLensCamera:
    """Return a lens over the range of these distances."""
    near, far = float(distances.min()), float(distances.max())
    if near == far:
        near, far = near * (1 - ONE_DISTANCE), far * (1 + ONE_DISTANCE)
    focus = float(camera.focus_distance)
    return camera.changed(focus_distance=focus, depth_range=(near, far), lens_material=None)  # files have no material


def diffraction_cutoff(camera: ThinLensCamera, wavelength: float, pupil: Pupil | None = None) -> float:
    r"""Return the diffraction cutoff of a lens in cycles per pixel, :math:`d R p / (\lambda s')`.

    Args:
        camera: lens with aperture radius R, image distance s' and pixel pitch p.
        wavelength: shortest wavelength of the channel in metres.
        pupil: aperture of diameter d, the largest distance between two open points, in pupil radii. Default: that
            of 23x23 mask pixels. Its corner pixels reach beyond the disc, so d is 2.14, and 2 for the disc.

    Source: Goodman, Introduction to Fourier Optics, section 7.2.

    Example:
        >>> round(diffraction_cutoff(ThinLensCamera(), 530e-9), 3)
        0.839
    """
    check_wavelength("wavelength", wavelength)
    pupil = Pupil(circular_aperture(23), MASK_SPAN / 23) if pupil is None else pupil
    frequency = camera.aperture_radius * camera.pixel_pitch / (wavelength * float(camera.image_distance))
    return pupil.diameter * frequency


def channel_cutoffs(camera: ThinLensCamera, channels: int) -> list[float]:
    """Return the diffraction cutoff of a lens at the shortest wavelength of each channel, at most 2 cycles per pixel.

    Args:
        camera: the lens.
        channels: 3 of red, green and blue, or of all visible light.

    Example:
        >>> [round(cutoff, 2) for cutoff in channel_cutoffs(ThinLensCamera(), 3)]
        [0.78, 0.93, 1.11]
    """
    shortest = {3: (570e-9, 480e-9, 400e-9)}.get(channels, (400e-9,) * channels)
    return [min(2.0, diffraction_cutoff(camera, wave)) for wave in shortest]


def measure_psfs(
    images: Mapping[float, Sequence[PointImage]],
    camera: ThinLensCamera,
    window: int,
    cutoff: float | Sequence[float] = 1.0,
    diameter: float = 0.0,
) -> MeasuredPSFs:
    """Measure a PSF bank from point images at known distances.

    Args:
        images: point images from :func:`point_images` by their distance in metres.
        camera: converts distance to defocus.
        window: side P of the PSFs in pixels of the sensor, the same as for the images.
        cutoff: highest frequency that the lens passes in each channel, in cycles per pixel of the sensor, see
            :func:`diffraction_cutoff`.
        diameter: of the point of light in metres. Its blur is corrected to second order, and half of the correction is
            in the uncertainty.

    Returns:
        The PSFs, their uncertainty and a report on each image.

    Raises:
        ValueError: if at some distance no image can be used, captures are clipped below saturation, the image of the
            point is wider than half a pixel or residuals exceed five times the noise, or if there is not one cutoff for
            each channel.

    Warns:
        UserWarning: if there are fewer images than aliased frequencies, if the point moves less than a grain of dust is
            wide (both before any computation), or if more than 5 % of the light lies around the window.

    Example:
        >>> from kornia_tidy import SensorNoise
        >>> from kornia_tidy.lab.calibration.psf import point_images
        >>> x, camera = torch.arange(64.0), ThinLensCamera()
        >>> spot = lambda at: 0.8 * torch.exp(-((x[:, None] - 32) ** 2 + (x - at) ** 2) / 8)[None, None]
        >>> sensor = SensorNoise.physical(10500, 2.4)
        >>> points = [point_images(spot(at), torch.ones(1), sensor, 15)[0] for at in (29.7, 31.9, 32.1, 34.3)]
        >>> measured = measure_psfs({0.595: points}, camera, 15, diffraction_cutoff(camera, 530e-9))
        >>> measured.bank.psfs.shape, round(float(measured.bank.psfs.sum()), 4)
        (torch.Size([1, 1, 15, 15]), 1.0)
    """
    check_depth(torch.tensor(list(images)))
    nearest, last = min(images, default=math.inf), like_infinity(camera.aperture_radius)
    warn_of_metres(["distance"], [nearest], camera.focal_length, last)
    limits = _limits(images, cutoff)
    check_diameter(diameter, list(images), camera)
    check_clipping(images)
    if not _warn_of_few(images, limits):
        warn_of_still_point(images)
    nodes = sorted((float(camera.defocus(torch.tensor(z, dtype=torch.float64))), z) for z in images)
    psfs, deviations, reports, shares = [], [], [], {}
    for _, distance in nodes:
        all_images = list(images[distance])
        good = [image for image in all_images if image.fault is None]
        reports += [
            PointReport(distance, *(_upsampling(image) * x for x in image.place), None, None, image.fault)
            for image in all_images
            if image.fault is not None
        ]
        if not good:
            faults = "; ".join(str(image.fault) for image in all_images) or "there is none"
            raise ValueError(f"no point image at {distance:g} m can be used: {faults}")
        found = register(good, limits)
        misfit = float(found.misfit[found.used].mean())
        if not misfit <= MOST_MISFIT:
            raise ValueError(
                f"the PSFs found at {distance:g} m do not explain their captures: residuals are {misfit**0.5:.1f} "
                f"times the noise, at most {MOST_MISFIT**0.5:g} are allowed"
            )
        reports += _reports(distance, good, found)
        raw = _raw(good, found, window, image_diameter(diameter, distance, camera))
        shares[distance] = share_around(float(raw.around.max()), window)
        psf, remaining = shrink(raw.psf, raw.variance)
        psfs.append(psf.clamp(min=0))
        # An error of the total, the divisor of all values, changes them in proportion.
        remaining = remaining * (1 - 2 * psf).clamp(min=0) + psf.square() * raw.variance.sum((1, 2), keepdim=True)
        common = raw.common - psf[:, None] * raw.common.sum((2, 3), keepdim=True)
        deviations.append((remaining + common.square().sum(1)).sqrt())
    warn_of_light_around(shares, window)
    defocus = torch.tensor([psi for psi, _ in nodes], dtype=torch.float32)
    bank = PSFBank.from_measured(torch.stack(psfs).float(), defocus)
    distances = torch.tensor([distance for _, distance in nodes], dtype=torch.float64)
    return MeasuredPSFs(bank, torch.stack(deviations).float(), distances, tuple(reports), _over(camera, distances))


@dataclass(frozen=True, eq=False)
class _Raw:
    """PSFs of one distance before denoising, (C, P, P), each with a sum of one.

    Args:
        psf: the PSFs.
        variance: of their noise.
        common: (C, K, P, P) errors of all pixels together, each of one standard deviation.
        around: (C,) mean light of a pixel around the window.
    """

    psf: Tensor
    variance: Tensor
    common: Tensor
    around: Tensor


def _raw(images: Sequence[PointImage], found: Registered, window: int, blur: float) -> _Raw:
    """Return the PSFs with the background corrected, and their errors.

    Args:
        images: those that were registered.
        found: the registration.
        window: side P of the PSFs.
        blur: diameter of the point's image in pixels.
    """
    used = [image for image, good in zip(images, found.used.tolist(), strict=True) if good]
    scale = found.brightness[found.used]
    told = torch.tensor([image.offset for image in used], dtype=torch.float64)
    # The mean position is that of the centres of light; their scatter about the registered positions gives its error.
    spread = (told - found.offsets[found.used]).var(0, correction=min(1, len(used) - 1))
    position = (spread / len(used)).sqrt()
    count = len(images[0].light)
    around = torch.stack([image.around.expand(count) / b for image, b in zip(used, scale, strict=True)])
    background = torch.stack(
        [image.background_variance.expand(count) / b**2 for image, b in zip(used, scale, strict=True)]
    )
    raw = []
    for channel, one in enumerate(found.psfs):
        planes = [plane for plane, other in enumerate(images[0].channels) if other == channel]
        beyond = around[:, planes].median()
        level = (
            (TAIL_DOUBT * beyond).square() + LEVEL * background[:, planes].mean() / background[:, planes].numel()
        ).sqrt()
        slopes = one.gradient(_upsampling(images[0]))
        psf, variance, scatter, down, right = (
            _central(x, images[0], window) for x in (one.psf, one.variance, found.scatter[channel], *slopes)
        )
        blurred = blur**2 / 32 * _laplacian(psf)
        psf = psf + TAIL * beyond - blurred
        total = psf.sum()
        # The images' scatter about the PSF, where it exceeds the noise, is an error of each image: dust, for example.
        variance = variance * scatter.clamp(min=1)
        common = [position[0] * down, position[1] * right, level.expand_as(psf), 0.5 * blurred]
        raw.append((psf / total, variance / total**2, torch.stack(common) / total, beyond / total))
    return _Raw(*(torch.stack(parts) for parts in zip(*raw, strict=True)))


def _laplacian(psf: Tensor) -> Tensor:
    """Return the Laplacian: a disc of diameter d blurs a PSF by d² / 32 times it, to second order."""
    wide = pad(psf[None], (1, 1, 1, 1), mode="replicate")[0]
    return wide[:-2, 1:-1] + wide[2:, 1:-1] + wide[1:-1, :-2] + wide[1:-1, 2:] - 4 * psf


def _limits(images: Mapping[float, Sequence[PointImage]], cutoff: float | Sequence[float]) -> list[float]:
    """Return the cutoff of each channel."""
    every = (image for at_distance in images.values() for image in at_distance)
    channels = 1 + max((channel for image in every for channel in image.channels), default=0)
    limits = [cutoff] * channels if isinstance(cutoff, (int, float)) else list(cutoff)
    if len(limits) != channels:
        raise ValueError(f"cutoff must be one number, or one for each of {channels} channels, got {limits}")
    return limits


def _warn_of_few(images: Mapping[float, Sequence[PointImage]], limits: Sequence[float]) -> bool:
    """Warn once, for the distance and channel that lack most images, that they do not determine the PSF.

    Returns:
        Whether it warned.
    """
    lacking = []
    for distance, at_distance in images.items():
        good = [image for image in at_distance if image.fault is None]
        for channel, limit in enumerate(limits if good else ()):
            planes = good[0].channels.count(channel)  # each plane samples the point at another position
            wanted = -(-most_aliases(limit * _upsampling(good[0])) // planes)
            lacking.append((wanted - len(good), wanted, len(good), distance, channel))
    if lacking and max(lacking)[0] > 0:
        _, wanted, there, distance, channel = max(lacking)
        warnings.warn(
            f"{there} places of the point at {distance:g} m are too few to resolve channel {channel}, whose PSF is in "
            f"part a guess, which its noise does not tell: {wanted} are needed, half as many again are good",
            stacklevel=3,
        )
        return True
    return False


def _upsampling(image: PointImage) -> int:
    """Return the pixels of the sensor for one pixel of the image along each axis."""
    return 1 if image.tile is None else len(image.tile)


def _central(psf: Tensor, image: PointImage, window: int) -> Tensor:
    """Crop the PSF to the window around the chief ray, which falls on the central pixel of the image."""
    first = _upsampling(image) * (image.light.shape[-1] // 2) - window // 2
    return psf[first : first + window, first : first + window]


def _reports(distance: float, images: Sequence[PointImage], found: Registered) -> list[PointReport]:
    reports = []
    for n, image in enumerate(images):
        misfit = float(found.misfit[n])
        row, column = (
            _upsampling(image) * (place - before + float(after))
            for place, before, after in zip(image.place, image.offset, found.offsets[n], strict=True)
        )
        rejected = None if found.used[n] else f"its residuals are {misfit**0.5:.1f} times the noise"
        reports.append(PointReport(distance, row, column, float(found.brightness[n]), misfit, rejected))
    return reports
