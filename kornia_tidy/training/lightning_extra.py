"""Check that Lightning and TensorBoard, the packages of the extra ``train``, are installed."""

from __future__ import annotations

import importlib


def require_lightning() -> None:
    """Raise ``ImportError`` with the command that installs them if Lightning or TensorBoard is missing.

    Raises:
        ImportError: if one is missing.
    """
    try:
        importlib.import_module("lightning.pytorch")
        importlib.import_module("tensorboard")
    except ImportError:
        raise ImportError("training needs lightning and tensorboard: pip install 'kornia-tidy[train]'") from None
