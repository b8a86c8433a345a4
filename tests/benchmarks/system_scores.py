"""Scores of a trained system on new dead leaves, and on the real scenes where these are on the machine."""

from __future__ import annotations

import statistics
from pathlib import Path
from typing import Any

from torch.utils.data import Dataset

from kornia_tidy import ThinLensCamera
from kornia_tidy.data import DeadLeaves, central_crop
from kornia_tidy.reconstruction.metrics import psnr
from kornia_tidy.reconstruction.tasks import stretched
from kornia_tidy.reconstruction.trained import load_trained
from kornia_tidy.training.callbacks import BEST
from kornia_tidy.training.evaluation import SceneResult, evaluate, mean_row
from tests.scenes import ENTRIES, load_scene

LEAVES, LEAVES_SIZE, LEAVES_SEED = 32, 256, 987654321  # the scenes of no training seed
LARGEST = 512  # pixels; of real scenes the middle


class RealScenes(Dataset[dict[str, Any]]):
    """The middles of the real scenes, their depths stretched over a camera's range."""

    def __init__(self, camera: ThinLensCamera) -> None:
        self.names, self.camera = sorted(ENTRIES), camera

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> dict[str, Any]:
        image, depth, valid = load_scene(self.names[index])
        depth = stretched(depth, valid, self.camera)
        sample = {"image": image.expand(3, -1, -1), "depth": depth, "mask": valid}
        size = tuple(min(LARGEST, side) for side in image.shape[-2:])
        return {**central_crop(sample, (size[0], size[1])), "index": index, "name": self.names[index]}


def score(folder: Path) -> dict[str, dict[str, float]]:
    """Return the mean scores of a system on each set of scenes."""
    system = load_trained(folder / BEST)
    camera = system.optics.camera
    assert isinstance(camera, ThinLensCamera)
    leaves = DeadLeaves(LEAVES, LEAVES_SIZE, LEAVES_SIZE, depth_range=camera.depth_range, seed=LEAVES_SEED)
    sets: dict[str, Dataset[Any]] = {"dead leaves": leaves, **({"real scenes": RealScenes(camera)} if ENTRIES else {})}
    scores = {}
    for name, scenes in sets.items():
        captures: list[float] = []

        def note(result: SceneResult, captures: list[float] = captures) -> None:
            captures.append(float(psnr(result.coded[None], result.truth["image"][None])))

        rows = evaluate(system, scenes, each=note)
        scores[name] = {"scenes": len(rows), "capture_psnr": statistics.fmean(captures), **mean_row(rows)}
    return scores
