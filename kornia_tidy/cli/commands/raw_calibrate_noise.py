"""`kornia-tidy raw calibrate-noise`: a camera's gain and read noise from its raw files."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from kornia_tidy.cli.commands.parser import Optional
from kornia_tidy.cli.commands.raw_options import Dump, RawFiles
from kornia_tidy.cli.commands.shared import File, check_once, check_outputs, picture_beside
from kornia_tidy.settings import Unit


@dataclass(frozen=True, kw_only=True)
class CalibrateNoise:
    """Measure gain and read noise.

    At one ISO setting, by photon transfer: a fit of the variance of the counts over their
    level gives the electrons per count (gain) and the noise without light (read noise).
    FILES are
      flats     two or more captures of each exposure, in any order, of a static scene:
                best an evenly lit sheet out of focus, from dark to nearly saturated.
                Differences of captures are measured, so that scene and fixed pattern
                cancel
      one file  any scene with smooth areas of different brightness. Noise is separated
                from texture block by block; the printed error shows how reliably
    Pictures that do not allow a calibration are refused with the reason.

    Args:
        files: camera raw files of one camera and ISO.
        output: where the calibration goes, OUT.json.
        dark: captures without light: black is measured in them. None: black as the files say.
        plot: picture of the photon-transfer curve. None: OUT.png, if matplotlib is installed.
        dump: layout of a headerless file.

    Notes:
        In Python:
          from kornia_tidy.lab.calibration.noise.photon_transfer import read_json
          sensor = read_json("iso800.json").sensor_noise()      # for TiDyOptics(sensor=...)

    Examples:
        Pairs of flats at ISO 800, with two captures under the lens cap:
          kornia-tidy raw calibrate-noise flats/*.dng --dark cap1.dng cap2.dng -o iso800.json

        From a single picture:
          kornia-tidy raw calibrate-noise street.cr2 -o noise.json
    """

    files: RawFiles
    output: Annotated[str, Unit("OUT.json")]
    dark: tuple[File, ...] = ()
    plot: Annotated[str, Optional("PNG")] | None = None
    dump: Dump = field(default_factory=Dump)

    def run(self) -> None:
        """Calibrate, write the results, and print a summary."""
        from kornia_tidy.checks import check_choice

        output = Path(self.output)
        plot = picture_beside(self.plot, self.output)
        if plot is not None:
            check_choice("the suffix of a plot", plot.suffix.lower(), (".png", ".pdf", ".svg"))
        check_once([*self.files, *self.dark])
        check_outputs([output, plot], [*self.files, *self.dark])
        from kornia_tidy.cli.commands.report import tell
        from kornia_tidy.figures.style import save_figure
        from kornia_tidy.figures.transfer import draw_transfer
        from kornia_tidy.lab.calibration.noise.photon_transfer import photon_transfer, write_json

        captures, darks = ([self.dump.open(path) for path in paths] for paths in (self.files, self.dark))
        result = photon_transfer(captures, darks)
        write_json(output, result)
        if plot is not None:
            save_figure(plot, draw_transfer(result))
        for topic, text in result.in_words():
            tell(topic, text)
        tell("wrote", f"{output}" + (f" and {plot}" if plot else ""))
