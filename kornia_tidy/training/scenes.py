"""Reproducible batches of scenes: their order, their augmentation, and a resumable loader."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler, default_collate

from kornia_tidy.search_path import starting_workers
from kornia_tidy.seeds import keyed_seed
from kornia_tidy.training.random_state import seeded

GAIN = (0.8, 1.1)  # range of the brightness factor of augmentation
CAPTURE = ("coded", "inverse_depth", "noise")  # of samples that are captures already


# ---------------------------------------------------------------------- order


class EpochBatches(Sampler):
    """Batches of each epoch, in an order drawn from seed and epoch, dealt to the processes in turn.

    Two processes with batches of b scenes take the same step as one process that accumulates two batches of b.

    Args:
        length: number of scenes.
        batch: scenes in a batch.
        seed: of the order.
        shuffle: False keeps the order of the scenes, and the last batch even if it is incomplete.
        rank: of this process.
        world: number of processes.

    Raises:
        ValueError: if there are fewer scenes than fill one batch for each process.

    Example:
        >>> batches = EpochBatches(5, 2, shuffle=False)
        >>> list(batches)
        [[(0, 0), (0, 1)], [(0, 2), (0, 3)], [(0, 4)]]
        >>> batches.start(epoch=1, first=2)
        >>> list(batches)
        [[(1, 4)]]
    """

    def __init__(
        self, length: int, batch: int, *, seed: int = 0, shuffle: bool = True, rank: int = 0, world: int = 1
    ) -> None:
        self.length, self.batch, self.seed, self.shuffle, self.rank, self.world = (
            length, batch, seed, shuffle, rank, world,
        )  # fmt: skip
        self.epoch = self.first = 0
        if (length < batch * world and shuffle) or length < world:
            raise ValueError(f"{length} scenes do not fill a batch of {batch} for each of {world} processes")

    @property
    def sampler(self) -> EpochBatches:
        """This object, on which Lightning calls :meth:`set_epoch`."""
        return self

    def set_epoch(self, epoch: int) -> None:
        """Start another epoch at its first batch. Without shuffling all epochs are the same, noise included."""
        if self.shuffle and epoch != self.epoch:
            self.start(epoch, 0)

    def start(self, epoch: int, first: int) -> None:
        """Start an epoch at batch number ``first``."""
        self.epoch, self.first = epoch, first

    def __len__(self) -> int:
        """Return the number of batches of a whole epoch."""
        batches = self.length // self.batch if self.shuffle else -(-self.length // self.batch)
        return batches // self.world

    def __iter__(self) -> Iterator[list[tuple[int, int]]]:
        """Yield batches of (epoch, index)."""
        order = range(self.length)
        if self.shuffle:
            generator = torch.Generator().manual_seed(keyed_seed(self.seed, "order", self.epoch))
            order = torch.randperm(self.length, generator=generator).tolist()
        for turn in range(self.first, len(self)):
            start = (turn * self.world + self.rank) * self.batch
            yield [(self.epoch, index) for index in order[start : start + self.batch]]


# ---------------------------------------------------------------------- batches


class Broken(NamedTuple):
    """Placeholder for a batch that cannot be used: an exception in a worker would show its whole traceback."""

    reason: str


class RepeatableScenes(Dataset):
    """Data set with items that depend only on epoch and index, not on the worker or the order of loading.

    Args:
        scenes: a map-style data set of ``{"image", "depth"}``, with ``"mask"`` where depth is not known everywhere; or
            of captures, see :class:`~kornia_tidy.training.noisy_crops.NoisyCrops`.
        seed: of random scenes, of captures' crops and noise, and of the augmentation.
        augment: flip scenes and vary their brightness; captures are not changed.
    """

    def __init__(self, scenes: Dataset, seed: int = 0, augment: bool = False) -> None:
        self.scenes, self.seed, self.augment = scenes, seed, augment

    def __len__(self) -> int:
        """Return the number of scenes."""
        return len(cast("Any", self.scenes))

    def __getitem__(self, index: Any) -> dict[str, Any] | Broken:
        """Return a scene by (epoch, index), or the reason why it cannot be used."""
        epoch, index = index
        try:
            with seeded(keyed_seed(self.seed, "item", epoch, index)):
                sample = self.scenes[index]
                if "coded" in sample:
                    return {**sample, "index": index, "name": sample.get("name", ""), "epoch": epoch}
                image, depth = sample["image"], sample["depth"]
                mask = sample.get("mask")
                mask = torch.ones_like(depth, dtype=torch.bool) if mask is None else mask
                if self.augment:
                    image, depth, mask = augmented(image, depth, mask)
        except (KeyError, OSError, ValueError) as error:
            return Broken(f"scene {index} of the data cannot be used: {error}")
        name = sample.get("name", "")
        return {"image": image, "depth": depth, "mask": mask, "index": index, "name": name, "epoch": epoch}


def augmented(image: Tensor, depth: Tensor, mask: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Flip a scene and vary its brightness at random, by torch's global generator.

    Source: Wu et al., PhaseCam3D (ICCP 2019), which varies brightness batch by batch.

    Example:
        >>> image, depth = torch.ones(3, 2, 2), torch.ones(1, 2, 2)
        >>> bright, _, _ = augmented(image, depth, depth > 0)
        >>> 0.8 <= float(bright.max()) <= 1.0
        True
    """
    across, down, gain = torch.rand(3, dtype=torch.float32).tolist()
    axes = [axis for axis, toss in ((-1, across), (-2, down)) if toss < 0.5]
    image = (image * (GAIN[0] + (GAIN[1] - GAIN[0]) * gain)).clamp(max=1)
    return image.flip(axes), depth.flip(axes), mask.flip(axes)


class _Collate:
    """Collates scenes to a batch and adds a noise seed that depends on these scenes."""

    def __init__(self, seed: int) -> None:
        self.seed = seed

    def __call__(self, samples: Sequence[dict[str, Any] | Broken]) -> dict[str, Any] | Broken:
        scenes: list[Mapping[str, Any]] = []
        for sample in samples:
            if isinstance(sample, Broken):
                return sample
            scenes.append(sample)
        sizes = {tuple(scene["image"].shape) for scene in scenes}
        if len(sizes) > 1:
            return Broken(f"the scenes of a batch must have one size, got {sorted(sizes)}")
        keys = [key for scene in scenes for key in (scene["epoch"], scene["index"])]
        kept = ("image", *(CAPTURE if "coded" in scenes[0] else ("depth",)), "mask", "index", "name")
        samples = [{key: scene[key] for key in kept} for scene in scenes]
        return {**default_collate(samples), "noise_seed": keyed_seed(self.seed, "noise", *keys)}


class SceneLoader(DataLoader):
    """Data loader with batches that depend only on seed and epoch; it resumes in the middle of an epoch.

    It does not use the global generators. Lightning saves and restores its state.

    Args:
        scenes: as for :class:`RepeatableScenes`.
        batch: scenes in a batch.
        seed: of everything random in the batches.
        train: shuffle, and augment if ``augment`` is True. False, for validation: the same batches in every epoch.
        augment: see :class:`RepeatableScenes`.
        workers: processes that load scenes.
        rank: of this process.
        world: number of processes that share the scenes.

    Example:
        >>> from kornia_tidy.data.dead_leaves import DeadLeaves
        >>> loader = SceneLoader(DeadLeaves(4, 32, 32), batch=2)
        >>> batch = next(iter(loader))
        >>> batch["image"].shape, loader.state_dict()
        (torch.Size([2, 3, 32, 32]), {'epoch': 0, 'batches': 1})
    """

    def __init__(
        self,
        scenes: Dataset,
        batch: int,
        *,
        seed: int = 0,
        train: bool = True,
        augment: bool = False,
        workers: int = 0,
        rank: int = 0,
        world: int = 1,
    ) -> None:
        items = RepeatableScenes(scenes, seed, augment and train)
        self._batches = EpochBatches(len(items), batch, seed=seed, shuffle=train, rank=rank, world=world)
        self._handed = 0
        super().__init__(
            items,
            batch_sampler=self._batches,
            num_workers=workers,
            collate_fn=_Collate(seed),
            generator=torch.Generator().manual_seed(
                seed % 2**63
            ),  # else each epoch would draw from the global generator
        )

    def __iter__(self) -> Any:
        """Yield batches; loading starts with the first one that is asked for."""
        self._handed = self._batches.first
        with starting_workers():
            batches = super().__iter__()
        for batch in batches:
            self._handed += 1
            yield batch

    def state_dict(self) -> dict[str, int]:
        """Return the epoch and the number of its batches that were yielded."""
        return {"epoch": self._batches.epoch, "batches": self._handed}

    def load_state_dict(self, state: Mapping[str, int]) -> None:
        """Resume after the batches that :meth:`state_dict` counted."""
        self._batches.start(state["epoch"], state["batches"])
