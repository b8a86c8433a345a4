"""Planning: the cheapest fidelity that captures a scene within an error, found without capturing it.

The error meant is the root mean square difference of the noise-free capture, in linear light and full scale 1, from
the one that the preset ``reference`` would give. It is predicted from the scene's defocus and power spectrum, see
:mod:`kornia_tidy.capture_error`; the cost by formula, see :mod:`kornia_tidy.render_cost`. The candidates are all
combinations of layers, spacing, window, points a pixel and precision below, with the light outside the window spread
over the image or given back to the window, whichever is nearer to the truth.
"""

from __future__ import annotations

import warnings
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product
from typing import Any, Protocol

import torch
from torch import Tensor

from kornia_tidy.capture_error import (
    LayerErrors,
    change_error,
    chebyshev_nodes,
    defocus_histogram,
    layer_coefficients,
    natural_power,
    nodes_needed,
    power_spectrum,
    region_power,
    spectrum_size,
)
from kornia_tidy.checks import check_choice, check_positive
from kornia_tidy.fidelity import Fidelity
from kornia_tidy.optics.defocus_interpolation import TAPS, defocus_band, fine_nodes, guarded
from kornia_tidy.optics.psf_bank import PSFBank
from kornia_tidy.optics.pupil import Pupil
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH, Spectrum
from kornia_tidy.render_cost import (
    BankGeometry,
    Tiles,
    bank_seconds,
    count_tiles,
    label_pixels,
    memory_bytes,
    rendering_seconds,
    window_side,
)
from kornia_tidy.render_plan import RenderPlan
from kornia_tidy.scene.convolution import largest_window, pad_border
from kornia_tidy.scene.tiles import Labels

REFERENCE = Fidelity.preset("reference")
LAYER_SPACINGS = {
    "nearest": (8.0, 4.0, 2.0, 1.0),
    "linear": (8.0, 4.0, 2.0, 1.0, 0.5, 0.25),
    "cubic": (2.0, 1.0),
    "bandlimited": (2.0, 1.0),
}
PIXEL_TOLERANCES = (1e-1, 2e-2, 1e-3, 1e-6)
WINDOW_STRAY_LIGHT = ("veil", "renormalize")  # the veil is nearer unless the window is narrow, or one side bright
WINDOW_RATIO = 1.2  # between a window that is tried and the next

SAFETY = 1.4  # on 35 photographs measured errors were up to 1.2 times what the formula says
WINDOW_SAFETY = 1.7  # here up to 1.5 times: tails are looked at a few depths only
FLOAT32_ERROR = 3e-7  # root mean square, relative to the light; measured: 0.8e-7 to 1.5e-7
_SURVEY_TOLERANCE = 0.3  # of pixels: differences of PSFs need not be known better than to some per cent
_LAYERS_WINDOW = 65  # where layers are compared: beyond it lies a fifth of the light, and a few per cent of its square
_WINDOW_SPACING = 4.0  # radians between PSFs whose tails are compared
_PIXEL_INTERVALS, _PIXEL_WINDOW = 8, 33  # where points a pixel are compared: most light is there


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
        self.band = defocus_band(optics.pupil.max_rho2, min(optics.spectrum.wavelengths), REFERENCE_WAVELENGTH)
        self.border, self.compositing = optics.border, optics.compositing
        self.defocus_range: tuple[float, float] = camera.defocus_range
        self.channels = channels
        self._optics = optics
        self._nodes: dict[tuple[str, float], tuple[float, ...]] = {}
        self._references: dict[int, Fidelity] = {}
        self._layers: tuple[Tensor, Tensor] | None = None
        self._wide: dict[int, Tensor] = {}
        self._pixels: dict[float, Tensor] = {}

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

    def reference(self, height: int, width: int) -> Fidelity:
        """Return the reference for images of this size, its window fixed."""
        limit = min(REFERENCE.max_window, largest_window(self.border, height, width))
        if limit not in self._references:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # that the widest window allowed holds less than it should
                window = self._optics.with_fidelity(REFERENCE.replace(max_window=limit)).window
            self._references[limit] = replace(REFERENCE, window=window)
        return self._references[limit]

    def layer_survey(self) -> tuple[Tensor, Tensor]:
        """Return the Chebyshev nodes that carry the PSFs of every defocus, and those PSFs."""
        if self._layers is None:
            spans = [
                guarded(self.nodes(each), TAPS[each.layers] // 2) if each.layers in TAPS else self.nodes(each)
                for each in (REFERENCE, *_layer_kinds())
            ]
            lo, hi = min(nodes[0] for nodes in spans), max(nodes[-1] for nodes in spans)
            nodes = chebyshev_nodes(lo, hi, nodes_needed((hi - lo) / 2, self.geometry.bandwidth))
            window = self._smallest(_LAYERS_WINDOW)
            psfs = self._bank(tuple(nodes.tolist()), window, _SURVEY_TOLERANCE, torch.float32).psfs.cpu()
            self._layers = nodes, psfs
        return self._layers

    def window_survey(self, window: int) -> tuple[tuple[float, ...], Tensor]:
        """Return some defocus over the range, and the PSFs there."""
        nodes = self._spread(max(1, round((self.defocus_range[1] - self.defocus_range[0]) / _WINDOW_SPACING)))
        if window not in self._wide:
            self._wide[window] = self._bank(nodes, window, _SURVEY_TOLERANCE, torch.float32).psfs.cpu()
        return nodes, self._wide[window]

    def pixel_changes(self, tolerance: float) -> tuple[tuple[float, ...], Tensor]:
        """Return some defocus, and what fewer points a pixel change in PSFs there, where most of their light is.

        PSFs in focus change most.
        """
        lo, hi = self.defocus_range
        nodes = tuple(sorted({*self._spread(_PIXEL_INTERVALS), min(max(0.0, lo), hi)}))
        for each in (tolerance, REFERENCE.pixel_tolerance):
            if each not in self._pixels:
                self._pixels[each] = self._bank(nodes, self._smallest(_PIXEL_WINDOW), each, torch.float64).psfs.cpu()
        return nodes, self._pixels[tolerance] - self._pixels[REFERENCE.pixel_tolerance]

    def _smallest(self, window: int) -> int:
        """The window, or that of the smallest reference if it is smaller."""
        return min(window, *(window_side(reference) for reference in self._references.values()))

    def _spread(self, intervals: int) -> tuple[float, ...]:
        lo, hi = self.defocus_range
        return tuple(lo + (hi - lo) * i / intervals for i in range(intervals + 1))

    @torch.no_grad()
    def _bank(self, nodes: tuple[float, ...], window: int, tolerance: float, dtype: torch.dtype) -> PSFBank:
        raw = REFERENCE.replace(window=window, pixel_tolerance=tolerance, stray_light="discard")
        return self._optics.with_fidelity(raw).psf_bank(self.channels, dtype, nodes)


class PlannedScene:
    """A scene whose errors are predicted, for one plan or many. Made by :meth:`Planner.scene`."""

    @torch.no_grad()
    def __init__(self, planner: Planner, defocus: Tensor, light: Tensor | None) -> None:
        height, width = defocus.shape[-2:]
        self._batch = len(defocus if light is None else light)
        self._planner, self._defocus = planner, defocus.detach()
        self._known: dict[Any, float] = {}
        self._tiles: dict[tuple[str, Sequence[float], int], Tiles] = {}
        self._labelled: tuple[tuple[str, Sequence[float], int], Labels] | None = None
        self.reference = planner.reference(height, width)
        size = spectrum_size(window_side(self.reference))
        if light is None:
            self._power, self._level = natural_power(planner.channels, size), 0.5
        else:
            self._power = power_spectrum(light, planner.border, size)
            if planner.compositing != "gather":
                self._power = self._power + region_power(light, defocus, planner.border, size)
            self._level = float(light.double().square().mean().sqrt())
        self._psi, self._share = defocus_histogram(defocus, *planner.defocus_range)
        self._layers = LayerErrors(*planner.layer_survey(), self._psi, self._share, self._power)
        self._rows = self._layer_rows(self.reference)

    def error(self, fidelity: Fidelity) -> float:
        """Return the predicted error of a fidelity, full scale 1: at most its window is that of the reference.

        Raises:
            ValueError: if the fidelity is not one whose error is known.
        """
        if fidelity.propagation != "exact" or fidelity.stray_light == "discard":
            raise ValueError(
                f"errors are predicted for propagation 'exact' and stray_light 'veil' or 'renormalize', got "
                f"{fidelity.propagation!r} and {fidelity.stray_light!r}"
            )
        if fidelity.window is None or fidelity.window > window_side(self.reference):
            raise ValueError(
                f"errors are predicted for a fixed window up to the reference's {self.reference.window}, got "
                f"{fidelity.window}"
            )
        return sum(error for _, error in self._parts(fidelity))

    def seconds(self, fidelity: Fidelity) -> float:
        """Return the predicted time of a capture with its PSFs on one core, see :mod:`kornia_tidy.render_cost`."""
        planner = self._planner
        return bank_seconds(planner.geometry, fidelity, self._computed(fidelity)) + rendering_seconds(
            self._cut(fidelity), planner.channels, fidelity
        )

    def plan(self, tolerance: float) -> RenderPlan:
        """Return the cheapest candidate predicted to be within the tolerance.

        Where none is, that is the reference, whose error is zero by definition; the plan then says so.
        """
        check_positive("tolerance", tolerance)
        chosen = min(self._within(tolerance), key=self.seconds, default=self.reference)
        if self.seconds(chosen) >= self.seconds(self.reference):
            return self._described(self.reference, tolerance)
        return self._described(replace(chosen, name=f"planned, tolerance {tolerance:g}"), tolerance)

    def _within(self, tolerance: float) -> Iterator[Fidelity]:
        """Yield, for each way to save elsewhere, the narrowest window that stays within a tolerance."""
        windows = window_ladder(window_side(self.reference))
        for layers, double, points in product(_layer_kinds(), (False, True), PIXEL_TOLERANCES):
            full = replace(layers, window=windows[-1], double=double, pixel_tolerance=points)
            if self.error(full) > tolerance:
                continue
            for stray_light in WINDOW_STRAY_LIGHT:
                each = [replace(full, window=window, stray_light=stray_light) for window in windows[:-1]]
                first = bisect_left(each, True, key=lambda narrower: self.error(narrower) <= tolerance)
                yield (*each, full)[first]

    def _described(self, fidelity: Fidelity, tolerance: float) -> RenderPlan:
        planner, window = self._planner, window_side(fidelity)
        held = _cropped(planner.window_survey(window_side(self.reference))[1], window).sum((-2, -1))
        computed = self._computed(fidelity)
        return RenderPlan(
            fidelity=fidelity,
            reference=self.reference,
            tolerance=tolerance,
            predicted_error=self.error(fidelity),
            error_parts=tuple(self._parts(fidelity)),
            seconds=self.seconds(fidelity),
            reference_seconds=self.seconds(self.reference),
            memory_bytes=memory_bytes(planner.geometry, self._cut(fidelity), planner.channels, fidelity, computed),
            layers_present=computed,
            layers_total=len(self._samples(fidelity)),
            wavelengths=len(planner.geometry.wavelengths),
            light_held=(float(held.min()), float(held.max())),
            reference_error=self._layers(self._rows, self._layers.own_rows()),
        )

    def _parts(self, fidelity: Fidelity) -> list[tuple[str, float]]:
        window = window_side(fidelity)
        return [
            ("layers", SAFETY * self._layer_error(fidelity)),
            ("window", WINDOW_SAFETY * self._window_error(window, fidelity.stray_light)),
            ("points a pixel", SAFETY * self._point_error(fidelity.pixel_tolerance)),
            ("float32", 0.0 if fidelity.double else FLOAT32_ERROR * self._level),
        ]

    def _layer_rows(self, fidelity: Fidelity) -> Tensor:
        return self._layers.rows(self._planner.nodes(fidelity), fidelity.layers, self._planner.band)

    def _layer_error(self, fidelity: Fidelity) -> float:
        key = (fidelity.layers, fidelity.layer_spacing)
        if key not in self._known:
            self._known[key] = self._layers(self._layer_rows(fidelity), self._rows)
        return self._known[key]

    def _window_error(self, window: int, stray_light: str) -> float:
        key = (window, stray_light)
        full = window_side(self.reference)
        if key not in self._known:
            nodes, psfs = self._planner.window_survey(full)
            around = slice(
                max(0, bisect_right(nodes, float(self._psi[0])) - 1), bisect_left(nodes, float(self._psi[-1])) + 1
            )
            nodes, psfs = nodes[around], psfs[around]
            kept = _cropped(psfs, window)
            if stray_light == "renormalize":
                kept = kept / kept.sum((-2, -1), keepdim=True)
            changes = -psfs
            _cropped(changes, window).add_(kept)
            self._known[key] = change_error(nodes, changes, self._psi, self._share, self._power)
        return self._known[key]

    def _point_error(self, tolerance: float) -> float:
        if tolerance <= REFERENCE.pixel_tolerance:
            return 0.0
        if tolerance not in self._known:
            nodes, changes = self._planner.pixel_changes(tolerance)
            self._known[tolerance] = change_error(nodes, changes, self._psi, self._share, self._power)
        return self._known[tolerance]

    def _samples(self, fidelity: Fidelity) -> Sequence[float]:
        nodes = self._planner.nodes(fidelity)
        return guarded(nodes, TAPS[fidelity.layers] // 2) if fidelity.layers in TAPS else nodes

    def _computed(self, fidelity: Fidelity) -> int:
        """How many PSFs are computed for the scene: all from the first that it takes light from to the last."""
        key = ("computed", fidelity.layers, fidelity.layer_spacing)
        if key not in self._known:
            ends = torch.stack([self._psi.min(), self._psi.max()])
            weights, _ = layer_coefficients(ends, self._planner.nodes(fidelity), fidelity.layers, self._planner.band)
            used = torch.nonzero((weights != 0).any(0)).flatten()
            self._known[key] = int(used[-1] - used[0] + 1)
        return int(self._known[key])

    def _cut(self, fidelity: Fidelity) -> Tiles:
        """The scene in tiles, as the renderer will cut it."""
        nodes, window = self._planner.nodes(fidelity), window_side(fidelity)
        nodes = fine_nodes(nodes) if fidelity.layers in TAPS else nodes
        mode = "nearest" if fidelity.layers == "nearest" else "linear"
        if (mode, nodes, window) not in self._tiles:
            margin = window // 2 if self._planner.border == "valid" or self._planner.compositing != "gather" else 0
            if self._labelled is None or self._labelled[0] != (mode, nodes, margin):  # one at a time: they are large
                seen = self._seen(margin)
                self._labelled = (mode, nodes, margin), label_pixels(seen, self._batch, nodes, mode)
            self._tiles[mode, nodes, window] = count_tiles(self._labelled[1], len(nodes), window)
        return self._tiles[mode, nodes, window]

    def _seen(self, margin: int) -> Tensor:
        """Defocus of the pixels that are rendered: with ``valid`` fewer than those of the image, with scatter more."""
        border = self._planner.border
        if border == "valid":
            height, width = self._defocus.shape[-2:]
            return self._defocus[..., margin : height - margin, margin : width - margin]
        return pad_border(self._defocus, margin, "replicate" if border == "zero" else border)


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


def _layer_kinds() -> Iterator[Fidelity]:
    for layers, spacings in LAYER_SPACINGS.items():
        for spacing in spacings:
            yield replace(REFERENCE, layers=layers, layer_spacing=spacing)


def _cropped(psfs: Tensor, window: int) -> Tensor:
    margin = (psfs.shape[-1] - window) // 2
    return psfs[..., margin : margin + window, margin : margin + window]
