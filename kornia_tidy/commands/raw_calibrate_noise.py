"""`kornia-tidy raw calibrate-noise`: a camera's gain and read noise from its raw files."""

from __future__ import annotations

import argparse
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kornia_tidy.commands.raw_options import add_dump_options, check_outputs, open_raw
from kornia_tidy.commands.report import Stages, tell

if TYPE_CHECKING:
    from kornia_tidy.calibration.noise.photon_transfer import PhotonTransfer

DESCRIPTION = """\
Measure a camera's noise at one ISO setting by photon transfer: a fit of the variance
of the counts over their level gives the electrons per count (gain) and the noise
without light (read noise). FILES are
  flats     two or more captures of each exposure, in any order, of a static scene:
            best an evenly lit sheet out of focus, from dark to nearly saturated.
            Differences of captures are measured, so that scene and fixed pattern
            cancel
  one file  any scene with smooth areas of different brightness. Noise is separated
            from texture block by block; the printed error shows how reliably
Pictures that do not allow a calibration are refused with the reason.
"""

EXAMPLES = """\
examples:
  Pairs of flats at ISO 800, with two captures under the lens cap:
    kornia-tidy raw calibrate-noise flats/*.dng --dark cap1.dng cap2.dng -o iso800.json --plot

  From a single picture:
    kornia-tidy raw calibrate-noise street.cr2 -o noise.json

In Python:
  from kornia_tidy.calibration.noise.photon_transfer import read_json
  sensor = read_json("iso800.json").sensor_noise()      # for TiDyOptics(sensor=...)
"""

STRAIGHT = 0.99  # R² above which the curve is reported as a straight line
DOTS_PER_INCH = 150


def add_parser(subparsers: Any) -> None:
    """Describe the subcommand to argparse."""
    parser = subparsers.add_parser(
        "calibrate-noise",
        help="measure gain and read noise",
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    parser.add_argument("files", nargs="+", metavar="FILES", help="camera raw files of one camera and ISO")
    parser.add_argument(
        "--dark", nargs="+", default=[], metavar="FILES", help="captures without light: black is measured in them"
    )
    parser.add_argument("-o", "--output", required=True, metavar="OUT.json", help="where the calibration goes")
    parser.add_argument(
        "--plot",
        nargs="?",
        const="",
        metavar="OUT.png",
        help="draw the photon-transfer curve (default: OUT.png beside OUT.json)",
    )
    add_dump_options(parser)


def run(args: argparse.Namespace) -> None:
    """Calibrate, write the results, and print a summary."""
    output = Path(args.output)
    plot = None if args.plot is None else Path(args.plot or output.with_suffix(".png"))
    _check_outputs(output, plot, [*args.files, *args.dark])
    from kornia_tidy.calibration.noise.photon_transfer import photon_transfer, write_json  # noqa: PLC0415

    stages = Stages()
    with stages("read"):
        captures, darks = ([open_raw(path, args) for path in paths] for paths in (args.files, args.dark))
    with stages("measure"):
        result = photon_transfer(captures, darks)
    with stages("write"):
        write_json(output, result)
        if plot is not None:
            _draw(result, plot)
    for topic, text in in_words(result):
        tell(topic, text)
    tell("wrote", f"{output}" + (f" and {plot}" if plot else ""))
    tell("time", stages.summary())


def in_words(result: PhotonTransfer) -> list[tuple[str, str]]:
    """Return the results of a calibration as topics and texts."""
    line = result.line
    iso = "" if result.iso is None else f", ISO {result.iso:g}"
    single = result.method == "single"
    limit = "" if result.read_noise_resolved else " (no more than a guess: rounding to counts may hide it)"
    topics = [
        ("camera", (result.camera or "unknown") + iso),
        ("levels", f"black {result.black:g}, white {result.white:g}"),
        ("gain", f"{line.gain:.4g} ± {line.gain_error:.2g} electrons a count"),
        ("read", f"{line.read_noise:.4g} ± {line.read_noise_error:.2g} electrons{limit}"),
        ("white", f"stands for {result.full_well:.4g} electrons"),
    ]
    if single:
        pattern = f"{line.fixed_pattern:.2%} of the level" if line.fixed_pattern else "not seen"
        topics.append(("pattern", f"{pattern}; fixed pattern and fine texture cannot be told apart in one picture"))
    for name, own in result.channels.items():
        topics.append(
            (f"  {name}", f"gain {own.gain:.4g}, read noise {own.read_noise:.3g} electrons, R² {own.r_squared:.4f}")
        )
    straight = "a straight line" if line.r_squared >= STRAIGHT else f"below {STRAIGHT}: not quite a straight line"
    topics.append(("R²", f"{line.r_squared:.4f} over {len(result.points)} points, {straight}"))
    return topics


def _draw(result: PhotonTransfer, path: Path) -> None:
    from kornia_tidy.figures.transfer import draw_transfer  # noqa: PLC0415
    from kornia_tidy.files import write_bytes  # noqa: PLC0415

    picture = BytesIO()
    draw_transfer(result).savefig(picture, dpi=DOTS_PER_INCH, format=path.suffix[1:])
    write_bytes(path, picture.getvalue())


def _check_outputs(output: Path, plot: Path | None, inputs: list[str]) -> None:
    """Check before any work that outputs can be written and do not replace captures."""
    if plot is not None:
        from kornia_tidy.checks import check_choice  # noqa: PLC0415
        from kornia_tidy.figures.style import require_matplotlib  # noqa: PLC0415

        require_matplotlib()
        check_choice("the suffix of a plot", plot.suffix.lower(), (".png", ".pdf", ".svg"))
    check_outputs([output, plot], inputs)
