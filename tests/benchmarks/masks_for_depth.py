"""Do several masks give better depth than the best single one? ``python -m tests.benchmarks.masks_for_depth FOLDER``.

For each of three seeds, one mask and five are designed with the aperture and the focus, for depth alone or for the
image, too (``--depth-weight``), by the same numbers of candidates and gradient steps:
:func:`kornia_tidy.design.co_design` at 57,000 electrons. Scenes are
those of :mod:`tests.benchmarks.when_coding_pays`: half A chooses the finalist and its settings, half B scores it. Each
design is kept in FOLDER as ``kornia-tidy design`` writes it; the same command goes on where it stopped.
"""

from __future__ import annotations

import argparse
import statistics
from itertools import product
from pathlib import Path

import torch
from tqdm import tqdm

from kornia_tidy.design.candidates import Candidate, search_lens
from kornia_tidy.design.co_design import CoDesign, Effort, co_design, planned_work
from kornia_tidy.design.design_report import design_files
from kornia_tidy.design.design_task import DesignTask, mask_of
from kornia_tidy.files import write_bytes
from tests.benchmarks.standard_error import mean_and_error
from tests.benchmarks.when_coding_pays import scenes_for

SEEDS, COUNTS = (0, 1, 2), (1, 5)
EFFORT = Effort(coarse_steps=60, steps=200, scenes=0)


def designed(folder: Path, depth_weight: float, masks: int, seed: int) -> CoDesign:
    """Return a design, and write its report."""
    task = DesignTask(masks=masks, depth_weight=depth_weight)
    scenes = scenes_for(task)
    place = folder / f"masks-{masks}-seed-{seed}"
    place.mkdir(parents=True, exist_ok=True)
    with tqdm(total=sum(planned_work(task, EFFORT, len(scenes)).values()), desc=place.name, leave=False) as bar:
        found = co_design(task, scenes, EFFORT, seed, place / "progress.json", lambda _, amount: bar.update(amount))
    for name, data in design_files(found).items():
        write_bytes(place / name, data)
    return found


def main() -> None:
    """Design, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--depth-weight", type=float, default=1.0, help="share of depth in what matters (default: 1)")
    options = parser.parse_args()
    pairs = product(SEEDS, COUNTS)
    found = {(masks, seed): designed(options.folder, options.depth_weight, masks, seed) for seed, masks in pairs}
    print("| masks | seed | from | f-number | focus | predicted RMSE | RMSE | PSNR, dB | PSFs differ | flat lens |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for (masks, seed), design in found.items():
        best, flat = design.verdict.coded, design.verdict.flat
        one = best.candidate
        print(
            f"| {masks} | {seed} | {one.start} | {one.f_number:.3g} | {one.focus:.2f} | {one.depth_error:.3f} | "
            f"{best.depth:.3f} | {best.image:.2f} | {_difference(design.task, one):.2f} | "
            f"{flat.depth:.3f}, f/{flat.candidate.f_number:.3g} |"
        )
    gains = [_gains(found[1, seed], found[5, seed]) for seed in SEEDS]
    seeds = mean_and_error([statistics.fmean(gain) for gain in gains], "+")
    scenes = mean_and_error([statistics.fmean(scene) for scene in zip(*gains, strict=True)], "+")
    print(f"\nfive masks over one, dB: {seeds} over seeds, {scenes} over the {len(gains[0])} scenes of half B")


@torch.no_grad()
def _difference(task: DesignTask, one: Candidate) -> float:
    """Return the mean difference of each mask's PSFs from their average, relative to it."""
    assert one.phase is not None
    lenses = [search_lens(task, mask_of(phase[None]), one.f_number, one.focus) for phase in one.phase]
    psfs = torch.stack([lens.psf_bank().psfs for lens in lenses])
    average = psfs.mean(0)
    return float(((psfs - average).flatten(1).norm(dim=1) / average.norm()).mean())


def _gains(one: CoDesign, five: CoDesign) -> list[float]:
    pairs = zip(five.verdict.coded.scores, one.verdict.coded.scores, strict=True)
    return [ours - theirs for ours, theirs in pairs]


if __name__ == "__main__":
    main()
