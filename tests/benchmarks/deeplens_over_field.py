"""A picture behind a real lens by tiles with PSFs and gradients, and by DeepLens's map of PSFs, against exact pixels.

``python -m tests.benchmarks.deeplens_over_field FOLDER`` with a checkout of DeepLens (github.com/vccimaging/DeepLens,
Apache-2.0), some minutes; without one it says so and ends. Of it only ``deeplens/imgsim/psf.py`` is loaded, which needs
nothing but torch: ``conv_psf_map_depth_interp`` convolves each cell of the picture with the PSFs of all layers in its
middle and blends them linearly in inverse depth. Both are given PSFs by this library: 21 layers, five masks, the single
element at f/17.6. So neither the lens models nor the time to make PSFs are compared.

Exact pixels are rendered each through the PSFs of its own place. Dead leaves of 3,000 px each; one thread; least
processor time of some rounds, by turns.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from kornia_tidy import Fidelity, PixelwiseMask, PSFBank, TiDyOptics
from kornia_tidy.data import dead_leaves
from kornia_tidy.render import render
from kornia_tidy.render.dispatch import Rendering
from kornia_tidy.render.over_field import render_over_field
from tests.benchmarks.lens_ratio import LENS, least_times

PIXELS = 24  # that are compared


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table, or why there is none."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.deeplens_over_field", description="See the file.")
    parser.add_argument("folder", type=Path, nargs="?", default=Path(), help="of a checkout of DeepLens")
    parser.add_argument("--size", type=int, nargs=2, default=(1110, 1282), help="rows and columns (1110 1282)")
    parser.add_argument("--window", type=int, default=23, help="side of the PSFs in pixels (23)")
    parser.add_argument("--cell", type=int, default=160, help="side of DeepLens's cells in pixels (160)")
    parser.add_argument("--tolerance", type=float, default=2e-2, help="of the tiles, Fidelity.field_tolerance (0.02)")
    parser.add_argument("--rounds", type=int, default=3, help="of which the least time counts (3)")
    args = parser.parse_args(arguments)
    source = args.folder / "deeplens" / "imgsim" / "psf.py"
    if not source.is_file():
        sys.exit(f"{source}: no such file: clone github.com/vccimaging/DeepLens and name its folder")
    torch.set_num_threads(1)
    compare(_function(source), tuple(args.size), args.window, args.cell, args.tolerance, args.rounds)


def _function(source: Path) -> Callable[..., Tensor]:
    spec = importlib.util.spec_from_file_location("deeplens_psf", source)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.conv_psf_map_depth_interp


@torch.no_grad()
def compare(
    by_map: Callable[..., Tensor], size: tuple[int, int], window: int, cell: int, tolerance: float, rounds: int
) -> None:
    """Print times and largest and mean errors of both ways."""
    image, depth = (part[None] for part in dead_leaves(*size, num_leaves=size[0] * size[1] // 3000))
    masks = PixelwiseMask(5, generator=torch.Generator().manual_seed(3))
    optics = TiDyOptics(masks, fidelity=Fidelity(window=window), lens=LENS)
    psi = optics.camera.defocus(depth)
    given = []
    for own in (optics, optics.with_fidelity(optics.fidelity.replace(field_tolerance=tolerance))):
        field = own.psf_model.field_of(size)
        assert field is not None
        given.append((own.psf_model.scene_bank(3, image.dtype, psi, field=field), field))
    (fine, of_fine), (bank, field) = given  # the map's PSFs do not suffer from the tolerance of the tiles
    grid = tuple(max(1, round(side / cell)) for side in size)
    middles = [[(2 * i + 1) * side / (2 * n) - 0.5 for i in range(n)] for side, n in zip(size, grid, strict=True)]
    cells = torch.stack([fine.between(of_fine, (y, x)).psfs for y in middles[0] for x in middles[1]])
    mapped = -1 / (psi - bank.defocus[0] + 1), cells.unflatten(0, grid), -1 / (bank.defocus - bank.defocus[0] + 1)

    def tiles() -> Tensor:
        return render_over_field(image, psi, bank, field, Rendering("gather", "reflect"))

    def deeplens() -> Tensor:
        return by_map(image, *mapped, interp_mode="disparity")

    seen = tiles(), deeplens()
    generator, exact = torch.Generator().manual_seed(0), []
    places = [[int(torch.randint(window, n - window, (1,), generator=generator)) for n in size] for _ in range(PIXELS)]
    points = [tuple(p - (n - 1) / 2 for p, n in zip(place, size, strict=True)) for place in places]
    banks = optics.psf_bank(defocus=bank.defocus.tolist(), field=points)
    for n, (y, x) in enumerate(places):
        around = ..., slice(y - window, y + window + 1), slice(x - window, x + window + 1)
        own = PSFBank(banks.psfs[n], banks.defocus, banks.energy[n])
        exact.append(render(image[around], psi[around], own)[0, :, window, window])
    rows, columns = torch.tensor(places).T
    errors = [(part[0][:, rows, columns].T - torch.stack(exact)).abs() for part in seen]
    times = least_times(rounds, [tiles, deeplens])
    print("| | processor time | largest error | mean error |\n|---|---|---|---|")
    names = f"tiles, {field.nodes[0]}x{field.nodes[1]} places", f"DeepLens's map, {grid[0]}x{grid[1]} cells"
    for name, time, error in zip(names, times, errors, strict=True):
        print(f"| {name} | {time:.2f} s | {float(error.max()):.1e} | {float(error.mean()):.1e} |")
    ratios = times[1] / times[0], float(errors[1].max() / errors[0].max()), float(errors[1].mean() / errors[0].mean())
    print("| ratio | " + " | ".join(f"{ratio:.0f}" for ratio in ratios) + " |")


if __name__ == "__main__":
    main()
