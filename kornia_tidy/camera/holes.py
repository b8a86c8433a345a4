"""Forms of samples and holes of their depth: who fills them, and how the mask of known pixels comes back."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
from torch import Tensor

from kornia_tidy.arrays import as_array
from kornia_tidy.optics.holes import fill_holes
from kornia_tidy.optics.thin_lens import DefocusRange

DEPTH_KEYS = ("depth", "mask_depth")  # the second is how kornia's containers know a map that must be warped


def names_in(
    sample: Mapping[str, Any], image: str = "image", depths: Sequence[str] = DEPTH_KEYS, remedy: str = ""
) -> tuple[str, str]:
    """Return the names of image and depth in a mapping.

    Args:
        sample: the mapping.
        image: name of the image.
        depths: possible names of the depth.
        remedy: to be put behind the message.

    Raises:
        KeyError: if there is no image, or not one depth.

    Example:
        >>> names_in({"mask_depth": None, "image": None})
        ('image', 'mask_depth')
    """
    found = [name for name in depths if name in sample]
    if image not in sample or len(found) != 1:
        raise KeyError(
            f"a mapping sample needs an {image!r}, and its depth under {' or '.join(map(repr, depths))}"
            f"{', in one place only' if len(found) > 1 else ''}, got the keys {list(sample)}{remedy}"
        )
    return image, found[0]


def with_parts(sample: Any, image: Any, depth: Any, valid: Any) -> Any:
    """Return a tuple or list ``(image, depth, ...)`` with other parts, a named one with its field ``valid`` too.

    Args:
        sample: the tuple or list.
        image: in the place of its image.
        depth: in the place of its depth.
        valid: in the place of its mask of valid pixels; None leaves that.

    Example:
        >>> with_parts(["image", "depth", 3], "coded", "depth", None)
        ['coded', 'depth', 3]
    """
    parts, make = [image, depth, *sample[2:]], cast("Any", type(sample))
    if not hasattr(sample, "_fields"):
        return make(parts)
    if valid is not None and "valid" in sample._fields:
        parts[sample._fields.index("valid")] = valid
    return make(*parts)


def fills_holes(optics: Any, holes: str = "error") -> bool:
    """Return whether holes of the depth are filled, by an adapter or by the optics that it calls.

    Args:
        optics: a :class:`~kornia_tidy.TiDyOptics`, or an augmentation that reads depth.
        holes: setting of the adapter, ``"error"`` or ``"fill"``.

    Raises:
        ValueError: if they would be, and the camera takes disparity, in which 0 is a value.

    Example:
        >>> from kornia_tidy import TiDyOptics
        >>> fills_holes(TiDyOptics()), fills_holes(TiDyOptics(), "fill"), fills_holes(TiDyOptics(holes="fill"))
        (False, True, True)
    """
    camera = getattr(optics, "optics", optics)  # of an augmentation
    filled = "fill" in {holes, *(getattr(part, "holes", "error") for part in (optics, camera))}
    if filled and isinstance(getattr(camera, "camera", None), DefocusRange):
        raise ValueError(
            "holes='fill' takes a depth of 0 as unknown, and to a DefocusRange 0 is the far end: fill the holes of "
            "its disparity before the call, and leave holes='error'"
        )
    return filled


def filled_depth(depth: Any) -> tuple[Any, Any]:
    """Fill the holes of a depth map as a tensor, an array or a PIL image. See :func:`kornia_tidy.data.fill_holes`.

    Returns:
        The depth in its kind, and where it was known: a tensor of bool for a tensor, else an array.

    Example:
        >>> import numpy as np
        >>> filled_depth(np.array([[500, 0, 2000]], np.uint16))
        (array([[ 500,  500, 2000]], dtype=uint16), array([[ True, False,  True]]))
    """
    if isinstance(depth, Tensor):
        return fill_holes(depth if type(depth) is Tensor else depth.as_subclass(Tensor))
    filled, valid = fill_holes(as_array("depth", depth))
    return (filled if isinstance(depth, np.ndarray) else sys.modules["PIL.Image"].fromarray(filled)), valid


def with_filled(sample: Any, depth: Any, valid: Any, names: Sequence[str] = DEPTH_KEYS) -> Any:
    """Return a sample with its depth filled, and the mask of known pixels where it has a place for one.

    Args:
        sample: a mapping, which gets the mask under ``"valid"``; a named tuple, which gets it in a field ``valid``; or
            another tuple or list ``(image, depth, ...)``, which has no place for it.
        depth: without holes.
        valid: where the depth was known. The returned mask is also False where the sample's is.
        names: under which a mapping may have the depth.

    Example:
        >>> import torch
        >>> valid = torch.tensor([[True, False]])
        >>> with_filled({"image": None, "depth": None, "mask": ~valid}, torch.ones(1, 2), valid)["valid"]
        tensor([[False, False]])
    """
    if isinstance(sample, Mapping):
        name = next(name for name in names if name in sample)
        return {**sample, name: depth, "valid": known_in(sample, valid)}
    earlier = getattr(sample, "valid", None)
    return with_parts(sample, sample[0], depth, valid if earlier is None else both_valid(valid, earlier))


def both_valid(valid: Any, earlier: Any) -> Any:
    """Return where two masks of valid pixels are both true.

    Args:
        valid: bool.
        earlier: of any type, true where it is positive.

    Raises:
        ValueError: if their shapes differ.
    """
    shape, found = tuple(valid.shape), tuple(getattr(earlier, "shape", ()))
    if shape != found:
        raise ValueError(f"valid must have the depth's shape {shape}, got {found}")
    return valid & (earlier > 0)


def known_in(sample: Mapping[str, Any], valid: Any) -> Any:
    """Return where a depth was known, less the pixels that the mapping says are not valid.

    Args:
        sample: may have an entry ``"valid"``, or a ``"mask"`` of bool in the shape of ``valid``.
        valid: where the depth has no hole, bool.
    """
    if (earlier := sample.get("valid")) is not None:
        valid = both_valid(valid, earlier)
    mask = sample.get("mask")
    if isinstance(mask, type(valid)) and mask.dtype == valid.dtype and mask.shape == valid.shape:
        valid = valid & mask
    return valid
