"""`kornia-tidy psf`: figure and numbers of a camera's PSFs over depth and colour, and over the field of a lens."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from kornia_tidy.choices import SYSTEMS, Preset
from kornia_tidy.cli.commands.lens_option import RealLens, camera_and_lens
from kornia_tidy.cli.commands.parser import Argument, Parsed
from kornia_tidy.cli.commands.shared import Out, Window, check_output
from kornia_tidy.reconstruction.settings import LensSettings
from kornia_tidy.settings import Count, Seed

if TYPE_CHECKING:
    from torch import Tensor

    from kornia_tidy.camera.tidy_optics import TiDyOptics

COLUMNS = 7


def depths_of(text: str) -> tuple[float, ...]:
    """Read depths in metres with commas between them, nearest first.

    Example:
        >>> depths_of("inf,0.5")
        (0.5, inf)
    """
    try:
        depths = [float(word) for word in text.split(",")]
    except ValueError:
        raise ValueError(f"must be metres with commas between them, got {text!r}") from None
    if not all(depth > 0 for depth in depths):
        raise ValueError(f"must be positive metres, got {text!r}")
    return tuple(sorted(set(depths)))


@dataclass(frozen=True, kw_only=True)
class Psf:
    """Draw a camera's PSFs over depth and colour, and over the field of a lens.

    Draws a montage of the point spread functions (PSFs) over depth and colour, a slice
    through focus, and the modulation transfer function (MTF). CAMERA is the name of a
    published system, a camera's state_dict (.safetensors), a checkpoint of a training
    (best.safetensors), or a file of heights in metres (.npy).

    --lens puts a real lens around the masks of a published system or a file of heights;
    without CAMERA it is the lens without masks. --field draws PSFs at heights from the
    axis to the corner, beside the lens's spot diagram.

    Printed for each depth and colour:
      held    share of a point's light inside the window (ensquared energy)
      peak    share of the light in the brightest pixel
      Strehl  the peak relative to that of an ideal lens in focus without a mask
      MTF50   spatial frequency at which contrast falls to one half, in cycles per
              pixel; 0.5 is the Nyquist limit

    and with --field:
      light   irradiance of an even scene relative to the axis
      rays    root mean square distance of the lens's rays from their mean

    The PSFs in Python:
      from kornia_tidy import TiDyOptics
      bank = TiDyOptics.from_preset("phasecam3d").psf_bank()  # bank.psfs, bank.defocus

    Args:
        camera: a file as above, or a published system. None: no masks, with --lens.
        output: picture.
        depths: depths with commas between them, inf allowed. None: 7 over the camera's range, even in inverse depth;
            with --field 5, one of them in focus.
        window: side of the PSFs, odd. None: as in a capture.
        fidelity: speed or accuracy. None: balanced, or as saved.
        mask_seed: of a system's masks.
        settings: for --lens with a name or surfaces, and for a file with only masks; other cameras have their own.
        lens: a real lens by its name, a file that Lens.save wrote, or its surfaces (.zmx, .seq, .json). None: an ideal
            lens, or as saved.
        field: number of heights on the sensor from the axis to the corner that the lens is made for. None: the axis.

    Examples:
        kornia-tidy psf phasecam3d
        kornia-tidy psf runs/edof/best.safetensors --depths 0.4,0.6,1,inf -o psfs.png
        kornia-tidy psf heights.npy --focus-distance 1 --aperture-diameter 4e-3
        kornia-tidy psf --lens double-gauss-50mm --f-number 8 --focus-distance 1 --field 5
        kornia-tidy psf --lens lens.zmx --f-number 4 --focus-distance 2 --field 5
        kornia-tidy psf tidy-5 --lens single-50mm --field 3 --depths 0.4,0.6,inf
    """

    camera: Annotated[str, Argument("CAMERA")] | None = None
    output: Out = "psf.png"
    depths: Annotated[tuple, Parsed("A,B", "metres", read=depths_of)] | None = None
    window: Window | None = None
    fidelity: Preset | None = None
    mask_seed: Seed = 0
    settings: LensSettings = dataclasses.field(default_factory=LensSettings)
    lens: RealLens | None = None
    field: Count | None = None

    def run(self) -> None:
        """Compute the PSFs, print their numbers and draw them."""
        import torch

        from kornia_tidy.cli.commands.report import tell, tell_camera
        from kornia_tidy.figures.field import airy_radius, draw_field
        from kornia_tidy.figures.field_measures import heights_to_corner, measures_over_field
        from kornia_tidy.figures.psf import draw_psfs
        from kornia_tidy.figures.psf_measures import measures_of_psfs
        from kornia_tidy.figures.style import require_matplotlib, save_figure

        if self.camera is None and self.lens is None:
            raise ValueError("there is no camera: give CAMERA, --lens, or both")
        check_output(self.output, self.camera, self.lens)
        require_matplotlib()
        with torch.no_grad():
            optics = self._optics()
            psi = self._defocus(optics)
        if self.field is None:
            measured = measures_of_psfs(optics, psi)
            name = Path(self.camera or self.lens or "").name
            title = f"PSFs of {name}, window {optics.window} x {optics.window} px"
            save_figure(self.output, draw_psfs(measured, title))
        else:
            if optics.lens is None:
                raise ValueError(f"--field is for a camera with a lens, and {self.camera} has none: give it --lens")
            measured = measures_over_field(optics, heights_to_corner(optics.lens, self.field), psi)
            save_figure(self.output, draw_field(measured, airy_radius(optics)), dpi=100)
        tell_camera(optics)
        tell("window", f"{optics.window} x {optics.window} px, fidelity {optics.fidelity.name!r}")
        print("", *measured.table(), "", sep="\n")
        tell("wrote", f"{self.output}: look at it")

    def _optics(self) -> TiDyOptics:
        """Return the camera, with stray light discarded so that the ensquared energy can be measured."""
        import torch

        from kornia_tidy.camera.tidy_optics import TiDyOptics
        from kornia_tidy.lab.mask_export.mask_files import SUFFIXES, read_heights
        from kornia_tidy.masks.no_mask import NoMask
        from kornia_tidy.masks.pixelwise import PixelwiseMask
        from kornia_tidy.reconstruction.trained import load_camera

        name, fidelity, generator = self.camera, self.fidelity or "balanced", torch.Generator()
        suffix = "" if name is None else Path(name).suffix.lower()
        if name is not None and name not in SYSTEMS and suffix not in SUFFIXES:
            raise ValueError(
                f"CAMERA must be one of {', '.join(map(repr, SYSTEMS))}, or a file (.npy, .safetensors), got {name!r}"
            )
        saved = None if name is None or name in SYSTEMS or suffix == ".npy" else load_camera(name)
        if saved is not None and self.lens is not None:
            raise ValueError(
                f"{name} has its own lens: --lens is only for published systems and files of masks without a lens"
            )
        if (saved is not None or (name in SYSTEMS and self.lens is None)) and self.settings != LensSettings():
            raise ValueError(
                f"{name} has its own lens: --focal-length and the like are only for files of masks without a lens"
            )
        camera, lens = camera_and_lens(self.lens, self.settings)
        if name is None:
            optics = TiDyOptics(NoMask(), camera, fidelity=fidelity, lens=lens)
        elif name in SYSTEMS:
            other = {} if lens is None else {"camera": camera, "lens": lens}
            generator.manual_seed(self.mask_seed)
            optics = TiDyOptics.from_preset(name, generator=generator, fidelity=fidelity, **other)
        elif saved is None:
            optics = TiDyOptics(PixelwiseMask(initial=read_heights(name)), camera, fidelity=fidelity, lens=lens)
        else:
            optics = saved if self.fidelity is None else saved.with_fidelity(fidelity)
        settings = optics.fidelity
        window = optics.window if self.window is None else self.window
        return optics.with_fidelity(settings.replace(name=settings.name, window=window, stray_light="discard"))

    def _defocus(self, optics: TiDyOptics) -> Tensor:
        """Return the defocus of the requested depths in radians, ascending, (D,)."""
        import torch

        from kornia_tidy.figures.field_measures import depths_around_focus

        lo, hi = optics.camera.defocus_range
        if self.depths is not None:
            return optics.camera.defocus(torch.tensor(self.depths[::-1], dtype=torch.float64))
        if self.field is not None:
            return depths_around_focus(optics.camera)
        return torch.linspace(lo, hi, COLUMNS, dtype=torch.float64)
