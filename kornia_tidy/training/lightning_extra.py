"""Check that Lightning and TensorBoard, the packages of the extra ``train``, are installed."""

from __future__ import annotations

from kornia_tidy.search_path import import_extra


def require_lightning() -> None:
    """Raise ``ImportError`` with the command that installs them if Lightning or TensorBoard is missing.

    Raises:
        ImportError: if one is missing.
    """
    for name in ("lightning.pytorch", "tensorboard"):
        import_extra(name, "training")
