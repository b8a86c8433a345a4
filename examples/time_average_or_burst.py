"""One exposure that averages over the masks, or a burst of one shot through each? Compared at equal light and time.

    python examples/time_average_or_burst.py --masks 4 --dead-time 0.008

In the same interval a burst loses the light of the pauses and reads out K times, but each of its shots has the PSF of
one mask. The scene is one plane, so that a linear (Wiener) filter restores it: from the averaged exposure, from the sum
of the burst, which needs no more memory, and from all shots of the burst together. For each of them and each light
level the filter's one parameter is the best of the same ladder, so that none is favoured.

With the defaults (3 electrons of read noise, pauses of 8 ms, 100 ms in all, swaps of 2 ms inside the one exposure) the
averaged exposure wins in the dark: 14.0 dB against 11.8 (sum) and 11.1 dB (all) where white is 10 electrons. From
about 200 electrons on all shots together win, by 0.8 dB at 1000 and at 30 000, for four times the memory. At equal
memory the averaged exposure is always ahead. With pauses of 25 ms, three quarters of the light lost, it also beats all
shots together at every level. Without pauses and with instant swaps the sum loses to it by its read noise only, 1.6 dB
at 10 electrons.

This is for your own number of masks, times and light. Experiment 10 of `examples/paper/` makes the same comparison with
shipped masks on several scenes, with error bars and with motion.

Source: the question is that of Shah et al., TiDy-PSFs (ICCV 2023), supplement, section 2.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import torch
from learn_point_psf import learn
from matplotlib.figure import Figure
from torch import Tensor

from kornia_tidy import SensorNoise, Switching, TiDyOptics, burst
from kornia_tidy.camera.burst import burst_shares
from kornia_tidy.data.dead_leaves import dead_leaves

EXPOSURE = 0.1  # s
LADDER = torch.logspace(-6, 1, 29).tolist()  # of the Wiener filter's parameter, noise over signal


@torch.no_grad()
def main(arguments: Sequence[str] | None = None) -> dict[str, list[float]]:
    """Take and restore all pictures; return the PSNR over the light levels for each way of taking them."""
    options = parse(arguments)
    with torch.enable_grad():
        masks = learn(options.masks, 0, options.iterations, 2e-8)[0]
    optics = TiDyOptics(
        masks.masks,
        modulator=Switching(options.switching_time, EXPOSURE, between="exponential"),
        sensor=None,
        fidelity=masks.fidelity,
        color_space="linear",
        border="circular",  # so that a Fourier transform undoes it
    )
    scene = dead_leaves(options.size, options.size, seed=1)[0].mean(0)[None, None]
    depth = torch.full_like(scene, options.depth)
    point = torch.zeros_like(scene)
    point[..., 0, 0] = 1

    pause = max(options.dead_time, options.switching_time)
    collected = float(burst_shares(torch.full((options.masks,), 1 / options.masks), pause, EXPOSURE).sum())

    def single(image: Tensor) -> Tensor:
        return optics(image, depth)[:, None]

    def shots(image: Tensor) -> Tensor:
        return burst(optics, image, depth, pause, EXPOSURE)

    def added(image: Tensor) -> Tensor:
        return shots(image).sum(1, keepdim=True)

    ways = {"one averaged exposure": single, "sum of a burst": added, "all shots of a burst": shots}
    result: dict[str, list[float]] = {name: [] for name in ways}
    for name, take in ways.items():
        optics.sensor = None
        psfs = take(point)  # the capture of a point is its PSF
        light, readouts = (1.0, 1) if take is single else (collected, options.masks)
        for electrons in options.electrons:
            optics.sensor = SensorNoise(options.read_noise / electrons, full_well=electrons, clip=False)
            torch.manual_seed(0)
            result[name].append(best_psnr(scene, take(scene), psfs))
        print(
            f"{name:>22}: {light:.0%} of the light, readouts: {readouts}, pictures stored: {psfs.shape[1]}; "
            + ", ".join(f"{p:.1f} dB at {e:g}" for p, e in zip(result[name], options.electrons, strict=True))
        )
    options.output.mkdir(parents=True, exist_ok=True)
    picture = options.output / "time_average_or_burst.png"
    draw(picture, options.electrons, result)
    print(f"wrote {picture}")
    return result


def best_psnr(scene: Tensor, captures: Tensor, psfs: Tensor) -> float:
    """Return the PSNR in dB of the best Wiener restoration of captures (1, K, 1, H, W) with known PSFs."""
    spectrum, transfer = torch.fft.rfft2(captures), torch.fft.rfft2(psfs)
    matched = (transfer.conj() * spectrum).sum(1)
    gain = (transfer.real.square() + transfer.imag.square()).sum(1)
    restored = (torch.fft.irfft2(matched / (gain + ratio), s=scene.shape[-2:]) for ratio in LADDER)
    error = min(float((image.clamp(0, 1) - scene).square().mean()) for image in restored)
    return -10 * float(torch.tensor(error).log10())


def draw(path: Path, electrons: Sequence[float], result: dict[str, list[float]]) -> None:
    """Draw PSNR over light."""
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots()
    for name, values in result.items():
        axes.semilogx(electrons, values, "o-", label=name)
    axes.set(xlabel="electrons of a white pixel in the whole interval", ylabel="PSNR of the restored image in dB")
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.2)
    axes.legend(frameon=False)
    figure.savefig(path, dpi=110)


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--masks", type=int, default=4, help="number K of masks (default: 4)")
    parser.add_argument("--dead-time", type=float, default=0.008, help="seconds of a readout (default: 0.008)")
    parser.add_argument("--switching-time", type=float, default=0.002, help="seconds of a swap (default: 0.002)")
    parser.add_argument("--read-noise", type=float, default=3.0, help="of a readout, in electrons (default: 3)")
    parser.add_argument(
        "--electrons",
        type=float,
        nargs="+",
        default=[10, 30, 100, 300, 1000, 3000, 10_000, 30_000],
        help="light levels: electrons of a white pixel in the whole interval",
    )
    parser.add_argument("--depth", type=float, default=0.4, help="of the plane, in metres (default: 0.4)")
    parser.add_argument("--size", type=int, default=256, help="side of the scene in pixels (default: 256)")
    parser.add_argument("--iterations", type=int, default=100, help="steps in which masks are learnt (default: 100)")
    parser.add_argument("--output", type=Path, default=Path("outputs/time_average_or_burst"), help="folder to write to")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
