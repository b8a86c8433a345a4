"""The camera as a linear operator at a known depth, with its transpose: what solvers of inverse problems need."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from kornia_tidy.camera.holes import fills_holes
from kornia_tidy.camera.samples import check_defocus
from kornia_tidy.camera.strips import Strip
from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.checks import check_choice, check_float_tensor, check_part
from kornia_tidy.mode import Mode, torch_mode
from kornia_tidy.optics.holes import HOLES, fill_holes
from kornia_tidy.psf.field import Field, check_centers
from kornia_tidy.psf.psf_bank import PSFBank

_WANTED = [True, False, False, False, False]  # of image, defocus, nodes, PSFs and stray light


class LinearCamera(nn.Module):
    r"""The optics of a camera for one depth map: :math:`y = A x` from the scene's linear light to the irradiance.

    Colour spaces and the sensor, which are not linear, are left out: images are linear light.

    Args:
        optics: the camera, gather or scatter. It is shared: A follows its masks at each call.
        depth: (B, 1, H, W), (1, 1, H, W) or (1, H, W), as the camera takes it.
        holes: ``"fill"`` fills holes of the depth from the nearest known pixel, as :func:`kornia_tidy.data.fill_holes`
            does; ``"error"`` leaves them to the camera. :attr:`valid` is False where they were.
        field_center: where the middle of the picture lies from the axis of a lens, (2,), or of each image, (B, 2): y
            and x in sensor pixels. Default: the camera's.

    Shape:
        - ``camera(x)``: (B, C, H, W) linear light to (B, C, H, W) irradiance, smaller for the border ``"valid"``.
        - ``camera.adjoint(y)``: the irradiance's shape to that of the light.

    Raises:
        TypeError: if ``optics`` is not a camera, or the depth is not a floating-point tensor.
        ValueError: if compositing is occlusion, which is not linear, the spectrum has a basis, or a depth is not
            positive; on use, if an image has another size or batch than the depth.

    Convention:
        - Gradients reach x, y and, through ``camera(x)``, the masks.
        - Computed in float32 or better; the result has the argument's type.

    Source: Claerbout: Earth Soundings Analysis, 1992, for the adjoint and its dot-product test.

    Example:
        >>> camera = LinearCamera(TiDyOptics(), torch.full((1, 64, 64), 0.7))
        >>> x, y = torch.rand(1, 3, 64, 64), torch.rand(1, 3, 64, 64)
        >>> bool(((camera(x) * y).sum() / (x * camera.adjoint(y)).sum() - 1).abs() < 1e-4)
        True
    """

    depth: Tensor
    valid: Tensor | None
    """Where the depth was known, (B, 1, H, W) bool, if holes are filled."""

    def __init__(self, optics: TiDyOptics, depth: Tensor, holes: str = "error", field_center: Any = None) -> None:
        super().__init__()
        check_part("optics", optics, TiDyOptics, "a camera such as TiDyOptics()")
        if optics.compositing == "occlusion":
            raise ValueError("a linear camera needs compositing 'gather' or 'scatter', got 'occlusion'")
        if optics.spectrum.basis is not None:
            raise ValueError("a linear camera needs colours without spectra of their own, got a spectrum with a basis")
        check_float_tensor("depth", depth, 3 if depth.ndim == 3 else 4, "(B, 1, H, W) or (1, H, W)")
        check_choice("holes", holes, HOLES)
        self.optics = optics
        self.field_center = field_center
        depth, valid = depth[None] if depth.ndim == 3 else depth, None
        if fills_holes(optics, holes):
            depth, valid = fill_holes(depth)
        self.register_buffer("depth", depth, persistent=False)
        self.register_buffer("valid", valid, persistent=False)
        check_defocus(depth, optics)  # raises, and warns
        if field_center is not None and len(depth) > 1:
            check_centers(field_center, len(depth))  # raises; with one depth, places are checked on use

    def forward(self, light: Tensor) -> Tensor:
        """Return the irradiance A x of linear light x."""
        check_float_tensor("light", light, 4, "(B, C, H, W)")
        self._check("light", light, (self.depth.shape[-2], self.depth.shape[-1]))
        if self._fields(len(light)) or Mode.TRANSFORM in torch_mode():
            return self._blurred(light)
        scene, options = self._scene(light.shape[1], light.dtype)
        image = light.to(scene[0].dtype)
        return torch.ops.kornia_tidy.render_layers(image, *scene, *options).to(light.dtype)

    def adjoint(self, irradiance: Tensor) -> Tensor:
        """Return the transpose of the camera applied to an irradiance y: light of the scene's size."""
        check_float_tensor("irradiance", irradiance, 4, "(B, C, H, W)")
        cut = self.optics.window - 1 if self.optics.border == "valid" else 0
        rows, columns = self.depth.shape[-2:]
        self._check("irradiance", irradiance, (rows - cut, columns - cut))
        if Mode.TRANSFORM in torch_mode():
            dark = irradiance.new_zeros(*irradiance.shape[:2], rows, columns)
            return torch.func.vjp(self.forward, dark)[1](irradiance)[0]
        if self._fields(len(irradiance)):
            return _Transpose.apply(irradiance, self._blurred, (rows, columns))
        scene, options = self._scene(irradiance.shape[1], irradiance.dtype)
        plain = [part if part is None else part.detach() for part in scene]
        return _Adjoint.apply(irradiance.to(plain[0].dtype), *plain, *options).to(irradiance.dtype)

    def _fields(self, count: int) -> tuple[Field, ...]:
        """Return where the images of a batch lie in the field: one place, or one for each; none of an ideal lens."""
        size = self.depth.shape[-2], self.depth.shape[-1]
        centers = check_centers(self.optics.field_center if self.field_center is None else self.field_center, count)
        found = [self.optics.psf_model.field_of(size, center) for center in centers]
        return tuple(field for field in found if field is not None)

    def _blurred(self, light: Tensor) -> Tensor:
        optics, dtype = self.optics, self._dtype(light.dtype)
        defocus = optics.camera.defocus(self.depth.to(dtype), optics.check_inputs)
        strip = Strip(light.to(dtype), defocus, defocus, optics.border, fields=self._fields(len(light)))
        return optics.blurred(strip).to(light.dtype)

    def _dtype(self, dtype: torch.dtype) -> torch.dtype:
        return torch.promote_types(dtype, torch.float64 if self.optics.fidelity.double else torch.float32)

    def _check(self, name: str, image: Tensor, size: tuple[int, int]) -> None:
        """Raise unless an image has the size and the batch that the depth map is for."""
        if tuple(image.shape[-2:]) != size or self.depth.shape[0] not in (1, image.shape[0]):
            raise ValueError(
                f"{name} must have {size[0]} x {size[1]} pixels and the batch of the depth {tuple(self.depth.shape)}, "
                f"got {tuple(image.shape)}"
            )

    def _scene(self, channels: int, dtype: torch.dtype) -> tuple[list[Any], list[Any]]:
        """Return defocus, nodes, PSFs and stray light, and the options of the renderer."""
        dtype = self._dtype(dtype)
        now = self.optics
        defocus = now.camera.defocus(self.depth.to(dtype), now.check_inputs)
        bank: PSFBank = now.psf_model.scene_bank(channels, dtype, defocus)
        fidelity = now.psf_model.fidelity
        layers = "nearest" if fidelity.layers == "nearest" else "linear"
        options = [now.compositing, layers, now.border, fidelity.correlate, [], "auto"]
        return [defocus, bank.defocus, bank.psfs, bank.veil], options


class _Transpose(torch.autograd.Function):
    """Transpose of a linear function, found by its gradient; its own gradient is the function."""

    @staticmethod
    def forward(ctx: Any, seen: Tensor, function: Callable[[Tensor], Tensor], size: tuple[int, int]) -> Tensor:
        ctx.function = function
        with torch.enable_grad():
            light = seen.new_zeros(*seen.shape[:2], *size).requires_grad_()
            return torch.autograd.grad(function(light), light, seen)[0]

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        return ctx.function(gradients[0]), None, None


class _Adjoint(torch.autograd.Function):
    """Adjoint of the renderer as a function of autograd: its gradient is the renderer."""

    @staticmethod
    def forward(ctx: Any, irradiance: Tensor, defocus: Tensor, nodes: Tensor, psfs: Tensor, *rest: Any) -> Tensor:
        ctx.save_for_backward(defocus, nodes, psfs, rest[0])
        ctx.options = rest[1:]
        light = irradiance.new_zeros(*irradiance.shape[:2], *defocus.shape[-2:])
        scene = (light, defocus, nodes, psfs, *rest)
        return torch.ops.kornia_tidy.render_layers_gradients(*scene, irradiance.contiguous(), _WANTED)[0]

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        rendered = torch.ops.kornia_tidy.render_layers(gradients[0].contiguous(), *ctx.saved_tensors, *ctx.options)
        return rendered, *(None,) * (4 + len(ctx.options))
