"""Crops of noise-free captures, with gain and sensor noise drawn anew for each step of training."""

from __future__ import annotations

import math
from typing import Any, cast

import torch
from torch import Tensor
from torch.utils.data import Dataset

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.checks import check_part
from kornia_tidy.optics.thin_lens import DefocusRange, ThinLensCamera
from kornia_tidy.sensor.exposure import electrons_at
from kornia_tidy.sensor.sensor import SensorNoise
from kornia_tidy.settings import check_settings
from kornia_tidy.training.noise_free import NoiseFreeCaptures
from kornia_tidy.training.settings import LightSettings

GAIN = (0.5, 2.0)  # range of the exposure factor, uniform in its logarithm
TINT = 0.1  # standard deviation of the logarithm of each channel's factor, as of another illuminant
SHOT_SHARE = 0.5  # share of captures with shot noise; the others have read noise alone
FULL_WELL = (500.0, 60e3)  # electrons, uniform in its logarithm: at a level of 0.3, a noise of 0.024 to 0.0022
READ_ELECTRONS = 2.4  # read noise of captures with shot noise, as of an industrial sensor


class NoisyCrops(Dataset):
    r"""Training samples from noise-free captures: a crop, a gain for each channel, and the sensor's noise.

    The gain g multiplies capture and image in linear light before the noise n is added, as a longer exposure or another
    illuminant would; optics are linear, so the result is an exact capture:

    .. math:: y = \mathrm{clip}(g \, (h * x) + n)

    No value exceeds full scale, as g is limited to the reciprocal of the crop's brightest value in each channel.

    Half of the captures have only read noise, with a standard deviation uniform in its logarithm. The others have shot
    noise, of a full well uniform in its logarithm, and a read noise of 2.4 electrons.

    All draws are from torch's global generator, which
    :class:`~kornia_tidy.training.scenes.RepeatableScenes` seeds by epoch and index.

    Args:
        captures: of fixed optics.
        optics: their camera, for the encoding of the sensor's values.
        crop: side of the crop in pixels. None: the whole capture.
        light: ranges of the noise. None: the defaults.
        gain: draw gains, and errors of the stated noise. False: the gain is one and the noise the true one, as
            for validation.

    Raises:
        ValueError: if a range of ``light`` is out of order, or a capture is smaller than the crop.

    Convention:
        Items are mappings of

        - ``"coded"``: the capture (3, H, W), and ``"image"``: the all-in-focus image, both encoded as the camera does;
        - ``"inverse_depth"`` (1, H, W), normalised; ``"mask"`` (1, H, W), True at known depths;
        - ``"noise"``: (3, H, W), standard deviation of the noise in linear light, full scale 1, by the sensor's model
          and the noisy capture, as for a capture of an unknown scene; in training wrong by a factor, see
          :func:`random_error`.

    Source: Foi et al., Practical Poissonian-Gaussian noise modeling (TIP 2008), for the noise; training over a range of
    noise levels as in Zhang et al., FFDNet (TIP 2018).
    """

    def __init__(
        self,
        captures: NoiseFreeCaptures,
        optics: TiDyOptics,
        crop: int | None = None,
        light: LightSettings | None = None,
        *,
        gain: bool = True,
    ) -> None:
        check_part("captures", captures, NoiseFreeCaptures, "NoiseFreeCaptures")
        self.captures, self.optics, self.crop, self.gain = captures, optics, crop, gain
        self.light = light or LightSettings()
        check_settings(self.light)
        self.light.check_light()

    def __len__(self) -> int:
        """Return the number of captures."""
        return len(self.captures)

    def __getitem__(self, index: int) -> dict[str, Any]:
        """Return a sample."""
        light, image, inverse_depth, mask = self.captures[index]
        if self.crop is not None:
            window = random_window(light.shape[-2], light.shape[-1], self.crop)
            light, image, inverse_depth, mask = (plane[window] for plane in (light, image, inverse_depth, mask))
        if self.gain:
            gain = random_gain(torch.maximum(light.amax((1, 2)), image.amax((1, 2))))
            light, image = light * gain, image * gain
        sensor = random_sensor(self.light, self.optics.camera)
        coded = sensor(light[None])[0]
        told = sensor.std(coded)
        return {
            "coded": self.optics.encode(coded[None])[0],
            "image": self.optics.encode(image[None])[0],
            "inverse_depth": inverse_depth,
            "mask": mask,
            "noise": told * random_error(self.light.noise_error) if self.gain else told,
        }


def full_wells(light: LightSettings, lens: ThinLensCamera | DefocusRange) -> tuple[float, float]:
    """Return the range of the full well in training, the same exposure time and light for every aperture.

    Example:
        >>> full_wells(LightSettings(electrons=(500, 57000), reference_f_number=17.6), ThinLensCamera(f_number=35.2))
        (125.0, 14250.0)
    """
    if light.electrons is None:
        return FULL_WELL
    f_number = cast("ThinLensCamera", lens).f_number
    least, largest = (electrons_at(f_number, count, light.reference_f_number) for count in light.electrons)
    return least, largest


def random_window(height: int, width: int, side: int) -> tuple[slice, slice, slice]:
    """Return a window of a picture (C, H, W) at random, by torch's global generator.

    Raises:
        ValueError: if the picture is smaller than the window.
    """
    if side > min(height, width):
        raise ValueError(f"the crop must not exceed the captures of {height} x {width} pixels, got {side}")
    top = int(torch.randint(height - side + 1, ()))
    left = int(torch.randint(width - side + 1, ()))
    return slice(None), slice(top, top + side), slice(left, left + side)


def random_gain(peak: Tensor) -> Tensor:
    """Return a gain for each channel, (C, 1, 1), by torch's global generator.

    Args:
        peak: brightest value of each channel, (C,). The gain is limited so that it does not exceed full scale.

    Example:
        >>> gain = random_gain(torch.tensor([1.0, 0.8, 0.5]))
        >>> gain.shape, bool((gain.flatten() * torch.tensor([1.0, 0.8, 0.5]) <= 1).all())
        (torch.Size([3, 1, 1]), True)
    """
    least, largest = (math.log(end) for end in GAIN)
    exposure = least + (largest - least) * torch.rand(1, dtype=torch.float32)
    gain = (exposure + TINT * torch.randn(len(peak), dtype=torch.float32)).exp()
    return torch.minimum(gain, 1 / peak.clamp(min=1e-6))[:, None, None]


def random_error(largest: float = LightSettings.noise_error) -> float:
    """Return a factor between one over the largest and the largest, uniform in its logarithm, by the global generator.

    From wrong noise levels a network learns to check the capture: a user seldom knows the noise of a
    photograph to better than a factor.

    Example:
        >>> factors = [random_error() for _ in range(100)]
        >>> 0.4 <= min(factors) < 0.7 and 1.4 < max(factors) <= 2.5
        True
    """
    return largest ** (2 * float(torch.rand((), dtype=torch.float32)) - 1)


def random_sensor(light: LightSettings, lens: ThinLensCamera | DefocusRange) -> SensorNoise:
    """Return a sensor with a noise drawn by torch's global generator; see :class:`NoisyCrops`.

    Example:
        >>> sensors = [random_sensor(LightSettings(), ThinLensCamera()) for _ in range(100)]
        >>> {sensor.full_well is None for sensor in sensors} == {True, False}
        True
        >>> all(0.001 <= sensor.sigma <= 0.03 for sensor in sensors if sensor.full_well is None)
        True
    """
    with_shot, place = torch.rand(2, dtype=torch.float32).tolist()
    least, largest = full_wells(light, lens) if with_shot < SHOT_SHARE else light.noise_range
    level = least * (largest / least) ** place
    if with_shot < SHOT_SHARE:
        return SensorNoise(READ_ELECTRONS / level, full_well=level)
    return SensorNoise(level)
