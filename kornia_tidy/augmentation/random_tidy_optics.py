"""RandomTiDyOptics: a programmable camera as an augmentation of kornia, with settings drawn for each image."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from itertools import product
from typing import Any

import torch
from torch import Tensor

from kornia_tidy.augmentation.depth_augmentation import DepthAugmentation
from kornia_tidy.augmentation.drawn_camera import DrawnOptics, RowSensors, drawn_camera, sensor_with
from kornia_tidy.augmentation.lens_argument import lens_optics, lens_parts
from kornia_tidy.augmentation.ranges import Range, checked_range, uniform_draws
from kornia_tidy.augmentation.rows import row_places, row_seeds
from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.optics.lens.lens import Lens

_OF_OPTICS = ("focus_distance", "aperture_diameter", "mask_jitter", "switching_time")


class RandomTiDyOptics(DepthAugmentation):
    r"""Capture images with a programmable camera; each image has random settings.

    Args:
        optics: the camera. Default: ``TiDyOptics()``. Gradients reach its masks.
        exposure: range of the factor of light before the sensor; 1 leaves it.
        focus_distance: range in metres.
        aperture_diameter: range in metres. The light of the image stays the same, as with automatic exposure.
        mask_jitter: range of the standard deviation of the phase error of each mask pixel, radians at 530 nm.
        noise_level: range of the standard deviation of the sensor's read noise, in units of full scale.
        switching_time: range of the duration of a transition between masks, in seconds.
        same_on_batch: one draw for the whole batch, noise included.
        p: probability of each image to be taken. Images that are not are not computed.
        keepdim: return (C, H, W) for (C, H, W).
        holes: ``"fill"`` fills holes of the depth from the nearest known pixel, as :func:`kornia_tidy.data.fill_holes`
            does; ``"error"`` leaves them to the camera.
        lens: a real lens of the default camera, or its name; ``optics`` has its own.

    Shape:
        - ``augmentation(image, depth)``: (B, C, H, W) and (B, 1, H, W) or (1, 1, H, W), or both without B, to the
          shape of the image, (1, C, H, W) for (C, H, W) without ``keepdim``.
        - Inside kornia's containers see :class:`~kornia_tidy.augmentation.DepthTap` and
          :func:`~kornia_tidy.augmentation.bound_depth`. For tuples and mappings see
          :class:`~kornia_tidy.augmentation.OpticsPipeline`.

    Raises:
        TypeError: if the camera lacks the part that a range is for.
        ValueError: if a range is empty or outside the camera's limits, ``p`` is not from 0 to 1, or the camera's
            border is ``"valid"``, which gives smaller images; on use, as :class:`~kornia_tidy.TiDyOptics`.

    Convention:
        - Each value is uniform in its range. None leaves that of the camera.
        - ``params``, such as ``augmentation._params`` after a call, holds the draws and a seed for each image, from
          which noise and phase errors follow: the same ``params`` give the same bits.
        - Draws come from the global generator of torch, as kornia's do.
        - Depth is read in float32 or better, whatever the image's type.
        - Images with the same lens are captured together; each other lens has its own PSFs. So
          ``focus_distance``, ``aperture_diameter``, ``mask_jitter`` and ``switching_time`` cost more than ``exposure``
          and ``noise_level``.
        - Matrices of drawn lenses are remembered as those of other lenses are, in 256 MiB for each process at most.
        - Behind a lens each image is a crop from a place that is drawn over the lens's field, as far out as its corners
          allow, unless the camera's ``field_center`` or the geometry of a pipeline says the place. Each place has its
          own PSFs, which take about a second; ``same_on_batch`` shares them.
        - Compiled graphs call it eagerly.

    Source: Shah, Kulshrestha, Metzler: TiDy-PSFs, ICCV 2023, for the camera.

    Example:
        >>> augmentation = RandomTiDyOptics(focus_distance=(0.5, 0.8), exposure=(0.5, 1.0), p=1.0)
        >>> image, depth = torch.rand(2, 3, 64, 64), torch.full((2, 1, 64, 64), 0.7)
        >>> coded = augmentation(image, depth)
        >>> torch.equal(coded, augmentation(image, depth, params=augmentation._params))
        True
    """

    def __init__(
        self,
        optics: TiDyOptics | None = None,
        exposure: Range = None,
        focus_distance: Range = None,
        aperture_diameter: Range = None,
        mask_jitter: Range = None,
        noise_level: Range = None,
        switching_time: Range = None,
        same_on_batch: bool = False,
        p: float = 0.5,
        keepdim: bool = False,
        holes: str = "error",
        lens: Lens | str | None = None,
    ) -> None:
        super().__init__(same_on_batch=same_on_batch, p=p, keepdim=keepdim, holes=holes)
        self.optics = lens_optics(optics, lens, lambda lens: TiDyOptics(**lens_parts(lens)))
        if self.optics.border == "valid":
            raise ValueError(
                "border 'valid' gives smaller images, and an augmentation keeps their size: use another border"
            )
        units = {
            "exposure": (exposure, "", False),
            "focus_distance": (focus_distance, "metres", False),
            "aperture_diameter": (aperture_diameter, "metres", False),
            "mask_jitter": (mask_jitter, "radians", True),
            "noise_level": (noise_level, "of full scale", True),
            "switching_time": (switching_time, "seconds", True),
        }
        ranges = {name: checked_range(name, *given) for name, given in units.items() if given[0] is not None}
        self._check_ends(ranges)
        self._param_generator = uniform_draws(ranges)

    def _check_ends(self, ranges: Mapping[str, tuple[float, float]]) -> None:
        """Raise the camera's own error if it cannot be as the ends of the ranges say."""
        lens = [name for name in ("focus_distance", "aperture_diameter") if name in ranges]
        for ends in product(*(ranges[name] for name in lens)):
            drawn: dict[str, Any] = dict(zip(lens, ends, strict=True))
            _ = drawn_camera(self.optics, DrawnOptics(**drawn)).psf_model.window
        if "switching_time" in ranges:
            longest = DrawnOptics(switching_time=ranges["switching_time"][1])
            drawn_camera(self.optics, longest).timeline(torch.float32)
        if "noise_level" in ranges:
            sensor_with(self.optics.sensor, ranges["noise_level"][1])

    def generate_parameters(self, batch_shape: tuple[int, ...]) -> dict[str, Tensor]:
        """Return the draws of a batch: a value of each range and a seed for each image, (B,)."""
        params = super().generate_parameters(batch_shape)
        params["seed"] = row_seeds(batch_shape[0], self.same_on_batch)
        if self.optics.lens is not None and self.optics.field_center == (0.0, 0.0):
            params["field_center"] = row_places(batch_shape, self.optics, self.same_on_batch)
        return params

    def change(self, image: Tensor, depth: Tensor, params: Mapping[str, Tensor]) -> Tensor:
        """Return the captures of some images. See :meth:`DepthAugmentation.change`."""
        values = {name: params[name].tolist() for name in _OF_OPTICS if name in params}
        seeds = params["seed"].tolist()
        own = "mask_jitter" in values or "switching_time" in values  # errors of each image's own
        groups: dict[DrawnOptics, list[int]] = defaultdict(list)
        for row in range(len(image)):
            drawn = {name: value[row] for name, value in values.items()}
            groups[DrawnOptics(**drawn, seed=int(seeds[row]) if own else 0)].append(row)
        parts, order = [], []
        for drawn, rows in groups.items():
            camera = drawn_camera(self.optics, drawn)
            camera.sensor = RowSensors(self.optics.sensor, {name: value[rows] for name, value in params.items()})
            whole, place = len(rows) == len(image), params.get("field_center")
            own = image if whole else image[rows], depth if whole or depth.shape[0] == 1 else depth[rows]
            parts.append(camera(*own, field_center=None if place is None else place[rows]))
            order += rows
        coded = torch.cat(parts)
        return coded if len(groups) == 1 else coded[torch.tensor(order).argsort().to(coded.device)]
