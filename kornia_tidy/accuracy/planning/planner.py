"""Planner: choice of the cheapest fidelity within an error tolerance, predicted without rendering.

The error is the root mean square difference between the noise-free capture and that of the preset ``reference``, in
linear light with full scale 1. Light beyond full scale is not clipped: a highlight of 1000 gives errors a thousand
times those of white. The error is predicted from the power of the scene in each octave and at each depth, see
:mod:`kornia_tidy.accuracy.error_model`, and the cost is counted in operations, see
:mod:`kornia_tidy.accuracy.costs`. The candidates are all combinations of layers, spacing, window, quadrature
points per pixel and precision. The light outside the window is spread over the image or renormalised into the window,
whichever is more accurate.

The prediction is the sum of the errors of all single changes, each times a safety factor. It is an upper estimate,
which holds on the scenes of ``tests/accuracy/adversarial_scenes.py``. It is not a strict bound, since the light of one
octave is assumed to have random phases.

Occlusion is not a sum over layers. Its error from changes of PSFs is estimated as that of scatter, for two images: the
light itself, and its difference to the brightest light nearby, since dark objects occlude bright ones. Three errors are
added that scatter does not have: the position of layers at occluding edges, the sharpness of outlines with a PSF cut to
its window, and the darkening of pixels that are reached by a small part of a PSF.
"""

from __future__ import annotations

import warnings
from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property, wraps
from itertools import product
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from kornia_tidy.accuracy.costs import bank_work, rendering_work, window_side
from kornia_tidy.accuracy.depth_energy import Depths
from kornia_tidy.accuracy.error_model import change_error, layer_coefficients
from kornia_tidy.accuracy.planning.render_plan import RenderPlan
from kornia_tidy.accuracy.scene_light import CONTRAST, SceneLight, interpolation, spectrum_size
from kornia_tidy.checks import check_positive
from kornia_tidy.fidelity import Fidelity
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH, Spectrum
from kornia_tidy.psf.defocus_interpolation import TAPS, defocus_band, fine_nodes
from kornia_tidy.psf.field import Field
from kornia_tidy.psf.lens_limits import check_defocus_range
from kornia_tidy.psf.psf_cache import nodes_around
from kornia_tidy.psf.psf_model import PSFModel
from kornia_tidy.psf.psf_window import FittedWindow
from kornia_tidy.psf.spectral_binning import bin_spectrum
from kornia_tidy.render.backend import Work
from kornia_tidy.render.backends.dense_occlusion import EPSILON
from kornia_tidy.render.borders import check_border, cropped, largest_window
from kornia_tidy.render.stray_light import share_in_frame, share_within

REFERENCE = Fidelity.preset("reference")
LAYER_SPACINGS = {
    "nearest": (8.0, 4.0, 2.0, 1.0),
    "linear": (8.0, 4.0, 2.0, 1.0, 0.5, 0.25),
    "cubic": (2.0, 1.0),
    "bandlimited": (2.0, 1.0),
}
PIXEL_TOLERANCES = (1e-1, 2e-2, 1e-3, 1e-6)
WINDOW_STRAY_LIGHT = ("veil", "renormalize")  # the better one depends on window and image
RATIO = 1.2  # between successive candidates of the window and of the number of wavelengths
SAFETY = 1.4  # factor for layers and wavelengths; measured errors are up to 1.3 times the formula
WINDOW_SAFETY = 1.7  # factor for windows; measured up to 1.5, as tails are sampled at a few depths only
FLOAT32_ERROR = 4e-7  # root mean square, relative to the light; measured with mutual intensity up to 3.3e-7
POINT_SAFETY = 1.6  # factor for quadrature points; measured up to 1.5, since only a few depths are sampled
OCCLUSION = 1.3  # ratio of occlusion's error to the prediction for scatter; measured up to 1.1, before SAFETY
OCCLUSION_WINDOW = 1.3  # the same ratio for windows
ORDER_ERROR = 4e-3  # of occlusion, relative to the contrast, per radian between linear layers; measured up to 1.9e-3
OUTLINE_ERROR = 2e-2  # the same, relative to the contrast at outlines; measured up to 1.9e-2
_OUTLINE = 1.0  # rad between neighbouring pixels; larger steps are outlines of objects
_ENOUGH = 0.05  # of the tolerance: with errors below it, more wavelengths bring nothing
_DEPTHS = 16  # of the scene at which PSFs are compared
_WINDOW = 65  # px, to compare all but windows: a fifth of the light lies outside, but a few per cent of its square
_TOLERANCE = 0.3  # pixel tolerance of the samples: some per cent suffice for differences of PSFs
_LARGEST_REMEMBERED = 129  # px; layers of all kinds take hundreds of PSFs, and share many
_WAVELENGTHS = 7  # at most, in the samples: PSFs then have errors of half a per cent


def remembered(method: Callable[..., Any]) -> Callable[..., Any]:
    """Return a method whose results its object keeps, by its arguments, in a dictionary ``_known``."""

    @wraps(method)
    def recalled(self: Any, *given: Any) -> Any:
        key = (method, *given)
        if key not in self._known:
            self._known[key] = method(self, *given)
        return self._known[key]

    return recalled


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

    def __init__(self, optics: Any, channels: int) -> None:
        self.model: PSFModel = optics.psf_model
        own = self.model.spectrum
        self.spectrum = own if channels == len(own.weights) else Spectrum.monochrome()
        states = len(self.model.state_weights(torch.float32))
        # For occlusion each state is rendered separately, see Fidelity.occlusion_states.
        self.captures = states if optics.compositing == "occlusion" else 1
        self.together = states // self.captures
        self.band = defocus_band(self.model.pupil.max_rho2, min(own.wavelengths), REFERENCE_WAVELENGTH)
        self.border: str = optics.border
        self.compositing: str = optics.compositing
        self.channels, self.planes = channels, len(self.spectrum.plane_weights)
        self.wide_blur = self.model.wide_blur if optics.compositing == "gather" else None
        self.fewest = len(self.spectrum.basis or (1,))
        self._known: dict[Any, Any] = {}

    def scene(self, defocus: Tensor, light: Tensor | None = None) -> PlannedScene:
        """Return a scene to ask for errors and plans.

        Args:
            defocus: (B, 1, H, W) or (1, 1, H, W) radians.
            light: (B, C, H, W) linear light. Default: a typical photograph.
        """
        return PlannedScene(self, defocus, light)

    def spectrum_of(self, count: int | None) -> Spectrum:
        """Return the spectrum, binned to a number of wavelengths unless that is None."""
        return self.spectrum if count is None else bin_spectrum(self.spectrum, count)

    @remembered
    def nodes(self, layers: str, spacing: float) -> tuple[float, ...]:
        """Return the defocus of layers of a kind and spacing."""
        return self.model.with_fidelity(replace(REFERENCE, layers=layers, layer_spacing=spacing)).defocus_nodes

    def reference(self, height: int, width: int) -> Fidelity:
        """Return the reference for images of this size, its window fixed: that of wide blur, where it is."""
        if self.wide_blur is not None:
            return replace(REFERENCE, window=self.wide_blur.window)
        limit = min(REFERENCE.max_window, largest_window(self.border, height, width))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that the widest allowed window misses the encircled energy
            window = self.model.with_fidelity(REFERENCE.replace(max_window=limit)).window
        return replace(REFERENCE, window=min(window, limit))  # a wide defocus disc takes more than the border allows

    def allows(self, reference: Fidelity, height: int, width: int) -> bool:
        """Return whether a reference keeps to the limits of the lens and of the border."""
        try:
            check_defocus_range(self.model.camera.defocus_range, self.model.pixel_step, reference, reference.window)
            check_border(self.border, height, width, window_side(reference))
        except ValueError:
            return False
        return True

    @torch.no_grad()
    def psfs(
        self,
        nodes: Sequence[float],
        window: int,
        tolerance: float = _TOLERANCE,
        wavelengths: int | None = _WAVELENGTHS,
        dtype: torch.dtype = torch.float64,
    ) -> Tensor:
        """Return exact PSFs at ascending defocus, (D, C, P, P)."""
        most = None if wavelengths is None else max(self.fewest, wavelengths)
        model = self._model(window, tolerance, most).without_memory()
        return model.psf_bank(self.channels, dtype, tuple(nodes)).psfs.cpu()

    @torch.no_grad()
    def layered(self, layers: str, spacing: float, depths: Sequence[float], window: int) -> Tensor:
        """Return the PSFs that layers of a kind and spacing give to pixels at some depths, (D, C, P, P)."""
        if window > _LARGEST_REMEMBERED and len(depths) > 1:  # a depth of band-limited layers takes a dozen of them
            return torch.cat([self.layered(layers, spacing, [psi], window) for psi in depths])
        psi = torch.tensor(depths, dtype=torch.float64)
        weights, at = layer_coefficients(psi, self.nodes(layers, spacing), layers, self.band)
        used = (weights != 0).any(0)
        nodes = tuple(psi for psi, needed in zip(at, used.tolist(), strict=True) if needed)
        psfs = self._sampling(window).psf_bank(self.channels, torch.float64, nodes).psfs.cpu()
        return (weights[:, used] @ psfs.flatten(1)).unflatten(1, psfs.shape[1:])

    @remembered
    def _sampling(self, window: int) -> PSFModel:
        """Return the model of the compared PSFs; a copy has its own memory."""
        model = self._model(window, _TOLERANCE, max(self.fewest, _WAVELENGTHS))
        return model.without_memory() if window > _LARGEST_REMEMBERED else copy(model)

    @torch.no_grad()
    def binned(self, count: int | None, depths: Sequence[float], window: int) -> Tensor:
        """Return PSFs with binned wavelengths, of each channel and basis reflectance, (D, C, B, P, P)."""
        spectrum = self.spectrum_of(count)
        planes = torch.zeros((), dtype=torch.float64)
        for wavelength, shares in zip(spectrum.wavelengths, zip(*spectrum.plane_weights, strict=True), strict=True):
            one = self._model(window, 1e-3, None, spectrum=Spectrum.monochrome(wavelength))
            psfs = one.without_memory().psf_bank(1, torch.float64, depths).psfs.cpu()
            planes = planes + psfs * torch.tensor(shares, dtype=torch.float64)[:, None, None]
        return planes.unflatten(1, (self.channels, -1))

    def _model(self, window: int, tolerance: float, wavelengths: int | None, **parts: Any) -> PSFModel:
        """Return the model with PSFs in a window, before anything is done about stray light."""
        points = {"pixel_tolerance": tolerance, "wavelengths": wavelengths}
        fidelity = REFERENCE.replace(window=window, stray_light="discard", **points)
        # Nobody asks how much of the light it holds.
        return self.model.replace(fidelity=fidelity, **parts).with_window(FittedWindow(window, (0.0, 1.0)))


class PlannedScene:
    """Error prediction and plans for one scene, made by :meth:`Planner.scene`.

    Attributes:
        planner: of the camera.
        images: number of images.
        reference: fidelity that errors refer to.
        light: power of the light by channel, octave and depth.
        level: root mean square of the light.
    """

    @torch.no_grad()
    def __init__(self, planner: Planner, defocus: Tensor, light: Tensor | None) -> None:
        height, width = defocus.shape[-2:]
        self.images = len(defocus if light is None else light)
        self.planner, self._defocus = planner, defocus.detach()
        self._known: dict[Any, Any] = {}
        self.reference = planner.reference(height, width)
        self._full = window_side(self.reference)
        self._narrow = self._full if planner.wide_blur else min(_WINDOW, self._full)
        size = spectrum_size(self._full)
        colours = range(1, len(planner.spectrum.basis or (1,)))
        margin = self._full // 2 if planner.border == "valid" else 0
        bins = 256 if planner.compositing == "gather" else 128
        self._depths = Depths(defocus, *planner.model.camera.defocus_range, planner.border, margin, bins)
        if light is None:  # differences between channels are assumed as large as between pixels
            self.light, self.level = SceneLight.unseen(self._depths, planner.channels, size), 0.5
            self._contrast = CONTRAST
            self._apart = torch.full((planner.channels, len(self._depths.psi)), CONTRAST, dtype=torch.float64)
            self._colours = [self.light for _ in colours]
        else:
            self.light, self.level = self._seen_light(light, size), float(light.double().square().mean().sqrt())
            self._contrast = float(light.double().std(correction=0))
            means = self._depths.means(light)  # mean light of each depth less that of the image
            self._apart = means / self._depths.share - means.sum(1, keepdim=True)
            self._colours = [self._seen_light(light.roll(-k, 1) - light, size) for k in colours]
        self._at = tuple(self.light.depths(_DEPTHS))
        self._outlines = self._at_outlines(light) if self._occlusion else 0.0

    def _seen_light(self, light: Tensor, size: int) -> SceneLight:
        return SceneLight.seen(light, self._depths, self.planner.border, size, self.planner.compositing)

    def error(self, fidelity: Fidelity) -> float:
        """Return the predicted error, full scale 1, of an exact fidelity with a window up to the reference's."""
        return sum(error for _, error in self._parts(fidelity))

    def operations(self, fidelity: Fidelity) -> float:
        """Return the operations of a capture with its PSFs, those of float64 counted twice."""
        return self.planner.captures * sum(work.operations for work in self._works(fidelity))

    def work_over_field(self, fidelity: Fidelity, field: Field) -> Work:
        """Return the work of a capture with its PSFs at the places of a field."""
        bank, rendering = self._works(fidelity, None if self._occlusion else field)
        planner, places = self.planner, len(field.points)
        operations = planner.captures * (places * bank.operations + rendering.operations)
        return Work(operations, max(round(planner.captures * places * bank.memory), rendering.memory))

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
        windows, counts = window_steps(self._full), tuple(self._wavelength_counts(tolerance))
        kinds = [(kind, spacing) for kind, spacings in LAYER_SPACINGS.items() for spacing in spacings]
        for (kind, spacing), points, count in product(kinds, PIXEL_TOLERANCES, counts):
            layers = replace(REFERENCE, layers=kind, layer_spacing=spacing)
            full = replace(layers, window=windows[-1], double=False, pixel_tolerance=points, wavelengths=count)
            if self.error(full) > tolerance:
                continue
            for stray_light in WINDOW_STRAY_LIGHT:
                each = [replace(full, window=window, stray_light=stray_light) for window in windows[:-1]]
                first = bisect_left(each, True, key=lambda narrower: self.error(narrower) <= tolerance)
                yield (*each, full)[first]

    def _wavelength_counts(self, tolerance: float) -> Iterator[int | None]:
        """Yield candidate numbers of wavelengths, up to the first with an error small against the tolerance."""
        planner, spectrum = self.planner, self.planner.spectrum
        # One wavelength per channel is a separate model, not a sample of a broader spectrum.
        single = all(sum(weight > 0 for weight in row) == 1 for row in spectrum.weights)
        for count in () if single else wavelength_steps(planner.fewest, len(spectrum.wavelengths)):
            error = SAFETY * self._wavelength_error(count)
            if error <= tolerance:
                yield count
            if error <= _ENOUGH * tolerance:
                return
        yield None

    def _described(self, fidelity: Fidelity, tolerance: float) -> RenderPlan:
        planner, (bank, rendering) = self.planner, self._works(fidelity)
        layers = self._layers(fidelity.layers, fidelity.layer_spacing)
        held = planner.captures * max(1.0, len(nodes_around(self._rendered(fidelity), self._defocus)) / layers[0])
        return RenderPlan(
            fidelity=fidelity,
            reference=self.reference,
            tolerance=tolerance,
            error_parts=tuple(self._parts(fidelity)),
            operations=self.operations(fidelity),
            reference_operations=self.operations(self.reference),
            memory_bytes=max(round(held * bank.memory), rendering.memory),
            layers=layers,
            window=window_side(fidelity),
            wavelengths=(len(planner.spectrum_of(fidelity.wavelengths).wavelengths), len(planner.spectrum.wavelengths)),
            states=planner.captures,
        )

    def _parts(self, fidelity: Fidelity) -> list[tuple[str, float]]:
        share, of_window = (OCCLUSION, OCCLUSION_WINDOW) if self._occlusion else (1.0, 1.0)
        share, of_window = (factor / self._share_in_frame for factor in (share, of_window))
        narrower = window_side(fidelity) < self._full
        ways = (fidelity.stray_light, *(["outlines"] if self._occlusion and narrower else []))
        window_error = of_window * max(self._window_error(window_side(fidelity), way) for way in ways)
        layer_error = SAFETY * share * self._layer_error(fidelity.layers, fidelity.layer_spacing)
        return [
            ("layers", layer_error + self._order_error(fidelity) + self._dark_error(fidelity)),
            ("window", WINDOW_SAFETY * window_error + self._spread_error(fidelity)),
            ("points a pixel", POINT_SAFETY * share * self._point_error(fidelity.pixel_tolerance)),
            ("wavelengths", SAFETY * share * self._wavelength_error(fidelity.wavelengths)),
            ("float32", 0.0 if fidelity.double else FLOAT32_ERROR * self.level),
        ]

    # ---------------------------------------------------------------------- errors of single changes

    @cached_property
    def _psfs(self) -> Tensor:
        """PSFs at some depths of the scene, in the window of the reference."""
        return self.planner.psfs(self._at, self._full, dtype=torch.float32)

    @remembered
    def _held(self, window: int) -> Tensor:
        """Return the share of the light in a window, at some depths of the scene, (D, C)."""
        return cropped(self._psfs, (self._full - window) // 2).sum((-2, -1)).double()

    @remembered
    def _layer_error(self, layers: str, spacing: float) -> float:
        reference = self._layered(REFERENCE.layers, REFERENCE.layer_spacing)
        return change_error(self._at, self._layered(layers, spacing) - reference, self.light, alternate=True)

    @remembered
    def _window_error(self, window: int, stray_light: str) -> float:
        psfs, margin = self._psfs, (self._full - window) // 2
        if stray_light == "outlines":  # PSFs are normalised in both windows, with and without stray light
            psfs = psfs / psfs.sum((-2, -1), keepdim=True)
        kept = cropped(psfs, margin)
        if stray_light != "veil":
            kept = kept / kept.sum((-2, -1), keepdim=True)
        changes = -psfs
        cropped(changes, margin).add_(kept)
        return change_error(self._at, changes, self.light)

    @remembered
    def _point_error(self, tolerance: float) -> float:
        return change_error(self._at, self._sampled(tolerance) - self._sampled(REFERENCE.pixel_tolerance), self.light)

    @remembered
    def _sampled(self, tolerance: float) -> Tensor:
        """Return PSFs at all wavelengths: that of the shortest changes most."""
        return self.planner.psfs(self._at, self._narrow, tolerance, None)

    @remembered
    def _wavelength_error(self, count: int | None) -> float:
        r"""Return the error from binned wavelengths.

        With a reflectance basis, channel c captures :math:`h_c * L_c + \sum_b h_{cb} * (L_b - L_c)` with the PSF
        :math:`h_c = \sum_b h_{cb}` of white.
        """
        if count is None or count >= len(self.planner.spectrum.wavelengths):
            return 0.0
        changes = self._binned(count) - self._binned(None)
        own = torch.arange(len(changes[0]))
        colours = [changes[:, own, (own + k) % len(own)] for k in range(1, changes.shape[2])]
        changed = zip((changes.sum(2), *colours), (self.light, *self._colours), strict=True)
        return sum(change_error(self._at, change, light) for change, light in changed)

    @remembered
    def _binned(self, count: int | None) -> Tensor:
        return self.planner.binned(count, self._at, self._narrow)

    @remembered
    def _layered(self, layers: str, spacing: float) -> Tensor:
        return self.planner.layered(layers, spacing, self._at, self._narrow)

    # ---------------------------------------------------------------------- what occlusion adds

    @property
    def _occlusion(self) -> bool:
        return self.planner.compositing == "occlusion"

    def _at_outlines(self, light: Tensor | None) -> float:
        """Return the root mean square, over all pixels, of the contrast of those with a neighbour at another depth."""
        nearest, farthest = (max_pool2d(sign * self._defocus, 3, 1, 1) for sign in (1, -1))
        outline = (nearest + farthest > _OUTLINE).double()
        contrast = self._contrast * float(outline.mean().sqrt())
        if light is None:
            return contrast
        brightest, darkest = (max_pool2d(sign * light.double(), 3, 1, 1) for sign in (1, -1))
        return max(contrast, float((outline * (brightest + darkest).square()).mean().sqrt()))

    @cached_property
    def _share_in_frame(self) -> float:
        """Least share of a PSF inside the image, averaged over pixels; 1 unless occlusion has the border ``"zero"``.

        Occlusion divides by the cumulative alpha. With the border ``"zero"`` it covers only the image: in a tiny image
        PSFs are renormalised by the small share inside it, and their errors grow likewise.
        """
        if not self._occlusion or self.planner.border != "zero":
            return 1.0
        shares = share_in_frame(self._psfs, self._defocus.shape[-2:]) / self._held(self._full)
        return min(1.0, float(shares.amin()))

    def _order_error(self, fidelity: Fidelity) -> float:
        """Return the error at occluding edges from layers at other positions than the reference's."""
        if not self._occlusion or fidelity.layers == "nearest":
            return 0.0  # nearest layers have much larger errors, which dominate
        own, theirs = self._rendered(fidelity), self._rendered(self.reference)
        if own == theirs:
            return 0.0
        each = max(ORDER_ERROR * self._contrast, OUTLINE_ERROR * self._outlines)
        return each * (own[-1] - own[0]) / (len(own) - 1)

    def _dark_error(self, fidelity: Fidelity) -> float:
        """Return the error of occlusion from the regularised division by the cumulative alpha.

        A layer with the share E of its PSF inside the window loses EPSILON / E of its light, so that white is not kept.
        """
        if not self._occlusion or replace(fidelity, name=self.reference.name) == self.reference:
            return 0.0
        held = self._held(window_side(fidelity)).amin(1)
        lost = EPSILON / (interpolation(self._depths.psi, self._at) @ held) - EPSILON
        return 2 * self.level * float((self._depths.share @ lost.square()).sqrt())

    def _spread_error(self, fidelity: Fidelity) -> float:
        """Return the error from stray light that is spread otherwise than the reference's.

        Occlusion normalises each layer by its alpha, so the layer's stray light should have the mean of the layer. In
        the others more stray light stays within a border ``"zero"`` where the window is narrower.
        """
        if fidelity.stray_light != "veil" or not (self._occlusion or self.planner.border == "zero"):
            return 0.0
        if not self._occlusion:
            height, width = self._defocus.shape[-2:]
            theirs, ours = (share_within(height, width, side) for side in (self._full, window_side(fidelity)))
            stray = float((1 - self._held(self._full)).clamp(min=0).max())
            return self.level * stray * float((ours - theirs).square().mean().sqrt())
        lost = self._held(self._full) - self._held(window_side(fidelity))
        lost = interpolation(self._depths.psi, self._at) @ lost * self._apart.T
        return float((self._depths.share @ lost.square()).mean().clamp(min=0).sqrt())

    # ---------------------------------------------------------------------- costs

    @remembered
    def _layers(self, layers: str, spacing: float) -> tuple[int, int]:
        """Return how many PSFs are computed for the scene, from its farthest to its nearest, and of the whole range."""
        nodes = self.planner.nodes(layers, spacing)
        weights, sampled = layer_coefficients(self._depths.psi[[0, -1]], nodes, layers, self.planner.band)
        used = torch.nonzero((weights != 0).any(0)).flatten()
        return int(used[-1] - used[0] + 1), len(sampled)

    def _rendered(self, fidelity: Fidelity) -> tuple[float, ...]:
        """Return the defocus of the rendered layers."""
        nodes = self.planner.nodes(fidelity.layers, fidelity.layer_spacing)
        return fine_nodes(nodes) if fidelity.layers in TAPS else nodes

    def _works(self, fidelity: Fidelity, field: Field | None = None) -> tuple[Work, Work]:
        """Return the work of a bank of PSFs and of the renderer, for one capture of the scene."""
        planner, (computed, _) = self.planner, self._layers(fidelity.layers, fidelity.layer_spacing)
        layers = "nearest" if fidelity.layers == "nearest" else "linear"
        bank = bank_work(planner.model, planner.spectrum_of(fidelity.wavelengths), planner.together, fidelity, computed)
        nodes, window = self._rendered(fidelity), window_side(fidelity)
        return bank, self._rendering(layers, nodes, window, fidelity.double, field)

    @remembered
    def _rendering(self, layers: str, nodes: tuple[float, ...], window: int, double: bool, field: Field | None) -> Work:
        planner, given = self.planner, (self._defocus, self.images, self.planner.planes, nodes, window)
        how = {"layers": layers, "compositing": planner.compositing, "border": planner.border, "double": double}
        return rendering_work(*given, **how, field=field)


def window_steps(largest: int) -> tuple[int, ...]:
    """Return the candidate window sides, ascending, each about a fifth narrower than the next.

    Example:
        >>> window_steps(41)
        (3, 5, 7, 9, 11, 13, 15, 17, 21, 25, 29, 35, 41)
    """
    windows = [largest]
    while windows[0] > 3:
        windows.insert(0, min(windows[0] - 2, 2 * int(windows[0] / RATIO / 2) + 1))
    return tuple(windows)


def wavelength_steps(fewest: int, all_of_them: int) -> tuple[int, ...]:
    """Return the candidate numbers of wavelengths, ascending, below the number of the spectrum.

    Example:
        >>> wavelength_steps(1, 31)
        (1, 2, 3, 4, 5, 6, 8, 10, 13, 16, 20, 25)
    """
    counts = [all_of_them]
    while counts[0] > fewest:
        counts.insert(0, max(fewest, min(counts[0] - 1, int(counts[0] / RATIO))))
    return tuple(counts[:-1])
