"""TiDyOptics: a camera whose phase mask changes during one exposure, as one module in front of any pipeline."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, Self, cast

import torch
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from torch import Tensor, nn
from torch.utils.data import get_worker_info

from kornia_tidy.camera.dataset_transform import DatasetTransform
from kornia_tidy.checks import check_choice, check_float_tensor, check_generator, check_part, check_positive
from kornia_tidy.fidelity import Fidelity
from kornia_tidy.masks.base import PhaseMasks, adam_groups
from kornia_tidy.optics.spectrum import Spectrum
from kornia_tidy.optics.thin_lens import DefocusRange, ThinLensCamera
from kornia_tidy.optics.units import check_image, layout_remedy, misread_depth, tell_once
from kornia_tidy.psf.camera_settings import settings_of
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.psf.psf_model import CodedLens
from kornia_tidy.render.bands import padded_band
from kornia_tidy.render.borders import BORDERS, check_border
from kornia_tidy.render.compositing import COMPOSITING, render
from kornia_tidy.runtime.threads import CaptureNotes
from kornia_tidy.runtime.tracing import is_followed, is_value_unknown, refuse_torchscript
from kornia_tidy.sensor.noise import STRIP, SensorNoise
from kornia_tidy.systems.presets import published_system

if TYPE_CHECKING:
    from kornia_tidy.planning.render_plan import RenderPlan

_OWN_SETTINGS = ("sensor", "compositing", "color_space", "border")
COLOR_SPACES = ("srgb", "linear", "paper")
DEPTH_KEYS = ("depth", "mask_depth")  # the second is how kornia's containers know a map that must be warped
# What a capture in float32 of three channels takes at its peak beyond image and capture: for tiles, and a pixel.
_BYTES_OF_TILES, _BYTES_A_PIXEL = 24 << 20, 120
_DEFAULT_SENSOR = SensorNoise(0.01)
_BEYOND = "depths beyond the camera's range"


class TiDyOptics(CodedLens):
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
        compositing: ``"gather"`` (the paper's equation 1), ``"scatter"`` (conserves flux) or ``"occlusion"`` (near
            things hide far ones; each state of the exposure is rendered, see ``Fidelity.occlusion_states``; not for a
            spectrum with a basis).
        color_space: how images are encoded: ``"srgb"`` (default) is decoded to linear light and encoded after;
            ``"linear"`` passes untouched, beyond 1 too; ``"paper"`` treats sRGB values as light, as the paper does,
            and then the sensor's units are encoded ones.
        border: ``"reflect"``, ``"replicate"``, ``"zero"``, ``"circular"``, or ``"valid"``, which crops image, depth
            and clean image alike to where the whole PSF fits.
        spectrum: wavelengths and how each channel weights them. Default: 610, 530 and 470 nm, one a channel. Images of
            one channel are taken at 530 nm. With a basis, as ``camera_spectrum(reflectance=True)`` gives, each colour
            has a reflectance spectrum, and what is red blurs in other PSFs than what is blue.
        aperture: amplitude over the mask's pixels (N, N), or finer by a whole factor. Default: the binary disc.
        check_inputs: look at the values of images and depths before any work, eagerly. What seems to be in another
            unit (depth in millimetres, images in 0..255 or normalised) is told once, with the remedy.
        memory_budget: bytes that a capture without gradients may take beyond image and capture. Larger images go
            through in bands of 64 rows or more, which changes nothing but the last digits.

    Shape:
        - ``optics(image, depth)``: (B, C, H, W) and (B, 1, H, W), or both without B, to the coded image.
        - ``optics((image, depth, ...))`` to ``(coded, depth, ...)``.
        - ``optics({"image": ..., "depth": ..., ...})`` to the same mapping with ``"image"`` coded, and
          ``"all_in_focus"`` the clean image. The depth may stand under ``"mask_depth"`` instead; a ``"mask"`` of what
          is valid is cropped like the depth.

    Raises:
        TypeError: if image or depth are not floating-point tensors, or an argument is of another type.
        ValueError: if shapes do not fit, a value or a mask is NaN, an sRGB value is above 16, a depth is not positive,
            the defocus needs PSFs too large, or options contradict each other.
        KeyError: if a mapping has no image or no depth.

    Convention:
        - Images are RGB; depth is metres (or what the camera takes), ``inf`` allowed.
        - Optics run in float32 or better, under autocast too; the capture has the image's dtype. Keep depth float32.
        - Defocus beyond the camera's range is clamped to its ends; ``clamped_pixels`` counts them.
        - Noise comes from the global generator, from ``generator=``, or from ``params=`` drawn before by
          :meth:`draw`. ``eval()`` does not switch it off: a camera has noise at test time too.
        - The capture is detached inside a DataLoader's worker, and only there; see :meth:`as_transform`.
        - Threads may share a camera: each capture sees masks, parts and window as they are at one moment. The order in
          which threads draw from the global generator is open: give each capture its ``generator=``.
        - ``state_dict()`` holds settings and PSF window too; see :class:`~kornia_tidy.psf.camera_state.CameraState`.

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

    _SETTABLE: ClassVar = {**CodedLens._SETTABLE, **{name: name for name in _OWN_SETTINGS}}

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
        memory_budget: int = 512 << 20,
    ) -> None:
        check_positive("memory_budget", memory_budget, "bytes")
        fidelity = Fidelity.of(fidelity)
        paper = fidelity.propagation == "paper"
        color_space = color_space or ("paper" if paper else "srgb")
        check_choice("color_space", color_space, COLOR_SPACES)
        check_choice("compositing", compositing, tuple(COMPOSITING))
        check_choice("border", border, BORDERS)
        if paper and (color_space != "paper" or compositing != "gather"):
            raise ValueError(
                f"fidelity 'paper' means color_space='paper' and compositing='gather', got {color_space!r} and "
                f"{compositing!r}: leave them out, or use another fidelity"
            )
        super().__init__(masks, camera, modulator, fidelity, spectrum, aperture)
        if compositing == "occlusion" and self.spectrum.basis is not None:
            # What hides is normalised by the light of its PSF; those between colours hold as much below zero as above.
            raise ValueError(
                "compositing 'occlusion' needs colours without spectra of their own, got a spectrum with a basis: "
                "leave reflectance=True out, or use 'gather' or 'scatter'"
            )
        if sensor is not None:
            check_part("sensor", sensor, nn.Module, "a sensor such as SensorNoise(0.01), or None for no noise")
        self.sensor = SensorNoise(0.01) if sensor is _DEFAULT_SENSOR else sensor  # cameras share no part by default
        self.compositing = compositing
        self.color_space = color_space
        self.border = border
        self.check_inputs = check_inputs
        self.memory_budget = memory_budget
        self._notes = CaptureNotes()

    @classmethod
    def from_preset(cls, name: str, *, generator: torch.Generator | None = None, **overrides: Any) -> Self:
        """Return a published optical system, its masks as they are before training.

        Args:
            name: one of ``tidy-5``, ``tidy-1``, ``fresnel``, ``phasecam3d``, ``ikoma2021``, ``chang2019``,
                ``liu2022-pixelwise``, ``liu2022-spiral`` and ``sitzmann2018``. What each is, and where every value of
                it was read or guessed, stands in :data:`kornia_tidy.systems.SYSTEMS`.
            generator: source of the noise that masks start from, where they do. Default: the global generator.
            overrides: arguments of the class that replace the system's, such as ``fidelity``, ``sensor`` or ``camera``.

        Raises:
            ValueError: if there is no system of this name, or an override contradicts another argument.
            TypeError: if an override is no argument of the class.

        Convention:
            - The fidelity is ``"balanced"``, which samples honestly. ``from_preset("tidy-5", fidelity="paper")`` is the
              published system with its discretisation; its data, a normalised disparity, go with
              ``camera=DefocusRange(-20, 20)``.

        Example:
            >>> optics = TiDyOptics.from_preset("tidy-5", generator=torch.Generator().manual_seed(0))
            >>> optics.masks.phase.shape, [round(psi, 6) for psi in optics.defocus_nodes[::10]]
            (torch.Size([5, 23, 23]), [-20.0, 0.0, 20.0])
            >>> optics = TiDyOptics.from_preset("ikoma2021", sensor=None)
            >>> optics.compositing, optics.sensor
            ('occlusion', None)
        """
        return cls(**published_system(name).parts(generator, **overrides))

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
            now = self._now(image[0])
            coded = now.capture(image[0], image[1], params, generator)
            parts = (coded, now._cropped(image[1]), *image[2:])
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
        if torch.jit.is_tracing():
            refuse_torchscript()
        check_generator(generator)
        image, depth, batched = self._checked(image, depth)
        with torch.autocast(image.device.type, enabled=False):
            now = self._now(image)
            check_border(now.border, *image.shape[-2:], now.window)
            if len(image) == 0:
                coded = now._no_capture(image, depth)
            elif (rows := now._rows_at_once(image, depth)) is None:
                coded = now._capture_at_once(image, depth, params, generator)
            else:
                coded = now._capture_in_bands(image, depth, rows, params, generator)
        if not torch.compiler.is_compiling() and get_worker_info() is not None:
            coded = coded.detach()  # collation in a worker cannot carry gradients
        return coded if batched else coded[0]

    def _no_capture(self, image: Tensor, depth: Tensor) -> Tensor:
        """Return the captures of a batch of no images, of which gradients are zero."""
        self._survey([])
        states, weights = self._states(self._compute_dtype(image))
        return self._cropped(image) + (states.sum() + weights.sum() + depth.sum()).to(image)

    def _capture_at_once(
        self, image: Tensor, depth: Tensor, params: Mapping[str, Tensor] | None, generator: torch.Generator | None
    ) -> Tensor:
        defocus = self._defocus(depth, image)
        self._survey([defocus])
        banks = self._scene_banks(image.shape[1], defocus)
        return self._expose(image, defocus, banks, self.border, params, generator)

    def _capture_in_bands(
        self,
        image: Tensor,
        depth: Tensor,
        rows: int,
        params: Mapping[str, Tensor] | None,
        generator: torch.Generator | None,
    ) -> Tensor:
        """Take the picture some rows at a time, each with as much of its neighbours as the PSFs reach."""
        radius = self.window // 2
        height, width = self._cropped(image).shape[-2:]
        bands = [slice(top, min(top + rows, height)) for top in range(0, height, rows)]
        extremes = self._survey(self._defocus(part, image) for part in depth.split(rows, dim=-2))
        banks = self._scene_banks(image.shape[1], extremes)
        sides = "replicate" if self.border == "zero" else self.border  # what is black may lie anywhere
        coded = image.new_empty(*image.shape[:2], height, width)
        for band in bands:
            piece = padded_band(image, band, radius, self.border)
            there = self._defocus(padded_band(depth, band, radius, sides), image)
            own = None if params is None else {name: field[..., band, :] for name, field in params.items()}
            coded[..., band, :] = self._expose(piece, there, banks, "valid", own, generator)
        return coded

    def _expose(
        self,
        image: Tensor,
        defocus: Tensor,
        banks: list[tuple[Tensor | float, PSFBank]],
        border: str,
        params: Mapping[str, Tensor] | None,
        generator: torch.Generator | None,
    ) -> Tensor:
        """Take a picture of encoded light at known defocus."""
        light = self.decode(image.to(defocus.dtype))
        # Where colours have spectra, each channel of the sensor sees a plane for each channel of the scene.
        reflectances = banks[0][1].psfs.shape[1] // image.shape[1]
        if reflectances > 1:
            light = light.repeat(1, reflectances, 1, 1)
        look = partial(
            render,
            light,
            defocus,
            compositing=self.compositing,
            layers="nearest" if self.fidelity.layers == "nearest" else "linear",
            border=border,
            correlate=self.fidelity.correlate,
        )
        (share, bank), *others = banks
        light = look(bank=bank)
        if others:
            light = light * share
            for share, bank in others:
                light = light + look(bank=bank) * share
        if reflectances > 1:
            light = light.unflatten(1, (-1, reflectances)).sum(2)
        if self.sensor is not None:
            light = self.sensor(light, params=params, generator=generator)
        return self.encode(light).to(image.dtype)

    def _scene_banks(self, channels: int, defocus: Tensor) -> list[tuple[Tensor | float, PSFBank]]:
        """PSFs that a scene is rendered through, and for what share of the exposure.

        Their average does for the whole exposure, except where layers hide one another: there each state of its own.
        """
        bank = partial(self.scene_bank, channels, defocus.dtype, defocus)
        if self.compositing != "occlusion" or self.fidelity.occlusion_states == "mean":
            return [(1.0, bank())]
        return [(share, bank(state=state)) for state, share in enumerate(self.state_weights(defocus.dtype))]

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

    # ------------------------------------------------------------------ how exactly to compute

    @torch.no_grad()
    def plan(self, depth: Tensor, image: Tensor | None = None, tolerance: float = 1e-3) -> RenderPlan:
        """Return the cheapest way to capture a scene within an error. See :mod:`kornia_tidy.planning.planner`.

        Args:
            depth: (B, 1, H, W) or (1, H, W), as for a capture.
            image: (B, C, H, W) or (C, H, W). Default: photographs as they usually are, of the spectrum's channels.
            tolerance: root mean square error of the noise-free linear capture against ``reference``, full scale 1.

        Returns:
            A plan for the masks as they are now, whose ``fidelity`` is for :meth:`with_fidelity`.

        Raises:
            ValueError: if the batch holds no image, or as for a capture.

        Example:
            >>> from kornia_tidy import PixelwiseMask
            >>> optics = TiDyOptics(PixelwiseMask(1, initial="flat"))
            >>> plan = optics.plan(torch.full((1, 96, 96), 0.9), tolerance=1e-2)
            >>> plan.predicted_error <= 1e-2
            True
        """
        from kornia_tidy.planning.planner import Planner  # noqa: PLC0415 (only who plans waits for it)

        shape = (len(self.spectrum.weights), *depth.shape[-2:])
        blank = depth.new_zeros(()).expand(*depth.shape[:-3], *shape) if image is None else image
        blank, depth, _ = self._checked(blank, depth)
        if len(blank) == 0 or len(depth) == 0:
            raise ValueError(f"a plan needs at least one image and its depth, got {len(blank)} and {len(depth)}")
        light = None if image is None else self.decode(blank.to(self._compute_dtype(blank)))
        defocus = self._defocus(depth, depth)
        return Planner(self, blank.shape[1]).scene(defocus, light).plan(tolerance)

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
        """Pixels of the last capture whose defocus lay outside the camera's range and was clamped to its end.

        Of a burst, those of one shot; of a moving scene, those of all its moments. Each thread sees those of the last
        capture that it took itself, be it with this camera or with a view of it such as ``with_fidelity`` returns.
        """
        return 0 if self._clamped is None else int(self._clamped)

    @property
    def _clamped(self) -> Tensor | None:
        return self._notes.clamped

    @_clamped.setter
    def _clamped(self, count: Tensor | None) -> None:
        self._notes.clamped = count

    @property
    def _warned(self) -> bool:
        return self._notes.is_told(_BEYOND)

    @_warned.setter
    def _warned(self, told: bool) -> None:
        if told:
            self._notes.first_time(_BEYOND)

    def extra_repr(self) -> str:
        """Describe the camera in a person's words."""
        settings, held = self.fidelity, self.light_held
        return (
            f"fidelity {settings.name!r}: {len(self.defocus_nodes)} {settings.layers} layers of defocus, PSF window "
            f"{self.window}x{self.window} px holding {held[0]:.0%} to {held[1]:.0%} of the light "
            f"({settings.stray_light} the rest); {self.compositing}, {self.border} border, {self.color_space} colour"
        )

    def settings(self) -> dict[str, Any]:
        """Return what shapes a capture besides the weights, by the names of the parts."""
        return {**super().settings(), **{name: settings_of(getattr(self, name)) for name in _OWN_SETTINGS}}

    def _take_over(self, saved: Mapping[str, Any]) -> None:
        for name, allowed in (("compositing", COMPOSITING), ("color_space", COLOR_SPACES), ("border", BORDERS)):
            if name in saved:
                check_choice(name, saved[name], tuple(allowed))
        super()._take_over(saved)

    # ------------------------------------------------------------------ inside

    def _now(self, image: Any) -> Self:
        """Return the camera at this moment, for a capture of an image."""
        if not isinstance(image, Tensor):
            return self
        with torch.autocast(image.device.type, enabled=False):
            return self.snapshot(self._compute_dtype(image))

    def _rows_at_once(self, image: Tensor, depth: Tensor) -> int | None:
        """Rows whose capture fits the memory allowed; None where all do, or where the whole image is needed."""
        learning = torch.is_grad_enabled() and (
            image.requires_grad or depth.requires_grad or any(p.requires_grad for p in self.parameters())
        )
        veiled = self.fidelity.stray_light == "veil"
        # Beyond a zero border there is nothing that hides, which black pixels would.
        unseen = self.compositing == "occlusion" and self.border == "zero"
        if learning or is_followed() or veiled or unseen:
            return None
        itemsize = self._compute_dtype(image).itemsize
        row = _BYTES_A_PIXEL * itemsize // 4 * image.shape[0] * image.shape[-1]
        rows = max(STRIP, (self.memory_budget - _BYTES_OF_TILES) // row // STRIP * STRIP)
        return None if rows >= image.shape[-2] else rows

    def _defocus(self, depth: Tensor, image: Tensor) -> Tensor:
        """The defocus of a depth map in the type that an image is computed in."""
        look = self.check_inputs and not is_value_unknown()
        return self.camera.defocus(depth.to(self._compute_dtype(image)), check_inputs=look)

    def _compute_dtype(self, image: Tensor) -> torch.dtype:
        return torch.float64 if self.fidelity.double or image.dtype == torch.float64 else torch.float32

    def _checked(self, image: Any, depth: Any) -> tuple[Tensor, Tensor, bool]:
        """Check a sample's types and shapes, and eagerly its values; return it batched."""
        if depth is None:
            raise ValueError("depth is missing: call optics(image, depth), optics((image, depth)) or optics(mapping)")
        batched = not isinstance(image, Tensor) or image.ndim != 3
        check_float_tensor("image", image, 4 if batched else 3, "(B, C, H, W) or (C, H, W)")
        check_float_tensor("depth", depth, image.ndim, "(B, 1, H, W) or (1, H, W), as the image is batched or not")
        remedy = layout_remedy(tuple(image.shape), len(self.spectrum.weights))
        if not batched:
            image, depth = image[None], depth[None]
        self._spectrum(image.shape[1], remedy)
        if 0 in image.shape[-2:]:
            raise ValueError(f"image must hold at least one pixel, got shape {tuple(image.shape)}")
        if depth.shape[1] != 1 or depth.shape[-2:] != image.shape[-2:] or depth.shape[0] not in (1, image.shape[0]):
            raise ValueError(
                f"depth must have shape {(image.shape[0], 1, *image.shape[-2:])} to fit the image, got "
                f"{tuple(depth.shape)}{layout_remedy(tuple(depth.shape), 1, 'depth') if depth.shape[1] != 1 else ''}"
            )
        self._check_values(image)
        return image, depth, batched

    def check_scene(self, image: Tensor, depth: Tensor) -> None:
        """Look at an image and its depth as a capture does: refuse what makes no sense, warn of other units."""
        image, depth, _ = self._checked(image, depth)
        self._tell_of_depth(*torch.aminmax(self._defocus(depth, image).detach()))

    def _tell_of_depth(self, lowest: Tensor, highest: Tensor) -> bool:
        """Warn once of depths that seem to be in another unit; return whether they do."""
        said = misread_depth(self.camera, lowest, highest) if self.check_inputs else None
        if said is not None:
            tell_once(self._notes, "depth", said, stacklevel=9)
        return said is not None

    def _check_values(self, image: Tensor) -> None:
        """Refuse values without sense; warn once of those that seem to be in another unit."""
        if self.check_inputs and not is_value_unknown():
            said = check_image(image, encoded=self.color_space != "linear")
            if said is not None:
                tell_once(self._notes, "image", said, stacklevel=8)

    def _survey(self, parts: Iterable[Tensor]) -> Tensor:
        """Return the lowest and highest defocus of a map given in parts; count pixels beyond the range, say so once.

        Half a thousandth of a radian of rounding is not beyond.
        """
        if is_value_unknown():
            return torch.zeros(2)
        lo, hi = self.camera.defocus_range
        extremes, pixels, clamped = [], 0, torch.tensor(0)
        for defocus in parts:
            own = defocus.detach()
            lowest, highest = torch.aminmax(own)
            extremes.append(torch.stack([lowest, highest]))
            pixels += own.numel()
            if not bool((lowest >= lo - 5e-4) & (highest <= hi + 5e-4)):
                clamped = clamped.to(own.device) + ((own < lo - 5e-4) | (own > hi + 5e-4)).sum()
        self._clamped = clamped
        if not extremes:
            return torch.zeros(2)
        lowest, highest = torch.stack(extremes).amin(0)[0], torch.stack(extremes).amax(0)[1]
        told = self._tell_of_depth(lowest, highest)
        if self.check_inputs and not told and (count := int(clamped)) and self._notes.first_time(_BEYOND):
            warnings.warn(
                f"{count} of {pixels} pixels have a defocus between {float(lowest):+.2f} and {float(highest):+.2f} "
                f"rad, beyond the camera's range {lo:+.2f} to {hi:+.2f}: they are rendered as its ends (see "
                f"ThinLensCamera.for_scene, or its depth_range)",
                stacklevel=5,
            )
        return torch.stack([lowest, highest])

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
        now = self._now(image)
        coded = now.capture(image, depth, params, generator)
        cropped = {name: now._cropped(sample[name]) for name in (keys[0], "mask") if name in sample}
        return {**sample, "image": coded, "all_in_focus": now._cropped(image), **cropped}


def _any_channels(function: Any, image: Tensor) -> Tensor:
    """Apply a function of kornia's that wants three channels to images of any number."""
    if image.shape[1] == 3:
        return function(image)
    planes = image.flatten(0, 1)[:, None]
    return function(planes.expand(-1, 3, -1, -1))[:, 0].reshape(image.shape)
