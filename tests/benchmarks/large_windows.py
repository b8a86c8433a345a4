"""Time of rendering through large PSFs in FFT round trips: one transform of the padded image and back.

``python -m tests.benchmarks.large_windows [window ...]``; minutes. The scene is Aloe (1110 x 1282), its disparity laid
linearly on [-20, 20] rad, in 8 nearest layers, float32. Backends take turns. Of each the least processor time of
``ROUNDS`` counts, because other programs can only lengthen it.

``transforms`` is the number of transformed samples of the chosen windows, their layers and PSFs, with the logarithms of
the sides, over that of a round trip: what windows cost if nothing but transforms took time, at its speed.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from math import log2, prod

import torch
from torch import Tensor

from kornia_tidy.kernels.window_sides import needed_side, size_step
from kornia_tidy.render.backends.tile_plan import BLOCKS, OVERLAPS, TileKind, cheapest_grid
from kornia_tidy.render.borders import next_fast_size
from kornia_tidy.render.compositing import render
from kornia_tidy.render.dispatch import explain
from kornia_tidy.render.scene import layered_scene
from tests.benchmarks.rendering_against_peers import load_scene, make_bank, round_trip
from tests.render.scenes import Bank

LAYERS, ROUNDS = 8, 3
WINDOWS = (65, 129, 257, 513)
LARGEST_DIRECT = 65  # px; direct convolution of larger windows takes many seconds
KINDS = {"overlap": OVERLAPS, "tiled": BLOCKS}


def least_seconds(calls: dict[str, Callable[[], object]]) -> dict[str, float]:
    """Return the least processor time of each call, the calls in turn."""
    least = dict.fromkeys(calls, float("inf"))
    for _ in range(ROUNDS):
        for name, call in calls.items():
            begun = time.process_time()
            call()
            least[name] = min(least[name], time.process_time() - begun)
    return least


def window_transforms(image: Tensor, psi: Tensor, bank: Bank, kind: TileKind) -> str:
    """Return the transforms of the chosen windows in round trips, and the windows in words."""
    scene = layered_scene(image, psi, bank.defocus, bank.psfs, layers="nearest")
    work, grid = cheapest_grid(scene.labels, LAYERS, bank.psfs.shape[-1], kind)
    side = bank.psfs.shape[-1] - 1
    plane = prod(next_fast_size(n + side) for n in image.shape[-2:])
    transforms = (work.blocks + work.pairs + work.layers) * grid.across  # of real numbers; a round trip takes two
    sides = [grid.size, grid.size]
    if kind is OVERLAPS:
        step = size_step(image.dtype)
        sides = [
            needed_side(grid.size, n, side + 1, s) for n, s in zip(image.shape[-2:], (step // 2, step), strict=True)
        ]
    samples = transforms / 2 * prod(sides) * log2(prod(sides))
    pixels = f"{grid.across} x {grid.tile}" if grid.across > 1 else grid.tile
    held = f"{pixels} px in {sides[0]} x {sides[1]}, {work.pairs / work.blocks:.1f} layers"
    return f"{samples / (plane * log2(plane)):.1f} ({held})"


def gradient_calls(image: Tensor, psi: Tensor, bank: Bank, compositing: str, methods: list[str]) -> dict:
    """Return calls that make the gradient of an image."""

    def step(method: str) -> None:
        leaf = image.clone().requires_grad_()
        render(leaf, psi, bank, compositing, layers="nearest", method=method).sum().backward()

    return {f"image gradient, {method}": lambda m=method: step(m) for method in methods}


def measure(window: int) -> None:
    """Print the rows of one window."""
    image, psi = load_scene("aloe")
    bank = make_bank(LAYERS, window)
    scene = layered_scene(image, psi, bank.defocus, bank.psfs, layers="nearest")
    print(explain(scene), file=sys.stderr)
    methods = ["overlap", "tiled", "dense", *(["direct"] if window <= LARGEST_DIRECT else [])]
    calls: dict[str, Callable[[], object]] = {"round trip": lambda: round_trip(image, psi, bank)}
    for method in methods:
        calls[f"gather, {method}"] = lambda m=method: render(image, psi, bank, layers="nearest", method=m)
    for method in ("overlap", "tiled", "dense"):
        calls[f"scatter, {method}"] = lambda m=method: render(image, psi, bank, "scatter", layers="nearest", method=m)
    calls |= gradient_calls(image, psi, bank, "gather", ["overlap"])
    times = least_seconds(calls)
    unit = times.pop("round trip")
    for name, seconds in times.items():
        kind = KINDS.get(name.removeprefix("gather, "))
        bound = window_transforms(image, psi, bank, kind) if kind else ""
        print(f"| {window} | {name} | {1e3 * seconds:.0f} | {seconds / unit:.2f} | {bound} |", flush=True)


def main(windows: list[int]) -> None:
    torch.set_num_threads(1)
    print("| window | call | ms | round trips | transforms |\n|---|---|---|---|---|")
    for window in windows:
        measure(window)


if __name__ == "__main__":
    main([int(word) for word in sys.argv[1:]] or list(WINDOWS))
