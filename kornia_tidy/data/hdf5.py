"""HDF5 files that hold one map, as Hypersim has them."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAGIC = b"\x89HDF\r\n\x1a\n"


def decode_hdf5(data: bytes) -> NDArray[Any]:
    """Decode the only data set of an HDF5 file. It needs ``pip install 'kornia-tidy[data]'``.

    Args:
        data: bytes of the file.

    Raises:
        ImportError: if h5py is missing.
        ValueError: if the file is damaged, or holds no data set or several.
    """
    try:
        import h5py  # noqa: PLC0415 - an extra, and slow to import
    except ImportError:
        raise ImportError("an HDF5 file needs h5py: pip install 'kornia-tidy[data]'") from None
    try:
        with h5py.File(io.BytesIO(data), "r") as file:
            names = list(file)
            if len(names) != 1 or not isinstance(file[names[0]], h5py.Dataset):
                raise ValueError(f"its HDF5 must hold one data set alone, found {', '.join(names)[:80] or 'none'}")
            return np.asarray(file[names[0]][()])
    except (OSError, RuntimeError, KeyError) as error:
        raise ValueError(f"its HDF5 is damaged: {error!s:.200}") from error
