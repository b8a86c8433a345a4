"""Whether a picture's texts can be read."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from matplotlib.backends.backend_agg import FigureCanvasAgg

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.text import Text


def check_texts(figure: Figure, texts: Iterable[Text], inside: bool = True) -> list[str]:
    """Fail if a text leaves the picture or covers another; return those that are not empty."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    boxes = [(t.get_text(), t.get_window_extent(canvas.get_renderer())) for t in texts if t.get_text()]
    for i, (text, box) in enumerate(boxes):
        assert not inside or (figure.bbox.contains(box.x0, box.y0) and figure.bbox.contains(box.x1, box.y1)), text
        for other, second in boxes[:i]:
            assert not box.overlaps(second), (text, other)
    return [text for text, _ in boxes]
