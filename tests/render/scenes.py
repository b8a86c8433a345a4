"""What the scene tests share: small banks and scenes, and the forward model written as sums over pixels."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from tests import oracle


@dataclass(frozen=True)
class Bank:
    """A stand-in for a PSF bank: what the renderer's protocol asks for and nothing else."""

    psfs: Tensor
    defocus: Tensor
    veil: Tensor | None = None

    def to(self, dtype: torch.dtype) -> Bank:
        veil = None if self.veil is None else self.veil.to(dtype)
        return replace(self, psfs=self.psfs.to(dtype), veil=veil)


def make_bank(layers=4, channels=3, size=5, *, dtype=torch.float64, device="cpu", light=1.0, veil=False) -> Bank:
    """Random PSFs with no symmetry that hold ``light`` of the light, at uneven nodes; the veil holds the rest."""
    psfs = torch.rand(layers, channels, size, size, dtype=dtype, device=device)
    psfs = light * psfs / psfs.sum((-2, -1), keepdim=True)
    nodes = torch.tensor([-20.0, -11.0, -4.0, 0.0, 7.0, 20.0], dtype=dtype, device=device)[:layers]
    return Bank(psfs, nodes, 1 - psfs.sum((-2, -1)) if veil else None)


def make_scene(bank: Bank, batch=2, height=9, width=12) -> tuple[Tensor, Tensor]:
    """A random image and a random defocus map that reaches a little beyond the bank's nodes."""
    like = {"dtype": bank.psfs.dtype, "device": bank.psfs.device}
    image = torch.rand(batch, bank.psfs.shape[1], height, width, **like)
    lowest, highest = bank.defocus[0] - 2, bank.defocus[-1] + 2
    return image, lowest + (highest - lowest) * torch.rand(batch, 1, height, width, **like)


def squares(bank: Bank, height: int, width: int, side: int = 11) -> Tensor:
    """Return a defocus map of squares, (1, 1, H, W): tiles of one layer and of several."""
    y, x = torch.arange(height)[:, None] // side, torch.arange(width) // side
    return bank.defocus[((y * 3 + x * 5) % len(bank.defocus)).to(bank.defocus.device)][None, None]


HARD = ("one layer", "checkerboard", "half way", "slope", "steep ramp", "squares", "speck", "noise", "columns")


def hard_depth(kind: str, bank: Bank, height: int, width: int) -> Tensor:
    """Return a defocus map that is hard on tiles, (1, 1, H, W).

    But for a slope, and half way between layers, it is at the bank's nodes in one half of the picture and between them
    in the other: pixels of two layers beside those of one.
    """
    nodes, count = bank.defocus, len(bank.defocus)
    y, x = torch.arange(height)[:, None], torch.arange(width)
    if kind == "slope":
        return nodes[0] + (nodes[-1] - nodes[0]) * (x / width).to(nodes).expand(1, 1, height, width)
    label = {
        "one layer": torch.full((height, width), 2),
        "checkerboard": y * 3 + x,
        "half way": y // 3 + x,
        "steep ramp": (y + 2 * x) * count // (height + 2 * width),
        "squares": y // 11 * 3 + x // 13 * 5,
        "speck": 1 + 3 * ((y == height // 2) & (x == width // 3)).long(),
        "noise": torch.randint(count, (height, width)),
        "columns": (x % 2 * 3).expand(height, width),
    }[kind] % count
    if kind == "half way":
        return (nodes[label] + nodes[(label + 1).clamp(max=count - 1)])[None, None] / 2
    psi = nodes[label][None, None]
    return psi + torch.where(x < width // 2, 1.5 * torch.rand(height, width), 0).to(psi)


def modelled(image: Tensor, defocus: Tensor, bank: Bank, compositing: str, border: str) -> Tensor:
    """Return what tests/oracle makes of the first scene of a batch with nearest layers."""
    weights = oracle.layer_weights(defocus[0, 0].numpy(), bank.defocus.tolist(), "nearest")
    psfs = bank.psfs.numpy()[None]
    return torch.from_numpy(oracle.capture(image[0].numpy(), weights, psfs, [1.0], compositing, border, "discard"))


def brute_weights(psi: np.ndarray, nodes: np.ndarray, mode: str) -> np.ndarray:
    """(D, H, W) weights of an (H, W) defocus map: NumPy's interpolation of each unit vector, or the nearest node."""
    if mode == "linear":
        return np.stack([np.interp(psi, nodes, unit) for unit in np.eye(len(nodes))])
    label = np.abs(psi[..., None] - nodes).argmin(-1)
    return np.stack([label == d for d in range(len(nodes))]).astype(float)


def _source(index: int, size: int, border: str) -> int | None:
    """The pixel that stands at ``index`` once the image goes on beyond its border; None is black."""
    if 0 <= index < size:
        return index
    if border == "zero":
        return None
    if border == "replicate":
        return min(max(index, 0), size - 1)
    if border == "circular":
        return index % size
    return -index if index < 0 else 2 * (size - 1) - index


def brute_blur(plane: np.ndarray, psf: np.ndarray, border: str) -> np.ndarray:
    """Convolution as four loops: each output pixel adds up what the PSF brings to it."""
    height, width = plane.shape
    radius = len(psf) // 2
    edge = radius if border == "valid" else 0
    out = np.zeros((height - 2 * edge, width - 2 * edge))
    for y, x in np.ndindex(*out.shape):
        for i, j in np.ndindex(*psf.shape):
            row = _source(y + edge + radius - i, height, border)
            column = _source(x + edge + radius - j, width, border)
            if row is not None and column is not None:
                out[y, x] += psf[i, j] * plane[row, column]
    return out


def brute_share_within(height: int, width: int, radius: int) -> np.ndarray:
    """The share of each pixel's stray light that stays in the frame, pixel by pixel: the rings' inverse square law."""
    out = np.zeros((height, width))
    for y, x, i, j in np.ndindex(height, width, height, width):
        k = max(abs(y - i), abs(x - j))
        if k > radius:
            out[y, x] += (radius + 0.5) / ((k - 0.5) * (k + 0.5) * 8 * k)
    return out


def brute_render(image, psi, bank: Bank, *, compositing: str, layers: str, border: str) -> Tensor:
    """The forward model from its formula for a batch of tiny images, in NumPy's float64."""
    nodes, psfs = bank.defocus.double().cpu().numpy(), bank.psfs.double().cpu().numpy()
    veil = np.zeros(psfs.shape[:2]) if bank.veil is None else bank.veil.double().cpu().numpy()
    crop = psfs.shape[-1] // 2 if border == "valid" else 0
    stays = brute_share_within(*image.shape[-2:], psfs.shape[-1] // 2) if border == "zero" else 1
    out = []
    for b in range(len(image)):
        weights = brute_weights(psi[b % len(psi), 0].double().cpu().numpy(), nodes, layers)
        inner = weights[:, crop : weights.shape[1] - crop, crop : weights.shape[2] - crop]
        for c, plane in enumerate(image[b].double().cpu().numpy()):
            if compositing == "gather":
                terms = [
                    o * (brute_blur(plane, h, border) + v * plane.mean() * stays)
                    for o, h, v in zip(inner, psfs[:, c], veil[:, c], strict=True)
                ]
            elif compositing == "occlusion":
                terms = [brute_occlusion(plane, weights, psfs[:, c], veil[:, c], border)]
            else:
                terms = [
                    brute_blur(o * plane, h, border) + v * (o * plane).mean() * stays
                    for o, h, v in zip(weights, psfs[:, c], veil[:, c], strict=True)
                ]
            out.append(sum(terms))
    return torch.from_numpy(np.stack(out)).reshape(*image.shape[:2], *out[0].shape).to(image.device)


def brute_occlusion(plane, weights, psfs, veil, border: str) -> np.ndarray:
    """Ikoma's layers over one another, the far ones first: each lets through what it does not hide."""
    image = np.zeros_like(brute_blur(plane, psfs[0], border))
    if border == "zero":  # of the light seen, as much is stray as the rest leaves
        held = np.array([brute_blur(np.ones_like(plane), psf, border).mean() for psf in psfs])
        stray = veil * brute_share_within(*plane.shape, psfs.shape[-1] // 2).mean()
        veil = stray / (held + stray)
    for d in range(len(psfs)):
        seen = brute_blur(weights[: d + 1].sum(0), psfs[d], border) + 1e-6
        light = (1 - veil[d]) * plane + veil[d] * plane.mean()
        opacity = brute_blur(weights[d], psfs[d], border) / seen
        image = brute_blur(weights[d] * light, psfs[d], border) / seen + (1 - opacity) * image
    return image
