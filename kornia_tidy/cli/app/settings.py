"""Settings of the app as plain values in SI units, each with its control: label, unit, range and explanation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any, Literal

from kornia_tidy.checks import check_choice, check_positive
from kornia_tidy.choices import COMPOSITING, LENSES, REPLACED, STARTS
from kornia_tidy.data.dead_leaves import MOST_LEAVES, PIXELS_A_LEAF
from kornia_tidy.optics.published_systems import SYSTEMS
from kornia_tidy.optics.thin_lens import ThinLensCamera
from kornia_tidy.reconstruction.pretrained import PRETRAINED, check_shipped
from kornia_tidy.reconstruction.settings import MaskSettings

Kind = Literal["choice", "number", "whole", "slider", "check", "file"]
Group = Literal["scene", "painted scene", "files", "painted depths", "camera", "own camera", "capture", "more"]

LENS = ThinLensCamera()
OWN, FLAT, FILES = "own", "flat", "files"
AS_SYSTEM = "system"
IDEAL = "ideal"
MOST_MASKS, STARTED_MASKS = 16, 5
SIDES = (96, 768)  # pixels
SEEDS = 2**31
ASPECT = 0.75  # rows of a painted scene for each column
TASKS = {"joint": "image, depth", "edof": "image"}
SCENES = {"dead leaves": "dead leaves", "photographic leaves": "photographic leaves", FILES: "your photo and depth map"}
STARTS_IN_WORDS = {
    FLAT: "flat (a plain lens)",
    "noise": "noise",
    "like fishers": "like fishers (for depth)",
    "focal sweep": "focal sweep (for the image)",
}
UNITS = (
    ("metres", 1.0),
    ("centimetres", 0.01),
    ("millimetres", 0.001),
    ("1/5000 metre (TUM, ICL-NUIM)", 0.0002),
    ("1/256 metre (KITTI)", 1 / 256),
)


@dataclass(frozen=True)
class Control:
    """A control of the page for one setting.

    Args:
        name: of the setting.
        default: of the setting.
        label: with its unit.
        group: of the page.
        info: explanation.
        choices: labels and values.
        low: smallest number, in the unit of the label.
        high: largest number.
        step: of a slider; other numbers are typed.
        per_unit: power of ten from the unit in the label to that of the setting: -3 for millimetres and metres.
    """

    name: str
    default: Any
    label: str
    group: Group
    info: str = ""
    choices: Sequence[tuple[str, Any]] = ()
    low: float | None = None
    high: float | None = None
    step: float | None = None
    per_unit: int = 0

    @property
    def kind(self) -> Kind:
        """Kind of the control."""
        if self.choices:
            return "choice"
        if self.low is None:
            return "file" if self.default is None else "check"
        if self.step is not None:
            return "slider"
        return "whole" if isinstance(self.default, int) else "number"

    @property
    def value(self) -> Any:
        """Default, in the unit of the label."""
        return self.shown(self.default)

    def shown(self, setting: Any) -> Any:
        """Return a value of the setting in the unit of the label."""
        return setting if self.per_unit == 0 else _scaled(Decimal(repr(setting)), -self.per_unit)

    def check(self, setting: Any) -> None:
        """Raise ``ValueError`` unless a value of the setting is one of the choices, or within the range."""
        if isinstance(setting, str) and self.choices:
            check_choice(self.label, setting, tuple(value for _, value in self.choices))
        if self.low is None or self.high is None:
            return
        if not self.low <= (number := self.shown(setting)) <= self.high:
            allowed = f"from {self.low:.12g} to {self.high:.12g}"
            raise ValueError(f"{self.label}: give a number {allowed}, got {number:.6g}")

    def setting(self, value: Any) -> Any:
        """Return a value of the control as the value of the setting.

        Raises:
            ValueError: if a number is missing, is not a number, or is not whole where it must be.

        Example:
            >>> by_name("noise").setting(0.00001), by_name("pixel_pitch").setting("3,45")
            (1e-07, 3.45e-06)
        """
        if self.kind in {"choice", "check", "file"}:
            return value
        if value is None:
            raise ValueError(f"{self.label}: give a number")
        try:
            number = Decimal(str(value).strip().replace(",", "."))
        except InvalidOperation:
            number = Decimal("nan")
        if not (number.is_finite() and math.isfinite(float(number))):
            raise ValueError(f"{self.label}: give a number, got {value!s:.40}")
        if not isinstance(self.default, int):
            return _scaled(number, self.per_unit)
        if number != number.to_integral_value():
            raise ValueError(f"{self.label}: give a whole number, got {value!s:.40}")
        return int(number)


def _scaled(number: Decimal, power: int) -> float:
    """Return a number times a power of ten, rounded once."""
    sign, digits, exponent = number.as_tuple()
    assert isinstance(exponent, int)  # of finite numbers
    return float(Decimal((sign, digits, exponent + power)))


def camera_name(name: str) -> str:
    """Return a system as a user sees it in the list of cameras.

    Example:
        >>> camera_name("edof-5"), camera_name("joint-uncertain"), camera_name("ikoma2021")
        ('trained edof-5: image, K = 5', 'trained joint-uncertain', 'published: Ikoma et al.')
    """
    if name == OWN:
        return "your own lens and masks"
    if name in SYSTEMS:
        return f"published: {SYSTEMS[name].title}"
    task, _, masks = name.partition("-")
    if task not in TASKS or not masks.isdigit():
        return f"trained {name}"
    return f"trained {name}: {TASKS[task]}, K = {masks}"


CAMERAS = (*PRETRAINED, *SYSTEMS, OWN)
INFOS = {
    "camera": "Trained systems come with a network. The network any-camera restores the others, without depth.",
    "f_number": "Focal length over aperture. Smaller is a wider aperture: more blur out of focus.",
    "fit": "Its depths then have a defocus of -20 to +20 rad.",
    "lens": "A real lens has its own focal length, and its PSFs vary over the picture.",
    "place": "0 is the middle; at 100 a corner of the picture is at the edge of the field.",
    "compositing": "Gather blurs each pixel by its depth, scatter spreads its light, and occlusion also hides.",
    "noise": "Standard deviation in linear light.",
    "stretch": "Linear in inverse depth. Your own lens takes the range of the scene instead.",
}
"""Explanations of settings."""
CHOICES: dict[str, Sequence[tuple[str, Any]]] = {
    "scene": [(words, name) for name, words in SCENES.items()],
    "depth_scale": UNITS,
    "camera": [(camera_name(name), name) for name in CAMERAS],
    "lens": [("ideal", IDEAL), *((name, name) for name in LENSES)],
    "start": [(STARTS_IN_WORDS.get(name, name), name) for name in (FLAT, *STARTS)],
    "compositing": [("as the system has it", AS_SYSTEM), *((name, name) for name in COMPOSITING)],
}
"""Labels and values."""


def _control(default: Any, label: str, group: Group, *limits: float, per_unit: int = 0) -> Any:
    """Return the field of a setting with its control; limits are ``low``, ``high`` and ``step``."""
    limited = dict(zip(("low", "high", "step"), limits, strict=False))
    return field(default=default, metadata={"label": label, "group": group, "per_unit": per_unit, **limited})


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of one capture in the app.

    Args:
        scene: ``"dead leaves"``, ``"photographic leaves"``, or ``"files"`` for image and depth files.
        seed: of the painted scene.
        side: longer side of the picture in pixels; larger files are made smaller.
        image_file: picture of the scene ``"files"``.
        depth_file: its depth map.
        depth_scale: metres per stored unit of the depth map.
        stretch: depths fill the range of the camera, linearly in inverse depth. The own camera always has the range of
            the scene.
        near: nearest depth of a painted scene in metres, if depths are not stretched.
        far: its farthest depth in metres.
        camera: name of a trained or a published system, or ``"own"``.
        f_number: focal length over aperture diameter of the own camera.
        focus_distance: its distance in focus, in metres.
        focal_length: in metres.
        pixel_pitch: of its sensor in metres.
        lens: ``"ideal"``, or the name of a real lens of the own camera, whose focal length it then has.
        place: where the picture lies in the lens's field: 0 in its middle, 1 with a corner at its edge.
        fit: focus and aperture of the own camera are chosen so that the scene's depths, their middle 99 %, have a
            defocus of -20 to +20 rad.
        start: masks of the own camera: ``"flat"`` for a plain lens, or a name of
            :func:`~kornia_tidy.masks.initial_heights.initial_heights`.
        masks: number K of its masks in one exposure.
        mask_seed: of the noise of masks.
        compositing: ``"gather"``, ``"scatter"``, ``"occlusion"``, or ``"system"`` for the compositing of the system.
        noise: standard deviation of the read noise, in units of full scale.
        noise_seed: of the noise.

    Raises:
        ValueError: if a value is not allowed, or a file is missing.

    Example:
        >>> Settings(camera="own", f_number=8).focus_distance
        0.595
        >>> Settings(noise=-1)
        Traceback (most recent call last):
        ...
        ValueError: Read noise (% of full scale): give a number from 0 to 5, got -100
    """

    scene: str = _control("dead leaves", "Scene", "scene")
    image_file: str | None = _control(None, "Photo (PNG, TIFF, JPEG)", "files")
    depth_file: str | None = _control(None, "Its depth map (16-bit PNG, TIFF, PGM, PFM, NPY, NPZ, OpenEXR)", "files")
    depth_scale: float = _control(1.0, "Unit of the depth map", "files")
    seed: int = _control(0, "Number of the painted scene", "painted scene", 0, SEEDS - 1)
    camera: str = _control("joint-uncertain", "Camera", "camera")
    f_number: float = _control(round(LENS.f_number, 1), "f-number", "own camera", 2, 32, 0.1)
    focus_distance: float = _control(float(LENS.focus_distance), "Focus distance (m)", "own camera", 0.06, 1000)
    fit: bool = _control(False, "Choose aperture and focus for the scene", "own camera")
    focal_length: float = _control(LENS.focal_length, "Focal length (mm)", "own camera", 1, 1000, per_unit=-3)
    lens: str = _control(IDEAL, "Lens", "own camera")
    place: float = _control(
        0.0, "Place of the picture in a real lens's field (%)", "own camera", 0, 100, 5, per_unit=-2
    )
    pixel_pitch: float = _control(LENS.pixel_pitch, "Pixel pitch (µm)", "own camera", 0.5, 50, per_unit=-6)
    start: str = _control("like fishers", "Masks", "own camera")
    masks: int = _control(MaskSettings.masks, "Masks in one exposure, K", "own camera", 1, MOST_MASKS, 1)
    compositing: str = _control(AS_SYSTEM, "Compositing at depth edges", "capture")
    noise: float = _control(0.002, "Read noise (% of full scale)", "capture", 0, 5, 0.05, per_unit=-2)
    stretch: bool = _control(True, "Stretch the depths over the camera's range", "more")
    near: float = _control(0.3, "Nearest painted depth (m)", "painted depths", 0.05, 1000)
    far: float = _control(10.0, "Farthest painted depth (m)", "painted depths", 0.05, 10000)
    side: int = _control(320, "Longer side of the picture (pixels)", "more", *SIDES, 32)
    mask_seed: int = _control(0, "Seed of random masks", "more", 0, SEEDS - 1)
    noise_seed: int = _control(0, "Seed of the sensor's noise", "more", 0, SEEDS - 1)

    @property
    def painted_size(self) -> tuple[int, int]:
        """Rows and columns of a painted scene, three to four."""
        return round(ASPECT * self.side), self.side

    @property
    def painted_leaves(self) -> int:
        """Number of leaves of the scene ``"dead leaves"``."""
        height, width = self.painted_size
        return min(MOST_LEAVES, max(1, height * width // PIXELS_A_LEAF))

    def __post_init__(self) -> None:
        if self.camera in REPLACED:
            check_shipped(self.camera)
        for control in CONTROLS:
            control.check(getattr(self, control.name))
        if self.scene == FILES:
            for path, what in ((self.image_file, "a photo"), (self.depth_file, "the depth map of the photo")):
                if path is None:
                    raise ValueError(f"{what} is missing: upload both a photo and its depth map")
                if not Path(path).is_file():
                    raise FileNotFoundError(f"there is no file {Path(path).name}: upload it again")
            check_positive("metres per stored unit", self.depth_scale)
        elif not 0 < self.near < self.far < math.inf:
            raise ValueError(
                f"the nearest depth must be positive and below the farthest, got {self.near:g} m and {self.far:g} m"
            )
        if self.camera == OWN and self.start not in {FLAT, "noise"} and self.masks > STARTED_MASKS:
            raise ValueError(
                f"the masks {self.start!r} are {STARTED_MASKS} at most, got K = {self.masks}; 'noise' has any number"
            )


CONTROLS = tuple(
    Control(one.name, one.default, **one.metadata, info=INFOS.get(one.name, ""), choices=CHOICES.get(one.name, ()))
    for one in fields(Settings)
)


def settings_of(values: Mapping[str, Any]) -> Settings:
    """Return the settings of the values of controls by name, in the units of their labels; missing ones are default.

    Raises:
        ValueError: if a number is missing, or a value is not allowed.

    Example:
        >>> settings_of({"focal_length": 35, "noise": 1.0}).focal_length
        0.035
    """
    return Settings(**{name: by_name(name).setting(value) for name, value in values.items()})


def by_name(name: str) -> Control:
    """Return the control of a setting."""
    return next(control for control in CONTROLS if control.name == name)


def shown(group: Group, scene: str, camera: str, stretch: bool) -> bool:
    """Return whether a group of controls has an effect, and so is shown.

    Example:
        >>> shown("files", "dead leaves", "edof-5", stretch=True), shown("own camera", "dead leaves", "own", True)
        (False, True)
    """
    if group == "files":
        return scene == FILES
    if group == "painted scene":
        return scene != FILES
    if group == "own camera":
        return camera == OWN
    if group == "painted depths":
        return scene != FILES and (camera == OWN or not stretch)
    return True
