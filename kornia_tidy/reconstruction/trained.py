"""Trained systems: building camera and network from settings, loading them from a checkpoint."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from kornia_tidy.camera.saved_camera import camera_of_state
from kornia_tidy.camera.saved_parts import below, masks_of_state
from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.checks import check_finite
from kornia_tidy.fidelity import Fidelity
from kornia_tidy.files import error_prefix
from kornia_tidy.masks.base import PhaseMasks
from kornia_tidy.masks.fresnel import FresnelLens
from kornia_tidy.masks.initial_heights import initial_heights
from kornia_tidy.masks.pixelwise import PixelwiseMask
from kornia_tidy.psf.camera_settings import EXTRA_STATE, check_settings, read_settings, settings_of
from kornia_tidy.psf.field_bank import FieldBank
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.reconstruction.any_camera import any_camera_head
from kornia_tidy.reconstruction.closed_form import NODES, ClosedForm, closed_form_channels
from kornia_tidy.reconstruction.closed_form_head import ClosedFormHead
from kornia_tidy.reconstruction.head import ReconstructionHead
from kornia_tidy.reconstruction.head_names import ANY_CAMERA, CLOSED_FORMS, check_imported
from kornia_tidy.reconstruction.heads import make_head
from kornia_tidy.reconstruction.joint_closed_form import JointClosedFormHead
from kornia_tidy.reconstruction.layered_joint import REFINED_FROM, LayeredJointHead
from kornia_tidy.reconstruction.refocused import Refocused
from kornia_tidy.reconstruction.residual import Residual
from kornia_tidy.reconstruction.settings import SystemSettings
from kornia_tidy.reconstruction.state_file import WHAT, read_state
from kornia_tidy.reconstruction.tasks import channels_of
from kornia_tidy.tensor_files import read_tensors

MOST_PSFS = 1 << 27  # bytes; a small file could name a window that takes gigabytes


class TrainedSystem(NamedTuple):
    """A camera and the network that reads its captures."""

    optics: TiDyOptics
    head: nn.Module
    settings: SystemSettings
    step: int
    """Steps of the optimiser that it was trained for."""
    run: Mapping[str, Any] = {}
    """The other settings in its checkpoint, unchecked: those of the run that trained it."""
    record: Mapping[str, Any] = {}
    """Record of the training, such as scores, of :func:`kornia_tidy.reconstruction.hub.save_pretrained`."""


def build_optics(settings: SystemSettings, psfs: PSFBank | FieldBank | None = None) -> TiDyOptics:
    """Return the camera that settings describe, with the initial masks and a fixed PSF window.

    Args:
        settings: of a system.
        psfs: measured PSFs, for settings with ``measured``.

    Raises:
        ValueError: if measured PSFs are missing, or given without ``measured`` in the settings.

    Example:
        >>> build_optics(SystemSettings(masks=2, window=23)).window
        23
    """
    if settings.measured != (psfs is not None):
        told = "need them" if psfs is None else "are needed where they are given"
        raise ValueError(f"settings of measured PSFs {told}, got measured={settings.measured}")
    fidelity = Fidelity.preset(settings.fidelity).replace(window=settings.window)
    if settings.stray_light is not None:
        fidelity = fidelity.replace(stray_light=settings.stray_light)
    optics = TiDyOptics(
        _masks(settings),
        None if settings.measured else settings.camera(),
        sensor=settings.sensor(),
        fidelity=fidelity,
        compositing=settings.compositing,
        color_space=settings.color_space,
        border=settings.border,
    )
    if psfs is not None:
        optics = optics.with_bank(psfs)
        optics.camera = settings.camera()  # not before: its PSFs without masks may be too wide to be computed
    return fix_window(optics)


def _masks(settings: SystemSettings) -> PhaseMasks:
    """Return the initial masks."""
    if not settings.masks:
        return FresnelLens()
    noise = torch.Generator().manual_seed(settings.seed)
    if settings.start == "noise":
        return PixelwiseMask(settings.masks, settings.mask_size, generator=noise)
    return PixelwiseMask(initial=initial_heights(settings.start, noise, settings.mask_size)[: settings.masks])


def fix_window(optics: TiDyOptics) -> TiDyOptics:
    """Fix a camera's PSF window at its present size, in place, so that it stays the same during training."""
    optics.fidelity = optics.fidelity.replace(window=optics.window)
    return optics


def build_head(settings: SystemSettings) -> nn.Module:
    """Return the network that settings describe, with weights drawn from the global generator."""
    if settings.head == ANY_CAMERA:
        if not settings.encoded:
            raise ValueError(f"the head {ANY_CAMERA!r} takes captures encoded as sRGB, got {settings.color_space!r}")
        return any_camera_head()
    if settings.head in CLOSED_FORMS:
        inverse, _, bilateral = settings.head.partition("-")
        return ClosedFormHead(bilateral=bool(bilateral), encoded=settings.encoded, inverse=inverse)
    if settings.depth_classes and settings.closed_form:
        head = _network(settings, settings.depth_classes + 3, closed_form_channels(settings.refocus, likelihood=True))
        refiner = _network(settings, 3, closed_form_channels(settings.refocus)) if settings.refined else None
        return JointClosedFormHead(head, settings.refocus, refiner, encoded=settings.encoded, inverse=settings.inverse)
    if settings.depth_classes:
        return LayeredJointHead(
            _network(settings, settings.depth_classes, 3 + 2 * settings.refocus),
            _network(settings, 3, REFINED_FROM),
            settings.refocus,
            encoded=settings.encoded,
        )
    layers, fine = settings.refocus, settings.fine
    channels = closed_form_channels(layers, fine=fine) if settings.closed_form else 3 + layers
    head = _network(settings, channels_of(settings.task), channels)
    if settings.closed_form:
        return ClosedFormHead(head, layers, encoded=settings.encoded, inverse=settings.inverse, fine=fine)
    if settings.refocus:
        head = Refocused(head, layers=settings.refocus)
    return Residual(head) if settings.residual else head


def _network(settings: SystemSettings, out_channels: int, in_channels: int) -> ReconstructionHead:
    return make_head(settings.head, out_channels, settings.width, in_channels, settings.repeats)


def update_psfs(head: nn.Module, optics: TiDyOptics) -> None:
    """Update the PSFs of a network that deconvolves captures, from the present state of a camera.

    They are evenly spaced over the range of defocus: those of green light for
    :class:`~kornia_tidy.reconstruction.Refocused`, of all colours for
    :class:`~kornia_tidy.reconstruction.LayeredJointHead` and :class:`~kornia_tidy.reconstruction.ClosedForm`, which
    also takes the noise of the sensor. Other networks are not changed. PSFs that were measured behind no colour filters
    are those of all colours.

    Raises:
        ValueError: if the camera has PSFs that were measured in other than one or three colours.
    """
    for module in head.modules():
        if isinstance(module, Refocused):
            module.set_psfs(_psf_bank(optics, 1, _nodes(optics, module.layers)))
        elif isinstance(module, ClosedForm | LayeredJointHead):
            module.set_psfs(closed_form_bank(optics, module.layers), correlate=optics.fidelity.correlate)
            if isinstance(module, ClosedForm) and optics.sensor is not None:
                module.set_noise(optics.sensor)


def closed_form_bank(optics: TiDyOptics, layers: int = 0) -> PSFBank:
    """Return a camera's PSFs as a closed form takes them: of three colours, evenly spaced over the range of defocus.

    Args:
        optics: the camera.
        layers: number of depths. 0: as many as PSFs are averaged over.

    Example:
        >>> closed_form_bank(TiDyOptics(fidelity="draft"), 5).psfs.shape[:2]
        torch.Size([5, 3])
    """
    return _psf_bank(optics, 3, _nodes(optics, layers or NODES))


def _psf_bank(optics: TiDyOptics, channels: int, nodes: list[float]) -> PSFBank:
    """Return a camera's PSFs for 1 channel, green, or 3; measured ones of the one number serve for the other."""
    measured = optics.psf_model.measured
    if measured is None:
        return optics.psf_bank(channels, defocus=nodes)
    if isinstance(measured, FieldBank):
        measured = measured.at_places([(0.0, 0.0)]).at(0)
    return measured.to(optics.masks.phase.device).at_defocus(nodes).with_channels(channels)


def _nodes(optics: TiDyOptics, count: int) -> list[float]:
    """Return evenly spaced defocus in radians, from one end of the camera's range to the other."""
    lo, hi = optics.camera.defocus_range
    return torch.linspace(lo, hi, count, dtype=torch.float64).tolist()


def load_trained(path: str | os.PathLike[str]) -> TrainedSystem:
    """Load camera and network from a checkpoint; the network with averaged weights, if the checkpoint holds them.

    Args:
        path: checkpoint that ``kornia-tidy train`` wrote.

    Returns:
        The system in eval mode, on the CPU. The sensor keeps its noise.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if it is not a checkpoint, or weights and settings do not fit; the message names the difference.
    """
    return system_of_state(read_state(path), path)


def system_of_state(state: Mapping[str, Any], path: str | os.PathLike[str]) -> TrainedSystem:
    """Return the system of a state that was read; the path is for messages. See :func:`load_trained`."""
    weights_of(state, path)
    if not isinstance(state.get("global_step"), int) or "settings" not in state:
        raise ValueError(f"cannot read {path}: it is a checkpoint without step or settings, or is damaged")
    if state["settings"] is None:
        raise ValueError(
            f"{path} does not say how its camera and network were made, as they were given as objects: make them anew "
            f"and use load_weights"
        )
    with error_prefix(f"cannot read {path}"):
        known, run = SystemSettings.split(state["settings"])
        settings = SystemSettings(**known)
        check_imported(settings.head)
    _check_sizes(state, settings, str(path))
    with error_prefix(f"cannot read {path}"):
        optics = build_optics(settings, stored_psfs(state))
    head = build_head(settings)
    load_weights(state, optics, head, str(path))
    with torch.no_grad():
        update_psfs(head, optics)
    return TrainedSystem(optics.eval(), head.eval(), settings, int(state["global_step"]), run)


def psfs_to_store(optics: TiDyOptics) -> dict[str, Tensor]:
    """Return the measured PSFs of a camera as tensors by name, for a checkpoint; none if they are computed."""
    bank = optics.psf_model.measured
    fields = {} if bank is None else vars(bank)
    return {name: value for name, value in fields.items() if value is not None}


def stored_psfs(state: Mapping[str, Any]) -> PSFBank | FieldBank | None:
    """Return the measured PSFs of a state that was read, of one place or over the field; None if it has none.

    Raises:
        ValueError: if they are no PSFs, or a value is not finite.
    """
    tensors = state.get("psfs", {})
    if not isinstance(tensors, Mapping) or not all(isinstance(value, Tensor) for value in tensors.values()):
        raise ValueError(f"measured PSFs must be tensors by name, got {tensors!r:.80}")
    if not tensors:
        return None
    try:
        bank = (FieldBank if "field" in tensors else PSFBank)(**tensors)
    except TypeError:
        raise ValueError(f"measured PSFs must have psfs, defocus and energy, got {sorted(tensors)!r:.80}") from None
    for name, value in tensors.items():
        check_finite(f"{name} of the measured PSFs", value)
    return bank


def weights_of(state: Mapping[str, Any], path: str | os.PathLike[str]) -> dict[str, Tensor]:
    """Return the weights of a state that was read; the path is for the message.

    Raises:
        ValueError: if it has none.
    """
    weights = state.get("state_dict")
    named = isinstance(weights, dict) and all(isinstance(name, str) for name in weights)
    if not named or not all(isinstance(value, Tensor) for value in weights.values()):
        raise ValueError(f"cannot read {path}: it is a checkpoint without weights, or is damaged")
    return weights


def _check_sizes(state: Mapping[str, Any], settings: SystemSettings, name: str) -> None:
    """Raise ``ValueError`` if settings and weights are of different sizes, before memory is allocated."""
    masks = state["state_dict"].get("optics.masks.phase")
    if masks is not None and settings.masks:
        told = f"{name} does not fit: it holds"
        if len(masks) != settings.masks:
            raise ValueError(f"{told} {len(masks)} masks, and its settings tell of {settings.masks}")
        if (side := masks.shape[-1]) != settings.mask_size:
            raise ValueError(f"{told} masks of {side} pixels along a side, its settings tell of {settings.mask_size}")
    depths = max(NODES, settings.refocus)
    if (size := 12 * (settings.window or 0) ** 2 * depths) > MOST_PSFS:  # three colours in float32
        raise ValueError(
            f"cannot read {name}: PSFs of window {settings.window} at {depths} depths must take at most "
            f"{MOST_PSFS >> 20} MiB, got {size >> 20}"
        )
    named = error_prefix(f"cannot read {name}: no network can be made by its settings", RuntimeError)
    with named, torch.device("meta"):  # shapes without memory
        head = build_head(settings)
    prefix = head_prefix(state["state_dict"])
    check_weights(head, below(state["state_dict"], prefix), f"{name}, {prefix.removesuffix('.')}")


def load_weights(
    checkpoint: str | os.PathLike[str] | Mapping[str, Any],
    optics: nn.Module | None = None,
    head: nn.Module | None = None,
    name: str | None = None,
) -> None:
    """Load weights of a checkpoint into a camera, a network, or both; for the network averaged ones, if there are any.

    Args:
        checkpoint: path, or a state that was read.
        optics: the camera. None: its weights are not loaded.
        head: the network. None: its weights are not loaded.
        name: of the checkpoint in messages.

    Raises:
        ValueError: if a weight is missing, unknown or of another shape, or the camera is another one. Nothing is then
            loaded.
    """
    state = checkpoint if isinstance(checkpoint, Mapping) else read_state(checkpoint)
    name = name or str(checkpoint)
    weights = weights_of(state, name)
    parts = [(optics, "optics."), (head, head_prefix(weights))]
    wanted = [(part, below(weights, prefix), prefix) for part, prefix in parts if part is not None]
    for part, own, prefix in wanted:
        check_weights(part, own, f"{name}, {prefix.removesuffix('.')}")
    for part, own, _ in wanted:
        part.load_state_dict(own)


def camera_state(path: str | os.PathLike[str]) -> dict[str, Tensor]:
    """Read the state of the camera in a file: the result of its ``state_dict()``, by itself or in a checkpoint.

    Args:
        path: safetensors file of a camera's state, or of ``kornia-tidy train``.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if it is damaged.
    """
    tensors, header = read_tensors(path, WHAT)
    return tensors if header.get("format") is None else below(weights_of(read_state(path), path), "optics.")


def load_camera(path: str | os.PathLike[str]) -> TiDyOptics | None:
    """Load the camera that was saved in a file: every capture is the same to the last bit.

    Args:
        path: as in :func:`camera_state`.

    Returns:
        The camera; None for a file without a camera, such as one of only masks.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if it is damaged, or see :func:`~kornia_tidy.camera.saved_camera.camera_of_state`.
    """
    state = camera_state(path)
    if EXTRA_STATE in state:
        with error_prefix(f"cannot read {path}"):
            return camera_of_state(state)
    checkpoint = read_tensors(path, WHAT)[1].get("format") is not None
    return load_trained(path).optics if checkpoint else None


def load_masks(checkpoint: str | os.PathLike[str], optics: TiDyOptics) -> None:
    """Load the masks of a checkpoint or of a camera into a camera, which may differ in all else.

    Args:
        checkpoint: path of a file that ``kornia-tidy train`` wrote, or of a camera's state, such as
            ``camera.safetensors`` of ``kornia-tidy design``.
        optics: camera with as many masks of the same size. Its PSF window does not change. Pixel-wise masks without
            limits take the phase of masks of any family; others need their own family, limits and material.

    Raises:
        ValueError: if the masks do not fit. Nothing is then loaded.
    """
    state = camera_state(checkpoint)
    own = below(state, "masks.")
    if EXTRA_STATE in state:
        try:
            check_settings(
                {"masks": read_settings(state[EXTRA_STATE]).get("masks")}, {"masks": settings_of(optics.masks)}
            )
        except ValueError:
            if not isinstance(optics.masks, PixelwiseMask) or optics.masks.constraint != "none":
                raise
            own = {"phase": masks_of_state(state).phase.detach()}
    check_weights(optics.masks, own, f"{checkpoint}, masks")
    optics.masks.load_state_dict(own)


def head_prefix(weights: Mapping[str, Tensor]) -> str:
    """Return the prefix of the network's weights in a checkpoint; of the averaged ones, if there are any."""
    return "average.network." if any(key.startswith("average.") for key in weights) else "head."


def check_weights(module: nn.Module, weights: Mapping[str, Tensor], name: str) -> None:
    """Raise ``ValueError`` unless weights fit a module by name and shape and are finite.

    Example:
        >>> check_weights(nn.Linear(2, 1), {"weight": torch.ones(1, 3)}, "a.safetensors")
        Traceback (most recent call last):
        ...
        ValueError: a.safetensors does not fit: missing bias; weight is (1, 3), wanted (1, 2)
    """
    # load_state_dict of a camera checks its settings.
    weights, own = (
        {key: value for key, value in state.items() if not key.endswith(EXTRA_STATE)}
        for state in (weights, module.state_dict())
    )
    missing, unknown = [key for key in own if key not in weights], [key for key in weights if key not in own]
    faults = [f"{word} {_some(keys)}" for word, keys in (("missing", missing), ("unknown", unknown)) if keys]
    # PSFs of a closed form take the window that is stored.
    free = {f"{name}.psfs".lstrip(".") for name, part in module.named_modules() if isinstance(part, ClosedForm)}
    faults += [
        f"{key} is {tuple(weights[key].shape)}, wanted {tuple(value.shape)}"
        for key, value in own.items()
        if key in weights and weights[key].shape != value.shape
        if key not in free or weights[key].shape[:2] != value.shape[:2]
    ]
    faults += [
        f"{key} holds NaN or infinity"
        for key, value in weights.items()
        if value.is_floating_point() and not bool(value.isfinite().all())
    ]
    if faults:
        raise ValueError(f"{name} does not fit: {'; '.join(faults[:4])}{' ...' if len(faults) > 4 else ''}")


def describe(optics: TiDyOptics, head: nn.Module) -> dict[str, str]:
    """Return the lens, sensor, fidelity and types of modules in words, which weights do not determine."""
    parts = {name: repr(getattr(optics, name)) for name in ("camera", "sensor")}
    parts |= {"fidelity": repr(optics.fidelity.replace(window=optics.window))}
    parts |= {name: str(getattr(optics, name)) for name in ("compositing", "color_space", "border")}
    parts |= {name: type(getattr(optics, name)).__name__ for name in ("masks", "modulator")}
    return {**parts, "head": type(head).__name__}


def _some(keys: list[str]) -> str:
    return ", ".join(keys[:3]) + (f" and {len(keys) - 3} more" if len(keys) > 3 else "")
