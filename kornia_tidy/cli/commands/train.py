"""`kornia-tidy train`: joint training of phase masks and a reconstruction network."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from kornia_tidy.cli.commands.parser import Given
from kornia_tidy.cli.commands.shared import OF_SENSOR, File, Folder, Noise, measured_system, refuse_with_psfs
from kornia_tidy.settings import Count, Processes, Unit, one_of
from kornia_tidy.training.settings import LEARN, TrainingSettings, usual_settings

if TYPE_CHECKING:
    from kornia_tidy.psf.field_bank import FieldBank
    from kornia_tidy.psf.psf_bank import PSFBank

CURVE = "learning_curve.png"
Checkpoint = Annotated[str, Unit("CHECKPOINT")]


@dataclass(frozen=True, kw_only=True)
class Machine:
    """Machine.

    Args:
        accelerator: where the network learns.
        devices: processes that learn together.
        workers: processes that load scenes.
        save_every: steps between checkpoints in an epoch.
    """

    accelerator: Annotated[str, one_of(("cpu", "gpu"))] = "cpu"
    devices: Annotated[int, Unit("N", "", 1, 1024)] = 1
    workers: Processes = 0
    save_every: Count = 100


@dataclass(frozen=True, kw_only=True)
class Train:
    r"""Learn masks and network together.

    The network reads the captures of the masks' camera. It gives an image in focus
    everywhere (edof), a depth map (depth), or both (joint). With --learn network it
    learns behind fixed masks; each scene is then rendered once, and a step takes only the network's time. FOLDER gets
    checkpoints, scores and pictures; --resume goes on after an interruption.

    Args:
        output: made if missing.
        resume: go on with the run in FOLDER, if there is one, with its settings.
        head_from: begin with the network of another run. None: new weights.
        refiner_from: begin the second network of refined with that of a run for the image only. None: new weights.
        masks_from: begin with the masks of another run, or of a camera that was saved. None: by start.
        design_from: lens, depth range and masks that kornia-tidy design recommends in FOLDER; options given here go
            first. None: no design.
        captures: noise-free captures, which runs may share, for learn network and refiner. None: in the run's folder.
        psfs: the camera whose PSFs kornia-tidy raw calibrate-psf measured, with lens, masks and distances. None:
            computed for lens and masks.
        noise: standard deviation of the read noise in linear light, of full scale; or the file that kornia-tidy raw
            calibrate-noise wrote. None: 0.01.

    Notes:
        FOLDER gets settings.json, last.safetensors (to go on from), best.safetensors (weights of
        the best epoch), training.csv, validation.csv, learning_curve.png, which tells at which
        step the score levels off (with matplotlib), pictures of masks, PSFs and estimates in
        pictures/, and a log for `tensorboard --logdir FOLDER`. After Ctrl-C or a power failure
        --resume continues with the stored settings, and ends with the same weights as an
        uninterrupted run (to the bit on one CPU process).

        Defaults of --learn network, which are for a CPU:
          --head nafnet --closed-form --width 16 --size 256 --scenes 1000 --validation-scenes 24
          --batch 4 --lr 0.002 --schedule cosine --loss charbonnier --epochs 24

    Examples:
        The paper's extended depth of field, on scenes made here:
          kornia-tidy train --task edof --masks 5 --pretrain-epochs 300 -o outputs/edof

        A first look, in minutes on a CPU, for which the paper's network is too large:
          kornia-tidy train --task depth --head plain --size 96 --scenes 64 --batch 4 --epochs 5 \
            -o outputs/look

        Extended depth of field in minutes on a CPU, from masks that are designed first:
          kornia-tidy train --task edof --start "focal sweep" --design 120 --refocus 5 --width 8 \
            --residual --size 128 --scenes 480 --batch 6 --lr 2e-3 --lr-metres 6e-8 --epochs 10 \
            -o outputs/swept

        A network behind five designed masks, in hours on a CPU; then both together:
          kornia-tidy train --learn network --start "focal sweep" --design 120 -o outputs/network
          kornia-tidy train --learn both --start "focal sweep" --design 120 --head nafnet --width 16 \
            --closed-form --head-from outputs/network/best.safetensors --lr 2e-4 --size 128 --batch 4 \
            -o outputs/both

        Masks again, for a network that has learnt, at a rate for masks that are good already:
          kornia-tidy train --learn masks --start "focal sweep" --lr-metres 4e-9 --batch 2 --epochs 2 \
            --masks-from outputs/network/best.safetensors --head-from outputs/network/best.safetensors \
            -o outputs/masks

        A network for the camera that `kornia-tidy design` recommends, and one for a lens without
        masks at f/48, both for 500 to 57,000 electrons of white at f/17.6 in the same time:
          kornia-tidy train --learn network --design-from outputs/design --electrons 500 57000 \
            -o outputs/designed
          kornia-tidy train --learn network --masks 1 --start flat --f-number 48 --focus-distance 0.74 \
            --electrons 500 57000 -o outputs/flat

        A network for a camera that was measured:
          kornia-tidy train --learn network --psfs bank.safetensors --noise iso800.json -o outputs/mine

        Depth with its uncertainty, and the image, in some minutes on a CPU:
          kornia-tidy train --task joint --start "like fishers" --depth-classes 32 --refocus 11 --width 8 \
            --size 128 --scenes 480 --batch 6 --lr 2e-3 --lr-metres 6e-8 --epochs 10 -o outputs/uncertain

        The paper's patches, by the loss of PhaseCam3D:
          kornia-tidy train --task depth --data flying-things-patches --root FlyingThings3D \
            --loss phasecam3d --border valid -o outputs/depth

        Goes on after an interruption; a longer run may be asked for:
          kornia-tidy train --resume --epochs 400 -o outputs/edof
    """

    output: Folder = "outputs/train"
    resume: bool = False
    head_from: Checkpoint | None = None
    refiner_from: Checkpoint | None = None
    masks_from: File | None = None
    design_from: Folder | None = None
    captures: Folder | None = None
    settings: Annotated[dict[str, Any], Given(TrainingSettings, but=OF_SENSOR)] = field(default_factory=dict)
    psfs: File | None = None
    noise: Noise | None = None
    machine: Machine = field(default_factory=Machine)

    basic: ClassVar = (
        *("output", "resume", "task", "learn", "masks", "start", "head", "width", "data", "root", "size"),
        *("scenes", "depth_range", "f_number", "noise", "epochs", "batch", "lr", "seed", "accelerator"),
    )

    def run(self) -> None:
        """Train or resume a run, and print its results."""
        from kornia_tidy.training.lightning_extra import require_lightning

        require_lightning()
        import torch

        from kornia_tidy.cli.commands.report import tell
        from kornia_tidy.training.callbacks import BEST, LAST
        from kornia_tidy.training.design_folder import designed_camera
        from kornia_tidy.training.run import SETTINGS, train

        machine, folder = self.machine, Path(self.output)
        if machine.accelerator == "gpu" and not (torch.cuda.is_available() or torch.backends.mps.is_available()):
            raise ValueError("--accelerator gpu: PyTorch finds no GPU here")
        if (started := os.environ.get("WORLD_SIZE", str(machine.devices))) != str(machine.devices):
            raise ValueError(
                f"--devices must be the number of processes that torchrun started, WORLD_SIZE={started}, got "
                f"{machine.devices}"
            )
        settings, psfs = self._settings(folder / SETTINGS)
        if self.captures is not None and not settings.fixed_optics:
            raise ValueError(f"--captures is for --learn network or refiner, got --learn {settings.learn}")
        masks_from = self.masks_from
        if self.design_from is not None and masks_from is None and settings.masks:
            masks_from = designed_camera(self.design_from)
        say = tell if os.environ.get("LOCAL_RANK", "0") == "0" else lambda *_: None  # only one process prints
        many = {"strategy": "ddp"} if machine.devices > 1 else {}
        say("task", f"{settings.task}, {settings.masks} masks, head {settings.head!r}, data {settings.data!r}")
        say("learn", LEARN[settings.learn])
        goes_on = self.resume and (folder / LAST).exists()
        say("run", f"{folder}, {'goes on' if goes_on else 'new'}, {settings.epochs} epochs")
        try:
            module = train(
                settings,
                folder,
                resume=self.resume,
                head_from=self.head_from,
                refiner_from=self.refiner_from,
                masks_from=masks_from,
                psfs=psfs,
                captures=self.captures,
                save_every=machine.save_every,
                workers=machine.workers,
                progress=sys.stderr.isatty(),
                accelerator=machine.accelerator,
                devices=machine.devices,
                **many,
            )
        except KeyboardInterrupt:
            say("stopped", f"--resume -o {folder} goes on from the last checkpoint")
            raise
        finally:
            drawn = _draw_curve(folder)
        say("camera", module.optics.extra_repr())
        say("wrote", f"{folder / BEST}: evaluate this one")
        for name in (LAST, SETTINGS, "training.csv", "validation.csv", *drawn, "pictures"):
            say("", str(folder / name))

    def _settings(self, stored: Path) -> tuple[TrainingSettings, PSFBank | FieldBank | None]:
        """Return the settings of the run: stored ones with the given changes, or usual ones; and measured PSFs."""
        from kornia_tidy.training.design_folder import designed_settings

        measured, psfs = measured_system(self.psfs, self.noise, self.settings)
        if psfs is not None:
            refuse_with_psfs(name for name in ("design_from", "masks_from") if getattr(self, name) is not None)
        given = {**self.settings, **measured}
        if self.design_from is not None:
            given = {**designed_settings(self.design_from), **given}
        if self.resume and stored.exists():
            return TrainingSettings.read(stored).replace(**given), psfs
        return TrainingSettings(**{**usual_settings(given), **given}), psfs


def _draw_curve(folder: Path) -> list[str]:
    """Draw the learning curve of a run and return its file, if matplotlib is there and an epoch was validated."""
    from kornia_tidy.figures.learning_curve import draw_learning_curve

    try:
        figure = draw_learning_curve(folder)
    except (ImportError, OSError, ValueError):
        return []
    figure.savefig(folder / CURVE, dpi=150)
    return [CURVE]
