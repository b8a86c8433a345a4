"""Files that would run code if anything unpickled, imported or evaluated what they hold."""

from __future__ import annotations

import io
import os
import pickle
from pathlib import Path

import numpy as np
import torch

MARKER = "code-was-run"


class Payload:
    """Makes a folder when it is unpickled."""

    def __init__(self, place: Path) -> None:
        self.place = place

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.mkdir, (str(self.place / MARKER),)


def payloads(place: Path) -> dict[str, bytes]:
    """Return files by what they are: each makes a folder in a place if it is trusted."""
    evil = Payload(place)
    objects, packed, old, new = io.BytesIO(), io.BytesIO(), io.BytesIO(), io.BytesIO()
    np.save(objects, np.array([evil], dtype=object), allow_pickle=True)
    np.savez(packed, np.array([evil], dtype=object))
    torch.save({"state_dict": evil}, old, _use_new_zipfile_serialization=False)
    torch.save({"state_dict": evil}, new)
    command = f"__import__('os').mkdir({str(place / MARKER)!r})"
    return {
        "pickle": pickle.dumps(evil),
        "pickle-0": pickle.dumps(evil, protocol=0),
        "objects in NPY": objects.getvalue(),
        "objects in NPZ": packed.getvalue(),
        "expression in NPY": _npy_with_header(f"{{'descr': {command}, 'fortran_order': False, 'shape': (1,)}}"),
        "torch.save, old": old.getvalue(),
        "torch.save, new": new.getvalue(),
        "expression": command.encode(),
        "YAML": f"!!python/object/apply:os.mkdir [{str(place / MARKER)!r}]\n".encode(),
    }


def _npy_with_header(header: str) -> bytes:
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode("latin-1") + bytes(8)
