"""The three tasks: what a network estimates from a capture, what the truth is, and how far both are apart."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from torch import Tensor

from kornia_tidy.checks import check_choice
from kornia_tidy.optics.camera import DefocusRange, ThinLensCamera

MAPS = {"edof": {"image": 3}, "depth": {"depth": 1}, "joint": {"depth": 1, "image": 3}}  # and their channels, in order

Loss = Callable[[Tensor, Tensor, Tensor | None], Tensor]
"""From prediction (B, C, H, W), target (B, C, H, W) and validity, bool (B, 1, H, W) or None, to a scalar."""


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


def depth_of_nearness(camera: ThinLensCamera, near: Tensor) -> Tensor:
    r"""Return the depth that a nearness means, :func:`nearness` undone.

    .. math:: z = 1 / \left( \frac{1}{z_{far}} + n \left( \frac{1}{z_{near}} - \frac{1}{z_{far}} \right) \right)

    Args:
        camera: what turns depth into defocus.
        near: any shape; values outside [0, 1] count as its ends.

    Returns:
        Metres, same shape: the ends of the camera's range at 0 and 1; infinite at 0 if its far end is.

    Example:
        >>> import torch
        >>> depth_of_nearness(ThinLensCamera(), torch.tensor([1.0, 0.5, 0.0]))
        tensor([0.2975, 0.5950,    inf])
    """
    closest, farthest = (1 / end for end in camera.depth_range)
    return near.clamp(0, 1).mul_(closest - farthest).add_(farthest).reciprocal_()


def mean_square(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the mean squared error over all valid samples of the batch, the paper's loss.

    Example:
        >>> import torch
        >>> mean_square(torch.zeros(1, 1, 1, 2), torch.tensor([2.0, 5.0]).view(1, 1, 1, 2))
        tensor(14.5000)
    """
    if mask is None:
        return (prediction - target).square().mean()
    mask = mask.expand_as(target)
    error = (prediction - target.where(mask, prediction.detach())).where(mask, 0)
    return error.square().sum() / mask.sum().clamp(min=1)


def task_loss(
    loss: Loss, estimate: Mapping[str, Tensor], truth: Mapping[str, Tensor], mask: Tensor, weights: Mapping[str, float]
) -> Tensor:
    """Return the weighted sum of the losses of a task's maps. The mask is that of the depth; images are known."""
    terms = [weights[name] * loss(estimate[name], truth[name], mask if name == "depth" else None) for name in estimate]
    return sum(terms[1:], terms[0])


def image_rmse(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the root mean squared error of each image, (B,), over its valid pixels; NaN if it has none."""
    if mask is None:
        return (prediction - target).square().mean((1, 2, 3)).sqrt()
    mask = mask.expand_as(target)
    squares = (prediction - target).square().where(mask, 0).sum((1, 2, 3))
    return (squares / mask.sum((1, 2, 3))).sqrt()


def centre_crop(tensor: Tensor, height: int, width: int) -> Tensor:
    """Return the middle of a map, as a camera with the border ``"valid"`` crops its capture."""
    top, left = (tensor.shape[-2] - height) // 2, (tensor.shape[-1] - width) // 2
    return tensor[..., top : top + height, left : left + width]
