"""Nine published optical systems as plain data: lens, wavelengths, compositing and noise, each with its source.

The values stand in ``published_systems.json``. A value that no accessible source states is a guess, and its entry in
``System.sources`` begins with that word. Masks and cameras are made of them in ``camera/published_systems.py``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kornia_tidy.checks import check_choice
from kornia_tidy.optics.materials import PMMA, cauchy_through
from kornia_tidy.optics.spectrum import Spectrum
from kornia_tidy.optics.thin_lens import ThinLensCamera

RGB = Spectrum.rgb()
GUESS = "guess"
"""First word in the source of a value that no accessible paper or code states."""
SITZMANN_PLATE = cauchy_through(
    "the plate of Sitzmann et al.",
    "code of Sitzmann et al. (2018) at three wavelengths",
    ((460e-9, 1.499), (550e-9, 1.493), (640e-9, 1.488)),
)
ELEMENTS = {material.name: material for material in (PMMA, SITZMANN_PLATE)}
"""Materials of the lenses that are a single element."""


@dataclass(frozen=True)
class System:
    """A published optical system: the values of its parts and their sources.

    Args:
        name: name for :meth:`kornia_tidy.TiDyOptics.from_preset`.
        title: common name.
        paper: publication.
        known_for: its characteristic property in one phrase.
        mask: description of the mask.
        lens: arguments of :class:`~kornia_tidy.ThinLensCamera`, in metres; a single element has a material's name.
        sources: each value and where it was published; a guess begins with the word "guess".
        spectrum: wavelengths, one for each channel.
        compositing: how depth layers are combined: "gather", "scatter" or "occlusion".
        sigma: standard deviation of the read noise, in units of full scale.
        modulated: fraction of the light that the mask modulates; the rest passes as through no mask.
        smooth_iris: whether the iris is a disc with a smooth edge. False: the published grid of open and shut pixels.

    Example:
        >>> from kornia_tidy.optics.published_systems import published_system
        >>> system = published_system("ikoma2021")
        >>> round(system.camera().f_number, 1), system.compositing
        (6.3, 'occlusion')
        >>> system.guesses
        ('start',)
    """

    name: str
    title: str
    paper: str
    known_for: str
    mask: str
    lens: Mapping[str, Any]
    sources: Mapping[str, str]
    spectrum: Spectrum = RGB
    compositing: str = "gather"
    sigma: float = 0.01
    modulated: float = 1.0
    smooth_iris: bool = True

    def camera(self) -> ThinLensCamera:
        """Return the lens with the pixel pitch of the sensor."""
        own: dict[str, Any] = {"depth_range": tuple(self.lens["depth_range"])}
        own["lens_material"] = ELEMENTS.get(self.lens.get("lens_material", ""))
        return ThinLensCamera(**{**self.lens, **own})

    @property
    def guesses(self) -> tuple[str, ...]:
        """Names of the values that are guesses."""
        return tuple(name for name, source in self.sources.items() if source.startswith(GUESS))

    @property
    def year(self) -> int:
        """Year of publication."""
        return int(re.findall(r"\b20\d\d\b", self.paper)[-1])


def _read() -> dict[str, System]:
    """Return the systems of the file; an entry ``like`` names values that several systems share."""
    table = json.loads(Path(__file__).with_suffix(".json").read_text("utf-8"))
    systems = {}
    for own in table["systems"]:
        shared = table["shared"].get(own.pop("like", ""), {"sources": {}})
        values: dict[str, Any] = {**shared, **own, "sources": {**shared["sources"], **own["sources"]}}
        if waves := values.pop("wavelengths", None):
            values["spectrum"] = Spectrum(tuple(waves), RGB.weights)
        systems[own["name"]] = System(**values)
    return systems


SYSTEMS = _read()
"""The published systems by name."""

HEADINGS = ("name", "lens", "mask", "depth, m", "psi, rad", "noise", "guessed", "source")


def published_system(name: str) -> System:
    """Return a published system by its name.

    Raises:
        ValueError: if the name is unknown; the message lists the known ones.

    Example:
        >>> published_system("tidy-5").title
        'TiDy, five masks'
    """
    check_choice("the name of a published system", name, tuple(SYSTEMS))
    return SYSTEMS[name]


def systems_table(systems: Sequence[System]) -> list[str]:
    """Return the systems as lines of aligned columns, the headings first.

    Example:
        >>> print(systems_table([published_system("ikoma2021")])[1][:68])
        ikoma2021  50 mm f/6.3, focus 1.7 m  radial profile, 61 radii, noise
    """
    rows = [HEADINGS]
    for system in systems:
        camera = system.camera()
        (near, far), (lo, hi) = camera.depth_range, camera.defocus_range
        rows.append(
            (
                system.name,
                f"{camera.focal_length * 1e3:.3g} mm f/{camera.f_number:.3g}, focus {camera.focus_distance:.3g} m",
                system.mask,
                f"{near:.3g} to {far:g}",
                f"{hi:+.1f} to {lo:+.1f}",
                f"{system.sigma:g}",
                str(len(system.guesses)),
                system.paper,
            )
        )
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
