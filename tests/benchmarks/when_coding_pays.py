"""When do phase masks pay? Co-designs over light, depth range and number of masks, decided on real scenes.

- ``python -m tests.benchmarks.when_coding_pays run FILE.json``: designs one cell after the other and writes the file
  after each; goes on where it stopped. ``--cells N`` stops after N new ones.
- ``... table FILE.json``: prints the table as Markdown.
- ``... plot FILE.json PICTURE.png``: draws the map.

Each cell is a :func:`kornia_tidy.design.co_design`, seed 0. Scenes are real ones of ../shared/data, twelve of each
half: the middle 256 pixels, depth stretched over the range in dioptres. Half A chooses settings and finalists, half B
scores.
"""

from __future__ import annotations

import argparse
import json
import math
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import torch
from tqdm import tqdm

from kornia_tidy.data import Scene, central_crop
from kornia_tidy.design import CoDesign, DesignTask, Effort, co_design
from kornia_tidy.figures.style import ACCENT, FAINT, INK, open_chart
from kornia_tidy.files import read_json, write_bytes
from kornia_tidy.reconstruction.tasks import stretched
from tests.scenes import ENTRIES, halves, load_scene

LIGHTS = (57_000, 10_000, 2_000, 500)  # electrons of white at f/17.6
RANGES = {
    "0.298 m to inf": (0.2975, math.inf),
    "0.595 m to inf": (0.595, math.inf),
    "0.149 m to inf": (0.14875, math.inf),
}
WEIGHTS = {"image": 0.0, "depth": 1.0, "both": 0.5}
FINER = (46, 92)  # pixels along a side of masks, where they are not the usual ones
SIZE, NUMBER = 256, 12  # pixels a side of the scenes, and scenes of each half
EFFORT = Effort(coarse_steps=20, steps=60, starts=("focal sweep",), scenes=0)
DEPTH_EFFORT = Effort(coarse_steps=30, steps=100, scenes=0)  # masks that tell depth are far from a focal sweep


class Cell(NamedTuple):
    """A cell of the map."""

    matters: str
    depths: str
    masks: int
    electrons: int
    mask_size: int = DesignTask.mask_size

    def __str__(self) -> str:
        """Return its key in the file."""
        key = f"{self.matters}, {self.depths}, K = {self.masks}, {self.electrons} electrons"
        return key if self.mask_size == DesignTask.mask_size else f"{key}, {self.mask_size} px"


def cells() -> list[Cell]:
    """Return all cells, the most wanted first."""
    first, less, more = RANGES
    usual = [
        *product(["image"], [first], (5, 1), LIGHTS),
        *product(["image"], [less], [5], LIGHTS),
        *product(["depth"], [first], [5], LIGHTS),
        *product(["both"], [first], [5], LIGHTS),
        *product(["image"], [more], [5], LIGHTS),
        *product(["depth"], [first], [1], LIGHTS),
        *product(["image"], [less, more], [1], LIGHTS),
        *product(["image"], [first], [2], LIGHTS),
    ]
    finer = product(["image"], [first], [5], LIGHTS, FINER)
    return [Cell(*cell) for cell in (*usual, *finer)]


def scenes_for(task: DesignTask) -> list[Scene]:
    """Return the real scenes, those of half A and half B in turn."""
    camera = task.camera(task.balanced_f_number, 0.5)
    listed = []
    first, second = halves(ENTRIES)
    for pair in zip(first[:NUMBER], second[:NUMBER], strict=True):
        for name in pair:
            image, depth, valid = load_scene(name)
            sample = {"image": image.expand(3, -1, -1), "depth": stretched(depth, valid, camera), "mask": valid}
            size = tuple(min(SIZE, side) for side in image.shape[-2:])
            cut = central_crop(sample, (size[0], size[1]))
            listed.append(Scene(cut["image"], cut["depth"], cut["mask"]))
    return listed


def row_of(design: CoDesign) -> dict[str, Any]:
    """Return the numbers of a design that the map shows."""
    verdict = design.verdict
    return {
        "words": design.words,
        "gain": verdict.gain,
        "standard_error": verdict.standard_error,
        "scenes": verdict.scenes,
        "flat_f_number": verdict.flat.candidate.f_number,
        "flat_score": verdict.flat.score,
        "coded_f_number": verdict.coded.candidate.f_number,
        "coded_score": verdict.coded.score,
        "flat_error": _finite(min(one.image_error for one in design.candidates if one.is_flat)),
        "coded_error": _finite(min(one.image_error for one in design.candidates if not one.is_flat)),
    }


def run(path: Path, most: int | None, named: str) -> None:
    """Design the cells that the file does not hold yet, of those whose key holds some words."""
    known = read_json(path) if path.exists() else {}
    todo = [cell for cell in cells() if str(cell) not in known and named in str(cell)][:most]
    for cell in tqdm(todo, desc="cells"):
        weight = WEIGHTS[cell.matters]
        task = DesignTask(
            depth_range=RANGES[cell.depths],
            electrons=cell.electrons,
            masks=cell.masks,
            depth_weight=weight,
            mask_size=cell.mask_size,
        )
        design = co_design(task, scenes_for(task), DEPTH_EFFORT if weight else EFFORT)
        known[str(cell)] = row_of(design)
        write_bytes(path, (json.dumps(known, indent=1) + "\n").encode())
        print(cell, known[str(cell)]["words"], flush=True)


def table(known: dict[str, Any]) -> str:
    """Return the map as a table of Markdown."""
    head = "| matters | depths | K | pixels | " + " | ".join(f"{light:,} e-" for light in LIGHTS) + " |"
    lines = [head, "|---" * 8 + "|"]
    rows = dict.fromkeys(cell._replace(electrons=0) for cell in cells())
    for row in rows:
        entries = [known.get(str(row._replace(electrons=light))) for light in LIGHTS]
        if any(entries):
            told = " | ".join("-" if entry is None else _entry(entry) for entry in entries)
            lines.append(f"| {row.matters} | {row.depths} | {row.masks} | {row.mask_size} | {told} |")
    return "\n".join(lines)


def _entry(entry: dict[str, Any]) -> str:
    gain = f"{entry['gain']:+.2f} ± {entry['standard_error']:.2f}"
    pays = entry["gain"] > 2 * entry["standard_error"]
    return f"{f'**{gain}**' if pays else gain} (f/{entry['coded_f_number']:.0f}, f/{entry['flat_f_number']:.0f})"


def plot(known: dict[str, Any], path: Path) -> None:
    """Draw gain over light, a panel for each range and for each of what matters."""
    from matplotlib.figure import Figure

    panels = [
        pair for pair in dict.fromkeys(cell[:2] for cell in cells()) if any(_of(known, *pair, k) for k in (5, 2, 1))
    ]
    rows = math.ceil(len(panels) / 2)
    figure = Figure(figsize=(5.2, 0.8 + 2.3 * rows), facecolor="white", layout="constrained")  # legible on a phone
    charts = figure.subplots(rows, 2, sharey=True, sharex=True, squeeze=False).flatten()
    for axes, (matters, depths) in zip(charts, panels, strict=False):
        for masks, color, shift in ((5, ACCENT, 1.0), (2, INK, 1.12), (1, FAINT, 0.89)):  # bars beside each other
            points = _of(known, matters, depths, masks)
            if points:
                lights, gains, errors = zip(*points, strict=True)
                places, bars = [light * shift for light in lights], [2 * error for error in errors]
                look = {"color": color, "marker": "o", "markersize": 5, "capsize": 3, "linewidth": 1.6}
                axes.errorbar(places, gains, bars, label=f"{masks} mask{'s' * (masks > 1)}", **look)
        axes.axhline(0, color=INK, linewidth=0.8)
        axes.set_xscale("log")
        axes.set_title(f"{matters}, {depths}", fontsize=11, color=INK)
        axes.tick_params(labelbottom=True)
        open_chart(axes, 10)
    figure.supxlabel("electrons of white at f/17.6", fontsize=11, color=INK)
    figure.supylabel("masks over the best flat lens, dB", fontsize=11, color=INK)
    if len(panels) % 2:
        charts[-1].remove()
    figure.legend(*charts[0].get_legend_handles_labels(), loc="lower right", bbox_to_anchor=(0.9, 0.12), fontsize=11,
                  frameon=False)  # fmt: skip
    figure.savefig(path, dpi=150)


def _of(known: dict[str, Any], matters: str, depths: str, masks: int) -> list[tuple[float, float, float]]:
    found = ((light, known.get(str(Cell(matters, depths, masks, light)))) for light in LIGHTS)
    return [(light, entry["gain"], entry["standard_error"]) for light, entry in found if entry]


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def main() -> None:
    """Read the command line and do what it says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=("run", "table", "plot"))
    parser.add_argument("file", type=Path)
    parser.add_argument("picture", type=Path, nargs="?")
    parser.add_argument("--cells", type=int, help="stop after so many new cells")
    parser.add_argument("--named", default="", metavar="WORDS", help="only cells whose key holds them, such as '92 px'")
    options = parser.parse_args()
    if options.action == "run":
        torch.set_num_threads(1)
        run(options.file, options.cells, options.named)
    elif options.action == "table":
        print(table(read_json(options.file)))
    else:
        plot(read_json(options.file), options.picture)


if __name__ == "__main__":
    main()
