"""Scenes made to break plans: texture and depth go together, light is sparse or beyond full scale, images are tiny.

``python -m tests.accuracy.adversarial_scenes 0 1000`` judges the plans of a thousand scenes against captures of both
plan and reference, and prints for each compositing and each kind of scene how many there were, the largest error
measured over the tolerance asked, and the median of predicted over measured. Each seed is a scene, so a range can be
cut in pieces.
"""

from __future__ import annotations

import argparse
import json
import warnings
from collections import defaultdict
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from statistics import median
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor

from kornia_tidy import DefocusRange, PixelwiseMask, TiDyOptics
from kornia_tidy.accuracy.planning import planner
from kornia_tidy.accuracy.planning.planner import REFERENCE
from kornia_tidy.masks import CubicMask
from tests.accuracy.planning_rig import MASKS, Rig, smooth

COMPOSITINGS = ("gather", "scatter", "occlusion")
BORDERS = ("reflect", "replicate", "zero", "circular", "valid")
TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
NARROW = 45  # px that the reference's window may have here: of random masks it would have 257, and take minutes
MASK_KINDS = {
    "flat": lambda: PixelwiseMask(1, 11, initial="flat"),
    "random": lambda: MASKS["random"](torch.Generator().manual_seed(0)),
    "learned": lambda: MASKS["learned"](torch.Generator().manual_seed(0)),
    "cubic": lambda: CubicMask(20.0, 15),
}


@dataclass(frozen=True)
class Case:
    """A scene, the camera that takes it and the tolerance asked.

    Args:
        kind: of :data:`SCENES`.
        seed: of everything drawn.
        compositing: how the camera composes.
        border: what lies beyond the image.
        mask: of :data:`MASK_KINDS`.
        size: of the image in pixels.
        tolerance: root mean square, full scale 1.
    """

    kind: str
    seed: int
    compositing: str
    border: str
    mask: str
    size: tuple[int, int]
    tolerance: float

    @classmethod
    def of_seed(cls, seed: int) -> Case:
        """Return the case of a number: compositing and kind take turns, all else is drawn."""
        generator = torch.Generator().manual_seed(seed)

        def drawn(choices: Any) -> Any:
            return choices[int(torch.randint(len(choices), (), generator=generator))]

        kinds = sorted(SCENES)
        kind = kinds[seed // len(COMPOSITINGS) % len(kinds)]
        sides = (1, 2, 3, 5, 8, 13) if kind == "tiny" else (33, 40, 48, 63)
        return cls(
            kind,
            seed,
            COMPOSITINGS[seed % len(COMPOSITINGS)],
            drawn(BORDERS),
            drawn(sorted(MASK_KINDS)),
            (drawn(sides), drawn(sides)),
            drawn(TOLERANCES),
        )

    def scene(self) -> tuple[Tensor, Tensor]:
        """Return linear light, (1, 3, H, W), and defocus in radians, (1, 1, H, W)."""
        return SCENES[self.kind](self.size, torch.Generator().manual_seed(self.seed))


@dataclass(frozen=True)
class Outcome:
    """What became of a case.

    Args:
        case: the case.
        predicted: error of the plan.
        measured: the same between the captures of plan and reference.
        reference: nothing cheaper was found within the tolerance.
    """

    case: Case
    predicted: float
    measured: float
    reference: bool


@lru_cache(maxsize=64)
def _rig(compositing: str, border: str, mask: str) -> Rig:
    optics = TiDyOptics(MASK_KINDS[mask](), DefocusRange(-20, 20), sensor=None, compositing=compositing, border=border)
    return Rig(optics)


def judge(case: Case) -> Outcome:
    """Plan a case's scene and capture it both ways."""
    with warnings.catch_warnings(), patch.object(planner, "REFERENCE", REFERENCE.replace(max_window=NARROW)):
        warnings.simplefilter("ignore")  # that windows this narrow do not hold the light they should
        rig, (light, defocus) = _rig(case.compositing, case.border, case.mask), case.scene()
        plan = rig.planner.scene(defocus, light).plan(case.tolerance)
        kept = plan.fidelity.replace(name="") == plan.reference.replace(name="")
        measured = 0.0 if kept else rig.error(light, defocus, plan.fidelity, plan.reference)
    return Outcome(case, plan.predicted_error, measured, kept)


# ---------------------------------------------------------------------- the scenes


def _uniform(lo: float, hi: float, generator: torch.Generator) -> float:
    return lo + (hi - lo) * float(torch.rand((), generator=generator))


def _depths(generator: torch.Generator) -> tuple[float, float]:
    """Two depths, at times on layers and half way between them, where the error is least and most."""
    psi = 40 * torch.rand(2, generator=generator) - 20
    if float(torch.rand((), generator=generator)) < 0.3:
        psi = psi.round() + torch.tensor([0.5, 0.0])
    return float(psi[0].clamp(-20, 20)), float(psi[1])


def _plane(size: tuple[int, int], value: float) -> Tensor:
    return torch.full((1, 1, *size), value)


def _window(size: tuple[int, int], generator: torch.Generator, least: int = 3, most: int = 40) -> tuple[slice, slice]:
    slices = []
    for side in size:
        length = min(side, int(torch.randint(least, most + 1, (), generator=generator)))
        start = int(torch.randint(side - length + 1, (), generator=generator))
        slices.append(slice(start, start + length))
    return slices[0], slices[1]


def textured_patch(size: tuple[int, int], generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """A patch of black and white pixels on black at another depth, or its negative."""
    (own, other), where = _depths(generator), _window(size, generator)
    light, defocus = torch.zeros(1, 3, *size), _plane(size, other)
    light[..., *where] = (torch.rand(1, 1, *light[0, 0][where].shape, generator=generator) > 0.5).float()
    defocus[..., *where] = own
    return (1 - light if _uniform(0, 1, generator) < 0.25 else light), defocus


def plain_patch(size: tuple[int, int], generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """A plain patch before or behind texture, faint or bright."""
    (own, other), where = _depths(generator), _window(size, generator)
    light, defocus = torch.rand(1, 3, *size, generator=generator), _plane(size, other)
    light[..., *where] = _uniform(0, 1, generator)
    defocus[..., *where] = own
    return light, defocus


def lights(size: tuple[int, int], generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """A few single bright pixels in the dark, at depths of their own or not."""
    own, other = _depths(generator)
    light, defocus = torch.zeros(1, 3, *size), _plane(size, other)
    for _ in range(int(torch.randint(1, 5, (), generator=generator))):
        y, x = (int(torch.randint(side, (), generator=generator)) for side in size)
        light[..., y, x] = torch.rand(3, generator=generator)
        if _uniform(0, 1, generator) < 0.5:
            defocus[..., y, x] = own
    return light, defocus


def half_black(size: tuple[int, int], generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """One half black, the other texture or white, at two depths."""
    own, other = _depths(generator)
    light, defocus = torch.rand(1, 3, *size, generator=generator), _plane(size, other)
    if _uniform(0, 1, generator) < 0.5:
        light = torch.ones(1, 3, *size)
    half = size[1] // 2
    light[..., :half] = 0
    defocus[..., :half] = own
    return light, defocus


def checkerboard(size: tuple[int, int], generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Squares of texture at one depth and of none, or of light, at another."""
    own, other = _depths(generator)
    side = int(torch.randint(1, 17, (), generator=generator))
    rows, columns = (torch.arange(length) // side for length in size)
    odd = ((rows[:, None] + columns) % 2).bool().expand(1, 1, *size)
    texture = (
        torch.rand(1, 3, *size, generator=generator) if _uniform(0, 1, generator) < 0.7 else torch.ones(1, 3, *size)
    )
    return torch.where(odd, texture, 0.0 if _uniform(0, 1, generator) < 0.6 else 0.5), torch.where(odd, own, other)


def highlights(size: tuple[int, int], generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """A usual scene with a few pixels a hundred to ten thousand times as bright."""
    light = (0.5 + 0.2 * smooth((1, 3, *size), 2.0, generator)).clamp(0, 1)
    defocus = (40 * smooth((1, 1, *size), 6.0, generator).sigmoid() - 20).clamp(-20, 20)
    for _ in range(int(torch.randint(1, 4, (), generator=generator))):
        y, x = (int(torch.randint(side, (), generator=generator)) for side in size)
        light[..., y : y + 2, x : x + 2] = 10 ** _uniform(2, 4, generator)
    return light, defocus


def lines(size: tuple[int, int], generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Thin bright or dark lines before a background at another depth."""
    own, other = _depths(generator)
    inverted = _uniform(0, 1, generator) < 0.5
    light, defocus = torch.full((1, 3, *size), float(inverted)), _plane(size, other)
    for _ in range(int(torch.randint(1, 5, (), generator=generator))):
        axis = int(torch.randint(2, (), generator=generator))
        at = int(torch.randint(size[axis], (), generator=generator))
        where = (..., at, slice(None)) if axis == 0 else (..., at)
        light[where], defocus[where] = float(not inverted), own
    return light, defocus


def gradients(size: tuple[int, int], generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Light and depth that change slowly, along with each other or across."""
    across = torch.linspace(0, 1, size[1]).expand(1, 1, *size)
    down = torch.linspace(0, 1, size[0])[:, None].expand(1, 1, *size)
    lo, hi = sorted(_depths(generator))
    light = across if _uniform(0, 1, generator) < 0.5 else down
    if _uniform(0, 1, generator) < 0.3:
        light = light * torch.rand(1, 1, *size, generator=generator)
    return light.repeat(1, 3, 1, 1), lo + (hi - lo) * across


def noise(size: tuple[int, int], generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """A depth for each pixel, over all of the range or about one depth, on white, texture or slow light."""
    lo, hi = sorted(_depths(generator))
    hi = min(20.0, lo + _uniform(0.1, 2, generator)) if _uniform(0, 1, generator) < 0.5 else hi
    defocus = lo + (hi - lo) * torch.rand(1, 1, *size, generator=generator)
    choice = int(torch.randint(3, (), generator=generator))
    light = (
        torch.ones(1, 3, *size),
        torch.rand(1, 3, *size, generator=generator),
        (0.5 + 0.2 * smooth((1, 3, *size), 4.0, generator)).clamp(0, 1),
    )[choice]
    return light, defocus


def odd_pixel(size: tuple[int, int], generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """One pixel of another depth, in texture or in white."""
    own, other = _depths(generator)
    light = torch.rand(1, 3, *size, generator=generator) if _uniform(0, 1, generator) < 0.5 else torch.ones(1, 3, *size)
    defocus = _plane(size, other)
    defocus[..., size[0] // 2, size[1] // 3] = own
    return light, defocus


def one_depth(size: tuple[int, int], generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """All at one depth: a patch of texture in the dark."""
    light, defocus = textured_patch(size, generator)
    return light, torch.full_like(defocus, float(defocus.flatten()[0]))


def noisy_patch(size: tuple[int, int], generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """A white or faint patch with pixels alternating between two depths, in front of a background on a layer."""
    (own, other), where = _depths(generator), _window(size, generator)
    light = _uniform(0, 1, generator) * torch.ones(1, 3, *size)
    defocus = _plane(size, float(round(other)))
    shape = defocus[..., *where].shape
    light[..., *where] = _uniform(0, 1, generator)
    step = _uniform(0, 1, generator)
    defocus[..., *where] = (own + step * (torch.rand(shape, generator=generator) > 0.5)).clamp(-20, 20)
    return light, defocus


def texture_in_step(size: tuple[int, int], generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Light and depth are the same noise, so that bright pixels are near."""
    shared = smooth((1, 1, *size), _uniform(0.3, 4, generator), generator).sigmoid()
    lo, hi = sorted(_depths(generator))
    return shared.repeat(1, 3, 1, 1), lo + (hi - lo) * shared


def tiny(size: tuple[int, int], generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """A picture of one pixel to thirteen a side."""
    lo, hi = sorted(_depths(generator))
    light = torch.rand(1, 3, *size, generator=generator)
    if _uniform(0, 1, generator) < 0.3:
        light = (light > 0.8).float()
    return light, lo + (hi - lo) * torch.rand(1, 1, *size, generator=generator)


SCENES = {
    "patch": textured_patch,
    "plain patch": plain_patch,
    "lights": lights,
    "half black": half_black,
    "checkerboard": checkerboard,
    "highlights": highlights,
    "lines": lines,
    "gradients": gradients,
    "depth noise": noise,
    "odd pixel": odd_pixel,
    "one depth": one_depth,
    "noisy patch": noisy_patch,
    "bright is near": texture_in_step,
    "tiny": tiny,
}


# ---------------------------------------------------------------------- the command


def report(outcomes: list[Outcome]) -> str:
    """Return the table of results, by compositing and by kind of scene."""
    rows: dict[tuple[str, str], list[Outcome]] = defaultdict(list)
    for outcome in outcomes:
        rows[outcome.case.compositing, "all"].append(outcome)
        rows[outcome.case.compositing, outcome.case.kind].append(outcome)
    table = [
        "compositing  kind             scenes  reference  beyond  worst measured/tolerance, /predicted  "
        "median predicted/measured"
    ]
    for (compositing, kind), own in sorted(rows.items()):
        measured = [each for each in own if each.measured > 0]
        worst = max((each.measured / each.case.tolerance for each in own), default=0.0)
        honest = max((each.measured / each.predicted for each in measured if each.predicted), default=0.0)
        ratio = median(each.predicted / each.measured for each in measured) if measured else float("nan")
        beyond = sum(each.measured > each.case.tolerance for each in own)
        table.append(
            f"{compositing:12} {kind:16} {len(own):6} {sum(each.reference for each in own):10} {beyond:7} "
            f"{worst:24.3f} {honest:12.3f} {ratio:19.2f}"
        )
    return "\n".join(table)


def main() -> None:
    """Judge a range of seeds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("first", type=int)
    parser.add_argument("beyond", type=int)
    parser.add_argument("--record", help="file that a line of JSON is added to for each scene")
    options = parser.parse_args()
    outcomes = []
    for seed in range(options.first, options.beyond):
        outcomes.append(judge(Case.of_seed(seed)))
        if options.record:
            with Path(options.record).open("a") as file:
                file.write(json.dumps(asdict(outcomes[-1])) + "\n")
    print(report(outcomes))


if __name__ == "__main__":
    main()
