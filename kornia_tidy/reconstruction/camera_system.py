"""A camera with what restores its captures without training: the network for any camera, or a closed form."""

from __future__ import annotations

import os

import torch

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.checks import check_choice
from kornia_tidy.masks.no_mask import NoMask
from kornia_tidy.optics.thin_lens import DefocusRange
from kornia_tidy.psf.camera_settings import EXTRA_STATE
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.reconstruction.capture_checks import measure_noise
from kornia_tidy.reconstruction.closed_form import LEAST_NOISE
from kornia_tidy.reconstruction.head_names import ANY_CAMERA, CLOSED_FORMS
from kornia_tidy.reconstruction.settings import SystemSettings
from kornia_tidy.reconstruction.state_file import WHAT
from kornia_tidy.reconstruction.trained import TrainedSystem, build_head, load_camera, load_trained, update_psfs
from kornia_tidy.sensor.sensor import SensorNoise
from kornia_tidy.tensor_files import read_tensors


@torch.no_grad()
def any_camera_system(
    optics: TiDyOptics | PSFBank, sensor: SensorNoise | None = None, head: str = ANY_CAMERA
) -> TrainedSystem:
    """Return a camera with the network for any camera, or a closed form; nothing is trained.

    Args:
        optics: the camera, of any masks, lens and sensor; it is not changed. Behind a real lens the PSFs are those of
            the field's centre, and :func:`~kornia_tidy.reconstruction.light_head.reconstruct_light` takes those of each
            place. Or the PSFs of a camera, of one or three colours.
        sensor: its noise is that of the captures. Default: the camera's.
        head: one of :data:`~kornia_tidy.reconstruction.head_names.CLOSED_FORMS`, which has the network.

    Returns:
        The system, for captures encoded as sRGB. Its settings tell of the head only.

    Raises:
        ValueError: if neither camera nor arguments have a sensor, the head is unknown, or the PSFs have only one depth.

    Example:
        >>> system = any_camera_system(TiDyOptics(fidelity="draft"))
        >>> system.head(torch.rand(1, 3, 32, 48)).shape
        torch.Size([1, 3, 32, 48])
        >>> bank = PSFBank.from_measured(torch.rand(5, 3, 7, 7), torch.linspace(-4.0, 6.0, 5))
        >>> any_camera_system(bank, SensorNoise(0.01)).head(torch.rand(1, 3, 32, 48)).shape
        torch.Size([1, 3, 32, 48])
    """
    check_choice("head", head, CLOSED_FORMS)
    if isinstance(optics, PSFBank):
        ends = float(optics.defocus.min()), float(optics.defocus.max())
        optics = TiDyOptics(NoMask(), DefocusRange(*ends), sensor=None).with_bank(optics)
    camera = optics.with_fidelity(optics.fidelity)  # with the same parts
    camera.sensor, camera.color_space = camera.sensor if sensor is None else sensor, "srgb"
    if camera.sensor is None:
        raise ValueError("a network restores captures by their noise, and the camera has no sensor: give sensor=")
    settings = SystemSettings(head=head)
    network = build_head(settings)
    update_psfs(network, camera)
    return TrainedSystem(camera.eval(), network.eval(), settings, 0)


def saved_system(path: str | os.PathLike[str], sensor: SensorNoise | None = None) -> TrainedSystem:
    """Load what restores captures from a file: a trained system, or a camera, with the network for any camera.

    Args:
        path: checkpoint of ``kornia-tidy train``, or a camera's state, as
            :func:`~kornia_tidy.reconstruction.trained.load_camera` reads it.
        sensor: replaces that of a camera.

    Raises:
        FileNotFoundError: if there is no file.
        ValueError: if it is damaged, or holds only masks.
    """
    if EXTRA_STATE not in read_tensors(path, WHAT)[0]:
        return load_trained(path)
    optics = load_camera(path)
    assert optics is not None
    return any_camera_system(optics, sensor)


def sensor_of(light: torch.Tensor) -> SensorNoise:
    """Return a sensor with the noise that a capture shows; with one of .01 where it shows none.

    Args:
        light: (C, H, W) linear light.

    Example:
        >>> drawn = 0.5 + 0.02 * torch.randn(1, 256, 256, generator=torch.Generator().manual_seed(0))
        >>> round(float(sensor_of(drawn).std(torch.tensor(0.5))), 2)
        0.02
    """
    found = measure_noise(light)
    if found is None:
        return SensorNoise(0.01)
    if found.rise <= 0:
        return SensorNoise(max(LEAST_NOISE, found.std(float(light.nanmedian()))))
    return SensorNoise(max(LEAST_NOISE, found.std(0.0)), full_well=1 / found.rise)
