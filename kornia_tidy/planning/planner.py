"""Planning: the cheapest fidelity that captures a scene within an error, found without capturing it.

The error meant is the root mean square difference of the noise-free capture, in linear light and full scale 1, from
the one that the preset ``reference`` would give. Light beyond full scale counts as it is: a highlight of 1000 makes
errors a thousand times those of white. The error is predicted from where in depth each octave of the scene's light
lies, see :mod:`kornia_tidy.planning.error_model`; the cost by formula, see :mod:`kornia_tidy.render.cost_model`. The
candidates are all combinations of layers, spacing, window, points a pixel and precision below, with the light outside
the window spread over the image or given back to the window, whichever is nearer to the truth.

The prediction adds up what each economy makes by itself, times a safety factor: an estimate from above, which holds on
the scenes of ``tests/planning/adversarial_scenes.py``. It is no proof: the light of one octave is taken to lie at
random.

Occlusion is no sum over layers, but what changes of PSFs make of it is near what they make of scatter, of two kinds of
light: the light itself, and what it lacks to the brightest around, as what is dark hides what is bright. To this comes
what scatter does not know: where one thing hides another, it matters where the layers lie; outlines are as sharp as a
PSF that is whole in its window; and what is seen by little of a PSF is a little too dark.
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
from kornia_tidy.planning.candidates import PIXEL_TOLERANCES, REFERENCE, WINDOW_STRAY_LIGHT, layer_kinds, window_ladder
from kornia_tidy.planning.depth_energy import Depths
from kornia_tidy.planning.error_model import LayerErrors, change_error, layer_coefficients
from kornia_tidy.planning.psf_samples import CameraSurvey, PlannableCamera
from kornia_tidy.planning.render_plan import RenderPlan
from kornia_tidy.planning.scene_light import CONTRAST, SceneLight, interpolation, spectrum_size
from kornia_tidy.psf.defocus_interpolation import TAPS, fine_nodes, guarded
from kornia_tidy.render.backends.dense_occlusion import EPSILON
from kornia_tidy.render.borders import pad_border
from kornia_tidy.render.cost_model import (
    Tiles,
    bank_seconds,
    count_tiles,
    label_pixels,
    memory_bytes,
    rendering_bytes,
    rendering_seconds,
    window_side,
)
from kornia_tidy.render.layers import Labels
from kornia_tidy.render.occlusion_cost import Windows, count_windows, windows_bytes, windows_seconds
from kornia_tidy.render.stray_light import share_in_frame

SAFETY = 1.4  # on photographs and adversarial scenes measured errors were up to 1.2 times what the formula says
WINDOW_SAFETY = 1.7  # here up to 1.5 times: tails are looked at a few depths only
FLOAT32_ERROR = 4e-7  # root mean square, relative to the light; that of PSFs by mutual intensity is up to 3.3e-7
POINT_SAFETY = 1.6  # up to 1.5 times: they are looked at a few depths only too, and change fast about focus
OCCLUSION = 1.3  # of what is predicted for scatter; on adversarial scenes measured up to 1.1 before SAFETY
OCCLUSION_WINDOW = 1.3  # of a window likewise
ORDER_ERROR = 4e-3  # of occlusion: of the contrast, for a radian between linear layers; on photographs up to 1.9e-3
OUTLINE_ERROR = 2e-2  # the same for the square root of the share of pixels on outlines; on checkerboards up to 1.9e-2
_OUTLINE = 1.0  # rad between neighbours: an outline, not a slope
_ENOUGH = 0.05  # of the tolerance: more wavelengths than leave this gain nothing


class Planner:
    """Plans scenes for one camera, whose masks it surveys once, as they are when it is made.

    ``optics.plan`` is this for one scene and one tolerance.

    Args:
        optics: the camera.
        channels: of the images: as many as its spectrum has, or 1.

    Example:
        >>> from kornia_tidy import PixelwiseMask, TiDyOptics
        >>> survey = Planner(TiDyOptics(PixelwiseMask(1, initial="flat")), channels=3)
        >>> scene = survey.scene(torch.full((1, 1, 64, 64), -5.0))
        >>> [scene.plan(tolerance).predicted_error <= tolerance for tolerance in (1e-1, 1e-2)]
        [True, True]
    """

    def __init__(self, optics: PlannableCamera, channels: int) -> None:
        self.survey = CameraSurvey(optics, channels)

    def scene(self, defocus: Tensor, light: Tensor | None = None) -> PlannedScene:
        """Return a scene to ask for errors and plans.

        Args:
            defocus: (B, 1, H, W) or (1, 1, H, W) radians.
            light: (B, C, H, W) linear light. Default: a typical photograph.
        """
        return PlannedScene(self.survey, defocus, light)


class PlannedScene:
    """A scene whose errors are predicted, for one plan or many. Made by :meth:`Planner.scene`."""

    @torch.no_grad()
    def __init__(self, survey: CameraSurvey, defocus: Tensor, light: Tensor | None) -> None:
        height, width = defocus.shape[-2:]
        self._batch = len(defocus if light is None else light)
        self._survey, self._defocus = survey, defocus.detach()
        self._known: dict[Any, float] = {}
        self._tiles: dict[tuple[str, Sequence[float], int], Tiles | Windows] = {}
        self._labelled: tuple[tuple[str, Sequence[float], int], Labels] | None = None
        self.reference = survey.reference(height, width)
        size = spectrum_size(window_side(self.reference))
        colours = range(1, len(survey.spectrum.basis or (1,)))
        margin = window_side(self.reference) // 2 if survey.border == "valid" else 0
        bins = 256 if survey.compositing == "gather" else 128
        self._depths = Depths(defocus, *survey.defocus_range, survey.border, margin, bins)
        if light is None:  # whose colours, if they matter, may differ as much as its pixels
            self._light, self._level = SceneLight.unseen(self._depths, survey.channels, size), 0.5
            self._contrast = CONTRAST
            self._apart = torch.full((survey.channels, len(self._depths.psi)), CONTRAST, dtype=torch.float64)
            self._colours = [self._light for _ in colours]
        else:
            self._light, self._level = self._seen_light(light, size), float(light.double().square().mean().sqrt())
            self._contrast = float(light.double().std(correction=0))
            means = self._depths.means(light)  # of the light at each depth, less that of all
            self._apart = means / self._depths.share - means.sum(1, keepdim=True)
            self._colours = [self._seen_light(light.roll(-k, 1) - light, size) for k in colours]
        self._layers = LayerErrors(*survey.layer_survey(window_side(self.reference)), self._light)
        self._rows = self._layer_rows(self.reference)

    def _seen_light(self, light: Tensor, size: int) -> SceneLight:
        return SceneLight.seen(light, self._depths, self._survey.border, size, self._survey.compositing)

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
        if self._survey.captures > 1 and fidelity.occlusion_states != "each":
            raise ValueError(f"errors are predicted for occlusion_states 'each', got {fidelity.occlusion_states!r}")
        return sum(error for _, error in self._parts(fidelity))

    def seconds(self, fidelity: Fidelity) -> float:
        """Return the seconds of a capture with its PSFs on one core, see :mod:`kornia_tidy.render.cost_model`."""
        survey, cut = self._survey, self._cut(fidelity)
        bank = bank_seconds(survey.geometry(fidelity), fidelity, self._computed(fidelity))
        if isinstance(cut, Windows):
            return survey.captures * (bank + windows_seconds(cut, survey.planes, itemsize=8 if fidelity.double else 4))
        return bank + rendering_seconds(cut, survey.planes, fidelity)

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
        windows, counts = window_ladder(window_side(self.reference)), tuple(self._wavelength_counts(tolerance))
        for layers, double, points, count in product(layer_kinds(), (False, True), PIXEL_TOLERANCES, counts):
            full = replace(layers, window=windows[-1], double=double, pixel_tolerance=points, wavelengths=count)
            if self.error(full) > tolerance:
                continue
            for stray_light in WINDOW_STRAY_LIGHT:
                each = [replace(full, window=window, stray_light=stray_light) for window in windows[:-1]]
                first = bisect_left(each, True, key=lambda narrower: self.error(narrower) <= tolerance)
                yield (*each, full)[first]

    def _wavelength_counts(self, tolerance: float) -> Iterator[int | None]:
        """Yield the numbers of wavelengths worth a try, up to one whose error is small beside the tolerance."""
        for count in self._survey.wavelength_counts():
            error = SAFETY * self._wavelength_error(count)
            if error <= tolerance:
                yield count
            if error <= _ENOUGH * tolerance:
                return
        yield None

    def _described(self, fidelity: Fidelity, tolerance: float) -> RenderPlan:
        survey, window = self._survey, window_side(fidelity)
        held = _cropped(survey.window_survey(window_side(self.reference))[1], window).sum((-2, -1))
        return RenderPlan(
            fidelity=fidelity,
            reference=self.reference,
            tolerance=tolerance,
            predicted_error=self.error(fidelity),
            error_parts=tuple(self._parts(fidelity)),
            seconds=self.seconds(fidelity),
            reference_seconds=self.seconds(self.reference),
            memory_bytes=self._memory(fidelity),
            layers_present=self._computed(fidelity),
            layers_total=len(self._samples(fidelity)),
            states=survey.captures,
            wavelengths=len(survey.geometry(fidelity).wavelengths),
            wavelengths_total=len(survey.spectrum.wavelengths),
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
        """Return the share of the pixels that have a neighbour at another depth."""
        nearest, farthest = (max_pool2d(sign * self._defocus, 3, 1, 1) for sign in (1, -1))
        return float((nearest + farthest > _OUTLINE).double().mean())

    @cached_property
    def _share_in_frame(self) -> float:
        """Return the least share of a PSF that falls into the image, averaged over its pixels, where that matters.

        Occlusion divides by what a pixel sees. With the border ``"zero"`` that is the image alone: the PSFs of a tiny
        image are renormalised to what little of them lies within it, and so are their errors.
        """
        if not self._occlusion or self._survey.border != "zero":
            return 1.0
        psfs = self._survey.window_survey(window_side(self.reference))[1]
        shares = share_in_frame(psfs, self._defocus.shape[-2:]) / psfs.sum((-2, -1))
        return min(1.0, float(shares.amin()))

    def _layer_rows(self, fidelity: Fidelity) -> Tensor:
        return self._layers.rows(self._survey.nodes(fidelity), fidelity.layers, self._survey.band)

    def _layer_error(self, fidelity: Fidelity) -> float:
        key = (fidelity.layers, fidelity.layer_spacing)
        if key not in self._known:
            self._known[key] = self._layers(self._layer_rows(fidelity), self._rows)
        return self._known[key]

    def _order_error(self, fidelity: Fidelity) -> float:
        """What it changes where things hide one another that layers lie elsewhere than the reference's do."""
        if not self._occlusion or fidelity.layers == "nearest":
            return 0.0  # nearest layers are much further off anyway
        own, theirs = self._rendered(fidelity), self._rendered(self.reference)
        if own == theirs:
            return 0.0
        each = max(ORDER_ERROR, OUTLINE_ERROR * self._outlines**0.5)
        return each * self._contrast * (own[-1] - own[0]) / (len(own) - 1)

    def _dark_error(self, fidelity: Fidelity) -> float:
        """Return the error of white that does not stay white, where things hide others.

        A layer seen by a share E of its PSF loses EPSILON / E of its light, and other layers are seen by other shares.
        """
        if not self._occlusion or self._is_reference(fidelity):
            return 0.0
        key = ("dark", fidelity.window)
        if key not in self._known:
            nodes, psfs = self._survey.window_survey(window_side(self.reference))
            held = _cropped(psfs, window_side(fidelity)).sum((-2, -1)).amin(1).double()
            lost = EPSILON / (interpolation(self._depths.psi, nodes) @ held) - EPSILON
            self._known[key] = 2 * self._level * float((self._depths.share @ lost.square()).sqrt())
        return self._known[key]

    def _spread_error(self, fidelity: Fidelity) -> float:
        """Return the error of stray light that takes on the image's mean, where things hide others.

        A layer's own light is renormalised to what is seen of it, so its stray light should have the layer's mean.
        """
        if not self._occlusion or fidelity.stray_light != "veil":
            return 0.0
        key = ("spread", fidelity.window)
        if key not in self._known:
            nodes, psfs = self._survey.window_survey(window_side(self.reference))
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
            nodes, psfs = self._survey.window_survey(full)
            around = slice(
                max(0, bisect_right(nodes, float(self._depths.psi[0])) - 1),
                bisect_left(nodes, float(self._depths.psi[-1])) + 1,
            )
            nodes, psfs = nodes[around], psfs[around]
            if stray_light == "outlines":  # their PSFs are normalised in either window, veil or not
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
            nodes, changes = self._survey.pixel_changes(tolerance, window_side(self.reference))
            self._known[tolerance] = change_error(nodes, changes, self._light)
        return self._known[tolerance]

    def _wavelength_error(self, count: int | None) -> float:
        if count is None or count >= len(self._survey.spectrum.wavelengths):
            return 0.0
        key = ("wavelengths", count)
        if key not in self._known:
            nodes, changes = self._survey.wavelength_changes(count, window_side(self.reference))
            lights = (self._light, *self._colours)
            self._known[key] = sum(map(change_error, repeat(nodes), changes, lights))
        return self._known[key]

    def _samples(self, fidelity: Fidelity) -> Sequence[float]:
        nodes = self._survey.nodes(fidelity)
        return guarded(nodes, TAPS[fidelity.layers] // 2) if fidelity.layers in TAPS else nodes

    def _computed(self, fidelity: Fidelity) -> int:
        """How many PSFs are computed for the scene: all from the first that it takes light from to the last."""
        key = ("computed", fidelity.layers, fidelity.layer_spacing)
        if key not in self._known:
            ends = torch.stack([self._depths.psi[0], self._depths.psi[-1]])
            weights, _ = layer_coefficients(ends, self._survey.nodes(fidelity), fidelity.layers, self._survey.band)
            used = torch.nonzero((weights != 0).any(0)).flatten()
            self._known[key] = int(used[-1] - used[0] + 1)
        return int(self._known[key])

    def _memory(self, fidelity: Fidelity) -> int:
        survey, cut, layers = self._survey, self._cut(fidelity), self._computed(fidelity)
        if isinstance(cut, Windows):
            rendering = windows_bytes(cut, survey.planes, itemsize=8 if fidelity.double else 4)
        else:
            rendering = rendering_bytes(cut, survey.planes, fidelity)
        held = survey.captures * max(layers, cut.layers)
        return memory_bytes(survey.geometry(fidelity), survey.planes, fidelity, held, rendering)

    def _rendered(self, fidelity: Fidelity) -> Sequence[float]:
        """Defocus of the layers that are rendered."""
        nodes = self._survey.nodes(fidelity)
        return fine_nodes(nodes) if fidelity.layers in TAPS else nodes

    def _cut(self, fidelity: Fidelity) -> Tiles | Windows:
        """The scene in tiles, as the renderer will cut it."""
        nodes, window = self._rendered(fidelity), window_side(fidelity)
        mode = "nearest" if fidelity.layers == "nearest" else "linear"
        if (mode, nodes, window) not in self._tiles:
            margin = 0 if self._survey.compositing == "gather" and self._survey.border != "valid" else window // 2
            if self._labelled is None or self._labelled[0] != (mode, nodes, margin):  # one at a time: they are large
                seen = self._seen(margin)
                self._labelled = (mode, nodes, margin), label_pixels(seen, self._batch, nodes, mode)
            scene = self._labelled[1], len(nodes), window
            gathers = self._survey.compositing == "gather"
            cut = count_windows(*scene) if self._occlusion else count_tiles(*scene, gathers=gathers)
            self._tiles[mode, nodes, window] = cut
        return self._tiles[mode, nodes, window]

    def _seen(self, margin: int) -> Tensor:
        """Defocus of the pixels that have a layer: with ``valid`` fewer than the image's, unless it is gather, more."""
        border = self._survey.border
        if border == "valid" and not self._occlusion:
            height, width = self._defocus.shape[-2:]
            return self._defocus[..., margin : height - margin, margin : width - margin]
        return pad_border(self._defocus, margin, "replicate" if border == "zero" else border)

    @property
    def _occlusion(self) -> bool:
        return self._survey.compositing == "occlusion"


def _cropped(psfs: Tensor, window: int) -> Tensor:
    margin = (psfs.shape[-1] - window) // 2
    return psfs[..., margin : margin + window, margin : margin + window]
