"""RenderPlan: the cheapest fidelity that captures a scene within an error.

The error meant is the root mean square difference of the noise-free capture, in linear light and full scale 1, from
the one that the preset ``reference`` would give. It is predicted from the scene's defocus and power spectrum, see
:mod:`kornia_tidy.capture_error`; the cost by formula, see :mod:`kornia_tidy.render_cost`. The candidates are all
combinations of layers, spacing, window, points a pixel and precision below.
"""

from __future__ import annotations

import warnings
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, Protocol

import torch
from torch import Tensor

from kornia_tidy.capture_error import (
    PSFSurvey,
    SceneErrors,
    defocus_histogram,
    natural_power,
    power_spectrum,
    region_power,
    spectrum_size,
)
from kornia_tidy.checks import check_choice, check_positive
from kornia_tidy.fidelity import Fidelity
from kornia_tidy.optics.psf_bank import PSFBank
from kornia_tidy.optics.pupil import Pupil
from kornia_tidy.optics.spectrum import Spectrum
from kornia_tidy.render_cost import BankGeometry, bank_operations, memory_bytes, rendering_operations, window_side
from kornia_tidy.scene.layers import LAYER_MODES, layer_weights

REFERENCE = Fidelity.preset("reference")
LAYER_SPACINGS = (8.0, 4.0, 2.0, 1.0, 0.5)
PIXEL_TOLERANCES = (1e-1, 2e-2, 1e-3, 1e-4, 1e-6)
WINDOW_RATIO = 1.2  # between a window that is tried and the next

SAFETY = 1.4  # on 35 photographs and 160 random scenes, measured errors were up to 1.3 times what the formula says
FLOAT32_ERROR = 3e-7  # root mean square, relative to the light; measured: 0.8e-7 to 1.5e-7
_SURVEY_TOLERANCE = 0.3  # of pixels: differences of PSFs need not be known better than to some per cent
_PIXEL_INTERVALS, _PIXEL_WINDOW = 8, 33  # where points a pixel are compared: most light is there


@dataclass(frozen=True)
class RenderPlan:
    """How to capture a scene, and what is known of it before. ``print`` it for a person.

    Args:
        fidelity: the setting, for ``optics.with_fidelity(plan.fidelity)``. Its window is fixed.
        reference: what the error is against: the preset, with the window of the masks as they are now.
        tolerance: error asked for.
        predicted_error: root mean square of the noise-free linear capture against ``reference``, full scale 1.
        operations: floating-point operations of one capture with its PSFs, see :mod:`kornia_tidy.render_cost`.
        memory_bytes: peak of one capture without gradients, beyond the image.
        reference_operations: what the reference would take.
        layers_present: layers that the scene takes light from.
        layers_total: layers of the camera's whole range.
        wavelengths: PSFs computed for each layer.
        light_held: least and largest share of the light in the window over the layers.
        reference_error: of the reference, against PSFs of its window computed for each pixel's own depth.
        error_parts: what each economy adds to ``predicted_error``, by name.
    """

    fidelity: Fidelity
    reference: Fidelity
    tolerance: float
    predicted_error: float
    operations: float
    memory_bytes: int
    reference_operations: float
    layers_present: int
    layers_total: int
    wavelengths: int
    light_held: tuple[float, float]
    reference_error: float
    error_parts: tuple[tuple[str, float], ...]

    def __str__(self) -> str:
        """Tell what is computed, what is skipped and why, and what it costs."""
        knobs, full = self.fidelity, self.reference
        held = " to ".join(dict.fromkeys(f"{share:.0%}" for share in self.light_held))
        skipped = [f"{self.layers_total - self.layers_present} of the layers, at depths that the scene does not have"]
        beyond = "" if knobs.window == full.window else f"light beyond {knobs.window} of {full.window} px and "
        reasons = {
            "layers and window": f"{beyond}PSFs between the layers",
            "points a pixel": "finer integration over pixels",
            "float32": "float64",
        }
        skipped += [f"{reasons[name]} (error {error:.1e})" for name, error in self.error_parts if error > 0]
        return "\n".join(
            [
                f"{knobs.name}: error {self.predicted_error:.1e} of full scale against the reference"
                + (", as nothing cheaper is within the tolerance" if knobs.name == full.name else ""),
                f"  computes: {self.layers_present} of {self.layers_total} {knobs.layers} layers of defocus, for each "
                f"PSFs at {self.wavelengths} wavelength{'s' if self.wavelengths != 1 else ''} of {knobs.window}x"
                f"{knobs.window} px that hold {held} of the light, in float{64 if knobs.double else 32}",
                "  skips: " + "; ".join(skipped),
                f"  costs: {self.operations:.1e} operations, {self.operations / self.reference_operations:.2%} of the "
                f"reference's, and {self.memory_bytes / 2**20:.0f} MiB",
                f"  the reference itself is {self.reference_error:.1e} from a PSF of its own for each depth",
            ]
        )


class PlannableCamera(Protocol):
    """What planning asks of a camera; :class:`kornia_tidy.TiDyOptics` is one."""

    masks: Any
    modulator: Any
    camera: Any
    spectrum: Any
    border: str
    compositing: str

    @property
    def pupil(self) -> Pupil:
        """The aperture."""
        ...

    @property
    def window(self) -> int:
        """Side of the PSFs."""
        ...

    @property
    def defocus_nodes(self) -> tuple[float, ...]:
        """Defocus of the layers in radians."""
        ...

    def with_fidelity(self, fidelity: Fidelity) -> PlannableCamera:
        """The camera at another fidelity."""
        ...

    def psf_bank(self, channels: int, dtype: torch.dtype, defocus: Sequence[float]) -> PSFBank:
        """PSFs at some defocus."""
        ...


class Planner:
    """Plans scenes for one camera, whose masks it surveys once, as they are when it is made.

    ``optics.plan`` is this for one scene and one tolerance.

    Args:
        optics: the camera.
        channels: of the images: as many as its spectrum has, or 1.

    Raises:
        ValueError: if the camera's compositing is neither gather nor scatter, whose errors follow from the PSFs'.

    Example:
        >>> from kornia_tidy import PixelwiseMask, TiDyOptics
        >>> planner = Planner(TiDyOptics(PixelwiseMask(1, initial="flat")), channels=3)
        >>> scene = planner.scene(torch.full((1, 1, 64, 64), -5.0))
        >>> [scene.plan(tolerance).predicted_error <= tolerance for tolerance in (1e-1, 1e-2)]
        [True, True]
    """

    def __init__(self, optics: PlannableCamera, channels: int) -> None:
        check_choice("the compositing of a camera to plan for", optics.compositing, ("gather", "scatter"))
        camera = optics.camera
        spectrum = optics.spectrum if channels == len(optics.spectrum.weights) else Spectrum.monochrome()
        step = float(camera.pixel_pitch * camera.aperture_radius / camera.image_distance)
        states = len(optics.modulator(optics.masks.phase)[1])
        self.geometry = BankGeometry(states, optics.pupil, spectrum.wavelengths, step)
        self.border, self.compositing = optics.border, optics.compositing
        self.defocus_range: tuple[float, float] = camera.defocus_range
        self.channels = channels
        self._optics = optics
        self._nodes: dict[tuple[str, float], tuple[float, ...]] = {}
        self._surveys: dict[int, tuple[Fidelity, PSFSurvey]] = {}
        self._pixels: dict[tuple[int, float], Tensor] = {}

    def scene(self, defocus: Tensor, light: Tensor | None = None) -> PlannedScene:
        """Return a scene to ask for errors and plans.

        Args:
            defocus: (B, 1, H, W) or (1, 1, H, W) radians.
            light: (B, C, H, W) linear light. Default: a typical photograph.
        """
        return PlannedScene(self, defocus, light)

    def nodes(self, fidelity: Fidelity) -> tuple[float, ...]:
        """Return the defocus of a fidelity's layers."""
        key = (fidelity.layers, fidelity.layer_spacing)
        if key not in self._nodes:
            self._nodes[key] = self._optics.with_fidelity(fidelity).defocus_nodes
        return self._nodes[key]

    def survey(self, height: int, width: int) -> tuple[Fidelity, PSFSurvey]:
        """Return the reference for images of this size, its window fixed, and its PSFs."""
        limit = min(REFERENCE.max_window, largest_window(self.border, height, width))
        if limit not in self._surveys:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # that the widest window allowed holds less than it should
                window = self._optics.with_fidelity(REFERENCE.replace(max_window=limit)).window
            reference = replace(REFERENCE, window=window)
            every = [self.nodes(fidelity) for fidelity in (reference, *_candidates((window,)))]
            survey = PSFSurvey(
                lambda nodes: self._bank(nodes, window, _SURVEY_TOLERANCE, torch.float32),
                (min(nodes[0] for nodes in every), max(nodes[-1] for nodes in every)),
                self.geometry.bandwidth,
            )
            self._surveys[limit] = reference, survey
        return self._surveys[limit]

    def pixel_changes(self, window: int, tolerance: float) -> tuple[tuple[float, ...], Tensor]:
        """Return some defocus, and what fewer points a pixel change in PSFs there, with all light in the window.

        PSFs in focus change most.
        """
        lo, hi = self.defocus_range
        between = (lo + (hi - lo) * i / _PIXEL_INTERVALS for i in range(_PIXEL_INTERVALS + 1))
        nodes = tuple(sorted({*between, min(max(0.0, lo), hi)}))
        key = (window, tolerance)
        if key not in self._pixels:
            ours, theirs = (
                self._bank(nodes, window, each, torch.float64).with_stray_light("renormalize").psfs.cpu()
                for each in (tolerance, REFERENCE.pixel_tolerance)
            )
            self._pixels[key] = ours - theirs
        return nodes, self._pixels[key]

    @torch.no_grad()
    def _bank(self, nodes: tuple[float, ...], window: int, tolerance: float, dtype: torch.dtype) -> PSFBank:
        raw = REFERENCE.replace(window=window, pixel_tolerance=tolerance, stray_light="discard")
        return self._optics.with_fidelity(raw).psf_bank(self.channels, dtype, nodes)


class PlannedScene:
    """A scene whose errors are predicted, for one plan or many. Made by :meth:`Planner.scene`."""

    @torch.no_grad()
    def __init__(self, planner: Planner, defocus: Tensor, light: Tensor | None) -> None:
        height, width = defocus.shape[-2:]
        batch = len(defocus if light is None else light)
        self._planner = planner
        self._counted: dict[tuple[str, float], tuple[int, int]] = {}
        self._points: dict[tuple[int, float], float] = {}
        self._shape = (batch, planner.channels, height, width)
        self.reference, self._survey = planner.survey(height, width)
        size = spectrum_size(window_side(self.reference))
        if light is None:
            power, self._level = natural_power(planner.channels, size), 0.5
        else:
            power = power_spectrum(light, planner.border, size)
            if planner.compositing != "gather":
                power = power + region_power(light, defocus, planner.border, size)
            self._level = float(light.double().square().mean().sqrt())
        self._psi, share = defocus_histogram(defocus, *planner.defocus_range)
        self._errors = SceneErrors(self._survey, self.reference, planner.nodes, self._psi, share, power)

    def error(self, fidelity: Fidelity) -> float:
        """Return the predicted error of a fidelity, full scale 1: at most its window is that of the reference.

        Raises:
            ValueError: if the fidelity is not one whose error is known.
        """
        if fidelity.propagation != "exact" or fidelity.stray_light != REFERENCE.stray_light:
            raise ValueError(
                f"errors are predicted for propagation 'exact' and stray_light {REFERENCE.stray_light!r}, got "
                f"{fidelity.propagation!r} and {fidelity.stray_light!r}"
            )
        if fidelity.window is None or fidelity.window > window_side(self.reference):
            raise ValueError(
                f"errors are predicted for a fixed window up to the reference's {self.reference.window}, got "
                f"{fidelity.window}"
            )
        return sum(error for _, error in self._parts(fidelity))

    def plan(self, tolerance: float) -> RenderPlan:
        """Return the cheapest candidate predicted to be within the tolerance.

        Where none is, that is the reference, whose error is zero by definition; the plan then says so.
        """
        check_positive("tolerance", tolerance)
        full = self.reference
        windows = window_ladder(window_side(full))
        # Narrower ones cannot do, whatever the layers: no need to look at them.
        first = bisect_left(windows, True, key=lambda w: self._errors(full.replace(window=w)) * SAFETY <= tolerance)
        ranked = sorted(_candidates(windows[first:]), key=self._operations)
        chosen = next((fidelity for fidelity in ranked if self.error(fidelity) <= tolerance), full)
        cheaper = self._operations(chosen) < self._operations(full)
        return self._described(
            replace(chosen, name=f"planned, tolerance {tolerance:g}") if cheaper else full, tolerance
        )

    def _described(self, fidelity: Fidelity, tolerance: float) -> RenderPlan:
        window = window_side(fidelity)
        present, made = self._layers(fidelity)
        nodes = self._planner.nodes(fidelity)
        held = self._survey.energy(nodes, window)
        return RenderPlan(
            fidelity=fidelity,
            reference=self.reference,
            tolerance=tolerance,
            predicted_error=self.error(fidelity),
            error_parts=tuple(self._parts(fidelity)),
            operations=self._operations(fidelity),
            reference_operations=self._operations(self.reference),
            memory_bytes=memory_bytes(self._planner.geometry, self._shape, self._planner.border, fidelity, made),
            layers_present=present,
            layers_total=len(nodes),
            wavelengths=len(self._planner.geometry.wavelengths),
            light_held=(float(held.min()), float(held.max())),
            reference_error=self._errors.of_reference(),
        )

    def _parts(self, fidelity: Fidelity) -> list[tuple[str, float]]:
        points = 0.0
        if fidelity.pixel_tolerance > REFERENCE.pixel_tolerance:
            key = (min(window_side(fidelity), _PIXEL_WINDOW), fidelity.pixel_tolerance)
            if key not in self._points:
                self._points[key] = self._errors.left_by(*self._planner.pixel_changes(*key))
            points = self._points[key]
        return [
            ("layers and window", SAFETY * self._errors(fidelity)),
            ("points a pixel", SAFETY * points),
            ("float32", 0.0 if fidelity.double else FLOAT32_ERROR * self._level),
        ]

    def _layers(self, fidelity: Fidelity) -> tuple[int, int]:
        """How many layers the scene takes light from, and of how many PSFs are made: all from first to last."""
        key = (fidelity.layers, fidelity.layer_spacing)
        if key not in self._counted:
            nodes = torch.tensor(self._planner.nodes(fidelity), dtype=torch.float64)
            weights = layer_weights(self._psi.view(1, 1, 1, -1), nodes, fidelity.layers)
            present = torch.nonzero((weights != 0).any(-1).flatten()).flatten().tolist()
            self._counted[key] = len(present), present[-1] - present[0] + 1
        return self._counted[key]

    def _operations(self, fidelity: Fidelity) -> float:
        present, made = self._layers(fidelity)
        return bank_operations(self._planner.geometry, fidelity, made) + rendering_operations(
            self._shape, self._planner.border, fidelity, present
        )


def largest_window(border: str, height: int, width: int) -> int:
    """Return the largest window that a border allows an image of this size; ``valid`` keeps half the view.

    Example:
        >>> largest_window("reflect", 48, 64), largest_window("valid", 48, 64)
        (95, 23)
    """
    side = min(height, width)
    limits = {"reflect": 2 * side - 1, "circular": 2 * side + 1, "valid": max(1, side // 2 - 1 + side // 2 % 2)}
    return limits.get(border, 2**31 - 1)


def window_ladder(largest: int) -> tuple[int, ...]:
    """Return the windows that are tried, ascending: each about a fifth narrower than the next.

    Example:
        >>> window_ladder(41)
        (3, 5, 7, 9, 11, 13, 15, 17, 21, 25, 29, 35, 41)
    """
    windows = [largest]
    while windows[0] > 3:
        windows.insert(0, min(windows[0] - 2, 2 * int(windows[0] / WINDOW_RATIO / 2) + 1))
    return tuple(windows)


def _candidates(windows: Sequence[int]) -> Iterator[Fidelity]:
    for double, tolerance, spacing, layers, window in product(
        (False, True), PIXEL_TOLERANCES, LAYER_SPACINGS, LAYER_MODES, windows
    ):
        yield replace(
            REFERENCE,
            window=window,
            layers=layers,
            layer_spacing=spacing,
            pixel_tolerance=tolerance,
            double=double,
        )
