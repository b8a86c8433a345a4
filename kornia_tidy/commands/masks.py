"""`kornia-tidy masks`: export of masks to SLM frames, heights or STL, and import of frames."""

from __future__ import annotations

import argparse
import math
import re
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from kornia_tidy.checks import check_choice
from kornia_tidy.commands.report import tell
from kornia_tidy.inference.trained import camera_state
from kornia_tidy.mask_export.frame_files import SUFFIXES, check_replaceable, read_slm_frames, write_slm_frames
from kornia_tidy.mask_export.mask_files import SavedMasks, masks_in_state, read_heights, write_heights
from kornia_tidy.mask_export.placement import FLIPS, ROTATIONS, PanelPlacement
from kornia_tidy.mask_export.printing import write_stl
from kornia_tidy.mask_export.response_file import read_response
from kornia_tidy.mask_export.slm_frames import SLMFrames
from kornia_tidy.mask_export.timing import FrameTime, frame_times
from kornia_tidy.masks.base import metres_to_radians
from kornia_tidy.modulator.phase_panel import GreyLevels
from kornia_tidy.modulator.switching import Switching
from kornia_tidy.optics.materials import FUSED_SILICA, NOA61, PDMS, PMMA, constant_index
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH

MATERIALS = {
    "constant": constant_index(1.5),
    "fused-silica": FUSED_SILICA,
    "pmma": PMMA,
    "pdms": PDMS,
    "noa61": NOA61,
}

DESCRIPTION = """\
Export and import phase masks. MASKS is a file of heights in metres (.npy, K x rows x
columns), a camera's state_dict (.safetensors) or a checkpoint of a training. A
state_dict tells the masks' family, constraint and material, and the modulator, whose
grey levels, dwell and switching times are the defaults of frames. One of masks alone
(phase in radians at 530 nm) tells none of them.
"""

EXPORT = """\
Export masks in the format given by the name of OUT:
  a folder  one frame per mask for the panel of a phase modulator (PNG or TIFF),
            timing.csv, and frames.json with the settings needed to read them
            back; up to 8 bits in 8-bit files, 9 and 10 in the least
            significant bits of 16-bit files
  x.npy     heights in metres
  x.stl     one mask on a plate, in millimetres
Files are written atomically, and frames are read back and compared.
"""

EXPORT_EXAMPLES = """\
examples:
  Frames for a 1920 x 1200 panel, seen through a mirror:
    kornia-tidy masks export camera.safetensors -o slm --flip left-right

  A 10-bit panel with a measured response and swaps of 4 ms:
    kornia-tidy masks export heights.npy -o slm --bits 10 --response lut.csv \\
        --exposure 0.1 --switching-time 0.004 --wavelength 532e-9

  The second mask for a printer, over a pupil of 4 mm:
    kornia-tidy masks export heights.npy -o mask.stl --mask 1 --pupil-radius 2e-3
"""


def add_parser(subparsers: Any) -> None:
    """Describe the command to argparse."""
    masks = subparsers.add_parser(
        "masks",
        help="masks -> SLM frames, heights, STL; and back",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    actions = masks.add_subparsers(required=True, metavar="ACTION", title="actions")

    show = actions.add_parser("show", help="list the masks of a file", description="List the masks of a file.")
    _add_masks(show)
    show.set_defaults(run=show_masks)

    export = actions.add_parser(
        "export",
        help="write SLM frames, heights or STL",
        description=EXPORT,
        epilog=EXPORT_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    _add_masks(export)
    export.add_argument("-o", "--output", required=True, metavar="OUT", help="a folder, x.npy or x.stl")
    export.add_argument("--force", action="store_true", help="replace what was written before")
    export.add_argument(
        "--pupil-radius",
        type=float,
        metavar="M",
        help="of the pupil on the panel or the plate, metres; the mask is 2.3 radii wide (default on a panel: the "
        "largest with a whole number of panel pixels per mask pixel)",
    )
    _add_panel(export)
    _add_timing(export)
    plate = export.add_argument_group("plate (STL)")
    plate.add_argument("--mask", type=int, metavar="K", help="which mask, from 0 (needed if there are several)")
    plate.add_argument("--base", type=float, default=1e-3, metavar="M", help="thickness in metres (default: 1e-3)")
    export.set_defaults(run=export_masks)

    back = actions.add_parser(
        "import",
        help="read SLM frames back and check them",
        description="Read a folder of SLM frames back, check every pixel; write the masks' heights if OUT is given.",
    )
    back.add_argument("frames", metavar="FOLDER", help="folder that export wrote")
    back.add_argument("-o", "--output", metavar="OUT", help="x.npy (metres) or x.safetensors (masks.phase)")
    back.add_argument(
        "--shown",
        action="store_true",
        help="heights as shown by the panel, wrapped to one wave (default: with the whole waves restored)",
    )
    _add_material(back)
    back.add_argument("--force", action="store_true", help="replace OUT")
    back.set_defaults(run=import_masks)


def show_masks(args: argparse.Namespace) -> None:
    """Print the masks of a file with their size and heights."""
    saved = _saved(args)
    heights = saved.heights
    tell("masks", _in_words(heights))
    tell("material", saved.material.name)
    for k, one in enumerate(heights):
        low, high = one.aminmax()
        tell(
            f"mask {k}",
            f"{float(low) * 1e9:.1f} to {float(high) * 1e9:.1f} nm, RMS {float(one.std(correction=0)) * 1e9:.1f} nm",
        )
    if saved.dwell is not None:
        tell("dwell", " ".join(f"{share:.4f}" for share in saved.dwell))


def export_masks(args: argparse.Namespace) -> None:
    """Export masks as SLM frames, heights or STL, by the name of the output."""
    kind = Path(args.output).suffix.lower()
    check_choice("the suffix of what to write", kind, ("", ".npy", ".stl"))
    _check_absent(args.output, args.force, args.masks, folder=not kind)
    saved = _saved(args)
    tell("masks", _in_words(saved.heights))
    if kind == ".npy":
        write_heights(args.output, saved.heights)
    elif kind == ".stl":
        _export_stl(args, saved.heights)
    else:
        _export_frames(args, saved)
    tell("wrote", args.output)


def import_masks(args: argparse.Namespace) -> None:
    """Import SLM frames, check them, and write their heights."""
    if args.output is not None:
        check_choice("the suffix of what to write", Path(args.output).suffix.lower(), (".npy", ".safetensors"))
        _check_absent(args.output, args.force)
    frames = read_slm_frames(args.frames)
    heights = frames.heights_shown() if args.shown else frames.heights()
    tell("masks", _in_words(heights))
    tell("frames", _frames_in_words(frames))
    if args.output is not None:
        write_heights(args.output, heights, None if args.material is None else MATERIALS[args.material])
        tell("wrote", args.output)


def _saved(args: argparse.Namespace) -> SavedMasks:
    """Return the masks of the arguments, and what their file says of them."""
    material = None if args.material is None else MATERIALS[args.material]
    if Path(args.masks).suffix.lower() != ".safetensors":
        return SavedMasks(read_heights(args.masks), MATERIALS["constant"] if material is None else material)
    state = camera_state(args.masks)
    try:
        return masks_in_state(state, material)
    except ValueError as error:
        raise ValueError(f"cannot read {args.masks}: {error}") from None


def _panel(args: argparse.Namespace, saved: SavedMasks) -> GreyLevels:
    """Return the panel of the options; without them, that of the camera, with its phases at the working wavelength."""
    bits = 8 if args.bits is None else args.bits
    if args.response is not None:
        return GreyLevels(bits, response=read_response(args.response, bits))
    known = next((part for part in _parts(saved) if isinstance(part, GreyLevels)), None)
    if known is None or args.bits is not None or args.phase_range is not None:
        return GreyLevels(bits, 2 * math.pi if args.phase_range is None else args.phase_range)
    if args.wavelength == REFERENCE_WAVELENGTH:
        return known
    scale = metres_to_radians(saved.material, args.wavelength) / metres_to_radians(saved.material)
    if known.response is None:
        return GreyLevels(known.bits, known.phase_range * scale)
    return GreyLevels(known.bits, response=(known.levels * scale).tolist())


def _times(args: argparse.Namespace, saved: SavedMasks) -> list[FrameTime]:
    """Return when the frames are shown, by the options; without them, by the camera's modulator."""
    known = next((part for part in _parts(saved) if isinstance(part, Switching)), Switching(0.0))
    exposure = known.exposure if args.exposure is None else args.exposure
    switching = known.switching_time if args.switching_time is None else args.switching_time
    shares = args.dwell or saved.dwell or [1.0] * len(saved.heights)
    if len(shares) != len(saved.heights):
        raise ValueError(f"there are {len(shares)} dwell shares for {len(saved.heights)} masks")
    return frame_times(shares, exposure, switching, args.cyclic or known.cyclic)


def _parts(saved: SavedMasks) -> list[nn.Module]:
    return [] if saved.modulator is None else list(saved.modulator.modules())


def _export_frames(args: argparse.Namespace, saved: SavedMasks) -> None:
    heights, panel = saved.heights, _panel(args, saved)
    placement = PanelPlacement(
        (args.panel[1], args.panel[0]),
        args.panel_pitch,
        args.pupil_radius,
        tuple(args.offset),
        args.flip,
        args.rotate,
    )
    times = _times(args, saved)
    frames = SLMFrames.of(heights, panel, args.wavelength, saved.material)
    write_slm_frames(args.output, frames, placement, times, args.suffix, replace=args.force)
    size = (heights.shape[1], heights.shape[2])
    scale = placement.scale(size)
    uneven = "" if scale == round(scale) else ", so that blocks differ by one"
    tell("panel", f"{args.panel[0]} x {args.panel[1]} px, {scale:.6g} a mask pixel{uneven}")
    tell("pupil", f"radius {placement.radius(size) * 1e3:.4g} mm on the panel")
    tell("frames", _frames_in_words(frames))
    # By the panel's phases and the masks themselves, and not by what the sidecar says of both.
    wanted = heights * metres_to_radians(saved.material, args.wavelength)
    error, share = read_slm_frames(args.output).phase_error(wanted, panel.levels)
    tell("check", f"read back, phase differs by up to {error:.3g} rad, {share / 2:.3f} grey levels, 0.5 allowed")
    if share > 1:
        raise ValueError(f"{args.output} does not hold the masks: phase differs by {error:.3g} rad")


def _export_stl(args: argparse.Namespace, heights: Tensor) -> None:
    if args.pupil_radius is None:
        raise ValueError("an STL file needs --pupil-radius, the metres of which 2.3 span the mask")
    index = 0 if args.mask is None and len(heights) == 1 else args.mask
    if index is None or not 0 <= index < len(heights):
        raise ValueError(f"an STL file holds one mask: --mask must be from 0 to {len(heights) - 1}, got {args.mask}")
    write_stl(args.output, heights[index], args.pupil_radius, args.base)


def _add_masks(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("masks", metavar="MASKS", help="heights (.npy), a state_dict or a checkpoint (.safetensors)")
    _add_material(parser)


def _add_material(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--material",
        choices=tuple(MATERIALS),
        help="what turns height into phase (default: as saved, or constant, index 1.5 at every wavelength)",
    )


def _add_panel(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("panel (frames)")
    group.add_argument("--bits", type=int, metavar="B", help="of a grey level, 1 to 10 (default: as saved, or 8)")
    group.add_argument(
        "--wavelength", type=float, default=530e-9, metavar="M", help="the panel's working wavelength (default: 530e-9)"
    )
    group.add_argument(
        "--phase-range",
        type=float,
        metavar="RAD",
        help="phase at that wavelength that the levels span (default: as saved, or 2 pi)",
    )
    group.add_argument(
        "--response",
        metavar="FILE",
        help="instead: its measured phases at that wavelength, as text: one for each level, or two columns, level and "
        "phase; radians, or the unit that a header names (deg, pi, waves)",
    )
    group.add_argument(
        "--panel", type=_panel_size, default=(1920, 1200), metavar="WxH", help="its pixels (default: 1920x1200)"
    )
    group.add_argument("--panel-pitch", type=float, default=8e-6, metavar="M", help="between them (default: 8e-6)")
    group.add_argument(
        "--offset",
        type=int,
        nargs=2,
        default=(0, 0),
        metavar=("RIGHT", "DOWN"),
        help="of the mask's centre from the panel's, panel pixels",
    )
    group.add_argument("--flip", choices=FLIPS, default="none", help="mirror the mask first (default: none)")
    group.add_argument(
        "--rotate", type=int, choices=ROTATIONS, default=0, help="then turn it counter-clockwise, degrees (default: 0)"
    )
    group.add_argument("--suffix", choices=SUFFIXES, default=".png", help="kind of files (default: .png)")


def _add_timing(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("timing (frames)")
    group.add_argument("--exposure", type=float, metavar="S", help="seconds (default: as saved, or 0.1)")
    group.add_argument("--switching-time", type=float, metavar="S", help="of a swap (default: as saved, or 0)")
    group.add_argument(
        "--dwell", type=float, nargs="+", metavar="SHARE", help="of each mask (default: as saved, or equal)"
    )
    group.add_argument("--cyclic", action="store_true", help="the swap back to the first falls into the exposure too")


def _panel_size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"a panel is WIDTHxHEIGHT in pixels, such as 1920x1200, got {text!r}")
    return int(match[1]), int(match[2])


def _check_absent(path: str, force: bool, source: str | None = None, folder: bool = False) -> None:
    """Check before any work that the output may be written.

    Raises:
        FileExistsError: if it exists and is not to be replaced.
        FileNotFoundError: if its parent folder does not exist.
    """
    target = Path(path)
    if not target.absolute().parent.is_dir():
        raise FileNotFoundError(f"cannot write {path}: there is no folder {target.parent}")
    if source is not None and target.exists() and Path(source).exists() and target.samefile(source):
        raise FileExistsError(f"cannot write {path}: it is the input")
    if target.exists() and not force:
        raise FileExistsError(f"cannot write {path}: it exists, and --force was not given")
    if folder:
        check_replaceable(path, force)


def _in_words(heights: Tensor) -> str:
    count, rows, columns = heights.shape
    low, high = torch.aminmax(heights)
    return f"{count} of {rows}x{columns} pixels, heights {float(low) * 1e9:.1f} to {float(high) * 1e9:.1f} nm"


def _frames_in_words(frames: SLMFrames) -> str:
    phases = frames.level_phases
    beyond = float((frames.turns != 0).double().mean())
    wrapped = f", {beyond:.1%} of the pixels wrapped by whole waves" if beyond else ""
    return (
        f"{len(frames.grey)} of {frames.bits} bits, {float(phases.min()):.3f} to {float(phases.max()):.3f} rad at "
        f"{frames.wavelength * 1e9:g} nm{wrapped}"
    )
