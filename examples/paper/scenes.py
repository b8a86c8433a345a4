"""Budgets of the experiments by scale, and their scenes: painted ones to train on and to score, and real ones."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, cast

from torch.utils.data import Dataset

from examples.paper.cameras import REFERENCE
from kornia_tidy import Fidelity, ThinLensCamera
from kornia_tidy.data.patches import central_crop
from kornia_tidy.reconstruction.tasks import metres, normalised_inverse_depth
from kornia_tidy.seeds import keyed_seed

BALANCED = Fidelity.preset("balanced")


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Extent of all trainings and scores at one scale.

    Args:
        size: side of painted scenes in pixels.
        scenes: number of painted scenes for training.
        batch: scenes in a step.
        steps: of the optimiser.
        width: channels of the first level of U-Nets.
        scored: number of other painted scenes that are scored.
        real: largest number of real scenes that are scored.
        real_size: side of their middle in pixels.
        seeds: trainings of each row, with other initial masks, weights and orders of the scenes.
        lr: learning rate of the network.
        lr_metres: learning rate of the masks in metres of height.
        schedule: of both, see :class:`~kornia_tidy.training.settings.TrainingSettings`.
        residual: image networks estimate the difference to the capture, which needs fewer steps.
        fidelity: by which PSFs are computed.
        accelerator: of Lightning.
    """

    size: int = 64
    scenes: int = 96
    batch: int = 4
    steps: int = 60
    width: int = 8
    scored: int = 16
    real: int = 12
    real_size: int = 160
    seeds: int = 2
    lr: float = 2e-3
    lr_metres: float = 6e-8
    schedule: str = "cosine"
    residual: bool = True
    fidelity: Fidelity = BALANCED
    accelerator: str = "cpu"

    @property
    def words(self) -> str:
        """The budget in words, for tables."""
        return (
            f"{self.steps:,} steps of {self.batch} of {self.scenes:,} painted scenes of {self.size} px, U-Nets of "
            f"width {self.width}, learning rates {self.lr:g} and {self.lr_metres:g} m ({self.schedule}); scored on "
            f"{self.scored} other painted scenes and {self.real} real ones of {self.real_size} px; seeds {self.seeds}"
        )


SMALL = Fidelity.preset("draft").replace(window=23)
BUDGETS = {
    "smoke": Budget(size=48, scenes=2, batch=2, steps=2, width=2, scored=2, real=0, seeds=1, fidelity=SMALL),
    "cpu": Budget(),
    "gpu": Budget(
        seeds=3, size=256, scenes=5077, batch=32, steps=10_000, width=32, scored=64, real=35, real_size=512, lr=1e-3,
        accelerator="gpu",
    ),
    "paper": Budget(
        seeds=3, size=256, scenes=5077, batch=32, steps=47_400, width=64, scored=419, real=35, real_size=512, lr=1e-4,
        lr_metres=1e-8, schedule="constant", residual=False, accelerator="gpu",
    ),
}  # fmt: skip
"""By scale. The one called ``"paper"`` has the paper's rates, batch, network and 300 passes over its 5,077 scenes."""


class ForCamera(Dataset):
    """Scenes with depths stretched, linearly in dioptres, from the range of one camera to that of another."""

    def __init__(self, scenes: Dataset[Any], camera: ThinLensCamera) -> None:
        self.scenes, self.camera = scenes, camera

    def __len__(self) -> int:
        """Return the number of scenes."""
        return len(cast("Any", self.scenes))

    def __getitem__(self, index: int) -> dict[str, Any]:
        """Return a scene."""
        sample = self.scenes[index]
        return {**sample, "depth": metres(self.camera, normalised_inverse_depth(REFERENCE, sample["depth"]))}


@lru_cache
def painted(budget: Budget, split: str, count: int) -> Dataset[Any]:
    """Return painted scenes of a split, ``"train"``, ``"validation"`` or ``"test"``; they stay in memory."""
    from kornia_tidy.data.photographic_leaves import PhotographicLeaves  # noqa: PLC0415 (after --help)
    from kornia_tidy.data.remembered import Remembered  # noqa: PLC0415

    seed = keyed_seed("paper", split)
    return Remembered(PhotographicLeaves(count, budget.size, budget.size, depth_range=REFERENCE.depth_range, seed=seed))


@lru_cache
def real(most: int, size: int) -> list[dict[str, Any]]:
    """Return real scenes of ``../shared/data``, evenly drawn from the list; none where the folder is missing.

    Depths are stretched over the range of :data:`REFERENCE`; the middle of each picture is kept.
    """
    from kornia_tidy.reconstruction.tasks import stretched  # noqa: PLC0415
    from tests.scenes import ENTRIES, load_scene  # noqa: PLC0415

    scenes = []
    for name in list(ENTRIES)[:: -(-len(ENTRIES) // most)] if most and ENTRIES else []:
        image, depth, known = load_scene(name)
        sample = {"image": image.expand(3, -1, -1), "depth": stretched(depth, known, REFERENCE), "mask": known}
        height, width = (min(size, side) for side in image.shape[-2:])
        scenes.append({**central_crop(sample, (height, width)), "name": name})
    return scenes


def scored_sets(budget: Budget) -> dict[str, Any]:
    """Return the painted scenes that are scored, and the real ones."""
    return {"painted": painted(budget, "test", budget.scored), "real": real(budget.real, budget.real_size)}
