"""The PSF model: from masks, modulator, lens, spectrum and fidelity to point spread functions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from math import ceil, floor
from typing import Any, NamedTuple, NoReturn, Self, cast

import numpy as np
import torch
from torch import Tensor, nn

from kornia_tidy.checks import check_choice, check_finite, check_part
from kornia_tidy.fidelity import Fidelity
from kornia_tidy.masks.base import PhaseMasks, central_square
from kornia_tidy.masks.pixelwise import PixelwiseMask
from kornia_tidy.mode import Mode, torch_mode
from kornia_tidy.modulator.modulator import DwellTimes, Timeline, timeline_of
from kornia_tidy.optics.aperture import check_aperture
from kornia_tidy.optics.default_device import on_cpu
from kornia_tidy.optics.lens.lens import Lens
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH, Spectrum
from kornia_tidy.optics.thin_lens import DefocusRange, ThinLensCamera
from kornia_tidy.psf.camera_settings import digest_of, settings_of
from kornia_tidy.psf.defocus_interpolation import (
    TAPS,
    defocus_band,
    fine_nodes,
    interpolable_spacing,
    interpolated_bank,
    not_negative,
)
from kornia_tidy.psf.exact import exact_psf_bank
from kornia_tidy.psf.field import Field, check_center
from kornia_tidy.psf.field_bank import (
    FieldBank,
    check_field,
    checked_places,
    field_light,
    field_psf_bank,
    field_psfs,
    light_on_axis,
)
from kornia_tidy.psf.field_nodes import field_nodes
from kornia_tidy.psf.geometric_psf import blur_radius
from kornia_tidy.psf.learnable_aperture import LearnableAperture, check_open
from kornia_tidy.psf.lens_limits import (
    LEAST_WINDOW,
    MOST_DEFOCUS,
    PARTS,
    WIDEST_DISC,
    check_defocus_range,
    fitting_lens,
)
from kornia_tidy.psf.measured_field import measured_nodes
from kornia_tidy.psf.paper import PAPER_SIZE, paper_psf_bank, warn_if_aliased
from kornia_tidy.psf.psf_bank import BankOfPSFs, PSFBank, checked_nodes
from kornia_tidy.psf.psf_cache import MEMORY, nodes_around, values_of
from kornia_tidy.psf.psf_ops import operator_psf_bank
from kornia_tidy.psf.psf_window import FittedWindow, fitted_window
from kornia_tidy.psf.pupil import Pupil, pupil_over
from kornia_tidy.psf.spectral_binning import bin_spectrum
from kornia_tidy.psf.wide_blur import SMALLEST_WIDE_RADIUS, BlurGroup, WideBlur, blurs_widely, wide_blur, window_of
from kornia_tidy.psf.wide_psfs import is_flat, learnt_bank, wide_psfs

Points = tuple[tuple[float, float], ...]
AXIS: Points = ((0.0, 0.0),)
MOST_FIELDS = 8  # sizes and places of pictures with remembered nodes
_SAMPLING = 0.1  # tolerance of PSFs that only show where the light goes


class Layering(NamedTuple):
    """How PSFs are sampled over defocus and on the sensor.

    Args:
        nodes: defocus of the layers in radians.
        side: of the PSFs in pixels.
        blur: layers and grids of wide blur, or None.
    """

    nodes: tuple[float, ...]
    side: int
    blur: WideBlur | None


class CachedParts:
    """What follows from the parts of a PSF model and is found when it is first asked for: window, pupil, wide blur."""

    def __init__(self, window: FittedWindow | None = None) -> None:
        self.window: FittedWindow | None = window
        self.pupil: Pupil | None = None
        self.blur: WideBlur | None = None
        self.blur_known = False
        self.layering: tuple[object, Layering] | None = None  # and the attributes of parts that it follows from
        self.fields: dict[object, Field] = {}  # by size and place of the picture, and what else they follow from


class PSFModel:
    """A lens whose phase mask changes during one exposure: all that decides how a point of light spreads.

    A value: its attributes cannot be set, :meth:`replace` returns another one. The parameters of masks, modulator and
    camera may change, as in training; PSFs follow the parameters at the time of the request.

    Args:
        masks: phase masks. Default: five learnable 23x23 masks of uniform noise.
        camera: turns depth into defocus. Default: ``ThinLensCamera()``.
        modulator: turns masks into the states shown and their weights; its ``fill_factor``, where it has one, is the
            share of each mask pixel that modulates. Default: equal dwell times.
        fidelity: a preset's name or a :class:`~kornia_tidy.fidelity.Fidelity`.
        spectrum: wavelengths and how each channel weights them. Default: 610, 530 and 470 nm, one a channel.
        aperture: amplitude over the mask's pixels (N, N), with N the shorter side, or finer by a whole factor.
            Default: the pixels with centres in the disc; the smooth disc for ``NoMask``. (K, N, N): one for each mask.
            An ``nn.Parameter`` is learnt: see :class:`~kornia_tidy.psf.LearnableAperture`.
        lens: a :class:`~kornia_tidy.optics.Lens` with the masks in its stop, or the name of one, made for the
            camera's aperture and focus. Its stop and its rims cut the masks exactly, besides ``aperture``. Default: an
            ideal lens.

    Raises:
        TypeError: if a part is of another type.
        ValueError: if the lens is not that of the camera, the camera's defocus needs more than 4096 layers or PSFs
            eight times as wide as the largest window, a mask holds NaN, or parts do not fit a learnable aperture.

    Example:
        >>> model = PSFModel()
        >>> model.psf_bank(defocus=[-10.0, 0.0]).psfs.shape[:2]
        torch.Size([2, 3])
    """

    masks: PhaseMasks
    camera: ThinLensCamera | DefocusRange
    modulator: nn.Module
    fidelity: Fidelity
    spectrum: Spectrum
    aperture: Tensor | LearnableAperture | None
    lens: Lens | None
    measured: PSFBank | FieldBank | None  # PSFs in the place of the masks' own
    state: int | None  # the one state looked through, if not all
    moment: int | None  # the one moment looked at, if not the whole exposure
    measured_cut: bool  # whether measured PSFs are zero somewhere

    _sampled: Spectrum  # the spectrum, at no more wavelengths than the fidelity allows
    _derived: CachedParts
    _aperture_mark: object  # another one for each aperture that was set; it identifies remembered PSFs
    _remembers: bool  # PSFs, and the matrices that they are made by

    def __init__(
        self,
        masks: PhaseMasks | None = None,
        camera: ThinLensCamera | DefocusRange | None = None,
        modulator: nn.Module | None = None,
        fidelity: str | Fidelity = "balanced",
        spectrum: Spectrum | None = None,
        aperture: Tensor | LearnableAperture | None = None,
        lens: Lens | str | None = None,
    ) -> None:
        vars(self).update(measured=None, state=None, moment=None, measured_cut=False, _remembers=True)
        parts = self.replace(
            fidelity=Fidelity.of(fidelity),
            masks=PixelwiseMask() if masks is None else masks,
            camera=ThinLensCamera() if camera is None else camera,
            modulator=DwellTimes() if modulator is None else modulator,
            spectrum=Spectrum.rgb() if spectrum is None else spectrum,
            aperture=aperture,
            lens=lens,
        )
        vars(self).update(vars(parts))
        if self.fidelity.propagation == "paper":
            warn_if_aliased(self.camera.defocus_range, self.spectrum)
        _ = self.fitted

    def __setattr__(self, name: str, value: object) -> NoReturn:
        """Refuse: a model is a value."""
        raise AttributeError(f"{name} of a PSFModel cannot be set: take model.replace({name}=...)")

    def replace(self, **parts: Any) -> Self:
        """Return this model with other parts. Its window is measured when it is first asked for.

        Args:
            parts: by their names: ``masks``, ``camera``, ``modulator``, ``fidelity``, ``spectrum``, ``aperture``,
                ``lens``.

        Raises:
            TypeError: if a part is of another type.
            ValueError: if the lens is not that of the camera.

        Example:
            >>> model = PSFModel(fidelity="draft").replace(masks=PixelwiseMask(1, initial="flat"))
            >>> model.fidelity.name, model.masks.phase.shape
            ('draft', torch.Size([1, 23, 23]))
        """
        for name, value in parts.items():
            if name in PARTS:
                check_part(name, value, *PARTS[name])
        if "aperture" in parts:
            parts["_aperture_mark"] = object()
        if isinstance(aperture := parts.get("aperture"), nn.Parameter):
            parts["aperture"] = LearnableAperture(aperture)
        elif aperture is not None and not isinstance(aperture, LearnableAperture):
            check_part("aperture", aperture, (Tensor, np.ndarray), "a tensor of amplitudes (N, N) such as 23x23")
            parts["aperture"] = check_aperture(aperture, aperture.shape[-1])
        if "spectrum" in parts or "fidelity" in parts:
            fidelity, spectrum = parts.get("fidelity") or self.fidelity, parts.get("spectrum") or self.spectrum
            most = fidelity.wavelengths
            parts["_sampled"] = spectrum if most is None else bin_spectrum(spectrum, most)
        present = {**vars(self), **parts}
        if present["lens"] is not None:
            given = (present[name] for name in ("lens", "camera", "fidelity", "_sampled"))
            parts["lens"] = fitting_lens(*given)
        return self._replace(_derived=CachedParts(), **parts)

    def _replace(self, **fields: Any) -> Self:
        """Return a model with other fields. All other parts and the remembered PSFs are shared."""
        other = object.__new__(type(self))
        vars(other).update(vars(self), **fields)
        return other

    # ------------------------------------------------------------------ PSFs

    def psf_bank(
        self,
        channels: int | None = None,
        dtype: torch.dtype | None = None,
        defocus: Sequence[float] | None = None,
        *,
        field: Sequence[tuple[float, float]] | None = None,
    ) -> Any:
        """Return the PSFs of the present masks, averaged over the exposure; gradients reach the masks.

        A :class:`~kornia_tidy.psf.PSFBank`; over a field a :class:`~kornia_tidy.psf.FieldBank`.

        They are those of a point that reflects all wavelengths alike, whether or not the spectrum has a basis.
        Without gradients, PSFs are remembered while masks and camera do not change. Measured PSFs are mixed linearly
        between their nodes, as a capture mixes them. Those of one state: ``through_state(k).psf_bank()``.

        Args:
            channels: 1 for an image of one channel, which is taken at 530 nm. Default: those of the spectrum.
            dtype: float32 or float64. Default: float32, or float64 where the fidelity asks for it.
            defocus: ascending nodes in radians. Default: all of ``defocus_nodes``.
            field: points (y, x) in sensor pixels from the axis, of cameras with a lens: (F, D, C, P, P). Default: the
                axis.

        Raises:
            TypeError: if nodes or field are not numbers.
            ValueError: if nodes or points of the field are not one or more finite ones, field points are given without
                a lens, the data type is another one, or a node is beyond 2e4 rad.
        """
        if dtype is not None:
            check_choice("dtype", dtype, (torch.float32, torch.float64))
        defocus = defocus if defocus is None else checked_nodes(defocus)
        if defocus is not None and self.measured is None and max(map(abs, defocus)) > MOST_DEFOCUS:
            raise ValueError(f"defocus must be within {MOST_DEFOCUS:g} rad to be computed, got {max(defocus, key=abs)}")
        spectrum = self.spectrum_of(len(self.spectrum.weights) if channels is None else channels)
        dtype = dtype or (torch.float64 if self.fidelity.double else torch.float32)
        if self.measured is not None and (field is None or isinstance(self.measured, FieldBank)):
            places = None if field is None else checked_places(field)
            bank = self._measured_bank(spectrum, dtype, self.masks.phase.device, places)
            return bank if defocus is None else bank.at_defocus(defocus)
        nodes = self.defocus_nodes if defocus is None else defocus
        if field is not None:
            points, tolerance = check_field(field, self.lens), self.fidelity.pixel_tolerance
            self._warn_if_beyond(tuple(points), nodes, spectrum.wavelengths)
            given = self._of_lens(spectrum.flat(), nodes, self.window, points, tolerance)
            return field_psf_bank(*self.states(dtype), **given).with_stray_light(self.fidelity.stray_light)
        bank = self._computed_bank(spectrum.flat(), dtype, nodes)
        own = PSFBank(*(x.clone() for x in (bank.psfs, bank.defocus, bank.energy)))  # users may change these
        return own.with_stray_light(self.fidelity.stray_light)

    def _of_lens(
        self,
        spectrum: Spectrum,
        nodes: Sequence[float],
        window: int,
        field: Sequence[tuple[float, float]],
        tolerance: float,
    ) -> dict[str, Any]:
        """Return what PSFs behind a lens depend on besides states and weights."""
        return {
            "pupil": self.pupil,
            "spectrum": spectrum,
            "dispersion": [self.masks.dispersion(wavelength) for wavelength in spectrum.wavelengths],
            "defocus": nodes,
            "field": field,
            "lens": cast("Lens", self.lens),
            "pixel_pitch": self.camera.pixel_pitch,
            "window": window,
            "tolerance": tolerance,
        }

    def scene_bank(
        self,
        channels: int,
        dtype: torch.dtype,
        defocus: Tensor,
        *,
        each_state: bool = False,
        device: torch.device | None = None,
        field: Field | None = None,
    ) -> Any:
        """Return the PSFs that a scene needs; of depths it does not hold there are none.

        A :class:`~kornia_tidy.psf.PSFBank`; over a field a :class:`~kornia_tidy.psf.FieldBank`. Where the spectrum has
        a basis, (D, C B, P, P): those of a channel follow each other. The bank may be given out again: its tensors must
        not be changed.

        Args:
            channels: of the image: those of the spectrum, or 1.
            dtype: float32 or float64.
            defocus: the scene's defocus in radians, any shape.
            each_state: the PSFs of each state of the exposure in one bank, (D, S C, P, P), and not their average; of an
                ideal lens.
            device: of measured PSFs. Default: that of ``defocus``.
            field: of the picture, behind a real lens: the PSFs at its nodes.
        """
        spectrum = self._sampled if channels == len(self.spectrum.weights) else self.spectrum_of(channels)
        if self.measured is not None:
            places = None if field is None else field.points
            return self._measured_bank(spectrum, dtype, device or defocus.device, places)
        nodes, kind = self.layering.nodes, self.fidelity.layers
        stray_light = self.fidelity.stray_light, len(spectrum.basis or (1,))
        if kind in ("nearest", "linear"):
            held = nodes_around(nodes, defocus)
            return self._computed_bank(spectrum, dtype, held, each_state, stray_light, field=field)
        targets = nodes_around(fine_nodes(nodes), defocus)
        spacing, guards = (nodes[-1] - nodes[0]) / (len(nodes) - 1), TAPS[kind] // 2
        first = floor((targets[0] - nodes[0]) / spacing + 1e-9) - guards
        last = ceil((targets[-1] - nodes[0]) / spacing - 1e-9) + guards
        samples = tuple(nodes[0] + spacing * i for i in range(first, last + 1))
        bank = self._computed_bank(spectrum, dtype, samples, each_state, field=field)
        band = self._band() if kind == "bandlimited" else None
        bank = interpolated_bank(bank, samples, targets, band)
        bank = bank if spectrum.basis else not_negative(bank)
        return self._finished(bank, stray_light, spectrum, field)

    @on_cpu
    def _warn_if_beyond(self, points: Points, nodes: Sequence[float], wavelengths: Sequence[float]) -> None:
        lens = cast("Lens", self.lens)
        heights = torch.tensor([math.hypot(*point) * self.camera.pixel_pitch for point in points], dtype=torch.float64)
        for wavelength in {min(wavelengths), max(wavelengths)}:
            lens.warn_if_beyond(heights, torch.tensor(nodes, dtype=torch.float64), wavelength)

    def _finished(
        self, bank: PSFBank, stray_light: tuple[str, int] | None, spectrum: Spectrum, field: Field | None
    ) -> PSFBank | FieldBank:
        """Return PSFs after something was done about stray light, where it is not None; of a field with its light.

        PSFs of a field are given as (D, F C, P, P), each with the light that an ideal lens would give it.
        """
        if stray_light is None:
            return bank
        if field is None:
            return bank.with_stray_light(*stray_light)
        lens, pitch, pupil = cast("Lens", self.lens), self.camera.pixel_pitch, self.pupil
        passed, flat, nodes = pupil.transmission, spectrum.flat(), tuple(bank.defocus.tolist())

        def light_at(nodes: tuple[float, ...]) -> tuple[Tensor]:
            return (field_light(pupil, flat, nodes, field.points, lens, pitch).movedim(1, 0),)

        parts = "light", passed, pupil.cell_pitch, flat, field.points, lens.table, pitch, torch.get_num_threads()
        new = passed.requires_grad or torch_mode() & Mode.TRACED or not self._remembers
        (light,) = light_at(nodes) if new else MEMORY.recall(values_of(*parts), nodes, light_at)
        light = light.to(bank.psfs)
        light = light.repeat_interleave(bank.psfs.shape[1] // light[0].numel(), 2)  # (D, F, C)
        each = light.shape[1:]
        if stray_light == ("renormalize", 1):  # in one step with the light
            scale = light / bank.energy.clamp(min=torch.finfo(light.dtype).tiny).unflatten(1, each)
        else:
            bank, scale = bank.with_stray_light(*stray_light), light
        # Place by place, as compiled code takes them; new memory for all of them at once takes longer than the product.
        psfs, scales = bank.psfs.unflatten(1, each).unbind(1), scale[..., None, None].unbind(1)
        lit = torch.stack([own * there for own, there in zip(psfs, scales, strict=True)])
        veil = None if bank.veil is None else (bank.veil.unflatten(1, each) * light).movedim(1, 0)
        rest = bank.energy.unflatten(1, each).movedim(1, 0), light.movedim(1, 0), veil
        return FieldBank(lit, bank.defocus, lit.new_tensor(field.points), *rest)

    def field_of(self, size: tuple[int, int], center: tuple[float, float] = (0.0, 0.0)) -> Field | None:
        """Return where over a picture PSFs are to be known for the fidelity's tolerance; None for an ideal lens.

        Args:
            size: rows and columns of the picture.
            center: of the picture, y and x in sensor pixels from the lens's axis.

        Raises:
            TypeError: if the centre is not two numbers.
            ValueError: if it is not finite.
            NotImplementedError: while torch compiles or exports, which needs values.
        """
        if not self.varies:
            return None
        if torch.compiler.is_compiling():
            raise NotImplementedError(
                "a camera behind a real lens cannot be compiled or exported: call it from outside of torch.compile, or "
                "leave lens= out"
            )
        known, lens, camera, center = self._derived.fields, self.lens, self.camera, check_center(center)
        table, tolerance = None if lens is None else lens.table, self.fidelity.field_tolerance
        phase, one = self.masks.phase, self.state is not None or self.moment is not None
        masks = 1 if self.measured is not None or one or is_flat(phase) else len(phase)
        asked = size, center, table, camera.pixel_pitch, camera.defocus_range, self.measured, masks
        if (field := known.get(asked)) is None:
            if lens is None or self.measured is not None:
                bank = cast("FieldBank", self.measured)
                field = measured_nodes(bank.psfs, bank.field, size, center, tolerance)
            else:
                rows, columns = ((size[i] - 1) / 2 for i in (0, 1))
                corners = [(center[0] + y * rows, center[1] + x * columns) for y in (-1, 1) for x in (-1, 1)]
                self._warn_if_beyond(tuple(corners), camera.defocus_range, self._sampled.wavelengths)
                given = camera.defocus_range, min(self._sampled.wavelengths), camera.pixel_pitch, self.window / 4
                field = field_nodes(size, center, lens, *given, tolerance, masks)
            known[asked] = field
            if len(known) > MOST_FIELDS:
                known.pop(next(iter(list(known))), None)
        return field

    def group_bank(
        self, channels: int, dtype: torch.dtype, group: BlurGroup, nodes: tuple[float, ...] | None = None
    ) -> PSFBank:
        """Return the PSFs of a group of layers of wide blur, on its grid.

        Args:
            channels: of the image.
            dtype: float32 or float64.
            group: of :attr:`wide_blur`.
            nodes: those of the group's that are needed. Default: all.
        """
        stray_light = self.fidelity.stray_light, 1
        return self._computed_bank(
            self.spectrum_of(channels), dtype, nodes or group.nodes, stray_light=stray_light, group=group
        )

    def _computed_bank(
        self,
        spectrum: Spectrum,
        dtype: torch.dtype,
        nodes: tuple[float, ...],
        each_state: bool = False,
        stray_light: tuple[str, int] | None = None,
        group: BlurGroup | None = None,
        field: Field | None = None,
    ) -> Any:
        """Return the PSFs at these nodes, computed or remembered; those of a group of wide blur on its grid.

        Those of a field are (D, F C, P, P) before stray light is dealt with, and a bank over the field after that.
        """
        states, weights = self.states(dtype)
        traced, (_, side, blur), grid = torch_mode() & Mode.TRACED, self.layering, 1
        if group is not None:
            side, grid = group.window, group.grid
        learning = torch.is_grad_enabled() and (states.requires_grad or weights.requires_grad)
        amplitude = None if self.aperture is None or self._amplitude is None else self.pupil.amplitude
        learning = learning or (amplitude is not None and torch.is_grad_enabled() and amplitude.requires_grad)
        exact = partial(self._exact_psfs, spectrum, grid, points=AXIS if field is None else field.points)
        build = partial(exact, states, weights, window=side, each_state=each_state)
        if blur is not None and not traced and not each_state:
            if learning:  # the PSFs are remembered; their gradients are made in the backward pass
                with torch.no_grad():
                    bank = self._computed_bank(spectrum, dtype, nodes, group=group)
                bank = learnt_bank(bank, exact, states, weights, grid)
                return bank if stray_light is None else bank.with_stray_light(*stray_light)
            lens = blur, self.pupil, float(self.pixel_step), grid, len(spectrum.weights), side
            build = partial(wide_psfs, partial(exact, states, weights), *lens, like=states)

        def finished(bank: PSFBank) -> PSFBank | FieldBank:
            return self._finished(bank, stray_light, spectrum, field)

        unread = Mode.UNREAD in torch_mode()
        if not self._remembers or learning or traced or unread or next(self.camera.parameters(), None) is not None:
            return finished(build(nodes))
        # Sums of another number of threads are rounded in another order.
        parts = "PSFs", spectrum, side, grid, each_state, None if field is None else field.points
        lens = self.fidelity, self._aperture_mark, getattr(self.modulator, "fill_factor", 1.0)
        others = None if self.lens is None else self.lens.table, torch.get_num_threads()
        seen = states, weights, amplitude, self.masks, self.camera, *self.camera.buffers()
        if type(self.masks).dispersion is not PhaseMasks.dispersion:  # it may depend on buffers and on parameters
            seen += (*(self.masks.dispersion(wavelength) for wavelength in spectrum.wavelengths),)
        return MEMORY.recall(
            values_of(*parts, *lens, *others, *seen),
            nodes,
            lambda missing: (build(missing).psfs,),
            lambda psfs: finished(PSFBank(psfs, psfs.new_tensor(nodes), psfs.sum((2, 3)))),
            stray_light,
        )

    def _exact_psfs(
        self,
        spectrum: Spectrum,
        grid: int,
        states: Tensor,
        weights: Tensor,
        nodes: tuple[float, ...],
        window: int,
        *,
        each_state: bool = False,
        tolerance: float | None = None,
        points: Points = AXIS,
    ) -> PSFBank:
        pupil = self.pupil
        if not torch_mode() & (Mode.GRAPH | Mode.UNREAD):
            check_finite("the phase of the masks", states)
            if isinstance(self.aperture, LearnableAperture):
                check_open(pupil.amplitude)
            check_finite("the weights of the modulator", weights)
        # How the phase of the masks and the focus of the lens change from wavelength to wavelength.
        dispersion = [self.masks.dispersion(wavelength) for wavelength in spectrum.wavelengths]
        shift = [self.camera.chromatic_defocus(wavelength) for wavelength in spectrum.wavelengths]
        if self.lens is not None:
            given = self._of_lens(spectrum, nodes, window, points, tolerance or self.fidelity.pixel_tolerance)
            psfs = field_psfs(states, weights, **given)[0].flatten(1, 2)
            return PSFBank(psfs, states.new_tensor(nodes), psfs.sum((2, 3)))
        if self.fidelity.propagation == "paper":
            if pupil.fill_factor != 1:
                raise ValueError(
                    f"fidelity 'paper' has one sample a mask pixel and so no gaps between them, got a fill_factor of "
                    f"{pupil.fill_factor}"
                )
            return paper_psf_bank(states, weights, pupil.amplitude, spectrum, dispersion, nodes, shift)
        tolerance = self.fidelity.pixel_tolerance if tolerance is None else tolerance
        step = self.pixel_step * grid
        light = states, weights, pupil, spectrum, dispersion, nodes
        shaped = self.aperture is not None and self._amplitude is not None
        if torch_mode() == Mode.GRAPH and not (shaped or each_state or isinstance(step, Tensor)):
            return operator_psf_bank(*light, step, window, tolerance, shift)
        return exact_psf_bank(*light, step, window, tolerance, shift, each_state, self._remembers)

    def _measured_bank(
        self,
        spectrum: Spectrum,
        dtype: torch.dtype,
        device: torch.device | None = None,
        places: Sequence[tuple[float, float]] | None = None,
    ) -> Any:
        bank = cast("PSFBank | FieldBank", self.measured)
        if bank.psfs.shape[-3] != len(spectrum.weights):
            raise ValueError(f"the measured PSFs have {bank.psfs.shape[-3]} channels, not {len(spectrum.weights)}")
        if isinstance(bank, FieldBank):
            bank = bank.at_places(AXIS if places is None else places)
            bank = bank.at(0) if places is None else bank
        return bank.to(device, dtype)

    # ------------------------------------------------------------------ the exposure

    def states(self, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """Return the phase of each state over the pupil, (S, N, N) radians, and its share of the exposure, (S,).

        Where each mask has its own amplitude the share is that of the light; behind a real lens, which cuts that light,
        it is that of the time.
        """
        shown = timeline_of(self.modulator, self.masks.phase.to(dtype))
        if self.moment is not None:
            states, weights = shown.moment(self.moment)
        else:
            states, weights = shown.states, shown.durations if shown.mixture is None else shown.weights
            if self.lens is None and self.aperture is not None and self._amplitudes_differ:
                weights = weights * self.relative_light(dtype)
        if self.state is not None:
            states, weights = states[self.state : self.state + 1], torch.ones_like(weights[:1])
        return (states if states.shape[-1] == states.shape[-2] else central_square(states)), weights

    def timeline(self, dtype: torch.dtype) -> Timeline:
        """Return the modulator's states of the masks during one exposure, and their times."""
        return timeline_of(self.modulator, self.masks.phase.to(dtype))

    def relative_light(self, dtype: torch.dtype) -> Tensor:
        """Return the light that passes at each moment over that of the whole exposure, (M,): 1 of one aperture.

        Raises:
            ValueError: if each mask has its own amplitude, and the modulator shows other states than the masks.
        """
        shown, amplitude = self.timeline(dtype), self._amplitude
        if amplitude is None or amplitude.ndim == 2:
            return torch.ones_like(shown.durations)
        if self.lens is None:
            light = amplitude.square().sum((-2, -1))
        else:
            light = light_on_axis(self.pupil, amplitude, self.lens)
        light = light.to(shown.durations)
        return light / (shown.durations * light).sum()

    def state_weights(self, dtype: torch.dtype) -> Tensor:
        """Return the share of the exposure of each state that the modulator shows, (S,)."""
        weights = self.states(dtype)[1]
        if self.lens is None or not self._amplitudes_differ or self.state is not None or self.moment is not None:
            return weights
        return weights * self.relative_light(dtype)

    # ------------------------------------------------------------------ other models of the same parts

    def with_fidelity(self, fidelity: str | Fidelity) -> Self:
        """Return this model at another fidelity. The parts are shared, so masks learn through both.

        Args:
            fidelity: a preset's name or a :class:`~kornia_tidy.fidelity.Fidelity`, such as that of a plan.
        """
        return self.replace(fidelity=Fidelity.of(fidelity))

    def without_memory(self) -> Self:
        """Return this model without memory of PSFs and of intermediate results. Parts are shared.

        Example:
            >>> PSFModel().without_memory().psf_bank(defocus=[0.0]).psfs.shape[:2]
            torch.Size([1, 3])
        """
        return self._replace(_remembers=False)

    def through_state(self, state: int) -> Self:
        """Return this model with one state of its modulator shown all the time. The parts and the window are shared.

        Args:
            state: index among the states that the modulator shows.

        Raises:
            ValueError: if the state is unknown, or PSFs were measured, which are those of the whole exposure.

        Example:
            >>> model = PSFModel()
            >>> len(model.state_weights(torch.float32)), len(model.through_state(2).state_weights(torch.float32))
            (5, 1)
        """
        if self.measured is not None:
            raise ValueError("PSFs that were measured are known for the whole exposure, not for each state of it")
        count = len(self.state_weights(torch.float32))
        if not 0 <= state < count:
            raise ValueError(f"state must be from 0 to {count - 1}, got {state}")
        return self.of_state(state)._replace(_derived=CachedParts(self.fitted))

    def of_state(self, state: int) -> Self:
        """Return this model with one state, unchecked, and the results found for all of them, such as wide blur."""
        return self._replace(state=state if self.state is None else self.state)

    def through_moment(self, moment: int) -> Self:
        """Return this model with the modulator's state of one moment shown all the time: one state, or some at once.

        The parts and the window are shared.

        Args:
            moment: index among the moments of :meth:`timeline`.

        Raises:
            ValueError: if the moment is unknown.

        Example:
            >>> from kornia_tidy.modulator.modulator import DiffractionEfficiency
            >>> model = PSFModel(modulator=DiffractionEfficiency(0.75))
            >>> model.through_moment(2).state_weights(torch.float32)
            tensor([0.7500, 0.2500])
        """
        count = len(self.timeline(torch.float32).durations)
        if not 0 <= moment < count:
            raise ValueError(f"moment must be from 0 to {count - 1}, got {moment}")
        return self._replace(moment=moment, _derived=CachedParts(self.fitted))

    def with_bank(self, bank: PSFBank | FieldBank) -> Self:
        """Return this model with PSFs that were measured in the place of its masks'. The other parts are shared.

        Args:
            bank: with the channels of the spectrum. Other depths than it holds are seen as the nearest of them. Of one
                over the field each pixel sees the PSFs of its place, whether or not there is a lens.

        Example:
            >>> measured = PSFBank.from_measured(torch.rand(2, 3, 5, 5), torch.tensor([-5.0, 5.0]))
            >>> model = PSFModel().with_bank(measured)
            >>> model.window, torch.equal(model.psf_bank().psfs, measured.psfs)
            (5, True)
        """
        check_part("bank", bank, BankOfPSFs, "a PSFBank or a FieldBank, such as PSFBank.load reads")
        bank.check()
        cut = bool((bank.psfs == 0).any())
        mean = self.replace(fidelity=self.fidelity.replace(occlusion_states="mean"))
        return mean._replace(measured=bank, measured_cut=cut)

    def with_window(self, window: FittedWindow | None) -> Self:
        """Return this model with a window that is known; None measures it, and finds the pupil, when it is asked for.

        Raises:
            ValueError: if this model's window is fixed to another side.
        """
        if window is not None and self.fixed_window not in (None, window.side):
            raise ValueError(
                f"the state is that of another camera: its PSF window is {window.side} px, and this one's is fixed to "
                f"{self.fixed_window} px; set Fidelity.window, or take its settings over by "
                f"load_state_dict(state, take_over=True)"
            )
        return self._replace(_derived=CachedParts(window))

    # ------------------------------------------------------------------ what follows from the parts

    @property
    def defocus_nodes(self) -> tuple[float, ...]:
        """Defocus of the PSF bank's layers in radians: evenly spaced over the camera's range, unless blur is wide."""
        if self.measured is not None:
            return tuple(self.measured.defocus.tolist())
        if self.wide_blur is not None:
            return self.wide_blur.nodes
        lo, hi = self.camera.defocus_range
        spacing = self.fidelity.layer_spacing
        if self.fidelity.layers == "bandlimited":
            spacing = min(spacing, interpolable_spacing(self._band()))
        intervals = max(1, round((hi - lo) / spacing))
        return tuple(lo + (hi - lo) * i / intervals for i in range(intervals + 1))

    @property
    def layering(self) -> Layering:
        """Nodes, window and wide blur of computed PSFs: all that a capture needs before the PSFs.

        They stay while the camera's range and the modulator's pixels stay, and flat masks flat where blur is wide.
        """
        derived, mode = self._derived, torch_mode()
        parts = self.camera.defocus_range, getattr(self.modulator, "fill_factor", 1.0)
        if derived.layering is not None and derived.layering[0] == parts:
            known = derived.layering[1]
            if known.blur is None or Mode.GRAPH in mode or is_flat(self.states(torch.float32)[0]):
                return known
        side = self.window if mode & Mode.TRACED else self.fitted.side  # the light in it is measured at the first PSFs
        known = Layering(self.defocus_nodes, side, self.wide_blur)
        if not mode & Mode.TRACED:
            derived.layering = parts, known
        return known

    @property
    def varies(self) -> bool:
        """Whether PSFs have a place in the picture: behind a real lens, or measured at several places."""
        return self.lens is not None if self.measured is None else isinstance(self.measured, FieldBank)

    @property
    def fixed_window(self) -> int | None:
        """Side of the PSFs in pixels if the fidelity, or the measured PSFs, fix it."""
        if self.measured is not None:
            return self.measured.window
        return PAPER_SIZE if self.fidelity.propagation == "paper" else self.fidelity.window

    @property
    def window(self) -> int:
        """Side of the PSFs in pixels: fixed by the fidelity, or measured when the model was made."""
        if self._derived.window is None and self.measured is None and self.fixed_window is not None:
            self.check_layers()
            return self.fixed_window
        return self.fitted.side

    @property
    def fitted(self) -> FittedWindow:
        """The window and the share of the light in it, measured with the masks as they were at the first look."""
        _ = self.wide_blur  # which drops the window of flat masks that have been learnt since
        derived = self._derived
        if derived.window is None:
            derived.window = self._fitted_window()
            derived.window.warn_if_small(self.fidelity, stacklevel=3)
        return derived.window

    def _fitted_window(self) -> FittedWindow:
        if self.measured is not None:
            energy = self.measured.energy
            return FittedWindow(self.measured.window, (float(energy.min()), float(energy.max())))
        if (blur := self.wide_blur) is not None:
            return FittedWindow(blur.window, self._wide_light())
        self.check_layers()
        found = fitted_window(self._sampled_psfs, self.fidelity, self.fixed_window)
        if not found.enough and (disc := self._disc_window()) is not None:
            found = fitted_window(self._sampled_psfs, self.fidelity, disc)
            return found._replace(enough=found.held[0] >= self.fidelity.enclosed_energy)
        return found

    def _disc_window(self) -> int | None:
        """Return the side that holds the lens's widest defocus disc; None where ``max_window`` holds it.

        Also where that is below :data:`LEAST_WINDOW`, the disc is wider than :data:`WIDEST_DISC`, or most of a window
        would be diffraction around it, as of macro lenses.
        """
        step, shifts = self.pixel_step, [self.camera.chromatic_defocus(w) for w in self.spectrum.wavelengths]
        size = float(step.detach()) if isinstance(step, Tensor) else step
        lo, hi = self.camera.defocus_range
        radius = blur_radius(max(-(lo + min(*shifts, 0.0)), hi + max(*shifts, 0.0)), size)
        if not LEAST_WINDOW <= self.fidelity.max_window < 2 * radius <= WIDEST_DISC:
            return None
        side = window_of(radius, size, self.pupil.extent)
        return side if side < 2 * WIDEST_DISC else None

    @torch.no_grad()
    def _sampled_psfs(self, size: int) -> Tensor:
        """Return the PSFs at both ends of the range and at focus, good enough to see where the light goes.

        As shares of the light in the field: of what crosses a cell at a hard edge, a mean field holds a part only.
        """
        lo, hi = self.camera.defocus_range
        nodes = tuple(sorted({lo, min(max(0.0, lo), hi), hi}))
        states = self.states(torch.float32)
        psfs = self._exact_psfs(self._sampled.flat(), 1, *states, nodes, size, tolerance=_SAMPLING).psfs
        return psfs if self.fidelity.propagation == "paper" else psfs / self.pupil.field_share

    def check_layers(self) -> None:
        """Raise ``ValueError`` for a range of defocus that needs too many layers, or too wide PSFs, unless measured."""
        if self.measured is None and self.wide_blur is None:
            check_defocus_range(self.camera.defocus_range, self.pixel_step, self.fidelity, self.fixed_window)

    @property
    def pupil(self) -> Pupil:
        """The aperture over the masks' pixels."""
        fill_factor, pupil = getattr(self.modulator, "fill_factor", 1.0), self._derived.pupil
        if pupil is None or pupil.fill_factor != fill_factor:
            aperture = getattr(self.masks, "iris", None) if self.aperture is None else self.aperture
            if (amplitude := self._amplitude) is not None:  # any pixel may open
                aperture = torch.ones(amplitude.shape[-2:])
            elif self.lens is not None and self.aperture is None:  # its stop is the edge
                aperture = torch.ones(min(self.masks.phase.shape[-2:]), min(self.masks.phase.shape[-2:]))
            given = cast("Tensor | None", aperture)
            pupil = self._derived.pupil = pupil_over(self.masks.phase.shape, given, fill_factor)
        if self.aperture is None or (amplitude := self._amplitude) is None:
            return pupil
        shown = self.state if self.moment is None else self.moment
        dtype = torch.promote_types(self.masks.phase.dtype, torch.float32)
        times = amplitude.new_ones(1) if amplitude.ndim == 2 else self.timeline(dtype).durations
        if shown is not None and amplitude.ndim == 3:
            amplitude, times = amplitude[shown : shown + 1], torch.ones_like(times[:1])
        return pupil.with_amplitude(amplitude, times, cut=self.lens is not None)

    @property
    def _amplitude(self) -> Tensor | None:
        """Amplitude that is learnt, or one of several, one for each mask."""
        amplitude = self.aperture() if isinstance(self.aperture, LearnableAperture) else self.aperture
        if amplitude is None or (amplitude.ndim == 2 and amplitude is self.aperture):
            return None
        if amplitude.ndim == 3:
            shown = self.timeline(torch.float32)
            if shown.mixture is not None or len(shown.states) != len(amplitude):
                raise ValueError(
                    f"an aperture for each mask needs a modulator that shows the {len(amplitude)} masks one by one, "
                    f"such as DwellTimes(), got {len(shown.states)} states: give one aperture (N, N) for all"
                )
        return amplitude

    @property
    def _amplitudes_differ(self) -> bool:
        """Whether each mask has its own amplitude."""
        return (own := self._amplitude) is not None and own.ndim == 3

    def _band(self) -> float:
        return defocus_band(self.pupil.max_rho2, min(self.spectrum.wavelengths), REFERENCE_WAVELENGTH)

    @property
    def pixel_step(self) -> float | Tensor:
        """A sensor pixel seen from the pupil, in metres: see :func:`exact_psf_bank`."""
        return self.camera.pixel_pitch * self.camera.aperture_radius / self.camera.image_distance

    def spectrum_of(self, channels: int, remedy: str = "") -> Spectrum:
        """Return the wavelengths at which an image of so many channels is seen.

        Args:
            channels: those of the spectrum, or 1.
            remedy: to be put behind the message if it is another number.

        Raises:
            ValueError: if it is another number.
        """
        if channels == len(self.spectrum.weights):
            return self._sampled
        if channels == 1:
            grey = Spectrum.monochrome()
            if self.lens is not None:  # its table need not hold that
                self._warn_if_beyond(AXIS, self.lens.defocus_range, grey.wavelengths)
            return grey
        raise ValueError(
            f"image must have {len(self.spectrum.weights)} channels as the spectrum has, or 1, got {channels}{remedy}"
        )

    @property
    def wide_blur(self) -> WideBlur | None:
        """Layers and grids of a fast lens without a mask; None where masks are shown, or the blur is narrow.

        Found with the masks at the first request, and dropped when they are no longer flat.
        """
        derived = self._derived
        if (derived.blur is None and derived.blur_known) or Mode.GRAPH in torch_mode():
            return derived.blur
        if not derived.blur_known:
            derived.blur, derived.blur_known = self._find_wide_blur(), True
        elif not is_flat(self.states(torch.float32)[0]):
            derived.blur, derived.window = None, None
        return derived.blur

    def _find_wide_blur(self) -> WideBlur | None:
        camera, known, step = self.camera, self._derived.window, self.pixel_step
        if self.measured is not None or self.lens is not None or self.spectrum.basis is not None:
            return None
        if self.aperture is not None and self._amplitude is not None:
            return None
        if not self.fidelity.blurs_by_rays:
            return None
        # A focus that is learnt moves the PSFs' sampling; colours with different focuses have different discs.
        if isinstance(step, Tensor) or any(camera.chromatic_defocus(w) for w in self.spectrum.wavelengths):
            return None
        if not blurs_widely(camera.defocus_range, step) or getattr(self.modulator, "fill_factor", 1) != 1:
            return None
        if not is_flat(self.states(torch.float32)[0]):
            return None
        blur = wide_blur(camera.defocus_range, step, self.pupil)
        return blur if known is None or known.side == blur.window else None  # a window of another kind was loaded

    @torch.no_grad()
    def _wide_light(self) -> tuple[float, float]:
        """Return the least and largest share of the light in the windows of small discs; large ones hold more."""
        states, step, shares = self.states(torch.float32), float(self.pixel_step), []
        for radius in (0.0, 2.0, SMALLEST_WIDE_RADIUS):
            nodes = (radius * math.pi * step / REFERENCE_WAVELENGTH,)
            side = window_of(radius, step, self.pupil.extent)
            bank = self._exact_psfs(self._sampled.flat(), 1, *states, nodes, side, tolerance=_SAMPLING)
            shares.append(bank.energy)
        return float(torch.cat(shares).min()), float(torch.cat(shares).max())

    def settings(self) -> dict[str, Any]:
        """Return what shapes the PSFs besides the weights, by the names of the parts."""
        fidelity = settings_of(self.fidelity)
        fidelity.pop("window")  # the window has a separate entry
        if fidelity["wide_blur"] == Fidelity.wide_blur:  # states of earlier versions do not have it
            fidelity.pop("wide_blur")
        if self.lens is None:  # nor this
            fidelity.pop("field_tolerance")
        bank = self.measured
        over_field = (bank.field, bank.light) if isinstance(bank, FieldBank) else ()
        return {
            **{name: settings_of(getattr(self, name)) for name in ("masks", "camera", "modulator", "spectrum")},
            "fidelity": fidelity,
            "mask_pixels": list(self.masks.phase.shape[-2:]),
            "aperture": settings_of(self.aperture),
            "measured PSFs": None if bank is None else digest_of(bank.psfs, bank.defocus, bank.energy, *over_field),
            **({} if self.lens is None else {"lens": settings_of(self.lens)}),
            "state": self.state,
            "moment": self.moment,
        }
