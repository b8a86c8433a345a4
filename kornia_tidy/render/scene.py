"""The layered scene: what the renderer is given, checked once and with the layers of every pixel found once."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from kornia_tidy.checks import check_float_tensor
from kornia_tidy.render.borders import check_border, pad_border
from kornia_tidy.render.layers import SAMPLE, Labels, assign_layers


@dataclass(frozen=True)
class LayeredScene:
    """An image whose pixels lie in defocus layers, and the PSF of each layer. See :func:`layered_scene`.

    Args:
        image: (B, C, H, W) linear light in float32 or float64.
        layer_index: (B or 1, 1, H, W) int64 index of each pixel's layer.
        layer_weight: (B or 1, 1, H, W) weight of the next layer, or None for nearest layers.
        psfs: (D, C, P, P) of the image's dtype, with P odd.
        stray_light: (D, C) fraction of a point's light that is spread evenly, or None for none.
        border: what lies beyond the image, see :mod:`kornia_tidy.render.borders`.
        compositing: ``"gather"``, ``"scatter"`` or ``"occlusion"``.
        found: what was found out about the scene, by its name, so that it is found once.
    """

    image: Tensor
    layer_index: Tensor
    layer_weight: Tensor | None
    psfs: Tensor
    stray_light: Tensor | None
    border: str
    compositing: str
    found: dict[Any, Any] = field(default_factory=dict, compare=False, repr=False)

    @property
    def psf_size(self) -> int:
        """Side P of the PSFs in pixels."""
        return self.psfs.shape[-1]

    @property
    def output_size(self) -> tuple[int, int]:
        """Height and width of the rendered image."""
        lost = self.psf_size - 1 if self.border == "valid" else 0
        return self.image.shape[-2] - lost, self.image.shape[-1] - lost

    # What follows is made when it is first asked for. functools.cached_property has a lock, which torch.compile refuses.

    @property
    def plane(self) -> Tensor:
        """(B, C, h + P - 1, w + P - 1) image with its border, for an output of h x w pixels."""
        if "plane" not in self.found:
            self.found["plane"] = pad_border(self.image, self.psf_size // 2, self.border)
        return self.found["plane"]

    @property
    def sorted_layers(self) -> tuple[Tensor, Tensor | None]:
        """Layer index and layer weight of the pixels that backends sort, (B or 1, h', w').

        Gather sorts the pixels of the output, scatter and occlusion those of :attr:`plane`. What lies beyond a border
        of zeros has no weight there, and takes the layers of the nearest pixels.
        """
        if "sorted_layers" not in self.found:
            self.found["sorted_layers"] = self._sort_layers()
        return self.found["sorted_layers"]

    def _sort_layers(self) -> tuple[Tensor, Tensor | None]:
        index, weight, radius = self.layer_index, self.layer_weight, self.psf_size // 2
        if self.compositing != "gather":
            sides = "replicate" if self.border == "zero" else self.border
            index = pad_border(index.to(self.image.dtype), radius, sides).long()  # padding is for real numbers
            weight = None if weight is None else pad_border(weight, radius, sides)
        elif self.border == "valid" and radius > 0:
            index = index[..., radius:-radius, radius:-radius]
            weight = None if weight is None else weight[..., radius:-radius, radius:-radius]
        return index[:, 0], None if weight is None else weight[:, 0]

    @property
    def batch_weight(self) -> Tensor | None:
        """Layer weight of :attr:`sorted_layers` for each image of the batch, (B, h', w')."""
        weight = self.sorted_layers[1]
        return None if weight is None else weight.expand(len(self.image), -1, -1)

    @property
    def labels(self) -> Labels:
        """:attr:`sorted_layers` for each image of the batch, (B, h', w')."""
        if "labels" not in self.found:
            index = self.sorted_layers[0].expand(len(self.image), -1, -1)
            self.found["labels"] = Labels.of(index, self.batch_weight)
        return self.found["labels"]

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
    """Check a scene and assign its pixels to layers, for :func:`kornia_tidy.render.dispatch.render_scene`.

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
    dtype = torch.promote_types(torch.promote_types(image.dtype, psfs.dtype), torch.float32)
    index, weight = assign_layers(defocus, nodes, layers)  # in defocus's own precision, not in the image's
    return LayeredScene(
        image.to(dtype),
        index,
        weight.to(dtype) if layers == "linear" else None,
        (psfs.flip((-2, -1)) if correlate else psfs).to(dtype),
        None if stray_light is None else stray_light.to(dtype),
        border,
        compositing,
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
    check_border(border, height, width, psf_width)
