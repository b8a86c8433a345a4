"""Compositing of a scene with many defocus layers, each with its PSF.

Each function makes a layered scene of its arguments (:mod:`kornia_tidy.render.scene`) and hands it to a backend
(:mod:`kornia_tidy.render.dispatch`). All backends give the same image. Light is linear throughout.
"""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.render.dispatch import Rendering, render_layers


def render(
    image: Tensor,
    defocus: Tensor,
    bank: PSFBank,
    compositing: str = "gather",
    *,
    layers: str = "linear",
    border: str = "reflect",
    correlate: bool = False,
    method: str = "auto",
) -> Tensor:
    """Render a scene through a PSF bank: the irradiance on the sensor, in linear light.

    Args:
        image: (B, C, H, W) linear light of the scene, with the channels of the bank.
        defocus: (B, 1, H, W) or (1, 1, H, W) defocus in radians. Beyond the bank's layers it is clamped to the ends.
        bank: PSFs and their defocus, a :class:`~kornia_tidy.psf.PSFBank`.
        compositing: ``"gather"``, ``"scatter"`` or ``"occlusion"``, see the functions of these names.
        layers: ``"linear"`` or ``"nearest"``, see :func:`kornia_tidy.render.layers.assign_layers`.
        border: ``"reflect"``, ``"replicate"``, ``"zero"``, ``"circular"`` or ``"valid"``, see
            :mod:`kornia_tidy.render.borders`.
        correlate: flip the PSFs by 180 degrees, as the PhaseCam3D family of codes does.
        method: the backend. ``"auto"`` takes one by a rule, see :func:`kornia_tidy.render.dispatch.choose`;
            ``"compiled"`` (in C), ``"batched"`` (in torch, on any device) and ``"dense"`` (the definition) ask for
            one. ``torch.func`` and forward-mode derivatives work only with dense.

    Returns:
        The coded image in ``image``'s dtype, computed in float32 or better, autocast or not: (B, C, H, W), or
        (B, C, H - P + 1, W - P + 1) for ``"valid"``.

    Raises:
        TypeError: if a tensor is not floating point.
        ValueError: if shapes do not fit, P is even, a choice is not known, the image is too small for the border, or
            the method asked for does not support the scene.

    Convention:
        A convolution: a PSF with its peak right of centre moves a point to the right. NaN is not looked for.

    Example:
        >>> import torch
        >>> bank = PSFBank(torch.full((2, 3, 5, 5), 1 / 25), torch.tensor([-9.0, 9.0]), torch.ones(2, 3))
        >>> render(torch.rand(4, 3, 32, 48), torch.zeros(1, 1, 32, 48), bank, border="valid").shape
        torch.Size([4, 3, 28, 44])
    """
    how = Rendering(compositing, border, layers, correlate)
    return render_layers(image, defocus, bank.defocus, bank.psfs, bank.veil, how, method)


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
    method: str = "auto",
) -> Tensor:
    r"""Convolve the image with each layer's PSF, then blend at each pixel those of its layers.

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
        border: continuation of the image beyond its edges, see :func:`render`.
        correlate: flip the PSFs by 180 degrees.
        method: the backend, see :func:`render`.

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
    how = Rendering("gather", border, layers, correlate)
    return render_layers(image, defocus, nodes, psfs, veil, how, method)


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
    method: str = "auto",
) -> Tensor:
    r"""Split the image into layers, convolve each with its PSF, and add them up.

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
        border: continuation of the image beyond its edges, see :func:`render`.
        correlate: flip the PSFs by 180 degrees.
        method: the backend, see :func:`render`.

    Returns:
        As :func:`render`; so are the errors and the convention.

    Source: Shah et al., TiDy-PSFs, ICCV 2023, caption of the figure of the forward model.
    """
    how = Rendering("scatter", border, layers, correlate)
    return render_layers(image, defocus, nodes, psfs, veil, how, method)


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
    method: str = "auto",
) -> Tensor:
    r"""Composite blurred layers from near to far, so that near ones occlude far ones.

    .. math::
        E_d = h_d * \sum_{j \le d} O_j, \quad l_d = \frac{h_d * (O_d L_d)}{\max(E_d, 0) + \epsilon}, \quad
        a_d = \frac{h_d * O_d}{\max(E_d, 0) + \epsilon}, \quad I = \sum_d l_d \prod_{j > d} (1 - a_j)

    White stays white, to :math:`\epsilon` over the smallest share of a PSF that a layer is seen by. Behind near things
    that is the tail of a far layer's PSF: one that is cut to zero sees nothing there, and white darkens. Give such PSFs
    tails (:meth:`kornia_tidy.psf.psf_bank.PSFBank.with_tails`), as cameras do with measured ones. PSFs are normalised
    by their sums on the way, so light that a bank discards is as if renormalised; in the dark beyond a border of zeros
    there is nothing to be seen, and the image does not darken towards it. Not linear in the PSFs: PSFs averaged over
    time only approximate the states of the exposure. Computed in float64, see
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
        border: continuation of the image beyond its edges, see :func:`render`.
        correlate: flip the PSFs by 180 degrees.
        method: the backend, see :func:`render`.

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
    how = Rendering("occlusion", border, layers, correlate)
    return render_layers(image, defocus, nodes, psfs, veil, how, method)


COMPOSITING: dict[str, Callable[..., Tensor]] = {"gather": gather, "scatter": scatter, "occlusion": occlusion}
