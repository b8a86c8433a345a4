"""`kornia-tidy raw reconstruct`: reconstruction of all-in-focus images and depth from captures of any size."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from kornia_tidy.choices import ORIENTATIONS, PRETRAINED
from kornia_tidy.cli.commands.lens_option import RealLens, camera_and_lens
from kornia_tidy.cli.commands.raw_develop import SUFFIXES, Format
from kornia_tidy.cli.commands.raw_options import Dump, RawFiles, WhiteBalance, white_balance
from kornia_tidy.cli.commands.shared import (
    File,
    Folder,
    Masks,
    Noise,
    masks_of,
    read_noise,
    refuse_with_psfs,
)
from kornia_tidy.reconstruction.head_names import ANY_CAMERA, CLOSED_FORMS
from kornia_tidy.reconstruction.settings import LensSettings
from kornia_tidy.settings import Metres, Pixels, Unit, one_of

if TYPE_CHECKING:
    from kornia_tidy.camera.tidy_optics import TiDyOptics
    from kornia_tidy.lab.capture_file import CaptureLight
    from kornia_tidy.sensor.sensor import SensorNoise


@dataclass(frozen=True, kw_only=True)
class ReconstructRaw:
    r"""Restore captures: pictures that are sharp everywhere, and depth.

    A trained network restores them, or a closed form for a camera that was measured or is
    given by lens and masks: tile by tile, within a memory budget, without visible seams.
    FILES are camera raw files or pictures (PNG, TIFF, JPEG, NPY). For each FILE, FOLDER gets
      FILE.png, FILE.jpg      the picture all in focus, 16 bits, and to look at
      FILE_depth.png          depth, 16 bits, in multiples of --depth-unit
      FILE_depth.pfm, .npy    depth in metres, float32, infinity kept
      FILE_depth_colors.png   depth in colours, with a scale in metres
      FILE_deviation.png      uncertainty of the depth: its standard deviation, in multiples
      FILE_deviation.pfm      of --depth-unit or in metres; 65535 or infinity where nothing
      FILE_deviation.npy      bounds the distance: far away, or depth unknown
    as far as the network estimates them, and FILE.json with the settings, which is written
    last. Files are written atomically. A network that tells the uncertainty (trained with
    --depth-classes) also makes FILE_depth_colors.png grey where the depth is unknown, as on
    blank walls.

    Exit status 2 if any file failed; the others are reconstructed all the same.

    Args:
        files: camera raw files, or pictures.
        output: where to; made if it is not there.
        head: a shipped system, a checkpoint of a training (best.safetensors), or the file of a camera, such as
            camera.safetensors of kornia-tidy design, whose captures the network for any camera restores; or, with
            --psfs or --masks, a closed form. None: with these the network for any camera.
        psfs: file of kornia-tidy raw calibrate-psf; its PSFs deconvolve the captures. None:
            those of the network's camera.
        masks: of the camera: a file of heights, or the number of masks that raw simulate makes. None: those of head or
            psfs.
        lens: a real lens around the masks: its name, a file that Lens.save wrote, or its surfaces (.zmx, .seq, .json).
            Captures are whole pictures, as large as the first; each tile is restored by the PSFs of its place. None: an
            ideal lens.
        settings: of the camera with these masks.
        noise: standard deviation of the read noise in linear light, of full scale; or the file that kornia-tidy raw
            calibrate-noise wrote. None: by the noise profile of the raw file, else that of the network's simulated
            sensor.
        resume: skip files that already have complete results with the same settings.
        format: of the 16-bit picture.
        depth_unit: of FILE_depth.png.
        linear: FILES that are pictures hold linear light, not sRGB.
        white_balance: as-shot, daylight, auto (bright areas are grey on average), none, or a factor for each colour.
            None: as shot, else daylight, else none.
        memory: for the network's tiles.
        overlap: pixels discarded on each side of a cut between tiles; with 144, shipped networks are within 0.0002 of
            the result for the whole picture; beyond the reach of a network, as with 1000, the result is exact.
        orientations: of the input, for the average of a network that begins with the closed form: with 8, images of
            edof systems are about 0.1 dB better and the depth error of joint-uncertain is 2 % less, in 6 to 7 times
            the time.
        device: where the network runs, such as cuda.
        dump: layout of a headerless file.

    Notes:
        Without a network of your camera, give the camera: its file as HEAD, its measured PSFs, or
        its masks with its lens.
        One network, any-camera, restores the captures of any camera that you give it. All others fit
        the camera that they were trained with, its masks and its lens. The library includes, for a
        50 mm lens and pixels of 8 um
          edof-5                      picture: five masks; f/17.6, at 0.6 m
          edof-designed               picture: five masks; f/22, at 1.98 m
          edof-flat                   picture: no masks; f/48, at 0.74 m
          joint-uncertain             picture, depth and its uncertainty: five masks; f/28.5, at 0.6 m
        A network that begins with the closed form, and the closed form itself, take the noise of
        each pixel: as --noise says, or of raw files with a noise profile (DNG) from it.

        Processing of a raw file: black and white levels, white balance, demosaicing, conversion
        to linear sRGB clipped to [0, 1], on the pixel grid of the sensor with square pixels,
        since the PSFs are defined there. Then the encoding of the network's training is applied
        (sRGB unless --color-space was linear or paper). The results are turned upright.

        Memory: --memory for the tiles, about 40 bytes a pixel of each file at work, and 0.4 GiB
        for the program; in all 1.8 GiB for a file of 24 megapixels. Behind a real lens tiles have
        384 pixels along a side, whatever --memory and --overlap say.

    Examples:
        All files of a folder; if interrupted, go on with --resume:
          kornia-tidy raw reconstruct shots/*.dng --head edof-5 -o sharp --resume

        A better picture, in seven times the time:
          kornia-tidy raw reconstruct shots/*.dng --head edof-5 -o best --orientations 8

        A camera of your own design, and one that was measured, without training:
          kornia-tidy raw reconstruct shots/*.dng --head camera.safetensors -o sharp
          kornia-tidy raw reconstruct shots/*.dng --psfs bank.safetensors --noise iso800.json -o sharp

        The same camera by its masks and its real lens, whose PSFs vary over the picture:
          kornia-tidy raw reconstruct shots/*.dng --masks heights.npy --lens single-50mm \
              --f-number 12 --focus-distance 0.7 --noise iso800.json -o sharp

        A network of one's own:
          kornia-tidy raw reconstruct shots/*.dng --head run/best.safetensors -o depths
    """

    files: RawFiles
    output: Folder
    head: Annotated[str, one_of((*PRETRAINED, *CLOSED_FORMS), others=True)] | None = None
    psfs: File | None = None
    masks: Masks | None = None
    lens: RealLens | None = None
    settings: LensSettings = field(default_factory=LensSettings)
    noise: Noise | None = None
    resume: bool = False
    format: Format = "png"
    depth_unit: Metres = 1e-3
    linear: bool = False
    white_balance: WhiteBalance = ()
    memory: Annotated[int, Unit("MIB", "MiB", 1)] = 512
    overlap: Pixels = 144
    orientations: Annotated[int, one_of(ORIENTATIONS)] = 1
    device: Annotated[str, Unit("DEVICE")] = "cpu"
    dump: Dump = field(default_factory=Dump)

    basic: ClassVar = (
        *("files", "output", "head", "psfs", "masks", "lens", "noise", "resume", "format", "depth_unit", "linear"),
        *("white_balance", "memory", "orientations", "device"),
    )

    def run(self) -> None:
        """Reconstruct captures."""
        import torch

        from kornia_tidy.cli.commands.report import tell
        from kornia_tidy.figures.reconstruction_files import reconstruct_files
        from kornia_tidy.lab.file_jobs import table
        from kornia_tidy.lab.measured import check_capture, takes_psfs
        from kornia_tidy.lab.named_system import load_system
        from kornia_tidy.reconstruction.head import takes_noise
        from kornia_tidy.reconstruction.light_head import LightHead

        white_balance(self.white_balance)  # refuses other values
        if self.noise == 0:
            raise ValueError("noise must be positive and finite in units of full scale, got 0.0")
        sensor, _ = read_noise(self.noise)
        optics = self._optics(sensor)
        system = load_system(self.head, self.psfs, sensor, optics)
        if self.noise is not None and not takes_noise(system.head):
            raise ValueError(f"--noise is for a network that takes it, and that of {self.head} does not")
        if self.psfs is not None and not takes_psfs(system.head):
            raise ValueError(f"--psfs is for a network that deconvolves captures, and that of {self.head} does not")
        head = LightHead(system, orientations=self.orientations).to(torch.device(self.device))

        def read(path: str) -> CaptureLight:
            capture = self._read(path)
            if self.psfs is not None or optics is not None:
                check_capture(system, path, capture)
            return capture

        words: dict[str, Any] = {"head": self.head or ANY_CAMERA} | (
            {"psfs": f"measured: {self.psfs}"} if self.psfs else {}
        )
        settings = ("noise", "linear", "overlap", "orientations", "white_balance", "depth_unit")
        words["settings"] = {name: getattr(self, name) for name in settings} | {"dump": vars(self.dump)}
        words["settings"] |= {"camera": {name: str(value) for name, value in self._given().items()}}
        used = (self.head, self.psfs, self.noise, self.masks, self.lens)
        folder = Path(self.output)
        rows = reconstruct_files(
            self.files,
            folder,
            head,
            read,
            words=words,
            inputs=[each for each in used if isinstance(each, str) and Path(each).is_file()],
            resume=self.resume,
            picture=SUFFIXES[self.format],
            depth_unit=self.depth_unit,
            memory_budget=self.memory << 20,
            overlap=self.overlap,
        )
        kind = system.settings
        if optics is not None and optics.lens is not None:
            tell("lens", optics.lens.extra_repr())
        tell("network", f"{self.head or self.psfs or ANY_CAMERA}: {kind.task}, {kind.head!r}, {system.step} steps")
        failed = sum(row.result not in {"done", "kept"} for row in rows)
        for line in table(rows):
            print(line)
        for row in rows:
            for note in row.notes:
                tell("note", f"{row.file}: {note}")
        tell("files", f"{len(rows) - failed} of {len(rows)} in {folder}")
        if failed:
            raise ValueError(f"{failed} of {len(rows)} files failed")

    def _given(self) -> dict[str, Any]:
        """Return the options of a camera that were given, by name."""
        usual = LensSettings()
        given = {"masks": self.masks, "lens": self.lens}
        given |= {name: value for name, value in vars(self.settings).items() if value != getattr(usual, name)}
        return {name: value for name, value in given.items() if value is not None}

    def _optics(self, sensor: SensorNoise | None) -> TiDyOptics | None:
        """Return the camera of lens and masks, if it is given so.

        Raises:
            ValueError: if the head or the PSFs have a camera of their own, or there are no masks.
        """
        from kornia_tidy.camera.tidy_optics import TiDyOptics
        from kornia_tidy.sensor.sensor import SensorNoise

        if not (given := self._given()):
            return None
        option = f"--{next(iter(given)).replace('_', '-')}"
        if self.psfs is not None:
            refuse_with_psfs(given)
        if self.head is not None and self.head not in CLOSED_FORMS:
            raise ValueError(
                f"{self.head} has its own camera: leave out {option}, or take one of "
                f"{', '.join(map(repr, CLOSED_FORMS))} as --head"
            )
        if self.masks is None:
            raise ValueError(f"{option} is of a camera whose masks are needed too: give --masks")
        size = None if self.lens is None else self._size()
        camera, lens = camera_and_lens(self.lens, self.settings, size=size)
        return TiDyOptics(masks_of(self.masks), camera, sensor=sensor or SensorNoise(), lens=lens)

    def _size(self) -> tuple[int, int] | None:
        """Return rows and columns of the first capture that can be read, over which a lens is traced."""
        for path in self.files:
            with suppress(OSError, ValueError):
                light = self._read(path).light
                return light.shape[-2], light.shape[-1]
        return None

    def _read(self, path: str) -> CaptureLight:
        """Return the linear light of a capture."""
        from kornia_tidy.lab.capture_file import PICTURES, read_light

        sensor, calibration = read_noise(self.noise)
        is_picture = self.dump.size is None and Path(path).suffix.lower() in PICTURES
        return read_light(
            path,
            raw=None if is_picture else self.dump.open(path),
            linear=self.linear,
            white_balance=white_balance(self.white_balance),
            sensor=sensor,
            calibration=calibration,
        )
