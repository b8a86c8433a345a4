"""Lens: a real lens as a table of its wavefronts over field, depth and colour."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, Self

import torch
from safetensors.torch import save
from torch import Tensor, nn

from kornia_tidy.checks import check_choice, check_finite, check_metres, check_number, check_positive
from kornia_tidy.files import write_bytes
from kornia_tidy.optics.lens.first_order import first_order
from kornia_tidy.optics.lens.lens_table import LensSample, LensTable
from kornia_tidy.optics.lens.named_lenses import NAMED_LENSES
from kornia_tidy.optics.lens.prescription import Prescription
from kornia_tidy.optics.lens.stop_quadrature import light_through_stop
from kornia_tidy.optics.lens.table_fit import fit_table
from kornia_tidy.optics.spectrum import LONGEST, REFERENCE_WAVELENGTH, SHORTEST
from kornia_tidy.optics.thin_lens import FASTEST, ThinLensCamera
from kornia_tidy.tensor_files import read_tensors

RGB = (470e-9, REFERENCE_WAVELENGTH, 610e-9)
WIDEST = 20.0  # radians; nearer depths than of this defocus are in a table only where focus is farther away
_FORMAT = "kornia_tidy.lens/1"
_ALIKE = 1e-3  # of lengths of a lens and its camera


class LensRangeWarning(UserWarning):
    """A lens was asked for a field point, a depth or a wavelength that its table does not hold."""


class Lens(nn.Module):
    """A real lens: wavefront, distortion, lateral colour, vignetting and light over field, depth and wavelength.

    A value: made by :meth:`named`, :meth:`from_prescription`, :meth:`load` and others, and not changed afterwards. Its
    table is float64 on the CPU wherever the module is moved.

    Args:
        name: of the lens.
        source: where its numbers were published.
        focal_length: in metres, at 530 nm.
        f_number: focal length over diameter of the entrance pupil.
        focus_distance: from the entrance pupil to the plane in focus, in metres.
        table: coefficients.
        residual: largest rms over the stop of what the table leaves of the traced wavefronts, in waves.

    Convention:
        - The stop lies in the mask's plane; positions in it are in stop radii. Depth counts from the entrance pupil.
        - Wavefronts are those of rays that join points of the stop with the object and with the image point, which is
          where the ray through the stop's centre meets the sensor, at each wavelength. Distortion and lateral colour
          are where it lies.
        - Field points are in metres from the axis on the sensor, where light of 530 nm lands.

    Source: wavefronts over field and aperture: Hopkins, Wave Theory of Aberrations (1950), of whose power series over
    the field a table is the general case.

    Example:
        >>> lens = Lens.named("single-50mm", f_number=17.6, focus_distance=0.595)
        >>> lens.residual < 1e-4, round(float(lens.relative_illumination(torch.tensor([0.0, 6.78e-3]))[1]), 2)
        (True, 0.97)
    """

    def __init__(
        self,
        name: str,
        source: str,
        focal_length: float,
        f_number: float,
        focus_distance: float,
        table: LensTable,
        residual: float = 0.0,
    ) -> None:
        super().__init__()
        self.name = name
        self.source = source
        self.focal_length = focal_length
        self.f_number = f_number
        self.focus_distance = focus_distance
        self.residual = residual
        self._table = table

    # ------------------------------------------------------------------ where lenses come from

    @classmethod
    def named(
        cls,
        name: str,
        f_number: float,
        focus_distance: float,
        wavelengths: Sequence[float] = RGB,
        field: float | None = None,
    ) -> Self:
        """Return a lens with a published prescription, traced at an aperture and a focus.

        Args:
            name: of :data:`~kornia_tidy.optics.lens.NAMED_LENSES`: ``"double-gauss-50mm"``, ``"triplet-50mm"``,
                ``"single-50mm"`` or ``"phone-5.5mm"``.
            f_number: focal length over diameter of the entrance pupil.
            focus_distance: from the entrance pupil to the plane in focus, in metres.
            wavelengths: in metres.
            field: largest height on the sensor in metres. Default: half the diagonal of the sensor that the lens was
                tabulated for.

        Raises:
            ValueError: if there is no such lens, or it cannot be traced so.

        Example:
            >>> lens = Lens.named("triplet-50mm", f_number=8, focus_distance=0.595)
            >>> round(lens.focal_length * 1e3, 2)
            49.99
        """
        check_choice("name of a lens", name, tuple(NAMED_LENSES))
        return cls(*_named(name, f_number, focus_distance, tuple(wavelengths), field))

    @classmethod
    def from_prescription(
        cls,
        prescription: Mapping[str, Any] | Prescription,
        f_number: float,
        focus_distance: float,
        wavelengths: Sequence[float] = RGB,
        field: float | None = None,
        nearest: float | None = None,
    ) -> Self:
        """Return a lens traced from its surfaces.

        Args:
            prescription: surfaces and glasses as plain data, see :meth:`~kornia_tidy.optics.lens.Prescription.read`.
            f_number: focal length over diameter of the entrance pupil.
            focus_distance: from the entrance pupil to the plane in focus, in metres; ``inf`` is allowed.
            wavelengths: in metres, one or more; light between them is interpolated.
            field: largest height on the sensor in metres. Default: half the diagonal of the prescription's
                ``"sensor"``.
            nearest: nearest depth in metres. Default: half the focus distance, or that of a defocus of 20 rad if it is
                nearer.

        Raises:
            TypeError: if a value is of another type.
            ValueError: if a value is out of range, or the lens cannot be traced so.

        Convention:
            - The table reaches from infinity to the nearest depth.
        """
        if field is None and isinstance(prescription, Mapping):
            field = _half_diagonal(prescription)
        if not isinstance(prescription, Prescription):
            prescription = Prescription.read(prescription)
        waves = _wavelengths(wavelengths)
        check_positive("f_number", f_number)
        if f_number < FASTEST:
            raise ValueError(f"f_number must be at least {FASTEST}, got {f_number}")
        _check_focus(focus_distance)
        if field is None:
            raise ValueError("field must be the largest height on the sensor in metres, got None")
        _check_field(field)
        return cls(*_traced(prescription, float(f_number), float(focus_distance), waves, float(field), nearest))

    # ------------------------------------------------------------------ what it does to light

    @property
    def field(self) -> float:
        """Largest height on the sensor in metres."""
        return float(self._table.field[0])

    @property
    def wavelengths(self) -> tuple[float, ...]:
        """Wavelengths of the table in metres."""
        return tuple(self._table.wavelengths.tolist())

    @property
    def defocus_range(self) -> tuple[float, float]:
        """Lowest and highest defocus of the table in radians at 530 nm."""
        return self._table.reach

    @property
    def pupil_radius(self) -> float:
        """Radius of the entrance pupil in metres."""
        return self.focal_length / self.f_number / 2

    def camera(self, pixel_pitch: float, depth_range: tuple[float, float] | None = None) -> ThinLensCamera:
        """Return the thin-lens camera of this lens, with its focal length, aperture and focus.

        Args:
            pixel_pitch: of the sensor in metres.
            depth_range: see :class:`~kornia_tidy.optics.ThinLensCamera`.
        """
        return ThinLensCamera(
            self.focal_length,
            focus_distance=self.focus_distance,
            pixel_pitch=pixel_pitch,
            depth_range=depth_range,
            f_number=self.f_number,
        )

    def sample(self, heights: Tensor, defocus: Tensor, wavelength: float) -> LensSample:
        """Return the coefficients of field points at heights (F,) in metres and defocus (D,), at a wavelength.

        Beyond the table its edge stands in, with a :class:`LensRangeWarning`.
        """
        self._warn_if_beyond(heights, defocus, wavelength)
        return self._table.at(heights, defocus, wavelength)

    def relative_illumination(self, heights: Tensor, defocus: float = 0.0, wavelength: float = 530e-9) -> Tensor:
        """Return the irradiance of an even, white scene over that on the axis, (F,), with vignetting.

        Args:
            heights: (F,) in metres from the axis.
            defocus: of the scene in radians.
            wavelength: in metres.
        """
        sample = self.sample(torch.cat([heights.double().new_zeros(1), heights.double()]), torch.tensor([defocus]), wavelength)
        areas = light_through_stop(sample)[:, 0]
        return areas[1:] / areas[0]

    def distortion(self, heights: Tensor, defocus: float = 0.0) -> Tensor:
        """Return by how much images are larger than a pinhole at the entrance pupil makes them, (F,), as a part of 1.

        Args:
            heights: (F,) in metres from the axis, where light of 530 nm lands.
            defocus: of the scene in radians.
        """
        self._warn_if_beyond(heights, torch.tensor([defocus]), None)
        slopes = self._table.slopes(torch.cat([heights.double().new_zeros(1), heights.double()]), torch.tensor([defocus]))[:, 0]
        return slopes[0] / slopes[1:] - 1

    def lateral_colour(self, heights: Tensor, wavelength: float, defocus: float = 0.0) -> Tensor:
        """Return where light of a wavelength lands less where light of 530 nm does, in metres along the field, (F,).

        Args:
            heights: (F,) in metres from the axis.
            wavelength: in metres.
            defocus: of the scene in radians.
        """
        sample = self.sample(heights.double(), torch.tensor([defocus]), wavelength)
        return heights * (sample.chief[:, 0] - 1)

    def _warn_if_beyond(self, heights: Tensor, defocus: Tensor, wavelength: float | None) -> None:
        beyond = []
        if float(heights.max()) > self.field * (1 + 1e-6):
            beyond.append(f"a field of {float(heights.max()):.4g} m beyond {self.field:.4g} m")
        low, high = self.defocus_range
        slack = 1e-6 * (high - low) + 1e-6
        if float(defocus.min()) < low - slack or float(defocus.max()) > high + slack:
            worst = float(defocus.min()) if float(defocus.min()) < low - slack else float(defocus.max())
            beyond.append(f"a defocus of {worst:.4g} rad beyond {low:.4g} to {high:.4g} rad")
        first, last = min(self.wavelengths), max(self.wavelengths)
        if wavelength is not None and not first * (1 - 1e-6) <= wavelength <= last * (1 + 1e-6):
            beyond.append(f"a wavelength of {wavelength * 1e9:.4g} nm beyond {first * 1e9:.4g} to {last * 1e9:.4g} nm")
        if beyond:
            warnings.warn(
                f"the lens {self.name!r} is asked for {' and '.join(beyond)}, and the edge of its table stands in: "
                f"make it with a wider range",
                LensRangeWarning,
                stacklevel=4,
            )

    # ------------------------------------------------------------------ files and states

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the lens to a safetensors file of some tens of kilobytes."""
        write_bytes(path, self._bytes())

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Read a lens written by :meth:`save`.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if the file is no lens, or a value is NaN or infinite.
        """
        tensors, notes = read_tensors(path, "lens")
        return cls._read(tensors, notes, str(path))

    def _bytes(self) -> bytes:
        tensors = {name: part.float().contiguous() for name, part in self._table.tensors().items()}
        tensors |= {name: getattr(self._table, name) for name in ("wavelengths", "defocus", "field")}
        tensors["scalars"] = torch.tensor([getattr(self, name) for name in _SCALARS], dtype=torch.float64)
        return save(tensors, {"format": _FORMAT, "name": self.name, "source": self.source})

    @classmethod
    def _read(cls, tensors: dict[str, Tensor], notes: Mapping[str, str], path: str) -> Self:
        names = {*LensTable.__dataclass_fields__, "scalars"}
        if notes.get("format") != _FORMAT or set(tensors) != names:
            raise ValueError(f"{path} is not a lens: its format is {notes.get('format')!r:.40} with {sorted(tensors)!r:.200}")
        for name, value in tensors.items():
            check_finite(f"{name} of {path}", value)
        scalars = tensors.pop("scalars")
        try:
            if tuple(scalars.shape) != (len(_SCALARS),):
                raise ValueError(f"scalars must have shape ({len(_SCALARS)},), got {tuple(scalars.shape)}")
            table = LensTable(**{name: value.double() for name, value in tensors.items()})
            given = dict(zip(_SCALARS, scalars.double().tolist(), strict=True))
            for name in ("focal_length", "f_number", "focus_distance"):
                check_positive(name, given[name])
            return cls(notes.get("name", ""), notes.get("source", ""), table=table, **given)
        except ValueError as error:
            raise ValueError(f"cannot read {path}: {error}") from None

    def extra_repr(self) -> str:
        """Return a one-line description."""
        low, high = self.defocus_range
        return (
            f"{self.name}: {self.focal_length * 1e3:.4g} mm f/{self.f_number:.3g}, focus at {self.focus_distance:.4g} m, "
            f"field to {self.field * 1e3:.3g} mm, psi {low:+.1f} to {high:+.1f}, "
            f"{', '.join(f'{w * 1e9:.0f}' for w in self.wavelengths)} nm, {self.residual:.4f} waves rms off"
        )


_SCALARS = ("focal_length", "f_number", "focus_distance", "residual")


Parts = tuple[str, str, float, float, float, LensTable, float]  # arguments of a lens


@lru_cache(maxsize=16)
def _named(name: str, f_number: float, focus: float, waves: tuple[float, ...], field: float | None) -> Parts:
    entry = NAMED_LENSES[name]
    lens = Lens.from_prescription(entry["prescription"], f_number, focus, waves, entry["field"] if field is None else field)
    return lens.name, lens.source, lens.focal_length, lens.f_number, lens.focus_distance, lens._table, lens.residual


def _traced(
    prescription: Prescription,
    f_number: float,
    focus: float,
    waves: tuple[float, ...],
    field: float,
    nearest: float | None,
) -> Parts:
    system = first_order(prescription, f_number, focus)
    scale = math.pi * system.pupil_radius**2 / REFERENCE_WAVELENGTH
    low = -scale / focus
    high = max(WIDEST, -low) if nearest is None else scale / nearest + low
    fit = fit_table(system, waves, field, (low, high))
    return prescription.name, prescription.source, system.focal_length, f_number, focus, fit.table, fit.residual


def _wavelengths(given: Sequence[float]) -> tuple[float, ...]:
    if isinstance(given, (str, int, float)) or not len(given):
        raise TypeError(f"wavelengths must be one or more numbers in metres such as {RGB}, got {given!r:.60}")
    for wavelength in given:
        check_number("wavelengths", wavelength, "metres")
        if not SHORTEST <= wavelength <= LONGEST:
            raise ValueError(f"wavelengths must be metres between {SHORTEST:g} and {LONGEST:g} (530 nm is 530e-9), got {wavelength}")
    return tuple(sorted({float(wavelength) for wavelength in given}))


def _check_focus(focus: float) -> None:
    check_number("focus_distance", focus, "metres")
    if not focus > 0:
        raise ValueError(f"focus_distance must be positive metres, got {focus}")


def _check_field(field: float) -> None:
    check_number("field", field, "metres")
    if field != 0:
        check_metres("field", field, 1e-6, 1.0, "21.6 mm is 21.6e-3")


def _half_diagonal(prescription: Mapping[str, Any]) -> float | None:
    """Return half the diagonal of the sensor that a prescription names, in metres."""
    sensor, pitch = prescription.get("sensor"), prescription.get("pitch_um")
    if sensor is None or pitch is None:
        return None
    if not isinstance(sensor, Sequence) or len(sensor) != 2 or isinstance(sensor, str):
        raise TypeError(f"sensor of the prescription must be (rows, columns), got {sensor!r:.60}")
    for value in (*sensor, pitch):
        check_positive("sensor and pitch_um of the prescription", value)
    return 0.5e-6 * pitch * math.hypot(*sensor)
