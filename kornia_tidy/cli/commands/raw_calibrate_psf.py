"""`kornia-tidy raw calibrate-psf`: measurement of PSFs from pictures of a point of light at known distances."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, cast

from kornia_tidy.cli.commands.parser import Given
from kornia_tidy.cli.commands.raw_options import Dump, RawFiles
from kornia_tidy.cli.commands.shared import File, SensorInElectrons, Window, check_once, check_outputs, picture_beside
from kornia_tidy.reconstruction.settings import LensSettings
from kornia_tidy.settings import Count, Metres, Seconds, Unit

if TYPE_CHECKING:
    from kornia_tidy.lab.calibration.noise.photon_transfer import PhotonTransfer
    from kornia_tidy.lab.calibration.psf.point_files import Picture
    from kornia_tidy.psf.psf_bank import PSFBank


@dataclass(frozen=True, kw_only=True)
class CalibratePsf:
    r"""Make a PSF bank from pictures of a point.

    The pictures show a point of light at known distances. At each distance the point is
    moved by some pixels and fractions of a pixel between the pictures: an undersampled PSF
    can only be reconstructed from several of them, and dust on the sensor stays where it
    is. 16 positions are good, 24 behind a filter array; they need not be known. Several
    exposures at each position, the longer ones saturated, measure the faint parts of a PSF
    as well. FILES are raw files or 16-bit images of linear light without black level,
    sorted by distance, then by position of the point, then by exposure. The planes of one
    colour of a filter array give one PSF on the pixel grid of the sensor, so that the bank
    has red, green and blue.

    Args:
        files: raw files, or 16-bit images of linear light.
        distances: of the point.
        output: bank to write, .safetensors.
        exposures: at each place.
        reference: the same places with a flat mask, unsaturated. None: PSFs are centred at their centroids.
        window: side of the PSFs in pixels of the sensor.
        points: points in each picture.
        picture: of PSFs, uncertainties and residuals. None: OUT.png, if matplotlib is installed.
        fit_mask: find the mask behind the PSFs and write its heights in metres. None: it is not searched for.
        mask_size: pixels along a side of the mask that is fitted.
        diameter: of the point of light.
        sensor: its noise.
        lens: of the camera; its depths are the distances.
        dump: layout of a headerless file.

    Notes:
        The printed numbers show the accuracy of the bank. "noise" is the expected error, as the
        sum of its moduli relative to the PSF's light. "residuals" of about 1 mean that the
        pictures of one distance are consistent. Far larger ones mean that something moved or
        that --full-well, --read-noise or the black level are wrong. Most of the error of a
        sharp PSF is noise in its dark surroundings: one more exposure, four times as long,
        lowers it as much as twice the number of positions. Without --reference each PSF is
        centred at its centroid, and shifts by the masks are not measured.

        In Python:
          from kornia_tidy.lab.calibration.psf.measured_psfs import MeasuredPSFs
          from kornia_tidy.reconstruction import Tikhonov
          measured = MeasuredPSFs.load("bank.safetensors")  # .bank, .uncertainty, .distances, .reports
          sharp = Tikhonov()(capture, measured.bank)        # on linear light

    Examples:
        Three distances, 8 places of the point at each:
          kornia-tidy raw calibrate-psf d1_*.dng d2_*.dng d3_*.dng \
              --distances 0.35 0.6 1.5 --noise iso800.json -o bank.safetensors

        Two exposures at each position; the same positions with a flat modulator, which give
        the position of the chief ray; and retrieval of the mask behind these PSFs:
          kornia-tidy raw calibrate-psf p*.tif --distances 0.35 0.6 1.5 --exposures 0.01 0.08 \
              --full-well 10500 --read-noise 2.4 --reference flat*.tif -o bank.safetensors \
              --fit-mask mask.npy
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
    sensor: SensorInElectrons = field(default_factory=SensorInElectrons)
    lens: Annotated[dict[str, Any], Given(LensSettings, but=("depth_range",))] = field(default_factory=dict)
    dump: Dump = field(default_factory=Dump)

    basic: ClassVar = (
        *("files", "distances", "output", "exposures", "reference", "window", "points", "picture", "fit_mask", "noise"),
        *("full_well", "read_noise", "focal_length", "f_number", "focus_distance", "pixel_pitch"),
    )

    def run(self) -> None:
        """Measure the PSFs and write the bank."""
        self._check()
        from kornia_tidy.cli.commands.report import tell
        from kornia_tidy.lab.calibration.psf.measured_psfs import channel_cutoffs, measure_psfs
        from kornia_tidy.lab.calibration.psf.point_files import images_of_files

        depths = (0.99 * min(self.distances), 1.01 * max(self.distances))
        camera = LensSettings(**self.lens).camera().changed(depth_range=depths)
        sensor, calibration = self.sensor.noise_of()
        images = images_of_files(
            partial(self._read, calibration=calibration),
            self.files,
            self.distances,
            self.exposures,
            sensor,
            window=self.window,
            points=self.points,
            references=self.reference,
        )
        channels = 1 + max(next(iter(images.values()))[0].channels)
        measured = measure_psfs(images, camera, self.window, channel_cutoffs(camera, channels), self.diameter)
        tell("camera", camera.extra_repr())
        for topic, text in measured.in_words():
            tell(topic, text)
        measured.save(self.output)
        tell(
            "wrote", f"{self.output}, PSFs sum to one: light outside their {self.window} x {self.window} px is not seen"
        )
        fit = None
        if self.fit_mask is not None:
            from kornia_tidy.lab.calibration.psf.phase_retrieval import retrieve_mask, spectrum_of
            from kornia_tidy.lab.mask_export.mask_files import write_heights

            bank = cast("PSFBank", measured.bank)  # of one place
            fit = retrieve_mask(bank, camera, spectrum_of(channels), self.mask_size)
            for distance, left in zip(measured.distances, fit.residual, strict=True):
                words = " ".join(f"{100 * float(x):.2g}" for x in left)
                tell("mask", f"{float(distance):g} m: leaves {words} % in L1")
            write_heights(self.fit_mask, fit.lens.masks.heights().detach())
            tell("wrote", self.fit_mask)
        if (picture := picture_beside(self.picture, self.output)) is not None:
            from kornia_tidy.figures.measured_psfs import draw_measured
            from kornia_tidy.figures.style import save_figure

            save_figure(picture, draw_measured(measured, fit))
            tell("wrote", str(picture))

    def _check(self) -> None:
        """Check the settings before any work."""
        from kornia_tidy.checks import check_choice
        from kornia_tidy.files import check_file

        picture = picture_beside(self.picture, self.output)
        for path, suffix in ((self.output, ".safetensors"), (picture, ".png"), (self.fit_mask, ".npy")):
            if path is not None:
                check_choice("the suffix of what to write", Path(path).suffix.lower(), (suffix,))
        inputs = [*self.files, *self.reference]
        check_outputs([self.output, picture, self.fit_mask], inputs)
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
        check_once(inputs)

    def _read(self, path: str, calibration: PhotonTransfer | None) -> Picture:
        """Read linear light (C, H, W) or, for a mosaic, the planes of its tile with their channels."""
        from kornia_tidy.data.image_files import SUFFIXES, read_linear
        from kornia_tidy.lab.calibration.psf.point_files import planes_of_tile

        if Path(path).suffix.lower() in SUFFIXES:
            return read_linear(path), None
        raw = self.dump.open(path)
        if calibration is not None:
            calibration.check_taken_alike(raw, path)
        return planes_of_tile(raw, path)
