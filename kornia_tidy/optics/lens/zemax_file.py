"""Zemax files (.zmx): surfaces of revolution in sequence, by the keywords of the text format."""

from __future__ import annotations

import math
from collections.abc import Sequence

from kornia_tidy.optics.lens.file_surfaces import AIR, FileLens, FileSurface, number

UNITS = {"MM": 1.0, "CM": 10.0, "IN": 25.4, "INCH": 25.4, "METER": 1000.0, "M": 1000.0}
TYPES = ("STANDARD", "EVENASPH", "ODDASPHE")
MOST_TERMS = 8  # of an asphere
_ANGLES, _HEIGHTS = ("0",), ("2", "3")  # kinds of field: angles, and heights on the sensor
# Keywords for the drawing, coating, making or solving of a surface, not its shape.
_WITHOUT_EFFECT = (
    *("BLNK", "COAT", "COFN", "COMM", "EDGE", "FIMP", "HIDE", "MAZH", "MEMA", "MIRR", "OEMA", "PICK", "POPS", "PPAR"),
    *("PUSH", "PZUP", "SLAB", "VCON", "VDSZ", "VPAR"),
)
_NUMBERS = {"CURV": "curvature", "CONI": "conic"}
_OF_SURFACES = ("TYPE", "CURV", "CONI", "DISZ", "STOP", "PARM", "GLAS", "CLAP", "FLAP", "DIAM", "OBDC", "XDAT")
_EDGES = ("CLAP", "FLAP", "DIAM")  # the first that there is counts
_MIRROR, _MODEL = "MIRROR", "1"


def read_zemax(text: str) -> FileLens:
    """Return the lens of a Zemax file.

    Args:
        text: of the file.

    Raises:
        ValueError: if it holds other things than surfaces of revolution between air and glass, or is damaged.

    Convention:
        - Of types of surfaces STANDARD, EVENASPH and ODDASPHE are read. Coordinate breaks, mirrors, apertures that are
          no discs about the axis and whatever else changes light are refused by name.
        - Light is cut at circular and floating apertures, and at diameters that the designer fixed; not at those that
          the program found.

    Source: ZEMAX Optical Design Program User's Guide (2011), chapters 4 to 7, for the meaning of the values.
    """
    header, blocks = _blocks(text)
    lens = FileLens(name=" ".join(header.get("NAME", [[]])[-1]))
    if (mode := _first(header, "MODE", "SEQ")) != "SEQ":
        raise ValueError(f"its MODE must be SEQ, for surfaces in sequence, got {mode!r:.60}")
    unit = _first(header, "UNIT", "MM")
    if unit not in UNITS:
        raise ValueError(f"its UNIT must be one of {', '.join(UNITS)}, got {unit!r:.60}")
    lens.unit = UNITS[unit]
    catalogues = header.get("GCAT", [[]])[-1]
    lens.take([_surface(i, block, lens, catalogues) for i, block in enumerate(blocks)])
    if any(math.isinf(surface.gap) for surface in lens.surfaces):
        raise ValueError("distances between its surfaces must be finite, got INFINITY")
    lens.wavelength = _primary(header) or lens.wavelength
    kind = _first(header, "FTYP", "0")
    largest = _largest_field(header)
    lens.angle = largest if kind in _ANGLES else None
    lens.height = largest if kind in _HEIGHTS else None
    return lens


def _blocks(text: str) -> tuple[dict[str, list[Sequence[str]]], list[list[Sequence[str]]]]:
    """Return the words behind each keyword of the header, and the lines of each surface as words."""
    header: dict[str, list[Sequence[str]]] = {}
    blocks: list[list[Sequence[str]]] = []
    for line in text.splitlines():
        words = line.split()
        if not words:
            continue
        if words[0] == "SURF":
            blocks.append([])
        elif blocks and (line[0].isspace() or words[0] in _OF_SURFACES):
            blocks[-1].append(words)
        else:
            header.setdefault(words[0], []).append(words[1:])
    return header, blocks


def _first(header: dict[str, list[Sequence[str]]], keyword: str, default: str) -> str:
    words = header.get(keyword, [[]])[-1]
    return words[0].upper() if words else default


def _primary(header: dict[str, list[Sequence[str]]]) -> float | None:
    """Return the primary wavelength in metres."""
    wanted = _first(header, "PWAV", "1")
    for words in header.get("WAVM", []):
        if len(words) > 1 and words[0] == wanted:
            return 1e-6 * number("its primary wavelength", words[1])
    return None


def _largest_field(header: dict[str, list[Sequence[str]]]) -> float | None:
    sides = []
    for keywords in (("XFLN", "XFLD"), ("YFLN", "YFLD")):
        words = next((header[keyword][-1] for keyword in keywords if keyword in header), [])
        sides.append(max((abs(number("fields", word)) for word in words), default=0.0))
    return math.hypot(*sides) or None


def _surface(i: int, block: Sequence[Sequence[str]], lens: FileLens, catalogues: Sequence[str]) -> FileSurface:
    surface = FileSurface(f"surface {i}")
    lines: dict[str, list[Sequence[str]]] = {}
    for keyword, *words in block:
        lines.setdefault(keyword, []).append(words)
    for keyword in lines:
        if keyword not in (*_OF_SURFACES, *_WITHOUT_EFFECT):
            raise ValueError(f"{surface.where} has {keyword!r:.60}, which is not read")
    kind = _first(lines, "TYPE", "STANDARD")
    if kind not in TYPES:
        raise ValueError(f"{surface.where} must be of type {', '.join(TYPES)}, got {kind!r:.60}")

    def value(keyword: str, words: Sequence[str], place: int = 0) -> float:
        return number(f"{keyword} of {surface.where}", words[place] if len(words) > place else "")

    if any(value("XDAT", words, 1) for words in lines.get("XDAT", [])):
        raise ValueError(f"{surface.where} has extra data (XDAT), which are not read")
    for words in lines.get("OBDC", []):
        if value("OBDC", words) or value("OBDC", words, 1):
            moved = " ".join(words)
            raise ValueError(f"the aperture of {surface.where} must stand about the axis, got OBDC {moved:.60}")
    for keyword, name in _NUMBERS.items():
        for words in lines.get(keyword, []):
            setattr(surface, name, value(keyword, words))
    for words in lines.get("DISZ", []):
        surface.gap = math.inf if [word.upper() for word in words[:1]] == ["INFINITY"] else value("DISZ", words)
    if kind != "STANDARD":
        terms = {value("PARM", words): value("PARM", words, 1) for words in lines.get("PARM", [])}
        surface.powers = _powers(surface.where, terms, 2 if kind == "EVENASPH" else 1)
    for words in lines.get("GLAS", []):
        surface.glass = _glass(surface.where, words, lens, catalogues)
    surface.stop = "STOP" in lines
    edges = [_edge(surface.where, keyword, words) for keyword in _EDGES for words in lines.get(keyword, [])]
    surface.clear = next((edge for edge in edges if edge), None)
    return surface


def _powers(where: str, terms: dict[float, float], step: int) -> dict[int, float]:
    """Return the powers of an asphere from its parameters, one for each step of the power."""
    for term, value in terms.items():
        if value and term not in range(1, MOST_TERMS + 1):
            raise ValueError(f"PARM of {where} must be from 1 to {MOST_TERMS}, got {term:g}")
    return {step * int(term): value for term, value in terms.items() if value}


def _glass(where: str, words: Sequence[str], lens: FileLens, catalogues: Sequence[str]) -> str:
    name = words[0] if words else ""
    if name.upper() == "AIR":
        return AIR
    if name.upper() == _MIRROR:
        raise ValueError(f"{where} is a mirror, and only lenses of refracting surfaces are read")
    if len(words) > 4 and words[1] == _MODEL:
        nd, vd = number(f"index of {where}", words[3]), number(f"Abbe number of {where}", words[4])
        name = f"{nd:g}/{vd:g}"
        lens.indices[name] = {"nd": nd, "vd": vd} if vd else nd
    return lens.glass(where, name, catalogues)


def _edge(where: str, keyword: str, words: Sequence[str]) -> float | None:
    """Return the radius of an aperture, or None where light is not cut."""
    values = [number(f"{keyword} of {where}", word) for word in words[:2]]
    if keyword == "DIAM":  # found by the program unless a 1 follows
        return values[0] if values and (len(values) < 2 or values[1] == 1) else None
    if len(values) < 2 or values[0]:
        raise ValueError(f"the aperture of {where} must be a disc, got {keyword} {' '.join(words):.60}")
    return values[1]
