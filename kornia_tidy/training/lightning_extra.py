"""Check that Lightning and TensorBoard, the packages of the extra ``train``, are installed."""

from __future__ import annotations

from kornia_tidy.search_path import import_installed


def require_lightning() -> None:
    """Raise ``ImportError`` with the command that installs them if Lightning or TensorBoard is missing.

    Raises:
        ImportError: if one is missing.
    """
    try:
        import_installed("lightning.pytorch")
        import_installed("tensorboard")
    except ImportError:
        raise ImportError("training needs lightning and tensorboard: pip install 'kornia-tidy[train]'") from None
