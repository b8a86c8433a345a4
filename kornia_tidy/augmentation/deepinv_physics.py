"""deepinv: the camera as a linear physics, so that its solvers restore captures.

Needs deepinv; nothing else of the package imports it.
"""

from __future__ import annotations

from typing import Any

from torch import Tensor

from kornia_tidy.augmentation.linear_camera import LinearCamera
from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.search_path import missing

try:
    from deepinv.physics import LinearPhysics  # ty: ignore[import-not-found]
except (ImportError, RuntimeError) as error:  # RuntimeError: it imports torchvision, which may not fit this torch
    raise missing("deepinv", "kornia_tidy.augmentation.deepinv_physics", error) from error


class CameraPhysics(LinearPhysics):
    """A camera at a known depth as a physics of deepinv: ``A``, ``A_adjoint``, and what follows from them.

    Args:
        optics: the camera, gather or scatter.
        depth: (B, 1, H, W), (1, 1, H, W) or (1, H, W), as the camera takes it.
        holes: as for :class:`~kornia_tidy.augmentation.LinearCamera`; the mask is ``physics.camera.valid``.
        options: of ``deepinv.physics.LinearPhysics``, such as ``noise_model=deepinv.physics.GaussianNoise(0.01)``.

    Raises:
        TypeError: as :class:`~kornia_tidy.augmentation.LinearCamera`.
        ValueError: as :class:`~kornia_tidy.augmentation.LinearCamera`.

    Convention:
        - Images are linear light, (B, C, H, W). The sensor of the camera is left out: ``noise_model`` replaces it.

    Example:
        >>> import torch
        >>> physics = CameraPhysics(TiDyOptics(), torch.full((1, 64, 64), 0.7))
        >>> y = physics(torch.rand(1, 3, 64, 64))
        >>> physics.A_adjoint(y).shape
        torch.Size([1, 3, 64, 64])
    """

    def __init__(self, optics: TiDyOptics, depth: Tensor, holes: str = "error", **options: Any) -> None:
        super().__init__(**options)
        self.camera = LinearCamera(optics, depth, holes)

    def A(self, x: Tensor, **kwargs: Any) -> Tensor:
        """Return the irradiance of linear light."""
        return self.camera(x)

    def A_adjoint(self, y: Tensor, **kwargs: Any) -> Tensor:
        """Return the transpose applied to an irradiance."""
        return self.camera.adjoint(y)
