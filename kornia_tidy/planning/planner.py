"""Planner: choice of the cheapest fidelity within an error tolerance, predicted without rendering.

The error is the root mean square difference between the noise-free capture and that of the preset ``reference``, in
linear light with full scale 1. Light beyond full scale is not clipped: a highlight of 1000 gives errors a thousand
times those of white. The error is predicted from the power of the scene in each octave and at each depth, see
:mod:`kornia_tidy.planning.error_model`, and the cost is counted in operations, see
:mod:`kornia_tidy.planning.rendering_cost`. The candidates are all combinations of layers, spacing, window, quadrature
points per pixel and precision. The light outside the window is spread over the image or renormalised into the window,
whichever is more accurate.

The prediction is the sum of the errors of all single changes, each times a safety factor. It is an upper estimate,
which holds on the scenes of ``tests/planning/adversarial_scenes.py``. It is not a strict bound, since the light of one
octave is assumed to have random phases.

Occlusion is not a sum over layers. Its error from changes of PSFs is estimated as that of scatter, for two images: the
light itself, and its difference to the brightest light nearby, since dark objects occlude bright ones. Three errors are
added that scatter does not have: the position of layers at occluding edges, the sharpness of outlines with a PSF cut to
its window, and the darkening of pixels that are reached by a small part of a PSF.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import product, repeat
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from kornia_tidy.checks import check_positive
from kornia_tidy.fidelity import Fidelity
from kornia_tidy.planning.bank_cost import bank_operations, memory_bytes, window_side
from kornia_tidy.planning.candidates import PIXEL_TOLERANCES, REFERENCE, WINDOW_STRAY_LIGHT, layer_kinds, window_steps
from kornia_tidy.planning.depth_energy import Depths
from kornia_tidy.planning.error_model import LayerErrors, change_error, layer_coefficients
from kornia_tidy.planning.psf_samples import PlannableCamera, PSFSamples
from kornia_tidy.planning.render_plan import RenderPlan
from kornia_tidy.planning.rendering_cost import rendering_work
from kornia_tidy.planning.scene_light import CONTRAST, SceneLight, interpolation, spectrum_size
from kornia_tidy.psf.defocus_interpolation import TAPS, fine_nodes, guarded
from kornia_tidy.render.backend import Work
from kornia_tidy.render.backends.dense_occlusion import EPSILON
from kornia_tidy.render.stray_light import share_in_frame

SAFETY = 1.4  # factor for layers and wavelengths; measured errors are up to 1.2 times the formula
WINDOW_SAFETY = 1.7  # factor for windows; measured up to 1.5, as tails are sampled at a few depths only
FLOAT32_ERROR = 4e-7  # root mean square, relative to the light; measured with mutual intensity up to 3.3e-7
POINT_SAFETY = 1.6  # factor for quadrature points; measured up to 1.5, as they are sampled at a few depths only
OCCLUSION = 1.3  # ratio of occlusion's error to the prediction for scatter; measured up to 1.1, before SAFETY
OCCLUSION_WINDOW = 1.3  # the same ratio for windows
ORDER_ERROR = 4e-3  # of occlusion, relative to the contrast, per radian between linear layers; measured up to 1.9e-3
OUTLINE_ERROR = 2e-2  # the same, times the square root of the share of outline pixels; measured up to 1.9e-2
_OUTLINE = 1.0  # rad between neighbouring pixels; larger steps are outlines of objects
_ENOUGH = 0.05  # of the tolerance: with errors below it, more wavelengths bring nothing


class Planner:
    """Planner of scenes for one camera; PSF samples of the masks are computed once and shared by all scenes.

    The samples belong to the masks at the time of construction. ``optics.plan`` plans one scene for one tolerance.

    Args:
        optics: the camera.
        channels: number of channels of the images: that of the spectrum, or 1.

    Example:
        >>> from kornia_tidy import PixelwiseMask, TiDyOptics
        >>> planner = Planner(TiDyOptics(PixelwiseMask(1, initial="flat")), channels=3)
        >>> scene = planner.scene(torch.full((1, 1, 64, 64), -5.0))
        >>> [scene.plan(tolerance).predicted_error <= tolerance for tolerance in (1e-1, 1e-2)]
        [True, True]
    """

    def __init__(self, optics: PlannableCamera, channels: int) -> None:
        self.samples = PSFSamples(optics, channels)

    def scene(self, defocus: Tensor, light: Tensor | None = None) -> PlannedScene:
        """Return a scene to ask for errors and plans.

        Args:
            defocus: (B, 1, H, W) or (1, 1, H, W) radians.
            light: (B, C, H, W) linear light. Default: a typical photograph.
        """
        return PlannedScene(self.samples, defocus, light)


class PlannedScene:
    """Error prediction and plans for one scene, made by :meth:`Planner.scene`."""

    @torch.no_grad()
    def __init__(self, samples: PSFSamples, defocus: Tensor, light: Tensor | None) -> None:
        height, width = defocus.shape[-2:]
        self._batch = len(defocus if light is None else light)
        self._samples, self._defocus = samples, defocus.detach()
        self._known: dict[Any, float] = {}
        self._works: dict[Any, Work] = {}
        self.reference = samples.reference(height, width)
        size = spectrum_size(window_side(self.reference))
        colours = range(1, len(samples.spectrum.basis or (1,)))
        margin = window_side(self.reference) // 2 if samples.border == "valid" else 0
        bins = 256 if samples.compositing == "gather" else 128
        self._depths = Depths(defocus, *samples.defocus_range, samples.border, margin, bins)
        if light is None:  # differences between channels are assumed as large as between pixels
            self._light, self._level = SceneLight.unseen(self._depths, samples.channels, size), 0.5
            self._contrast = CONTRAST
            self._apart = torch.full((samples.channels, len(self._depths.psi)), CONTRAST, dtype=torch.float64)
            self._colours = [self._light for _ in colours]
        else:
            self._light, self._level = self._seen_light(light, size), float(light.double().square().mean().sqrt())
            self._contrast = float(light.double().std(correction=0))
            means = self._depths.means(light)  # mean light of each depth less that of the image
            self._apart = means / self._depths.share - means.sum(1, keepdim=True)
            self._colours = [self._seen_light(light.roll(-k, 1) - light, size) for k in colours]
        self._layers = LayerErrors(*samples.layer_samples(window_side(self.reference)), self._light)
        self._rows = self._layer_rows(self.reference)

    def _seen_light(self, light: Tensor, size: int) -> SceneLight:
        return SceneLight.seen(light, self._depths, self._samples.border, size, self._samples.compositing)

    def error(self, fidelity: Fidelity) -> float:
        """Return the predicted error of a fidelity, full scale 1; its window is at most that of the reference.

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
        if self._samples.captures > 1 and fidelity.occlusion_states != "each":
            raise ValueError(f"errors are predicted for occlusion_states 'each', got {fidelity.occlusion_states!r}")
        return sum(error for _, error in self._parts(fidelity))

    def operations(self, fidelity: Fidelity) -> float:
        """Return the operations of a capture with its PSFs, those of float64 counted twice."""
        samples = self._samples
        bank = bank_operations(samples.geometry(fidelity), fidelity, self._computed(fidelity))
        return (samples.captures if self._occlusion else 1) * (bank + self._work(fidelity).operations)

    def plan(self, tolerance: float) -> RenderPlan:
        """Return the cheapest candidate predicted to be within the tolerance.

        If no candidate is, the plan is the reference, which has no error by definition.
        """
        check_positive("tolerance", tolerance)
        chosen = min(self._within(tolerance), key=self.operations, default=self.reference)
        if self.operations(chosen) >= self.operations(self.reference):
            return self._described(self.reference, tolerance)
        return self._described(replace(chosen, name=f"planned, tolerance {tolerance:g}"), tolerance)

    def _within(self, tolerance: float) -> Iterator[Fidelity]:
        """Yield the narrowest window within a tolerance for each combination of the other settings."""
        windows, counts = window_steps(window_side(self.reference)), tuple(self._wavelength_counts(tolerance))
        for layers, double, points, count in product(layer_kinds(), (False, True), PIXEL_TOLERANCES, counts):
            full = replace(layers, window=windows[-1], double=double, pixel_tolerance=points, wavelengths=count)
            if self.error(full) > tolerance:
                continue
            for stray_light in WINDOW_STRAY_LIGHT:
                each = [replace(full, window=window, stray_light=stray_light) for window in windows[:-1]]
                first = bisect_left(each, True, key=lambda narrower: self.error(narrower) <= tolerance)
                yield (*each, full)[first]

    def _wavelength_counts(self, tolerance: float) -> Iterator[int | None]:
        """Yield candidate numbers of wavelengths, up to the first with an error small against the tolerance."""
        for count in self._samples.wavelength_counts():
            error = SAFETY * self._wavelength_error(count)
            if error <= tolerance:
                yield count
            if error <= _ENOUGH * tolerance:
                return
        yield None

    def _described(self, fidelity: Fidelity, tolerance: float) -> RenderPlan:
        samples, window = self._samples, window_side(fidelity)
        held = _cropped(samples.window_samples(window_side(self.reference))[1], window).sum((-2, -1))
        return RenderPlan(
            fidelity=fidelity,
            reference=self.reference,
            tolerance=tolerance,
            predicted_error=self.error(fidelity),
            error_parts=tuple(self._parts(fidelity)),
            operations=self.operations(fidelity),
            reference_operations=self.operations(self.reference),
            memory_bytes=self._memory(fidelity),
            layers_present=self._computed(fidelity),
            layers_total=len(self._sampled_defocus(fidelity)),
            states=samples.captures,
            wavelengths=len(samples.geometry(fidelity).wavelengths),
            wavelengths_total=len(samples.spectrum.wavelengths),
            light_held=(float(held.min()), float(held.max())),
            reference_error=self._layers(self._rows, self._layers.own_rows()),
        )

    def _parts(self, fidelity: Fidelity) -> list[tuple[str, float]]:
        share, of_window = (OCCLUSION, OCCLUSION_WINDOW) if self._occlusion else (1.0, 1.0)
        share, of_window = (factor / self._share_in_frame for factor in (share, of_window))
        narrower = window_side(fidelity) < window_side(self.reference)
        ways = (fidelity.stray_light, *(["outlines"] if self._occlusion and narrower else []))
        window_error = of_window * max(self._window_error(window_side(fidelity), way) for way in ways)
        layer_error = SAFETY * share * self._layer_error(fidelity)
        return [
            ("layers", layer_error + self._order_error(fidelity) + self._dark_error(fidelity)),
            ("window", WINDOW_SAFETY * window_error + self._spread_error(fidelity)),
            ("points a pixel", POINT_SAFETY * share * self._point_error(fidelity.pixel_tolerance)),
            ("wavelengths", SAFETY * share * self._wavelength_error(fidelity.wavelengths)),
            ("float32", 0.0 if fidelity.double else FLOAT32_ERROR * self._level),
        ]

    @cached_property
    def _outlines(self) -> float:
        """Share of the pixels that have a neighbour at another depth."""
        nearest, farthest = (max_pool2d(sign * self._defocus, 3, 1, 1) for sign in (1, -1))
        return float((nearest + farthest > _OUTLINE).double().mean())

    @cached_property
    def _share_in_frame(self) -> float:
        """Least share of a PSF inside the image, averaged over pixels; 1 unless occlusion has the border ``"zero"``.

        Occlusion divides by the cumulative alpha. With the border ``"zero"`` it covers the image alone: in a tiny image
        PSFs are renormalised by the small share inside it, and their errors grow likewise.
        """
        if not self._occlusion or self._samples.border != "zero":
            return 1.0
        psfs = self._samples.window_samples(window_side(self.reference))[1]
        shares = share_in_frame(psfs, self._defocus.shape[-2:]) / psfs.sum((-2, -1))
        return min(1.0, float(shares.amin()))

    def _layer_rows(self, fidelity: Fidelity) -> Tensor:
        return self._layers.rows(self._samples.nodes(fidelity), fidelity.layers, self._samples.band)

    def _layer_error(self, fidelity: Fidelity) -> float:
        key = (fidelity.layers, fidelity.layer_spacing)
        if key not in self._known:
            self._known[key] = self._layers(self._layer_rows(fidelity), self._rows)
        return self._known[key]

    def _order_error(self, fidelity: Fidelity) -> float:
        """Return the error at occluding edges from layers at other positions than the reference's."""
        if not self._occlusion or fidelity.layers == "nearest":
            return 0.0  # nearest layers have much larger errors, which dominate
        own, theirs = self._rendered(fidelity), self._rendered(self.reference)
        if own == theirs:
            return 0.0
        each = max(ORDER_ERROR, OUTLINE_ERROR * self._outlines**0.5)
        return each * self._contrast * (own[-1] - own[0]) / (len(own) - 1)

    def _dark_error(self, fidelity: Fidelity) -> float:
        """Return the error of occlusion from the regularised division by the cumulative alpha.

        A layer with the share E of its PSF inside the window loses EPSILON / E of its light, so that white is not kept.
        """
        if not self._occlusion or self._is_reference(fidelity):
            return 0.0
        key = ("dark", fidelity.window)
        if key not in self._known:
            nodes, psfs = self._samples.window_samples(window_side(self.reference))
            held = _cropped(psfs, window_side(fidelity)).sum((-2, -1)).amin(1).double()
            lost = EPSILON / (interpolation(self._depths.psi, nodes) @ held) - EPSILON
            self._known[key] = 2 * self._level * float((self._depths.share @ lost.square()).sqrt())
        return self._known[key]

    def _spread_error(self, fidelity: Fidelity) -> float:
        """Return the error of occlusion from stray light with the mean of the image.

        Occlusion normalises each layer by its alpha, so the layer's stray light should have the mean of the layer.
        """
        if not self._occlusion or fidelity.stray_light != "veil":
            return 0.0
        key = ("spread", fidelity.window)
        if key not in self._known:
            nodes, psfs = self._samples.window_samples(window_side(self.reference))
            lost = psfs.sum((-2, -1)) - _cropped(psfs, window_side(fidelity)).sum((-2, -1))
            lost = interpolation(self._depths.psi, nodes) @ lost.double() * self._apart.T
            self._known[key] = float((self._depths.share @ lost.square()).mean().clamp(min=0).sqrt())
        return self._known[key]

    def _is_reference(self, fidelity: Fidelity) -> bool:
        return replace(fidelity, name=self.reference.name) == self.reference

    def _window_error(self, window: int, stray_light: str) -> float:
        key = (window, stray_light)
        full = window_side(self.reference)
        if key not in self._known:
            nodes, psfs = self._samples.window_samples(full)
            around = slice(
                max(0, bisect_right(nodes, float(self._depths.psi[0])) - 1),
                bisect_left(nodes, float(self._depths.psi[-1])) + 1,
            )
            nodes, psfs = nodes[around], psfs[around]
            if stray_light == "outlines":  # PSFs are normalised in both windows, with and without stray light
                psfs = psfs / psfs.sum((-2, -1), keepdim=True)
            kept = _cropped(psfs, window)
            if stray_light != "veil":
                kept = kept / kept.sum((-2, -1), keepdim=True)
            changes = -psfs
            _cropped(changes, window).add_(kept)
            self._known[key] = change_error(nodes, changes, self._light)
        return self._known[key]

    def _point_error(self, tolerance: float) -> float:
        if tolerance <= REFERENCE.pixel_tolerance:
            return 0.0
        if tolerance not in self._known:
            nodes, changes = self._samples.pixel_changes(tolerance, window_side(self.reference))
            self._known[tolerance] = change_error(nodes, changes, self._light)
        return self._known[tolerance]

    def _wavelength_error(self, count: int | None) -> float:
        if count is None or count >= len(self._samples.spectrum.wavelengths):
            return 0.0
        key = ("wavelengths", count)
        if key not in self._known:
            nodes, changes = self._samples.wavelength_changes(count, window_side(self.reference))
            lights = (self._light, *self._colours)
            self._known[key] = sum(map(change_error, repeat(nodes), changes, lights))
        return self._known[key]

    def _sampled_defocus(self, fidelity: Fidelity) -> Sequence[float]:
        nodes = self._samples.nodes(fidelity)
        return guarded(nodes, TAPS[fidelity.layers] // 2) if fidelity.layers in TAPS else nodes

    def _computed(self, fidelity: Fidelity) -> int:
        """Return the number of PSFs computed for the scene: all layers from its farthest to its nearest."""
        key = ("computed", fidelity.layers, fidelity.layer_spacing)
        if key not in self._known:
            ends = torch.stack([self._depths.psi[0], self._depths.psi[-1]])
            weights, _ = layer_coefficients(ends, self._samples.nodes(fidelity), fidelity.layers, self._samples.band)
            used = torch.nonzero((weights != 0).any(0)).flatten()
            self._known[key] = int(used[-1] - used[0] + 1)
        return int(self._known[key])

    def _memory(self, fidelity: Fidelity) -> int:
        samples, nodes = self._samples, self._rendered(fidelity)
        farthest, nearest = float(self._depths.psi[0]), float(self._depths.psi[-1])
        first, last = max(0, bisect_right(nodes, farthest) - 1), min(len(nodes) - 1, bisect_left(nodes, nearest))
        held = samples.captures * max(self._computed(fidelity), last - first + 1)
        rendering = self._work(fidelity).memory
        return memory_bytes(samples.geometry(fidelity), samples.planes, fidelity, held, rendering)

    def _rendered(self, fidelity: Fidelity) -> Sequence[float]:
        """Return the defocus of the rendered layers."""
        nodes = self._samples.nodes(fidelity)
        return fine_nodes(nodes) if fidelity.layers in TAPS else nodes

    def _work(self, fidelity: Fidelity) -> Work:
        """Return the work of the renderer for the scene."""
        samples, nodes, window = self._samples, self._rendered(fidelity), window_side(fidelity)
        layers = "nearest" if fidelity.layers == "nearest" else "linear"
        key = layers, nodes, window, fidelity.double
        if key not in self._works:
            self._works[key] = rendering_work(
                self._defocus,
                self._batch,
                samples.planes,
                nodes,
                window,
                layers=layers,
                compositing=samples.compositing,
                border=samples.border,
                double=fidelity.double,
            )
        return self._works[key]

    @property
    def _occlusion(self) -> bool:
        return self._samples.compositing == "occlusion"


def _cropped(psfs: Tensor, window: int) -> Tensor:
    margin = (psfs.shape[-1] - window) // 2
    return psfs[..., margin : margin + window, margin : margin + window]
