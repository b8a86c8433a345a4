"""TiDyOptics: a camera whose phase mask changes during one exposure, as one module in front of any pipeline."""

from __future__ import annotations

import copy
import warnings
from bisect import bisect_left, bisect_right
from collections.abc import Mapping, Sequence
from functools import partial
from math import ceil, floor, pi
from typing import TYPE_CHECKING, Any, cast

import torch
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from torch import Tensor, nn
from torch.utils.data import get_worker_info

from kornia_tidy.checks import check_choice, check_finite, check_float_tensor
from kornia_tidy.dataset_transform import DatasetTransform
from kornia_tidy.fidelity import Fidelity
from kornia_tidy.optics.aperture import check_aperture, circular_aperture
from kornia_tidy.optics.bank_memory import BankMemory
from kornia_tidy.optics.camera import DefocusRange, ThinLensCamera
from kornia_tidy.optics.defocus_interpolation import FINE_SPACING, TAPS, defocus_band, interpolated_bank
from kornia_tidy.optics.exact import exact_psf_bank
from kornia_tidy.optics.modulator import DwellTimes
from kornia_tidy.optics.paper import PAPER_SIZE, paper_psf_bank, warn_if_aliased
from kornia_tidy.optics.phase_masks import MASK_SPAN, PhaseMasks, PixelwiseMask, adam_groups
from kornia_tidy.optics.psf_bank import PSFBank, enclosing_window
from kornia_tidy.optics.pupil import Pupil
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH, Spectrum
from kornia_tidy.scene.compositing import render
from kornia_tidy.scene.convolution import check_border
from kornia_tidy.sensor.noise import SensorNoise

if TYPE_CHECKING:
    from kornia_tidy.planning import RenderPlan

COLOR_SPACES = ("srgb", "linear", "paper")
DEPTH_KEYS = ("depth", "mask_depth")  # the second is how kornia's containers know a map that must be warped
_DEFAULT_SENSOR = SensorNoise(0.01)


class TiDyOptics(nn.Module):
    r"""A programmable camera: an image and its depth go in, a coded capture comes out, gradients reach the masks.

    The chain is: decode to linear light, blur by the PSFs of each pixel's depth (averaged over the masks shown during
    the exposure), sensor noise, encode. Its parts can be swapped: ``masks``, ``modulator``, ``camera``, ``sensor``.

    Args:
        masks: phase masks. Default: five learnable 23x23 masks of uniform noise, as in the paper.
        camera: turns depth into defocus. Default: 50 mm, f/17.6, focused at 0.595 m, pixels of 8 um, so that depths
            from 0.298 m to infinity span the paper's range of defocus.
        modulator: turns masks into the states shown and their weights. Default: equal dwell times.
        sensor: noise and digitisation in linear light, full scale 1; None leaves the light as it is.
        fidelity: a preset's name (``"paper"``, ``"draft"``, ``"balanced"``, ``"reference"``) or a
            :class:`~kornia_tidy.fidelity.Fidelity`.
        compositing: ``"gather"`` (the paper's equation 1) or ``"scatter"`` (conserves flux).
        color_space: how images are encoded: ``"srgb"`` (default) is decoded to linear light and encoded after;
            ``"linear"`` passes untouched, beyond 1 too; ``"paper"`` treats sRGB values as light, as the paper does,
            and then the sensor's units are encoded ones.
        border: ``"reflect"``, ``"replicate"``, ``"zero"``, ``"circular"``, or ``"valid"``, which crops image, depth
            and clean image alike to where the whole PSF fits.
        spectrum: wavelengths and how each channel weights them. Default: 610, 530 and 470 nm, one a channel. Images of
            one channel are taken at 530 nm.
        aperture: amplitude over the mask's pixels (N, N), or finer by a whole factor. Default: the binary disc.
        check_inputs: look at the values of images and depths before any work, eagerly.

    Shape:
        - ``optics(image, depth)``: (B, C, H, W) and (B, 1, H, W), or both without B, to the coded image.
        - ``optics((image, depth, ...))`` to ``(coded, depth, ...)``.
        - ``optics({"image": ..., "depth": ..., ...})`` to the same mapping with ``"image"`` coded, and
          ``"all_in_focus"`` the clean image. The depth may stand under ``"mask_depth"`` instead.

    Raises:
        TypeError: if image or depth are not floating-point tensors.
        ValueError: if shapes do not fit, a value is NaN, a depth is not positive, or options contradict each other.
        KeyError: if a mapping has no image or no depth.

    Convention:
        - Images are RGB; depth is metres (or what the camera takes), ``inf`` allowed.
        - Optics run in float32 or better, under autocast too; the capture has the image's dtype. Keep depth float32.
        - Defocus beyond the camera's range is clamped to its ends; ``clamped_pixels`` counts them.
        - Noise comes from the global generator, from ``generator=``, or from ``params=`` drawn before by
          :meth:`draw`. ``eval()`` does not switch it off: a camera has noise at test time too.
        - The capture is detached inside a DataLoader's worker, and only there; see :meth:`as_transform`.

    Source: Shah, Kulshrestha, Metzler: TiDy-PSFs, ICCV 2023.

    Example:
        >>> optics = TiDyOptics()
        >>> image, depth = torch.rand(2, 3, 96, 96), torch.full((2, 1, 96, 96), 0.8)
        >>> coded = optics(image, depth)
        >>> coded.shape
        torch.Size([2, 3, 96, 96])
        >>> coded.mean().backward()
        >>> optics.masks.phase.grad.shape
        torch.Size([5, 23, 23])
    """

    def __init__(
        self,
        masks: PhaseMasks | None = None,
        camera: ThinLensCamera | DefocusRange | None = None,
        modulator: nn.Module | None = None,
        sensor: nn.Module | None = _DEFAULT_SENSOR,
        fidelity: str | Fidelity = "balanced",
        compositing: str = "gather",
        color_space: str | None = None,
        border: str = "reflect",
        spectrum: Spectrum | None = None,
        aperture: Tensor | None = None,
        check_inputs: bool = True,
    ) -> None:
        super().__init__()
        self.fidelity = Fidelity.preset(fidelity) if isinstance(fidelity, str) else fidelity
        paper = self.fidelity.propagation == "paper"
        color_space = color_space or ("paper" if paper else "srgb")
        check_choice("color_space", color_space, COLOR_SPACES)
        check_choice("compositing", compositing, ("gather", "scatter"))
        check_choice("border", border, ("reflect", "replicate", "zero", "circular", "valid"))
        if paper and (color_space != "paper" or compositing != "gather"):
            raise ValueError(
                f"fidelity 'paper' means color_space='paper' and compositing='gather', got {color_space!r} and "
                f"{compositing!r}: leave them out, or use another fidelity"
            )
        self.masks = PixelwiseMask() if masks is None else masks
        self.camera = ThinLensCamera() if camera is None else camera
        self.modulator = DwellTimes() if modulator is None else modulator
        self.sensor = sensor
        self.spectrum = Spectrum.rgb() if spectrum is None else spectrum
        self.compositing = compositing
        self.color_space = color_space
        self.border = border
        self.check_inputs = check_inputs
        self._aperture = None if aperture is None else check_aperture(aperture, aperture.shape[-1])
        self._clamped: Tensor | None = None
        self._memory = BankMemory()
        self._warned = False
        if paper:
            warn_if_aliased(self.camera.defocus_range, self.spectrum)
        self.register_load_state_dict_post_hook(_refit_window)
        self.fit_window()

    # ------------------------------------------------------------------ the camera at work

    def forward(
        self,
        image: Any,
        depth: Tensor | None = None,
        params: Mapping[str, Tensor] | None = None,
        generator: torch.Generator | None = None,
    ) -> Any:
        """Take a picture of a sample given as tensors, a tuple or a mapping.

        Args:
            image: the image, or a whole sample; see the class for the forms.
            depth: the depth map, if ``image`` is a tensor.
            params: noise drawn before by :meth:`draw`, to repeat a capture or to compile one.
            generator: source of the noise (not while compiling).
        """
        if isinstance(image, Mapping):
            return self._map_sample(image, depth, params, generator)
        if isinstance(image, (tuple, list)):
            if len(image) < 2 or depth is not None:
                raise ValueError(f"a tuple sample must be (image, depth, ...), got {len(image)} entries")
            coded = self.capture(image[0], image[1], params, generator)
            parts = (coded, self._cropped(image[1]), *image[2:])
            return type(image)(*parts) if hasattr(image, "_fields") else type(image)(parts)
        return self.capture(image, depth, params, generator)

    def capture(
        self,
        image: Tensor,
        depth: Tensor | None,
        params: Mapping[str, Tensor] | None = None,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Take a picture of an image and its depth. See :meth:`forward`."""
        image, depth, batched = self._checked(image, depth)
        check_border(self.border, *image.shape[-2:], self.window)
        dtype = self._compute_dtype(image)
        with torch.autocast(image.device.type, enabled=False):
            light = self.decode(image.to(dtype))
            defocus = self.camera.defocus(depth.to(dtype), check_inputs=False)
            self._count_clamped(defocus)
            bank = self._scene_bank(image.shape[1], dtype, defocus)
            light = render(
                light,
                defocus,
                bank,
                self.compositing,
                layers="nearest" if self.fidelity.layers == "nearest" else "linear",
                border=self.border,
                correlate=self.fidelity.correlate,
            )
            if self.sensor is not None:
                light = self.sensor(light, params=params, generator=generator)
            coded = self.encode(light).to(image.dtype)
        if not torch.compiler.is_compiling() and get_worker_info() is not None:
            coded = coded.detach()  # collation in a worker cannot carry gradients
        return coded if batched else coded[0]

    def draw(self, image: Tensor, generator: torch.Generator | None = None) -> dict[str, Tensor]:
        """Draw the noise of one capture of an image like this one, for ``params=``.

        Args:
            image: (B, C, H, W) or (C, H, W).
            generator: source of the noise. Default: the global generator.
        """
        if self.sensor is None:
            return {}
        height, width = self._cropped(image).shape[-2:]
        shape = (*(image.shape[:2] if image.ndim == 4 else (1, image.shape[0])), height, width)
        sensor = cast("SensorNoise", self.sensor)
        return sensor.draw(shape, device=image.device, dtype=self._compute_dtype(image), generator=generator)

    def psf_bank(
        self,
        channels: int | None = None,
        dtype: torch.dtype | None = None,
        defocus: Sequence[float] | None = None,
    ) -> PSFBank:
        """Return the PSFs of the masks as they are now, averaged over the exposure; gradients reach the masks.

        Without gradients, PSFs are remembered while masks and camera stay as they are.

        Args:
            channels: 1 for an image of one channel, which is taken at 530 nm. Default: those of the spectrum.
            dtype: float32 or float64. Default: float32, or float64 where the fidelity asks for it.
            defocus: ascending nodes in radians. Default: all of ``defocus_nodes``.
        """
        spectrum = self._spectrum(len(self.spectrum.weights) if channels is None else channels)
        dtype = (torch.float64 if self.fidelity.double else torch.float32) if dtype is None else dtype
        nodes = self.defocus_nodes if defocus is None else tuple(defocus)
        return self._computed_bank(spectrum, dtype, nodes).with_stray_light(self.fidelity.stray_light)

    @property
    def defocus_nodes(self) -> tuple[float, ...]:
        """Defocus of the PSF bank's layers in radians: evenly spaced over the camera's range."""
        lo, hi = self.camera.defocus_range
        intervals = max(1, round((hi - lo) / self.fidelity.layer_spacing))
        return tuple(lo + (hi - lo) * i / intervals for i in range(intervals + 1))

    # ------------------------------------------------------------------ how exactly to compute

    def with_fidelity(self, fidelity: str | Fidelity) -> TiDyOptics:
        """Return this camera at another fidelity. The parts are shared, so masks learn through both.

        Args:
            fidelity: a preset's name or a :class:`~kornia_tidy.fidelity.Fidelity`, such as that of a plan.
        """
        other = copy.copy(self)
        for kind in ("_modules", "_parameters", "_buffers"):  # or swapping a part of one would swap that of both
            other.__dict__[kind] = dict(self.__dict__[kind])
        other.fidelity = Fidelity.preset(fidelity) if isinstance(fidelity, str) else fidelity
        return other

    @torch.no_grad()
    def plan(self, depth: Tensor, image: Tensor | None = None, tolerance: float = 1e-3) -> RenderPlan:
        """Return the cheapest way to capture a scene within an error. See :mod:`kornia_tidy.planning`.

        Args:
            depth: (B, 1, H, W) or (1, H, W), as for a capture.
            image: (B, C, H, W) or (C, H, W). Default: photographs as they usually are, of the spectrum's channels.
            tolerance: root mean square error of the noise-free linear capture against ``reference``, full scale 1.

        Returns:
            A plan for the masks as they are now, whose ``fidelity`` is for :meth:`with_fidelity`.

        Example:
            >>> optics = TiDyOptics(PixelwiseMask(1, initial="flat"))
            >>> plan = optics.plan(torch.full((1, 96, 96), 0.9), tolerance=1e-2)
            >>> plan.predicted_error <= 1e-2
            True
        """
        from kornia_tidy.planning import Planner  # noqa: PLC0415 (only who plans waits for it)

        shape = (len(self.spectrum.weights), *depth.shape[-2:])
        blank = depth.new_zeros(()).expand(*depth.shape[:-3], *shape) if image is None else image
        blank, depth, _ = self._checked(blank, depth)
        light = None if image is None else self.decode(blank.to(self._compute_dtype(blank)))
        defocus = self.camera.defocus(depth.to(self._compute_dtype(depth)), check_inputs=False)
        return Planner(self, blank.shape[1]).scene(defocus, light).plan(tolerance)

    # ------------------------------------------------------------------ the window of the PSFs

    @property
    def window(self) -> int:
        """Side of the PSFs in pixels: given by the fidelity, or measured by :meth:`fit_window`."""
        return self.fit_window() if self._window is None else self._window

    def fit_window(self) -> int:
        """Choose the smallest PSF window that holds the fidelity's share of the light of the masks as they are now.

        It is done on construction, after ``load_state_dict`` and when a part is swapped; masks in training keep their
        window until this is called again. A window or a preset that fixes the side is only measured.

        Returns:
            The side in pixels: at most ``fidelity.max_window``, with a warning if that does not hold the share.
        """
        settings = self.fidelity
        if settings.layers == "bandlimited" and settings.layer_spacing >= (limit := pi / self._band()):
            raise ValueError(
                f"layers='bandlimited' needs a layer_spacing below {limit:.2f} rad for this aperture and "
                f"{min(self.spectrum.wavelengths) * 1e9:.0f} nm, got {settings.layer_spacing}"
            )
        fixed = PAPER_SIZE if settings.propagation == "paper" else settings.window
        size = fixed or min(33, settings.max_window)
        while True:
            psfs = self._sampled_psfs(size)
            window = fixed or enclosing_window(psfs, settings.enclosed_energy)
            if window is not None or size == settings.max_window:
                break
            size = min(2 * size - 1, settings.max_window)
        self._window = window or size
        margin = (size - self._window) // 2
        shares = psfs[..., margin : size - margin, margin : size - margin].sum((2, 3))
        self._held = (float(shares.min()), float(shares.max()))
        if window is None:
            warnings.warn(
                f"the largest PSF window allowed, {size} px, holds {self._held[0]:.0%} of the light where it should "
                f"hold {settings.enclosed_energy:.0%}; the rest is handled by {settings.stray_light!r}: raise "
                f"Fidelity.max_window, or lower Fidelity.enclosed_energy",
                stacklevel=2,
            )
        return self._window

    @torch.no_grad()
    def _sampled_psfs(self, size: int) -> Tensor:
        """PSFs at both ends of the range and at focus, good enough to see where the light goes."""
        lo, hi = self.camera.defocus_range
        nodes = tuple(sorted({lo, min(max(0.0, lo), hi), hi}))
        states, weights = self.modulator(self.masks.phase.to(torch.float32))
        return self._build(states, weights, self.spectrum, self._pixel_step(), size, 0.1, nodes).psfs

    # ------------------------------------------------------------------ colour

    def decode(self, image: Tensor) -> Tensor:
        """Return linear light from an image in the camera's colour space."""
        return _any_channels(rgb_to_linear_rgb, image) if self.color_space == "srgb" else image

    def encode(self, light: Tensor) -> Tensor:
        """Return an image in the camera's colour space from linear light."""
        return _any_channels(linear_rgb_to_rgb, light) if self.color_space == "srgb" else light

    # ------------------------------------------------------------------ training, data sets, people

    def parameter_groups(self, lr_metres: float, lr: float | None = None) -> list[dict[str, Any]]:
        """Return optimiser groups: the masks with a learning rate in metres of height, then any other parameters.

        Args:
            lr_metres: height that one Adam step moves, in metres; the paper uses 1e-8.
            lr: learning rate of the other parameters (a learnable focus, say). Default: the optimiser's.

        Example:
            >>> optics = TiDyOptics()
            >>> optimizer = torch.optim.Adam(optics.parameter_groups(lr_metres=1e-8), betas=(0.99, 0.999))
            >>> optimizer.param_groups[0]["eps"]
            1e-15
        """
        groups: list[dict[str, Any]] = [adam_groups(self.masks, lr_metres)]
        in_masks = {id(p) for p in self.masks.parameters()}
        others = [p for p in self.parameters() if id(p) not in in_masks]
        if others:
            groups.append({"params": others} if lr is None else {"params": others, "lr": lr})
        return groups

    def as_transform(self, seed: int | None = None, key: Any = "index") -> DatasetTransform:
        """Return the camera as a transform of single samples, without gradients. See :class:`DatasetTransform`."""
        return DatasetTransform(self, seed, key)

    @property
    def clamped_pixels(self) -> int:
        """Pixels of the last capture whose defocus lay outside the camera's range and was clamped to its end."""
        return 0 if self._clamped is None else int(self._clamped)

    def extra_repr(self) -> str:
        """Describe the camera in a person's words."""
        settings = self.fidelity
        return (
            f"fidelity {settings.name!r}: {len(self.defocus_nodes)} {settings.layers} layers of defocus, PSF window "
            f"{self.window}x{self.window} px holding {self._held[0]:.0%} to {self._held[1]:.0%} of the light "
            f"({settings.stray_light} the rest); {self.compositing}, {self.border} border, {self.color_space} colour"
        )

    def __setattr__(self, name: str, value: Any) -> None:
        """Set an attribute; a part that shapes the PSFs makes window and pupil to be found anew."""
        super().__setattr__(name, value)
        if name in ("masks", "camera", "modulator", "spectrum", "fidelity"):
            self.__dict__.update(_window=None, _pupil=None)

    def __getstate__(self) -> dict[str, Any]:
        """Return what travels with pickle and deepcopy: nothing of the last capture."""
        return {**super().__getstate__(), "_clamped": None, "_memory": BankMemory()}

    # ------------------------------------------------------------------ inside

    @property
    def pupil(self) -> Pupil:
        """The aperture over the masks' pixels."""
        size = self.masks.phase.shape[-1]
        pupil = self.__dict__["_pupil"]
        if pupil is None:
            amplitude = circular_aperture(size, MASK_SPAN / size) if self._aperture is None else self._aperture
            if amplitude.shape[-1] % size:
                raise ValueError(
                    f"aperture must have a whole number of cells for each of the {size} mask pixels, got "
                    f"{tuple(amplitude.shape)}"
                )
            pupil = self.__dict__["_pupil"] = Pupil(amplitude, MASK_SPAN / amplitude.shape[-1])
        return pupil

    def _build(
        self,
        states: Tensor,
        weights: Tensor,
        spectrum: Spectrum,
        step: float | Tensor,
        window: int,
        tolerance: float,
        nodes: tuple[float, ...],
    ) -> PSFBank:
        dispersion = [self.masks.dispersion(w) for w in spectrum.wavelengths]
        if self.fidelity.propagation == "paper":
            return paper_psf_bank(states, weights, self.pupil.amplitude, spectrum, dispersion, nodes)
        return exact_psf_bank(states, weights, self.pupil, spectrum, dispersion, nodes, step, window, tolerance)

    def _computed_bank(self, spectrum: Spectrum, dtype: torch.dtype, nodes: tuple[float, ...]) -> PSFBank:
        """PSFs at these nodes, computed or remembered, before anything is done about stray light."""
        states, weights = self.modulator(self.masks.phase.to(dtype))
        step, tolerance = self._pixel_step(), self.fidelity.pixel_tolerance
        build = partial(self._build, states, weights, spectrum, step, self.window, tolerance)
        learning = any(isinstance(x, Tensor) and x.requires_grad for x in (states, weights, step))
        if torch.compiler.is_compiling() or isinstance(step, Tensor) or (learning and torch.is_grad_enabled()):
            return build(nodes)
        dispersion = tuple(self.masks.dispersion(w) for w in spectrum.wavelengths)
        paper = self.fidelity.propagation == "paper"
        setting = (spectrum, dispersion, step, self.window, tolerance, paper, self.pupil)
        return self._memory.recall(setting, states, weights, nodes, build)

    def _scene_bank(self, channels: int, dtype: torch.dtype, defocus: Tensor) -> PSFBank:
        """PSFs at the layers that a scene's defocus lies between: those of other depths are not computed."""
        spectrum, kind = self._spectrum(channels), self.fidelity.layers
        nodes = self.defocus_nodes
        if kind in ("nearest", "linear"):
            bank = self._computed_bank(spectrum, dtype, _around(nodes, defocus))
        else:
            spacing, guards = (nodes[-1] - nodes[0]) / (len(nodes) - 1), TAPS[kind] // 2
            finer = ceil(spacing / FINE_SPACING)
            fine = tuple(nodes[0] + spacing / finer * i for i in range(finer * (len(nodes) - 1) + 1))
            targets = _around(fine, defocus)
            first = floor((targets[0] - nodes[0]) / spacing + 1e-9) - guards
            last = ceil((targets[-1] - nodes[0]) / spacing - 1e-9) + guards
            samples = tuple(nodes[0] + spacing * i for i in range(first, last + 1))
            bank = self._computed_bank(spectrum, dtype, samples)
            bank = interpolated_bank(bank, samples, targets, self._band() if kind == "bandlimited" else None)
        return bank.with_stray_light(self.fidelity.stray_light)

    def _band(self) -> float:
        return defocus_band(self.pupil.max_rho2, min(self.spectrum.wavelengths), REFERENCE_WAVELENGTH)

    def _pixel_step(self) -> float | Tensor:
        """A sensor pixel seen from the pupil, in metres: see :func:`exact_psf_bank`."""
        return self.camera.pixel_pitch * self.camera.aperture_radius / self.camera.image_distance

    def _spectrum(self, channels: int) -> Spectrum:
        if channels == len(self.spectrum.weights):
            return self.spectrum
        if channels == 1:
            return Spectrum.monochrome()
        raise ValueError(
            f"image must have {len(self.spectrum.weights)} channels as the spectrum has, or 1, got {channels}"
        )

    def _compute_dtype(self, image: Tensor) -> torch.dtype:
        return torch.float64 if self.fidelity.double or image.dtype == torch.float64 else torch.float32

    def _checked(self, image: Any, depth: Any) -> tuple[Tensor, Tensor, bool]:
        """Check a sample's types and shapes, and eagerly its values; return it batched."""
        if depth is None:
            raise ValueError("depth is missing: call optics(image, depth), optics((image, depth)) or optics(mapping)")
        batched = not isinstance(image, Tensor) or image.ndim != 3
        check_float_tensor("image", image, 4 if batched else 3, "(B, C, H, W) or (C, H, W)")
        check_float_tensor("depth", depth, image.ndim, "(B, 1, H, W) or (1, H, W), as the image is batched or not")
        if not batched:
            image, depth = image[None], depth[None]
        self._spectrum(image.shape[1])
        if image.numel() == 0:
            raise ValueError(f"image must hold at least one pixel, got shape {tuple(image.shape)}")
        if depth.shape[1] != 1 or depth.shape[-2:] != image.shape[-2:] or depth.shape[0] not in (1, image.shape[0]):
            raise ValueError(
                f"depth must have shape {(image.shape[0], 1, *image.shape[-2:])} to fit the image, got "
                f"{tuple(depth.shape)}"
            )
        if self.check_inputs and not torch.compiler.is_compiling():
            check_finite("image", image)
            self.camera.defocus(depth.detach(), check_inputs=True)
        return image, depth, batched

    def _count_clamped(self, defocus: Tensor) -> None:
        """Count pixels beyond the range; say so once. Half a thousandth of a radian of rounding is not beyond."""
        if torch.compiler.is_compiling():
            return
        lo, hi = self.camera.defocus_range
        self._clamped = ((defocus < lo - 5e-4) | (defocus > hi + 5e-4)).detach().sum()
        if self.check_inputs and not self._warned and (count := int(self._clamped)):
            self._warned = True
            warnings.warn(
                f"{count} of {defocus.numel()} pixels have a defocus between {float(defocus.detach().min()):+.2f} and "
                f"{float(defocus.detach().max()):+.2f} rad, beyond the camera's range {lo:+.2f} to {hi:+.2f}: they are "
                f"rendered as its ends (see ThinLensCamera.for_scene, or its depth_range)",
                stacklevel=4,
            )

    def _cropped(self, tensor: Tensor) -> Tensor:
        """Crop a map to the capture's view, which is smaller only with the border ``"valid"``."""
        margin = self.window // 2 if self.border == "valid" else 0
        return tensor[..., margin : tensor.shape[-2] - margin, margin : tensor.shape[-1] - margin]

    def _map_sample(
        self,
        sample: Mapping[str, Any],
        depth: Tensor | None,
        params: Mapping[str, Tensor] | None,
        generator: torch.Generator | None,
    ) -> dict[str, Any]:
        keys = [key for key in DEPTH_KEYS if key in sample]
        if "image" not in sample:
            raise KeyError(f"a mapping sample needs an 'image', got the keys {list(sample)}")
        if depth is not None or len(keys) != 1:
            raise KeyError(
                f"a mapping sample needs its depth under 'depth' or 'mask_depth', and in one place only, got the keys "
                f"{list(sample)}"
            )
        image, depth = sample["image"], sample[keys[0]]
        coded = self.capture(image, depth, params, generator)
        return {**sample, "image": coded, "all_in_focus": self._cropped(image), keys[0]: self._cropped(depth)}


def _refit_window(optics: TiDyOptics, _: Any) -> None:
    optics.fit_window()


def _around(nodes: tuple[float, ...], defocus: Tensor) -> tuple[float, ...]:
    """Return the nodes that a defocus map lies between; all of them while compiling, which cannot look."""
    if torch.compiler.is_compiling():
        return nodes
    lowest, highest = torch.stack(torch.aminmax(defocus.detach())).tolist()
    # On a node the next layer has no weight but a slope: where depth is learnt it must be there.
    extra = int(defocus.requires_grad)
    first = max(0, bisect_right(nodes, lowest) - 1 - extra)
    last = min(len(nodes) - 1, max(0, bisect_left(nodes, highest) + extra))
    return nodes[min(first, last) : last + 1]


def _any_channels(function: Any, image: Tensor) -> Tensor:
    """Apply a function of kornia's that wants three channels to images of any number."""
    if image.shape[1] == 3:
        return function(image)
    planes = image.flatten(0, 1)[:, None]
    return function(planes.expand(-1, 3, -1, -1))[:, 0].reshape(image.shape)
