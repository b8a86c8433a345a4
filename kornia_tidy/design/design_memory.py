"""Memory of a co-design in one file, so that an interrupted search goes on where it stopped."""

from __future__ import annotations

import base64
import hashlib
import json
import os
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kornia_tidy.design.candidates import Candidate
from kornia_tidy.design.simulated_captures import Scores
from kornia_tidy.files import read_json, write_bytes


class DesignMemory:
    """Designed masks and scores by name, in a file that is written whole after each entry.

    Args:
        path: the file. None keeps the entries only in this process.
        about: key of the entries: task, effort, seed and scenes. A file about something else is replaced.

    Example:
        >>> memory = DesignMemory()
        >>> candidate = Candidate("random", 20.0, 0.5, 0.02, 0.1, -17.0, torch.ones(1, 3, 3))
        >>> memory.candidate("a", lambda: candidate) is candidate, len(memory)
        (True, 1)
        >>> memory.candidate("a", lambda: None).phase.shape
        torch.Size([1, 3, 3])
    """

    def __init__(self, path: str | os.PathLike[str] | None = None, about: Any = None) -> None:
        self.path = None if path is None else Path(path)
        self.about = json.loads(json.dumps(about))
        self.entries: dict[str, Any] = {}
        if self.path is not None and self.path.exists():
            stored = read_json(self.path)
            if isinstance(stored, dict) and stored.get("about") == self.about:
                self.entries = stored.get("entries", {})
                if not isinstance(self.entries, dict):
                    raise ValueError(f"cannot read {self.path}: entries must be values by name")

    def __len__(self) -> int:
        """Return the number of entries."""
        return len(self.entries)

    def candidate(self, name: str, design: Callable[[], Candidate]) -> Candidate:
        """Return the candidate of a name, designed if it is not there."""
        if name in self.entries:
            stored = self.entries[name]
            try:
                values: dict[str, Any] = {**stored, "phase": _tensor(stored["phase"])}
                return Candidate(**values)
            except (KeyError, TypeError, ValueError) as error:
                raise ValueError(f"cannot read {self.path}: {name:.80} is no candidate ({error!s:.200})") from error
        candidate = design()
        values = {field.name: getattr(candidate, field.name) for field in fields(candidate)}
        self._add(name, {**values, "phase": None if candidate.phase is None else _text(candidate.phase)})
        return candidate

    def scores(self, candidate: Candidate, measure: Callable[[], list[Scores]]) -> list[Scores]:
        """Return the scores of a candidate, measured if they are not there."""
        phase = "" if candidate.phase is None else hashlib.sha256(candidate.phase.numpy().tobytes()).hexdigest()[:16]
        name = f"scores of {candidate.start} f/{candidate.f_number:.9g} at {candidate.focus:.9g} {phase}"
        if name not in self.entries:
            self._add(name, measure())
        return self.entries[name]

    def _add(self, name: str, value: Any) -> None:
        self.entries[name] = value
        if self.path is not None:
            write_bytes(self.path, json.dumps({"about": self.about, "entries": self.entries}).encode())


def _text(phase: Tensor) -> dict[str, Any]:
    values = phase.float().contiguous().numpy()
    return {"shape": list(values.shape), "float32": base64.b64encode(values.astype("<f4").tobytes()).decode()}


def _tensor(stored: dict[str, Any] | None) -> Tensor | None:
    if stored is None:
        return None
    values = np.frombuffer(base64.b64decode(stored["float32"]), "<f4").astype(np.float32)
    return torch.from_numpy(values.reshape(stored["shape"]))
