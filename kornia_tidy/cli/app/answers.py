"""Answers of the page to values of its controls: pictures, legends and the script, or one sentence for a mistake."""

from __future__ import annotations

import time
import traceback
from collections.abc import Mapping
from typing import Any, NamedTuple

from kornia_tidy.cli.app.capture import Result, Tell, take_picture
from kornia_tidy.cli.app.legends import legends, mistake, status
from kornia_tidy.cli.app.pictures import Picture, depth_map, masks_and_psfs, photograph
from kornia_tidy.cli.app.script import as_python
from kornia_tidy.cli.app.settings import settings_of

PICTURES = ("scene", "capture", "image", "depth", "estimate", "psfs")
KEPT = "The pictures are those of the settings before."


class Answer(NamedTuple):
    """Answer of the page."""

    message: str
    """Camera and time, or a mistake in one sentence; Markdown."""
    pictures: dict[str, Picture]
    """By name, without ``"estimate"`` for a camera that estimates no depth; empty after a mistake."""
    legends: dict[str, str]
    """Of each of ``PICTURES``, Markdown; empty after a mistake."""
    script: str
    """Python script of the same capture; empty after a mistake."""


def answer(values: Mapping[str, Any], tell: Tell = lambda share, stage: None) -> Answer:
    """Return the page's answer to values of its controls.

    Args:
        values: by the names of the controls, in the units of their labels; missing ones are default.
        tell: see :func:`~kornia_tidy.cli.app.capture.take_picture`.

    Returns:
        Pictures, legends and script; after a mistake only a sentence, so that the page keeps its pictures. A fault of
        the library is printed with its traceback to standard error too, for a report.

    Example:
        >>> answer({"noise": None}).message
        '**Read noise (% of full scale): give a number.** The pictures are those of the settings before.'
    """
    try:
        start = time.perf_counter()
        settings = settings_of(values)
        result = take_picture(settings, tell)
        tell(0.85, "pictures")
        pictures = draw(result)
        return Answer(status(result, time.perf_counter() - start), pictures, legends(result), as_python(settings))
    except Exception as error:
        if not isinstance(error, (ImportError, OSError, TypeError, ValueError)):
            traceback.print_exception(error)
        told = mistake(error, [values.get("image_file"), values.get("depth_file")])
        return Answer(f"**{told}** {KEPT}", {}, {}, "")


def draw(result: Result) -> dict[str, Picture]:
    """Return the pictures of a result by name."""
    pictures = {
        "scene": photograph(result.scene.image),
        "capture": photograph(result.capture),
        "image": photograph(result.image),
        "depth": depth_map(result.inverse_depth, result.camera),
        "psfs": masks_and_psfs(result),
    }
    if result.estimate is not None:
        pictures["estimate"] = depth_map(result.estimate, result.camera)
    return pictures
