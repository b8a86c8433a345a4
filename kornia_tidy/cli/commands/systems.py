"""`kornia-tidy systems`: nine published optical systems, listed and drawn side by side."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated

from kornia_tidy.choices import SYSTEMS
from kornia_tidy.cli.commands.parser import Parsed
from kornia_tidy.cli.commands.shared import Out, OwnScene, check_output
from kornia_tidy.settings import Seed, Unit

if TYPE_CHECKING:
    from torch import Tensor

DOTS_PER_INCH = 120


def names_of(text: str) -> tuple[str, ...]:
    """Read names of systems with commas between them.

    Example:
        >>> names_of("tidy-5, chang2019")
        ('tidy-5', 'chang2019')
    """
    names = tuple(name.strip() for name in text.split(","))
    if wrong := [name for name in names if name not in SYSTEMS]:
        raise ValueError(f"must be some of {', '.join(SYSTEMS)}, got {wrong[0]!r:.80}")
    return names


@dataclass(frozen=True, kw_only=True)
class Systems:
    """Compare nine published systems side by side.

    Lists them and draws, in one picture, their masks, point spread functions (PSF) and
    contrast (MTF) over depth, the Cramér-Rao bound on the depth of a point, and the capture
    of one scene. Depths of your own scene are stretched, in dioptres, over each system's
    range.

    Masks are those that a system starts from before training. The same systems in Python:
      from kornia_tidy import TiDyOptics
      optics = TiDyOptics.from_preset("phasecam3d")
      coded = optics(image, depth)
    Where each value was read stands in kornia_tidy.optics.SYSTEMS["phasecam3d"].sources;
    values that no text or code would give are guesses, and are listed as such.

    Args:
        systems: names with commas between them, in the order given. None: all of them.
        output: picture to write.
        size: longer side of the scene: larger ones are made smaller, and blur then looks larger.
        seed: of scene, masks and noise.
        scene: to be captured.

    Examples:
        kornia-tidy systems                                    all nine, on a scene made here
        kornia-tidy systems --systems tidy-5,ikoma2021 -o two.png
        kornia-tidy systems --image rgb.png --depth depth.png --depth-scale 0.001
    """

    systems: Annotated[tuple, Parsed("A,B", read=names_of)] | None = None
    output: Out = "systems.png"
    size: Annotated[int, Unit("PX", "pixels", 32)] = 320
    seed: Seed = 0
    scene: OwnScene = field(default_factory=OwnScene)

    def run(self) -> None:
        """List the systems, compute their statistics, and draw them."""
        check_output(self.output, self.scene.image, self.scene.depth)
        import torch

        from kornia_tidy.camera.tidy_optics import TiDyOptics
        from kornia_tidy.cli.commands.report import progress_bar, tell
        from kornia_tidy.figures.style import require_matplotlib, save_figure
        from kornia_tidy.figures.system_statistics import system_statistics
        from kornia_tidy.figures.systems import Portrait, draw_systems
        from kornia_tidy.optics.published_systems import published_system, systems_table
        from kornia_tidy.reconstruction.tasks import metres

        systems = [published_system(name) for name in self.systems or SYSTEMS]
        require_matplotlib()
        portraits = []
        progress = progress_bar("systems", iterable=systems, unit="system")
        with torch.no_grad(), progress:
            image, inverse_depth, scene = self._scene()
            for system in progress:
                progress.set_postfix_str(system.name)
                camera = system.camera()
                masks = torch.Generator().manual_seed(self.seed)
                optics = TiDyOptics.from_preset(system.name, generator=masks, camera=camera)
                seen = system_statistics(optics.psf_model)
                generator = torch.Generator().manual_seed(self.seed)
                capture = optics(image, metres(camera, inverse_depth), generator=generator)
                portraits.append(Portrait(system, optics, seen, capture))
            figure = draw_systems(portraits, image, inverse_depth, scene)
            save_figure(self.output, figure, DOTS_PER_INCH)
        print("\n".join(systems_table([portrait.system for portrait in portraits])))
        print()
        tell("wrote", f"{self.output}: look at it")

    def _scene(self) -> tuple[Tensor, Tensor, str]:
        """Return an RGB image, its normalised inverse depth in [0, 1], and its name."""
        from kornia_tidy.data.depth_range import middle_depths

        scene, name = self.scene.read_or_paint(round(self.size * 0.625), self.size, 0.5, 5.0, self.seed)
        near, far = (1 / end for end in middle_depths(scene.depth, scene.valid))
        image, depth, _ = scene.within(self.size)
        return image, ((1 / depth - far) / (near - far)).clamp(0, 1), name
