"""Samples: an image and its depth as tensors, a tuple or a mapping; checks of their values and of their defocus."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any, Protocol

import torch
from torch import Tensor, nn
from torch.utils.data import get_worker_info

from kornia_tidy.camera.holes import DEPTH_KEYS, fills_holes, names_in, with_filled, with_parts
from kornia_tidy.checks import check_finite, check_float_tensor, check_generator
from kornia_tidy.fidelity import Fidelity
from kornia_tidy.kernels.precision import widest
from kornia_tidy.mode import Mode, refuse_torchscript, torch_mode
from kornia_tidy.optics.holes import fill_holes
from kornia_tidy.optics.misread_depth import misread_depth
from kornia_tidy.optics.thin_lens import DefocusRange
from kornia_tidy.optics.units import OTHER_FOCUS, SAME_FOCUS, check_depth_fits, check_image, layout_remedy, warn_once
from kornia_tidy.psf.field import check_centers
from kornia_tidy.psf.psf_model import PSFModel
from kornia_tidy.render.borders import cropped

# Peak memory of a capture in float32 beyond image and capture: for tiles, and for each value of the image.
BYTES_OF_TILES, BYTES_A_VALUE = 24 << 20, 40
ROUNDING = 5e-4  # radians beyond the camera's range that are not counted as beyond
DEPTH_UNIT, _RANGE = "unit of depth", "depths beyond the camera's range"  # keys of warnings


@dataclass(eq=False)
class Notes:
    """Warnings that a camera has given, and clamped pixels of its last capture. Views of the camera share them.

    Args:
        told: keys of the warnings that were given.
        clamped: number of pixels of the last capture beyond the range of defocus.
    """

    told: set[Hashable] = field(default_factory=set)
    clamped: Tensor | int = 0


class CheckedCamera(Protocol):
    """A camera that checks its inputs and warns once."""

    psf_model: PSFModel
    check_inputs: bool
    holes: str
    color_space: str
    notes: Notes
    fixed_defocus: tuple[float, float] | None


@dataclass(frozen=True, eq=False)
class Sample:
    """An image and its depth, batched, and the form in which they came.

    Args:
        image: (B, C, H, W).
        depth: (B, 1, H, W) or (1, 1, H, W).
        form: the mapping or tuple that was given, None for tensors.
        batched: whether image and depth came with the axis of batches.
        dtype: that the capture is computed in, float32 or float64.
        bytes_at_once: about as many as a capture of the whole image takes beyond image and capture.
        centers: where the middles of the pictures lie from the lens's axis: one, one for each image, or none.
    """

    image: Tensor
    depth: Tensor
    form: Mapping[str, Any] | tuple[Any, ...] | list[Any] | None
    batched: bool
    dtype: torch.dtype
    bytes_at_once: int
    centers: tuple[tuple[float, float], ...] = ()

    def coded(self, coded: Tensor) -> Any:
        """Return the capture in the sample's form.

        Args:
            coded: the capture, (B, C, H, W), or smaller: then depth, mask and clean image are cropped to its middle.

        Returns:
            A tensor, the tuple with the capture in the place of the image, or the mapping with the capture under
            ``"image"`` and the clean image under ``"all_in_focus"``. Detached inside a DataLoader's worker.
        """
        if not torch.compiler.is_compiling() and get_worker_info() is not None:
            coded = coded.detach()  # collation in a worker cannot carry gradients
        margin = (self.image.shape[-2] - coded.shape[-2]) // 2
        if not self.batched:
            coded = coded[0]
        if self.form is None:
            return coded
        return with_capture(self.form, coded, margin)


def with_capture(
    sample: Any,
    coded: Any,
    margin: int,
    names: Sequence[str] = ("image", *DEPTH_KEYS),
    crop: Callable[[Any, int], Any] = cropped,
) -> Any:
    """Return a sample with its capture in the place of the image, and its maps cropped to the size of the capture.

    Args:
        sample: a mapping, which gets the clean image under ``"all_in_focus"``; or a tuple or list
            ``(image, depth, ...)``. A mask of valid pixels is an entry or a field of a named tuple.
        coded: the capture.
        margin: pixels that it lacks on each side.
        names: of the image, and the possible ones of the depth in a mapping.
        crop: crops a map or an image.

    Example:
        >>> with_capture((torch.zeros(1, 4, 4), torch.ones(1, 4, 4)), torch.ones(1, 2, 2), 1)[1].shape
        torch.Size([1, 2, 2])
    """
    named = isinstance(sample, Mapping)
    valid = sample.get("valid") if named else getattr(sample, "valid", None)
    if len(getattr(valid, "shape", ())) < 2:  # no map
        valid = None
    if named:
        maps = {name: sample[name] for name in (*names[1:], "mask") if name in sample}
        maps |= {} if valid is None else {"valid": valid}
        smaller = {name: crop(value, margin) for name, value in maps.items()} if margin else {}
        return {**sample, names[0]: coded, "all_in_focus": crop(sample[names[0]], margin), **smaller}
    return with_parts(sample, coded, crop(sample[1], margin), None if valid is None else crop(valid, margin))


def read_sample(
    image: Any,
    depth: Any,
    camera: CheckedCamera,
    generator: object = None,
    *,
    deferred: bool = False,
    field_center: Any = None,
) -> Sample:
    """Return a sample given as tensors, a tuple or a mapping, with its types, shapes and light checked.

    Args:
        image: the image, or a whole sample.
        depth: the depth map, if ``image`` is a tensor.
        camera: defines the input.
        generator: source of the noise, to be checked before any work.
        deferred: leave the light on an accelerator to :func:`defocus_extremes_in_one_read`.
        field_center: where the middle of each picture lies. Default: the mapping's entry of this name, if it has one.

    Raises:
        TypeError: if image or depth are not floating-point tensors, or the generator is of another type.
        ValueError: if shapes or devices do not fit, the depth is missing, the light is not finite, or a depth map to be
            filled consists of holes.
        KeyError: if a mapping has no image or no depth.
    """
    form: Any = image if isinstance(image, (Mapping, tuple, list)) else None
    if form is not None and depth is not None:
        raise ValueError("a mapping or a tuple holds its depth: call optics(sample) without another depth")
    if isinstance(form, Mapping):
        field_center = form.get("field_center") if field_center is None else field_center
        image, depth = (form[name] for name in names_in(form))
    elif form is not None:
        missing: list[Any] = [None, None]
        image, depth = [*form, *missing][:2]
    if torch.jit.is_tracing():
        refuse_torchscript()
    if generator is not None:
        check_generator(generator)
    if depth is None:
        raise ValueError("depth is missing: call optics(image, depth), optics((image, depth)) or optics(mapping)")
    batched = not isinstance(image, Tensor) or image.ndim != 3
    check_float_tensor("image", image, 4 if batched else 3, "(B, C, H, W) or (C, H, W)")
    check_float_tensor("depth", depth, image.ndim, "(B, 1, H, W) or (1, H, W), as the image is batched or not")
    model, given = camera.psf_model, tuple(image.shape)
    home = next(chain(model.masks.parameters(), model.masks.buffers()), image).device
    if not image.device == depth.device == home:
        raise ValueError(
            f"image and depth must be on the camera's device, {home}, got {image.device} and {depth.device}: move "
            f"them, or the camera with optics.to(...)"
        )
    image, depth = (image, depth) if batched else (image[None], depth[None])
    channels = len(model.spectrum.weights)
    if image.shape[1] not in (channels, 1):
        model.spectrum_of(image.shape[1], layout_remedy(given, channels))  # raises
    if 0 in image.shape[-2:]:
        raise ValueError(f"image must hold at least one pixel, got shape {tuple(image.shape)}")
    if depth.shape[1:] != (1, *image.shape[-2:]) or len(depth) not in (1, len(image)):
        check_depth_fits(depth, image)  # raises
    at_once = image.device.type == "cpu" or not deferred
    if camera.check_inputs and at_once and Mode.GRAPH not in torch_mode() and image.numel():
        lowest, highest = torch.aminmax(image.detach())
        if not bool((lowest >= 0) & (highest <= 1)):  # NaN too
            check_light(image, camera)
    wide = model.fidelity.double or image.dtype == torch.float64
    dtype = widest(image.device) if wide else torch.float32
    bytes_at_once = BYTES_OF_TILES + BYTES_A_VALUE * image.numel() * dtype.itemsize // 4
    centers = () if field_center is None else check_centers(field_center, len(image))
    sample = Sample(image, depth, form, batched, dtype, bytes_at_once, centers)
    return filled_sample(sample) if camera.holes == "fill" and fills_holes(camera) else sample


def filled_sample(sample: Sample) -> Sample:
    """Return a sample with a depth without holes, and with that depth and the mask of known pixels in its form."""
    depth, valid = fill_holes(sample.depth)
    if sample.form is None:
        return replace(sample, depth=depth)
    parts = (depth, valid) if sample.batched else (depth[0], valid[0])
    return replace(sample, depth=depth, form=with_filled(sample.form, *parts))


def compute_dtype(dtype: torch.dtype, fidelity: Fidelity, device: torch.device) -> torch.dtype:
    """Return the type that images of a type are computed in: float64 where either asks for it and the device has it."""
    wide = fidelity.double or dtype == torch.float64
    return widest(device) if wide else torch.float32


def check_light(image: Tensor, camera: CheckedCamera) -> None:
    """Raise an error for an image that is not light, and warn once of one that seems to be in another unit.

    Args:
        image: of any shape, in the camera's colour space.
        camera: whether it checks its inputs, and its white level.

    Raises:
        ValueError: if a value is NaN or infinite, an sRGB value is above 16, or light beyond 1e30.
    """
    if camera.check_inputs and Mode.GRAPH not in torch_mode():
        said = check_image(image, encoded=camera.color_space != "linear")
        if said is not None:
            warn_once(camera.notes.told, "image", said, stacklevel=7)


def defocus_extremes(parts: Iterable[Tensor], camera: CheckedCamera, depth: Tensor) -> Tensor:
    """Return how far the defocus of a scene reaches; note and, once, tell of pixels beyond the camera's range.

    Args:
        parts: of the defocus map, in radians.
        camera: its range of defocus.
        depth: of the scene, for a warning.

    Returns:
        Lowest and highest defocus in radians, (2,); the map itself where it is learnt or cannot be looked at; the range
        of the camera's fixed layers where it has such.
    """
    fixed = camera.fixed_defocus
    lo, hi = camera.psf_model.camera.defocus_range
    extremes, pixels, clamped, reach = torch.zeros(2), 0, 0, None
    for defocus in parts:
        if Mode.GRAPH in torch_mode():
            return defocus if fixed is None else torch.tensor(fixed, requires_grad=defocus.requires_grad)
        own = defocus.detach()
        if not own.numel():
            continue
        if defocus.requires_grad or Mode.TRANSFORM in torch_mode():
            reach = defocus
        lowest, highest = torch.aminmax(own)
        if not bool((lowest >= lo - ROUNDING) & (highest <= hi + ROUNDING)):
            clamped = clamped + ((own < lo - ROUNDING) | (own > hi + ROUNDING)).sum()
        if pixels:
            lowest, highest = torch.minimum(lowest, extremes[0]), torch.maximum(highest, extremes[1])
        extremes = torch.stack([lowest, highest])
        pixels += own.numel()
    camera.notes.clamped = clamped
    farthest = lo + max(SAME_FOCUS, -lo / OTHER_FOCUS)  # as far out of focus as infinity
    if camera.check_inputs and pixels and (isinstance(clamped, Tensor) or float(extremes[1]) <= farthest):
        warn_of_defocus(depth, camera, extremes, int(clamped))
    if fixed is not None:
        return torch.tensor(fixed, requires_grad=reach is not None and reach.requires_grad)
    return extremes if reach is None else reach


def defocus_extremes_in_one_read(image: Tensor, depth: Tensor, defocus: Tensor, camera: CheckedCamera) -> Tensor:
    """Return how far the defocus of a scene on an accelerator reaches, and check the scene and the masks.

    The host waits for an accelerator once, for the extremes of image, depth, defocus and masks together, and not at all
    where the camera has fixed layers. Where a check finds something it waits again, to say what.

    Args:
        image: of the scene, (B, C, H, W).
        depth: of the scene.
        defocus: of the scene in radians.
        camera: at one moment.

    Returns:
        Lowest and highest defocus in radians, (2,), as far as PSFs are needed for it.
    """
    fixed, lens = camera.fixed_defocus, camera.psf_model.camera
    own, (lo, hi) = defocus.detach(), lens.defocus_range
    camera.notes.clamped = ((own < lo - ROUNDING) | (own > hi + ROUNDING)).sum() if own.numel() else 0
    if fixed is not None or not own.numel():
        return torch.tensor(fixed or (lo, hi), requires_grad=defocus.requires_grad)
    states, weights = camera.psf_model.states(own.dtype)
    learnt = camera.psf_model.aperture
    aperture = list(learnt.parameters()) if isinstance(learnt, nn.Module) else []
    looked_at = image, depth, own, states, weights, *aperture
    pairs = [torch.aminmax(x.detach()) for x in looked_at if x.numel()]
    numbers = torch.stack([end.to(own.dtype) for pair in pairs for end in pair]).tolist()
    (dark, bright), (near, far), reach, *rest = zip(numbers[::2], numbers[1::2], strict=True)
    if not all(map(math.isfinite, (x for pair in rest for x in pair))):
        check_finite("the phase of the masks", states)
        check_finite("the weights of the modulator", weights)
        for amplitude in aperture:
            check_finite("the aperture", amplitude)
    if camera.check_inputs:
        if not (dark >= 0 and bright <= 1):  # NaN too
            check_light(image, camera)
        if not (near > 0 and (far <= 1 or not isinstance(lens, DefocusRange))):
            lens.defocus(depth)
        beyond = reach[0] < lo - ROUNDING or reach[1] > hi + ROUNDING
        if beyond or reach[1] <= lo + max(SAME_FOCUS, -lo / OTHER_FOCUS):
            warn_of_defocus(depth, camera, torch.tensor(reach), int(camera.notes.clamped) if beyond else 0)
    return torch.tensor(reach, requires_grad=defocus.requires_grad)


def check_defocus(depth: Tensor, camera: CheckedCamera) -> Tensor:
    """Return the defocus of a depth map in radians; warn once of a map in another unit."""
    defocus = camera.psf_model.camera.defocus(depth, camera.check_inputs)
    if camera.check_inputs and defocus.numel() and Mode.GRAPH not in torch_mode():
        warn_of_defocus(depth, camera)
    return defocus


def warn_of_defocus(depth: Tensor, camera: CheckedCamera, extremes: Tensor | None = None, clamped: int = 0) -> None:
    """Warn once of depths in another unit, or else of those beyond the camera's range.

    Args:
        depth: of the scene.
        camera: its range of defocus, and its earlier warnings.
        extremes: lowest and highest defocus in radians, (2,); None: not looked at.
        clamped: number of pixels beyond the range.
    """
    lens, told = camera.psf_model.camera, camera.notes.told
    lo, hi = lens.defocus_range
    lowest, highest = (math.inf, -math.inf) if extremes is None else extremes.tolist()
    if DEPTH_UNIT not in told and (not clamped or lowest > hi or highest < lo):
        said = misread_depth(lens, *(float(end) for end in torch.aminmax(depth.detach())))
        if said is not None:
            warn_once(told, DEPTH_UNIT, said, stacklevel=8)
            told.add(_RANGE)  # which such depths are beyond
    if clamped:
        warn_once(
            told,
            _RANGE,
            f"{clamped} of {depth.numel()} pixels have a defocus between {lowest:+.2f} and {highest:+.2f} rad, beyond "
            f"the camera's range {lo:+.2f} to {hi:+.2f}: they are rendered as its ends (see "
            f"ThinLensCamera.for_scene, or its depth_range)",
            stacklevel=8,
        )
