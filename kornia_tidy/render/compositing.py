"""Compositing: the image of a scene whose pixels lie in different defocus layers, one PSF a layer.

Two methods give the same image. The dense one convolves the whole image for every layer that the scene contains; it is
the definition. The tiled one (see :mod:`kornia_tidy.render.backends.tiled` and
:mod:`kornia_tidy.render.backends.tiled_occlusion`) convolves each tile for the layers found there, many times faster
and in bounded memory. Light is linear throughout.
"""

from __future__ import annotations

from collections.abc import Callable
from types import EllipsisType
from typing import Protocol

import torch
from torch import Tensor

from kornia_tidy.checks import check_choice, check_float_tensor
from kornia_tidy.render.backends.dense_occlusion import occlude_dense
from kornia_tidy.render.backends.tiled import blur_then_mix, split_then_blur
from kornia_tidy.render.backends.tiled_occlusion import occlude_tiled
from kornia_tidy.render.borders import check_border, from_spectrum, pad_border, padded_size, to_spectrum
from kornia_tidy.render.layers import assign_layers, layer_weight, present_layers
from kornia_tidy.render.stray_light import spread_evenly
from kornia_tidy.runtime.tracing import is_followed

METHODS = ("tiled", "dense")


class Bank(Protocol):
    """What a renderer asks of a PSF bank. D layers, C channels, PSFs of P x P pixels with P odd."""

    @property
    def psfs(self) -> Tensor:
        """(D, C, P, P) fraction of a point's light that falls on each pixel."""
        ...

    @property
    def defocus(self) -> Tensor:
        """(D,) defocus of the layers in radians, ascending."""
        ...

    @property
    def veil(self) -> Tensor | None:
        """(D, C) fraction of light that leaves the window and is spread evenly, or None for none."""
        ...


def render(
    image: Tensor,
    defocus: Tensor,
    bank: Bank,
    compositing: str = "gather",
    *,
    layers: str = "linear",
    border: str = "reflect",
    correlate: bool = False,
    method: str = "tiled",
) -> Tensor:
    """Render a scene through a PSF bank: what the sensor sees, in linear light.

    Args:
        image: (B, C, H, W) linear light of the scene, with the channels of the bank.
        defocus: (B, 1, H, W) or (1, 1, H, W) defocus in radians. Beyond the bank's layers it is clamped to the ends.
        bank: PSFs and their defocus, see :class:`Bank`.
        compositing: ``"gather"``, ``"scatter"`` or ``"occlusion"``, see the functions of these names.
        layers: ``"linear"`` or ``"nearest"``, see :func:`kornia_tidy.render.layers.assign_layers`.
        border: ``"reflect"``, ``"replicate"``, ``"zero"``, ``"circular"`` or ``"valid"``, see
            :mod:`kornia_tidy.render.borders`.
        correlate: turn the PSFs by 180 degrees, as the PhaseCam3D family of codes does.
        method: ``"tiled"``, or ``"dense"`` for the slow reference. While compiling and under torch.func, which need
            plain operations of torch, dense is used; for second derivatives, a backward pass like it.

    Returns:
        The coded image in ``image``'s dtype, computed in float32 or better, autocast or not: (B, C, H, W), or
        (B, C, H - P + 1, W - P + 1) for ``"valid"``.

    Raises:
        TypeError: if a tensor is not floating point.
        ValueError: if shapes do not fit, P is even, a choice is not known, or the image is too small for the border.

    Convention:
        A convolution: a PSF with its peak right of centre moves a point to the right. NaN is not looked for.

    Example:
        >>> import torch
        >>> from types import SimpleNamespace
        >>> bank = SimpleNamespace(psfs=torch.full((2, 3, 5, 5), 1 / 25), defocus=torch.tensor([-9.0, 9.0]), veil=None)
        >>> render(torch.rand(4, 3, 32, 48), torch.zeros(1, 1, 32, 48), bank, border="valid").shape
        torch.Size([4, 3, 28, 44])
    """
    check_choice("compositing", compositing, COMPOSITING)
    composite = COMPOSITING[compositing]
    return composite(
        image,
        defocus,
        bank.defocus,
        bank.psfs,
        bank.veil,
        layers=layers,
        border=border,
        correlate=correlate,
        method=method,
    )


def gather(
    image: Tensor,
    defocus: Tensor,
    nodes: Tensor,
    psfs: Tensor,
    veil: Tensor | None = None,
    *,
    layers: str = "linear",
    border: str = "reflect",
    correlate: bool = False,
    method: str = "tiled",
) -> Tensor:
    r"""Blur the image by each layer's PSF, then let each pixel take the layer it lies in.

    .. math:: I_c = \sum_d O_d \, (L_c * h_{dc} + v_{dc} \overline{L_c})

    White stays white where the PSFs sum to one (with the veil), but for the border ``"zero"``; flux is not conserved
    where depth changes.

    Args:
        image: L, (B, C, H, W) linear light.
        defocus: (B, 1, H, W) or (1, 1, H, W) defocus in radians; with ``nodes`` and ``layers`` it gives the weights O.
        nodes: (D,) ascending defocus of the layers in radians.
        psfs: h, (D, C, P, P) with P odd.
        veil: v, (D, C) fraction of the image's mean light that is added, or None. With the border ``"zero"`` as much of
            it as stays in the image, see :func:`kornia_tidy.render.stray_light.share_within`.
        layers: ``"linear"`` or ``"nearest"``.
        border: what lies beyond the image, see :func:`render`.
        correlate: turn the PSFs by 180 degrees.
        method: ``"tiled"`` or ``"dense"``, see :func:`render`.

    Returns:
        As :func:`render`; so are the errors and the convention.

    Source: Shah et al., TiDy-PSFs, ICCV 2023, equation 1.

    Example:
        >>> import torch
        >>> point = torch.zeros(1, 1, 5, 5)
        >>> point[..., 2, 2] = 1
        >>> psf = torch.tensor([[[[0.0, 0.0, 0.0], [0.0, 0.25, 0.75], [0.0, 0.0, 0.0]]]])
        >>> coded = gather(point, torch.zeros(1, 1, 5, 5), torch.zeros(1), psf)
        >>> (coded[0, 0, 2] * 100).round().int().tolist()
        [0, 0, 25, 75, 0]
    """
    options = {"veil": veil, "layers": layers, "border": border, "correlate": correlate, "method": method}
    return _composite({"tiled": _gather_tiled, "dense": _gather_dense}, image, defocus, nodes, psfs, **options)


def scatter(
    image: Tensor,
    defocus: Tensor,
    nodes: Tensor,
    psfs: Tensor,
    veil: Tensor | None = None,
    *,
    layers: str = "linear",
    border: str = "reflect",
    correlate: bool = False,
    method: str = "tiled",
) -> Tensor:
    r"""Let each pixel spread its own light by the PSF of the layer it lies in.

    .. math:: I_c = \sum_d \left( (O_d L_c) * h_{dc} + v_{dc} \overline{O_d L_c} \right)

    Flux is conserved where the PSFs sum to one (with the veil) and the border is circular; white does not stay white
    where depth changes, because no layer hides another. For gradients the dense method keeps one spectrum a layer.

    Args:
        image: L, (B, C, H, W) linear light. The product with the weights O is what gets padded.
        defocus: (B, 1, H, W) or (1, 1, H, W) defocus in radians; with ``nodes`` and ``layers`` it gives the weights O.
        nodes: (D,) ascending defocus of the layers in radians.
        psfs: h, (D, C, P, P) with P odd.
        veil: v, (D, C) fraction of each layer's mean light that is added, or None. With the border ``"zero"`` as much
            of it as stays in the image, see :func:`kornia_tidy.render.stray_light.share_within`.
        layers: ``"linear"`` or ``"nearest"``.
        border: what lies beyond the image, see :func:`render`.
        correlate: turn the PSFs by 180 degrees.
        method: ``"tiled"`` or ``"dense"``, see :func:`render`.

    Returns:
        As :func:`render`; so are the errors and the convention.

    Source: Shah et al., TiDy-PSFs, ICCV 2023, caption of the figure of the forward model.
    """
    options = {"veil": veil, "layers": layers, "border": border, "correlate": correlate, "method": method}
    return _composite({"tiled": _scatter_tiled, "dense": _scatter_dense}, image, defocus, nodes, psfs, **options)


def occlusion(
    image: Tensor,
    defocus: Tensor,
    nodes: Tensor,
    psfs: Tensor,
    veil: Tensor | None = None,
    *,
    layers: str = "linear",
    border: str = "reflect",
    correlate: bool = False,
    method: str = "tiled",
) -> Tensor:
    r"""Let near layers hide far ones: blur each layer and its outline, normalise, lay them over one another.

    .. math::
        E_d = h_d * \sum_{j \le d} O_j, \quad l_d = \frac{h_d * (O_d L_d)}{\max(E_d, 0) + \epsilon}, \quad
        a_d = \frac{h_d * O_d}{\max(E_d, 0) + \epsilon}, \quad I = \sum_d l_d \prod_{j > d} (1 - a_j)

    White stays white, to :math:`\epsilon` over the smallest share of a PSF that a layer is seen by. PSFs are normalised
    by their sums on the way, so light that a bank discards is as if renormalised; in the dark beyond a border of zeros
    there is nothing to be seen, and the image does not darken towards it. Not linear in the PSFs: PSFs averaged over
    time stand for the states of the exposure only roughly. Computed in float64, see
    :mod:`kornia_tidy.render.backends.dense_occlusion`.

    Args:
        image: L, (B, C, H, W) linear light.
        defocus: (B, 1, H, W) or (1, 1, H, W) defocus in radians; with ``nodes`` and ``layers`` it gives the weights O.
        nodes: (D,) ascending defocus of the layers in radians: the last is the nearest.
        psfs: h, (D, C, P, P) with P odd.
        veil: v, (D, C) fraction of each layer's light that is spread evenly before it is blurred and hidden, or None:
            :math:`L_d = (1 - v_d) L + v_d \overline{L}`, so that one layer alone looks as gather makes it. With the
            border ``"zero"`` as much of it as there is among the light seen, see
            :func:`kornia_tidy.render.stray_light.normalised_share`.
        layers: ``"linear"`` or ``"nearest"``.
        border: what lies beyond the image, see :func:`render`.
        correlate: turn the PSFs by 180 degrees.
        method: ``"tiled"`` or ``"dense"``, see :func:`render`.

    Returns:
        As :func:`render`; so are the errors and the convention.

    Source: Ikoma et al., Depth from Defocus with Learned Optics for Imaging and Occlusion-aware Depth Estimation,
    ICCP 2021; there :math:`\epsilon` is 1e-3, here 1e-6.

    Example:
        >>> import torch
        >>> scene = torch.tensor([[[[0.0, 0.0, 1.0, 1.0]]]])  # bright and near on the right, dark and far on the left
        >>> psfs = torch.zeros(2, 1, 3, 3)
        >>> psfs[0, 0, 1, 1], psfs[1, 0, 1] = 1, 1 / 3  # what is near is out of focus
        >>> coded = occlusion(scene, 10 * scene, torch.tensor([0.0, 10.0]), psfs, border="replicate")
        >>> (coded[0, 0, 0] * 100).round().int().tolist()
        [0, 33, 67, 100]
    """
    options = {"veil": veil, "layers": layers, "border": border, "correlate": correlate, "method": method}
    return _composite({"tiled": occlude_tiled, "dense": occlude_dense}, image, defocus, nodes, psfs, **options)


COMPOSITING: dict[str, Callable[..., Tensor]] = {"gather": gather, "scatter": scatter, "occlusion": occlusion}


def _composite(
    methods: dict[str, Callable[..., Tensor]],
    image: Tensor,
    defocus: Tensor,
    nodes: Tensor,
    psfs: Tensor,
    *,
    veil: Tensor | None,
    layers: str,
    border: str,
    correlate: bool,
    method: str,
) -> Tensor:
    """Check the inputs, find the layers and add them up in float32 or better."""
    check_choice("method", method, METHODS)
    check_scene(image, defocus, nodes, psfs, veil)
    check_border(border, image.shape[-2], image.shape[-1], psfs.shape[-1])
    dtype = torch.promote_types(torch.promote_types(image.dtype, psfs.dtype), torch.float32)
    with torch.autocast(image.device.type, enabled=False):
        lower, fraction = assign_layers(defocus, nodes, layers)  # in defocus's own precision, not in the image's
        psfs = psfs.flip((-2, -1)) if correlate else psfs
        veil = None if veil is None else veil.to(dtype)
        fraction = fraction.to(dtype) if layers == "linear" else None
        sum_layers = methods["dense" if is_followed() else method]
        coded = sum_layers(image.to(dtype), lower, fraction, psfs.to(dtype), veil=veil, border=border)
    return coded.to(image.dtype)


def _gather_dense(
    image: Tensor, lower: Tensor, fraction: Tensor | None, psfs: Tensor, *, veil: Tensor | None, border: str
) -> Tensor:
    psf_size = psfs.shape[-1]
    inside = _output_pixels(psf_size // 2, border)
    lower, fraction = lower[inside], None if fraction is None else fraction[inside]
    size = padded_size(*image.shape[-2:], psf_size, border)
    light = to_spectrum(pad_border(image, psf_size // 2, border), size)
    stray = None if veil is None else spread_evenly(image, psf_size, border)
    # Of the sum a pixel has two terms: pick them, mix once. Autograd then keeps masks, not a blurred image a layer.
    below = above = torch.zeros((), dtype=image.dtype, device=image.device)
    for index in present_layers(lower, fraction, len(psfs)):
        blurred = from_spectrum(light * to_spectrum(psfs[index], size), size, psf_size)
        if stray is not None and veil is not None:  # both or none
            blurred = blurred + veil[index, :, None, None] * stray
        below = torch.where(lower == index, blurred, below)
        if fraction is not None:
            above = torch.where(lower == index - 1, blurred, above)
    return below if fraction is None else torch.lerp(below, above, fraction)


def _scatter_dense(
    image: Tensor, lower: Tensor, fraction: Tensor | None, psfs: Tensor, *, veil: Tensor | None, border: str
) -> Tensor:
    psf_size = psfs.shape[-1]
    size = padded_size(*image.shape[-2:], psf_size, border)
    light = stray = torch.zeros((), dtype=image.dtype, device=image.device)
    for index in present_layers(lower, fraction, len(psfs)):
        own = layer_weight(lower, fraction, index) * image
        light = light + to_spectrum(pad_border(own, psf_size // 2, border), size) * to_spectrum(psfs[index], size)
        if veil is not None:
            stray = stray + veil[index, :, None, None] * own
    coded = from_spectrum(light, size, psf_size)
    return coded if veil is None else coded + spread_evenly(stray, psf_size, border)


def _gather_tiled(
    image: Tensor, lower: Tensor, fraction: Tensor | None, psfs: Tensor, *, veil: Tensor | None, border: str
) -> Tensor:
    inside = _output_pixels(psfs.shape[-1] // 2, border)
    lower, fraction = lower[inside], None if fraction is None else fraction[inside]
    coded = blur_then_mix(image, psfs, lower, fraction, border)
    if veil is None:
        return coded
    return coded + _own_veil(lower, fraction, veil) * spread_evenly(image, psfs.shape[-1], border)


def _scatter_tiled(
    image: Tensor, lower: Tensor, fraction: Tensor | None, psfs: Tensor, *, veil: Tensor | None, border: str
) -> Tensor:
    coded = split_then_blur(image, psfs, lower, fraction, border)
    if veil is None:
        return coded
    return coded + spread_evenly(_own_veil(lower, fraction, veil) * image, psfs.shape[-1], border)


def _output_pixels(radius: int, border: str) -> tuple[EllipsisType, slice, slice]:
    """Index of the pixels of (B, 1, H, W) that the output has."""
    kept = slice(radius, -radius) if border == "valid" and radius > 0 else slice(None)
    return ..., kept, kept


def _own_veil(lower: Tensor, fraction: Tensor | None, veil: Tensor) -> Tensor:
    """(B, C, H, W) mean of the veil over each pixel's layers."""
    below = torch.cat([own.take(lower) for own in veil.unbind(1)], dim=1)
    if fraction is None:
        return below
    higher = (lower + 1).clamp(max=len(veil) - 1)
    return torch.lerp(below, torch.cat([own.take(higher) for own in veil.unbind(1)], dim=1), fraction)


def check_scene(image: Tensor, defocus: Tensor, nodes: Tensor, psfs: Tensor, veil: Tensor | None) -> None:
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
    if veil is not None and tuple(veil.shape) != (depth, channels):
        raise ValueError(
            f"veil must have shape {(depth, channels)}, one value a layer and channel, got {tuple(veil.shape)}"
        )
