"""The three tasks of reconstruction, their maps, and depth as normalised inverse depth."""

from __future__ import annotations

import torch
from torch import Tensor

from kornia_tidy.checks import check_choice
from kornia_tidy.data.depth_range import middle_depths
from kornia_tidy.optics.thin_lens import DefocusRange, ThinLensCamera
from kornia_tidy.reconstruction.depth_distribution import depth_moments

MAPS = {"edof": {"image": 3}, "depth": {"depth": 1}, "joint": {"depth": 1, "image": 3}}  # with channels, in order


def channels_of(task: str) -> int:
    """Return the number of output channels of a network for a task.

    Example:
        >>> channels_of("joint")
        4
    """
    check_choice("task", task, tuple(MAPS))
    return sum(MAPS[task].values())


def split_maps(task: str, output: Tensor) -> dict[str, Tensor]:
    """Return a network's output as maps by name, ``"depth"`` (B, 1, H, W) and ``"image"`` (B, 3, H, W).

    The depth of a network that estimates a distribution is the mean, see :func:`depth_logits`.
    """
    if (logits := depth_logits(task, output)) is not None:
        return {"depth": depth_moments(logits)[0], "image": output[:, -MAPS[task]["image"] :]}
    if output.ndim != 4 or output.shape[1] != channels_of(task):
        raise ValueError(f"a head for the task {task!r} must return (B, {channels_of(task)}, H, W), got {output.shape}")
    return dict(zip(MAPS[task], output.split(list(MAPS[task].values()), 1), strict=True))


def depth_logits(task: str, output: Tensor) -> Tensor | None:
    """Return the logits of a network's distribution of depth, (B, D, H, W); None if it estimates one value a pixel.

    A network for the task ``"joint"`` with a distribution of depth, such as
    :class:`~kornia_tidy.reconstruction.LayeredJointHead`, returns D + 3 channels, with the image last.

    Example:
        >>> depth_logits("joint", torch.rand(1, 19, 4, 4)).shape, depth_logits("joint", torch.rand(1, 4, 4, 4))
        (torch.Size([1, 16, 4, 4]), None)
    """
    if task != "joint" or output.ndim != 4 or output.shape[1] <= channels_of(task):
        return None
    return output[:, : -MAPS[task]["image"]]


def normalised_inverse_depth(camera: ThinLensCamera | DefocusRange, depth: Tensor) -> Tensor:
    r"""Return the normalised inverse depth that networks estimate: 0 at the far end of the range, 1 at the near end.

    .. math:: n = (\psi(z) - \psi_{min}) / (\psi_{max} - \psi_{min})

    It is linear in defocus, and so in inverse depth, as is the normalised disparity of the paper's data. It is finite
    at infinity.

    Args:
        camera: the lens that turns depth into defocus.
        depth: (B, 1, H, W), as the camera takes it.

    Returns:
        Same shape, in [0, 1]; depths beyond the camera's range are clamped.

    Example:
        >>> import torch
        >>> normalised_inverse_depth(ThinLensCamera(), torch.tensor([0.2975, 0.595, float("inf")]))
        tensor([1.0000, 0.5000, 0.0000])
    """
    lo, hi = camera.defocus_range
    return ((camera.defocus(depth, check_inputs=False) - lo) / (hi - lo)).clamp(0, 1)


def metres(camera: ThinLensCamera, inverse_depth: Tensor) -> Tensor:
    """Return depth in metres from normalised inverse depth, the inverse of :func:`normalised_inverse_depth`.

    Args:
        camera: a lens with metric scale.
        inverse_depth: any shape; values are clamped to [0, 1].

    Returns:
        Same shape, metres from the near to the far end of the camera's range, which may be infinite.

    Example:
        >>> import torch
        >>> metres(ThinLensCamera(), torch.tensor([1.0, 0.5, 0.0]))
        tensor([0.2975, 0.5950,    inf])
    """
    lo, hi = camera.defocus_range
    return camera.depth(lo + (hi - lo) * inverse_depth.clamp(0, 1))


def stretched(depth: Tensor, valid: Tensor, camera: ThinLensCamera) -> Tensor:
    """Stretch the depths of a scene, linearly in dioptres, over a camera's range.

    Example:
        >>> import torch
        >>> depth = torch.tensor([[[2.0, 3.0, 6.0]]])
        >>> stretched(depth, depth > 0, ThinLensCamera()).round(decimals=4)
        tensor([[[0.2975, 0.5950,    inf]]])
    """
    near, far = (1 / end for end in middle_depths(depth, valid))
    return metres(camera, ((1 / depth - far) / (near - far)))


def deviation_in_metres(camera: ThinLensCamera, inverse_depth: Tensor, deviation: Tensor) -> Tensor:
    r"""Return the uncertainty of depth in metres: half the distance between one deviation nearer and one farther.

    .. math:: \sigma_z = \big( z(n - \sigma_n) - z(n + \sigma_n) \big) / 2

    Args:
        camera: a lens with metric scale.
        inverse_depth: normalised inverse depth n, any shape.
        deviation: its standard deviation, same shape, in parts of the range.

    Returns:
        Same shape. Infinite where one deviation farther is infinitely far: nothing then bounds the depth in metres.

    Example:
        >>> deviation_in_metres(ThinLensCamera(), torch.tensor([0.5, 0.5, 0.05]), torch.tensor([0.0, 0.1, 0.28]))
        tensor([0.0000, 0.1240,    inf])
    """
    far, near = metres(camera, inverse_depth - deviation), metres(camera, inverse_depth + deviation)
    return torch.where(far.isinf(), far, (far - near) / 2)


def centre_crop(tensor: Tensor, height: int, width: int) -> Tensor:
    """Return the central part of a map, to which a camera with the border ``"valid"`` crops its capture."""
    top, left = (tensor.shape[-2] - height) // 2, (tensor.shape[-1] - width) // 2
    return tensor[..., top : top + height, left : left + width]
