"""Small trained systems that come with the library: a camera with its learnt masks, and the network that reads it.

``heads.json`` beside this file tells how each was trained and how well it does on scenes it never saw.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from kornia_tidy.checks import check_choice
from kornia_tidy.inference.state_file import read_state, write_state
from kornia_tidy.inference.trained import TrainedSystem, load_trained

FOLDER = Path(__file__).parent
PRETRAINED = ("joint-5", "joint-1", "joint-0", "edof-5", "edof-1", "edof-0")
"""Task and number of masks; 0 is a plain lens, for comparison."""


def load_pretrained(name: str) -> TrainedSystem:
    """Return a camera and the network that reads its captures, trained together.

    Args:
        name: one of :data:`PRETRAINED`.

    Returns:
        Camera, network, training settings and steps, in eval mode on the CPU. The network takes captures of that
        camera, (B, 3, H, W) as :class:`~kornia_tidy.TiDyOptics` returns them, with a noise of 0.002 of full scale, and
        returns the maps of its task, which :func:`~kornia_tidy.inference.tasks.split_maps` names.

    Raises:
        ValueError: if there is no system of this name.

    Example:
        >>> import torch
        >>> system = load_pretrained("edof-5")
        >>> image, depth = torch.rand(1, 3, 64, 64), torch.full((1, 1, 64, 64), 1.0)
        >>> with torch.no_grad():
        ...     estimate = system.head(system.optics(image, depth))
        >>> estimate.shape
        torch.Size([1, 3, 64, 64])
    """
    check_choice("name", name, PRETRAINED)
    return load_trained(FOLDER / f"{name}.safetensors")


def about_pretrained() -> dict[str, Any]:
    """Return how the systems were trained and how well they do: settings, steps, machine, date, scores."""
    return json.loads((FOLDER / "heads.json").read_text())


def ship(checkpoint: str | os.PathLike[str], path: str | os.PathLike[str]) -> None:
    """Write of a checkpoint only what :func:`~kornia_tidy.inference.trained.load_trained` reads: half its size.

    Args:
        checkpoint: a file that ``kornia-tidy train`` wrote with a moving average.
        path: where to.

    Raises:
        ValueError: if it is no checkpoint, or has no moving average.
    """
    state = read_state(checkpoint)
    wanted = ("optics.", "average.network.")
    weights = {name: value for name, value in state["state_dict"].items() if name.startswith(wanted)}
    if not any(name.startswith(wanted[1]) for name in weights):
        raise ValueError(f"{checkpoint} holds no moving average of its network: train it with ema above 0")
    write_state(path, {**{key: state[key] for key in ("settings", "global_step")}, "state_dict": weights})
