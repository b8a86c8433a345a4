"""Lens: a real lens as a table of its wavefronts over field, depth and colour."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib import import_module
from typing import Any, Self

import torch
from torch import Tensor, nn

from kornia_tidy.checks import check_choice, check_number, check_part, described
from kornia_tidy.files import write_bytes
from kornia_tidy.optics.default_device import on_cpu
from kornia_tidy.optics.lens.ideal_table import read_zernike_table, seidel_wavefront
from kornia_tidy.optics.lens.lens_file import check_mask_shift, lens_bytes, lens_parts
from kornia_tidy.optics.lens.lens_table import LensSample, LensTable
from kornia_tidy.optics.lens.made_lenses import (
    RGB,
    LensParts,
    checked_wavelengths,
    ideal_parts,
    named_parts,
    traced_parts,
)
from kornia_tidy.optics.lens.named_lenses import NAMED_LENSES
from kornia_tidy.optics.lens.prescription import Prescription
from kornia_tidy.optics.lens.stop_quadrature import light_through_stop
from kornia_tidy.optics.thin_lens import ThinLensCamera
from kornia_tidy.tensor_files import parse_tensors, read_tensors

_SLACK = 3e-3  # of the range of defocus: lengths of a camera may differ by a thousandth from its lens's


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
        residual: largest rms over the stop of the table's error against the traced wavefronts, in waves.

    Convention:
        - The masks lie in the stop unless :meth:`with_masks_off_stop` moves them; positions in it are in stop radii.
          Depth counts from the entrance pupil.
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
        self._residual = residual  # no setting: it is known as well as its digits are
        self._table = table.rounded()  # as files hold it, so that a lens from a file is the same

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
            ValueError: if the lens is unknown, or cannot be traced.

        Example:
            >>> lens = Lens.named("triplet-50mm", f_number=8, focus_distance=0.595)
            >>> round(lens.focal_length * 1e3, 2)
            49.99
        """
        check_choice("name of a lens", name, tuple(NAMED_LENSES))
        numbers = {"f_number": f_number, "focus_distance": focus_distance, "field": 0.0 if field is None else field}
        for what, number in numbers.items():
            check_number(what, number)
        height = None if field is None else float(field)
        return cls(*named_parts(name, float(f_number), float(focus_distance), checked_wavelengths(wavelengths), height))

    @classmethod
    def from_prescription(
        cls,
        prescription: Mapping[str, Any] | Prescription | str | os.PathLike[str],
        f_number: float,
        focus_distance: float,
        wavelengths: Sequence[float] = RGB,
        field: float | None = None,
        nearest: float | None = None,
    ) -> Self:
        """Return a lens traced from its surfaces.

        Args:
            prescription: surfaces and glasses as plain data, see :meth:`~kornia_tidy.optics.lens.Prescription.read`; or
                a file: Zemax ``.zmx``, CODE V ``.seq``, or ``.json`` by Optiland, by DeepLens, or of such plain data.
            f_number: focal length over diameter of the entrance pupil.
            focus_distance: from the entrance pupil to the plane in focus, in metres; ``inf`` is allowed.
            wavelengths: in metres, one or more; light between them is interpolated.
            field: largest height on the sensor in metres. Default: half the diagonal of the prescription's
                ``"sensor"``, or the largest field of the file.
            nearest: nearest depth in metres. Default: half the focus distance, or that of a defocus of 20 rad if it is
                nearer.

        Raises:
            TypeError: if a value is of another type.
            ValueError: if a value is out of range, or the lens cannot be traced so.

        Convention:
            - The table reaches from infinity to the nearest depth.
            - Of files surfaces of revolution with one stop are read. A stop on a refracting surface becomes the plane
              through its vertex, on the side of air. Where the file has its object at infinity and its sensor near
              focus, the sensor keeps its distance from the paraxial focus at the file's primary wavelength.
        """
        return cls(*traced_parts(prescription, f_number, focus_distance, wavelengths, field, nearest))

    @classmethod
    def from_seidel(
        cls,
        focal_length: float,
        f_number: float,
        focus_distance: float,
        field: float,
        spherical: float = 0.0,
        coma: float = 0.0,
        astigmatism: float = 0.0,
        field_curvature: float = 0.0,
        distortion: float = 0.0,
        wavelengths: Sequence[float] = RGB,
    ) -> Self:
        r"""Return a thin lens with third-order aberrations, the same optical path at every wavelength and depth.

        .. math:: W = W_{040} \rho^4 + W_{131} h \rho^3 \cos\varphi + W_{222} h^2 \rho^2 \cos^2\varphi
            + W_{220} h^2 \rho^2

        Args:
            focal_length: in metres.
            f_number: focal length over diameter of the pupil.
            focus_distance: in metres; ``inf`` is allowed.
            field: largest height on the sensor in metres, at which h is 1.
            spherical: W040 in waves of 530 nm.
            coma: W131 in waves of 530 nm.
            astigmatism: W222 in waves of 530 nm.
            field_curvature: W220 in waves of 530 nm.
            distortion: by how much images are larger at the largest height, as a part of 1.
            wavelengths: in metres.

        Raises:
            ValueError: if a value is not finite, or out of range.

        Convention:
            - A positive W is a longer path, as that of positive defocus. The azimuth runs from the direction of the
              field on the sensor.

        Source: Welford, Aberrations of Optical Systems (1986), chapter 7.

        Example:
            >>> Lens.from_seidel(50e-3, 4.0, 1.0, 10e-3, coma=2.0).residual
            0.0
        """
        given = {
            "spherical": spherical,
            "coma": coma,
            "astigmatism": astigmatism,
            "field_curvature": field_curvature,
        }
        for name, value in {**given, "distortion": distortion}.items():
            check_number(name, value)
            if not abs(value) < 1e6:
                raise ValueError(f"{name} must be finite and below 1e6, got {value}")
        if not abs(distortion) < 1:
            raise ValueError(f"distortion must be a part of 1 between -1 and 1, got {distortion}")
        wavefront = seidel_wavefront(**given)
        waves = checked_wavelengths(wavelengths)
        return cls(
            *ideal_parts("Seidel", "", wavefront, waves, focal_length, f_number, focus_distance, field, distortion)
        )

    @classmethod
    def from_zernike_table(
        cls,
        path: str | os.PathLike[str],
        focal_length: float,
        f_number: float,
        focus_distance: float,
        order: str = "noll",
        sign: int = -1,
    ) -> Self:
        r"""Return a thin lens with wavefronts by Zernike coefficients over field and wavelength, from a CSV file.

        Args:
            path: file with the columns ``field_mm`` (height on the sensor, along +y), ``wavelength_nm`` (may be
                missing: 530) and ``Z1``, ``Z2``, ... in waves of that wavelength. Lines that start with # are left out.
            focal_length: in metres.
            f_number: focal length over diameter of the pupil.
            focus_distance: in metres; ``inf`` is allowed.
            order: ``"noll"`` (orthonormal) or ``"fringe"`` (of unit amplitude at the edge).
            sign: -1 where positive coefficients are a wavefront ahead of the sphere, as Zemax and Optiland have it; 1
                where they are a longer path.

        Raises:
            FileNotFoundError: if the file is missing.
            ValueError: if a value is missing, no number, or out of range.

        Example:
            >>> import tempfile
            >>> with tempfile.TemporaryDirectory() as folder:
            ...     with open(f"{folder}/lens.csv", "w") as file:
            ...         _ = file.write("field_mm,Z4,Z7\n0,0.1,0\n5,0.1,0.2\n10,0.1,0.4\n")
            ...     lens = Lens.from_zernike_table(f"{folder}/lens.csv", 50e-3, 4.0, 1.0)
            >>> lens.field
            0.01
        """
        wavefront, waves, field = read_zernike_table(path, order, sign)
        given = focal_length, f_number, focus_distance, field
        return cls(*ideal_parts("Zernike table", os.path.basename(path), wavefront, waves, *given))

    def with_masks_off_stop(self, mask_shift: float) -> Self:
        r"""Return this lens with the masks off its stop, where light of each field point passes another part of them.

        .. math:: U(\rho; h) = A \, e^{i \phi(\rho + \sigma h)}

        Args:
            mask_shift: :math:`\sigma` in stop radii per metre of height on the sensor. A mask in air at the distance d
                behind a stop of radius R, where the chief ray to the height h has the slope s, has
                :math:`\sigma = d s / (R h)`; in front of the stop it is negative. 0: in the stop.

        Raises:
            TypeError: if it is not a number.
            ValueError: if masks would move by more than a stop radius within the lens's field.

        Convention:
            - To first order: that light of one point converges between stop and masks, and that masks and the stop's
              edge diffract in two planes, is left out.
            - Masks and aperture move together. Beyond their 2.3 stop radii is the opaque frame, which vignettes.

        Source: Wei et al., Learned Off-aperture Encoding (2025), arXiv:2507.22523.

        Example:
            >>> lens = Lens.named("single-50mm", 17.6, 0.595).with_masks_off_stop(20.0)
            >>> lens.mask_shift
            20.0
        """
        check_mask_shift(mask_shift, self.field)
        return type(self)(*self._parts()._replace(table=replace(self._table, mask_shift=float(mask_shift))))

    def show(self, field: int = 5) -> Any:
        """Draw PSFs over field, depth and colour without masks, the spot diagram and the MTF, for pixels of 8 um.

        :func:`kornia_tidy.figures.draw_lens` draws those of a camera, with its masks and pixels.

        Args:
            field: number of heights from the axis to the corner.

        Returns:
            A figure of matplotlib; a notebook shows it, ``figure.savefig(path)`` writes it.

        Raises:
            ImportError: if matplotlib is missing.

        Example:
            >>> figure = Lens.from_seidel(50e-3, 17.6, 0.595, 5e-3, coma=1.0).show(field=2)
            >>> len(figure.axes) > 5
            True
        """
        return import_module("kornia_tidy.figures").draw_lens(self, field)  # only who draws needs figures

    # ------------------------------------------------------------------ its effect on light

    @property
    def field(self) -> float:
        """Largest height on the sensor in metres."""
        return float(self._table.field[0])

    @property
    def table(self) -> LensTable:
        """Coefficients of the lens."""
        return self._table

    @property
    def mask_shift(self) -> float:
        """Stop radii per metre of masks off the stop, see :meth:`with_masks_off_stop`."""
        return self._table.mask_shift

    @property
    def residual(self) -> float:
        """Largest rms over the stop of the table's error against traced wavefronts, in waves; 0 without any."""
        return self._residual

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

    @on_cpu
    def sample(self, heights: Tensor, defocus: Tensor, wavelength: float) -> LensSample:
        """Return the coefficients of field points at heights (F,) in metres and defocus (D,), at a wavelength.

        Beyond the table its edge stands in, with a :class:`LensRangeWarning`.
        """
        self.warn_if_beyond(heights, defocus, wavelength)
        return self._table.at(heights, defocus, wavelength)

    @on_cpu
    def relative_illumination(self, heights: Tensor, defocus: float = 0.0, wavelength: float = 530e-9) -> Tensor:
        """Return the irradiance of an even, white scene over that on the axis, (F,), with vignetting.

        Args:
            heights: (F,) in metres from the axis.
            defocus: of the scene in radians.
            wavelength: in metres.
        """
        sample = self.sample(_with_axis(heights), torch.tensor([defocus]), wavelength)
        areas = light_through_stop(sample)[:, 0]
        return areas[1:] / areas[0]

    @on_cpu
    def distortion(self, heights: Tensor, defocus: float = 0.0) -> Tensor:
        """Return the distortion, (F,): the image height over that of a pinhole at the entrance pupil, less one.

        Args:
            heights: (F,) in metres from the axis, where light of 530 nm lands.
            defocus: of the scene in radians.
        """
        heights = _with_axis(heights)
        self.warn_if_beyond(heights, torch.tensor([defocus]), None)
        slopes = self._table.slopes(heights, torch.tensor([defocus]))[:, 0]
        return slopes[0] / slopes[1:] - 1

    @on_cpu
    def lateral_colour(self, heights: Tensor, wavelength: float, defocus: float = 0.0) -> Tensor:
        """Return how much farther from the axis a wavelength lands than 530 nm, in metres, (F,).

        Args:
            heights: (F,) in metres from the axis.
            wavelength: in metres.
            defocus: of the scene in radians.
        """
        sample = self.sample(_with_axis(heights), torch.tensor([defocus]), wavelength)
        return heights * (sample.chief[1:, 0] - 1)

    def warn_if_beyond(self, heights: Tensor, defocus: Tensor, wavelength: float | None = None) -> None:
        """Give a :class:`LensRangeWarning` if the lens is not known at a height, a defocus or a wavelength.

        Args:
            heights: (F,) in metres from the axis.
            defocus: (D,) in radians.
            wavelength: in metres. Default: not looked at.
        """
        beyond = []
        if float(heights.max()) > self.field * (1 + 1e-6):
            beyond.append(f"a field of {float(heights.max()):.4g} m beyond {self.field:.4g} m")
        low, high = self.defocus_range
        slack = _SLACK * (high - low) + 1e-6
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
        write_bytes(path, lens_bytes(self._parts()))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Read a lens written by :meth:`save`.

        Raises:
            FileNotFoundError: if the file is missing.
            ValueError: if the file is not a lens, or a value is NaN or infinite.
        """
        return cls(*lens_parts(*read_tensors(path, "lens"), str(path)))

    def _parts(self) -> LensParts:
        return LensParts(*(getattr(self, name) for name in LensParts._fields))

    @on_cpu
    def get_extra_state(self) -> Tensor:
        """Return the lens as the bytes of its file, uint8."""
        return torch.frombuffer(bytearray(lens_bytes(self._parts())), dtype=torch.uint8).clone()

    @classmethod
    def of_state(cls, state: Tensor) -> Self:
        """Return the lens of :meth:`get_extra_state`, as states of cameras hold it under ``lens._extra_state``.

        Raises:
            ValueError: if it is damaged.
        """
        return cls(**_state_parts(state)._asdict())

    def set_extra_state(self, state: Tensor) -> None:
        """Take the lens of a state.

        Raises:
            ValueError: if it is damaged.
        """
        given = _state_parts(state)._asdict()
        self._table, self._residual = given.pop("table"), given.pop("residual")
        vars(self).update(given)

    def _load_from_state_dict(
        self,
        state_dict: Any,
        prefix: str,
        local_metadata: Any,
        strict: bool,
        missing_keys: list[str],
        unexpected_keys: list[str],
        error_msgs: list[str],
    ) -> None:
        lists = missing_keys, unexpected_keys, error_msgs
        super()._load_from_state_dict(state_dict, prefix, local_metadata, strict, *lists)
        if (key := f"{prefix}_extra_state") in missing_keys:  # a state of only masks does not change the lens
            missing_keys.remove(key)

    def extra_repr(self) -> str:
        """Return a one-line description."""
        low, high = self.defocus_range
        moved = f", masks off the stop by {self.mask_shift:+.3g} radii/m" if self.mask_shift else ""
        return (
            f"{self.name}: {self.focal_length * 1e3:.4g} mm f/{self.f_number:.3g}, focus at {self.focus_distance:.4g} "
            f"m, field to {self.field * 1e3:.3g} mm, psi {low:+.1f} to {high:+.1f}, "
            f"{', '.join(f'{w * 1e9:.0f}' for w in self.wavelengths)} nm, {self.residual:.4f} waves rms off{moved}"
        )


def _with_axis(heights: Tensor) -> Tensor:
    """Return heights (F,) with the axis, 0, before them, in float64."""
    check_part("heights", heights, Tensor, "a tensor (F,) of metres from the axis")
    if heights.ndim != 1 or not bool((heights >= 0).all()):  # True for NaN
        raise ValueError(f"heights must be zero or positive metres from the axis, (F,), got {heights.tolist()!r:.80}")
    return torch.cat([heights.new_zeros(1), heights]).double()


def _state_parts(state: Tensor) -> LensParts:
    what = "the lens in the state"
    if not isinstance(state, Tensor) or state.dtype != torch.uint8:
        raise ValueError(f"{what} must be bytes, got {described(state)}")
    return lens_parts(*parse_tensors(state.cpu().numpy().tobytes(), f"cannot read {what}: it is damaged"), what)
