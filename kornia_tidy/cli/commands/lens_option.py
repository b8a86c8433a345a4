"""Option --lens: a real lens by its name, its table, or its surfaces, with the camera of the other options."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

from kornia_tidy.choices import LENSES
from kornia_tidy.reconstruction.settings import LensSettings
from kornia_tidy.settings import Choice

if TYPE_CHECKING:
    from kornia_tidy.optics.lens.lens import Lens
    from kornia_tidy.optics.thin_lens import ThinLensCamera

Settings = TypeVar("Settings", bound=LensSettings)
RealLens = Annotated[str, Choice("NAME|FILE", choices=LENSES, others=True)]


def camera_and_lens(
    lens: str | None,
    settings: Settings,
    camera: Callable[[Settings], ThinLensCamera] = LensSettings.camera,
    size: tuple[int, int] | None = None,
) -> tuple[ThinLensCamera, Lens | None]:
    """Return the camera of the options, which is the lens's where there is one, and the lens.

    Args:
        lens: a name, a file of ``Lens.save``, or one of surfaces. None: no real lens. Names and surfaces are traced at
            the camera's f-number and focus.
        settings: lens and sensor of the other options.
        camera: makes the camera of settings.
        size: rows and columns of the picture, over which the lens is traced. Default: over its own field.

    Raises:
        FileNotFoundError: if the lens is neither a name nor a file.
        ValueError: if an option contradicts the lens, or the file does not hold a lens.
    """
    from kornia_tidy.optics.lens.first_order import first_order
    from kornia_tidy.optics.lens.lens import Lens
    from kornia_tidy.optics.lens.named_lenses import NAMED_LENSES
    from kornia_tidy.optics.lens.prescription import Prescription
    from kornia_tidy.optics.lens.prescription_files import SUFFIXES, read_prescription_file

    if lens is None:
        return camera(settings), None
    given = [name for name, value in vars(settings).items() if value != getattr(type(settings)(), name)]
    if lens not in LENSES and not Path(lens).is_file():
        raise FileNotFoundError(f"--lens must be one of {', '.join(map(repr, LENSES))}, or a file, got {lens!r:.80}")
    if lens not in LENSES and Path(lens).suffix.lower() not in SUFFIXES:
        _refuse(lens, given, ("focal_length", "f_number", "aperture_diameter", "focus_distance", "fit_depth"))
        loaded = Lens.load(lens)
        return loaded.camera(settings.pixel_pitch, settings.depth_range), loaded
    _refuse(lens, given, ("focal_length",))
    corner = None if size is None else math.hypot(*size) / 2 * settings.pixel_pitch
    usual: float = NAMED_LENSES[lens]["field"] if lens in LENSES else 0.0
    if lens in LENSES:
        prescription, field = Prescription.read(NAMED_LENSES[lens]["prescription"]), None
    else:
        prescription, field = read_prescription_file(lens)
    focal_length = first_order(prescription, 8.0, math.inf).focal_length
    own = camera(replace(settings, focal_length=focal_length))
    aperture, focus = own.f_number, float(own.focus_distance)
    if lens in LENSES:
        return own, Lens.named(lens, aperture, focus, field=max(usual, corner or 0.0))
    if (field := field if corner is None else corner) is None:
        raise ValueError(
            f"{lens} must say its largest field, in angles or in heights on the sensor: add it, or make the lens in "
            f"Python with Lens.from_prescription(..., field=...)"
        )
    return own, Lens.from_prescription(prescription, aperture, focus, field=field)


def _refuse(lens: str, given: list[str], own: tuple[str, ...]) -> None:
    """Raise ``ValueError`` if an option was given for a property of the lens."""
    for name in given:
        if name in own:
            raise ValueError(f"the lens {lens} has its own: leave out --{name.replace('_', '-')}")
