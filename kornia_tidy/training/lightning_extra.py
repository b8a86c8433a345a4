"""The extra that training needs: one clear sentence where it is missing."""

from __future__ import annotations

import importlib


def require_lightning() -> None:
    """Raise one clear sentence if Lightning or TensorBoard is missing.

    Raises:
        ImportError: if one is.
    """
    try:
        importlib.import_module("lightning.pytorch")
        importlib.import_module("tensorboard")
    except ImportError:
        raise ImportError("training needs lightning and tensorboard: pip install 'kornia-tidy[train]'") from None
