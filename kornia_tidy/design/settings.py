"""Settings of a co-design as plain values, with units and ranges; they are read without torch."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from kornia_tidy.choices import LENSES
from kornia_tidy.reconstruction.settings import LensSettings, MaskSettings
from kornia_tidy.settings import DepthRange, Electrons, FNumber, Metres, Unit, one_of

MOST_MASKS = 64
LARGEST_MASK = 1024  # pixels along a side: a search with more would take days


@dataclass(frozen=True, kw_only=True)
class DesignSettings:
    """Scene, lens and sensor.

    Args:
        depth_range: nearest and farthest depth that the camera is for; the farthest may be inf.
        depth_weight: weight of depth, from 0, only the image, to 1.
        focal_length: of the lens.
        pixel_pitch: of the sensor.
        electrons: of a white pixel at the reference f-number. The exposure time is the same at every f-number, but for
            those at which white would exceed the full well: there it is shorter.
        reference_f_number: f-number at which the electrons are counted.
        full_well: electrons from black to white, which limit the exposure. None: by the pixel's area, 57000 at 8 um.
        read_noise: its standard deviation.
        masks: in one exposure.
        mask_size: pixels along a side of a mask; 20 of 23 span the aperture, and more pixels scatter less light.
        lens: a real lens by its name, over whose field cameras are compared; its focal length is taken. None: an ideal
            lens.
    """

    depth_range: DepthRange = (0.2975, math.inf)
    depth_weight: Annotated[float, Unit("W", "", 0, 1)] = 0.0
    focal_length: Metres = LensSettings.focal_length
    pixel_pitch: Metres = LensSettings.pixel_pitch
    electrons: Electrons = 57_000.0
    reference_f_number: FNumber = 17.6
    full_well: Electrons | None = None
    read_noise: Electrons = 2.4
    masks: Annotated[int, Unit("K", "", 1, MOST_MASKS)] = MaskSettings.masks
    mask_size: Annotated[int, Unit("N", "", 1, LARGEST_MASK)] = MaskSettings.mask_size
    lens: Annotated[str, one_of(LENSES)] | None = None
