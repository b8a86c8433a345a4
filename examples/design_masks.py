"""Design masks for depth and for extended depth of field, and compare them with a plain lens and the classics.

    python examples/design_masks.py --limit 10

A mask for depth makes the image of a point change as much as it can with defocus: it lowers the Cramér-Rao bound, which
no unbiased estimate beats. What comes of it is the tetrapod: two lobes that move apart along one diagonal on one side
of focus and along the other one on the other side; with --limit 20 there are three. A mask for extended depth of field
does the opposite: the image changes little, so that one filter restores it at all depths. It starts from a cubic of
15 rad, which by itself is behind the plain lens: photographs have little light at the frequencies that it saves.

Measured with the defaults (530 nm, 3000 photons, 5 of background a pixel, psi from -10 to 10 rad; 14 s on one core):

| mask         | depth: mean bound in rad | EDoF: error after restoration |
|--------------|--------------------------|-------------------------------|
| plain lens   | none in focus            | 0.0154                        |
| spiral       | 0.0656                   | 0.0159                        |
| cubic        | none in focus            | 0.0187                        |
| depth design | 0.0581                   | 0.0183                        |
| EDoF design  | 0.0862                   | 0.0119                        |

Source: Shechtman et al., Physical Review Letters 113, 133902 (2014), for depth; Prasad, Optics Letters 38(4) 585
(2013), for the spiral; Dowski and Cathey, Applied Optics 34(11) 1859 (1995), for the cubic; Diaz et al., Optics Letters
34(19) 2970 (2009), for one filter at all depths.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure

from kornia_tidy import DefocusRange, Fidelity, PixelwiseMask, Spectrum
from kornia_tidy.design.fisher_information import crlb
from kornia_tidy.design.objectives import design, restoration_error
from kornia_tidy.masks import CubicMask, PhaseMasks, SpiralMask, ZernikeMask
from kornia_tidy.psf.psf_model import PSFModel

# Light that leaves the window is lost, not given back: a mask is not rewarded for throwing light far away.
FIDELITY = Fidelity("design", pixel_tolerance=0.1, layer_spacing=1.0, window=33, stray_light="discard")


def main(arguments: Sequence[str] | None = None) -> dict[str, tuple[float, float]]:
    """Design and draw; return the mean bound (rad) and the error after restoration for each mask."""
    options = parse(arguments)
    start = time.perf_counter()
    noise = torch.Generator().manual_seed(options.seed)
    gentle = 0.5 / 55**0.5 * torch.randn(2, 55, generator=noise)  # half a radian rms to begin with
    lenses = {
        "plain lens": lens_with(PixelwiseMask(1, initial="flat"), options),
        "spiral": lens_with(SpiralMask(1, size=92, num_zones=3, initial="rotating"), options),
        "cubic": lens_with(CubicMask(15.0), options),
        "depth design": lens_with(ZernikeMask(1, initial=gentle[0]), options),
        "EDoF design": lens_with(PixelwiseMask(1, initial=CubicMask(15.0).heights().detach()), options),
    }
    depth, edof = lenses["depth design"], lenses["EDoF design"]
    design(depth.masks, lambda: crlb(depth, photons=options.photons).mean(), options.iterations, 8e-9)
    design(edof.masks, lambda: restoration_error(edof.psf_bank()), options.iterations, 8e-9)
    print("mask            mean bound in rad  error after restoration")
    scores = {}
    with torch.no_grad():
        bounds = {name: crlb(lens, photons=options.photons) for name, lens in lenses.items()}
        for name, lens in lenses.items():
            scores[name] = float(bounds[name].mean()), float(restoration_error(lens.psf_bank()))
            print(f"{name:15} {scores[name][0]:17.4f} {scores[name][1]:24.4f}")
        options.output.mkdir(parents=True, exist_ok=True)
        picture = options.output / "design_masks.png"
        draw(picture, lenses, {name: bound.numpy() for name, bound in bounds.items()})
    print(f"wrote {picture} after {time.perf_counter() - start:.0f} s")
    return scores


def lens_with(masks: PhaseMasks, options: argparse.Namespace) -> PSFModel:
    """Return the lens that all masks share, at 530 nm."""
    camera = DefocusRange(-options.limit, options.limit)
    return PSFModel(masks, camera, fidelity=FIDELITY, spectrum=Spectrum.monochrome())


def draw(path: Path, lenses: dict[str, PSFModel], bounds: dict[str, np.ndarray]) -> None:
    """Draw masks, PSFs over defocus and the bound over defocus."""
    figure = Figure(figsize=(12, 12), layout="constrained")
    montage, chart = figure.subfigures(2, 1, height_ratios=(1.9, 1))
    for row, (axes, (name, lens)) in enumerate(zip(montage.subplots(len(lenses), 8), lenses.items(), strict=True)):
        phase = lens.masks.phase[0].numpy()
        y, x = (np.indices(phase.shape) - (len(phase) - 1) / 2) * (2.3 / len(phase))
        axes[0].imshow(np.where(x**2 + y**2 <= 1 + 1e-9, phase % (2 * np.pi), np.nan), cmap="twilight")
        axes[0].set(xticks=[], yticks=[], ylabel=name)
        psfs, nodes = lens.psf_bank().psfs[:, 0].numpy(), lens.defocus_nodes
        for one, index in zip(axes[1:], np.linspace(0, len(nodes) - 1, 7).round().astype(int), strict=True):
            one.imshow(np.sqrt(psfs[index] / psfs[index].max()), cmap="magma")
            one.set(xticks=[], yticks=[], title=f"$\\psi$ = {nodes[index]:.1f} rad" if row == 0 else "")
    montage.suptitle("phase (a turn of colours is 2π), and PSFs over defocus (square root of the light)")
    axes = chart.subplots()
    for name, bound in bounds.items():
        axes.semilogy(lenses[name].defocus_nodes, np.minimum(bound, 1e3), label=name)  # in focus a plain lens has inf
    best = min(float(bound.min()) for bound in bounds.values())
    axes.set(ylim=(best / 1.5, 100 * best), xlabel="defocus ψ in rad", ylabel="√CRLB of ψ in rad")
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.2, which="both")
    axes.legend(frameon=False, ncols=len(bounds), loc="upper center")
    figure.savefig(path, dpi=100)


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--limit", type=float, default=10.0, help="largest defocus in rad either way (default: 10)")
    parser.add_argument("--photons", type=float, default=3000.0, help="photons of a point (default: 3000)")
    parser.add_argument("--iterations", type=int, default=150, help="gradient steps of each design (default: 150)")
    parser.add_argument("--seed", type=int, default=0, help="of the start of the depth design (default: 0)")
    parser.add_argument("--output", type=Path, default=Path("outputs/design_masks"), help="folder to write to")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    torch.set_num_threads(1)  # the matrices are small: more threads would wait for each other
    main()
