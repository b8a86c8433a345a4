"""Option --lens: a real lens by its name, its table, or its surfaces, with the camera of the other options."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from kornia_tidy.choices import LENSES
from kornia_tidy.reconstruction.settings import LensSettings
from kornia_tidy.settings import Choice

if TYPE_CHECKING:
    from kornia_tidy.optics.lens.lens import Lens
    from kornia_tidy.optics.thin_lens import ThinLensCamera

RealLens = Annotated[str, Choice("NAME|FILE", choices=LENSES, others=True)]


def camera_and_lens(lens: str | None, settings: LensSettings) -> tuple[ThinLensCamera, Lens | str | None]:
    """Return the camera of the options, which is the lens's where there is one, and the lens.

    Args:
        lens: a name, a file of ``Lens.save``, or one of surfaces, which is traced at the camera's f-number and focus.
            None: no real lens.
        settings: lens and sensor of the other options.

    Raises:
        FileNotFoundError: if the lens is neither a name nor a file.
        ValueError: if an option contradicts the lens, or the file does not hold a lens.
    """
    from kornia_tidy.optics.lens.first_order import first_order
    from kornia_tidy.optics.lens.lens import Lens
    from kornia_tidy.optics.lens.made_lenses import named_focal_length
    from kornia_tidy.optics.lens.prescription_files import SUFFIXES, read_prescription_file

    given = [name for name, value in vars(settings).items() if value != getattr(LensSettings(), name, value)]
    if lens is None:
        return settings.camera(), None
    if lens in LENSES:
        _refuse(lens, given, ("focal_length",))
        return replace(settings, focal_length=named_focal_length(lens)).camera(), lens
    if not Path(lens).is_file():
        raise FileNotFoundError(f"--lens must be one of {', '.join(map(repr, LENSES))}, or a file, got {lens!r:.80}")
    if Path(lens).suffix.lower() in SUFFIXES:
        _refuse(lens, given, ("focal_length",))
        prescription, field = read_prescription_file(lens)
        if field is None:
            raise ValueError(
                f"{lens} must say its largest field, in angles or in heights on the sensor: add it, or make the lens "
                f"in Python with Lens.from_prescription(..., field=...)"
            )
        focal_length = first_order(prescription, 8.0, math.inf).focal_length
        camera = replace(settings, focal_length=focal_length).camera()
        made = Lens.from_prescription(prescription, camera.f_number, float(camera.focus_distance), field=field)
        return camera, made
    _refuse(lens, given, ("focal_length", "f_number", "aperture_diameter", "focus_distance"))
    loaded = Lens.load(lens)
    return loaded.camera(settings.pixel_pitch, settings.depth_range), loaded


def _refuse(lens: str, given: list[str], own: tuple[str, ...]) -> None:
    """Raise ``ValueError`` if an option was given for a property of the lens."""
    for name in given:
        if name in own:
            raise ValueError(f"the lens {lens} has its own: leave out --{name.replace('_', '-')}")
