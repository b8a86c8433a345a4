"""Speed of rendering, ours and others' side by side, each checked to give the same image.

Not named ``test_``: it times the real scene for minutes, which the check that every suite runs once must not.

Run with ``pytest tests/benchmarks/rendering_against_peers.py -s``. The scene is a small random one and, where the
shared data is present, Aloe (1110 x 1282, thin leaves: hard for tiles), its disparity laid linearly on [-20, 20] rad.
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
import pytest
import torch
from torch import Tensor
from torch.nn.functional import conv2d, pad

from kornia_tidy.render.borders import next_fast_size
from kornia_tidy.render.compositing import render
from tests.base import DATA
from tests.render.scenes import Bank

ROUNDS = 7
Name = TypeVar("Name", bound=Hashable)


def load_scene(name: str) -> tuple[Tensor, Tensor]:
    if name == "small":
        torch.manual_seed(0)
        y, x = torch.meshgrid(torch.linspace(-20, 20, 96), torch.linspace(0, 9, 120), indexing="ij")
        return torch.rand(1, 3, 96, 120), (y * torch.sin(x)).reshape(1, 1, 96, 120)
    if not DATA.is_dir():
        pytest.skip("the real scenes of ../shared/data are not on this machine")
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


def occlusion_by_transforms(image: Tensor, psi: Tensor, bank: Bank) -> Tensor:
    """Ours as it is without a C compiler."""
    return render(image, psi, bank, "occlusion", layers="nearest", method="batched")


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


@pytest.mark.parametrize("scene", ["small", "aloe"])
@pytest.mark.parametrize("renderer", RENDERERS)
def test_gather_21_nearest_layers_23_pixels(benchmark, renderer, scene):
    image, psi = load_scene(scene)
    bank = make_bank(21, 23)
    coded = benchmark.pedantic(RENDERERS[renderer], (image, psi, bank), rounds=ROUNDS, warmup_rounds=1)
    if renderer != "round_trip":
        torch.testing.assert_close(coded, dense(image, psi, bank), rtol=0, atol=2e-6)


@pytest.mark.parametrize("scene", ["small", "aloe"])
@pytest.mark.parametrize("compositing", ["gather", "scatter"])
@pytest.mark.parametrize(
    ("layers", "count", "size"),
    [("nearest", 21, 23), ("linear", 21, 23), ("linear", 201, 23), ("nearest", 21, 41), ("nearest", 21, 65)],
)
def test_tiled_render(benchmark, compositing, layers, count, size, scene):
    image, psi = load_scene(scene)
    bank = make_bank(count, size)
    coded = benchmark.pedantic(render, (image, psi, bank, compositing), {"layers": layers}, rounds=ROUNDS)
    assert coded.shape == image.shape


@pytest.mark.parametrize("scene", ["small", "aloe"])
@pytest.mark.parametrize("compositing", ["gather", "scatter"])
@pytest.mark.parametrize("method", ["auto", "dense"])
def test_training_batch_forward_and_backward_to_the_psfs(benchmark, compositing, method, scene):
    """8 crops of 278 x 278, as the paper's patches; of the small scene two of 60 x 60."""
    image, psi = load_scene(scene)
    count, side = (8, 278) if scene == "aloe" else (2, 60)
    corners = [(100 * i, 120 * i) if scene == "aloe" else (10 * i, 20 * i) for i in range(count)]
    image, psi = (
        torch.cat([x[..., top : top + side, left : left + side] for top, left in corners]) for x in (image, psi)
    )
    bank = make_bank(21, 23)

    def step():
        psfs = bank.psfs.clone().requires_grad_()
        own = Bank(psfs, bank.defocus)
        render(image, psi, own, compositing, layers="nearest", border="valid", method=method).square().sum().backward()
        return psfs.grad

    assert torch.isfinite(benchmark.pedantic(step, rounds=ROUNDS, warmup_rounds=1)).all()


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


@pytest.mark.parametrize("scene", ["small", "aloe"])
def test_ratios_within_one_run(scene):
    image, psi = load_scene(scene)
    bank = make_bank(21, 23)
    medians = in_turn({name: lambda f=f: f(image, psi, bank) for name, f in RENDERERS.items()})
    print(f"\n{scene}, 21 nearest layers, 23-pixel PSFs, {torch.get_num_threads()} threads")
    for name, own in medians.items():
        print(f"{name:14} {own:9.1f} ms  {own / medians['tiled']:6.2f} x tiled")
    assert all(own > 0 for own in medians.values())


@pytest.mark.parametrize("scene", ["small", "aloe"])
def test_occlusion_against_the_stack_of_all_layers(scene):
    """The float64 stack is the reference; in float32, as its authors run it, it is timed and its error printed."""
    image, psi = load_scene(scene)
    bank = make_bank(21, 23)
    coded = tiled_occlusion(image, psi, bank)
    expected = ikoma_stack(image.double(), psi, bank).float()
    torch.testing.assert_close(coded, expected, rtol=0, atol=2e-5)
    error = float((ikoma_stack(image, psi, bank) - expected).abs().max())
    candidates = {
        f.__name__: lambda f=f: f(image, psi, bank) for f in (tiled_occlusion, occlusion_by_transforms, ikoma_stack)
    }
    medians = in_turn(candidates, 3 if scene == "aloe" else ROUNDS)
    print(
        f"\n{scene}, 21 nearest layers, 23-pixel PSFs, {torch.get_num_threads()} threads; float32 stack off {error:.1e}"
    )
    for name, own in medians.items():
        print(f"{name:16} {own:9.1f} ms  {own / medians['tiled_occlusion']:6.2f} x tiled occlusion")
    assert all(own > 0 for own in medians.values())


@pytest.mark.parametrize("scene", ["small", "aloe"])
@pytest.mark.parametrize(("layers", "size"), [("nearest", 23), ("linear", 23), ("nearest", 41)])
def test_tiled_occlusion(benchmark, layers, size, scene):
    image, psi = load_scene(scene)
    bank = make_bank(21, size)
    coded = benchmark.pedantic(render, (image, psi, bank, "occlusion"), {"layers": layers}, rounds=ROUNDS)
    assert coded.shape == image.shape
