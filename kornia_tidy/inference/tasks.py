"""The three tasks: what a network estimates from a capture, what the truth is, and how far both are apart."""

from __future__ import annotations

from torch import Tensor

from kornia_tidy.checks import check_choice
from kornia_tidy.optics.thin_lens import DefocusRange, ThinLensCamera

MAPS = {"edof": {"image": 3}, "depth": {"depth": 1}, "joint": {"depth": 1, "image": 3}}  # and their channels, in order


def channels_of(task: str) -> int:
    """Return how many channels a head needs for a task.

    Example:
        >>> channels_of("joint")
        4
    """
    check_choice("task", task, tuple(MAPS))
    return sum(MAPS[task].values())


def split_maps(task: str, output: Tensor) -> dict[str, Tensor]:
    """Return the channels of a head's output by name: ``"depth"`` (B, 1, H, W), then ``"image"`` (B, 3, H, W)."""
    if output.ndim != 4 or output.shape[1] != channels_of(task):
        raise ValueError(f"a head for the task {task!r} must return (B, {channels_of(task)}, H, W), got {output.shape}")
    return dict(zip(MAPS[task], output.split(list(MAPS[task].values()), 1), strict=True))


def nearness(camera: ThinLensCamera | DefocusRange, depth: Tensor) -> Tensor:
    r"""Return depth as networks learn it: 0 at the far end of the camera's range, 1 at the near one.

    .. math:: n = (\psi(z) - \psi_{min}) / (\psi_{max} - \psi_{min})

    It is linear in defocus, so in inverse depth, as the normalised disparity of the paper's data; infinity is a number.

    Args:
        camera: what turns depth into defocus.
        depth: (B, 1, H, W), as the camera takes it.

    Returns:
        Same shape, in [0, 1]; depths beyond the camera's range have its ends.

    Example:
        >>> import torch
        >>> nearness(ThinLensCamera(), torch.tensor([0.2975, 0.595, float("inf")]))
        tensor([1.0000, 0.5000, 0.0000])
    """
    lo, hi = camera.defocus_range
    return ((camera.defocus(depth, check_inputs=False) - lo) / (hi - lo)).clamp(0, 1)


def metres(camera: ThinLensCamera, nearness: Tensor) -> Tensor:
    """Return the depth of what networks learn, the inverse of :func:`nearness`.

    Args:
        camera: as for :func:`nearness`, one that knows metres.
        nearness: any shape; beyond [0, 1] it is taken as the end of it.

    Returns:
        Same shape, metres from the near to the far end of the camera's range, which may be infinite.

    Example:
        >>> import torch
        >>> metres(ThinLensCamera(), torch.tensor([1.0, 0.5, 0.0]))
        tensor([0.2975, 0.5950,    inf])
    """
    lo, hi = camera.defocus_range
    return camera.depth(lo + (hi - lo) * nearness.clamp(0, 1))


def centre_crop(tensor: Tensor, height: int, width: int) -> Tensor:
    """Return the middle of a map, as a camera with the border ``"valid"`` crops its capture."""
    top, left = (tensor.shape[-2] - height) // 2, (tensor.shape[-1] - width) // 2
    return tensor[..., top : top + height, left : left + width]
