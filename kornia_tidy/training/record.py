"""Record of a training run, read from its folder: scores of its evaluation and of its validation."""

from __future__ import annotations

import os
from typing import Any

from kornia_tidy.files import check_folder, error_prefix, read_csv, read_json

EVALUATION, VALIDATION = "evaluation/summary.json", "validation.csv"


def training_record(folder: str | os.PathLike[str]) -> dict[str, Any]:
    r"""Read the record of a run for its model card, see :func:`kornia_tidy.reconstruction.hub.save_pretrained`.

    Args:
        folder: of the run. ``evaluation/summary.json`` in it, which ``kornia-tidy evaluate`` writes, has the scores on
            test scenes, ``validation.csv`` those after each epoch.

    Returns:
        ``"scores"`` by test set, if the run was evaluated, and ``"validation"``, the lines of ``validation.csv``.

    Raises:
        FileNotFoundError: if the folder or both files are missing.
        ValueError: if a file is damaged.

    Example:
        >>> import tempfile
        >>> from pathlib import Path
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = Path(folder, "validation.csv").write_text("epoch,val_loss\n0,0.5\n")
        ...     training_record(folder)
        {'validation': [{'epoch': '0', 'val_loss': '0.5'}]}
    """
    folder = check_folder(folder)
    record: dict[str, Any] = {}
    if (summary := folder / EVALUATION).exists():
        about = read_json(summary)
        with error_prefix(
            f"cannot read {summary}: it is no summary of an evaluation", AttributeError, KeyError, TypeError
        ):
            test_set = f"{about['settings']['data']}, {about['split']}, {about['scenes']} scenes"
            record["scores"] = {test_set: {str(name): float(value) for name, value in about["mean"].items()}}
    if (validation := folder / VALIDATION).exists():
        record["validation"] = read_csv(validation)
    if not record:
        raise FileNotFoundError(f"{folder} has neither {EVALUATION} nor {VALIDATION}: it is no folder of a run")
    return record
