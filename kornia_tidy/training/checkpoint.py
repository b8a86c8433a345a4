"""Checkpoints of Lightning's trainer in safetensors instead of pickle."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from lightning.fabric.plugins import CheckpointIO

from kornia_tidy.reconstruction.state_file import read_state, write_state


class SafetensorsIO(CheckpointIO):
    """Writes the trainer's whole state as one safetensors file, atomically: ``Trainer(plugins=[SafetensorsIO()])``."""

    def save_checkpoint(
        self,
        checkpoint: dict[str, Any],
        path: str | os.PathLike[str],
        storage_options: Any | None = None,
    ) -> None:
        """Write a checkpoint as :func:`~kornia_tidy.reconstruction.state_file.write_state` does."""
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        write_state(path, checkpoint)

    def load_checkpoint(
        self,
        path: str | os.PathLike[str],
        map_location: Any | None = None,
        weights_only: bool | None = None,
    ) -> dict[str, Any]:
        """Read a checkpoint to the CPU as :func:`~kornia_tidy.reconstruction.state_file.read_state` does."""
        return read_state(path)

    def remove_checkpoint(self, path: str | os.PathLike[str]) -> None:
        """Remove a checkpoint, if it exists."""
        Path(path).unlink(missing_ok=True)
