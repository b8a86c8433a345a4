"""TiDyOptics: a camera whose phase mask changes during one exposure, as one module in front of any pipeline."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial, reduce
from itertools import chain
from operator import add
from typing import TYPE_CHECKING, Any, NoReturn, Self, cast

import torch
from torch import Tensor, nn

from kornia_tidy.camera.dataset_transform import DatasetTransform
from kornia_tidy.camera.published_systems import published_parts
from kornia_tidy.camera.samples import (
    Notes,
    Sample,
    check_defocus,
    check_light,
    compute_dtype,
    defocus_extremes,
    defocus_extremes_in_one_read,
    read_sample,
)
from kornia_tidy.camera.saved_parts import checked_settings
from kornia_tidy.camera.strips import Strip, placed, rows_at_once, strips_of
from kornia_tidy.checks import check_choice, check_finite, check_positive
from kornia_tidy.fidelity import PRESETS, Fidelity
from kornia_tidy.kernels.pixel_ops import decode, encode
from kornia_tidy.masks.base import PhaseMasks, parameter_groups
from kornia_tidy.mode import Mode, refuse_torchscript, torch_mode, values_unread
from kornia_tidy.modulator.modulator import Timeline
from kornia_tidy.optics.holes import HOLES
from kornia_tidy.optics.lens.lens import Lens
from kornia_tidy.optics.spectrum import Spectrum
from kornia_tidy.optics.thin_lens import DefocusRange, ThinLensCamera
from kornia_tidy.psf.camera_settings import (
    EXTRA_STATE,
    check_settings,
    read_settings,
    settings_of,
    take_over,
    write_settings,
)
from kornia_tidy.psf.field import check_center
from kornia_tidy.psf.field_bank import FieldBank
from kornia_tidy.psf.learnable_aperture import LearnableAperture
from kornia_tidy.psf.lens_limits import PARTS
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.psf.psf_model import PSFModel
from kornia_tidy.psf.psf_window import FittedWindow
from kornia_tidy.psf.pupil import Pupil
from kornia_tidy.psf.wide_psfs import held_nodes
from kornia_tidy.render.borders import BORDERS, check_border, cropped
from kornia_tidy.render.compositing import COMPOSITING
from kornia_tidy.render.dispatch import Explanation, Rendering, explain
from kornia_tidy.render.pieces import pieces_of, render_piece
from kornia_tidy.render.scene import layered_scene
from kornia_tidy.sensor.sensor import Sensor, SensorNoise, check_sensor

if TYPE_CHECKING:
    from kornia_tidy.accuracy.planning.render_plan import RenderPlan
    from kornia_tidy.psf.wide_blur import WideBlur

_DEFAULT_SENSOR = SensorNoise(0.01)
_SUBMODULES = ("masks", "camera", "modulator", "lens", "aperture")
COLOR_SPACES = ("srgb", "linear", "paper")
OWN_SETTINGS = ("sensor", "compositing", "color_space", "border")  # of a camera, beside those of its PSF model


def _part(name: str, meaning: str, *, settable: bool = False) -> Any:
    """Return a property that is the PSF model's; to set it puts another model in the place of the present one."""

    def swap(self: Any, value: Any) -> None:
        self.psf_model = self.psf_model.replace(**{name: value})

    return property(lambda self: getattr(self.psf_model, name), swap if settable else None, doc=meaning)


class TiDyOptics(nn.Module):
    r"""A programmable camera: an image and its depth go in, a coded capture comes out, gradients reach the masks.

    The chain is: decode to linear light, blur by the PSFs of each pixel's depth (averaged over the masks shown during
    the exposure), sensor noise, encode. Its parts can be swapped: ``masks``, ``modulator``, ``camera``, ``sensor``.

    Masks, camera, modulator, lens and a learnable aperture are those of its
    :class:`~kornia_tidy.psf.psf_model.PSFModel` and its submodules, so that states hold ``masks.phase``, and optimisers
    and ``to(device)`` reach them. To set one of them, or ``fidelity``, ``spectrum`` or ``aperture``, puts another PSF
    model in the place of the present one.

    Args:
        masks: phase masks. Default: five learnable 23x23 masks of uniform noise, as in the paper.
        camera: turns depth into defocus. Default: 50 mm, f/17.6, focused at 0.595 m, pixels of 8 um, so that depths
            from 0.298 m to infinity span the paper's range of defocus.
        modulator: turns masks into the states shown and their weights. Default: equal dwell times.
        sensor: noise and digitisation in linear light, full scale 1; None does not change the light.
        fidelity: a preset's name (``"paper"``, ``"draft"``, ``"balanced"``, ``"reference"``) or a
            :class:`~kornia_tidy.fidelity.Fidelity`.
        compositing: ``"gather"`` (the paper's equation 1), ``"scatter"`` (conserves flux) or ``"occlusion"`` (near
            things hide far ones; each state of the exposure is rendered, see ``Fidelity.occlusion_states``; not for a
            spectrum with a basis).
        color_space: how images are encoded: ``"srgb"`` (default) is decoded to linear light and encoded after;
            ``"linear"`` passes untouched, also beyond 1; ``"paper"`` treats sRGB values as light, as the paper does,
            and then the sensor's units are encoded ones.
        border: ``"reflect"``, ``"replicate"``, ``"zero"``, ``"circular"``, or ``"valid"``, which crops image, depth
            and clean image alike to where the whole PSF fits.
        spectrum: wavelengths and how each channel weights them. Default: 610, 530 and 470 nm, one a channel. Images of
            one channel are taken at 530 nm. With a basis, as ``camera_spectrum(reflectance=True)`` gives, each colour
            has a reflectance spectrum, and red things have other PSFs than blue ones.
        aperture: amplitude over the mask's pixels (N, N), or finer by a whole factor. Default: the pixels with centres
            in the disc; the smooth disc for :class:`~kornia_tidy.masks.no_mask.NoMask`. (K, N, N): one for each mask,
            where the modulator shows them one by one. An ``nn.Parameter`` is learnt: see
            :class:`~kornia_tidy.psf.LearnableAperture`.
        check_inputs: look at the values of images and depths before any work, eagerly. Inputs in another unit (depth in
            millimetres, images in 0..255 or normalised) give one warning with the remedy. A sensor checks its light
            in any case.
        memory_budget: bytes that a capture without gradients may take beyond image and capture. Images that take half
            of it go through in bands of 64 rows or more, and PSFs that exceed the other half are computed in pieces,
            some layers at a time, also with gradients. That changes nothing but the last digits.
        holes: ``"error"`` refuses a depth of NaN, 0 or less; ``"fill"`` fills such pixels from the nearest known one,
            as :func:`kornia_tidy.data.fill_holes` does, with gradients and in compiled graphs. Like ``check_inputs`` it
            is not part of the state.
        lens: a :class:`~kornia_tidy.optics.Lens` with the masks in its stop, or the name of one, such as
            ``"double-gauss-50mm"``, made for the camera's aperture and focus. Its focal length, f-number and focus are
            the camera's. Each pixel sees the PSF of its place in the picture, within the fidelity's
            ``field_tolerance``; :meth:`psf_bank` gives those of single places. Default: an ideal lens.
        field_center: where the middle of the pictures lies, y and x in sensor pixels from the lens's axis: of crops. A
            capture may bring its own: as an argument, or as an entry of a mapping.

    Shape:
        - ``optics(image, depth)``: (B, C, H, W) and (B, 1, H, W), or both without B, to the coded image.
        - ``optics((image, depth, ...))`` to ``(coded, depth, ...)``.
        - ``optics({"image": ..., "depth": ..., ...})`` to the same mapping with ``"image"`` coded, and
          ``"all_in_focus"`` the clean image. The depth may stand under ``"mask_depth"`` instead; a ``"mask"`` of valid
          pixels is cropped like the depth.
        - With ``holes="fill"`` the depth of a tuple or a mapping comes back filled, and a mapping gets ``"valid"``,
          bool in the depth's shape: False in holes, and where a ``"valid"`` or a bool ``"mask"`` that it had was False.
          A named tuple asks for it by a field ``valid``, as :class:`kornia_tidy.data.Scene` has it.

    Raises:
        TypeError: if image or depth are not floating-point tensors, or an argument is of another type.
        ValueError: if shapes do not fit, a value or a mask is NaN, an sRGB value is above 16, a depth is not positive
            (with ``holes="fill"``: of no pixel), the defocus needs PSFs too large, or options contradict each other.
        KeyError: if a mapping has no image or no depth.

    Convention:
        - Images are RGB; depth is metres (or the camera's unit), ``inf`` allowed.
        - Optics run in float32 or better, also under autocast; the capture has the image's dtype. Keep depth float32.
        - Defocus beyond the camera's range is clamped to its ends; ``clamped_pixels`` counts them.
        - Noise comes from the global generator, from ``generator=``, or from ``params=`` drawn before by
          :meth:`draw`. ``eval()`` does not switch it off: a camera also has noise at test time.
        - The capture is detached inside a DataLoader's worker, and only there; see :meth:`as_transform`.
        - Threads may share a camera while its masks and parts stand still. Where they change meanwhile, as in training,
          give each thread its own copy (``copy.deepcopy``). The order in which threads draw from the global generator
          is open: give each capture its ``generator=``.
        - ``state_dict()`` also holds settings and PSF window; see :meth:`load_state_dict`.

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

    psf_model: PSFModel
    fixed_defocus: tuple[float, float] | None = None  # of every scene, see with_fixed_layers
    masks: PhaseMasks
    camera: ThinLensCamera | DefocusRange
    modulator: nn.Module
    lens: Lens | None

    fidelity: Fidelity = _part("fidelity", "How exactly to compute.", settable=True)
    spectrum: Spectrum = _part("spectrum", "Wavelengths, and how each channel weights them.", settable=True)
    aperture: Tensor | LearnableAperture | None = _part(
        "aperture", "Amplitude over the mask's pixels, None for the binary disc; a module where it is learnt."
    )
    pupil: Pupil = _part("pupil", "The aperture over the masks' pixels.")
    defocus_nodes: tuple[float, ...] = _part(
        "defocus_nodes", "Defocus of the PSF bank's layers in radians: evenly spaced over the camera's range."
    )
    window: int = _part(
        "window", "Side of the PSFs in pixels: given by the fidelity, or measured by :meth:`fit_window`."
    )

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
        aperture: Tensor | LearnableAperture | None = None,
        check_inputs: bool = True,
        memory_budget: int = 512 << 20,
        holes: str = "error",
        lens: Lens | str | None = None,
        field_center: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        check_positive("memory_budget", memory_budget, "bytes")
        fidelity = Fidelity.of(fidelity)
        paper = fidelity.propagation == "paper"
        color_space = color_space or ("paper" if paper else "srgb")
        check_choice("color_space", color_space, COLOR_SPACES)
        check_choice("compositing", compositing, tuple(COMPOSITING))
        check_choice("border", border, BORDERS)
        check_choice("holes", holes, HOLES)
        if paper and (color_space != "paper" or compositing != "gather"):
            raise ValueError(
                f"fidelity 'paper' means color_space='paper' and compositing='gather', got {color_space!r} and "
                f"{compositing!r}: leave them out, or use another fidelity"
            )
        super().__init__()
        self.psf_model = PSFModel(masks, camera, modulator, fidelity, spectrum, aperture, lens)
        for name in _SUBMODULES:
            self._take(name)
        self.register_load_state_dict_post_hook(_measure_window)
        if compositing == "occlusion" and self.spectrum.basis is not None:
            # Occlusion divides by the sum of each PSF; the PSFs between two colours sum to zero.
            raise ValueError(
                "compositing 'occlusion' needs colours without spectra of their own, got a spectrum with a basis: "
                "leave reflectance=True out, or use 'gather' or 'scatter'"
            )
        check_sensor(sensor)
        self.sensor = SensorNoise(0.01) if sensor is _DEFAULT_SENSOR else sensor  # cameras share no part by default
        self.compositing = compositing
        self.color_space = color_space
        self.border = border
        self.check_inputs = check_inputs
        self.holes = holes
        self.memory_budget = memory_budget
        self.field_center = check_center(field_center)
        self.notes = Notes()  # shared with cameras made by _replace

    @classmethod
    def from_preset(cls, name: str, *, generator: torch.Generator | None = None, **overrides: Any) -> Self:
        """Return a published optical system with untrained masks.

        Args:
            name: one of ``tidy-5``, ``tidy-1``, ``fresnel``, ``phasecam3d``, ``ikoma2021``, ``chang2019``,
                ``liu2022-pixelwise``, ``liu2022-spiral`` and ``sitzmann2018``. :data:`kornia_tidy.optics.SYSTEMS`
                describes each system and the source of each value.
            generator: source of the noise that masks start from, where they do. Default: the global generator.
            overrides: arguments of the class that replace the system's, such as ``fidelity``, ``sensor`` or ``camera``.
                ``lens="own"`` is the single element of ``chang2019`` or ``sitzmann2018`` as a real lens, see
                :func:`~kornia_tidy.camera.published_systems.single_element`.

        Raises:
            ValueError: if no system has this name, or an override contradicts another argument.
            TypeError: if an override is not an argument of the class.

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
        return cls(**published_parts(name, generator, **overrides))

    # ------------------------------------------------------------------ the parts and their PSFs

    def __setattr__(self, name: str, value: Any) -> None:
        """Set an attribute; masks, camera, modulator, lens and aperture are also those of the PSF model."""
        if name not in _SUBMODULES:
            super().__setattr__(name, value)
            return
        self.psf_model = self.psf_model.replace(**{name: value})
        self._take(name)

    def _take(self, name: str) -> None:
        """Make a part of the PSF model a part of this camera."""
        part = getattr(self.psf_model, name)
        if name != "aperture" or isinstance(part, nn.Module):
            super().__setattr__(name, part)
        else:
            self._modules.pop(name, None)  # an aperture that is not learnt is the PSF model's alone

    def __prepare_scriptable__(self) -> NoReturn:
        """Refuse ``torch.jit.script`` of this camera and of modules that contain it."""
        refuse_torchscript()

    @property
    def light_held(self) -> tuple[float, float]:
        """Least and largest share of the light in the window, as it was when the window was chosen."""
        return self.psf_model.fitted.held

    def fit_window(self) -> int:
        """Choose the smallest PSF window that holds the fidelity's share of the light of the present masks.

        It is done on construction, when a part is swapped, and after loading weights that do not tell their window;
        masks in training keep their window until this is called again. A window or a preset that fixes the side is only
        measured.

        Returns:
            The side in pixels: at most ``fidelity.max_window``, or as wide as the lens's defocus disc; with a warning
            if that does not hold the share.
        """
        self.psf_model = self.psf_model.with_window(None)
        return self.psf_model.fitted.side

    def psf_bank(
        self,
        channels: int | None = None,
        dtype: torch.dtype | None = None,
        defocus: Sequence[float] | None = None,
        *,
        field: Sequence[tuple[float, float]] | None = None,
    ) -> Any:
        """Return the PSFs of the present masks. See :meth:`kornia_tidy.psf.psf_model.PSFModel.psf_bank`."""
        return self.psf_model.psf_bank(channels, dtype, defocus, field=field)

    def state_weights(self, dtype: torch.dtype) -> Tensor:
        """Return the share of the exposure of each state that the modulator shows, (S,)."""
        return self.psf_model.state_weights(dtype)

    def timeline(self, dtype: torch.dtype) -> Timeline:
        """Return the modulator's states of the masks during one exposure, and their times."""
        return self.psf_model.timeline(dtype)

    def with_fidelity(self, fidelity: str | Fidelity) -> Self:
        """Return this camera at another fidelity. The parts are shared, so masks learn through both.

        Args:
            fidelity: a preset's name or a :class:`~kornia_tidy.fidelity.Fidelity`, such as that of a plan.
        """
        return self._replace(psf_model=self.psf_model.with_fidelity(fidelity))

    def with_fixed_layers(self, depth: Tensor | None = None) -> Self:
        """Return this camera with the same defocus layers for every scene. The parts are shared, so masks learn.

        A capture usually looks at the scene: it checks its values, and convolves the layers between its nearest and its
        farthest point. An accelerator has to be waited for to know them. With fixed layers a capture on an accelerator
        looks at no value: the host never waits, and a training step can be captured in a CUDA graph, once one was made
        before. On the CPU values are checked as ever.

        Args:
            depth: depths that span the range of all scenes, in the camera's unit, such as metres. Default: all of the
                camera's range. Depths beyond it are rendered as its nearest layer.

        Raises:
            ValueError: if a depth is NaN or not positive.

        Example:
            >>> from kornia_tidy import TiDyOptics
            >>> optics = TiDyOptics().with_fixed_layers(torch.tensor([0.5, 2.0]))
            >>> [round(psi, 2) for psi in optics.fixed_defocus]
            [-14.06, 3.8]
        """
        if depth is None:
            return self._replace(fixed_defocus=self.psf_model.camera.defocus_range)
        reach = torch.stack(torch.aminmax(self.psf_model.camera.defocus(depth.detach())))
        return self._replace(fixed_defocus=tuple(reach.tolist()))

    def through_state(self, state: int) -> Self:
        """Return this camera with one state of its modulator shown all the time. The parts and the window are shared.

        Args:
            state: index among the states that the modulator shows.

        Raises:
            ValueError: if the state is unknown.
        """
        return self._replace(psf_model=self.psf_model.through_state(state))

    def through_moment(self, moment: int) -> Self:
        """Return this camera with the modulator's state of one moment shown all the time. The parts are shared.

        Args:
            moment: index among the moments of :meth:`timeline`.

        Raises:
            ValueError: if the moment is unknown.
        """
        return self._replace(psf_model=self.psf_model.through_moment(moment))

    def with_bank(self, bank: PSFBank | FieldBank) -> Self:
        """Return this camera with measured PSFs instead of those of its masks. The other parts are shared.

        Args:
            bank: with the channels of the spectrum. Other depths than it holds are seen as the nearest of them. Of one
                over the field, see :meth:`kornia_tidy.psf.FieldBank.from_measured`, each pixel sees the PSFs of its
                place.
        """
        return self._replace(psf_model=self.psf_model.with_bank(bank))

    # ------------------------------------------------------------------ the camera at work

    def forward(
        self,
        image: Any,
        depth: Tensor | None = None,
        params: Mapping[str, Tensor] | None = None,
        generator: torch.Generator | None = None,
        field_center: Any = None,
    ) -> Any:
        """Take a picture of a sample given as tensors, a tuple or a mapping.

        Args:
            image: the image, or a whole sample; see the class for the forms.
            depth: the depth map, if ``image`` is a tensor.
            params: noise drawn before by :meth:`draw`, to repeat a capture or to compile one.
            generator: source of the noise (not while compiling).
            field_center: where the middle of the picture lies from the lens's axis, (2,), or of each image, (B, 2): y
                and x in sensor pixels. Default: the entry ``"field_center"`` of a mapping, else the camera's. Without a
                lens it says nothing.
        """
        sample, coded = read_sample(image, depth, self, generator, deferred=True, field_center=field_center), None
        device, dtype = sample.image.device, sample.image.dtype
        with (
            torch.autocast(device.type, enabled=False),
            nullcontext() if device.type == "cpu" else values_unread(device),
        ):
            for strip in self.strips(sample):  # one, of the whole picture, unless memory is short
                seen, rows = self.blurred(strip), strip.rows or slice(0, None)
                if self.sensor is not None:
                    noise = None if params is None else {name: field[..., rows, :] for name, field in params.items()}
                    seen = self.sensor(seen, params=noise, generator=generator, origin=(rows.start, 0))
                seen = encode(seen, self.color_space).to(dtype)
                coded = seen if strip.rows is None else placed(coded, seen, rows, self.height(sample))
            return sample.coded(cast("Tensor", coded))

    def blurred(self, strip: Strip) -> Tensor:
        """Return the irradiance on the sensor over the whole exposure, (B, C, h, w): a sum over pieces of the PSFs.

        Args:
            strip: of a picture.
        """
        if len(set(strip.fields)) > 1:
            return torch.cat([self.blurred(image) for image in strip.images()])
        light, defocus, fidelity = strip.light, strip.defocus, self.psf_model.fidelity
        given = self.compositing, self.memory_budget, defocus, light.device
        field = strip.fields[0] if strip.fields else None
        pieces = pieces_of(self.psf_model, light.shape[1], light.dtype, strip.reach, *given, field)
        layers = "nearest" if fidelity.layers == "nearest" else "linear"
        rendering = Rendering(self.compositing, strip.border, layers, fidelity.correlate)
        return reduce(add, (render_piece(light, defocus, piece, rendering) for piece in pieces))

    def strips(self, sample: Sample) -> Iterator[Strip]:
        """Yield the strips that a picture is taken in: ordinarily one, which is all of it.

        Args:
            sample: image and depth, see :func:`kornia_tidy.camera.samples.read_sample`.
        """
        size = sample.image.shape[-2], sample.image.shape[-1]
        alike = self.lens is None and self.psf_model.measured is None  # PSFs all over the picture
        centers = () if alike else sample.centers or (self.field_center,)
        found = [self.psf_model.field_of(size, center) for center in centers]
        fields = tuple(field for field in found if field is not None)
        rows = self._rows_at_once(sample) if sample.bytes_at_once > self.memory_budget // 2 else None
        if rows is None:
            image, depth = sample.image.to(sample.dtype), sample.depth.to(sample.dtype)
            unread = Mode.UNREAD in torch_mode()
            light = decode(image, self.color_space)
            defocus = self.psf_model.camera.defocus(depth, self.check_inputs and not unread)
            reach = (
                defocus_extremes_in_one_read(image, depth, defocus, self)
                if unread
                else defocus_extremes([defocus], self, depth)
            )
            yield Strip(light, defocus, reach, self.border, fields=fields)
            return
        check_border(self.border, *size, self.window)
        if sample.image.device.type != "cpu":
            check_light(sample.image, self)
        parts = sample.depth.split(rows, dim=-2)
        to_defocus = partial(self.psf_model.camera.defocus, check_inputs=self.check_inputs)
        reach = defocus_extremes((to_defocus(part.to(sample.dtype)) for part in parts), self, sample.depth)
        given = rows, self.height(sample), self.window // 2, self.border, fields
        for own, image, depth, places in strips_of(sample, *given):
            yield Strip(decode(image, self.color_space), to_defocus(depth), reach, "valid", own, places)

    def irradiance(self, sample: Sample, views: Sequence[TiDyOptics]) -> list[Tensor]:
        """Return the irradiance of a scene on the sensor, (B, C, h, w), through each of some views of this camera.

        Args:
            sample: image and depth, see :func:`kornia_tidy.camera.samples.read_sample`.
            views: of its moments, such as :meth:`through_moment` gives.
        """
        found: list[Any] = [None] * len(views)
        device = sample.image.device
        with (
            torch.autocast(device.type, enabled=False),
            nullcontext() if device.type == "cpu" else values_unread(device),
        ):
            for strip in views[0].strips(sample):  # a moment of one mask may take more nodes over the field than all
                for n, view in enumerate(views):
                    part = view.blurred(strip)
                    found[n] = part if strip.rows is None else placed(found[n], part, strip.rows, self.height(sample))
        return found

    def height(self, sample: Sample) -> int:
        """Return how many rows a capture has."""
        return sample.image.shape[-2] - (self.window - 1 if self.border == "valid" else 0)

    def _rows_at_once(self, sample: Sample) -> int | None:
        """Return how many rows fit half of the memory allowed; None where the whole image is needed at once."""
        image, depth = sample.image, sample.depth
        learning = torch.is_grad_enabled() and (
            image.requires_grad or depth.requires_grad or any(p.requires_grad for p in self.parameters())
        )
        spread = self.fidelity.stray_light == "veil"
        # Beyond a zero border there is nothing that hides, which black pixels would.
        unseen = self.compositing == "occlusion" and self.border == "zero"
        if learning or torch_mode() & Mode.TRACED or spread or unseen or not len(image):
            return None
        return rows_at_once(sample, self.memory_budget // 2)  # the other half is for PSFs

    def _replace(self, **attributes: Any) -> Self:
        """Return a camera with other attributes. Parts, notes and remembered PSFs are shared."""
        other = object.__new__(type(self))
        modules, parameters, buffers = dict(self._modules), dict(self._parameters), dict(self._buffers)
        vars(other).update(vars(self), _modules=modules, _parameters=parameters, _buffers=buffers, **attributes)
        return other

    def decode(self, image: Tensor) -> Tensor:
        """Return linear light from an image (B, C, H, W) in the camera's colour space."""
        return decode(image, self.color_space)

    def encode(self, light: Tensor) -> Tensor:
        """Return an image in the camera's colour space from linear light (B, C, H, W)."""
        return encode(light, self.color_space)

    def draw(self, image: Tensor, generator: torch.Generator | None = None) -> dict[str, Tensor]:
        """Draw the noise of one capture of an image like this one, for ``params=``.

        Args:
            image: (B, C, H, W) or (C, H, W).
            generator: source of the noise. Default: the global generator.
        """
        if self.sensor is None:
            return {}
        height, width = cropped(image, self.window // 2 if self.border == "valid" else 0).shape[-2:]
        shape = (*(image.shape[:2] if image.ndim == 4 else (1, image.shape[0])), height, width)
        dtype = compute_dtype(image.dtype, self.fidelity, image.device)
        return cast("Sensor", self.sensor).draw(shape, device=image.device, dtype=dtype, generator=generator)

    # ------------------------------------------------------------------ how exactly to compute

    @torch.no_grad()
    def plan(self, depth: Tensor, image: Tensor | None = None, tolerance: float = 1e-3) -> RenderPlan:
        """Return the cheapest way to capture a scene within an error. See :mod:`kornia_tidy.accuracy.planning.planner`.

        Args:
            depth: (B, 1, H, W) or (1, H, W), as for a capture.
            image: (B, C, H, W) or (C, H, W). Default: photographs as they usually are, of the spectrum's channels.
            tolerance: root mean square error of the noise-free linear capture against ``reference``, full scale 1.

        Returns:
            A plan for the present masks; its ``fidelity`` is for :meth:`with_fidelity`.

        Raises:
            ValueError: if the batch holds no image, or as for a capture.

        Example:
            >>> from kornia_tidy import PixelwiseMask
            >>> optics = TiDyOptics(PixelwiseMask(1, initial="flat"))
            >>> plan = optics.plan(torch.full((1, 96, 96), 0.9), tolerance=1e-2)
            >>> plan.predicted_error <= 1e-2
            True
        """
        from kornia_tidy.accuracy.planning.plan import plan_scene  # noqa: PLC0415 (a capture without a plan does not need it)

        shape = (len(self.spectrum.weights), *depth.shape[-2:])
        blank = depth.new_zeros(()).expand(*depth.shape[:-3], *shape) if image is None else image
        sample = read_sample(blank, depth, self)
        if len(sample.image) == 0 or len(sample.depth) == 0:
            found = f"{len(sample.image)} and {len(sample.depth)}"
            raise ValueError(f"a plan needs at least one image and its depth, got {found}")
        light = None if image is None else self.decode(sample.image.to(sample.dtype))
        metres = sample.depth.to(compute_dtype(depth.dtype, self.fidelity, depth.device))
        defocus = check_defocus(metres, self)
        return plan_scene(self, defocus, light, (len(sample.image), sample.image.shape[1]), tolerance)

    @torch.no_grad()
    def explain(self, image: Tensor, depth: Tensor) -> Explanation:
        """Return which backend renders a scene, of several pieces the first, with operations and memory of each.

        PSFs that vary over the picture are those of its place; of a batch with several places, of the first image's.

        Args:
            image: (B, C, H, W) or (C, H, W), as for a capture.
            depth: its depth.

        Raises:
            ValueError: if the batch holds no image, or as for a capture.

        Example:
            >>> print(TiDyOptics(compositing="scatter").explain(torch.rand(3, 64, 64), torch.ones(1, 64, 64)))
            scatter of 1 x 3 channels of 64x64 px, ...
              dense: ... operations, ... MiB
            ...
        """
        sample = read_sample(image, depth, self)
        if len(sample.image) == 0:
            raise ValueError("an explanation needs at least one image, got a batch of none")
        light = self.decode(sample.image.to(sample.dtype))
        defocus = self.camera.defocus(sample.depth.to(sample.dtype), self.check_inputs)
        reach, (batch, channels, height, width) = defocus_extremes([defocus], self, sample.depth), light.shape
        center = sample.centers[0] if sample.centers else self.field_center
        field = self.psf_model.field_of((height, width), center)
        given = self.compositing, self.memory_budget, defocus, light.device, field
        pieces = list(pieces_of(self.psf_model, channels, sample.dtype, reach, *given))
        if pieces[0].window is not None:
            if self.border == "valid":
                check_border(self.border, height, width, pieces[0].window)
            held = held_nodes(cast("WideBlur", self.psf_model.wide_blur), defocus)
            groups = ", ".join(f"{len(nodes)} on grids of {group.grid} px" for group, nodes in held)
            words = f"gather of {batch} x {channels} channels of {height}x{width} px, layers of wide blur: {groups}"
            return Explanation(words, "grids", {}, {})
        bank, fidelity = pieces[0].bank(), self.psf_model.fidelity
        light = light.repeat(1, bank.psfs.shape[-3] // channels, 1, 1)
        how = self.compositing, "nearest" if fidelity.layers == "nearest" else "linear", self.border, fidelity.correlate
        psfs, spread = bank.psfs, None if field is not None else bank.veil  # over a field it is added afterwards
        if field is not None and field.nodes == (1, 1) and self.compositing != "occlusion":
            field, psfs = None, psfs[0]
        found = explain(layered_scene(light, defocus, bank.defocus, psfs, spread, *how, field))
        return found if len(pieces) == 1 else replace(found, scene=f"{found.scene}, the first of {len(pieces)} pieces")

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
        return parameter_groups(self, self.masks, lr_metres, lr)

    def as_transform(self, seed: int | None = None, key: Any = "index", **entries: Any) -> DatasetTransform:
        """Return the camera as a transform of single samples, without gradients. See :class:`DatasetTransform`."""
        return DatasetTransform(self, seed, key, **entries)

    @property
    def clamped_pixels(self) -> int:
        """Pixels of the last capture whose defocus lay outside the camera's range and was clamped to its end.

        Of a burst, those of one shot; of a moving scene, those of all its moments. A capture by a view of this camera,
        such as ``with_fidelity`` returns, or in another thread also counts.
        """
        return int(self.notes.clamped)

    def check_scene(self, image: Tensor, depth: Tensor) -> None:
        """Check the values of an image and its depth as a capture does, and warn of other units."""
        sample = read_sample(image, depth, self)
        check_defocus(sample.depth.to(sample.dtype), self)

    def extra_repr(self) -> str:
        """Describe the camera in a person's words."""
        settings, held = self.fidelity, self.light_held
        return (
            f"fidelity {settings.name!r}: {len(self.defocus_nodes)} {settings.layers} layers of defocus, PSF window "
            f"{self.window}x{self.window} px holding {held[0]:.0%} to {held[1]:.0%} of the light "
            f"({settings.stray_light} the rest); {self.compositing}, {self.border} border, {self.color_space} colour"
            f"{', holes of depth filled' if self.holes == 'fill' else ''}"
        )

    # ------------------------------------------------------------------ state

    def settings(self) -> dict[str, Any]:
        """Return what shapes a capture besides the weights, by the names of the parts."""
        return {**self.psf_model.settings(), **{name: settings_of(getattr(self, name)) for name in OWN_SETTINGS}}

    def _take_over(self, saved: Mapping[str, Any]) -> None:
        for name, allowed in (("compositing", COMPOSITING), ("color_space", COLOR_SPACES), ("border", BORDERS)):
            if name in saved:
                check_choice(name, saved[name], tuple(allowed))
        fidelity = saved.get("fidelity")
        if isinstance(fidelity, dict):
            preset = PRESETS.get(str(fidelity.get("name")).removesuffix(", changed"), Fidelity())
            later = {name: getattr(preset, name) for name in ("wide_blur", "field_tolerance")}
            own = {**later, **fidelity, "window": saved.get("fixed_window")}
            saved = {**saved, "fidelity": own}
        take_over(self, saved, self.settings(), {name: name for name in (*PARTS, "aperture", *OWN_SETTINGS)})
        self.psf_model = self.psf_model.with_window(None)
        self.psf_model.check_layers()

    def get_extra_state(self) -> Tensor:
        """Return settings and window, uint8."""
        window, fixed = self.psf_model.fitted, self.fidelity.window
        return write_settings(
            {**self.settings(), "window": window.side, "light_held": window.held, "fixed_window": fixed}
        )

    def set_extra_state(self, state: Tensor) -> None:
        """Take the window of a saved camera that has these settings.

        Raises:
            ValueError: if the saved camera is another one, or its settings are damaged.
        """
        saved = read_settings(state)
        check_settings(saved, self.settings())
        window, held = saved.get("window"), saved.get("light_held")
        if type(window) is not int or window < 1 or window % 2 == 0:
            raise ValueError(f"the window in the state must be an odd number of pixels, got {window}")
        if not isinstance(held, list) or [type(share) for share in held] != [float, float]:
            raise ValueError(f"light_held in the state must be two shares of the light, got {held}")
        self.psf_model = self.psf_model.with_window(FittedWindow(window, (held[0], held[1])))

    def load_state_dict(
        self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False, *, take_over: bool = False
    ) -> Any:
        """Load a camera: weights, and the window where the state has it.

        The settings of its parts and its PSF window are one entry, ``_extra_state``, a tensor of bytes. A state

        - of the same camera restores weights and window: every capture is the same to the last bit;
        - of another camera is refused, also with ``strict=False``, before any weight of this camera is changed; the
          first difference is named. ``take_over=True`` sets this camera's settings to the saved ones first;
        - without that entry, such as masks alone, loads the weights and measures the window anew for them;
        - without weights of this camera does not change it.

        The entry is never counted among the missing keys, so that masks alone and files of earlier versions load with
        ``strict=True``. In a larger module's state it stands under the camera's prefix, and ``load_state_dict`` of that
        module obeys the same rules. To take settings over there, load the camera's part of the state into the camera
        first.

        Args:
            state_dict: result of ``state_dict()``, or only weights.
            strict: refuse missing and unknown weights.
            assign: as in PyTorch.
            take_over: set the settings of this camera's parts to those in the state first, where they differ. Parts of
                another class are not made: they are refused. After any error nothing is changed.

        Returns:
            The missing and the unknown keys, as in PyTorch.

        Raises:
            ValueError: if the state is that of another camera, or it has no settings to take over.
            RuntimeError: if weights do not fit, as in PyTorch.

        Example:
            >>> from kornia_tidy import PixelwiseMask, ThinLensCamera, TiDyOptics
            >>> saved = TiDyOptics(PixelwiseMask(2), ThinLensCamera(pixel_pitch=9e-6)).state_dict()
            >>> optics = TiDyOptics(PixelwiseMask(2))
            >>> optics.load_state_dict(saved, take_over=True), optics.camera.pixel_pitch
            (<All keys matched successfully>, 9e-06)
        """
        if take_over:
            saved, rehearsal = checked_settings(state_dict, self.settings()), copy.deepcopy(self)
            for camera in (rehearsal, self):  # so that an error changes nothing
                camera._take_over(saved)
                keys = nn.Module.load_state_dict(camera, state_dict, strict, assign)
            return keys
        return super().load_state_dict(state_dict, strict, assign)

    def _load_from_state_dict(
        self,
        state_dict: Mapping[str, Any],
        prefix: str,
        local_metadata: Any,
        strict: bool,
        missing_keys: list[str],
        unexpected_keys: list[str],
        error_msgs: list[str],
    ) -> None:
        key = prefix + EXTRA_STATE
        own = (prefix + name for name, _ in chain(self.named_parameters(), self.named_buffers()))
        weights = {name: state_dict[name] for name in own if isinstance(state_dict.get(name), Tensor)}
        for name, value in weights.items():
            check_finite(f"{name} in the state", value)
        if key not in state_dict and weights:
            self.psf_model = self.psf_model.with_window(None)  # measured when the weights are there
        super()._load_from_state_dict(
            state_dict, prefix, local_metadata, strict, missing_keys, unexpected_keys, error_msgs
        )
        if key in missing_keys:  # masks alone are a state too, and that of versions which did not save settings
            missing_keys.remove(key)


def _measure_window(camera: TiDyOptics, _: Any) -> None:
    _ = camera.psf_model.fitted
