"""Measurement: settings are searched on half A, then every scene is scored, and each value is kept at once."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import torch
from tqdm import tqdm

from kornia_tidy.reconstruction.metrics import psnr
from tests.benchmarks.results.captures import Capture, capture, irradiance, sigma_of
from tests.benchmarks.results.restorations import Restoration, Settings, nearest, restorations_for
from tests.benchmarks.results.scenes import SceneSet
from tests.benchmarks.results.scores import Scores, best_ramp, constant, depth_scores, ramp, score
from tests.benchmarks.results.store import Cell, Store, SystemRow
from tests.benchmarks.results.systems import System

NO_CAMERA, NO_NOISE = "no camera", "none"
RAMP_OF_A, BEST_RAMP, CONSTANT = "ramp of half A", "best ramp of the scene", "mean of the scene"


def search(value: Callable[[Settings], float], grid: Mapping[str, Sequence[float]], start: Settings) -> Settings:
    """Return the settings on a grid with the largest value, by ascent along one setting after the other.

    The ascent ends where no neighbour along any setting is better.

    Example:
        >>> search(lambda s: -(s["a"] - 4) ** 2, {"a": (1.0, 2.0, 4.0, 8.0)}, {"a": 1.1})
        {'a': 4.0}
    """
    place = {name: nearest(tuple(values), start[name]) for name, values in grid.items()}
    known: dict[tuple[int, ...], float] = {}

    def at(where: dict[str, int]) -> float:
        key = tuple(where.values())
        if key not in known:
            known[key] = value({name: grid[name][index] for name, index in where.items()})
        return known[key]

    moved = True
    while moved:
        moved = False
        for name, values in grid.items():
            for step in (1, -1):
                while 0 <= place[name] + step < len(values) and at({**place, name: place[name] + step}) > at(place):
                    place[name] += step
                    moved = True
    return {name: grid[name][index] for name, index in place.items()}


def in_words(settings: Settings) -> str:
    """Return settings as they stand in the tables."""
    return ", ".join(f"{name} {value:.3g}" for name, value in settings.items())


class Measurement:
    """Measures systems on one set of scenes; values in the store are not measured again."""

    def __init__(self, store: Store, scenes: SceneSet, wanted: Sequence[str] | None = None) -> None:
        self.store, self.scenes, self.wanted = store, scenes, wanted

    def measure(self, system: System, noises: Sequence[str], progress: tqdm) -> None:
        """Measure all restorations of a system at some noises."""
        self.store.put_system(SystemRow(system.name, system.digest, system.kind, system.title, system.f_number))
        lights: dict[str, torch.Tensor] = {}

        def light(name: str) -> torch.Tensor:
            if name not in lights:
                lights[name] = irradiance(system, self.scenes.load(name))
            return lights[name]

        for noise in noises:
            progress.set_postfix_str(f"{self.scenes.name}, {system.name}, noise {noise}")
            self._at_noise(system, noise, light)
            progress.update()

    def _at_noise(self, system: System, noise: str, light: Callable[[str], torch.Tensor]) -> None:
        captures: dict[str, Capture] = {}

        def taken(name: str) -> Capture:
            if name not in captures:
                captures[name] = capture(system, self.scenes.load(name), light(name), noise)
            return captures[name]

        restorations = {
            name: each for name, each in restorations_for(system).items() if not self.wanted or name in self.wanted
        }
        cells: dict[str, tuple[Restoration, Settings]] = {}
        for name, restoration in restorations.items():
            cells[name] = restoration, self._choose(system, noise, name, restoration, taken)
        for scene in self.scenes.names:
            for name, (restoration, settings) in cells.items():
                cell = self._cell(system, scene, noise, name, settings)
                if not is_whole(self.store.get(cell)):
                    with torch.inference_mode():
                        maps = restoration.restore(taken(scene), settings)
                        self.store.put(cell, score(self.scenes.load(scene), maps))
            captures.pop(scene, None)

    def _choose(
        self, system: System, noise: str, name: str, restoration: Restoration, taken: Callable[[str], Capture]
    ) -> Settings:
        """Return the settings with the highest mean PSNR on half A."""
        if not restoration.grid:
            return {}

        def mean_psnr(settings: Settings) -> float:
            values = []
            for scene in self.scenes.half_a:
                cell = self._cell(system, scene, noise, name, settings)
                scores = self.store.get(cell)
                if "psnr" not in scores:
                    with torch.inference_mode():
                        image = restoration.restore(taken(scene), settings)["image"]
                        scores = {"psnr": float(psnr(image, self.scenes.load(scene).image))}
                    self.store.put(cell, scores)
                values.append(scores["psnr"])
            return math.fsum(values) / len(values)

        return search(mean_psnr, restoration.grid, restoration.start(sigma_of(noise, system.f_number)))

    def _cell(self, system: System, scene: str, noise: str, restoration: str, settings: Settings) -> Cell:
        return Cell(self.scenes.name, scene, system.name, system.digest, noise, restoration, in_words(settings))

    def measure_depth_without_camera(self) -> None:
        """Score the depth estimates that know nothing of a capture."""
        self.store.put_system(SystemRow(NO_CAMERA, "", "none", NO_CAMERA, math.nan))
        everywhere = best_ramp([self.scenes.load(name) for name in self.scenes.half_a])
        for name in self.scenes.names:
            scene = self.scenes.load(name)
            estimates = {
                CONSTANT: constant(scene),
                RAMP_OF_A: ramp(scene, *everywhere),
                BEST_RAMP: ramp(scene, *best_ramp([scene])),
            }
            for kind, estimate in estimates.items():
                cell = Cell(self.scenes.name, name, NO_CAMERA, "", NO_NOISE, kind, "")
                if not self.store.get(cell):
                    self.store.put(cell, depth_scores(scene, estimate))


def is_whole(scores: Scores) -> bool:
    """Whether a cell has all its scores; candidates of a search have their PSNR alone."""
    return bool(scores) and scores.keys() != {"psnr"}
