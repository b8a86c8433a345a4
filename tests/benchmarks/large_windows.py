"""Time of rendering through large PSFs in FFT round trips: one transform of the padded image and back.

``python -m tests.benchmarks.large_windows [window ...]``; minutes. The scene is Aloe (1110 x 1282), its disparity laid
linearly on [-20, 20] rad, in 8 nearest layers, float32. Backends take turns. Of each the least processor time of
``ROUNDS`` counts, because other programs can only lengthen it.

``operations`` are those that the backend counts, over those of a round trip: what it costs if nothing but its
transforms took time, at the speed of a round trip's.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import torch
from torch import Tensor

from kornia_tidy.render.backend import transform_operations
from kornia_tidy.render.compositing import render
from kornia_tidy.render.dispatch import explain
from kornia_tidy.render.scene import layered_scene
from tests.benchmarks.rendering_against_peers import in_turn, load_scene, make_bank, round_trip
from tests.render.scenes import Bank

LAYERS, ROUNDS = 8, 3
WINDOWS = (65, 129, 257, 513)
METHODS = ("compiled", "batched", "dense")


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
    explanation = explain(scene)
    print(explanation, file=sys.stderr)
    calls: dict[str, Callable[[], object]] = {"round trip": lambda: round_trip(image, psi, bank)}
    for method in METHODS:
        calls[f"gather, {method}"] = lambda m=method: render(image, psi, bank, layers="nearest", method=m)
    for method in METHODS:
        calls[f"scatter, {method}"] = lambda m=method: render(image, psi, bank, "scatter", layers="nearest", method=m)
    calls |= gradient_calls(image, psi, bank, "gather", ["compiled"])
    times = in_turn(calls, ROUNDS, time.process_time, min)
    unit = times.pop("round trip")
    trip = 2 * image.shape[1] * transform_operations(*scene.padded_size)
    for name, own in times.items():
        work = explanation.works.get(name.removeprefix("gather, "))
        bound = f"{work.operations / trip:.1f}" if work else ""
        print(f"| {window} | {name} | {own:.0f} | {own / unit:.2f} | {bound} |", flush=True)


def main(windows: list[int]) -> None:
    torch.set_num_threads(1)
    print("| window | call | ms | round trips | operations |\n|---|---|---|---|---|")
    for window in windows:
        measure(window)


if __name__ == "__main__":
    main([int(word) for word in sys.argv[1:]] or list(WINDOWS))
