"""HDF5 files that hold one map, as Hypersim has them, and what their attributes say of its numbers."""

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
_MISSING = ("_FillValue", "missing_value")
_METRES = {
    unit: metres
    for short, long, metres in (("m", "", 1.0), ("cm", "centi", 1e-2), ("mm", "milli", 1e-3), ("km", "kilo", 1e3))
    for unit in (short, f"{long}meter", f"{long}metre")
}


def decode_hdf5(data: bytes) -> tuple[NDArray[Any], NDArray[np.bool_] | None, float]:
    """Decode the only data set of an HDF5 file. It needs ``pip install 'kornia-tidy[data]'``.

    Args:
        data: bytes of the file.

    Returns:
        values: as they are stored.
        unknown: True where they are the missing value of the attributes; None if these name none.
        scale: metres in a unit by the attributes; 1 if they do not say it.

    Raises:
        ImportError: if h5py is missing.
        ValueError: if the file is damaged, or holds no data set or several, or a data set in it that does not hold a
            map of numbers, or whose attributes give an offset for them.

    Source: NetCDF Climate and Forecast Metadata Conventions 1.11, sections 2.5.1, 3.1 and 8.1.
    """
    h5py = import_extra("h5py", "an HDF5 file")  # slow to import
    try:
        with h5py.File(io.BytesIO(data), "r") as file:
            names = list(file)
            dataset = stored_numbers(file, names[0]) if len(names) == 1 else None
            if dataset is None:
                raise ValueError(f"its HDF5 must hold only one data set, found {', '.join(names)[:80] or 'none'}")
            check_pixels("the map", *_rows_and_columns(dataset.shape))
            values = np.asarray(dataset[()])
            return values, *_meaning(values, dataset.attrs)
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


def _meaning(values: NDArray[Any], attributes: Any) -> tuple[NDArray[np.bool_] | None, float]:
    """Return where values are missing by the attributes, None if these do not say it, and the metres in a unit."""
    given = {
        name: np.ravel(attributes[name]) for name in (*_MISSING, "scale_factor", "add_offset") if name in attributes
    }
    numbers = {name: value[0] for name, value in given.items() if value.size == 1 and value.dtype.kind in "iuf"}
    if numbers.get("add_offset", 0):
        raise ValueError(f"its numbers are to be changed by add_offset {numbers['add_offset']:g}: save the depths")
    unit = attributes.get("units", "")
    unit = unit.decode("ascii", "replace") if isinstance(unit, bytes) else str(unit)
    metres = _METRES.get(unit.strip().lower().removesuffix("s"), 1.0)
    missing = [values == numbers[name] for name in _MISSING if name in numbers]
    return np.logical_or.reduce(missing) if missing else None, float(numbers.get("scale_factor", 1)) * metres


def _rows_and_columns(shape: tuple[int, ...]) -> tuple[int, int]:
    """Return the first axis of a shape, and the product of the others."""
    return (shape[0] if shape else 1), math.prod(shape[1:])
