"""Sequences in the format of TUM RGB-D and ICL-NUIM: image and depth are joined by their times."""

from __future__ import annotations

import math
import os
from pathlib import Path, PurePosixPath

from kornia_tidy.checks import check_positive
from kornia_tidy.data.rgbd import Scene, read_rgbd
from kornia_tidy.data.scene_dataset import SceneDataset, Transform
from kornia_tidy.files import read_text

SCALE = 1 / 5000  # m; a stored 5000 is one metre
ASSOCIATIONS = ("associations.txt", "associate.txt")


class TUMSequence(SceneDataset):
    """Data set of a sequence in the format of TUM RGB-D, which ICL-NUIM also uses.

    Args:
        root: folder with ``rgb.txt`` and ``depth.txt``, which list times and files, or with ``associations.txt``, which
            lists pairs.
        max_difference: seconds between an image and its depth at most. Pairs that are listed may differ by more.
        transform: see :class:`~kornia_tidy.data.scene_dataset.SceneDataset`, which also describes the items.

    Raises:
        FileNotFoundError: if a list is missing.
        ValueError: if a list is damaged, or no image and depth are near each other in time.

    Convention:
        - Depth is stored in units of 0.2 mm, and 0 is unknown.
        - Pairs are formed from the nearest times on, and each file is used once. They are sorted by the image's time,
          which is the name of an item.

    Source: Sturm et al., A Benchmark for the Evaluation of RGB-D SLAM Systems (IROS 2012); Handa et al., A Benchmark
    for RGB-D Visual Odometry (ICRA 2014).
    """

    def __init__(
        self, root: str | os.PathLike[str], max_difference: float = 0.02, *, transform: Transform | None = None
    ) -> None:
        super().__init__(transform)
        check_positive("max_difference", max_difference, "seconds")
        self.root = Path(root)
        lists = [self.root / name for name in ASSOCIATIONS if (self.root / name).is_file()]
        self.pairs = _listed(lists[0]) if lists else _associated(self.root, max_difference)
        self.names = [time for time, _, _ in self.pairs]

    def read(self, index: int) -> Scene:
        """Read a pair."""
        _, image, depth = self.pairs[index]
        return read_rgbd(self.root / image, self.root / depth, scale=SCALE)


def _lines(path: Path, columns: int) -> list[list[str]]:
    """Return the columns of a list; comments begin with #."""
    lines = [line.split() for line in read_text(path, "replace").splitlines()]
    lines = [line for line in lines if line and not line[0].startswith("#")]
    if not lines or any(len(line) < columns for line in lines):
        raise ValueError(f"cannot read {path}: it should list {'pairs of ' if columns == 4 else ''}times and files")
    for line in lines:
        for time, file in zip(line[:columns:2], line[1:columns:2], strict=True):
            _seconds(path, time)
            if PurePosixPath(file).is_absolute() or ".." in PurePosixPath(file).parts:
                raise ValueError(f"cannot read {path}: files must lie in the folder, got {file:.80}")
    return lines


def _listed(path: Path) -> list[tuple[str, str, str]]:
    """Return listed pairs: TUM's tool writes the image first, ICL-NUIM the depth."""
    depth_first = PurePosixPath(_lines(path, 4)[0][1]).parts[0].startswith("depth")
    rows = [line[2:4] + line[:2] if depth_first else line[:4] for line in _lines(path, 4)]
    pairs = [(time, image, depth) for time, image, _, depth in rows]
    return sorted(pairs, key=lambda pair: float(pair[0]))


def _associated(root: Path, max_difference: float) -> list[tuple[str, str, str]]:
    """Return the pairs of images and depths with the nearest times."""
    images, depths = (
        sorted((_seconds(root / name, line[0]), line[0], line[1]) for line in _lines(root / name, 2))
        for name in ("rgb.txt", "depth.txt")
    )
    near, first = [], 0
    for i, image in enumerate(images):
        while first < len(depths) and depths[first][0] < image[0] - max_difference:
            first += 1
        for j in range(first, len(depths)):
            if depths[j][0] > image[0] + max_difference:
                break
            near.append((abs(depths[j][0] - image[0]), i, j))
    pairs: dict[int, int] = {}
    used: set[int] = set()
    for _, i, j in sorted(near):
        if i not in pairs and j not in used:
            pairs[i] = j
            used.add(j)
    if not pairs:
        raise ValueError(f"{root} has no image and depth within {max_difference} s of each other")
    return [(images[i][1], images[i][2], depths[pairs[i]][2]) for i in sorted(pairs)]


def _seconds(path: Path, text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not math.isfinite(seconds):
        raise ValueError(f"cannot read {path}: a line should begin with a time in seconds, got {text!r:.80}")
    return seconds
