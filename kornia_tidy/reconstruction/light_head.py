"""Trained systems on real captures: from linear light to an sRGB image and depth in metres."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import torch
from kornia.color import linear_rgb_to_rgb
from torch import Tensor, nn

from kornia_tidy.checks import check_float_tensor, check_positive
from kornia_tidy.optics.thin_lens import ThinLensCamera
from kornia_tidy.psf.field_bank import FieldBank
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.psf.psf_model import PSFModel
from kornia_tidy.reconstruction.capture_checks import MeasuredNoise, check_capture, least_softness
from kornia_tidy.reconstruction.closed_form import NODES, ClosedForm
from kornia_tidy.reconstruction.depth_distribution import depth_moments
from kornia_tidy.reconstruction.head import takes_noise
from kornia_tidy.reconstruction.head_names import CLOSED_FORMS
from kornia_tidy.reconstruction.receptive_field import receptive_field
from kornia_tidy.reconstruction.restored_over_field import restored_over_field
from kornia_tidy.reconstruction.ruled_closed_form import RuledClosedForm
from kornia_tidy.reconstruction.self_ensemble import self_ensemble
from kornia_tidy.reconstruction.tasks import MAPS, depth_logits, deviation_in_metres, metres, split_maps
from kornia_tidy.reconstruction.tiled import OVERLAP, check_seamless, one_tile, reconstruct_tiled, shared_copy
from kornia_tidy.reconstruction.trained import TrainedSystem
from kornia_tidy.reconstruction.whole_picture import whole_picture
from kornia_tidy.sensor.sensor import SensorNoise

MOST_LIGHT = 16.0  # of full scale; more is another unit
FIELD_TILE = 384  # px, within which the PSFs of its middle serve; each tile costs a computation of kernels


class Reconstruction(NamedTuple):
    """Image and depth that a system reconstructs from a capture; None for a map that it was not trained for."""

    image: Tensor | None
    """All-in-focus image, (3, H, W) in [0, 1], encoded as sRGB."""
    depth: Tensor | None
    """Depth in metres, (1, H, W); may be infinite."""
    notes: tuple[str, ...] = ()
    """What was repaired in the capture, and what contradicts what is told of it, each with its remedy."""


class UncertainReconstruction(NamedTuple):
    """A :class:`Reconstruction` by a system that estimates how uncertain its depth is."""

    image: Tensor
    """As in :class:`Reconstruction`."""
    depth: Tensor
    """As in :class:`Reconstruction`."""
    deviation: Tensor
    """Standard deviation of the depth in metres, (1, H, W); infinite where the depth may be infinite, see
    :func:`~kornia_tidy.reconstruction.tasks.deviation_in_metres`."""
    relative_deviation: Tensor
    """The same in parts of the range, of normalised inverse depth: 0.29 where nothing is known."""
    notes: tuple[str, ...] = ()
    """As in :class:`Reconstruction`."""


class LightHead(nn.Module):
    """The network of a trained system with linear light as input, converted to the colour space of its training.

    These are the camera's colours: sRGB-encoded captures for ``"srgb"``, linear light for ``"linear"``, and also for
    ``"paper"``, since its simulated sensor takes encoded values for light.

    Args:
        system: camera and network, see :func:`~kornia_tidy.reconstruction.trained.load_trained`.
        noise: standard deviation of the captures' noise in linear light, in units of full scale, for a network that is
            conditioned on it. None: as the sensor of the system has it.
        orientations: over which the network is averaged, see :func:`~kornia_tidy.reconstruction.self_ensemble`.

    Shape:
        - light: (B, 3, H, W) or (B, 1, H, W), linear; black is 0 and saturation 1; other values are clipped.
        - output: the maps of the task, in the order of :data:`~kornia_tidy.reconstruction.tasks.MAPS`: the image
          encoded as sRGB, depth as normalised inverse depth; then its standard deviation, if the network is
          ``uncertain``.

    Raises:
        TypeError: if the network estimates depth and the camera has no metric scale.
        ValueError: if a noise is given that is not positive, or the network is not conditioned on it; for orientations
            that are not offered, or a network that knows PSFs in one orientation.
    """

    def __init__(self, system: TrainedSystem, noise: float | None = None, orientations: int = 1) -> None:
        super().__init__()
        if noise is not None:
            check_positive("noise", noise, "in units of full scale")
            if not takes_noise(system.head):
                raise ValueError("noise is for a network that is conditioned on it, and this one is not")
        if "depth" in MAPS[system.settings.task] and not isinstance(system.optics.camera, ThinLensCamera):
            raise TypeError(f"depth in metres needs a ThinLensCamera, got {type(system.optics.camera).__name__}")
        self.head = system.head if orientations == 1 else self_ensemble(system.head, orientations)
        self.noise = noise
        self.task = system.settings.task
        self.camera = cast("ThinLensCamera", system.optics.camera)  # another one where no depth is estimated
        self.encoded = system.optics.color_space == "srgb"
        self.uncertain = system.settings.depth_classes > 0
        model, behind = system.optics.psf_model, system.settings.head in CLOSED_FORMS
        if isinstance(model.measured, FieldBank):
            model = model.with_bank(model.measured.with_channels(3))
        self.field = (model, system.optics.field_center) if behind and model.varies else None  # no part of the head
        self.eval()

    def forward(self, light: Tensor) -> tuple[Tensor, ...]:
        """Return the maps."""
        light = light.clamp(0, 1).expand(-1, 3, -1, -1)
        capture = linear_rgb_to_rgb(light) if self.encoded else light
        output = self.head(capture) if self.noise is None else self.head(capture, noise=self.noise)
        maps = split_maps(self.task, output)
        if "image" in maps and not self.encoded:
            maps["image"] = linear_rgb_to_rgb(maps["image"].clamp(0, 1))
        if (logits := depth_logits(self.task, output)) is not None:
            return (*maps.values(), depth_moments(logits)[1])
        return tuple(maps.values())


def with_noise_of(head: LightHead, sensor: SensorNoise | None) -> LightHead:
    """Return a copy of a head that takes its captures' noise for that of a sensor, in each pixel by its light.

    The copy shares the weights, so that several threads may each have their own.

    Args:
        head: a network. One that is not conditioned on the noise takes no notice of it.
        sensor: with a standard deviation in units of the captures' full scale. None: the noise does not change.
    """
    copied = cast("LightHead", shared_copy(head))
    copied.field = head.field  # PSFs that it remembers serve all captures
    for module in copied.modules():
        if isinstance(module, ClosedForm) and sensor is not None:
            module.set_noise(sensor)
    return copied


@torch.no_grad()
def reconstruct_light(
    head: LightHead,
    light: Tensor,
    *,
    memory_budget: int = 512 << 20,
    overlap: int | None = OVERLAP,
    progress: Callable[[int, int], object] | None = None,
) -> Reconstruction | UncertainReconstruction:
    """Reconstruct image and depth from a capture of any size, and the uncertainty of depth if the network tells it.

    Args:
        head: a trained network.
        light: (3, H, W) or (1, H, W), linear light of the camera that the network was trained for, in the orientation
            of the sensor and of the PSFs; black is 0, saturation 1.
        memory_budget: see :func:`~kornia_tidy.reconstruction.tiled.reconstruct_tiled`. A capture that fits is one tile.
        overlap: pixels of a tile that are discarded at each cut, if the receptive field reaches farther. With 144,
            tiles of a picture differed from the whole by at most 2e-4 of full scale, for shipped networks, which see
            as far as 450 pixels. None: the receptive field, for an exact result, which takes many times as long within
            little memory.
        progress: see :func:`~kornia_tidy.reconstruction.tiled.reconstruct_tiled`.

    Raises:
        TypeError: if the light is not a floating-point tensor.
        ValueError: if it is of another shape or unit, or the network cannot be tiled within the memory.

    Convention:
        Gradients are not computed.
    """
    check_float_tensor("light", light, 3, "(3, H, W) or (1, H, W)")
    if light.shape[0] not in {1, 3} or 0 in light.shape:
        raise ValueError(f"light must have shape (3, H, W) or (1, H, W), got {tuple(light.shape)}")
    if (most := float(light.max())) > MOST_LIGHT:
        raise ValueError(
            f"light must be in parts of full scale, at most {MOST_LIGHT:g}, got {most:.5g}: divide by full scale"
        )
    forms = [part for part in head.modules() if isinstance(part, ClosedForm)]
    softness = min((least_softness(part.psfs) for part in forms), default=math.inf)
    light, _, notes, least = check_capture(light, _told_noise(head), softness)
    head = _with_least_noise(head, least, float(light.mean()))
    colours = light.expand(3, -1, -1)[None]
    if head.field is not None:
        return Reconstruction(_over_field(head, colours, *head.field, progress)[0], None, notes)
    with whole_picture(head, colours):
        cut = None
        if one_tile(head, colours, memory_budget) is None:
            if not (known := getattr(head.head, "seamless", False)):
                check_seamless(head)  # which does not know of stray light
            cut = overlap if overlap is not None and (known or overlap < receptive_field(head)) else None
        maps: Any = reconstruct_tiled(head, colours, overlap=cut, memory_budget=memory_budget, progress=progress)
    names = [*MAPS[head.task], *(["deviation"] if head.uncertain else [])]
    named = {name: part[0].float() for name, part in zip(names, maps, strict=True)}
    image, near = named.get("image"), named.get("depth")
    if image is not None:
        image.clamp_(0, 1)
    if image is None or near is None or not head.uncertain:
        return Reconstruction(image, None if near is None else metres(head.camera, near), notes)
    deviation = named["deviation"]
    in_metres = deviation_in_metres(head.camera, near, deviation)
    return UncertainReconstruction(image, metres(head.camera, near), in_metres, deviation, notes)


def _with_least_noise(head: LightHead, least: float, level: float) -> LightHead:
    """Return a head with even noise of at least ``least``, that of JPEG; the head itself if it was given its noise."""
    if not least or head.noise is not None or (told := _told_noise(head)) is None:
        return head
    copied = cast("LightHead", shared_copy(head))
    copied.field = head.field
    own = told.std(level)
    copied.noise = max(least, own)
    for part in copied.modules():
        if isinstance(part, RuledClosedForm) and least > own:  # more noise of the sensor is left by JPEG
            part.in_differences = 0.0
    return copied


def _over_field(
    head: LightHead,
    light: Tensor,
    model: PSFModel,
    center: tuple[float, float],
    progress: Callable[[int, int], object] | None,
) -> Tensor:
    """Restore a capture through a real lens by a closed form, or the network for any camera, with the local PSFs."""
    own = shared_copy(head)
    form = next(part for part in own.modules() if isinstance(part, ClosedForm))
    nodes = torch.linspace(*model.camera.defocus_range, form.layers or NODES, dtype=torch.float64).tolist()

    def restore(part: Tensor, bank: PSFBank) -> Tensor:
        form.set_psfs(bank.at_defocus(nodes))
        return own(part)[0]

    with whole_picture(own, light):
        restored = restored_over_field(light, model, restore, center=center, tile=FIELD_TILE, progress=progress)
    return restored.clamp(0, 1)


def _told_noise(head: LightHead) -> MeasuredNoise | None:
    """Return the noise with which a network restores captures; None if it takes none."""
    if head.noise is not None:
        return MeasuredNoise(head.noise**2, 0.0)
    models = [part.noise_model.tolist() for part in head.modules() if isinstance(part, ClosedForm)]
    return MeasuredNoise(*models[0]) if models else None
