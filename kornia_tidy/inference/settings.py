"""Settings of a trained system: plain values, stored as JSON, from which its camera and network are built."""

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
from kornia_tidy.inference.heads import CLOSED_FORMS, check_head, check_repeats
from kornia_tidy.inference.tasks import MAPS
from kornia_tidy.masks.initial_heights import STARTS
from kornia_tidy.optics.thin_lens import FASTEST, ThinLensCamera
from kornia_tidy.psf.psf_bank import STRAY_LIGHT
from kornia_tidy.reconstruction.closed_form import INVERSES
from kornia_tidy.reconstruction.head import check_count
from kornia_tidy.render.borders import BORDERS
from kornia_tidy.render.compositing import COMPOSITING
from kornia_tidy.sensor.noise import SensorNoise

Distance = float  # metres, may be infinite
MOST = 1024  # masks, their pixels along a side, blocks, or depths to refocus to: more would take days


@dataclass(frozen=True, kw_only=True)
class SystemSettings:
    """Camera and network of a trained system. The defaults are the paper's, with our camera.

    Settings of a run are in :class:`~kornia_tidy.training.settings.TrainingSettings`.

    Args:
        task: ``"edof"`` (all-in-focus image), ``"depth"`` or ``"joint"``.
        masks: number K of learnable masks; 0 is a fixed Fresnel lens.
        start: initial heights of the masks by name, the first K of
            :func:`~kornia_tidy.masks.initial_heights.initial_heights`; ``"noise"`` gives any number of masks.
        mask_size: pixels along a side of a mask; 20 of 23 span the aperture.
        focal_length: of the lens in metres.
        pixel_pitch: of the sensor in metres.
        depth_range: nearest and farthest depth in metres for which focus and aperture are chosen. None: the default
            lens, from 0.298 m to infinity.
        f_number: focal length over the diameter of the aperture. None: f/17.6, or as chosen for ``depth_range``.
        focus: distance in focus in metres; may be ``inf``. None: the middle of the range of inverse depth.
        measured: PSFs were measured, see :func:`~kornia_tidy.inference.measured.measured_settings`. Checkpoints hold
            them, and ``masks`` take no part.
        sigma: read noise of the sensor, in units of full scale.
        full_well: electrons at full scale, for shot noise. None: no shot noise.
        bits: bits of the sensor's converter. None: no rounding.
        fidelity: name of the preset by which PSFs are computed.
        window: side of the PSFs in pixels. None: measured on the initial masks, then fixed.
        stray_light: what becomes of the light outside the window, see :class:`~kornia_tidy.fidelity.Fidelity`. None: as
            the preset has it.
        compositing: see :class:`~kornia_tidy.TiDyOptics`.
        color_space: as for :class:`~kornia_tidy.TiDyOptics`. None: its default.
        border: as for :class:`~kornia_tidy.TiDyOptics`.
        head: name of the network, see :data:`kornia_tidy.inference.heads.HEADS`; of a closed form alone,
            one of :data:`~kornia_tidy.inference.heads.CLOSED_FORMS`; or the import path of a class, ``module:Class``.
        width: channels of the network's first level. None: its default; the paper's attention U-Net has 64.
        repeats: factor of the number of blocks of the head ``"nafnet"``, see
            :class:`~kornia_tidy.reconstruction.NAFNet`.
        residual: the network estimates the difference between image and capture; for tasks with an image.
        closed_form: the network takes restorations in closed form beside the capture, and its image is added to the
            best of them, see :class:`~kornia_tidy.reconstruction.ClosedFormHead`.
        inverse: filter of these restorations, ``"tikhonov"`` or ``"wiener"``, see
            :class:`~kornia_tidy.reconstruction.closed_form.ClosedForm`.
        refocus: number of depths that the capture is refocused to before it enters the network, see
            :class:`~kornia_tidy.reconstruction.Refocused`. 0: none.
        fine: the capture is refocused twice to each of these depths, the second time sharper and with more noise; for
            ``closed_form`` without ``depth_classes``, see :class:`~kornia_tidy.reconstruction.closed_form.ClosedForm`.
        depth_classes: classes of a distribution of depth, for the task ``"joint"``. It begins as the likelihood of
            ``refocus`` depths in closed form; the image begins as with ``closed_form``, see
            :class:`~kornia_tidy.reconstruction.JointClosedFormHead`, or without it as the capture deconvolved for each
            of these depths, blended by the distribution, see :class:`~kornia_tidy.reconstruction.LayeredJointHead`.
            0: one depth a pixel without uncertainty.
        refined: a second network of the same kind refines the image, where ``depth_classes`` and ``closed_form`` are
            given, see :class:`~kornia_tidy.reconstruction.JointClosedFormHead`.
        seed: of the initial masks, and of everything random in a run.

    Raises:
        ValueError: if a value is not allowed.

    Example:
        >>> SystemSettings(task="depth", masks=2).camera().focal_length
        0.05
    """

    task: str = "edof"
    masks: int = 5
    start: str = "noise"
    mask_size: int = 23
    focal_length: float = 50e-3
    pixel_pitch: float = 8e-6
    depth_range: tuple[float, float] | None = None
    f_number: float | None = None
    focus: Distance | None = None
    measured: bool = False
    sigma: float = 0.01
    full_well: float | None = None
    bits: int | None = None
    fidelity: str = "balanced"
    window: int | None = None
    stray_light: str | None = None
    compositing: str = "gather"
    color_space: str | None = None
    border: str = "reflect"
    head: str = "attention-unet"
    width: int | None = None
    repeats: int = 1
    residual: bool = False
    closed_form: bool = False
    inverse: str = "tikhonov"
    refocus: int = 0
    fine: bool = False
    depth_classes: int = 0
    refined: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        _check_types(self)
        check_choice("task", self.task, tuple(MAPS))
        check_choice("compositing", self.compositing, tuple(COMPOSITING))
        check_choice("border", self.border, BORDERS)
        Fidelity.preset(self.fidelity)
        if self.stray_light is not None:
            check_choice("stray_light", self.stray_light, STRAY_LIGHT)
        for name in ("focal_length", "pixel_pitch"):
            check_positive(name, getattr(self, name))
        self._check_lens()
        for name in ("masks", "refocus", "depth_classes", "seed"):
            check_count(name, getattr(self, name), 0)
        check_count("mask_size", self.mask_size)
        for name in ("masks", "mask_size", "repeats", "refocus", "depth_classes"):
            if getattr(self, name) > MOST:
                raise ValueError(f"{name} must be {MOST} or fewer, got {getattr(self, name)}")
        check_choice("start", self.start, STARTS)
        if self.start != "noise" and self.masks > 5:
            raise ValueError(f"start {self.start!r} has five masks, got masks={self.masks}; 'noise' has any number")
        if self.residual and "image" not in MAPS[self.task]:
            raise ValueError(f"residual adds the capture to the image, and the task {self.task!r} estimates none")
        check_head(self.head)
        check_count("repeats", self.repeats)
        check_repeats(self.head, self.repeats)
        self._check_closed_form()
        if self.depth_classes or self.refined:
            self._check_distribution()
        if self.depth_range is not None:
            object.__setattr__(self, "depth_range", tuple(self.depth_range))  # JSON has no tuples

    def _check_lens(self) -> None:
        if self.f_number is not None and self.f_number < FASTEST:
            raise ValueError(f"f_number must be {FASTEST} or more, got {self.f_number}")
        if self.focus is not None and not self.focus > self.focal_length:
            raise ValueError(
                f"focus must be metres beyond the focal length of {self.focal_length:g} m, got {self.focus}"
            )

    def _check_closed_form(self) -> None:
        if self.head in CLOSED_FORMS and self.task != "edof":
            raise ValueError(f"head {self.head!r} restores images, for the task 'edof' only, got {self.task!r}")
        if self.residual and (self.closed_form or self.head in CLOSED_FORMS):
            raise ValueError("residual adds the capture and closed_form its restoration: choose one of them")
        check_choice("inverse", self.inverse, INVERSES)
        if self.inverse != INVERSES[0] and not self.closed_form:
            raise ValueError(f"inverse {self.inverse!r} is the filter of closed_form, which is not asked for")
        if self.fine and (self.depth_classes or not (self.closed_form and self.refocus)):
            raise ValueError(
                "fine is for closed_form with refocus and without depth_classes, got "
                f"closed_form={self.closed_form}, refocus={self.refocus}, depth_classes={self.depth_classes}"
            )

    def _check_distribution(self) -> None:
        if self.refined and not (self.depth_classes and self.closed_form):
            raise ValueError("refined is for depth_classes with closed_form, which are not both asked for")
        if self.task != "joint" or self.residual:
            kind = f"task {self.task!r}" + (" with residual" if self.residual else "")
            raise ValueError(f"depth_classes are for the task 'joint' without residual, got the {kind}")
        for name in ("depth_classes", "refocus"):
            if getattr(self, name) < 2:
                raise ValueError(f"a distribution of depth needs {name} of at least 2, got {getattr(self, name)}")

    @property
    def encoded(self) -> bool:
        """Whether captures are encoded as sRGB; otherwise they are taken for linear light."""
        return (self.color_space or ("paper" if self.fidelity == "paper" else "srgb")) == "srgb"

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some values changed."""
        return replace(self, **changes)

    def sensor(self) -> SensorNoise:
        """Return the sensor with its noise."""
        return SensorNoise(self.sigma, full_well=self.full_well, bits=self.bits)

    def camera(self) -> ThinLensCamera:
        """Return the lens and the sensor's pixels."""
        lens: dict[str, Any] = {"focal_length": self.focal_length, "pixel_pitch": self.pixel_pitch}
        if self.f_number is None and self.focus is None:
            return self._chosen_camera(lens)
        near, far = ThinLensCamera().depth_range if self.depth_range is None else self.depth_range
        diameter = (
            self._chosen_camera(lens).aperture_diameter if self.f_number is None else self.focal_length / self.f_number
        )
        focus = 2 / (1 / near + 1 / far) if self.focus is None else self.focus
        return ThinLensCamera(aperture_diameter=diameter, focus_distance=focus, depth_range=(near, far), **lens)

    def _chosen_camera(self, lens: dict[str, Any]) -> ThinLensCamera:
        """Return the lens whose focus and aperture follow from the depth range, or the default one."""
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
        known, unknown = cls.split(values)
        if unknown:
            raise ValueError(f"settings hold unknown names: {', '.join(sorted(unknown))[:200]}")
        return cls(**known)

    @classmethod
    def split(cls, values: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
        """Split a dictionary into the settings of this class and all other entries.

        Raises:
            ValueError: if it is no dictionary.
        """
        if not isinstance(values, Mapping):
            raise ValueError(f"settings must be values by name, got {values!r:.80}")
        names = {field.name for field in fields(cls)}
        known = {name: value for name, value in values.items() if name in names}
        return known, {name: value for name, value in values.items() if name not in names}

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the settings as JSON."""
        write_bytes(path, (json.dumps(self.as_dict(), indent=2) + "\n").encode())

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Self:
        """Read settings from a JSON file.

        Raises:
            FileNotFoundError: if there is no file.
            ValueError: if the file does not hold JSON of settings.
        """
        values = read_json(path)
        try:
            return cls.from_dict(values)
        except ValueError as error:
            raise ValueError(f"cannot read {path}: {error}") from error


def _check_types(settings: SystemSettings) -> None:
    """Raise ``ValueError`` for a value of another type, as a damaged file may hold; int is allowed for float."""
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
    "Distance": "a number of metres",
    "tuple[float, float]": "two numbers",
}


def _is_a(kind: str, value: Any) -> bool:
    if kind == "tuple[float, float]":
        return isinstance(value, (tuple, list)) and len(value) == 2 and all(_is_number(end) for end in value)
    if kind == "float":
        return _is_number(value) and math.isfinite(value)
    if kind == "Distance":
        return _is_number(value)
    if kind == "int":
        return isinstance(value, int) and not isinstance(value, bool)
    return isinstance(value, {"str": str, "bool": bool}[kind])


def _is_number(value: Any) -> bool:
    """Whether a value is infinite or a number that a float can hold; integers in JSON may be larger."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    return abs(value) <= sys.float_info.max or value == math.inf
