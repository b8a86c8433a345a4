"""Triton's interpreter for tests: kernels run on tensors of the CPU, where Triton is installed and no GPU is there."""

from __future__ import annotations

import importlib.util
import os

import pytest
import torch

INSTALLED = importlib.util.find_spec("triton") is not None
if INSTALLED and not torch.cuda.is_available():
    os.environ["TRITON_INTERPRET"] = "1"  # Triton reads it when it is imported
    from triton.runtime import interpreter  # ty: ignore[import-not-found]

    _patch_tensor = interpreter._patch_lang_tensor

    def _patch(tensor: type, *scope: object) -> None:
        """Let arrays of one element be indices: Triton, since 3.6 with a scope, asks NumPy for what 2.4 refuses."""
        _patch_tensor(tensor, *scope)
        tensor.__index__ = lambda self: self.handle.data.item()

    interpreter._patch_lang_tensor = _patch

needs_triton = pytest.mark.skipif(not INSTALLED, reason="Triton is not installed: pip install 'kornia-tidy[triton]'")
DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
