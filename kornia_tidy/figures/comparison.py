"""Figure that compares cameras by rows of pictures, each with its score and a detail three times as large."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import zip_longest
from typing import TYPE_CHECKING, NamedTuple

from kornia.color import rgb_to_y
from kornia.filters import box_blur
from torch import Tensor
from torch.nn import functional

from kornia_tidy.figures.style import ACCENT, INK, LABEL, TITLE, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLUMN = 2.9  # inches
ZOOM, DETAIL = 3, 1 / 8  # of the shorter side


class Panel(NamedTuple):
    """A picture with its words."""

    heading: str
    picture: Tensor
    """(3, H, W) in [0, 1]."""
    words: str = ""
    """Such as its score."""
    zoomed: bool = True
    """Whether the detail is drawn."""


def draw_comparison(rows: Sequence[Sequence[Panel | None]], title: str, subtitle: str, notes: Sequence[str]) -> Figure:
    """Draw rows of pictures of one scene, with the same detail of each in its corner.

    Args:
        rows: from top to bottom, each of pictures from left to right; None leaves a place empty. The first picture is
            the scene itself, in which the detail is chosen: where it has most of it.
        title: heading of the page.
        subtitle: a sentence below it.
        notes: paragraphs at the foot.

    Returns:
        A figure; ``figure.savefig(path, dpi=150)`` makes four columns 1900 pixels wide.

    Raises:
        ImportError: if matplotlib is missing.
        ValueError: if the first place is empty.
    """
    if not rows or not rows[0] or rows[0][0] is None:
        raise ValueError("the first picture of a comparison must be the scene, and there is none")
    scene = rows[0][0].picture
    columns = max(map(len, rows))
    tall = (COLUMN * scene.shape[-2] / scene.shape[-1] + 0.6) * len(rows) + 0.3 * len(notes) + 0.9
    figure = new_figure(columns * (COLUMN + 0.2), tall)
    figure.suptitle(f"{title}\n{subtitle}", fontsize=TITLE + 1.5, color=INK)
    figure.supxlabel("\n".join(notes), fontsize=LABEL, color=INK, x=0.01, ha="left")
    place = detail_of(scene)
    for line, row in zip(figure.subplots(len(rows), columns, squeeze=False), rows, strict=True):
        for axes, panel in zip_longest(line, row):
            _bare(axes)
            if panel is not None:
                _draw(axes, panel, place)
    return figure


def detail_of(scene: Tensor) -> tuple[int, int, int]:
    """Return top, left and side in pixels of the square of a scene with the finest detail, which is not at the border.

    Args:
        scene: (3, H, W) in [0, 1].

    Example:
        >>> import torch
        >>> scene = torch.full((3, 64, 64), 0.5)
        >>> scene[:, 30:34:2, 38:42:2] = 1.0
        >>> top, left, side = detail_of(scene)
        >>> top <= 30 <= 32 < top + side, left <= 38 <= 40 < left + side
        (True, True)
    """
    luma = rgb_to_y(scene[None])
    side = max(1, round(DETAIL * min(scene.shape[-2:])))
    fine = (luma - box_blur(luma, (3, 3))).abs()  # edges do not outweigh textures as in squares
    contrast = functional.avg_pool2d(fine, side, 1)[0, 0]
    rows, columns = (length // 8 for length in contrast.shape)
    inner = contrast[rows : len(contrast) - rows, columns : contrast.shape[1] - columns]
    best = int(inner.argmax())
    return best // inner.shape[1] + rows, best % inner.shape[1] + columns, side


def _draw(axes: Axes, panel: Panel, place: tuple[int, int, int]) -> None:
    from matplotlib.patches import Rectangle  # noqa: PLC0415

    pixels = panel.picture.detach().cpu().clamp(0, 1).permute(1, 2, 0).numpy()
    axes.imshow(pixels, interpolation="antialiased")
    axes.set_xlabel(panel.words, fontsize=LABEL + 1, color=INK, labelpad=3)
    axes.set_title(panel.heading, fontsize=TITLE, color=ACCENT, weight="bold", loc="left", pad=4)
    if not panel.zoomed:
        return
    top, left, side = place
    height, width = pixels.shape[:2]
    axes.add_patch(Rectangle((left, top), side, side, fill=False, edgecolor="white", linewidth=0.8))
    x = 0.0 if left + side / 2 > width / 2 else 1 - ZOOM * side / width  # in the half without the square
    inset = axes.inset_axes((x, 0.0, ZOOM * side / width, ZOOM * side / height))
    inset.imshow(pixels[top : top + side, left : left + side], interpolation="nearest")
    _bare(inset)
    for spine in inset.spines.values():
        spine.set(visible=True, color="white", linewidth=1.0)


def _bare(axes: Axes) -> None:
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)
