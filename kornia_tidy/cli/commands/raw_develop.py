"""`kornia-tidy raw develop`: pictures from camera raw files."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from kornia_tidy.choices import DEMOSAIC, HIGHLIGHTS
from kornia_tidy.cli.commands.raw_options import Dump, RawFiles, WhiteBalance, white_balance
from kornia_tidy.cli.commands.shared import Folder
from kornia_tidy.settings import one_of

SUFFIXES = {"png": ".png", "tiff": ".tif"}
Format = Annotated[str, one_of(("png", "tiff"))]


@dataclass(frozen=True, kw_only=True)
class DevelopRaw:
    r"""Make pictures of raw files.

    Black and white levels, white balance, demosaicing, colour conversion to sRGB, upright
    orientation and square pixels. Nothing is brightened, sharpened or denoised. Each FILE
    becomes FOLDER/FILE.png, 16 bits, and a preview FOLDER/FILE.jpg. Files are written
    atomically. Exit status 2 if any file failed; the others are developed all the same.

    Args:
        files: camera raw files.
        output: where to; made if it is not there.
        format: of the 16-bit picture.
        no_preview: no JPEG beside it.
        resume: keep existing pictures, develop the others.
        demosaic: method. None: LibRaw's AHD for Bayer, Markesteijn's for X-Trans, else bilinear.
        white_balance: as-shot, daylight, auto (bright areas are grey on average), none, or a factor for each colour.
            None: as shot, else daylight, else none.
        highlights: clip all channels where the first saturates, or keep what others saw above.
        linear: linear light in the 16-bit picture, not encoded as sRGB.
        sensor_grid: pixels as on the sensor: neither turned nor stretched.
        dump: layout of a headerless file.

    Notes:
        The first example in Python:
          from kornia_tidy.data.image_files import write_image
          from kornia_tidy.lab.raw.capture import RawCapture
          from kornia_tidy.lab.raw.develop import develop
          write_image("pictures/shot.png", develop(RawCapture.open("shots/shot.dng")), bits=16)

    Examples:
        All files of a folder; if interrupted, go on with --resume:
          kornia-tidy raw develop shots/*.dng -o pictures

        For measurements: linear light on the pixel grid of the sensor, without interpolation:
          kornia-tidy raw develop shots/*.dng -o planes --demosaic half --linear --sensor-grid

        Files without a white balance, which look green or orange:
          kornia-tidy raw develop quicktake/*.qtk -o pictures --white-balance auto

        A headerless dump of counts, with factors for red, green and blue:
          kornia-tidy raw develop dump.raw --size 768x512 --pattern RGGB --black 600 --white 15520 \
              --white-balance 1.9 1 1.5 -o pictures
    """

    files: RawFiles
    output: Folder
    format: Format = "png"
    no_preview: bool = False
    resume: bool = False
    demosaic: Annotated[str, one_of(DEMOSAIC)] | None = None
    white_balance: WhiteBalance = ()
    highlights: Annotated[str, one_of(HIGHLIGHTS)] = "clip"
    linear: bool = False
    sensor_grid: bool = False
    dump: Dump = field(default_factory=Dump)

    def run(self) -> None:
        """Develop raw files."""
        import torch

        from kornia_tidy.cli.commands.report import tell
        from kornia_tidy.data.image_files import write_image
        from kornia_tidy.lab.file_jobs import for_each_file, output_paths
        from kornia_tidy.lab.raw.develop import develop, encode
        from kornia_tidy.lab.raw.properties import clipped_in_words, colors_in_words

        balance = white_balance(self.white_balance)
        folder = Path(self.output)
        suffixes = [SUFFIXES[self.format], *([] if self.no_preview else [".jpg"])]
        outputs = output_paths(self.files, folder, suffixes)
        folder.mkdir(parents=True, exist_ok=True)
        done = {"developed": 0, "kept": 0}

        def work(path: str) -> None:
            place = f"{list(outputs).index(path) + 1}/{len(outputs)}"
            paths = outputs[path]
            if self.resume and all(output.exists() for output in paths):
                done["kept"] += 1
                tell(place, f"{path}: kept {paths[0]}")
                return
            raw = self.dump.open(path)
            with torch.no_grad():
                image = develop(
                    raw,
                    self.demosaic,
                    white_balance=balance,
                    highlights=self.highlights,
                    encoded=False,
                    square_pixels=not self.sensor_grid,
                    upright=not self.sensor_grid,
                )
                clipped = clipped_in_words(image)
                encoded = encode(image.clamp_(0, 1))
            for output in reversed(paths):  # the preview is written first, so that a picture means that both exist
                if output.suffix == ".jpg":
                    write_image(output, encoded)
                else:
                    write_image(output, image if self.linear else encoded, bits=16)
            done["developed"] += 1
            tell(
                place,
                f"{path}: {image.shape[-1]} x {image.shape[-2]} px, {colors_in_words(raw, self.demosaic, balance)}",
            )
            tell("", f"{clipped}; wrote {paths[0]}")

        try:
            for_each_file(list(outputs), work)
        finally:
            missing = len(outputs) - sum(done.values())
            tell("files", f"{done['developed']} developed, {done['kept']} kept, {missing} failed or left")
