"""A training run in a folder, with settings, checkpoints, logs and pictures; a stopped run can be resumed."""

from __future__ import annotations

import logging
import os
import signal
import threading
import warnings
from collections.abc import Generator, Mapping
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any, TypeGuard, cast

import lightning.pytorch as pl
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities.warnings import PossibleUserWarning
from torch import Tensor, nn
from torch.utils.data import Dataset

from kornia_tidy.camera.samples import DEPTH_UNIT
from kornia_tidy.camera.saved_parts import below
from kornia_tidy.files import error_prefix, only_here, output_folder
from kornia_tidy.psf.field_bank import FieldBank
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.reconstruction.closed_form_head import ClosedFormHead, with_fine_maps
from kornia_tidy.reconstruction.head_names import CLOSED_FORMS
from kornia_tidy.reconstruction.joint_closed_form import JointClosedFormHead, as_refiner, widened_for_depth
from kornia_tidy.reconstruction.nafnet import deepened
from kornia_tidy.reconstruction.state_file import read_state
from kornia_tidy.reconstruction.trained import (
    fix_window,
    head_prefix,
    load_masks,
    load_weights,
    stored_psfs,
    weights_of,
)
from kornia_tidy.seeds import keyed_seed
from kornia_tidy.training.callbacks import LAST, DrawPictures, SaveCheckpoints, WriteLog
from kornia_tidy.training.checkpoint import SafetensorsIO
from kornia_tidy.training.data_module import SceneData
from kornia_tidy.training.data_sets import PAINTED, make_scenes
from kornia_tidy.training.module import TidyTraining
from kornia_tidy.training.noise_free import NoiseFreeCaptures
from kornia_tidy.training.noisy_crops import NoisyCrops
from kornia_tidy.training.settings import TrainingSettings, differences
from kornia_tidy.training.stored_run import check_stored_run

SETTINGS = "settings.json"
SCENE_SETTINGS = ("data", "root", "size", "depth_range", "seed")  # the scene of a number follows from them
MAY_CHANGE = ("epochs", "patience")  # settings that may differ when a run is resumed


def train(
    settings: TrainingSettings,
    folder: str | os.PathLike[str],
    *,
    resume: bool = False,
    head_from: str | os.PathLike[str] | None = None,
    refiner_from: str | os.PathLike[str] | None = None,
    masks_from: str | os.PathLike[str] | None = None,
    psfs: PSFBank | FieldBank | None = None,
    captures: str | os.PathLike[str] | None = None,
    save_every: int = 100,
    workers: int = 0,
    progress: bool = False,
    **trainer_options: Any,
) -> TidyTraining:
    """Train a system in a folder, from the start or from the last checkpoint in it.

    Args:
        settings: of the system and the run.
        folder: made if missing. It gets ``settings.json``, ``last.safetensors`` (to resume from), ``best.safetensors``
            (weights of the best epoch), ``training.csv``, ``validation.csv``, ``pictures/`` and a TensorBoard log;
            with ``pretrain_epochs`` the same files of that stage in ``pretrain/``.
        resume: resume the run in the folder, if there is one.
        head_from: checkpoint with the network's initial weights, such as one trained with a fixed Fresnel lens. That of
            a network for the image may begin one for image and depth, see
            :func:`~kornia_tidy.reconstruction.joint_closed_form.widened_for_depth`.
        refiner_from: checkpoint with a network for the image, with whose weights the refiner of ``refined`` begins.
        masks_from: checkpoint with the initial masks, such as those of a shipped system, or the state of a camera, such
            as ``camera.safetensors`` of ``kornia-tidy design``.
        psfs: measured ones, for settings of :func:`~kornia_tidy.lab.measured.measured_settings`. A run that
            resumes has them in its checkpoint.
        captures: folder of the noise-free captures, for fixed optics. Runs with the same camera and scenes may
            share it. Default: ``captures/`` in the folder of the run.
        save_every: steps between checkpoints within an epoch.
        workers: processes that load scenes.
        progress: show a progress bar.
        **trainer_options: passed on to Lightning's ``Trainer``, such as ``accelerator="gpu"`` or ``devices=2``.

    Returns:
        The trained module.

    Raises:
        ValueError: if the folder holds another run, one is at work in it, or a checkpoint or the data cannot be used.
        OSError: if the disk is full; the last checkpoint is then intact.
    """
    if refiner_from is not None and not settings.refined:
        raise ValueError("a network begins the refiner of refined, which is not asked for")
    folder = output_folder(folder)
    goes_on = resume and (folder / LAST).exists()
    if settings.learn == "masks" and settings.head not in CLOSED_FORMS and head_from is None and not goes_on:
        raise ValueError(
            f"learn='masks' learns through a network that does not change: begin with that of a trained system, "
            f"head_from, or take a head without weights, {' or '.join(CLOSED_FORMS)}"
        )
    scenes, validation = make_scenes(settings, "train"), make_scenes(settings, "validation")
    folder.mkdir(parents=True, exist_ok=True)
    with only_here(folder, "a training is at work") if _is_first_process() else nullcontext():
        checkpoint = _prepare(folder, settings, resume)
        stored = None if checkpoint is None else _read_run(checkpoint)
        if settings.pretrain_epochs and stored is None:
            first = settings.replace(masks=0, pretrain_epochs=0, epochs=settings.pretrain_epochs)
            train(
                first, folder / "pretrain", resume=resume, head_from=head_from, refiner_from=refiner_from, psfs=psfs,
                save_every=save_every, workers=workers, progress=progress, **trainer_options,
            )  # fmt: skip
            head_from, refiner_from = folder / "pretrain" / LAST, None
        if stored is not None:  # the window was measured on the masks before training
            settings = settings.replace(window=TrainingSettings.read(folder / SETTINGS).window)
            psfs = _same_psfs(psfs, stored_psfs(stored), checkpoint)
        pl.seed_everything(keyed_seed(settings.seed, "start") % 2**32, verbose=False)
        design = stored is None and masks_from is None
        module = TidyTraining.from_settings(settings, psfs=psfs, design=design, progress=progress)
        if settings.data in PAINTED:
            module.optics.notes.told.add(DEPTH_UNIT)  # painted in metres: a far scene does not suggest another unit
        if stored is None:
            _begin(module, settings.window, head_from, refiner_from, masks_from)
        elif settings.fixed_optics:  # the masks may have been designed
            load_weights(stored, module.optics, name=str(checkpoint))
        module.run.write(folder / SETTINGS)
        if settings.fixed_optics:
            place = folder / "captures" if captures is None else Path(captures)
            scenes = _crops("train", scenes, module, place)
            validation = _crops("validation", validation, module, place)
        data = SceneData(scenes, validation, settings.batch, settings.seed, settings.augment, workers)
        with _contained():
            trainer = _trainer(settings, folder, save_every, progress, trainer_options)
            if stored is not None:
                batches = len(data.train_dataloader()) // trainer.world_size  # not yet divided among processes
                with error_prefix(f"cannot resume from {checkpoint}"):
                    check_stored_run(stored, trainer, module, batches)
            _fit(trainer, module, data, checkpoint)
    return module


def _trainer(
    settings: TrainingSettings, folder: Path, save_every: int, progress: bool, options: Mapping[str, Any]
) -> pl.Trainer:
    callbacks: list[pl.Callback] = [
        WriteLog(folder),
        DrawPictures(folder / "pictures"),
        SaveCheckpoints(folder, save_every, patience=settings.patience),  # last, after the logs
    ]
    usual: dict[str, Any] = {
        "max_epochs": settings.epochs,
        "accumulate_grad_batches": settings.accumulate,
        "precision": settings.precision,
        "deterministic": "warn",
        "accelerator": "cpu",
        "devices": 1,
        "log_every_n_steps": 10,
    }
    return pl.Trainer(
        plugins=[SafetensorsIO()],
        callbacks=callbacks + ([pl.callbacks.TQDMProgressBar(leave=False)] if progress else []),
        logger=TensorBoardLogger(folder, name="tensorboard", version=""),
        num_sanity_val_steps=0,
        use_distributed_sampler=False,
        enable_checkpointing=False,
        enable_progress_bar=progress,
        enable_model_summary=False,
        **{**usual, **options},
    )


def _read_run(path: Path) -> dict[str, Any]:
    """Return the state of a run, which has weights at least."""
    state = read_state(path)
    weights_of(state, path)
    return state


def _same_psfs(
    given: PSFBank | FieldBank | None, stored: PSFBank | FieldBank | None, path: Path | None
) -> PSFBank | FieldBank | None:
    """Return the measured PSFs of a run, or raise ``ValueError`` if others are given for going on with it."""
    if given is not None and (stored is None or not torch.equal(given.psfs, stored.psfs)):
        raise ValueError(f"cannot resume from {path}: its PSFs are not those that are given")
    return stored


def _begin(
    module: TidyTraining,
    window: int | None,
    head_from: str | os.PathLike[str] | None,
    refiner_from: str | os.PathLike[str] | None,
    masks_from: str | os.PathLike[str] | None,
) -> None:
    """Load the masks and the weights that a new run begins with; a window of None is measured on the masks."""
    if masks_from is not None:
        load_masks(masks_from, module.optics)
        module.optics.fidelity = module.optics.fidelity.replace(window=window)
        module.settings = module.run = module.run.replace(window=fix_window(module.optics).window)
    if head_from is not None:
        _begin_network(head_from, module.head)
    if refiner_from is not None:
        _begin_refiner(refiner_from, module.head)
    if module.average is not None and (head_from, refiner_from) != (None, None):
        module.average.network.load_state_dict(module.head.state_dict())


def _begin_network(path: str | os.PathLike[str], head: nn.Module) -> None:
    """Load the initial weights of a network, widened from a network for the image, or with fewer blocks or maps.

    PSFs and noise of its closed form stay those of this camera, and so does a refiner where the other has none.
    """
    state = _read_network(path, head)
    weights = below(state["state_dict"], head_prefix(state["state_dict"]))
    kept = ("closed_form.",) if any(name.startswith("refiner.") for name in weights) else ("closed_form.", "refiner.")
    weights |= {name: value for name, value in head.state_dict().items() if name.startswith(kept)}
    if isinstance(head, JointClosedFormHead) and "temperature" not in weights:
        weights = widened_for_depth(weights, head)
    weights = deepened(weights, head)
    if _is_fine(head) and not state["settings"].get("fine"):
        weights = with_fine_maps(weights, head)
    load_weights({**state, "state_dict": _as_head(weights)}, head=head, name=str(path))


def _begin_refiner(path: str | os.PathLike[str], head: nn.Module) -> None:
    """Load the initial weights of the refiner of a network, from a network for the image of as many blocks or fewer."""
    assert isinstance(head, JointClosedFormHead)
    state = _read_network(path, head)
    weights = as_refiner(below(state["state_dict"], head_prefix(state["state_dict"])), head)
    weights = {**{name: value for name, value in head.state_dict().items() if name not in weights}, **weights}
    load_weights({**state, "state_dict": _as_head(weights)}, head=head, name=str(path))


def _read_network(path: str | os.PathLike[str], head: nn.Module) -> dict[str, Any]:
    """Read a checkpoint whose network begins a head. Fine maps are not taken for further depths."""
    state = read_state(path)
    weights_of(state, path)
    if not isinstance(state.get("settings"), Mapping):
        raise ValueError(f"{path} holds no settings of a system")
    if state["settings"].get("fine") and not _is_fine(head):
        raise ValueError(f"the network of {path} takes fine maps, and can begin only one that takes them")
    return state


def _is_fine(head: nn.Module) -> TypeGuard[ClosedFormHead]:
    """Return whether a network takes fine maps."""
    return isinstance(head, ClosedFormHead) and head.closed_form.fine


def _as_head(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {f"head.{name}": value for name, value in weights.items()}


def _crops(split: str, scenes: Dataset[Any], module: TidyTraining, folder: Path) -> NoisyCrops:
    """Return training samples of captures by a module's camera; of validation, whole captures."""
    settings, training = module.run, split == "train"
    about = {"split": split, **{name: getattr(settings, name) for name in SCENE_SETTINGS}}
    if settings.data not in PAINTED:  # of files, the number decides which are drawn
        about["scenes"] = len(cast("Any", scenes))
    captures = NoiseFreeCaptures(scenes, module.optics, folder / split, about)
    return NoisyCrops(captures, module.optics, settings.crop if training else None, settings, gain=training)


def _is_first_process() -> bool:
    """Return whether this is the first process of a run, by the environment variables of torchrun and Lightning."""
    return {os.environ.get(name, "0") for name in ("RANK", "LOCAL_RANK", "NODE_RANK")} == {"0"}


def _fit(trainer: pl.Trainer, module: TidyTraining, data: SceneData, checkpoint: Path | None) -> None:
    """Fit, and raise ``KeyboardInterrupt`` on Ctrl-C; Lightning would exit and ignore further signals."""
    in_main_thread = threading.current_thread() is threading.main_thread()
    handler = signal.getsignal(signal.SIGINT)
    try:
        trainer.fit(module, data, ckpt_path=checkpoint)
    except SystemExit as left:
        if not trainer.interrupted:
            raise
        cause = left.__context__
        raise (cause if isinstance(cause, KeyboardInterrupt) else KeyboardInterrupt) from None
    finally:
        if in_main_thread:
            signal.signal(signal.SIGINT, handler)


def _prepare(folder: Path, settings: TrainingSettings, resume: bool) -> Path | None:
    """Write the settings of a new run; return the checkpoint to resume from, if there is one."""
    path, last = folder / SETTINGS, folder / LAST
    if not resume:
        if last.exists():
            raise ValueError(f"{folder} holds a run already: resume it, or choose another folder")
        settings.write(path)
        return None
    if path.exists():
        stored = TrainingSettings.read(path)
        allowed = {name: getattr(settings, name) for name in MAY_CHANGE}
        window = {"window": stored.window} if settings.window is None else {}  # measured when the run began
        if other := differences(stored.replace(**allowed).as_dict(), settings.replace(**window).as_dict()):
            raise ValueError(f"the run in {folder} has other settings (stored / asked for): {'; '.join(other)}")
    return last if last.exists() else None


@contextmanager
def _contained() -> Generator[None]:
    """Silence Lightning's messages and warnings in a block, and restore torch's determinism flags after it."""
    logger = logging.getLogger("lightning.pytorch")
    level = logger.level
    before = torch.are_deterministic_algorithms_enabled(), torch.is_deterministic_algorithms_warn_only_enabled()
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PossibleUserWarning)
            warnings.filterwarnings("ignore", message=".*LeafSpec", category=FutureWarning)
            yield
    finally:
        logger.setLevel(level)
        torch.use_deterministic_algorithms(before[0], warn_only=before[1])
