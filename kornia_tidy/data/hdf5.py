"""HDF5 files that hold one map, as Hypersim has them, and what their attributes say of its numbers."""

from __future__ import annotations

import io
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kornia_tidy.data.picture_header import check_pixels
from kornia_tidy.optics.units import metres_in
from kornia_tidy.search_path import import_extra, import_installed

DAMAGE = (OSError, OverflowError, RuntimeError, KeyError, TypeError, AttributeError)  # of h5py on damaged files
MAGIC = b"\x89HDF\r\n\x1a\n"
_MISSING = ("_FillValue", "missing_value")
_UNITS = ("units", "unit", "Units", "Unit")


def decode_hdf5(data: bytes) -> tuple[NDArray[Any], NDArray[np.bool_] | None, float]:
    """Decode the only data set of an HDF5 file. It needs ``pip install 'kornia-tidy[data]'``.

    Args:
        data: bytes of the file.

    Returns:
        values: as they are stored.
        unknown: True where they are a missing value of the attributes or outside their valid range; None if these name
            none.
        scale: metres in a unit by the attributes; 1 if they do not say it.

    Raises:
        ImportError: if h5py is missing.
        ValueError: if the file is damaged, or holds no data set or several beside the coordinates of axes, or one that
            does not hold a map of numbers, or whose attributes give an offset for them, a factor that is not positive,
            or a unit of inverse depth.

    Source: NetCDF Climate and Forecast Metadata Conventions 1.11, sections 2.5.1, 3.1 and 8.1; NetCDF Users Guide,
    attribute conventions (``_Unsigned``).
    """
    h5py = import_extra("h5py", "an HDF5 file")  # slow to import
    try:
        with h5py.File(io.BytesIO(data), "r") as file:
            names = [name for name in file if not _is_axis(file, name)]
            dataset = stored_numbers(file, names[0]) if len(names) == 1 else None
            if dataset is None:
                raise ValueError(f"its HDF5 must hold only one data set, found {', '.join(names)[:80] or 'none'}")
            check_pixels("the map", *_rows_and_columns(dataset.shape))
            values = np.asarray(dataset[()])
            return _meaning(values, dataset.attrs)
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
    if not isinstance(dataset, h5py.Dataset) or dataset.shape is None:  # of an empty one
        return None
    if dataset.external or dataset.is_virtual:
        raise ValueError(f"the values of {name:.80} in its HDF5 lie in other files")
    if dataset.dtype.kind not in "biuf":
        raise ValueError(f"the values of {name:.80} in its HDF5 must be numbers, not {dataset.dtype}")
    check_pixels(f"a chunk of {name:.80}", *_rows_and_columns(dataset.chunks or ()))
    return dataset


def _is_axis(file: Any, name: str) -> bool:
    """Return whether a data set holds the coordinates along an axis of others, as NetCDF 4 has them."""
    h5py = import_installed("h5py")
    found = file[name] if isinstance(file.get(name, getlink=True), h5py.HardLink) else None
    return isinstance(found, h5py.Dataset) and found.ndim == 1 and h5py.h5ds.is_scale(found.id)


def _meaning(values: NDArray[Any], attributes: Any) -> tuple[NDArray[Any], NDArray[np.bool_] | None, float]:
    """Return values, where they are missing by their attributes, None if these do not say it, and metres in a unit."""
    stored, meant = values.dtype, values.dtype
    if _texts(attributes, "_Unsigned")[:1] in (["true"], ["True"]):
        meant = np.dtype(stored.str.replace("i", "u"))

    def numbers(name: str) -> NDArray[Any]:
        found = np.ravel(attributes[name]) if name in attributes else np.empty(0)
        found = found if found.dtype.kind in "iuf" else np.empty(0)
        return found.view(meant) if found.dtype == stored else found

    for name, least, most in (("add_offset", 0, 0), ("scale_factor", 5e-324, np.finfo(float).max)):
        given = np.ravel(attributes.get(name, []))
        if given.size and not (numbers(name).size == 1 and least <= numbers(name)[0] <= most):
            raise ValueError(
                f"its numbers are to be changed by {name} {given.tolist()!s:.40}: save the depths themselves"
            )
    values = values.view(meant)
    missing = [values == number for name in _MISSING for number in numbers(name)]
    missing += [values < least for name in ("valid_min", "valid_range") for least in numbers(name)[:1]]
    missing += [values > most for name in ("valid_max", "valid_range") for most in numbers(name)[-1:]]
    metres = math.prod(metres_in(unit) for name in _UNITS for unit in _texts(attributes, name)[:1])
    scale = float(next(iter(numbers("scale_factor")), 1)) * metres
    return values, np.logical_or.reduce(missing) if missing else None, scale


def _texts(attributes: Any, name: str) -> list[str]:
    """Return the texts of an attribute, of which there may be one or many."""
    found = np.ravel(attributes[name]).tolist() if name in attributes else []
    return [text.decode("utf-8", "replace") if isinstance(text, bytes) else str(text) for text in found]


def _rows_and_columns(shape: tuple[int, ...]) -> tuple[int, int]:
    """Return the first axis of a shape, and the product of the others."""
    return (shape[0] if shape else 1), math.prod(shape[1:])
