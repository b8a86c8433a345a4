"""`kornia-tidy raw reconstruct`: reconstruction of all-in-focus images and depth from captures of any size."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from kornia_tidy.choices import ORIENTATIONS, PRETRAINED
from kornia_tidy.cli.commands.raw_develop import SUFFIXES, Format, output_paths
from kornia_tidy.cli.commands.raw_options import Dump, RawFiles, WhiteBalance, white_balance
from kornia_tidy.cli.commands.shared import File, Folder, Noise, read_noise
from kornia_tidy.reconstruction.head_names import CLOSED_FORMS
from kornia_tidy.settings import Count, Metres, Pixels, Unit, one_of

if TYPE_CHECKING:
    from kornia_tidy.reconstruction.light_head import LightHead
    from kornia_tidy.reconstruction.trained import TrainedSystem
    from kornia_tidy.sensor.noise import SensorNoise


@dataclass(frozen=True, kw_only=True)
class ReconstructRaw:
    """All-in-focus pictures and depth of captures.

    By a trained network, or by the closed form of a camera that was measured, tile by tile
    within a memory budget and without visible seams.
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
        head: a shipped system, or a checkpoint of a training (best.safetensors), or, with PSFs, a closed form. None:
            with PSFs wiener-bilateral.
        psfs: the camera whose PSFs kornia-tidy raw calibrate-psf measured, by which captures are deconvolved. None:
            those of the network's camera.
        noise: standard deviation of the read noise in linear light, of full scale; or the file that kornia-tidy raw
            calibrate-noise wrote. None: by the noise profile of the raw file, else that of the network's simulated
            sensor.
        resume: skip files whose results are there and still right.
        format: of the 16-bit picture.
        depth_unit: of FILE_depth.png.
        linear: FILES that are pictures hold linear light, not sRGB.
        white_balance: as-shot, daylight, auto (what is bright is grey on average), none, or a factor for each colour.
            None: as shot, else daylight, else none.
        jobs: files at a time.
        memory: for the network's tiles, of all jobs.
        overlap: of a tile that is discarded at each cut; with 144 shipped networks are within 0.0002 of the result for
            the whole picture; 1000 or all else that is farther than a network sees is exact.
        orientations: of its input over which a network that begins with the closed form is averaged: with 8 the images
            of edof systems are about 0.1 dB better, the depth of joint-uncertain 2 % less wrong, in 6 to 7 times the
            time.
        device: where the network runs, such as cuda.
        dump: what a headerless file holds.
    """

    files: RawFiles
    output: Folder
    head: Annotated[str, one_of((*PRETRAINED, *CLOSED_FORMS), others=True)] | None = None
    psfs: File | None = None
    noise: Noise | None = None
    resume: bool = False
    format: Format = "png"
    depth_unit: Metres = 1e-3
    linear: bool = False
    white_balance: WhiteBalance = ()
    jobs: Count = 1
    memory: Annotated[int, Unit("MIB", "MiB", 1)] = 512
    overlap: Pixels = 144
    orientations: Annotated[int, one_of(ORIENTATIONS)] = 1
    device: Annotated[str, Unit("DEVICE")] = "cpu"
    dump: Dump = field(default_factory=Dump)

    basic: ClassVar = (
        *("files", "output", "head", "psfs", "noise", "resume", "format", "depth_unit", "linear", "white_balance"),
        *("jobs", "memory", "orientations", "device"),
    )
    notes: ClassVar = """\
A network fits the camera that it was trained with, so HEAD must be trained with the
masks and lens of the captures. The library includes, for a 50 mm lens and pixels of 8 um
  edof-5, edof-1, edof-0      picture: five masks, one, a Fresnel element; f/17.6, at 0.6 m
  edof-designed               picture: five masks; f/22, at 1.98 m
  edof-flat                   picture: no masks; f/48, at 0.74 m
  joint-uncertain             picture, depth and its uncertainty: five masks; f/28.5, at 0.6 m
  joint-5, joint-1, joint-0   picture and depth, by small networks; f/17.6, at 0.6 m
A network that begins with the closed form, and the closed form itself, take the noise of
each pixel: as --noise says, or of raw files with a noise profile (DNG) from it.

Processing of a raw file: black and white levels, white balance, demosaicing, conversion
to linear sRGB clipped to [0, 1], on the pixel grid of the sensor with square pixels,
since the PSFs are defined there. Then the encoding of the network's training is applied
(sRGB unless --color-space was linear or paper). The results are turned upright.

Memory: --memory for the tiles, about 40 bytes a pixel of each file at work, and 0.4 GiB
for the program; in all 1.8 GiB for a file of 24 megapixels.
"""
    examples: ClassVar = """\
  All files of a folder; if interrupted, go on with --resume:
    kornia-tidy raw reconstruct shots/*.dng --head edof-5 -o sharp --resume

  A better picture, in seven times the time:
    kornia-tidy raw reconstruct shots/*.dng --head edof-5 -o best --orientations 8

  A camera that was measured, without a network:
    kornia-tidy raw reconstruct shots/*.dng --psfs bank.safetensors --noise iso800.json -o sharp

  A network of one's own; of two files, one is read and written while the other is computed:
    kornia-tidy raw reconstruct shots/*.dng --head run/best.safetensors -o depths --jobs 2
"""

    def run(self) -> None:
        """Reconstruct captures."""
        import torch

        from kornia_tidy.cli.commands.file_jobs import Row, table, work_on_all
        from kornia_tidy.cli.commands.report import tell
        from kornia_tidy.cli.commands.system_options import load_system
        from kornia_tidy.figures.reconstruction_files import reconstruction_suffixes
        from kornia_tidy.figures.style import require_matplotlib
        from kornia_tidy.files import remove_leftovers
        from kornia_tidy.lab.measured import takes_psfs
        from kornia_tidy.reconstruction.head import takes_noise
        from kornia_tidy.reconstruction.light_head import LightHead, reconstruct_light

        white_balance(self.white_balance)  # refuses what is none
        if self.noise == 0:
            raise ValueError("noise must be positive and finite in units of full scale, got 0.0")
        sensor, _ = read_noise(self.noise)
        system = load_system(self.head, self.psfs, sensor)
        if self.noise is not None and not takes_noise(system.head):
            raise ValueError(f"--noise is for a network that takes it, and that of {self.head} does not")
        if self.psfs is not None and not takes_psfs(system.head):
            raise ValueError(f"--psfs is for a network that deconvolves captures, and that of {self.head} does not")
        head = LightHead(system, orientations=self.orientations).to(torch.device(self.device))
        suffixes = reconstruction_suffixes(system.settings.task, SUFFIXES[self.format], uncertain=head.uncertain)
        if "_depth_colors.png" in suffixes:
            require_matplotlib()
        folder = Path(self.output)
        outputs = output_paths(self.files, folder, [*suffixes, ".json"])  # which is written last
        made_by = self._made_by()
        folder.mkdir(parents=True, exist_ok=True)
        if self.resume:
            remove_leftovers(folder)
        reconstruct_light(head, torch.zeros(3, 1, 1))  # measures the network's memory once for all jobs
        name = self.head or self.psfs
        tell("network", f"{name}: {system.settings.task}, {system.settings.head!r}, {system.step} steps")

        def work(path: str, progress: Callable[[int, int], None]) -> Row:
            start = time.perf_counter()
            said = json.loads(json.dumps({"source": _identity(path), "made_by": made_by}))
            paths = outputs[path]
            if self.resume and is_finished(paths, said):
                return Row(path, "kept")
            options = {"memory_budget": (self.memory << 20) // self.jobs, "overlap": self.overlap, "progress": progress}
            size = self._reconstruct(path, paths, said, head, system, options)
            return Row(path, "done", f"{size[0]} x {size[1]}", time.perf_counter() - start)

        rows = work_on_all("reconstruct", list(outputs), work, self.jobs)
        failed = sum(row.result not in {"done", "kept"} for row in rows)
        for line in table(rows):
            print(line)
        tell("files", f"{len(rows) - failed} of {len(rows)} in {folder}")
        if failed:
            raise ValueError(f"{failed} of {len(rows)} files failed")

    def _reconstruct(
        self, path: str, paths: list[Path], said: dict[str, Any], head: LightHead, system: TrainedSystem, options: dict
    ) -> tuple[int, int]:
        """Reconstruct a file, write its results and last their record; return columns and rows."""
        import torch

        from kornia_tidy.cli.commands.system_options import CLOSED_FORM
        from kornia_tidy.figures.reconstruction_files import reconstruction_in_words, write_reconstruction
        from kornia_tidy.files import write_bytes
        from kornia_tidy.lab.capture_file import PICTURES, read_light
        from kornia_tidy.reconstruction.light_head import reconstruct_light, with_noise_of

        sensor, calibration = read_noise(self.noise)
        balance = white_balance(self.white_balance)
        is_picture = self.dump.size is None and Path(path).suffix.lower() in PICTURES
        raw = None if is_picture else self.dump.open(path)
        capture = read_light(
            path, raw=raw, linear=self.linear, white_balance=balance, sensor=sensor, calibration=calibration
        )
        del raw  # its counts take memory
        if self.psfs is not None:
            _check_measured(path, len(capture.light), capture.noise, system)
        own = with_noise_of(head, capture.noise)  # no other thread's
        result, capture = reconstruct_light(own, capture.light, **options), capture._replace(light=torch.empty(0))
        size = write_reconstruction(paths[:-1], result, capture, head, self.depth_unit)
        words = {"head": self.head or CLOSED_FORM, **reconstruction_in_words(head, self.depth_unit)}
        words |= {"psfs": f"measured: {self.psfs}"} if self.psfs is not None else {}
        words |= {"noise": capture.noise.extra_repr()} if capture.noise is not None else {}
        write_bytes(paths[-1], (json.dumps({**said, "size": size, **words}, indent=1) + "\n").encode())
        return size

    def _made_by(self) -> dict[str, Any]:
        """Return what results depend on beside their file, to recognise them on resuming."""
        from kornia_tidy.cli.commands.system_options import digests

        return {
            "system": digests(self.head, self.psfs, self.noise),
            "depth_unit": self.depth_unit,
            "linear": self.linear,
            "overlap": self.overlap,
            "orientations": self.orientations,
            "white_balance": self.white_balance or None,
            "dump": {name: value or None for name, value in vars(self.dump).items()},
        }


def is_finished(paths: list[Path], said: dict[str, Any]) -> bool:
    """Return whether all results of a file exist, made with the same settings."""
    from kornia_tidy.files import parse_json

    if not all(path.is_file() for path in paths):
        return False
    try:
        record = parse_json(paths[-1].read_bytes())
    except ValueError:
        return False
    return isinstance(record, dict) and all(record.get(name) == value for name, value in said.items())


def _identity(path: str) -> dict[str, Any]:
    """Return the identity of an input file, to recognise it on resuming."""
    if not Path(path).is_file():
        raise FileNotFoundError(f"cannot read {path}: there is no such file")
    state = Path(path).stat()
    return {"file": Path(path).name, "bytes": state.st_size, "modified": state.st_mtime_ns}


def _check_measured(path: str, colors: int, noise: SensorNoise | None, system: TrainedSystem) -> None:
    """Raise ``ValueError`` if a capture has other colours than the measured PSFs, or a closed form lacks its noise."""
    measured = system.optics.psf_model.measured
    assert measured is not None
    if colors != (channels := measured.psfs.shape[1]):
        raise ValueError(f"the PSFs were measured in {channels} colours, and {path} has {colors}")
    if noise is None and not system.step:
        raise ValueError(f"the noise of {path} is not known: give --noise")
