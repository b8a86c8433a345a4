"""Results as a table: scores by scene for each set of scenes, noise, system and restoration, and paired differences."""

from __future__ import annotations

import math
import statistics
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from tests.benchmarks.results.measure import NO_CAMERA, is_whole
from tests.benchmarks.results.restorations import NETWORK
from tests.benchmarks.results.scenes import SceneSet
from tests.benchmarks.results.store import Measured, SystemRow

ByScene = dict[str, dict[str, float]]


class Key(NamedTuple):
    """A row of the results."""

    scenes: str
    noise: str
    system: str
    restoration: str


class Difference(NamedTuple):
    """Mean of paired differences, its standard error, and how many of the pairs are above zero."""

    mean: float
    error: float
    ahead: int
    pairs: int

    def __str__(self) -> str:
        """Return the mean and its standard error."""
        return self.rounded(2)

    def rounded(self, digits: int) -> str:
        """Return the mean and, where there is one, its standard error."""
        error = f" ± {self.error:.{digits}f}" if math.isfinite(self.error) else ""
        return f"{self.mean:+.{digits}f}{error}"


def paired(ours: Mapping[str, float], theirs: Mapping[str, float]) -> Difference:
    """Return the mean difference of values of the same scenes, with the standard error of this mean.

    Scenes in which a value is missing or not finite do not count. The standard error takes scenes as independent.

    Example:
        >>> paired({"a": 2.0, "b": 4.0, "c": 1.0}, {"a": 1.0, "b": 1.0})
        Difference(mean=2.0, error=1.0, ahead=2, pairs=2)
    """
    differences = [ours[name] - theirs[name] for name in ours if name in theirs]
    differences = [value for value in differences if math.isfinite(value)]
    if not differences:
        return Difference(math.nan, math.nan, 0, 0)
    count, ahead = len(differences), sum(value > 0 for value in differences)
    error = statistics.stdev(differences) / math.sqrt(count) if count > 1 else math.nan
    return Difference(statistics.fmean(differences), error, ahead, count)


class Results:
    """The measured scores, each restoration with the settings that are best on half A."""

    def __init__(self, cells: Iterable[Measured], systems: Mapping[str, SystemRow], sets: Sequence[SceneSet]) -> None:
        self.systems, self.sets = dict(systems), {each.name: each for each in sets}
        candidates: dict[Key, dict[str, ByScene]] = defaultdict(lambda: defaultdict(dict))
        for cell, scores, _ in cells:
            key = Key(cell.scenes, cell.noise, cell.system, cell.restoration)
            candidates[key][cell.settings][cell.scene] = scores
        self.rows: dict[Key, ByScene] = {}
        self.settings: dict[Key, str] = {}
        for key, by_settings in candidates.items():
            if key.scenes in self.sets and (chosen := self._chosen(key, by_settings)) is not None:
                self.rows[key], self.settings[key] = by_settings[chosen], chosen

    def _chosen(self, key: Key, by_settings: Mapping[str, ByScene]) -> str | None:
        """Return the settings that are best on half A and scored on all scenes; None while a run is incomplete."""
        scenes = self.sets[key.scenes]
        tried = {
            settings: statistics.fmean(found[name].get("psnr", 0.0) for name in scenes.half_a)
            for settings, found in by_settings.items()
            if all(name in found for name in scenes.half_a)
        }
        if not tried:
            return None
        best = max(tried, key=lambda settings: tried[settings])
        found = by_settings[best]
        return best if all(is_whole(found.get(name, {})) for name in scenes.names) else None

    def values(self, key: Key, score: str, half: str = "B") -> dict[str, float]:
        """Return a score by scene; an empty mapping for a row without measurements."""
        if key not in self.rows:
            return {}
        scenes, by_scene = self.sets[key.scenes], self.rows[key]
        names = scenes.half_b if half == "B" else scenes.half_a
        return {name: by_scene[name][score] for name in names if score in by_scene[name]}

    def mean(self, key: Key, score: str, half: str = "B") -> float:
        """Return the mean of a score over the scenes of a half that have one, NaN where none has."""
        values = [value for value in self.values(key, score, half).values() if math.isfinite(value)]
        return statistics.fmean(values) if values else math.nan

    def difference(self, ours: Key, theirs: Key, score: str = "psnr") -> Difference:
        """Return the paired difference of a score on half B."""
        return paired(self.values(ours, score), self.values(theirs, score))

    def keys(
        self,
        scenes: str,
        noise: str,
        *,
        system: str | None = None,
        restoration: str | None = None,
        network: bool = True,
    ) -> list[Key]:
        """Return the rows of a set of scenes and a noise with an image; of a system or a restoration; without networks
        if ``network`` is False."""
        found = []
        for key in self.rows:
            fits = key[:2] == (scenes, noise) and key.system != NO_CAMERA and system in (None, key.system)
            fits = fits and restoration in (None, key.restoration) and bool(self.values(key, "psnr"))
            if fits and (network or not key.restoration.startswith(NETWORK)):
                found.append(key)
        return found

    def best(self, keys: Sequence[Key]) -> Key | None:
        """Return the row with the highest mean PSNR on half A."""
        return max(keys, key=lambda key: self.mean(key, "psnr", "A"), default=None)
