"""`kornia-tidy render`: coded captures of a whole data set, written to disk."""

from __future__ import annotations

import hashlib
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from kornia_tidy.choices import BESIDE, SPLITS, SYSTEMS
from kornia_tidy.cli.commands.parser import Given
from kornia_tidy.cli.commands.shared import File, Folder, Noise, measured_system
from kornia_tidy.settings import Count, Processes, Seed, Unit, one_of
from kornia_tidy.training.settings import TrainingSettings

if TYPE_CHECKING:
    from kornia_tidy.camera.tidy_optics import TiDyOptics

OF_SCENES = ("data", "root", "size", "scenes", "validation_scenes", "depth_range", "seed")
OF_CAMERA = (
    "masks", "focal_length", "f_number", "aperture_diameter", "focus_distance", "pixel_pitch", "depth_range", "sigma",
    "fidelity", "window", "stray_light", "compositing", "border",
)  # fmt: skip
OF_MEASURED = ("full_well", "bits")  # known of a camera if its noise was measured
OF_PRESET = ("noise", "fidelity", "compositing", "border")  # options that replace a part of a published system


@dataclass(frozen=True, kw_only=True)
class Files:
    """Files.

    Args:
        beside: pictures beside the coded image.
        float32: images as NPY, not as 16-bit PNG.
        shard_items: tar files of so many captures, not folders. None: a folder for each.
        shard_megabytes: tar files of about this size, judged by the first capture. None: a folder for each.
    """

    beside: tuple[Annotated[str, one_of(BESIDE)], ...] = BESIDE
    float32: bool = False
    shard_items: Count | None = None
    shard_megabytes: Annotated[float, Unit("MB", "megabytes", 0, above=True)] | None = None

    def __post_init__(self) -> None:
        if self.shard_items is not None and self.shard_megabytes is not None:
            raise ValueError("--shard-items and --shard-megabytes say the same: give one of them")


@dataclass(frozen=True, kw_only=True)
class Render:
    r"""Photograph a data set and store its coded captures.

    Every scene of a data set is photographed once through a camera with phase masks, and
    the captures are stored for training. The camera is given by the options below, a
    published system (--preset) or a trained one (--checkpoint).

    FOLDER gets render.json (all settings), the captures, and index.csv once all captures
    are complete:
      000123/coded.png, image.png, depth.npy, mask.png, scene.json     a folder for each scene
      00004.tar with 000123.coded.png, 000123.depth.npy, ...           --shard-...: WebDataset
    Images are PNG of 16 bits, or with --float NPY (rows, columns, RGB) of float32; image is
    the all-in-focus one; depth is NPY of float32 in metres, inf for a sky; the mask is 255
    where depth is known.

    Args:
        output: made if missing.
        jobs: processes that render here.
        noise_seed: of the sensor's noise.
        split: part of the data; all: of an rgbd-folder.
        scenes: number of patches and scenes made here; of files at most, but of their train split all. None: the
            split's.
        preset: a published system; only noise, fidelity, compositing and border can be given beside it. None: a camera
            of the options below.
        checkpoint: best.safetensors of a training; its scenes are the defaults. None: a camera of the options below.
        psfs: the camera whose PSFs kornia-tidy raw calibrate-psf measured, with lens, masks and distances. None:
            computed for lens and masks.
        noise: standard deviation of the read noise in linear light, of full scale; or the file that kornia-tidy raw
            calibrate-noise wrote. None: 0.01.
        files: of the captures.
        settings: of camera and scenes.

    Notes:
        After an interruption the same command continues and gives the same bytes, since captures
        and shards are written atomically. Camera, scene, seed and number determine a capture, for
        any --jobs and any process (on processors of one kind). Processes of torchrun or srun, or
        others with RANK and WORLD_SIZE in their environment, share the work, on one machine or on
        several that share FOLDER. A process that finishes its share renders missing captures of
        others, so that nothing is lost with a process.

        In Python, in a data loader:
          from kornia_tidy.training.coded_datasets.captures import CodedCaptures
          CodedCaptures("captures")[0]        # {"coded", "image", "depth", "mask", "index", "name"}

    Examples:
        Scenes made here, through five random masks, on all of 8 cores:
          kornia-tidy render --scenes 1000 --jobs 8 -o captures

        The scenes that a training was not shown, through the masks it learnt, in shards:
          kornia-tidy render --checkpoint outputs/edof/best.safetensors --split test \
              --shard-megabytes 500 -o captures

        Two machines with 16 processes each:
          torchrun --nnodes 2 --nproc-per-node 16 ... -m kornia_tidy render ... -o captures

        The same by SLURM:
          srun --nodes 2 --ntasks-per-node 16 kornia-tidy render ... -o captures
    """

    output: Folder
    jobs: Processes = 1
    noise_seed: Seed = 0
    split: Annotated[str, one_of(SPLITS)] = "train"
    scenes: Count | None = None
    preset: Annotated[str, one_of(SYSTEMS)] | None = None
    checkpoint: File | None = None
    psfs: File | None = None
    noise: Noise | None = None
    files: Files = field(default_factory=Files)
    settings: Annotated[
        dict[str, Any],
        Given(
            TrainingSettings,
            only=(*(name for name in OF_CAMERA if name != "sigma"), "data", "root", "size", "seed"),
        ),
    ] = field(default_factory=dict)

    basic: ClassVar = (
        *("output", "jobs", "noise_seed", "split", "scenes", "preset", "checkpoint", "noise", "masks", "depth_range"),
        *("f_number", "fidelity", "data", "root", "size", "seed", "float32", "shard_items", "shard_megabytes"),
    )

    def __post_init__(self) -> None:
        if self.preset is not None and self.checkpoint is not None:
            raise ValueError("--preset and --checkpoint are two cameras: give one of them")

    def run(self) -> None:
        """Render the data set, and print a summary."""
        from kornia_tidy.cli.commands.report import progress_bar, tell, tell_camera
        from kornia_tidy.training.coded_datasets.layout import Layout
        from kornia_tidy.training.coded_datasets.render_scenes import (
            place_among_processes,
            render_scenes,
            shard_items_within,
        )
        from kornia_tidy.training.data_sets import make_scenes

        rank, world = place_among_processes()
        optics, settings, camera_from = self._camera()
        scenes = make_scenes(settings, self.split, self.scenes)
        layout = Layout(self.files.beside, self.files.float32, self.files.shard_items)
        if self.files.shard_megabytes is not None:
            size = int(self.files.shard_megabytes * 1e6)
            items = shard_items_within(optics, scenes, layout, size, self.noise_seed)
            layout = Layout(layout.beside, layout.floats, items)
        values = settings.as_dict()
        made_from = {**camera_from, "split": self.split, "scenes": {name: values[name] for name in OF_SCENES}}
        who = f", process {rank + 1} of {world}" if world > 1 else ""
        if rank == 0:
            tell_camera(optics)
            tell("scenes", f"{len(scenes)} of {settings.data!r}, {self.split}")  # ty: ignore[invalid-argument-type]
        start = time.perf_counter()
        with progress_bar(f"render{who}", unit="scene", disable=None if rank == 0 else True) as bar:

            def each(done: int, total: int) -> None:
                if bar.total is None:
                    bar.total, bar.initial, bar.n = total, done - 1, done - 1
                bar.update(done - bar.n)

            try:
                made, found = render_scenes(
                    optics, scenes, self.output, layout, seed=self.noise_seed, jobs=self.jobs, rank=rank, world=world,
                    take_over=True, made_from=made_from, each=each,
                )  # fmt: skip
            except KeyboardInterrupt:
                bar.close()
                tell("stopped", "the same command goes on")
                raise
        seconds = time.perf_counter() - start
        before = f", {found} were there" if found else ""
        tell("wrote", f"{self.output}{who}: {made} captures in {seconds:.1f} s, {made / seconds:.2f} a second{before}")

    def _camera(self) -> tuple[TiDyOptics, TrainingSettings, dict[str, Any]]:
        """Return the camera, the settings of its scenes, and the origin of the camera."""
        import torch

        from kornia_tidy.camera.tidy_optics import TiDyOptics
        from kornia_tidy.files import read_bytes
        from kornia_tidy.reconstruction.trained import build_optics, load_trained

        measured, psfs = measured_system(self.psfs, self.noise, self.settings)
        given = self.settings | measured
        if self.scenes is not None:
            given |= {"scenes": self.scenes, "validation_scenes": self.scenes}
        own = [name for name in OF_CAMERA if name in given]
        asked = ["psfs"] * (psfs is not None) + ["noise" if name == "sigma" else name for name in own]
        allowed, source = (OF_PRESET, "--preset") if self.preset else ((), "--checkpoint")
        if (self.preset or self.checkpoint) and (wrong := [name for name in asked if name not in allowed]):
            raise ValueError(f"--{wrong[0].replace('_', '-')} does not go with {source}, which has its own")
        if self.checkpoint:
            system = load_trained(self.checkpoint)
            digest = hashlib.sha256(read_bytes(self.checkpoint)).hexdigest()
            trained = TrainingSettings.of(system)
            if given.get("data", trained.data) != trained.data:
                given = {"root": None, **given}  # the stored folder belongs to the other data set
            return system.optics, trained.replace(**given), {"checkpoint": str(self.checkpoint), "sha256": digest}
        settings = TrainingSettings().replace(**given)
        if not self.preset:
            options = {name: getattr(settings, name) for name in (*OF_CAMERA, *(n for n in OF_MEASURED if n in given))}
            made_from: dict[str, Any] = {"options": options}
            if self.psfs is not None:
                made_from["psfs"] = hashlib.sha256(read_bytes(self.psfs)).hexdigest()
            return build_optics(settings, psfs), settings, made_from
        overrides: dict[str, Any] = {name: given[name] for name in own if name != "sigma"}
        if self.noise is not None:
            overrides["sensor"] = settings.sensor()
        noise = torch.Generator().manual_seed(settings.seed)
        optics = TiDyOptics.from_preset(self.preset, generator=noise, **overrides)
        seen = settings.replace(depth_range=getattr(optics.camera, "depth_range", None))
        return optics, seen, {"preset": self.preset, "options": {name: given[name] for name in own}}
