"""A camera with what restores its captures without training: the network for any camera, or a closed form."""

from __future__ import annotations

import os

import torch

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.checks import check_choice
from kornia_tidy.psf.camera_settings import EXTRA_STATE
from kornia_tidy.reconstruction.head_names import ANY_CAMERA, CLOSED_FORMS
from kornia_tidy.reconstruction.settings import SystemSettings
from kornia_tidy.reconstruction.state_file import WHAT
from kornia_tidy.reconstruction.trained import TrainedSystem, build_head, load_camera, load_trained, update_psfs
from kornia_tidy.sensor.sensor import SensorNoise
from kornia_tidy.tensor_files import read_tensors


@torch.no_grad()
def any_camera_system(optics: TiDyOptics, sensor: SensorNoise | None = None, head: str = ANY_CAMERA) -> TrainedSystem:
    """Return a camera with the network for any camera, or a closed form; nothing is trained.

    Args:
        optics: the camera, of any masks, lens and sensor; it is not changed. Behind a real lens the PSFs are those of
            the field's centre, and :func:`~kornia_tidy.reconstruction.light_head.reconstruct_light` takes those of each
            place.
        sensor: by whose noise captures are restored. Default: the camera's.
        head: one of :data:`~kornia_tidy.reconstruction.head_names.CLOSED_FORMS`, which has the network.

    Returns:
        The system, for captures encoded as sRGB. Its settings tell of the head only.

    Raises:
        ValueError: if neither is a sensor there, or the head is another.

    Example:
        >>> system = any_camera_system(TiDyOptics(fidelity="draft"))
        >>> system.head(torch.rand(1, 3, 32, 48)).shape
        torch.Size([1, 3, 32, 48])
    """
    check_choice("head", head, CLOSED_FORMS)
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
        sensor: of a camera, in place of its own.

    Raises:
        FileNotFoundError: if there is no file.
        ValueError: if it is damaged, or holds masks alone.
    """
    if EXTRA_STATE not in read_tensors(path, WHAT)[0]:
        return load_trained(path)
    optics = load_camera(path)
    assert optics is not None
    return any_camera_system(optics, sensor)
