"""The layered scene: the renderer's input, checked, with every pixel assigned to its layers."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from kornia_tidy.checks import check_float_tensor
from kornia_tidy.kernels.overlap_ops import Places, window_size
from kornia_tidy.psf.field import Field
from kornia_tidy.render.borders import BORDERS, check_border, pad_border, padded_size
from kornia_tidy.render.layers import assign_layers, check_nodes

SAMPLE = 8  # px between the rows and columns of a sample of the labels


@dataclass(frozen=True)
class Labels:
    """The layers of each pixel: all light to one layer, or a weight to the next one.

    Args:
        layer_index: (B, H, W) int64 index of a layer, from :func:`~kornia_tidy.render.layers.assign_layers`.
        layer_weight: (B, H, W) weight of the next layer, or None for nearest layers.
        weight_gradient: a layer with a weight of zero counts too, for its gradient.
    """

    layer_index: Tensor
    layer_weight: Tensor | None
    weight_gradient: bool = False

    @classmethod
    def of(cls, layer_index: Tensor, layer_weight: Tensor | None) -> Labels:
        """Return labels for layers as assigned; ``weight_gradient`` where a gradient of ``layer_weight`` is wanted."""
        if layer_weight is None:
            return cls(layer_index, None)
        return cls(layer_index, layer_weight.detach(), layer_weight.requires_grad and torch.is_grad_enabled())

    def every(self, step: int) -> Labels:
        """Return the labels of every ``step``-th row and column."""
        kept = (slice(None), slice(None, None, step), slice(None, None, step))
        weight = self.layer_weight
        return Labels(self.layer_index[kept], None if weight is None else weight[kept], self.weight_gradient)

    def terms(self, *where: slice) -> list[Tensor]:
        """Return the one or two layers of each pixel there: the same twice if it lies in one."""
        index = self.layer_index[where]
        if self.layer_weight is None:
            return [index]
        if self.weight_gradient:
            return [index, index + 1]
        weight = self.layer_weight[where]
        return [index + (weight == 1), index + (weight > 0)]


@dataclass(frozen=True)
class LayeredScene:
    """An image, the defocus layers of its pixels, and the PSF of each layer. See :func:`layered_scene`.

    Backends sort pixels by their layers: gather those of the output (B or 1, h, w), scatter and occlusion those of
    :attr:`plane`. What lies beyond a border of zeros has no weight there, and takes the layers of the nearest pixels.

    Args:
        image: (B, C, H, W) linear light in float32 or float64.
        layer_index: (B or 1, 1, H, W) int64 index of each pixel's layer.
        layer_weight: (B or 1, 1, H, W) weight of the next layer, or None for nearest layers.
        psfs: (D, C, P, P) of the image's dtype, with P odd; with a field (F, D, C, P, P).
        stray_light: (D, C) fraction of a point's light that is spread evenly, or None for none.
        border: what lies beyond the image, see :mod:`kornia_tidy.render.borders`.
        compositing: ``"gather"``, ``"scatter"`` or ``"occlusion"``.
        dtype: of the rendered image.
        sorted_layers: layer index and layer weight of the pixels that are sorted, and
        labels: the same for each image of the batch, without gradients.
        field: where over the picture PSFs are known, or None for PSFs that are the same everywhere.
        found: planes that were made of the scene, by their names, so that they are made once.
    """

    image: Tensor
    layer_index: Tensor
    layer_weight: Tensor | None
    psfs: Tensor
    stray_light: Tensor | None
    border: str
    compositing: str
    dtype: torch.dtype
    sorted_layers: tuple[Tensor, Tensor | None]
    labels: Labels
    field: Field | None = None
    found: dict[str, Any] = dataclasses.field(default_factory=dict, compare=False, repr=False)

    @property
    def output_size(self) -> tuple[int, int]:
        """Height and width of the rendered image."""
        lost = self.psfs.shape[-1] - 1 if self.border == "valid" else 0
        return self.image.shape[-2] - lost, self.image.shape[-1] - lost

    @property
    def padded_size(self) -> tuple[int, int]:
        """Height and width of :attr:`plane`."""
        return padded_size(*self.image.shape[-2:], self.psfs.shape[-1], self.border)

    @property
    def plane(self) -> Tensor:
        """(B, C, h + P - 1, w + P - 1) image with its border, for an output of h x w pixels. Made on first use."""
        if "plane" not in self.found:
            self.found["plane"] = pad_border(self.image, self.psfs.shape[-1] // 2, self.border)
        return self.found["plane"]

    @property
    def batch_weight(self) -> Tensor | None:
        """Layer weight of :attr:`sorted_layers` for each image of the batch, with gradients."""
        weight = self.sorted_layers[1]
        return None if weight is None else weight.expand(len(self.image), -1, -1)

    @property
    def places(self) -> Places:
        """Tiles over the field and the nodes' weights there: at the pixels that see, for scatter at those of the light.

        Tiles are as large as suits the PSFs, but not larger than the field's cells.
        """
        if "places" not in self.found:
            assert self.field is not None
            side, origin = self.psfs.shape[-1], self.field.origin
            scatters, valid = self.compositing == "scatter", self.border == "valid"
            sides, beyond = (self.padded_size, side // 2) if scatters else (self.output_size, 0)
            moved = side // 2 * (valid - scatters)
            most = min(self.field.cell, window_size(side) - side + 1)
            rows, columns = (self.field.tiles(i, origin[i] + moved, sides[i], most, beyond) for i in (0, 1))
            self.found["places"] = Places(*rows, *columns)
        return self.found["places"]

    @property
    def sampled_layers(self) -> int:
        """Number of layers in a sample of the scene: every eighth row and column of :attr:`labels`."""
        if "sampled_layers" not in self.found:
            terms = [layer.flatten() for layer in self.labels.every(SAMPLE).terms()]
            self.found["sampled_layers"] = int((torch.bincount(torch.cat(terms)) > 0).sum())
        return self.found["sampled_layers"]


def layered_scene(
    image: Tensor,
    defocus: Tensor,
    nodes: Tensor,
    psfs: Tensor,
    stray_light: Tensor | None = None,
    *,
    compositing: str = "gather",
    layers: str = "linear",
    border: str = "reflect",
    correlate: bool = False,
) -> LayeredScene:
    """Check a scene and assign its pixels to layers, for :func:`kornia_tidy.render.dispatch.choose`.

    Args:
        image: (B, C, H, W) linear light.
        defocus: (B, 1, H, W) or (1, 1, H, W) defocus in radians.
        nodes: (D,) ascending defocus of the layers in radians.
        psfs: (D, C, P, P) with P odd.
        stray_light: (D, C) fraction of a point's light that is spread evenly, or None for none.
        compositing: ``"gather"``, ``"scatter"`` or ``"occlusion"``.
        layers: ``"linear"`` or ``"nearest"``, see :func:`kornia_tidy.render.layers.assign_layers`.
        border: what lies beyond the image, see :mod:`kornia_tidy.render.borders`.
        correlate: flip the PSFs by 180 degrees.

    Returns:
        The scene in float32 or better.

    Raises:
        TypeError: if a tensor is not floating point.
        ValueError: if shapes do not fit, P is even, a choice is not known, or the image is too small for the border.

    Example:
        >>> import torch
        >>> psi, nodes, psfs = torch.full((1, 1, 8, 8), 2.0), torch.tensor([0.0, 4.0]), torch.rand(2, 3, 5, 5)
        >>> scene = layered_scene(torch.rand(2, 3, 8, 8), psi, nodes, psfs, border="valid")
        >>> scene.output_size, scene.layer_index.unique(), scene.layer_weight.unique()
        ((4, 4), tensor([0]), tensor([0.5000]))
    """
    check_scene(image, defocus, nodes, psfs, stray_light, border)
    if nodes.device.type != "cpu":
        check_nodes(nodes)
    return assigned_scene(image, defocus, nodes, psfs, stray_light, compositing, layers, border, correlate)


def assigned_scene(
    image: Tensor,
    defocus: Tensor,
    nodes: Tensor,
    psfs: Tensor,
    stray_light: Tensor | None,
    compositing: str,
    layers: str,
    border: str,
    correlate: bool,
    field: Field | None = None,
) -> LayeredScene:
    """Return the scene of :func:`layered_scene`, whose tensors were checked before."""
    dtype = torch.promote_types(torch.promote_types(image.dtype, psfs.dtype), torch.float32)
    index, weight = assign_layers(defocus, nodes, layers)  # in defocus's own precision, not in the image's
    return scene_of_layers(
        image.to(dtype),
        index,
        weight.to(dtype) if layers == "linear" else None,
        (psfs.flip((-2, -1)) if correlate else psfs).to(dtype),
        None if stray_light is None else stray_light.to(dtype),
        border,
        compositing,
        image.dtype,
        field,
    )


def scene_of_layers(
    image: Tensor,
    layer_index: Tensor,
    layer_weight: Tensor | None,
    psfs: Tensor,
    stray_light: Tensor | None,
    border: str,
    compositing: str,
    dtype: torch.dtype,
    field: Field | None = None,
) -> LayeredScene:
    """Return a scene with layers that the caller knows already. Nothing is checked.

    Args:
        image: this and the other arguments are those of :class:`LayeredScene`.
        layer_index: of each pixel.
        layer_weight: of the next layer, or None.
        psfs: of the layers.
        stray_light: of the layers, or None.
        border: what lies beyond the image.
        compositing: ``"gather"``, ``"scatter"`` or ``"occlusion"``.
        dtype: of the rendered image.
        field: where over the picture PSFs are known.
    """
    index, weight, radius, batch = layer_index, layer_weight, psfs.shape[-1] // 2, len(image)
    if compositing != "gather":
        sides = "replicate" if border == "zero" else border
        index = pad_border(index.to(image.dtype), radius, sides).long()  # padding is for real numbers
        weight = None if weight is None else pad_border(weight, radius, sides)
    elif border == "valid" and radius > 0:
        index = index[..., radius:-radius, radius:-radius]
        weight = None if weight is None else weight[..., radius:-radius, radius:-radius]
    index, weight = index[:, 0], None if weight is None else weight[:, 0]
    with_gradient = weight is not None and weight.requires_grad and torch.is_grad_enabled()
    of_batch = None if weight is None else weight.detach().expand(batch, -1, -1)
    labels = Labels(index.expand(batch, -1, -1), of_batch, with_gradient)
    sorted_layers = index, weight
    return LayeredScene(
        image, layer_index, layer_weight, psfs, stray_light, border, compositing, dtype, sorted_layers, labels, field
    )


def check_scene(
    image: Tensor, defocus: Tensor, nodes: Tensor, psfs: Tensor, stray_light: Tensor | None, border: str
) -> None:
    """Raise ``TypeError`` or ``ValueError`` unless image, defocus map and PSFs fit each other. Looks at no value."""
    check_float_tensor("image", image, 4, "(B, C, H, W)")
    check_float_tensor("defocus", defocus, 4, "(B, 1, H, W)")
    check_float_tensor("psfs", psfs, 4, "(D, C, P, P)")
    batch, channels, height, width = image.shape
    if tuple(defocus.shape) not in ((batch, 1, height, width), (1, 1, height, width)):
        raise ValueError(
            f"defocus must have the image's size, shape {(batch, 1, height, width)} or {(1, 1, height, width)}, "
            f"got {tuple(defocus.shape)}"
        )
    depth, psf_channels, psf_height, psf_width = psfs.shape
    if psf_height != psf_width or psf_height % 2 == 0:
        raise ValueError(f"psfs must be square with an odd side, which has a centre, got {psf_height}x{psf_width}")
    if psf_channels != channels:
        raise ValueError(f"image and psfs must have the same channels, got {channels} and {psf_channels}")
    if tuple(nodes.shape) != (depth,):
        raise ValueError(f"nodes must have shape {(depth,)}, one defocus a PSF layer, got {tuple(nodes.shape)}")
    if stray_light is not None and tuple(stray_light.shape) != (depth, channels):
        raise ValueError(
            f"veil must have shape {(depth, channels)}, one value a layer and channel, got {tuple(stray_light.shape)}"
        )
    if border not in BORDERS or min(height, width) < psf_width:  # no border needs more
        check_border(border, height, width, psf_width)
