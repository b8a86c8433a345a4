"""SUN RGB-D: indoor frames of four depth cameras, with rotated bits in the 16-bit depth."""

from __future__ import annotations

import os
from itertools import chain
from pathlib import Path

from kornia_tidy.data.rgbd import Scene, read_rgbd
from kornia_tidy.data.scene_dataset import SceneDataset, Transform
from kornia_tidy.files import check_folder, find_files

DEPTH = "depth_bfx"  # folder of the improved depth
ROTATED_BITS = 3  # to the left, in the published files


class SUNRGBD(SceneDataset):
    """Data set of the frames of SUN RGB-D, as published.

    Args:
        root: folder ``SUNRGBD`` or a part of it, such as ``SUNRGBD/kv2``. Each frame is a folder that holds ``image``
            and ``depth_bfx``, each with one file.
        transform: see :class:`~kornia_tidy.data.scene_dataset.SceneDataset`, which also describes the items.

    Raises:
        FileNotFoundError: if the folder is missing or holds no frame.
        ValueError: if a frame does not have one image and one depth.

    Convention:
        - Holes of ``depth_bfx`` were filled by the publishers from several frames.
        - Depth is in millimetres once the bits are rotated back, and 0 is unknown. The publishers' code clips it at
          8 m; it is not clipped here.
        - A name is the path of a frame's folder.

    Source: Song et al., SUN RGB-D (CVPR 2015), with the bit rotation of its toolbox.
    """

    def __init__(self, root: str | os.PathLike[str], *, transform: Transform | None = None) -> None:
        super().__init__(transform)
        self.root = check_folder(root)
        files = chain.from_iterable(find_files(self.root, f"**/{name}/*") for name in ("image", DEPTH))
        folders = sorted({file.parent.parent for file in files})
        frames = [folder for folder in folders if (folder / "image").is_dir() and (folder / DEPTH).is_dir()]
        if not frames:
            raise FileNotFoundError(f"SUN RGB-D is not in {self.root}: a frame is a folder with image/ and {DEPTH}/")
        self.pairs = [(_only_file(frame / "image"), _only_file(frame / DEPTH)) for frame in frames]
        self.names = [frame.relative_to(self.root).as_posix() for frame in frames]

    def read(self, index: int) -> Scene:
        """Read a frame."""
        return read_rgbd(*self.pairs[index], scale=0.001, rotated_bits=ROTATED_BITS)


def _only_file(folder: Path) -> Path:
    files = list(find_files(folder, "*"))
    if len(files) != 1:
        raise ValueError(f"{folder} should hold one file, found {len(files)}")
    return files[0]
