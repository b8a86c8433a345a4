"""Everything that decides a training run, as plain values that a JSON file holds."""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Self

from kornia_tidy.checks import check_choice, check_positive
from kornia_tidy.fidelity import Fidelity
from kornia_tidy.files import read_json, write_bytes
from kornia_tidy.inference.tasks import LOSSES, MAPS
from kornia_tidy.masks.initial_heights import STARTS
from kornia_tidy.optics.thin_lens import ThinLensCamera
from kornia_tidy.render.borders import BORDERS
from kornia_tidy.render.compositing import COMPOSITING

SCHEDULES = ("constant", "cosine")
MOST = 1024  # masks, or depths to refocus to: more would take days
PRECISIONS = ("32-true", "bf16-mixed", "16-mixed")  # of the network; optics always run in float32


@dataclass(frozen=True)
class TrainingSettings:
    """A training run. The defaults are the paper's, with our camera; see :func:`kornia_tidy.training.run.train`.

    Args:
        task: ``"edof"`` (all-in-focus image), ``"depth"`` or ``"joint"``.
        masks: number K of learnable masks; 0 is a fixed Fresnel lens.
        start: heights that masks have at first, the first K of those that
            :func:`~kornia_tidy.masks.initial_heights.initial_heights` knows by this name; of noise as many as wanted.
        design: gradient steps that bring the masks near the best for the task before training, without scenes or
            network, see :func:`~kornia_tidy.training.designed.design_masks`; only for edof. 0: none. A fixed lens
            stays as it is.
        focal_length: of the lens in metres.
        pixel_pitch: of the sensor in metres.
        depth_range: nearest and farthest depth in metres for which focus and aperture are chosen. None: the default
            lens, from 0.298 m to infinity.
        sigma: read noise of the sensor, of full scale.
        fidelity: the preset that PSFs are computed at.
        window: side of the PSFs in pixels. None: measured when the run begins, then fixed.
        compositing: see :class:`~kornia_tidy.TiDyOptics`.
        color_space: see there. None: its default.
        border: see there.
        head: name of the network, see :data:`kornia_tidy.inference.heads.HEADS`.
        width: channels of its first level. None: its default; the paper's attention U-Net has 64.
        residual: the network estimates what is to be added to the capture; for tasks with an image.
        refocus: number of depths that the capture is refocused to before the network sees it, see
            :class:`~kornia_tidy.reconstruction.Refocused`. 0: the network sees the capture alone.
        data: name of the data, see :data:`kornia_tidy.training.data_sets.SCENES`.
        root: folder of the data, where they are files. None: ``data/NAME``.
        size: side of the scenes in pixels; larger ones are cropped, at random for training.
        scenes: number of training scenes, where the data have no number of their own.
        validation_scenes: number of scenes that tell how training goes, at most.
        augment: flip scenes and vary their brightness by 0.8 to 1.1, as PhaseCam3D does.
        lr: learning rate of the network.
        lr_metres: learning rate of the masks in metres of height.
        schedule: of both rates: ``"constant"``, or ``"cosine"``: up in a tenth of the steps, then down to zero.
        batch: scenes in a batch.
        accumulate: batches in a step of the optimiser.
        epochs: passes over the data.
        pretrain_epochs: passes before these in which the network alone learns, behind a fixed Fresnel lens. The paper
            takes 300 for the tasks edof and joint.
        patience: stop after so many epochs without improvement. None: never.
        ema: decay of the moving average of the network. 0: none.
        depth_weight: of the depth loss in the joint task.
        image_weight: of the image loss in the joint task.
        loss: name of the loss, see :data:`kornia_tidy.inference.tasks.LOSSES`.
        precision: of the network.
        seed: everything random follows from it.

    Raises:
        ValueError: if a value is not allowed.

    Example:
        >>> TrainingSettings(task="depth", masks=5).lr_metres
        1e-08
    """

    task: str = "edof"
    masks: int = 5
    start: str = "noise"
    design: int = 0
    focal_length: float = 50e-3
    pixel_pitch: float = 8e-6
    depth_range: tuple[float, float] | None = None
    sigma: float = 0.01
    fidelity: str = "balanced"
    window: int | None = None
    compositing: str = "gather"
    color_space: str | None = None
    border: str = "reflect"
    head: str = "attention-unet"
    width: int | None = None
    residual: bool = False
    refocus: int = 0
    data: str = "dead-leaves"
    root: str | None = None
    size: int = 278
    scenes: int = 5077
    validation_scenes: int = 64
    augment: bool = True
    lr: float = 1e-4
    lr_metres: float = 1e-8
    schedule: str = "constant"
    batch: int = 32
    accumulate: int = 1
    epochs: int = 300
    pretrain_epochs: int = 0
    patience: int | None = None
    ema: float = 0.999
    depth_weight: float = 1.0
    image_weight: float = 1.0
    loss: str = "mse"
    precision: str = "32-true"
    seed: int = 0

    def __post_init__(self) -> None:
        _check_types(self)
        check_choice("task", self.task, tuple(MAPS))
        check_choice("loss", self.loss, tuple(LOSSES))
        check_choice("precision", self.precision, PRECISIONS)
        check_choice("schedule", self.schedule, SCHEDULES)
        check_choice("compositing", self.compositing, tuple(COMPOSITING))
        check_choice("border", self.border, BORDERS)
        Fidelity.preset(self.fidelity)
        for name in ("focal_length", "pixel_pitch", "lr", "lr_metres"):
            check_positive(name, getattr(self, name))
        least = {"masks": 0, "size": 1, "scenes": 1, "validation_scenes": 1, "batch": 1, "accumulate": 1, "epochs": 1}
        for name, lowest in {**least, "pretrain_epochs": 0, "refocus": 0, "design": 0, "seed": 0}.items():
            value = getattr(self, name)
            if not isinstance(value, int) or value < lowest:
                raise ValueError(f"{name} must be a whole number of at least {lowest}, got {value!r}")
        for name in ("masks", "refocus"):
            if getattr(self, name) > MOST:
                raise ValueError(f"{name} must be {MOST} or fewer, got {getattr(self, name)}")
        check_choice("start", self.start, STARTS)
        if self.start != "noise" and self.masks > 5:
            raise ValueError(f"start {self.start!r} has five masks, got masks={self.masks}; 'noise' has any number")
        if self.residual and "image" not in MAPS[self.task]:
            raise ValueError(f"residual adds the capture to the image, and the task {self.task!r} estimates none")
        if self.design and self.task != "edof":
            raise ValueError(f"masks can be designed before training for the task 'edof' only, got {self.task!r}")
        if self.patience is not None and self.patience < 1:
            raise ValueError(f"patience must be 1 epoch or more, got {self.patience}")
        if not 0 <= self.ema < 1:
            raise ValueError(f"ema must be in [0, 1), got {self.ema}")
        if self.depth_range is not None:
            object.__setattr__(self, "depth_range", tuple(self.depth_range))  # JSON has no tuples

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some values changed."""
        return replace(self, **changes)

    def camera(self) -> ThinLensCamera:
        """Return the lens and the sensor's pixels."""
        lens: dict[str, Any] = {"focal_length": self.focal_length, "pixel_pitch": self.pixel_pitch}
        return (
            ThinLensCamera(**lens) if self.depth_range is None else ThinLensCamera.for_scene(self.depth_range, **lens)
        )

    def as_dict(self) -> dict[str, Any]:
        """Return the settings as a dictionary of plain values."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Return the settings of a dictionary.

        Raises:
            ValueError: if it is no dictionary, a name is unknown, or a value is not allowed or of another type.
        """
        if not isinstance(values, Mapping):
            raise ValueError(f"settings must be values by name, got {values!r:.80}")
        known = {field.name for field in fields(cls)}
        if unknown := sorted(set(values) - known):
            raise ValueError(f"settings hold unknown names: {', '.join(unknown)[:200]}")
        return cls(**values)

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the settings as JSON."""
        write_bytes(path, (json.dumps(self.as_dict(), indent=2) + "\n").encode())

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Self:
        """Read settings written as JSON.

        Raises:
            FileNotFoundError: if there is no file.
            ValueError: if it is not JSON of settings.
        """
        values = read_json(path)
        try:
            return cls.from_dict(values)
        except ValueError as error:
            raise ValueError(f"cannot read {path}: {error}") from error


def _check_types(settings: TrainingSettings) -> None:
    """Refuse values of other types, as a damaged file may hold; whole numbers do where others are meant."""
    for field in fields(settings):
        name, value = field.name, getattr(settings, field.name)
        if value is None and "None" in str(field.type):
            continue
        kind = str(field.type).split(" | ")[0]
        if not _is_a(kind, value):
            raise ValueError(f"{name} must be {_KINDS[kind]}, got {value!r:.80}")


_KINDS = {
    "str": "a text",
    "bool": "true or false",
    "int": "a whole number",
    "float": "a finite number",
    "tuple[float, float]": "two numbers",
}


def _is_a(kind: str, value: Any) -> bool:
    if kind == "tuple[float, float]":
        return isinstance(value, (tuple, list)) and len(value) == 2 and all(_is_number(end) for end in value)
    if kind == "float":
        return _is_number(value) and math.isfinite(value)
    if kind == "int":
        return isinstance(value, int) and not isinstance(value, bool)
    return isinstance(value, {"str": str, "bool": bool}[kind])


def _is_number(value: Any) -> bool:
    """Of a size that floats have, as JSON's whole numbers have no end; or infinity."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    return abs(value) <= sys.float_info.max or value == math.inf


def differences(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """Return the entries in which two descriptions differ, each as ``name (one / other)``.

    Example:
        >>> differences({"masks": 5, "task": "edof"}, {"masks": 3, "task": "edof"})
        ['masks (5 / 3)']
    """
    names = dict.fromkeys([*one, *other])
    return [f"{n} ({one.get(n)} / {other.get(n)})" for n in names if one.get(n) != other.get(n)]
