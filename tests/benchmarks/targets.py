"""The figures that rendering is judged by, as one table: ours and the straightforward ways, in turns, in one process.

``python -m tests.benchmarks.targets [row ...]`` on a machine that does nothing else; minutes. The scene is Aloe
(1110 x 1282, thin leaves: hard for tiles), its disparity laid linearly on [-20, 20] rad; K = 5 masks, 21 nearest
layers, PSFs of 23 x 23 pixels, float32, unless a row says otherwise. Medians of 7.
"""

from __future__ import annotations

import argparse
import platform
import subprocess
import sys
from collections.abc import Callable, Iterator
from datetime import UTC, datetime

import torch
from torch import Tensor
from torch.nn.functional import interpolate, pad

from kornia_tidy import DefocusRange, Fidelity, PixelwiseMask, TiDyOptics
from kornia_tidy.design.tradeoff.costs import peak_bytes
from kornia_tidy.optics import camera_spectrum
from kornia_tidy.render import render
from kornia_tidy.render.borders import next_fast_size
from tests.benchmarks.rendering_against_peers import (
    RENDERERS,
    ikoma_stack,
    in_turn,
    labels_of,
    load_aloe,
    make_bank,
    tiled_occlusion,
)
from tests.render.scenes import Bank

MASKS, LAYERS, WINDOW = 5, 21, 23
Row = tuple[str, str, str, float, str]  # number, what, against what, ratio, target


def by_captures(image: Tensor, psi: Tensor, states: Tensor, nodes: Tensor) -> Tensor:
    """The straightforward loop: a capture for each mask, a dense product and inverse transform for each layer."""
    height, width = image.shape[-2:]
    radius = states.shape[-1] // 2
    padded = pad(image, (radius,) * 4, mode="reflect")
    size = [next_fast_size(n) for n in padded.shape[-2:]]
    label = labels_of(psi, Bank(states[0], nodes))
    captures = []
    for psfs in states:
        spectrum = torch.fft.rfft2(padded, s=size)
        coded = torch.zeros_like(image)
        for layer, psf in enumerate(psfs):
            blurred = torch.fft.irfft2(spectrum * torch.fft.rfft2(psf, s=size), s=size)
            inside = blurred[..., 2 * radius : 2 * radius + height, 2 * radius : 2 * radius + width]
            coded = coded + (label == layer) * inside
        captures.append(coded)
    return torch.stack(captures).mean(0)


def ours(image: Tensor, psi: Tensor, states: Tensor, nodes: Tensor) -> Tensor:
    return render(image, psi, Bank(states.mean(0), nodes), layers="nearest")


def make_states() -> tuple[Tensor, Tensor]:
    torch.manual_seed(2)
    states = torch.rand(MASKS, LAYERS, 3, WINDOW, WINDOW) ** 4
    return states / states.sum((-2, -1), keepdim=True), torch.linspace(-20, 20, LAYERS)


def make_optics(masks: int = MASKS, fidelity: Fidelity | None = None, **options) -> TiDyOptics:
    """Return a camera fitted to the scene's depths, without noise and encoding, so that only the optics is timed."""
    exact = Fidelity(window=WINDOW, layers="nearest", layer_spacing=2.0) if fidelity is None else fidelity
    torch.manual_seed(0)
    return TiDyOptics(
        PixelwiseMask(masks),
        camera=DefocusRange(-20, 20),
        sensor=None,
        color_space="linear",
        fidelity=exact,
        check_inputs=False,
        **options,
    )


def ratio(number: str, what: str, against: str, calls: dict[str, Callable[[], object]], target: str) -> Row:
    """The first call's time over the second's, or the other way round where the second is the slow one."""
    first, second = in_turn(calls).values()
    print(f"  {number}: {first:.1f} ms, {second:.1f} ms", file=sys.stderr)
    return number, what, against, second / first if target.startswith("≥") else first / second, target


def loop_rows(image: Tensor, psi: Tensor) -> Iterator[Row]:
    states, nodes = make_states()
    torch.testing.assert_close(
        ours(image, psi, states, nodes), by_captures(image, psi, states, nodes), rtol=0, atol=2e-6
    )
    calls = {
        "ours": lambda: ours(image, psi, states, nodes),
        "loop": lambda: by_captures(image, psi, states, nodes),
    }
    yield ratio("1", "capture", "loop of K captures", calls, "≥ 80")


def peer_rows(image: Tensor, psi: Tensor) -> Iterator[Row]:
    bank = make_bank(LAYERS, WINDOW)
    times = in_turn({name: lambda f=f: f(image, psi, bank) for name, f in RENDERERS.items()})
    print("  " + ", ".join(f"{name} {own:.1f} ms" for name, own in times.items()), file=sys.stderr)
    yield "2", "render", "averaged dense FFT loop", times["dense"] / times["tiled"], "≥ 10"
    yield "2", "render", "one conv2d over all layers", times["by_one_conv2d"] / times["tiled"], "≥ 10"
    yield "3", "render", "one rfft2 + irfft2 of the image", times["tiled"] / times["round_trip"], "≤ 3"
    yield "12", "render", "cv2.filter2D per layer", times["by_opencv"] / times["tiled"], "> 1"
    yield "12", "render", "kornia fft_conv per layer", times["by_kornia"] / times["tiled"], "> 1"


def learning_rows(image: Tensor, psi: Tensor) -> Iterator[Row]:
    optics = make_optics()
    disparity = (psi + 20) / 40
    weights = torch.rand(image.shape)

    def step() -> Tensor:
        optics.masks.phase.grad = None
        (optics(image, disparity) * weights).sum().backward()
        return optics.masks.phase.grad

    singles = [make_optics(1) for _ in range(MASKS)]
    for k, single in enumerate(singles):
        single.masks.phase = torch.nn.Parameter(optics.masks.phase.detach()[k : k + 1].clone())
    nodes = torch.tensor(optics.defocus_nodes)

    def loop_step() -> Tensor:
        # The mean of unscaled PSFs, scaled by the light of the mean: what one exposure records.
        banks = [
            single.psf_model._computed_bank(single.spectrum, torch.float32, single.defocus_nodes) for single in singles
        ]
        held = torch.stack([bank.energy for bank in banks]).mean(0)[..., None, None]
        states = torch.stack([bank.psfs / held for bank in banks])
        for single in singles:
            single.masks.phase.grad = None
        (by_captures(image, psi, states, nodes) * weights).sum().backward()
        return torch.cat([single.masks.phase.grad for single in singles])

    expected = loop_step()
    torch.testing.assert_close(step(), expected, rtol=0, atol=2e-3 * float(expected.abs().max()))
    yield ratio("4", "forward and backward to the masks", "that loop", {"ours": step, "loop": loop_step}, "≥ 40")


def batch_rows(image: Tensor, psi: Tensor) -> Iterator[Row]:
    corners = [(100 * i, 120 * i) for i in range(8)]
    crops, maps = (torch.cat([x[..., t : t + 278, left : left + 278] for t, left in corners]) for x in (image, psi))
    bank = make_bank(LAYERS, WINDOW)

    def step(method: str) -> Tensor | None:
        psfs = bank.psfs.clone().requires_grad_()
        options = {"layers": "nearest", "border": "valid", "method": method}
        render(crops, maps, Bank(psfs, bank.defocus), **options).square().sum().backward()
        return psfs.grad

    calls = {"tiled": lambda: step("auto"), "dense": lambda: step("dense")}
    yield ratio("5", "training batch 8x3x278x278, forward and backward", "dense FFT loop", calls, "≥ 8")


@torch.no_grad()
def state_rows(image: Tensor, psi: Tensor) -> Iterator[Row]:
    disparity = (psi + 20) / 40
    few, many = make_optics(1), make_optics(16)
    yield ratio("6", "K = 16, bank included", "K = 1", fresh(image, disparity, many, few), "≤ 1.3")
    cached = {"16": lambda: many(image, disparity), "1": lambda: few(image, disparity)}
    yield ratio("6", "K = 16, bank cached", "K = 1", cached, "≤ 1.03")


@torch.no_grad()
def depth_rows(image: Tensor, psi: Tensor) -> Iterator[Row]:
    disparity = (psi + 20) / 40
    nearest = make_optics()
    cubic = nearest.with_fidelity(Fidelity(window=WINDOW, layers="cubic", layer_spacing=1.0))
    calls = {"cubic": lambda: cubic(image, disparity), "nearest": lambda: nearest(image, disparity)}
    yield ratio("7", "cubic, 1 rad apart", "21 nearest layers", calls, "≤ 3")
    many, few = make_bank(201, WINDOW), make_bank(LAYERS, WINDOW)
    calls = {
        "linear": lambda: render(image, psi, many, layers="linear"),
        "nearest": lambda: render(image, psi, few, layers="nearest"),
    }
    yield ratio("7", "201 linear layers", "21 nearest layers", calls, "≤ 3")


@torch.no_grad()
def colour_rows(image: Tensor, psi: Tensor) -> Iterator[Row]:
    disparity = (psi + 20) / 40
    many, few = make_optics(spectrum=camera_spectrum(samples=31)), make_optics()
    yield ratio("8", "31 wavelengths, bank included", "3 wavelengths", fresh(image, disparity, many, few), "≤ 1.6")
    cached = {"31": lambda: many(image, disparity), "3": lambda: few(image, disparity)}
    yield ratio("8", "31 wavelengths, rendering alone", "3 wavelengths", cached, "≤ 1.0")


def occlusion_rows(image: Tensor, psi: Tensor) -> Iterator[Row]:
    bank = make_bank(LAYERS, WINDOW)
    expected = ikoma_stack(image.double(), psi, bank).float()
    torch.testing.assert_close(tiled_occlusion(image, psi, bank), expected, rtol=0, atol=2e-5)
    calls = {"tiled": lambda: tiled_occlusion(image, psi, bank), "stack": lambda: ikoma_stack(image, psi, bank)}
    yield ratio("9, 12", "occlusion-aware", "Ikoma's equations as a dense FFT stack", calls, "≥ 10")


@torch.no_grad()
def size_rows(image: Tensor, psi: Tensor) -> Iterator[Row]:
    optics = TiDyOptics(camera=DefocusRange(-20, 20), fidelity=Fidelity(window=WINDOW, layers="nearest"))
    small = image, (psi + 20) / 40
    large = tuple(interpolate(x, scale_factor=4.1, mode="nearest") for x in small)
    times = list(in_turn({"large": lambda: optics(*large), "small": lambda: optics(*small)}, rounds=5).values())
    pixels = large[1].numel() / small[1].numel()
    yield (
        "10",
        f"{large[1].numel() / 1e6:.0f} Mpixel, noise and colour, a pixel",
        "1.4 Mpixel",
        (times[0] / times[1] / pixels),
        "≤ 1.2",
    )
    taken = peak_bytes(lambda: optics(*large), image.device) - 4 * large[0].numel()
    yield "10", "its peak memory beyond image and capture", "1 GiB", taken / 2**30, "≤ 1"


def fresh(image: Tensor, disparity: Tensor, *cameras: TiDyOptics) -> dict[str, Callable[[], object]]:
    """Captures that compute their PSFs anew."""

    def capture(optics: TiDyOptics) -> Tensor:
        optics.masks.phase.data.add_(1e-4)  # so that no PSF is remembered
        return optics(image, disparity)

    return {str(number): lambda o=optics: capture(o) for number, optics in enumerate(cameras)}


ROWS = {
    "1": loop_rows,
    "2": peer_rows,
    "4": learning_rows,
    "5": batch_rows,
    "6": state_rows,
    "7": depth_rows,
    "8": colour_rows,
    "9": occlusion_rows,
    "10": size_rows,
}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", nargs="*", metavar="row", choices=[*ROWS, []], help="numbers of rows (default: all)")
    wanted = parser.parse_args().rows
    image, psi = load_aloe()
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    print(
        f"{platform.processor() or platform.machine()}, {torch.get_num_threads()} threads, torch {torch.__version__}, "
        f"{datetime.now(UTC):%Y-%m-%d}, commit {commit.stdout.strip()}\n"
    )
    print("| # | ours | against | ratio | target |\n|---|---|---|---|---|")
    for number, rows in ROWS.items():
        if not wanted or number in wanted:
            for row, what, against, value, target in rows(image, psi):
                print(f"| {row} | {what} | {against} | {value:.2f} | {target} |", flush=True)


if __name__ == "__main__":
    main()
