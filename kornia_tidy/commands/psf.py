"""`kornia-tidy psf`: figure and numbers of a camera's PSFs over depth and colour."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

from kornia_tidy.choices import SYSTEMS, Preset
from kornia_tidy.commands.parser import Argument, Parsed
from kornia_tidy.commands.shared import Out, Window, check_output
from kornia_tidy.inference.settings import LensSettings
from kornia_tidy.settings import Seed

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
    """PSFs of a camera over depth and colour.

    Draws a montage of the point spread functions (PSFs) over depth and colour, a slice
    through focus, and the modulation transfer function (MTF). CAMERA is the name of a
    published system, a camera's state_dict (.safetensors), a checkpoint of a training
    (best.safetensors), or a file of heights in metres (.npy).

    Printed for each depth and colour:
      held    share of a point's light inside the window (ensquared energy)
      peak    share of the light in the brightest pixel
      Strehl  the peak relative to that of the same lens in focus without a mask
      MTF50   spatial frequency at which contrast falls to one half, in cycles per
              pixel; 0.5 is the Nyquist limit

    The PSFs in Python:
      from kornia_tidy import TiDyOptics
      bank = TiDyOptics.from_preset("phasecam3d").psf_bank()  # bank.psfs, bank.defocus

    Args:
        camera: a file as above, or a published system.
        output: picture.
        depths: depths with commas between them, inf allowed. None: 7 over the camera's range, even in inverse depth.
        window: side of the PSFs, odd. None: as in a capture.
        fidelity: speed or accuracy. None: balanced, or as saved.
        mask_seed: of a system's masks.
        lens: for a file of masks alone; saved cameras have their own.
    """

    camera: Annotated[str, Argument("CAMERA")]
    output: Out = "psf.png"
    depths: Annotated[tuple, Parsed("A,B", "metres", read=depths_of)] | None = None
    window: Window | None = None
    fidelity: Preset | None = None
    mask_seed: Seed = 0
    lens: LensSettings = field(default_factory=LensSettings)

    examples: ClassVar = """\
  kornia-tidy psf phasecam3d
  kornia-tidy psf runs/edof/best.safetensors --depths 0.4,0.6,1,inf -o psfs.png
  kornia-tidy psf heights.npy --focus-distance 1 --aperture-diameter 4e-3
"""

    def run(self) -> None:
        """Compute the PSFs, print their numbers and draw them."""
        import torch

        from kornia_tidy.commands.report import Stages, tell
        from kornia_tidy.figures.psf import draw_psfs
        from kornia_tidy.figures.psf_measures import measures_of_psfs
        from kornia_tidy.figures.style import require_matplotlib, save_figure

        check_output(self.output, self.camera)
        require_matplotlib()
        stages = Stages()
        with torch.no_grad(), stages("camera"):
            optics = self._optics()
            psi = self._defocus(optics)
        with stages("PSFs"):
            measured = measures_of_psfs(optics, psi)
        title = f"PSFs of {Path(self.camera).name}, window {optics.window} x {optics.window} px"
        with stages("picture"):
            save_figure(self.output, draw_psfs(measured.sheet(title)))
        tell("camera", optics.camera.extra_repr())
        tell("masks", optics.masks.extra_repr())
        tell("window", f"{optics.window} x {optics.window} px, fidelity {optics.fidelity.name!r}")
        print("", *measured.table(), "", sep="\n")
        tell("wrote", f"{self.output}: look at it")
        tell("time", stages.summary())

    def _optics(self) -> TiDyOptics:
        """Return the camera, with stray light discarded so that the ensquared energy can be measured."""
        import torch

        from kornia_tidy.camera.tidy_optics import TiDyOptics
        from kornia_tidy.inference.trained import load_camera
        from kornia_tidy.mask_export.mask_files import SUFFIXES, read_heights
        from kornia_tidy.masks.pixelwise import PixelwiseMask

        name, fidelity, suffix = self.camera, self.fidelity or "balanced", Path(self.camera).suffix.lower()
        if name not in SYSTEMS and suffix not in SUFFIXES:
            raise ValueError(
                f"CAMERA must be one of {', '.join(map(repr, SYSTEMS))}, or a file (.npy, .safetensors), got {name!r}"
            )
        saved = load_camera(name) if name not in SYSTEMS and suffix != ".npy" else None
        if (name in SYSTEMS or saved is not None) and self.lens != LensSettings():
            raise ValueError(f"{name} has a lens of its own: --focal-length and the like are for files of masks alone")
        if name in SYSTEMS:
            generator = torch.Generator().manual_seed(self.mask_seed)
            optics = TiDyOptics.from_preset(name, generator=generator, fidelity=fidelity)
        elif saved is None:
            optics = TiDyOptics(PixelwiseMask(initial=read_heights(name)), self.lens.camera(), fidelity=fidelity)
        else:
            optics = saved if self.fidelity is None else saved.with_fidelity(fidelity)
        settings = optics.fidelity
        window = optics.window if self.window is None else self.window
        return optics.with_fidelity(settings.replace(name=settings.name, window=window, stray_light="discard"))

    def _defocus(self, optics: TiDyOptics) -> Tensor:
        """Return the defocus of the requested depths in radians, ascending, (D,)."""
        import torch

        lo, hi = optics.camera.defocus_range
        if self.depths is None:
            return torch.linspace(lo, hi, COLUMNS, dtype=torch.float64)
        return optics.camera.defocus(torch.tensor(self.depths[::-1], dtype=torch.float64))
