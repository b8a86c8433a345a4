"""Small trained systems that are shipped with the package.

``heads.json`` holds how each was trained, and its scores on test scenes.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from kornia_tidy.checks import check_choice
from kornia_tidy.choices import PRETRAINED, REPLACED
from kornia_tidy.reconstruction.settings import SystemSettings
from kornia_tidy.reconstruction.state_file import read_state
from kornia_tidy.reconstruction.trained import TrainedSystem, load_trained

FOLDER = Path(__file__).parent


def check_shipped(name: str) -> None:
    """Raise ``ValueError`` unless a system is shipped; for one of an earlier version, name what took its place.

    Example:
        >>> check_shipped("joint-5")
        Traceback (most recent call last):
        ValueError: the system 'joint-5' is no longer shipped: 'joint-uncertain' took its place
    """
    if name in REPLACED:
        raise ValueError(f"the system {name!r} is no longer shipped: {REPLACED[name]!r} took its place")
    check_choice("name", name, PRETRAINED)


def load_pretrained(name: str) -> TrainedSystem:
    """Load a shipped system, a camera and a network trained together.

    Args:
        name: one of :data:`PRETRAINED`.

    Returns:
        The system in eval mode, on the CPU. Its network takes captures of its camera, (B, 3, H, W) as
        :class:`~kornia_tidy.TiDyOptics` returns them, with a noise of 0.002 of full scale, and returns the maps of its
        task; :func:`~kornia_tidy.reconstruction.tasks.split_maps` returns them by name.

    Raises:
        ValueError: if no system has this name.

    Example:
        >>> import torch
        >>> system = load_pretrained("edof-5")
        >>> image, depth = torch.rand(1, 3, 72, 72), torch.full((1, 1, 72, 72), 1.0)
        >>> with torch.no_grad():
        ...     estimate = system.head(system.optics(image, depth))
        >>> estimate.shape
        torch.Size([1, 3, 72, 72])
    """
    check_shipped(name)
    return load_trained(FOLDER / f"{name}.safetensors")


def pretrained_settings(name: str) -> SystemSettings:
    """Return the settings of camera and network of a shipped system, without building them.

    Example:
        >>> pretrained_settings("edof-5").masks
        5
    """
    check_shipped(name)
    known, _ = SystemSettings.split(read_state(FOLDER / f"{name}.safetensors")["settings"])
    return SystemSettings(**known)


def about_pretrained() -> dict[str, Any]:
    """Return settings, steps, machine, date and scores of the shipped systems."""
    return json.loads((FOLDER / "heads.json").read_text())


def pretrained_record(name: str) -> dict[str, Any]:
    """Return the record of the training of a shipped system: seed, scores by test set, machine and date.

    Example:
        >>> sorted(pretrained_record("edof-5")["scores"])
        ['dead leaves', 'real scenes']
    """
    check_shipped(name)
    about = about_pretrained()
    return {**{key: about[key] for key in ("command", "date", "commit", "machine", "torch")}, **about["systems"][name]}
