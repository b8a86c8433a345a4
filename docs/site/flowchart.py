"""Flow charts of pages, written in Mermaid's language, drawn as SVG when the site is built: nothing is loaded.

Read are `flowchart TD` or `LR`, boxes `name["first line<br/>second line"]`, arrows `a --> b` and dotted ones with words
`a -. words .-> b`. The layout is that of Sugiyama, Tagawa, Toda: Methods for visual understanding of hierarchical
system structures (1981): boxes in layers by the longest path, their order by barycentres, long arrows through
places that are kept free in the layers between.
"""

from __future__ import annotations

import html
import itertools
import re
from collections import defaultdict
from typing import NamedTuple

BOX = r"(\w+)(?:\[\"?([^\]\"]*)\"?\])?"
ARROW = re.compile(rf"{BOX}\s*(?:-->|-\.\s*(.*?)\s*\.->)\s*{BOX}")
CHARACTER, LINE, MARGIN = 7.6, 18, 12  # px: width and height of text, and around it in a box
BETWEEN, LAYERS = 22, 40  # px between boxes of a layer, and between layers
FREE = 14  # px kept free for an arrow that passes a layer
SWEEPS = 24

Name = str | tuple[str, str, int]  # of a box, or of the place of an arrow in a layer


class Chart(NamedTuple):
    """Contents of a flow chart."""

    across: bool  # from left to right
    lines: dict[str, list[str]]  # of text in each box
    arrows: dict[tuple[str, str], str | None]  # words of a dotted arrow, None of a plain one


def read_chart(text: str) -> Chart:
    """Read a flow chart; a line that is not understood is a ValueError."""
    first, *rest = [line.strip() for line in text.strip().splitlines()]
    if first not in ("flowchart TD", "flowchart LR"):
        raise ValueError(f"a flow chart must begin with flowchart TD or flowchart LR, got {first!r}")
    lines: dict[str, list[str]] = {}
    arrows: dict[tuple[str, str], str | None] = {}
    for line in rest:
        found = ARROW.fullmatch(line)
        if not found:
            raise ValueError(f"a line of a flow chart must be an arrow between boxes, got {line!r}")
        start, start_text, words, end, end_text = found.groups()
        for name, label in ((start, start_text), (end, end_text)):
            if label or name not in lines:
                lines[name] = (label or name).split("<br/>")
        arrows[start, end] = words
    return Chart(first.endswith("LR"), lines, arrows)


def ranks(chart: Chart) -> dict[str, int]:
    """Return the layer of each box: below all boxes that point to it, and near its targets."""
    found = dict.fromkeys(chart.lines, 0)
    for _ in found:  # the longest path has fewer arrows than there are boxes
        for start, end in chart.arrows:
            found[end] = max(found[end], found[start] + 1)
    if any(found[end] <= found[start] for start, end in chart.arrows):
        raise ValueError("the arrows of a flow chart must not go in a circle")
    for name in found:
        if all(end != name for _, end in chart.arrows):
            found[name] = min((found[end] for start, end in chart.arrows if start == name), default=1) - 1
    return found


def layout(chart: Chart) -> tuple[list[list[Name]], dict[tuple[str, str], list[Name]]]:
    """Return the layers, in order, and the stations of each arrow."""
    rank = ranks(chart)
    stations: dict[tuple[str, str], list[Name]] = {}
    layers: list[list[Name]] = [[] for _ in range(max(rank.values()) + 1)]
    for name, place in rank.items():
        layers[place].append(name)
    for start, end in chart.arrows:
        between: list[Name] = [(start, end, place) for place in range(rank[start] + 1, rank[end])]
        stations[start, end] = [start, *between, end]
        for place, name in enumerate(between, rank[start] + 1):
            layers[place].append(name)
    near = neighbours(stations)
    for sweep in range(SWEEPS):
        at = {name: place for layer in layers for place, name in enumerate(layer)}
        side = sweep % 2  # those above, then those below
        for layer in layers if side == 0 else layers[::-1]:
            layer.sort(key=lambda name: _mean([at[other] for other in near[name][side]], at[name]))
            at.update({name: place for place, name in enumerate(layer)})
    return layers, stations


def neighbours(stations: dict[tuple[str, str], list[Name]]) -> dict[Name, tuple[list[Name], list[Name]]]:
    """Return the predecessors and successors of each box and place on its arrows."""
    near: dict[Name, tuple[list[Name], list[Name]]] = defaultdict(lambda: ([], []))
    for path in stations.values():
        for one, other in itertools.pairwise(path):
            near[one][1].append(other)
            near[other][0].append(one)
    return near


def centres(layers: list[list[Name]], near: dict, extent: dict[Name, float]) -> dict[Name, float]:
    """Return the place of each box along its layer: near the mean of its neighbours, without overlap."""
    at: dict[Name, float] = {}
    for layer in layers:
        at |= zip(layer, separated([0.0] * len(layer), [extent[name] for name in layer]), strict=True)
    for sweep in range(SWEEPS):
        for layer in layers if sweep % 2 == 0 else layers[::-1]:
            wanted = [_mean([at[other] for side in near[name] for other in side], at[name]) for name in layer]
            at |= zip(layer, separated(wanted, [extent[name] for name in layer]), strict=True)
    return at


def separated(wanted: list[float], extents: list[float]) -> list[float]:
    """Return places in order that do not overlap and have the least squared distance to those wanted.

    Example:
        >>> separated([0.0, 0.0], [10.0, 10.0])
        [-16.0, 16.0]
    """
    steps = [0.0] + [(one + other) / 2 + BETWEEN for one, other in itertools.pairwise(extents)]
    offsets = list(itertools.accumulate(steps))
    blocks: list[list[float]] = []  # isotonic regression: neighbours in the wrong order share their mean
    for value, offset in zip(wanted, offsets, strict=True):
        blocks.append([value - offset])
        while len(blocks) > 1 and _mean(blocks[-2]) > _mean(blocks[-1]):
            blocks[-2:] = [blocks[-2] + blocks[-1]]
    level = [_mean(block) for block in blocks for _ in block]
    return [value + offset for value, offset in zip(level, offsets, strict=True)]


def _mean(values: list[float], default: float = 0.0) -> float:
    return sum(values) / len(values) if values else default


def draw_chart(text: str) -> str:
    """Return a flow chart as an SVG element."""
    chart = read_chart(text)
    layers, stations = layout(chart)
    sizes = {name: (max(map(len, rows)) * CHARACTER + 2 * MARGIN, len(rows) * LINE + 2 * MARGIN - 4)
             for name, rows in chart.lines.items()}  # fmt: skip
    along, depth = (1, 0) if chart.across else (0, 1)
    extent = {name: sizes[name][along] if isinstance(name, str) else FREE for layer in layers for name in layer}
    at = centres(layers, neighbours(stations), extent)
    thickness = [max([sizes[name][depth] for name in layer if isinstance(name, str)], default=0) for layer in layers]
    begins = [sum(thickness[:n]) + n * LAYERS for n in range(len(layers))]
    middle = {name: begins[n] + thickness[n] / 2 for n, layer in enumerate(layers) for name in layer}
    low = min(at[name] - extent[name] / 2 for name in at) - 2

    def point(across: float, down: float) -> tuple[float, float]:
        return (down + 2, across - low) if chart.across else (across - low, down + 2)

    parts = []
    for (start, end), path in stations.items():
        edge = [(at[start], middle[start] + sizes[start][depth] / 2)]
        edge += [
            place for name in path[1:-1] for place in ((at[name], middle[name] - FREE), (at[name], middle[name] + FREE))
        ]
        edge += [(at[end], middle[end] - sizes[end][depth] / 2 - 6)]
        parts.append(
            curve([point(*place) for place in edge], chart.across, dotted=chart.arrows[start, end] is not None)
        )
    for name, rows in chart.lines.items():
        x, y = point(at[name], middle[name])
        width, height = sizes[name]
        parts.append(
            f'<rect x="{x - width / 2:.0f}" y="{y - height / 2:.0f}" width="{width:.0f}" height="{height:.0f}" rx="5"/>'
        )
        top = y - (len(rows) - 1) * LINE / 2
        parts += [f'<text x="{x:.0f}" y="{top + n * LINE:.0f}">{html.escape(row)}</text>' for n, row in enumerate(rows)]
    high = max(at[name] + extent[name] / 2 for name in at) - low + 2
    total = begins[-1] + thickness[-1] + 4
    width, height = (total, high) if chart.across else (high, total)
    words = html.escape(", ".join(f"{start} to {end}" for start, end in chart.arrows))
    size = f'viewBox="0 0 {width:.0f} {height:.0f}" width="{width:.0f}" height="{height:.0f}"'
    drawing = f'<svg role="img" aria-label="Flow chart: {words}" {size}>{"".join(parts)}</svg>'
    return f'<div class="flowchart">{drawing}</div>'


def curve(points: list[tuple[float, float]], across: bool, dotted: bool) -> str:
    """Return an arrow through points, which leaves and meets each in the direction of the chart."""
    commands = [f"M{points[0][0]:.0f},{points[0][1]:.0f}"]
    for (x, y), (to_x, to_y) in itertools.pairwise(points):
        half_x, half_y = (x + to_x) / 2, (y + to_y) / 2
        bend = (
            f"{half_x:.0f},{y:.0f} {half_x:.0f},{to_y:.0f}"
            if across
            else f"{x:.0f},{half_y:.0f} {to_x:.0f},{half_y:.0f}"
        )
        commands.append(f"C{bend} {to_x:.0f},{to_y:.0f}")
    x, y = points[-1]
    head = f"{x - 1:.0f},{y - 4:.0f} {x - 1:.0f},{y + 4:.0f} {x + 6:.0f},{y:.0f}"
    if not across:
        head = f"{x - 4:.0f},{y - 1:.0f} {x + 4:.0f},{y - 1:.0f} {x:.0f},{y + 6:.0f}"
    dashes = ' stroke-dasharray="4 4"' if dotted else ""
    return f'<path d="{"".join(commands)}"{dashes}/><polygon points="{head}"/>'
