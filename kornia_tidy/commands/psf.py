"""`kornia-tidy psf`: figure and numbers of a camera's PSFs over depth and colour."""

from __future__ import annotations

import argparse
import math
from io import BytesIO
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.commands.options import add_lens_options, check_output, make_lens, seed
from kornia_tidy.commands.report import Stages, tell
from kornia_tidy.fidelity import PRESETS, Fidelity
from kornia_tidy.figures.depth import depth_at
from kornia_tidy.figures.psf import PSFSheet, draw_psfs, ring_centres
from kornia_tidy.figures.style import require_matplotlib
from kornia_tidy.figures.system_statistics import contrast_transfer
from kornia_tidy.files import write_bytes
from kornia_tidy.inference.trained import load_camera
from kornia_tidy.mask_export.mask_files import SUFFIXES, read_heights
from kornia_tidy.masks.pixelwise import PixelwiseMask
from kornia_tidy.optics.thin_lens import ThinLensCamera
from kornia_tidy.systems.presets import SYSTEMS

DESCRIPTION = """\
Draw the point spread functions (PSFs) of a camera: a montage over depth and colour,
a slice through focus, and the modulation transfer function (MTF). CAMERA is
the name of a published system, a camera's state_dict (.safetensors), a checkpoint of
a training (best.safetensors), or a file of heights in metres (.npy).

Printed for each depth and colour:
  held    share of a point's light inside the window (ensquared energy)
  peak    share of the light in the brightest pixel
  Strehl  the peak relative to that of the same lens in focus without a mask
  MTF50   spatial frequency at which contrast falls to one half, in cycles per
          pixel; 0.5 is the Nyquist limit
"""

EPILOG = f"""\
systems: {", ".join(SYSTEMS)}

examples:
  kornia-tidy psf phasecam3d
  kornia-tidy psf runs/edof/best.safetensors --depths 0.4,0.6,1,inf -o psfs.png
  kornia-tidy psf heights.npy --focus-distance 1 --aperture-diameter 4e-3

The PSFs in Python:
  from kornia_tidy import TiDyOptics
  bank = TiDyOptics.from_preset("phasecam3d").psf_bank()  # bank.psfs, bank.defocus
"""

DOTS_PER_INCH = 150
FREQUENCIES = 64  # rings of the contrast
SLICES = 81  # of the picture through focus
COLUMNS = 7


def add_parser(subparsers: Any) -> None:
    """Describe the command to argparse."""
    parser = subparsers.add_parser(
        "psf",
        help="PSFs of a camera over depth and colour",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    parser.add_argument("camera", metavar="CAMERA", help="a published system, or a file as above")
    parser.add_argument("-o", "--output", default="psf.png", metavar="OUT", help="picture (default: psf.png)")
    parser.add_argument(
        "--depths",
        metavar="A,B",
        help=f"metres, inf allowed (default: {COLUMNS} over the camera's range, even in inverse depth)",
    )
    parser.add_argument("--window", type=int, metavar="PX", help="side of the PSFs, odd (default: as in a capture)")
    parser.add_argument("--fidelity", choices=tuple(PRESETS), help="speed or accuracy (default: balanced, or as saved)")
    parser.add_argument("--mask-seed", type=seed, default=0, metavar="N", help="of a system's masks (default: 0)")
    add_lens_options(
        parser.add_argument_group("lens", "In metres, for a file of masks alone; saved cameras have their own.")
    )


def run(args: argparse.Namespace) -> None:
    """Compute the PSFs, print their numbers and draw them."""
    check_output(args.output, args.camera)
    require_matplotlib()
    stages = Stages()
    with torch.no_grad():
        with stages("camera"):
            optics = _optics(args)
            psi = _defocus(args.depths, optics)
        with stages("PSFs"):
            psfs = optics.psf_bank(defocus=psi.tolist()).psfs.flip(0)  # nearest first
            lo, hi = optics.camera.defocus_range
            focus = torch.linspace(lo, hi, SLICES, dtype=torch.float64)
            through = optics.psf_bank(defocus=focus.tolist()).psfs
            contrast = contrast_transfer(psfs / psfs.sum((2, 3), keepdim=True), FREQUENCIES)
            strehl = psfs.amax((2, 3)) / _without_mask(optics).amax((2, 3))
        near_to_far = [round(each, 6) + 0.0 for each in psi.flip(0).tolist()]  # without a negative zero
        depths, channels = [_in_metres(each, optics) for each in near_to_far], _channels(optics)
        middle = len(channels) // 2
        sheet = PSFSheet(
            title=f"PSFs of {Path(args.camera).name}, window {optics.window} x {optics.window} px",
            depths=[
                f"{depth}\nψ = {each:+.3g}" if each else f"{depth}\nψ = 0"
                for depth, each in zip(depths, near_to_far, strict=True)
            ],
            channels=channels,
            psfs=psfs,
            contrast=contrast[:, middle],
            focus=focus,
            slices=through[:, middle, optics.window // 2],
        )
        with stages("picture"):
            picture = BytesIO()
            draw_psfs(sheet).savefig(picture, dpi=DOTS_PER_INCH, format=Path(args.output).suffix[1:])
    tell("camera", optics.camera.extra_repr())
    tell("masks", optics.masks.extra_repr())
    tell("window", f"{optics.window} x {optics.window} px, fidelity {optics.fidelity.name!r}")
    print()
    print(
        f"{'depth':>9}  {'psi, rad':>8}  {'colour':>8}  {'held':>6}  {'peak':>7}  {'Strehl':>6}  MTF50, cycles a pixel"
    )
    for d, (depth, each) in enumerate(zip(depths, near_to_far, strict=True)):
        for c, name in enumerate(channels):
            held, peak = 100 * float(psfs[d, c].sum()), 100 * float(psfs[d, c].max())
            print(
                f"{depth:>9}  {each:>+8.2f}  {name:>8}  {held:>4.1f} %  {peak:>5.2f} %  {float(strehl[d, c]):>6.3f}  "
                f"{_half_contrast(contrast[d, c])}"
            )
    print()
    write_bytes(args.output, picture.getvalue())
    tell("wrote", f"{args.output}: look at it")
    tell("time", stages.summary())


def _optics(args: argparse.Namespace) -> TiDyOptics:
    """Return the camera of the arguments, with stray light discarded so that the ensquared energy can be measured."""
    name, fidelity, lens = args.camera, args.fidelity or "balanced", make_lens(args, None)
    if name in SYSTEMS:
        generator = torch.Generator().manual_seed(args.mask_seed)
        _refuse_lens(name, lens)
        optics = TiDyOptics.from_preset(name, generator=generator, fidelity=fidelity)
    elif Path(name).suffix.lower() not in SUFFIXES:
        raise ValueError(
            f"CAMERA must be one of {', '.join(map(repr, SYSTEMS))}, or a file (.npy, .safetensors), got {name!r}"
        )
    elif (saved := None if Path(name).suffix.lower() == ".npy" else load_camera(name)) is None:
        optics = TiDyOptics(PixelwiseMask(initial=read_heights(name)), lens, fidelity=fidelity)
    else:
        _refuse_lens(name, lens)
        optics = saved if args.fidelity is None else saved.with_fidelity(fidelity)
    settings: Fidelity = optics.fidelity
    window = optics.window if args.window is None else args.window
    return optics.with_fidelity(settings.replace(name=settings.name, window=window, stray_light="discard"))


def _refuse_lens(name: str, lens: ThinLensCamera) -> None:
    if lens.extra_repr() != ThinLensCamera().extra_repr():
        raise ValueError(f"{name} has a lens of its own: --focal-length and the like are for files of masks alone")


def _defocus(text: str | None, optics: TiDyOptics) -> Tensor:
    """Return the defocus of the requested depths in radians, ascending, (D,)."""
    lo, hi = optics.camera.defocus_range
    if text is None:
        return torch.linspace(lo, hi, COLUMNS, dtype=torch.float64)
    try:
        depths = [float(word) for word in text.split(",")]
    except ValueError:
        raise ValueError(f"--depths must be metres with commas between them, got {text!r}") from None
    if not all(depth > 0 for depth in depths):
        raise ValueError(f"--depths must be positive metres, got {text!r}")
    return optics.camera.defocus(torch.tensor(sorted(set(depths), reverse=True), dtype=torch.float64))


def _without_mask(optics: TiDyOptics) -> Tensor:
    """Return the in-focus PSFs of the same lens with a flat mask, (1, C, P, P)."""
    rows, columns = optics.masks.phase.shape[-2:]
    masks = PixelwiseMask(1, (rows, columns), initial="flat")
    plain = TiDyOptics(
        masks, optics.camera, fidelity=optics.fidelity, spectrum=optics.spectrum, aperture=optics.aperture
    )
    return plain.psf_bank(defocus=[0.0]).psfs


def _in_metres(psi: float, optics: TiDyOptics) -> str:
    if not isinstance(optics.camera, ThinLensCamera):
        return "-"
    depth = depth_at(psi, optics.camera)
    return "inf" if math.isinf(depth) else f"{depth:.3g} m"


def _channels(optics: TiDyOptics) -> list[str]:
    """Return the names of the channels: a wavelength, or a colour if a channel has several."""
    seen = [
        [wavelength for wavelength, weight in zip(optics.spectrum.wavelengths, weights, strict=True) if weight]
        for weights in optics.spectrum.weights
    ]
    names = ("red", "green", "blue") if len(seen) == 3 else tuple(f"{c + 1}" for c in range(len(seen)))
    return [f"{own[0] * 1e9:.0f} nm" if len(own) == 1 else name for own, name in zip(seen, names, strict=True)]


def _half_contrast(contrast: Tensor) -> str:
    """Return the frequency at which contrast first falls to one half, in cycles per pixel, in words.

    Example:
        >>> _half_contrast(torch.tensor([0.9, 0.6, 0.4, 0.1]))
        '0.250'
    """
    frequency, values = [0.0, *ring_centres(len(contrast))], [1.0, *contrast.tolist()]
    for i in range(1, len(values)):
        if values[i] <= 0.5:
            share = (values[i - 1] - 0.5) / (values[i - 1] - values[i])
            return f"{frequency[i - 1] + share * (frequency[i] - frequency[i - 1]):.3f}"
    return "above 0.5"
