"""Captures through a real lens over captures of the ideal lens, and the kernels alone, in one process by turns.

``python -m tests.benchmarks.lens_ratio``; a minute. ``--size 1110 1282`` takes the picture of the stated ratios, which
takes minutes. Dead leaves of 3,000 px each, five masks, 21 layers, one thread, the single element at f/17.6; least
processor time of some rounds.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch

from kornia_tidy import Fidelity, PixelwiseMask, TiDyOptics
from kornia_tidy.data import dead_leaves
from kornia_tidy.psf import FieldBank
from kornia_tidy.psf.field import Field
from kornia_tidy.render.dispatch import Rendering, render_layers
from kornia_tidy.render.over_field import render_over_field
from tests.benchmarks.rendering_against_peers import in_turn

WINDOWS = (23, 61)
LENS = "single-50mm"


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.lens_ratio", description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, nargs=2, default=(278, 321), help="rows and columns (278 321)")
    parser.add_argument("--rounds", type=int, default=5, help="of which the least time counts (5)")
    parser.add_argument("--compositing", nargs="+", default=["gather", "scatter"], help="(gather scatter)")
    args = parser.parse_args(arguments)
    torch.set_num_threads(1)
    print("| compositing | window | places | kernel | gradient of PSFs | capture | capture with new PSFs |")
    print("|---|---|---|---|---|---|---|")
    for compositing in args.compositing:
        for window in WINDOWS:
            row = ratios(tuple(args.size), window, compositing, args.rounds)
            print(f"| {compositing} | {window} px | {' | '.join(row)} |", flush=True)


def ratios(size: tuple[int, int], window: int, compositing: str, rounds: int) -> list[str]:
    """Return the number of places over the field, and times over those of the ideal lens in words."""
    image, depth = (part[None] for part in dead_leaves(*size, num_leaves=size[0] * size[1] // 3000))
    field_center = 555 - size[0] / 2, 641 - size[1] / 2  # a crop of the corner of 1110 x 1282 px

    def camera(lens: str | None) -> TiDyOptics:
        masks, fidelity = PixelwiseMask(5, generator=torch.Generator().manual_seed(3)), Fidelity(window=window)
        return TiDyOptics(masks, fidelity=fidelity, compositing=compositing, lens=lens, field_center=field_center)

    ideal, real = camera(None), camera(LENS)
    psi = ideal.camera.defocus(depth)
    field = real.psf_model.field_of(size, field_center)
    assert isinstance(field, Field)
    with torch.no_grad():
        bank = real.psf_model.scene_bank(3, image.dtype, psi, field=field)
    psfs = bank.psfs.clone().requires_grad_()
    learnt = replace(bank, psfs=psfs)
    rendering = Rendering(compositing, "reflect")

    def of_axis(psfs: torch.Tensor) -> torch.Tensor:
        return render_layers(image, psi, bank.defocus, psfs[0], None, rendering)

    def of_field(bank: FieldBank) -> torch.Tensor:
        return render_over_field(image, psi, bank, field, rendering)

    def gradient(seen: torch.Tensor) -> torch.Tensor:
        return torch.autograd.grad(seen.sum(), psfs)[0]

    with torch.no_grad():
        times = [least_times(rounds, [lambda: of_axis(bank.psfs), lambda: of_field(bank)])]
    learning = [lambda: gradient(of_axis(psfs)), lambda: gradient(of_field(learnt))]
    times.append(least_times(1 if compositing == "occlusion" else rounds, learning))
    with torch.no_grad():
        times.append(least_times(rounds, [lambda: ideal(image, depth), lambda: real(image, depth)]))
        times.append(least_times(rounds, [lambda: camera(None)(image, depth), lambda: camera(LENS)(image, depth)]))
    return [f"{field.nodes[0]}x{field.nodes[1]}", *(f"{after / before:.2f}" for before, after in times)]


def least_times(rounds: int, actions: Sequence[Callable[[], object]]) -> list[float]:
    """Return the least processor time of each action in seconds; they take turns."""
    return [1e-3 * least for least in in_turn(dict(enumerate(actions)), rounds, time.process_time, min).values()]


if __name__ == "__main__":
    main()
