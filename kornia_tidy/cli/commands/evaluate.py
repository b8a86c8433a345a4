"""`kornia-tidy evaluate`: error measures of a trained system on test scenes."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Annotated, Any

from kornia_tidy.cli.commands.parser import Argument, Given
from kornia_tidy.cli.commands.shared import File, Folder, Noise, read_noise
from kornia_tidy.files import output_folder
from kornia_tidy.settings import Count, CountOrNone, Seed
from kornia_tidy.training.settings import SceneSettings, TrainingSettings


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Measure the errors of a trained system.

    A trained camera and network, or the closed form of a camera that was measured, is
    evaluated on scenes that were not used for training. With --psfs and --noise the
    captures are those of the measured camera, and a network that deconvolves them uses its
    PSFs. FOLDER gets results.csv (one line per scene), summary.json (means and settings),
    and pictures of the first scenes: capture, estimates, ground truth, and errors times 3.

    image_rmse, image_psnr (dB), image_ssim: of the image in [0, 1], without clipping.
    depth_rmse: of normalised inverse depth, 0 at the far and 1 at the near end of the
      camera's range; depth_rmse_radians: of the corresponding defocus.
    depth_rmse_metres, depth_abs_rel, depth_log10, depth_delta1 to 3 (within 1.25, 1.25^2 and
      1.25^3): of depth in metres, over pixels of known depth within the camera's range. A
      range that reaches to infinity ends at 32 times its near end. Estimates are clamped to
      the range. depth_counted: share of the pixels evaluated.

    Data, folder and size of the scenes are those of the training, if not given. The scenes
    are the data's own for testing: a tenth of an rgbd-folder that was trained on, and all
    of another.

    Args:
        system: best.safetensors or last.safetensors of a run; a shipped system; or, with PSFs, a closed form, which
            needs no training.
        output: made if missing. None: evaluation, beside the system.
        psfs: file of kornia-tidy raw calibrate-psf; the measured camera takes the captures. None: those of the
            system's camera.
        noise: standard deviation of the read noise in linear light, of full scale; or the file that kornia-tidy raw
            calibrate-noise wrote. None: that of the training.
        scenes: their number. None: the whole test split; 32 of generated scenes.
        pictures: scenes drawn.
        noise_seed: of the sensor.
        settings: of the scenes.

    Notes:
        Shipped systems: joint-uncertain, edof-5, edof-designed, edof-flat.
        Closed forms: tikhonov, tikhonov-bilateral, wiener, wiener-bilateral, any-camera.

    Examples:
        kornia-tidy evaluate outputs/edof/best.safetensors
        kornia-tidy evaluate edof-5 --data dead-leaves --scenes 8 -o outputs/edof-5
        kornia-tidy evaluate wiener-bilateral --psfs bank.safetensors --noise iso800.json -o outputs/mine
    """

    system: Annotated[str, Argument("SYSTEM")]
    output: Folder | None = None
    psfs: File | None = None
    noise: Noise | None = None
    scenes: Count | None = None
    pictures: CountOrNone = 8
    noise_seed: Seed = 0
    settings: Annotated[dict[str, Any], Given(SceneSettings, only=("data", "root", "size"), stored=True)] = field(
        default_factory=dict
    )

    def run(self) -> None:
        """Evaluate the system, write results and pictures, and print a summary."""
        folder = output_folder(self.output or Path(self.system).parent / "evaluation")
        from kornia_tidy.cli.commands.report import progress_bar, tell
        from kornia_tidy.lab.named_system import load_system
        from kornia_tidy.reconstruction.tasks import MAPS
        from kornia_tidy.training.data_sets import make_scenes
        from kornia_tidy.training.evaluation import SceneResult, draw_scene, evaluate, metric_range, table, write_table

        sensor, _ = read_noise(self.noise)
        system = load_system(self.system, self.psfs, sensor)
        trained = TrainingSettings.of(system)
        settings = trained.replace(**self.settings)
        if settings.data != trained.data and "root" not in self.settings:
            settings = settings.replace(root=None)  # the stored folder belongs to the other data set
        seen = (settings.data, _place(settings.root)) == (trained.data, _place(trained.root))
        split = "test" if seen or settings.data != "rgbd-folder" else "all"
        scenes = make_scenes(settings, split, self.scenes)
        tell("system", f"{settings.task}, {settings.masks} masks, head {settings.head!r}, {system.step} steps")
        folder.mkdir(parents=True, exist_ok=True)
        numbers = count()
        with progress_bar("evaluate", unit="scene") as progress:

            def each(result: SceneResult) -> None:
                if next(numbers) < self.pictures:
                    draw_scene(folder, result)
                progress.update()

            rows = evaluate(system, scenes, self.noise_seed, each)
        about = {"checkpoint": str(self.system), "step": system.step, "noise_seed": self.noise_seed, "split": split}
        about = {**about, "psfs": self.psfs, "noise": self.noise}
        near, far = metric_range(settings.camera())
        write_table(folder, rows, {**about, "metres_counted": [near, far], "settings": settings.as_dict()})
        for line in table(rows):
            print(line)
        if "depth" in MAPS[settings.task]:
            tell("metres", f"pixels count whose depth is known, from {near:.4g} to {far:.4g} m")
        tell("wrote", f"{folder / 'results.csv'}, {len(rows)} scenes")
        tell("", str(folder / "summary.json"))


def _place(root: str | None) -> Path | None:
    return None if root is None else Path(root).resolve()
