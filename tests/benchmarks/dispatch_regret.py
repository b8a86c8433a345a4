"""How much slower the rule's choice of a backend is than the fastest choice, over many scenes.

``python -m tests.benchmarks.dispatch_regret`` on a machine that does nothing else, some 20 minutes; ``--quick`` takes a
share of the scenes, a minute or two. ``OMP_NUM_THREADS`` sets the threads.

The regret of a scene is the time of ``method="auto"`` over that of the fastest of the other choices: each backend by
name, and compiled code with other windows than the rule's and with direct sums up to 15 px. Times are the least of
rounds in which all take their turn; a regret above 1.15 is measured again before it counts. Target: 1.15 in the
geometric mean, at most 2.
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from statistics import geometric_mean
from typing import NamedTuple
from unittest import mock

import torch

from kornia_tidy.design.tradeoff.conditions import device_name
from kornia_tidy.kernels.overlap_ops import window_size
from kornia_tidy.render.backends import compiled
from kornia_tidy.render.dispatch import BACKENDS, choose, refusal
from kornia_tidy.render.scene import LayeredScene, layered_scene

GOOD, BAD = 1.15, 2.0
WINDOWS, LAYERS, SIDES = (5, 9, 15, 23, 33, 41, 65, 97, 129), (1, 3, 8, 21), (256, 512, 1024, 2048)
ROUNDS, AGAIN = 5, 3  # rounds, and how often a large regret is measured again
HOPELESS = 3.0  # times the fastest: not repeated, but for auto, which comes first and finds caches cold
LONGEST = 2.0  # s of a rendering that is not repeated
MOST_DIRECT = 15  # px of PSFs that are convolved directly too


class Case(NamedTuple):
    compositing: str
    side: int
    window: int
    layers: int
    mode: str


class Result(NamedTuple):
    case: Case
    chosen: str
    times: dict[str, float]

    @property
    def regret(self) -> float:
        return self.times["auto"] / min(time for name, time in self.times.items() if name != "auto")


def cases(*, quick: bool) -> list[Case]:
    """Linear and nearest layers in turn; a single layer is nearest."""
    sides = SIDES[:2] if quick else SIDES
    every = itertools.product(("gather", "scatter", "occlusion"), sides, WINDOWS, LAYERS)
    found = [
        Case(*case, "nearest" if case[-1] == 1 or number % 2 else "linear")
        for number, case in enumerate(every, start=1)
    ]
    return found[::3] if quick else found


def make_scene(case: Case) -> LayeredScene:
    """A wavy ground with boxes before it: not the scenes that costs are fitted to."""
    generator = torch.Generator().manual_seed(case.side + case.window)
    axis = torch.linspace(0, 1, case.side)
    defocus = 14 * torch.sin(5 * axis[:, None] + 3 * axis) - 5
    for top, left, height, width, psi in torch.rand(25, 5, generator=generator).tolist():
        rows, columns = ((axis >= a) & (axis < a + 0.03 + 0.2 * b * b) for a, b in ((top, height), (left, width)))
        defocus = torch.where(rows[:, None] & columns, 40 * psi - 20, defocus)
    psfs = torch.rand(case.layers, 3, case.window, case.window, generator=generator) ** 4
    image = torch.rand(1, 3, case.side, case.side, generator=generator)
    return layered_scene(
        image,
        defocus[None, None],
        torch.linspace(-20, 20, case.layers),
        psfs / psfs.sum((-2, -1), keepdim=True),
        compositing=case.compositing,
        layers=case.mode,
    )


def choices(scene: LayeredScene) -> dict[str, tuple[str, dict[str, object]]]:
    """Return a method and settings of the compiled backend for each choice, by name."""
    able = [name for name, backend in BACKENDS.items() if refusal(backend, scene) is None]
    found: dict[str, tuple[str, dict[str, object]]] = {name: (name, {}) for name in ("auto", *able)}
    if "compiled" in able and scene.compositing != "occlusion":
        side, usual = scene.psfs.shape[-1], window_size(scene.psfs.shape[-1])
        for factor in (0.5, 0.75, 1.5, 2, 3):
            size = window_size(round(factor * side))
            if size >= 2 * side - 1 and size != usual:
                found[f"windows of {size} px"] = "compiled", {"window_size": lambda _, size=size: size}
        if side <= MOST_DIRECT:
            found["direct sums"] = "compiled", {"LARGEST_DIRECT": side}
            found["windows"] = "compiled", {"LARGEST_DIRECT": 0}
    return found


def measure(case: Case) -> Result:
    scene = make_scene(case)
    ways = choices(scene)
    with torch.no_grad():
        chosen = choose(scene).name
        times = dict.fromkeys(ways, math.inf)
        for number in range(AGAIN + 1):
            for _ in range(ROUNDS):
                fastest = min(times.values())
                for name, (method, settings) in ways.items():
                    hopeless = name != "auto" and times[name] > HOPELESS * fastest
                    if not hopeless and not LONGEST < times[name] < math.inf:
                        with mock.patch.multiple(compiled, **settings) if settings else nullcontext():
                            times[name] = min(times[name], time_once(scene, method))
            result = Result(case, chosen, times)
            if result.regret <= GOOD or number == AGAIN:
                break
    return result


def time_once(scene: LayeredScene, method: str) -> float:
    fresh, clock = (
        replace(scene, found={}),
        time.thread_time if torch.get_num_threads() == 1 else time.perf_counter,
    )
    start = clock()
    choose(fresh, method).render(fresh)
    return clock() - start


def report(results: list[Result]) -> Iterator[str]:
    regrets = [result.regret for result in results]
    yield ""
    yield f"{device_name(torch.device('cpu'))}, {torch.get_num_threads()} threads, torch {torch.__version__}"
    yield f"| scenes | <= {GOOD} | <= {BAD} | geometric mean | worst |"
    yield "| --- | ---: | ---: | ---: | ---: |"
    for kind in ("gather", "scatter", "occlusion", None):
        own = [regret for result in results if kind in (None, result.case.compositing) for regret in [result.regret]]
        within = [sum(regret <= bound for regret in own) / len(own) for bound in (GOOD, BAD)]
        shares = " | ".join(f"{100 * share:.1f} %" for share in within)
        yield f"| {kind or 'all'}: {len(own)} | {shares} | {geometric_mean(own):.2f} | {max(own):.2f} |"
    yield f"chosen: {dict(Counter(result.chosen for result in results))}"
    met = geometric_mean(regrets) <= GOOD and max(regrets) <= BAD
    yield "target met" if met else "target missed"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a share of the scenes, none above 512 px")
    args = parser.parse_args()
    names = ("auto", *BACKENDS)
    titles = ["compositing", "px", "PSF", "layers", *(f"{name} ms" for name in names), "chosen", "fastest", "regret"]
    print(f"| {' | '.join(titles)} |")
    print(f"| --- | ---: | ---: | --- |{' ---: |' * len(names)} --- | --- | ---: |")
    results = []
    for case in cases(quick=args.quick):
        result = measure(case)
        results.append(result)
        each = " | ".join(f"{1e3 * result.times.get(name, math.nan):.1f}" for name in names)
        best = min((name for name in result.times if name != "auto"), key=result.times.__getitem__)
        kind = f"| {case.compositing} | {case.side} | {case.window} | {case.layers} {case.mode} "
        print(f"{kind}| {each} | {result.chosen} | {best} | {result.regret:.2f} |", flush=True)
    print("\n".join(report(results)))


if __name__ == "__main__":
    main()
