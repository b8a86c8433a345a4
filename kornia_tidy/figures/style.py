"""Style of the figures: colours, font sizes, colour maps and ticks. Matplotlib is imported on first use."""

from __future__ import annotations

import os
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kornia_tidy.files import write_bytes
from kornia_tidy.search_path import import_extra

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, FAINT, ACCENT = "#1c2733", "#66727f", "#c2410c"
DEPTH_COLORS, PHASE_COLORS = "inferno", "twilight"
TITLE, LABEL, SMALL = 9.5, 7.5, 6.5  # pt
RED, GREEN, BLUE = "#c0392b", "#2e8b57", "#2563eb"  # a camera's channels


def require_matplotlib() -> None:
    """Raise ``ImportError`` with instructions if matplotlib is missing.

    Raises:
        ImportError: if matplotlib is missing.
    """
    import_extra("matplotlib.figure", "a picture")


def new_figure(width: float, height: float, layout: Any = "constrained") -> Figure:
    """Return an empty white figure of inches.

    Raises:
        ImportError: if matplotlib is missing.
    """
    require_matplotlib()
    from matplotlib.figure import Figure  # noqa: PLC0415

    return Figure(figsize=(width, height), facecolor="white", layout=layout)


def shown(name: str) -> str:
    r"""Return the name of a file or of a thing as a figure can show it.

    Bytes that are no text become question marks, and a dollar sign begins no formula.

    Example:
        >>> print(shown("a$b" + chr(0xDCFF)))
        a\$b?
    """
    return name.encode(errors="replace").decode().replace("$", r"\$")


def encoded_figure(figure: Figure, dpi: float = 150, format: str = "png") -> bytes:  # noqa: A002 (as matplotlib has it)
    """Return a figure as the bytes of a picture file."""
    picture = BytesIO()
    figure.savefig(picture, dpi=dpi, format=format)
    return picture.getvalue()


def save_figure(path: str | os.PathLike[str], figure: Figure, dpi: float = 150) -> None:
    """Write a figure atomically, in the format of the path's suffix."""
    write_bytes(path, encoded_figure(figure, dpi, Path(path).suffix[1:]))


def quiet(axes: Axes, spines: bool = True) -> None:
    """Remove all ticks but those of an x axis from 0 to 1, and draw the frame in a faint style."""
    if axes.get_xlim() != (0, 1):
        axes.set_xticks([])
    axes.set_yticks([])
    axes.tick_params(labelsize=SMALL, length=2, width=0.5, pad=1.5, color=FAINT, labelcolor=FAINT)
    for spine in axes.spines.values():
        spine.set_visible(spines)
        spine.set(linewidth=0.5, color=FAINT)


def open_chart(axes: Axes, label_size: float, **properties: Any) -> None:
    """Set properties of a chart, and draw it with a faint grid, a legend, and without frame at the top and right.

    Args:
        axes: with all lines.
        label_size: of ticks, labels and legend in pt; the title is a point larger.
        **properties: as ``axes.set`` takes them, such as ``title`` and ``xlabel``.
    """
    axes.set(**properties)
    for text, larger in ((axes.title, 1), (axes.xaxis.label, 0), (axes.yaxis.label, 0)):
        text.set(fontsize=label_size + larger, color=INK)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=label_size, frameon=False)
    axes.grid(which="major", color="#e8ecef", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(which="both", labelsize=label_size, labelcolor=INK, color=FAINT)
    axes.spines[["top", "right"]].set_visible(False)
