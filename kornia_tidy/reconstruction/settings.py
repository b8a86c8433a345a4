"""Settings of a trained system: plain values, stored as JSON, from which its camera and network are built."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import TYPE_CHECKING, Annotated, Any, Self

from kornia_tidy.choices import (
    INVERSES,
    TASKS,
    Border,
    ColorSpace,
    Compositing,
    Inverse,
    Preset,
    Start,
    StrayLight,
)
from kornia_tidy.files import error_prefix, read_json, write_bytes
from kornia_tidy.reconstruction.head_names import CLOSED_FORMS, HEADS, check_head, check_repeats
from kornia_tidy.settings import (
    DepthRange,
    Distance,
    FNumber,
    Metres,
    Pixels,
    Seed,
    Unit,
    check_settings,
    one_of,
)

if TYPE_CHECKING:
    from kornia_tidy.optics.thin_lens import ThinLensCamera
    from kornia_tidy.sensor.sensor import SensorNoise

MOST = 1024  # masks, their pixels along a side, blocks, or depths to refocus to: more would take days
RENAMED = {"focus": "focus_distance"}  # in checkpoints of earlier versions


@dataclass(frozen=True, kw_only=True)
class LensSettings:
    """Lens and sensor.

    Lengths are in metres. Defocus, in radians at the edge of an aperture of radius R, is
    psi = pi R^2 / 530 nm * (1/depth - 1/focus): from +20 at 0.2975 m to -20 at infinity
    for the default lens. Aperture and focus that are not given are chosen for the range
    of depths, so that it fills psi = -20 to +20.

    Args:
        focal_length: of the lens; longer enlarges the PSF.
        f_number: focal length over the diameter of the aperture. None: 17.6, or by the depth range.
        aperture_diameter: instead of the f-number; wider blurs more out of focus. None: by the f-number.
        focus_distance: depth that is seen sharply; may be inf. None: the middle of the depth range in 1/depth.
        depth_range: nearest and farthest depth that the camera is for; others are clamped to its ends. None: half the
            focus distance to inf.
        pixel_pitch: of the sensor; smaller enlarges the PSF in pixels.
    """

    focal_length: Metres = 50e-3
    f_number: FNumber | None = None
    aperture_diameter: Metres | None = None
    focus_distance: Distance | None = None
    depth_range: DepthRange | None = None
    pixel_pitch: Metres = 8e-6

    def __post_init__(self) -> None:
        check_settings(self)
        if self.f_number is not None and self.aperture_diameter is not None:
            raise ValueError("f_number and aperture_diameter say the same: give one of them")
        if self.focus_distance is not None and not self.focus_distance > self.focal_length:
            raise ValueError(
                f"focus_distance must be metres beyond the focal length of {self.focal_length:g} m, got "
                f"{self.focus_distance}"
            )
        if self.depth_range is not None:
            object.__setattr__(self, "depth_range", tuple(self.depth_range))  # JSON has no tuples

    def camera(self) -> ThinLensCamera:
        """Return the lens and the sensor's pixels."""
        from kornia_tidy.optics.thin_lens import ThinLensCamera  # noqa: PLC0415 (torch takes seconds)

        lens: dict[str, Any] = {"focal_length": self.focal_length, "pixel_pitch": self.pixel_pitch}
        diameter = self.aperture_diameter if self.f_number is None else self.focal_length / self.f_number
        focus, depths = self.focus_distance, self._depths()
        if diameter is None:
            fits = self.depth_range is not None
            chosen = ThinLensCamera.for_scene(self.depth_range, **lens) if fits else ThinLensCamera(**lens)
            if focus is None:
                return chosen
            diameter = chosen.aperture_diameter
        if focus is None:
            focus = 2 / sum(1 / end for end in depths or ThinLensCamera().depth_range)
        return ThinLensCamera(aperture_diameter=diameter, focus_distance=focus, depth_range=depths, **lens)

    def _depths(self) -> tuple[float, float] | None:
        """Return the range of depths where aperture or focus are given; None for one that follows from the focus."""
        return self.depth_range


@dataclass(frozen=True, kw_only=True)
class MaskSettings:
    """The learnt task.

    Args:
        task: an image in focus everywhere (edof), depth, or both (joint).
        masks: learnable masks in one exposure; 0 is a fixed Fresnel lens.
        start: heights of the masks at first, see :func:`~kornia_tidy.masks.initial_heights.initial_heights`. Those with
            fisher suit depth, the sweep edof; noise has any number of masks, the others five; flat, with one mask, is a
            lens without masks.
        mask_size: pixels along a side of a mask; 20 of 23 span the aperture.
        seed: of the initial masks, and of everything random in a run.
    """

    task: Annotated[str, one_of(TASKS)] = "edof"
    masks: Annotated[int, Unit("K", "", 0, MOST)] = 5
    start: Start = "noise"
    mask_size: Annotated[int, Unit("N", "", 1, MOST)] = 23
    seed: Seed = 0


@dataclass(frozen=True, kw_only=True)
class CaptureSettings:
    """Capture.

    Args:
        measured: PSFs were measured, see :func:`~kornia_tidy.lab.measured.measured_settings`. Checkpoints hold
            them, and ``masks`` take no part.
        sigma: read noise of the sensor, of full scale.
        full_well: electrons at full scale, for shot noise. None: no shot noise.
        bits: of the sensor's converter. None: no rounding.
        fidelity: speed or accuracy of the PSFs, see :class:`~kornia_tidy.fidelity.Fidelity`.
        window: side of the PSFs, odd. None: measured on the initial masks.
        stray_light: treatment of the light outside the window. None: as the fidelity has it.
        compositing: how depths are put together, see :class:`~kornia_tidy.TiDyOptics`. gather: each pixel collects
            light through its own depth's PSF, as the paper; scatter: each spreads its light, which conserves it;
            occlusion: near things hide far ones, slowest.
        color_space: srgb is decoded to linear light and encoded after; linear is light already; paper takes sRGB for
            light, as the paper does. None: srgb, or paper with that fidelity.
        border: continuation of the picture beyond its edges; valid crops the capture instead.
    """

    measured: bool = False
    sigma: Annotated[float, Unit("S", "", 0)] = 0.01
    full_well: Annotated[float, Unit("E", "electrons", 0)] | None = None
    bits: Annotated[int, Unit("B", "", 1)] | None = None
    fidelity: Preset = "balanced"
    window: Pixels | None = None
    stray_light: StrayLight | None = None
    compositing: Compositing = "gather"
    color_space: ColorSpace | None = None
    border: Border = "reflect"


@dataclass(frozen=True, kw_only=True)
class NetworkSettings:
    """Network.

    Args:
        head: a network, or a closed form, behind which only masks are learnt. Without a GPU take nafnet, plain or a
            small width: the paper's attention-unet has 34.9 million weights. module:Class is a class of yours, which is
            called with channels in, channels out and, if given, width.
        width: channels of its first level. None: its own, the paper's 64.
        repeats: factor of the number of blocks of nafnet.
        residual: the network adds to the capture; for tasks with an image.
        closed_form: the network takes deconvolved captures and the level of the noise, and adds to the best of them,
            see :class:`~kornia_tidy.reconstruction.ClosedFormHead`.
        inverse: filter of the deconvolved captures; wiener knows the spectrum of photographs and how PSFs differ
            between depths.
        refocus: depths that the capture is refocused to for the network, see
            :class:`~kornia_tidy.reconstruction.Refocused`; 0: none.
        fine: refocus twice to each of these depths, the second time sharper and with more noise; for closed_form
            without depth_classes, see :class:`~kornia_tidy.reconstruction.closed_form.ClosedForm`.
        depth_classes: depth as a distribution over so many classes, with its uncertainty, from the depths of refocus,
            for the task joint; with closed_form 21 classes from 9 depths are usual, without 32 from 11; 0: one depth a
            pixel; see :class:`~kornia_tidy.reconstruction.JointClosedFormHead` and
            :class:`~kornia_tidy.reconstruction.LayeredJointHead`.
        refined: a second network of the same kind refines the image, for depth_classes with closed_form.
    """

    head: Annotated[str, one_of((*HEADS, *CLOSED_FORMS), others=True)] = "attention-unet"
    width: Annotated[int, Unit("C", "channels", 1)] | None = None
    repeats: Annotated[int, Unit("N", "", 1, MOST)] = 1
    residual: bool = False
    closed_form: bool = False
    inverse: Inverse = "tikhonov"
    refocus: Annotated[int, Unit("D", "", 0, MOST)] = 0
    fine: bool = False
    depth_classes: Annotated[int, Unit("D", "", 0, MOST)] = 0
    refined: bool = False


@dataclass(frozen=True, kw_only=True)
class SystemSettings(NetworkSettings, CaptureSettings, LensSettings, MaskSettings):
    """Camera and network of a trained system. The defaults are the paper's, with our camera.

    Settings of a run are in :class:`~kornia_tidy.training.settings.TrainingSettings`.

    Args:
        depth_range: nearest and farthest depth that the camera is for. None: 0.298 to inf.

    Raises:
        ValueError: if a value is not allowed.

    Example:
        >>> SystemSettings(task="depth", masks=2).camera().focal_length
        0.05
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.start != "noise" and self.masks > 5:
            raise ValueError(f"start {self.start!r} has five masks, got masks={self.masks}; 'noise' has any number")
        if self.residual and self.task == "depth":
            raise ValueError(f"residual adds the capture to the image, and the task {self.task!r} estimates none")
        check_head(self.head)
        check_repeats(self.head, self.repeats)
        self._check_closed_form()
        if self.depth_classes or self.refined:
            self._check_distribution()

    def _check_closed_form(self) -> None:
        if self.head in CLOSED_FORMS and self.task != "edof":
            raise ValueError(f"head {self.head!r} restores images, for the task 'edof' only, got {self.task!r}")
        if self.residual and (self.closed_form or self.head in CLOSED_FORMS):
            raise ValueError("residual adds the capture and closed_form its restoration: choose one of them")
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
        from kornia_tidy.sensor.sensor import SensorNoise  # noqa: PLC0415 (torch takes seconds)

        return SensorNoise(self.sigma, full_well=self.full_well, bits=self.bits)

    def _depths(self) -> tuple[float, float] | None:
        from kornia_tidy.optics.thin_lens import ThinLensCamera  # noqa: PLC0415

        return ThinLensCamera().depth_range if self.depth_range is None else self.depth_range

    def as_dict(self) -> dict[str, Any]:
        """Return the settings as a dictionary of plain values."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Return the settings of a dictionary.

        Raises:
            ValueError: if it is not a dictionary, a name is unknown, or a value is not allowed or of another type.
        """
        known, unknown = cls.split(values)
        if unknown:
            raise ValueError(f"settings hold unknown names: {', '.join(sorted(unknown))[:200]}")
        return cls(**known)

    @classmethod
    def split(cls, values: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
        """Split a dictionary into the settings of this class and all other entries.

        Raises:
            ValueError: if it is not a dictionary.
        """
        if not isinstance(values, Mapping):
            raise ValueError(f"settings must be values by name, got {values!r:.80}")
        values = {RENAMED.get(name, name): value for name, value in values.items()}
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
            FileNotFoundError: if the file is missing.
            ValueError: if the file does not hold JSON of settings.
        """
        values = read_json(path)
        with error_prefix(f"cannot read {path}"):
            return cls.from_dict(values)
