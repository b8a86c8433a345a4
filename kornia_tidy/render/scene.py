"""The layered scene: the renderer's input, checked, with every pixel assigned to its defocus layers.

A bank knows its PSFs at a few nodes of defocus. A pixel between two nodes has a layer index, that of the node below it,
and a layer weight, the fraction of the way to the next node. All weights follow from these two numbers, so no
(B, D, H, W) tensor is needed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import pad

from kornia_tidy.checks import check_choice, check_float_tensor
from kornia_tidy.kernels.occlusion_ops import TILE
from kornia_tidy.kernels.overlap_ops import window_size
from kornia_tidy.kernels.places import Places
from kornia_tidy.mode import Mode, torch_mode
from kornia_tidy.psf.field import Field
from kornia_tidy.render.borders import BORDERS, PAD_MODES, check_border, pad_border

LAYER_MODES = ("nearest", "linear")
SAMPLE = 8  # px between the rows and columns of a sample of the labels


@dataclass(frozen=True)
class Labels:
    """The layers of each pixel: all light to one layer, or a weight to the next one.

    Args:
        layer_index: (B, H, W) int64 index of a layer, from :func:`assign_layers`.
        layer_weight: (B, H, W) weight of the next layer, or None for nearest layers.
        weight_gradient: a layer with a weight of zero counts too, for its gradient.
    """

    layer_index: Tensor
    layer_weight: Tensor | None
    weight_gradient: bool = False

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

    def present(self) -> list[int]:
        """Return the layers that hold a pixel, ascending. Waits for the device once."""
        return torch.bincount(torch.cat([layer.flatten() for layer in self.terms()])).nonzero()[:, 0].tolist()


@dataclass(frozen=True)
class LayeredScene:
    """An image, the defocus layers of its pixels, and the PSF of each layer. See :func:`layered_scene`.

    Backends sort pixels by their layers: gather those of the output (B or 1, h, w), scatter and occlusion those of
    :attr:`plane`. Pixels beyond a border of zeros have no weight there, and take the layers of the nearest pixels.

    Args:
        image: (B, C, H, W) linear light in float32 or float64.
        plane: (B, C, h + P - 1, w + P - 1) image with its border, for an output of h x w pixels.
        layer_index: (B or 1, 1, H, W) int64 index of each pixel's layer.
        layer_weight: (B or 1, 1, H, W) weight of the next layer, or None for nearest layers.
        psfs: (D, C, P, P) of the image's dtype, with P odd; with a field (F, D, C, P, P).
        stray_light: (D, C) fraction of a point's light that is spread evenly, or None for none.
        border: continuation of the image beyond its edges, see :mod:`kornia_tidy.render.borders`.
        compositing: ``"gather"``, ``"scatter"`` or ``"occlusion"``.
        dtype: of the rendered image.
        sorted_layers: layer index and layer weight of the pixels that are sorted, and
        labels: the same for each image of the batch, without gradients.
        field: where over the picture PSFs are known, or None for PSFs that are the same everywhere.
    """

    image: Tensor
    plane: Tensor
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

    @property
    def output_size(self) -> tuple[int, int]:
        """Height and width of the rendered image."""
        lost = self.psfs.shape[-1] - 1 if self.border == "valid" else 0
        return self.image.shape[-2] - lost, self.image.shape[-1] - lost

    @property
    def padded_size(self) -> tuple[int, int]:
        """Height and width of :attr:`plane`."""
        return self.plane.shape[-2], self.plane.shape[-1]

    @property
    def batch_weight(self) -> Tensor | None:
        """Layer weight of :attr:`sorted_layers` for each image of the batch, with gradients."""
        weight = self.sorted_layers[1]
        return None if weight is None else weight.expand(len(self.image), -1, -1)

    @cached_property
    def places(self) -> Places:
        """Tiles over the field and the nodes' weights there: at the pixels that see, for scatter at those of the light.

        Tiles are as large as suits the PSFs, but not larger than the field's cells. Those of occlusion are small.
        """
        assert self.field is not None
        side, origin, occludes = self.psfs.shape[-1], self.field.origin, self.compositing == "occlusion"
        scatters, valid = self.compositing == "scatter", self.border == "valid"
        sides, beyond = (self.padded_size, side // 2) if scatters else (self.output_size, 0)
        moved = side // 2 * (valid - scatters)
        most = TILE if occludes else (min(self.field.cell, window_size(side) - side + 1),) * 2
        rows, columns = (self.field.tiles(i, origin[i] + moved, sides[i], most[i], beyond) for i in (0, 1))
        return Places(*rows, *columns)

    @cached_property
    def sampled_layers(self) -> int:
        """Number of layers in a sample of the scene: every eighth row and column of :attr:`labels`."""
        return len(self.labels.every(SAMPLE).present())


def layered_scene(
    image: Tensor,
    defocus: Tensor,
    nodes: Tensor,
    psfs: Tensor,
    stray_light: Tensor | None = None,
    compositing: str = "gather",
    layers: str = "linear",
    border: str = "reflect",
    correlate: bool = False,
    field: Field | None = None,
) -> LayeredScene:
    """Check a scene and assign its pixels to layers, for :func:`kornia_tidy.render.dispatch.choose`.

    Args:
        image: (B, C, H, W) linear light.
        defocus: (B, 1, H, W) or (1, 1, H, W) defocus in radians.
        nodes: (D,) ascending defocus of the layers in radians.
        psfs: (D, C, P, P) with P odd; with a field (F, D, C, P, P).
        stray_light: (D, C) fraction of a point's light that is spread evenly, or None for none.
        compositing: ``"gather"``, ``"scatter"`` or ``"occlusion"``.
        layers: ``"linear"`` or ``"nearest"``, see :func:`assign_layers`.
        border: continuation of the image beyond its edges, see :mod:`kornia_tidy.render.borders`.
        correlate: flip the PSFs by 180 degrees.
        field: where over the picture PSFs are known. Default: they are the same everywhere.

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
    check_scene(image, defocus, nodes, psfs if field is None else psfs[0], stray_light, border)
    kind = torch.promote_types(torch.promote_types(image.dtype, psfs.dtype), torch.float32)
    layer_index, layer_weight = assign_layers(defocus, nodes, layers)  # in defocus's own precision, not in the image's
    layer_weight = layer_weight.to(kind) if layers == "linear" else None
    index, weight, radius, batch = layer_index, layer_weight, psfs.shape[-1] // 2, len(image)
    if compositing != "gather":
        sides = "replicate" if border == "zero" else border
        index = pad_border(index.to(kind), radius, sides).long()  # padding is for real numbers
        weight = None if weight is None else pad_border(weight, radius, sides)
    elif border == "valid" and radius > 0:
        index = index[..., radius:-radius, radius:-radius]
        weight = None if weight is None else weight[..., radius:-radius, radius:-radius]
    index, weight = index[:, 0], None if weight is None else weight[:, 0]
    with_gradient = weight is not None and weight.requires_grad and torch.is_grad_enabled()
    of_batch = None if weight is None else weight.detach().expand(batch, -1, -1)
    light = image.to(kind)
    return LayeredScene(
        light,
        light if border == "valid" else pad(light, (radius,) * 4, PAD_MODES[border]),
        layer_index,
        layer_weight,
        (psfs.flip((-2, -1)) if correlate else psfs).to(kind),
        None if stray_light is None else stray_light.to(kind),
        border,
        compositing,
        image.dtype,
        (index, weight),
        Labels(index.expand(batch, -1, -1), of_batch, with_gradient),
        field,
    )


def assign_layers(defocus: Tensor, nodes: Tensor, mode: str) -> tuple[Tensor, Tensor]:
    r"""Return the layer below each pixel's defocus and the weight of the next layer.

    .. math:: t = \frac{\psi - \psi_i}{\psi_{i+1} - \psi_i}, \qquad \psi_i \le \psi \le \psi_{i+1}

    Args:
        defocus: (B, 1, H, W) defocus in radians. Values beyond the nodes are clamped to the end nodes.
        nodes: (D,) defocus of the layers in radians, strictly ascending; the spacing may vary.
        mode: ``"linear"`` shares the light between two layers, ``"nearest"`` gives all of it to one.

    Returns:
        The layer index i in int64 and the layer weight t in [0, 1], both (B, 1, H, W). Layer i has the weight 1 - t and
        layer i + 1 the weight t. For ``"nearest"`` t is zero.

    Raises:
        ValueError: if ``mode`` is not known, or the nodes do not ascend (not checked while compiling, nor on an
            accelerator: see :func:`check_nodes`).

    Convention:
        - Half way between two nodes, nearest takes the lower one (the farther from the camera).
        - Linear has a gradient with respect to defocus; on a node it is that of the interval above, on the last node
          that of the interval below. Nearest has none.

    Example:
        >>> import torch
        >>> defocus = torch.tensor([-4.0, 0.5, 3.0, 9.0]).view(1, 1, 1, 4)
        >>> index, weight = assign_layers(defocus, torch.tensor([-2.0, 0.0, 4.0]), "linear")
        >>> index.flatten().tolist(), weight.flatten().tolist()
        ([0, 1, 1, 1], [0.0, 0.125, 0.75, 1.0])
    """
    if mode not in LAYER_MODES:
        check_choice("layers", mode, LAYER_MODES)
    check_float_tensor("nodes", nodes, 1, "(D,)")
    dtype = torch.promote_types(torch.promote_types(defocus.dtype, nodes.dtype), torch.float32)
    defocus, nodes = defocus.to(dtype), nodes.to(dtype)
    spacing: float | None = None  # of nodes that are evenly spaced, among which nothing is searched
    if nodes.device.type == "cpu" and len(nodes) > 1 and not (nodes.requires_grad or Mode.TRANSFORM in torch_mode()):
        places = nodes.tolist()
        step = (places[-1] - places[0]) / (len(places) - 1)
        rounding = 4 * torch.finfo(dtype).eps * max(map(abs, places))
        even = step > 2 * rounding and all(abs(x - places[0] - i * step) <= rounding for i, x in enumerate(places))
        spacing = step if even else None
    if nodes.device.type == "cpu" and spacing is None:
        check_nodes(nodes)
    if mode == "nearest" and spacing is not None:
        steps = (defocus.detach() - nodes[0]).div_(spacing).sub_(0.5).ceil_().clamp_(0, len(nodes) - 1)
        return steps.long(), torch.zeros((), dtype=dtype).expand(defocus.shape)
    if mode == "nearest" or len(nodes) == 1:
        middles = (nodes[1:] + nodes[:-1]) / 2
        index = torch.bucketize(defocus.detach().contiguous(), middles.detach())
        return index, torch.zeros((), dtype=dtype, device=defocus.device).expand(defocus.shape)
    if spacing is not None:
        steps = (defocus - nodes[0]).div_(spacing).clamp_(0, len(nodes) - 1)
        index = steps.detach().long().clamp_(max=len(nodes) - 2)
        return index, steps - index
    clamped = defocus.clamp(nodes[0], nodes[-1])
    # Inner nodes only: the end nodes belong to the first and last interval.
    index = torch.bucketize(clamped.detach().contiguous(), nodes[1:-1].detach().contiguous(), right=True)
    return index, (clamped - nodes.take(index)) / nodes.diff().take(index)


def check_nodes(nodes: Tensor) -> None:
    """Raise ``ValueError`` if the nodes do not ascend strictly, unless their values are unknown. Waits for the device.

    Args:
        nodes: (D,) defocus of the layers in radians.
    """
    if Mode.GRAPH not in torch_mode() and not bool((nodes.diff() > 0).all()):
        raise ValueError(f"nodes must ascend strictly, got {nodes.tolist()}")


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
            f"stray light must have shape {(depth, channels)}, one value a layer and channel, "
            f"got {tuple(stray_light.shape)}"
        )
    if border not in BORDERS or min(height, width) < psf_width:  # no border needs more
        check_border(border, height, width, psf_width)
