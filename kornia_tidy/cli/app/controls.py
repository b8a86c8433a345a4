"""Controls of the app: label, unit, range and explanation of each setting, and their conversion to settings."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from decimal import Decimal, InvalidOperation
from typing import Any, Literal, NamedTuple

from kornia_tidy.choices import LENSES, STARTS
from kornia_tidy.cli.app.settings import (
    AS_SYSTEM,
    CHART,
    FILES,
    FLAT,
    IDEAL,
    MOST_MASKS,
    OWN,
    SCENES,
    SEEDS,
    SIDES,
    Settings,
)
from kornia_tidy.optics.published_systems import SYSTEMS
from kornia_tidy.reconstruction.pretrained import PRETRAINED

Kind = Literal["choice", "number", "whole", "slider", "check", "file"]
Group = Literal["scene", "painted scene", "files", "painted depths", "camera", "own camera", "capture", "more"]

TASKS = {"joint": "image, depth", "edof": "image"}
SCENE_NAMES = {FILES: "your photo and depth map"}
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


class Control(NamedTuple):
    """A control of the page for one setting."""

    name: str
    """Of the setting."""
    label: str
    kind: Kind
    group: Group
    info: str = ""
    choices: Sequence[tuple[str, Any]] = ()
    """Labels and values."""
    low: float | None = None
    high: float | None = None
    step: float | None = None
    per_unit: int = 0
    """Power of ten from the unit in the label to that of the setting: -3 for millimetres and metres."""

    @property
    def value(self) -> Any:
        """Default, in the unit of the label."""
        default = getattr(Settings(), self.name)
        return default if self.per_unit == 0 else _scaled(Decimal(repr(default)), -self.per_unit)

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
        if self.kind != "whole" and self.name not in {"masks", "side"}:
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


CONTROLS = (
    Control("scene", "Scene", "choice", "scene", choices=[(SCENE_NAMES.get(name, name), name) for name in SCENES]),
    Control("image_file", "Photo (PNG, TIFF, JPEG)", "file", "files"),
    Control("depth_file", "Its depth map (16-bit PNG, TIFF, PGM, PFM, NPY, NPZ, OpenEXR)", "file", "files"),
    Control("depth_scale", "Unit of the depth map", "choice", "files", choices=UNITS),
    Control("seed", "Number of the painted scene", "whole", "painted scene", low=0, high=SEEDS - 1),
    Control(
        "camera",
        "Camera",
        "choice",
        "camera",
        "Trained systems come with a network. The network any-camera restores the others, without depth.",
        [(camera_name(name), name) for name in (*PRETRAINED, *SYSTEMS, OWN)],
    ),
    Control(
        "f_number",
        "f-number",
        "slider",
        "own camera",
        "Focal length over aperture. Smaller is a wider aperture: more blur out of focus.",
        low=2,
        high=32,
        step=0.1,
    ),
    Control("focus_distance", "Focus distance (m)", "number", "own camera", low=0.06, high=1000),
    Control(
        "fit",
        "Choose aperture and focus for the scene",
        "check",
        "own camera",
        "Its depths then have a defocus of -20 to +20 rad.",
    ),
    Control("focal_length", "Focal length (mm)", "number", "own camera", low=1, high=1000, per_unit=-3),
    Control(
        "lens",
        "Lens",
        "choice",
        "own camera",
        "A real lens has its own focal length, and its PSFs vary over the picture.",
        [("ideal", IDEAL), *((name, name) for name in LENSES)],
    ),
    Control(
        "place",
        "Place of the picture in a real lens's field (%)",
        "slider",
        "own camera",
        "0 is the middle; at 100 a corner of the picture is at the edge of the field.",
        low=0,
        high=100,
        step=5,
        per_unit=-2,
    ),
    Control("pixel_pitch", "Pixel pitch (µm)", "number", "own camera", low=0.5, high=50, per_unit=-6),
    Control(
        "start",
        "Masks",
        "choice",
        "own camera",
        choices=[(STARTS_IN_WORDS.get(name, name), name) for name in (FLAT, *STARTS)],
    ),
    Control("masks", "Masks in one exposure, K", "slider", "own camera", low=1, high=MOST_MASKS, step=1),
    Control(
        "compositing",
        "Compositing at depth edges",
        "choice",
        "capture",
        "Gather blurs each pixel by its depth, scatter spreads its light, occlusion lets near things hide far ones.",
        [("as the system has it", AS_SYSTEM), ("gather", "gather"), ("scatter", "scatter"), ("occlusion", "occlusion")],
    ),
    Control(
        "noise",
        "Read noise (% of full scale)",
        "slider",
        "capture",
        "Standard deviation in linear light.",
        low=0,
        high=5,
        step=0.05,
        per_unit=-2,
    ),
    Control(
        "stretch",
        "Stretch the depths over the camera's range",
        "check",
        "more",
        "Linear in inverse depth. Your own lens takes the range of the scene instead.",
    ),
    Control("near", "Nearest painted depth (m)", "number", "painted depths", low=0.05, high=1000),
    Control("far", "Farthest painted depth (m)", "number", "painted depths", low=0.05, high=10000),
    Control("side", "Longer side of the picture (pixels)", "slider", "more", low=SIDES[0], high=SIDES[1], step=32),
    Control("mask_seed", "Seed of random masks", "whole", "more", low=0, high=SEEDS - 1),
    Control("noise_seed", "Seed of the sensor's noise", "whole", "more", low=0, high=SEEDS - 1),
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
        return scene not in {FILES, CHART}
    if group == "own camera":
        return camera == OWN
    if group == "painted depths":
        return scene != FILES and (camera == OWN or not stretch)
    return True
