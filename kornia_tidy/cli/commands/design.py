"""`kornia-tidy design`: co-design of aperture, focus and masks, and whether masks pay."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any

from kornia_tidy.choices import BETWEEN
from kornia_tidy.cli.commands.shared import Folder
from kornia_tidy.design.settings import DesignSettings
from kornia_tidy.files import output_folder
from kornia_tidy.settings import Seconds, Seed, Unit, one_of

if TYPE_CHECKING:
    from torch import nn

    from kornia_tidy.data.rgbd import Scene
    from kornia_tidy.design.co_design import CoDesign, Effort
    from kornia_tidy.design.design_task import DesignTask


@dataclass(frozen=True, kw_only=True)
class ModulatorSettings:
    """Modulator.

    Args:
        bits: of its grey levels over one wave. None: any phase.
        switching_time: from mask to mask.
        exposure: of a capture.
        between: phase while it switches.
    """

    bits: Annotated[int, Unit("B", "", 1)] | None = None
    switching_time: Seconds = 0.0
    exposure: Seconds = 0.1
    between: Annotated[str, one_of(BETWEEN)] = "exponential"

    def modulator(self) -> nn.Module:
        """Return what shows the masks."""
        from kornia_tidy.modulator.modulator import DwellTimes, SpatialLightModulator
        from kornia_tidy.modulator.phase_panel import GreyLevels
        from kornia_tidy.modulator.switching import Switching

        parts: list[nn.Module] = [] if self.bits is None else [GreyLevels(self.bits)]
        switching = self.switching_time > 0
        timing = Switching(self.switching_time, self.exposure, self.between) if switching else DwellTimes()
        return SpatialLightModulator(*parts, timing) if parts else timing


@dataclass(frozen=True, kw_only=True)
class Design:
    r"""Design aperture, focus and masks together, and see whether masks pay.

    The aim is extended depth of field, depth, or both. A wide aperture with masks gets
    more light, a lens that is stopped down is sharper over a larger range of depths: which
    of the two is ahead depends on the light and on the range of depths.

    Everything is compared at the same exposure time: light is given as the electrons of a
    white pixel at one f-number, and falls with the square of the f-number. Where white would
    exceed the full well of a pixel the exposure is shorter.

      search    flat lenses and masks at f-numbers one stop apart, by the error of the
                best linear restoration (and of depth by texture); masks start from a
                focal sweep, a Fisher mask and noise, and see the modulator's switching
                and grey levels
      captures  the best of both take pictures of scenes (dead leaves, and yours), which the
                best closed form restores; settings are chosen on one half of the scenes,
                scores are from the other
    Masks are recommended only if they are ahead by more than two standard errors.

    Args:
        output: made if missing.
        quick: fewer steps and scenes: a first answer, in 20 s on one core.
        seed: of all that is random.
        scenes: pictures with depth, which decide beside dead leaves; FOLDER/rgbd.json pairs them: {"image": "*.png",
            "depth": "*_depth.png", "scale": 0.001}. None: only dead leaves.
        given: scene, lens and sensor.
        modulator: what shows the masks.

    Notes:
        FOLDER gets design.png (look at this first), report.json (every camera that was compared),
        masks.npy (heights of the best masks in metres) and camera.safetensors (the recommended
        camera):
          kornia-tidy masks export FOLDER/camera.safetensors -o slm      frames for a modulator
          kornia-tidy psf FOLDER/camera.safetensors --aperture-diameter A --focus-distance Z
        its PSFs, with the aperture and the focus that are printed at the end.

        How many electrons? The full well of the pixel if white nearly saturates it. Else roughly
          500 * illuminance in lux * exposure in seconds * (pixel pitch in um)^2 / f-number^2
        at a quantum efficiency of one half: 17,000 lux (day, in the shade) for 33 ms on 8 um
        pixels give 57,000 at f/17.6, and 300 lux (a room) give 1,000.

    Examples:
        The camera of the paper in bright light, a first answer:
          kornia-tidy design --quick

        A range of 0.5 to 4 m in dim light, with a modulator of 8 bits that takes 4 ms:
          kornia-tidy design --depth-range 0.5 4 --electrons 5000 --bits 8 \
              --switching-time 4e-3 --exposure 33e-3 -o outputs/dim

        Behind a real lens, scored over its field:
          kornia-tidy design --lens single-50mm --quick -o outputs/single

        Image and depth count alike; your own scenes decide too:
          kornia-tidy design --depth-weight 0.5 --scenes my/scenes -o outputs/both
    """

    output: Folder = "outputs/design"
    quick: bool = False
    seed: Seed = 0
    scenes: Folder | None = None
    given: DesignSettings = field(default_factory=DesignSettings)
    modulator: ModulatorSettings = field(default_factory=ModulatorSettings)

    def task(self) -> DesignTask:
        """Return the task that the settings describe.

        Raises:
            ValueError: if a value is out of its range, or a length not in metres.
        """
        from kornia_tidy.design.design_task import DesignTask

        return DesignTask(**vars(self.given), modulator=self.modulator.modulator())

    def run(self) -> None:
        """Design, and write the files."""
        folder = output_folder(self.output)
        from kornia_tidy.cli.commands.report import tell
        from kornia_tidy.data.rgbd_folder import scenes_in
        from kornia_tidy.design.co_design import Effort, planned_work
        from kornia_tidy.design.design_report import PICTURE, design_files, exposure_in_words, focus_distance
        from kornia_tidy.figures.co_design import draw_co_design
        from kornia_tidy.figures.style import require_matplotlib, save_figure
        from kornia_tidy.files import write_bytes

        require_matplotlib()
        task = self.task()
        effort = Effort.quick() if self.quick else Effort()
        scenes = [] if self.scenes is None else scenes_in(self.scenes)
        folder.mkdir(parents=True, exist_ok=True)
        work = planned_work(task, effort, len(scenes))
        near, far = task.depth_range
        tell("scene", f"depths {near:g} to {far:g} m, {effort.scenes} dead leaves, {len(scenes)} scenes of yours")
        tell("light", f"{task.electrons:g} electrons of white at f/{task.reference_f_number:g}, equal exposure time")
        tell("work", f"{work['search']} gradient steps and {work['captures']} captures")
        design = _with_progress(task, scenes, effort, self.seed, work)
        save_figure(folder / PICTURE, draw_co_design(design))
        files = design_files(design)
        for name, data in files.items():
            write_bytes(folder / name, data)
        tell("verdict", design.words)
        focus, f_number = focus_distance(task, design.recommended), design.recommended.f_number
        tell("exposure", exposure_in_words(design))
        tell("camera", f"f/{f_number:.3g}, aperture {task.focal_length / f_number:.3g} m, focus at {focus:.3g} m")
        tell("wrote", f"{folder / PICTURE}: look at this one")
        for name in files:
            tell("", str(folder / name))


def _with_progress(task: DesignTask, scenes: list[Scene], effort: Effort, seed: int, work: dict[str, int]) -> CoDesign:
    """Run the co-design with a progress bar for each stage."""
    from kornia_tidy.cli.commands.report import progress_bar
    from kornia_tidy.design.co_design import co_design

    bars: dict[str, Any] = {}

    def progress(stage: str, amount: int) -> None:
        if stage not in bars:
            for bar in bars.values():
                bar.close()
            bars[stage] = progress_bar(stage, total=work[stage])
        bars[stage].update(amount)

    try:
        return co_design(task, scenes, effort, seed, progress)
    finally:
        for bar in bars.values():
            bar.close()
