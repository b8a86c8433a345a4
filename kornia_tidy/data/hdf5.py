"""HDF5 files that hold one map, as Hypersim has them."""

from __future__ import annotations

import io
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kornia_tidy.data.picture_header import check_pixels
from kornia_tidy.search_path import import_extra, import_installed

DAMAGE = (OSError, OverflowError, RuntimeError, KeyError, TypeError, AttributeError)  # of h5py on damaged files
MAGIC = b"\x89HDF\r\n\x1a\n"


def decode_hdf5(data: bytes) -> NDArray[Any]:
    """Decode the only data set of an HDF5 file. It needs ``pip install 'kornia-tidy[data]'``.

    Args:
        data: bytes of the file.

    Raises:
        ImportError: if h5py is missing.
        ValueError: if the file is damaged, or holds no data set or several, or a data set in it that does not hold a
            map of numbers.
    """
    h5py = import_extra("h5py", "an HDF5 file")  # slow to import
    try:
        with h5py.File(io.BytesIO(data), "r") as file:
            names = list(file)
            dataset = stored_numbers(file, names[0]) if len(names) == 1 else None
            if dataset is None:
                raise ValueError(f"its HDF5 must hold only one data set, found {', '.join(names)[:80] or 'none'}")
            check_pixels("the map", *_rows_and_columns(dataset.shape))
            return np.asarray(dataset[()])
    except DAMAGE as error:
        raise ValueError(f"its HDF5 is damaged: {error!s:.200}") from error


def stored_numbers(file: Any, name: str) -> Any:
    """Return a data set of numbers that lie in an open HDF5 file, None if the name is not that of a data set.

    Links to other files, and values in other files, are refused: a file could expose data that its sender may not read.
    So are chunks with more numbers than a picture has pixels, which would be decompressed as a whole.

    Raises:
        ValueError: if the data set is such a one, or its values are not numbers.
    """
    h5py = import_installed("h5py")

    link = file.get(name, getlink=True) if name in file else None
    if link is not None and not isinstance(link, h5py.HardLink):
        raise ValueError(f"{name:.80} in its HDF5 is a link")
    dataset = file[name] if link is not None else None
    if not isinstance(dataset, h5py.Dataset):
        return None
    if dataset.external or dataset.is_virtual:
        raise ValueError(f"the values of {name:.80} in its HDF5 lie in other files")
    if dataset.dtype.kind not in "biuf":
        raise ValueError(f"the values of {name:.80} in its HDF5 must be numbers, not {dataset.dtype}")
    check_pixels(f"a chunk of {name:.80}", *_rows_and_columns(dataset.chunks or ()))
    return dataset


def _rows_and_columns(shape: tuple[int, ...]) -> tuple[int, int]:
    """Return the first axis of a shape, and the product of the others."""
    return (shape[0] if shape else 1), math.prod(shape[1:])
