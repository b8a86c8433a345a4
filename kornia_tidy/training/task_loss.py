"""Losses by name, and the weighted loss of a task's maps."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from torch import Tensor

from kornia_tidy.reconstruction.depth_distribution import distribution_loss
from kornia_tidy.reconstruction.losses import l1_loss, mse_loss, phasecam3d_loss

Loss = Callable[[Tensor, Tensor, Tensor | None], Tensor]
"""From prediction (B, C, H, W), target (B, C, H, W) and validity mask, bool (B, 1, H, W) or None, to a scalar."""

# That of TiDy-PSFs, of Ikoma et al. for depth, and of PhaseCam3D for depth; each is applied to every map of a task.
LOSSES: dict[str, Loss] = {"mse": mse_loss, "l1": l1_loss, "phasecam3d": phasecam3d_loss}


def task_loss(
    loss: Loss,
    estimate: Mapping[str, Tensor],
    truth: Mapping[str, Tensor],
    mask: Tensor,
    weights: Mapping[str, float],
    logits: Tensor | None = None,
) -> Tensor:
    """Return the weighted sum of the losses of a task's maps.

    Args:
        loss: of one map.
        estimate: maps by name, each (B, C, H, W).
        truth: the true maps by name.
        mask: bool (B, 1, H, W), True where depth is known. The image is known everywhere.
        weights: factor of each map's loss by name.
        logits: those of the distribution of depth, (B, D, H, W), if the network estimates one. The loss of depth is
            then :func:`~kornia_tidy.reconstruction.depth_distribution.distribution_loss` instead of ``loss``.

    Convention:
        The depth loss of a batch without any known depth, such as a crop inside a hole, is zero.
    """
    terms = []
    for name, maps in estimate.items():
        if name == "depth" and logits is not None:
            terms.append(weights[name] * distribution_loss(logits, truth[name], mask))
        elif name == "depth" and not bool(mask.any()):
            terms.append(0 * maps.sum())
        else:
            terms.append(weights[name] * loss(maps, truth[name], mask if name == "depth" else None))
    return sum(terms[1:], terms[0])
