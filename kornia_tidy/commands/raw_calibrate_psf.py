"""`kornia-tidy raw calibrate-psf`: measurement of PSFs from pictures of a point of light at known distances."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from kornia_tidy.commands.parser import Given
from kornia_tidy.commands.raw_options import Dump, RawFiles
from kornia_tidy.commands.shared import File, Noise, Window, check_outputs, read_noise
from kornia_tidy.inference.settings import LensSettings
from kornia_tidy.settings import Count, Electrons, Metres, Seconds, Unit

if TYPE_CHECKING:
    from torch import Tensor

    from kornia_tidy.calibration.noise.photon_transfer import PhotonTransfer
    from kornia_tidy.calibration.psf.point_images import Tile
    from kornia_tidy.optics.thin_lens import ThinLensCamera
    from kornia_tidy.sensor.noise import SensorNoise

GOOD_NOISE = 0.02  # in L1


@dataclass(frozen=True, kw_only=True)
class NoiseOfSensor:
    """Noise of the sensor.

    Args:
        full_well: electrons from black to white. None: as noise says.
        read_noise: its standard deviation. None: as noise says.
        noise: standard deviation of the read noise in linear light, of full scale; or the file that kornia-tidy raw
            calibrate-noise wrote. None: by full_well and read_noise.
    """

    full_well: Electrons | None = None
    read_noise: Electrons | None = None
    noise: Noise | None = None


@dataclass(frozen=True, kw_only=True)
class CalibratePsf:
    """Pictures of a point -> PSF bank.

    The pictures show a point of light at known distances.
    At each distance the point is moved by some pixels and fractions of a pixel between
    the pictures: an undersampled PSF can only be reconstructed from several of them, and
    dust on the sensor stays where it is. 16 positions are good, 24 behind a filter array;
    they need not be known. Several exposures at each
    position, the longer ones saturated, measure the faint parts of a PSF as well. FILES
    are raw files or 16-bit images of linear light without black level, sorted by
    distance, then by position of the point, then by exposure. The planes of one colour of
    a filter array give one PSF on the pixel grid of the sensor, so that the bank has red,
    green and blue.

    Args:
        files: raw files, or 16-bit images of linear light.
        distances: of the point.
        output: bank to write, .safetensors.
        exposures: at each place.
        reference: the same places with a flat mask, unsaturated. None: PSFs are centred at their centroids.
        window: side of the PSFs in pixels of the sensor.
        points: points in each picture.
        picture: draw PSFs, uncertainties and residuals. None: they are not drawn.
        fit_mask: find the mask behind the PSFs and write its heights in metres. None: it is not searched for.
        mask_size: pixels along a side of the mask that is fitted.
        diameter: of the point of light.
        sensor: its noise.
        lens: of the camera; its depths are the distances.
        dump: what a headerless file holds.
    """

    files: RawFiles
    distances: tuple[Metres, ...]
    output: Annotated[str, Unit("OUT")]
    exposures: tuple[Seconds, ...] = (1.0,)
    reference: tuple[File, ...] = ()
    window: Window = 41
    points: Count = 1
    picture: Annotated[str, Unit("PNG")] | None = None
    fit_mask: Annotated[str, Unit("NPY")] | None = None
    mask_size: Count = 23
    diameter: Annotated[float, Unit("M", "metres", 0)] = 0.0
    sensor: NoiseOfSensor = field(default_factory=NoiseOfSensor)
    lens: Annotated[dict[str, Any], Given(LensSettings, but=("depth_range",))] = field(default_factory=dict)
    dump: Dump = field(default_factory=Dump)

    basic: ClassVar = (
        *("files", "distances", "output", "exposures", "reference", "window", "points", "picture", "fit_mask", "noise"),
        *("full_well", "read_noise", "focal_length", "f_number", "focus_distance", "pixel_pitch"),
    )
    notes: ClassVar = """\
The printed numbers show the accuracy of the bank. "noise" is the expected error, as the
sum of its moduli relative to the PSF's light. "residuals" of about 1 mean that the
pictures of one distance are consistent. Far larger ones mean that something moved or
that --full-well, --read-noise or the black level are wrong. Most of the error of a
sharp PSF is noise in its dark surroundings: one more exposure, four times as long,
lowers it as much as twice the number of positions. Without --reference each PSF is
centred at its centroid, and shifts by the masks are not measured.

In Python:
  bank = PSFBank.load("bank.safetensors")
  coded = TiDyOptics(camera=..., sensor=...).with_bank(bank)(image, depth)
  sharp = Tikhonov()(capture, bank)  # of linear light
  MeasuredPSFs.load("bank.safetensors").uncertainty  # and .distances, .reports of every picture
"""
    examples: ClassVar = """\
  Three distances, 8 places of the point at each:
    kornia-tidy raw calibrate-psf d1_*.dng d2_*.dng d3_*.dng \\
        --distances 0.35 0.6 1.5 --noise iso800.json -o bank.safetensors

  Two exposures at each position; the same positions with a flat modulator, which give
  the position of the chief ray; and retrieval of the mask behind these PSFs:
    kornia-tidy raw calibrate-psf p*.tif --distances 0.35 0.6 1.5 --exposures 0.01 0.08 \\
        --full-well 10500 --read-noise 2.4 --reference flat*.tif -o bank.safetensors \\
        --picture bank.png --fit-mask mask.npy
"""

    def run(self) -> None:
        """Measure the PSFs and write the bank."""
        places = self._check()
        import torch

        from kornia_tidy.calibration.psf.measured_psfs import measure_psfs
        from kornia_tidy.commands.report import Stages, tell
        from kornia_tidy.files import replacing
        from kornia_tidy.optics.thin_lens import ThinLensCamera

        lens = LensSettings(**self.lens).camera()
        depths = (0.99 * min(self.distances), 1.01 * max(self.distances))
        focus = float(lens.focus_distance)
        camera = ThinLensCamera(lens.focal_length, lens.aperture_diameter, focus, lens.pixel_pitch, depths)
        stages = Stages()
        with stages("measure"):
            images = self._images(places)
            channels = 1 + max(next(iter(images.values()))[0].channels)
            measured = measure_psfs(images, camera, self.window, _cutoff(camera, channels), self.diameter)
        tell("camera", camera.extra_repr())
        for report in measured.reports:
            if report.rejected is not None:
                where = f"row {report.row:.1f}, column {report.column:.1f}"
                tell("left out", f"the point at {report.distance:g} m, {where}: {report.rejected}")
        noise = (2 / torch.pi) ** 0.5 * measured.uncertainty.sum((2, 3))
        for distance, psi, own in zip(measured.distances, measured.bank.defocus, noise, strict=True):
            used = [r for r in measured.reports if r.distance == float(distance) and r.rejected is None]
            times = (sum(r.misfit or 0.0 for r in used) / len(used)) ** 0.5
            words = " ".join(f"{100 * float(x):.2g}" for x in own)
            where = f"{float(distance):g} m, psi {float(psi):+.2f} rad"
            tell(
                "PSF",
                f"{where}: {len(used)} point images, residuals {times:.2g} times the noise, noise {words} % in L1",
            )
            worst = float(own.max())
            if worst > GOOD_NOISE:
                more = math.ceil(len(used) * (worst / GOOD_NOISE) ** 2)
                tell(
                    "", f"about {more} point images, or one more and far longer exposure, bring it to {GOOD_NOISE:.0%}"
                )
        measured.save(self.output)
        tell(
            "wrote", f"{self.output}, PSFs sum to one: light outside their {self.window} x {self.window} px is not seen"
        )
        fit = None
        if self.fit_mask is not None:
            from kornia_tidy.calibration.psf.phase_retrieval import retrieve_mask
            from kornia_tidy.mask_export.mask_files import write_heights

            with stages("mask"):
                fit = retrieve_mask(measured.bank, camera, _spectrum(channels), self.mask_size)
            for distance, left in zip(measured.distances, fit.residual, strict=True):
                words = " ".join(f"{100 * float(x):.2g}" for x in left)
                tell("mask", f"{float(distance):g} m: leaves {words} % in L1")
            write_heights(self.fit_mask, fit.lens.masks.heights().detach())
            tell("wrote", self.fit_mask)
        if self.picture is not None:
            from kornia_tidy.figures.measured_psfs import draw_measured

            with replacing(self.picture) as temporary:
                draw_measured(measured, fit).savefig(temporary, dpi=150, format="png")
            tell("wrote", self.picture)
        tell("time", stages.summary())

    def _check(self) -> int:
        """Check the settings before any work; return the number of point positions at each distance."""
        from kornia_tidy.checks import check_choice
        from kornia_tidy.files import check_file

        for path, suffix in ((self.output, ".safetensors"), (self.picture, ".png"), (self.fit_mask, ".npy")):
            if path is not None:
                check_choice("the suffix of what to write", Path(path).suffix.lower(), (suffix,))
        inputs = [*self.files, *self.reference]
        check_outputs([self.output, self.picture, self.fit_mask], inputs)
        if len(set(self.distances)) != len(self.distances) or not min(self.distances) > 0:
            raise ValueError(f"--distances must be different metres above zero, got {self.distances}")
        groups = len(self.distances) * len(self.exposures)
        if len(self.files) % groups:
            raise ValueError(
                f"{len(self.files)} files do not divide into {len(self.distances)} distances with "
                f"{len(self.exposures)} exposures at each place"
            )
        places = len(self.files) // groups
        for path in inputs:
            check_file(path)
        if self.fit_mask is not None and len(self.distances) < 2:
            raise ValueError("--fit-mask needs two distances or more: one does not tell a mask from its twin")
        if self.reference and len(self.reference) != places * len(self.distances):
            raise ValueError(
                f"--reference needs one file for each of {places * len(self.distances)} places, got "
                f"{len(self.reference)}"
            )
        return places

    def _images(self, places: int) -> dict[float, list[Any]]:
        """Read the pictures of one position after another, and keep only crops around the points."""
        import torch

        from kornia_tidy.calibration.psf.point_images import point_images

        sensor, calibration = self._sensor()
        exposures = torch.tensor(self.exposures)
        files = iter(self.files)
        references = iter(self.reference)
        images: dict[float, list[Any]] = {}
        for distance in self.distances:
            images[distance] = []
            for _ in range(places):
                frames, tiles = zip(*[self._read(next(files), calibration) for _ in self.exposures], strict=True)
                if len({frame.shape for frame in frames}) > 1:
                    raise ValueError(f"the exposures of one place differ in size: {[tuple(f.shape) for f in frames]}")
                reference = self._read(next(references))[0] if self.reference else None
                images[distance] += point_images(
                    torch.stack(frames), exposures, sensor, self.window, self.points, reference, tiles[0]
                )
        return images

    def _sensor(self) -> tuple[SensorNoise, PhotonTransfer | None]:
        """Return the noise of the settings, and its calibration if it was measured."""
        from kornia_tidy.sensor.noise import SensorNoise

        full_well, read = self.sensor.full_well, self.sensor.read_noise
        if self.sensor.noise is None:
            if full_well is None or read is None:
                raise ValueError("the noise of the sensor is needed: --noise, or --full-well and --read-noise")
            return SensorNoise.physical(full_well, read), None
        if full_well is not None or read is not None:
            raise ValueError("--noise says full well and read noise: leave out --full-well and --read-noise")
        sensor, calibration = read_noise(self.sensor.noise)
        assert sensor is not None
        return sensor, calibration

    def _read(self, path: str, calibration: PhotonTransfer | None = None) -> tuple[Tensor, Tile | None]:
        """Read linear light (C, H, W) or, for a mosaic, the planes of its tile with their channels."""
        from kornia_tidy.data.image_files import SUFFIXES, read_image

        if Path(path).suffix.lower() in SUFFIXES:
            return read_image(path), None
        raw = self.dump.open(path)
        if calibration is not None:
            calibration.check_taken_alike(raw, path)
        rows, columns = raw.tile
        if (rows, columns) not in {(1, 1), (2, 2)}:
            raise ValueError(f"cannot measure PSFs on {path}: its tile is {rows}x{columns}, 2x2 or none is needed")
        if raw.pattern is None:
            return raw.planes(), None
        letters = "".join(dict.fromkeys(raw.colors))  # both greens are one channel
        return raw.planes(), tuple(tuple(letters.index(raw.colors[color]) for color in row) for row in raw.pattern)


def _cutoff(camera: ThinLensCamera, channels: int) -> list[float]:
    """Return the cutoff frequency of the lens at the shortest wavelength of the channels."""
    from kornia_tidy.calibration.psf.measured_psfs import diffraction_cutoff

    shortest = {3: (570e-9, 480e-9, 400e-9)}.get(channels, (400e-9,) * channels)
    return [min(2.0, diffraction_cutoff(camera, wave)) for wave in shortest]


def _spectrum(channels: int) -> Any:
    from kornia_tidy.optics.spectrum import Spectrum

    if channels not in {1, 3}:
        raise ValueError(f"--fit-mask needs PSFs of 1 or 3 channels, these have {channels}")
    return Spectrum.monochrome() if channels == 1 else Spectrum.rgb()
