"""Scene rendering: layers of defocus, borders, compositing, stray light, and the average over one exposure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache

import numpy as np

Array = np.ndarray
EPSILON = 1e-6  # added to the normalisers of occlusion; Ikoma et al. 2021 take 1e-3


def layer_weights(psi: Array, nodes: Sequence[float], mode: str) -> Array:
    """Return the weight of each layer at each pixel, (D, H, W).

    "nearest" gives a pixel to the layer of the nearest psi, and at equal distance to the one farther from the camera.
    "linear" shares it between the two layers around its psi. Beyond the end layers a pixel belongs to the end layer.
    """
    out = np.zeros((len(nodes), *psi.shape))
    for y, x in np.ndindex(*psi.shape):
        p = min(max(psi[y, x], nodes[0]), nodes[-1])
        if mode == "nearest":
            out[min(range(len(nodes)), key=lambda d: abs(p - nodes[d])), y, x] = 1
            continue
        d = next(d for d in range(len(nodes) - 1) if p <= nodes[d + 1])
        share = (p - nodes[d]) / (nodes[d + 1] - nodes[d])
        out[d, y, x], out[d + 1, y, x] = 1 - share, share
    return out


def source_index(index: int, size: int, border: str) -> int | None:
    """Return which pixel of a row the border shows at an index outside [0, size), or None for black.

    "reflect" mirrors the row about the middle of its last pixel (c b | a b c | b a), "replicate" repeats the last
    pixel, "circular" begins again at the other end, "zero" is black.
    """
    if 0 <= index < size:
        return index
    if border == "reflect":
        return source_index(-index if index < 0 else 2 * (size - 1) - index, size, border)
    return {"replicate": 0 if index < 0 else size - 1, "circular": index % size}.get(border)


def padded(planes: Array, radius: int, border: str) -> Array:
    """Return planes (n, H, W) extended by a radius on each side as the border says; "valid" extends nothing."""
    if border == "valid":
        return planes
    n, height, width = planes.shape
    out = np.zeros((n, height + 2 * radius, width + 2 * radius))
    for y in range(out.shape[1]):
        for x in range(out.shape[2]):
            row, column = source_index(y - radius, height, border), source_index(x - radius, width, border)
            if row is not None and column is not None:
                out[:, y, x] = planes[:, row, column]
    return out


def blur(planes: Sequence[Array], psf: Array, border: str) -> Array:
    r"""Return the convolution of each plane, :math:`\sum_k h(k) L(y - k)`, at pixels that see the whole PSF."""
    last = len(psf) - 1
    wide = padded(np.stack(planes), last // 2, border)
    height, width = wide.shape[1] - last, wide.shape[2] - last
    out = np.zeros((len(planes), height, width))
    for i, j in np.ndindex(*psf.shape):
        out += psf[i, j] * wide[:, last - i : last - i + height, last - j : last - j + width]
    return out


def cropped(plane: Array, radius: int, border: str) -> Array:
    """Return the part of a plane (..., H, W) that the output shows: for "valid" without the outer pixels."""
    height, width = plane.shape[-2:]
    return plane[..., radius : height - radius, radius : width - radius] if border == "valid" else plane


@cache
def retained_stray_light(height: int, width: int, radius: int) -> Array:
    r"""Return the share of each pixel's stray light that lands in an image with black around it, (H, W).

    Behind a sharp aperture light falls as the inverse cube of the distance, so what lies beyond a ring falls as the
    inverse of its radius: beyond ring k, :math:`(r + 1/2) / (k + 1/2)` of what lies beyond the window. A ring is the
    8k pixels at a distance of k along the farther axis, and shares its light evenly. Source: Born and Wolf, 8.5.2.
    """
    out = np.zeros((height, width))
    for y, x, i, j in np.ndindex(height, width, height, width):
        k = max(abs(y - i), abs(x - j))
        if k > radius:
            out[y, x] += ((radius + 0.5) / (k - 0.5) - (radius + 0.5) / (k + 0.5)) / (8 * k)
    return out


def gather(image: Array, weights: Array, bank: Array, stray: Array, border: str) -> Array:
    r"""Return :math:`I_c = \sum_d O_d (L_c * h_{dc} + v_{dc} \overline{L_c})`: blur, then select.

    Each pixel takes the blurred image of its own layer. The stray light v is spread evenly; with the border "zero" it
    is weighted by :func:`retained_stray_light`. Source: Shah et al., TiDy-PSFs, ICCV 2023, equation 1.
    """
    r = bank.shape[-1] // 2
    inner = cropped(weights, r, border)
    retained = retained_stray_light(*image.shape[1:], r) if border == "zero" else 1.0
    out = np.zeros((len(image), *inner.shape[1:]))
    for c, plane in enumerate(image):
        for d in range(len(bank)):
            out[c] += inner[d] * (blur([plane], bank[d, c], border)[0] + stray[d, c] * plane.mean() * retained)
    return out


def scatter(image: Array, weights: Array, bank: Array, stray: Array, border: str) -> Array:
    r"""Return :math:`I_c = \sum_d ((O_d L_c) * h_{dc} + v_{dc} \overline{O_d L_c})`: spread.

    Each pixel spreads its own light. Source: Shah et al., TiDy-PSFs, ICCV 2023, caption of the forward model's figure.
    """
    r = bank.shape[-1] // 2
    retained = retained_stray_light(*image.shape[1:], r) if border == "zero" else 1.0
    out = np.zeros((len(image), *cropped(weights, r, border).shape[1:]))
    for c, plane in enumerate(image):
        for d in range(len(bank)):
            light = weights[d] * plane
            out[c] += blur([light], bank[d, c], border)[0] + stray[d, c] * light.mean() * retained
    return out


def occlusion(image: Array, weights: Array, bank: Array, stray: Array, border: str) -> Array:
    r"""Return the layers composited over one another from far to near, each normalised by E.

    .. math:: I \leftarrow \frac{h_d * (O_d L_d)}{E_d} + \left( 1 - \frac{h_d * O_d}{E_d} \right) I, \qquad
        E_d = h_d * \sum_{j \le d} O_j + \epsilon

    Stray light is added to the layer first: :math:`L_d = (1 - v) L + v \overline{L}`. The black beyond a border
    "zero" has no weight O, and v is then the share of stray light in the light that reaches the pixel from the image.
    Source: Ikoma et al., ICCP 2021, equation 5.
    """
    retained = retained_stray_light(*image.shape[1:], bank.shape[-1] // 2).mean() if border == "zero" else 1.0
    out = []
    for c, plane in enumerate(image):
        result: Array | float = 0.0
        for d in range(len(bank)):
            v = stray[d, c]
            if border == "zero":
                (held,) = blur([np.ones_like(plane)], bank[d, c], border)
                v = v * retained / (held.mean() + v * retained)
            lit = (1 - v) * plane + v * plane.mean()
            behind = weights[: d + 1].sum(0)
            light, alpha, seen = blur([weights[d] * lit, weights[d], behind], bank[d, c], border)
            normaliser = np.maximum(seen, 0) + EPSILON
            result = light / normaliser + (1 - alpha / normaliser) * result
        out.append(result)
    return np.stack(out)


COMPOSITING: dict[str, Callable[..., Array]] = {"gather": gather, "scatter": scatter, "occlusion": occlusion}


def stray_light(states: Array, shares: Sequence[float], choice: str) -> tuple[Array, Array]:
    """Return PSFs (S, D, C, P, P) and stray light (S, D, C) of the states, with light outside the window dealt with.

    "renormalize" multiplies all states by the one factor that makes the exposure's average PSF sum to one, "discard"
    loses the light, "veil" spreads it over the image.
    """
    held = states.sum((-2, -1))
    if choice == "renormalize":
        return states / np.einsum("s,sdc->dc", np.asarray(shares), held)[..., None, None], np.zeros_like(held)
    return states, np.zeros_like(held) if choice == "discard" else 1 - held


def capture(
    image: Array, weights: Array, states: Array, shares: Sequence[float], compositing: str, border: str, choice: str
) -> Array:
    """Return the linear image of one exposure: the images of all states, averaged with their shares of the time.

    Occlusion normalises PSFs by their light, so there stray light is dealt with for each state by itself.
    """
    alone = compositing == "occlusion"
    out: Array | float = 0.0
    for s, share in enumerate(shares):
        among, time = (states[s : s + 1], [1.0]) if alone else (states, shares)
        bank, stray = stray_light(among, time, choice)
        n = 0 if alone else s
        out = out + share * COMPOSITING[compositing](image, weights, bank[n], stray[n], border)
    return np.asarray(out)
