"""Rendering by other libraries and by ours, and their times in turns, for the programs that compare them.

PSFs are random. Ratios are taken within one run, the candidates in turn, from medians.
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable, Hashable, Mapping
from typing import TypeVar

import cv2
import kornia
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv2d, pad

from kornia_tidy.render import render
from kornia_tidy.render.borders import next_fast_size
from tests.base import DATA
from tests.render.scenes import Bank

ROUNDS = 7
Name = TypeVar("Name", bound=Hashable)


def load_aloe() -> tuple[Tensor, Tensor]:
    """Return Aloe (1110 x 1282, thin leaves: hard for tiles), its disparity laid linearly on [-20, 20] rad."""
    entry = next(e for e in json.loads((DATA / "scenes.json").read_text()) if "aloe" in e["image"])
    image = cv2.cvtColor(cv2.imread(str(DATA / entry["image"])), cv2.COLOR_BGR2RGB)
    disparity = cv2.imread(str(DATA / entry["depth"]), cv2.IMREAD_GRAYSCALE).astype(np.float32)
    known = disparity > 0
    lowest, highest = disparity[known].min(), disparity[known].max()
    psi = np.where(known, (disparity - lowest) / (highest - lowest) * 40 - 20, -20).astype(np.float32)
    return torch.from_numpy(image).permute(2, 0, 1)[None].contiguous() / 255, torch.from_numpy(psi)[None, None]


def make_bank(layers: int, size: int) -> Bank:
    torch.manual_seed(1)
    psfs = torch.rand(layers, 3, size, size) ** 4
    return Bank(psfs / psfs.sum((-2, -1), keepdim=True), torch.linspace(-20, 20, layers))


def labels_of(psi: Tensor, bank: Bank) -> Tensor:
    middles = (bank.defocus[1:] + bank.defocus[:-1]) / 2
    return torch.bucketize(psi, middles)


def by_one_conv2d(image: Tensor, psi: Tensor, bank: Bank) -> Tensor:
    radius = bank.psfs.shape[-1] // 2
    weight, padded = bank.psfs.flip((-2, -1)).transpose(0, 1)[:, :, None], pad(image, (radius,) * 4, mode="reflect")
    # Channel by channel: with groups=3 the same takes minutes.
    blurred = torch.stack([conv2d(padded[:, c : c + 1], weight[c]) for c in range(3)], 1)
    return blurred.gather(2, labels_of(psi, bank)[:, None].expand(-1, 3, -1, -1, -1)).squeeze(2)


def by_opencv(image: Tensor, psi: Tensor, bank: Bank) -> Tensor:
    label, planes = labels_of(psi, bank)[0, 0].numpy(), image[0].numpy()
    coded = np.empty_like(planes)
    for layer in np.unique(label):
        here = label == layer
        for c in range(3):
            psf = np.ascontiguousarray(bank.psfs[layer, c].numpy()[::-1, ::-1])
            coded[c][here] = cv2.filter2D(planes[c], -1, psf, borderType=cv2.BORDER_REFLECT_101)[here]
    return torch.from_numpy(coded)[None]


def by_kornia(image: Tensor, psi: Tensor, bank: Bank) -> Tensor:
    label, coded = labels_of(psi, bank), torch.zeros(())
    for layer in label.unique().tolist():
        blurred = kornia.filters.fft_conv(image.transpose(0, 1), bank.psfs[layer], "reflect", behaviour="conv")
        coded = torch.where(label == layer, blurred.transpose(0, 1), coded)
    return coded


def round_trip(image: Tensor, psi: Tensor, bank: Bank) -> Tensor:
    """One transform of the padded image and back: what any renderer by spectra pays at least."""
    side = bank.psfs.shape[-1] - 1
    size = [next_fast_size(n + side) for n in image.shape[-2:]]
    return torch.fft.irfft2(torch.fft.rfft2(image, s=size), s=size)[..., : image.shape[-2], : image.shape[-1]]


def tiled(image: Tensor, psi: Tensor, bank: Bank) -> Tensor:
    return render(image, psi, bank, layers="nearest")


def by_transforms(image: Tensor, psi: Tensor, bank: Bank) -> Tensor:
    """Ours as it is without a C compiler."""
    return render(image, psi, bank, layers="nearest", method="batched")


def dense(image: Tensor, psi: Tensor, bank: Bank) -> Tensor:
    return render(image, psi, bank, layers="nearest", method="dense")


def tiled_occlusion(image: Tensor, psi: Tensor, bank: Bank) -> Tensor:
    return render(image, psi, bank, "occlusion", layers="nearest")


def ikoma_stack(image: Tensor, psi: Tensor, bank: Bank) -> Tensor:
    """Ikoma's equations as written: every layer's planes in one stack, near first, transformed whole."""
    depths, side = len(bank.psfs), bank.psfs.shape[-1]
    padded = [pad(x, (side // 2,) * 4, mode="reflect") for x in (image, labels_of(psi, bank).to(image.dtype))]
    size = [next_fast_size(n) for n in padded[0].shape[-2:]]
    inner = (..., slice(side - 1, padded[0].shape[-2]), slice(side - 1, padded[0].shape[-1]))
    spectra = torch.fft.rfft2(bank.psfs.flip(0).to(image.dtype), s=size)  # (D, C, H, W)

    def blur(stack: Tensor) -> Tensor:
        return torch.fft.irfft2(torch.fft.rfft2(stack, s=size) * spectra, s=size)[inner]

    own = (padded[1][0] == torch.arange(depths - 1, -1, -1)[:, None, None]).to(image.dtype)[:, None]  # (D, 1, H, W)
    behind = own.flip(0).cumsum(0).flip(0)
    seen = blur(behind).clamp(min=0) + 1e-6
    light, opacity = blur(own * padded[0]) / seen, blur(own) / seen
    through = torch.cat([torch.ones_like(opacity[:1]), (1 - opacity[:-1]).cumprod(0)])
    return (light * through).sum(0, keepdim=True)


RENDERERS = {f.__name__: f for f in (tiled, by_transforms, dense, by_one_conv2d, by_opencv, by_kornia, round_trip)}


def in_turn(
    candidates: Mapping[Name, Callable[[], object]],
    rounds: int = ROUNDS,
    clock: Callable[[], float] = time.perf_counter,
    best: Callable[[list[float]], float] = statistics.median,
) -> dict[Name, float]:
    """Return milliseconds of each, one after the other in every round: load from outside meets all alike.

    Each is called once before. ``best`` makes one time of those of the rounds.
    """
    times: dict[Name, list[float]] = {name: [] for name in candidates}
    for call in candidates.values():
        call()
    for _ in range(rounds):
        for name, call in candidates.items():
            start = clock()
            call()
            times[name].append(1e3 * (clock() - start))
    return {name: best(own) for name, own in times.items()}
