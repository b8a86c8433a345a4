"""`kornia-tidy trade`: measurement of the speed-accuracy trade-off on one's own scene and device."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, ClassVar

from kornia_tidy.choices import KNOBS, Preset
from kornia_tidy.cli.commands.shared import CameraSettings, Folder, OwnScene
from kornia_tidy.files import output_folder
from kornia_tidy.settings import Count, Pixels, Seed, Unit, one_of

NEAR, FAR = 0.3, float("inf")  # m: the default camera's range


@dataclass(frozen=True, kw_only=True)
class Trade:
    """Measure speed against accuracy.

    The speed-accuracy trade-off is measured on one scene and this machine. Each setting of
    the fidelity is varied by itself from a preset. The presets, and the plans for this scene
    within errors of 1e-1 to 1e-6, are also measured. For each point the table has the
      error    of the noise-free capture in linear light, full scale 1, against the preset
               'reference', which is rendered once
      time     of a capture after a change of the masks (PSFs and rendering), and with
               cached PSFs; median and interquartile range
      memory   peak of the tensors of a capture

    Args:
        output: made if missing.
        size: side of the scene made here.
        seed: of the scene made here.
        knobs: settings that are varied. None: all of them.
        base: preset of the other settings.
        reference: preset that errors refer to; balanced is faster on a large scene.
        training: also captures with gradients to the masks.
        repeats: timed runs of each.
        device: cpu, cuda or cuda:N.
        scene: that is captured.
        camera: lens and masks.

    Notes:
        Results are written to FOLDER/trade.json after every point, and at the end a figure to
        trade.png and a table to the screen.

        No setting can lower the error below that of the other settings. With an exact but slow
        base, --base reference, the error of each single setting is measured.

        Times are reliable on an otherwise idle machine. PyTorch uses as many threads as the
        environment variable OMP_NUM_THREADS says; on a busy machine fewer can be much faster.

    Examples:
        kornia-tidy trade                                 all settings, on a generated scene

        kornia-tidy trade --knobs window layers --training

        kornia-tidy trade --image rgb.png --depth depth.png --depth-scale 0.001 --device cuda
    """

    output: Folder = "outputs/trade"
    size: Pixels = 512
    seed: Seed = 0
    knobs: tuple[Annotated[str, one_of(KNOBS)], ...] = ()
    base: Preset = "balanced"
    reference: Preset = "reference"
    training: bool = False
    repeats: Count = 5
    device: Annotated[str, Unit("DEVICE")] = "cpu"
    scene: OwnScene = field(default_factory=OwnScene)
    camera: CameraSettings = field(default_factory=CameraSettings)

    basic: ClassVar = (
        *("output", "size", "seed", "knobs", "base", "reference", "training", "repeats", "device", "image", "depth"),
        *("depth_scale", "masks", "depth_range", "f_number", "focus_distance", "fit_depth"),
    )

    def run(self) -> None:
        """Measure the sweep, write files after every row, and print the table."""
        folder = output_folder(self.output)
        from kornia_tidy.cli.commands.report import progress_bar, scene_in_words, tell, tell_camera
        from kornia_tidy.design.tradeoff.conditions import Conditions
        from kornia_tidy.design.tradeoff.costs import checked_device
        from kornia_tidy.design.tradeoff.files import TradeRun, markdown, write_trade
        from kornia_tidy.design.tradeoff.measure import scene_settings, sweep
        from kornia_tidy.figures.style import require_matplotlib, save_figure
        from kornia_tidy.figures.tradeoff import draw_trade

        require_matplotlib()
        device = checked_device(self.device)
        scene, name = self.scene.read_or_paint(self.size, self.size, NEAR, FAR, self.seed)
        optics = self.camera.optics(scene).to(device)
        image, depth = scene.image.to(device), scene.depth.to(device)
        optics.check_scene(image, depth)  # warns once: the measured captures do not warn
        conditions = Conditions.here_and_now(name, optics, image, self.reference)
        settings = scene_settings(optics, image, depth, self.base, self.knobs or KNOBS)

        tell("scene", f"{name}, {scene_in_words(scene)}")
        tell_camera(optics, self.camera.in_words(optics))
        tell("machine", f"{conditions.device}, {conditions.threads} threads, PyTorch {conditions.torch}")
        tell("settings", str(len(settings)))
        folder.mkdir(parents=True, exist_ok=True)

        rows = []
        steps = sweep(
            optics,
            image,
            depth,
            settings,
            repeats=self.repeats,
            training=self.training,
            reference=self.reference,
        )
        with progress_bar("trade", total=len(settings), unit="setting") as progress:
            for setting in settings:
                step = f"{setting.knob} {setting.value}"
                progress.set_postfix_str(step if rows else f"reference, then {step}")
                rows.append(next(steps))
                write_trade(folder, TradeRun(conditions, tuple(rows)))
                progress.update()

        save_figure(folder / "trade.png", draw_trade(TradeRun(conditions, tuple(rows))))
        print(f"\n{markdown(rows)}\n")
        tell("bold", "no other setting is both faster and closer to the reference")
        tell("wrote", f"{folder / 'trade.png'}: look at this one")
        tell("", str(folder / "trade.json"))
