"""CODE V files (.seq): surfaces of revolution in sequence, by the commands that a saved lens has."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence

from kornia_tidy.optics.lens.file_surfaces import AIR, FAR, FileLens, FileSurface, number

UNITS = {"M": 1.0, "MM": 1.0, "C": 10.0, "CM": 10.0, "I": 25.4, "IN": 25.4}
_POWERS = dict(zip("ABCDEFGHJ", range(4, 22, 2), strict=True))  # of an asphere's coefficients; the letter I is left out
_FIELDS = ("XAN", "YAN", "XIM", "YIM", "XRI", "YRI", "XOB", "YOB")
_FICTITIOUS = re.compile(r"\d{3,6}\.\d{3,6}")  # digits of nd - 1, and of Abbe's number after two
# Commands about the use, drawing, making or improvement of a lens, not its shape.
_DISPLACED = ("XDE", "YDE", "ZDE", "ADE", "BDE", "CDE", "CUF")  # allowed where they are 0
_WITHOUT_EFFECT = (
    *("ASP", "CAN", "CCY", "CLS", "CON", "CWL", "DER", "DOR", "EPD", "FNO", "GLC", "GO", "INI", "LEN", "LOC"),
    *("NA", "NAO", "PIM", "PRE", "SLB", "SPH", "TEM", "THC", "UID", "VLX", "VLY", "VUX", "VUY", "WTF", "WTW", "KC"),
    *(f"{letter}C" for letter in _POWERS),
)


def read_codev(text: str) -> FileLens:
    """Return the lens of a CODE V file.

    Args:
        text: of the file.

    Raises:
        ValueError: if it holds other things than surfaces of revolution between air and glass, or is damaged.

    Convention:
        - ``RDM`` in the file chooses radii or curvatures of surfaces: the defaults of programs differ.
        - Spheres, conics and aspheres to the 20th power are read. Decentred and tilted surfaces, mirrors, apertures
          that are not discs and commands that are not known are refused by name.

    Source: CODE V Reference Manual (Synopsys), chapters on lens data and materials, for the meaning of the commands.
    """
    return _Reader().read(text)


class _Reader:
    """Contents of a file read so far."""

    def __init__(self) -> None:
        self.lens = FileLens()
        self.surfaces: list[FileSurface] = []
        self.radii: bool | None = None
        self.wavelengths: list[float] = []
        self.reference = 1
        self.private: list[float] | None = None  # wavelengths in nm of the private catalogue that is being read
        self.sides: dict[str, float] = {}
        self.stop: int | None = None
        self.ended = False

    def read(self, text: str) -> FileLens:
        lens = self.lens
        for words in commands(text):
            self._command(words[0], words[1:])
        if not self.ended or len(self.surfaces) < 3:
            raise ValueError("it must have an object (SO), surfaces (S) and a sensor (SI)")
        lens.take(self.surfaces)
        if self.stop is not None:
            if not 1 <= self.stop <= len(lens.surfaces):
                raise ValueError(f"its stop must be one of the surfaces 1 to {len(lens.surfaces)}, got {self.stop}")
            lens.surfaces[self.stop - 1].stop = True
        if self.wavelengths:
            if not 1 <= self.reference <= len(self.wavelengths):
                raise ValueError(f"its REF must be from 1 to {len(self.wavelengths)}, got {self.reference}")
            lens.wavelength = 1e-9 * self.wavelengths[self.reference - 1]
        for names, kind in ((("XAN", "YAN"), "angle"), (("XIM", "YIM"), "height"), (("XRI", "YRI"), "height")):
            if largest := math.hypot(*(self.sides.get(name, 0.0) for name in names)):
                setattr(lens, kind, largest)
        return lens

    def _command(self, name: str, words: Sequence[str]) -> None:
        command = name.upper()[:3]  # the rest is for people
        if command in ("PRV", "END"):
            self.private = [] if command == "PRV" else None
        elif self.private is not None:
            self._private(name, words)
        elif command in ("SO", "S", "SI"):
            self._surface(command, words)
        elif self.surfaces and command in ("STO", "CIR", "K", *_POWERS):
            self._of_surface(self.surfaces[-1], command, words)
        elif not self._of_lens(command, words):
            displaced = command not in _DISPLACED or any(number(f"{command} of a surface", word) for word in words)
            if displaced and command not in _WITHOUT_EFFECT:
                where = self.surfaces[-1].where if self.surfaces and not self.ended else "it"
                raise ValueError(f"{where} has the command {name!r:.60}, which is not read")

    def _of_lens(self, command: str, words: Sequence[str]) -> bool:
        """Take a command that says something of the whole lens, and return whether it was one."""
        first = words[0] if words else ""
        if command == "TIT":
            self.lens.name = " ".join(words).strip("'\"")
        elif command == "DIM":
            if first.upper() not in UNITS:
                raise ValueError(f"its DIM must be one of {', '.join(UNITS)}, got {first!r:.60}")
            self.lens.unit = UNITS[first.upper()]
        elif command == "RDM":
            self.radii = not first.upper().startswith("N")
        elif command == "WL":
            self.wavelengths = [number("its wavelengths", word) for word in words]
        elif command == "REF":
            self.reference = int(number("its REF", first))
        elif command in _FIELDS:
            self.sides[command] = max((abs(number("its fields", word)) for word in words), default=0.0)
        else:
            return False
        return True

    def _surface(self, command: str, words: Sequence[str]) -> None:
        if self.radii is None:
            raise ValueError("it must say by RDM (radii) or RDM N (curvatures) what its surfaces have")
        surface = FileSurface(f"surface {len(self.surfaces)}")
        if len(words) < 2:
            raise ValueError(f"{surface.where} must have a radius and a distance, got {' '.join(words)!r:.60}")
        shape = number(f"radius of {surface.where}", words[0])
        surface.curvature = 1 / shape if self.radii and shape else shape
        if self.radii and abs(shape) >= FAR:
            surface.curvature = 0.0
        surface.gap = number(f"distance behind {surface.where}", words[1])
        if len(words) > 2:
            surface.glass = self._glass(surface.where, words[2])
        self.surfaces.append(surface)
        self.ended = command == "SI"

    def _glass(self, where: str, name: str) -> str:
        label = name.upper().strip("'\"")
        if label in ("AIR", ""):
            return AIR
        if label == "REFL":
            raise ValueError(f"{where} is a mirror, and only lenses of refracting surfaces are read")
        indices = self.lens.indices
        if label not in indices and _FICTITIOUS.fullmatch(label):
            index, abbe = label.split(".")
            indices[label] = {"nd": 1 + int(index) / 10 ** len(index), "vd": int(abbe) / 10 ** (len(abbe) - 2)}
        return self.lens.glass(where, label)

    def _of_surface(self, surface: FileSurface, command: str, words: Sequence[str]) -> None:
        if command == "STO":
            if words:
                self.stop = int(number("its stop", words[0].upper().removeprefix("S")))
            else:
                surface.stop = True
        elif command == "CIR":
            *kinds, radius = words or [""]
            if any(word.upper() not in ("EDG", "CLR") for word in kinds):
                raise ValueError(f"the aperture of {surface.where} must be a disc, got CIR {' '.join(words):.60}")
            if "EDG" not in (word.upper() for word in kinds):
                surface.clear = number(f"CIR of {surface.where}", radius)
        else:
            value = number(f"{command} of {surface.where}", words[0] if words else "")
            if command == "K":
                surface.conic = value
            else:
                surface.powers[_POWERS[command]] = value

    def _private(self, command: str, words: Sequence[str]) -> None:
        """Take a line of a private catalogue: wavelengths in nanometres, or the indices of a glass at these."""
        values = [number("indices of its private glasses", word) for word in words]
        if command.upper() == "PWL":
            self.private = values
        elif self.private is None or len(values) != len(self.private):
            raise ValueError(f"its private glass {command!r:.60} must have an index for each wavelength of PWL")
        else:
            self.lens.indices[command.upper().strip("'\"")] = dict(zip(map(str, self.private), values, strict=True))


def commands(text: str) -> Iterator[list[str]]:
    r"""Yield the commands of a file as words: semicolons part them, and after an ampersand they go on in the next line.

    Example:
        >>> list(commands("RDM;LEN  'a; b' ! a comment\nS 1.0 &\n  2.0"))
        [['RDM'], ['LEN', "'a; b'"], ['S', '1.0', '2.0']]
    """
    joined = re.sub(r"&[ \t]*\r?\n", " ", re.sub(r"!.*", "", text))
    for line in joined.splitlines():
        words: list[str] = []
        for word in re.findall(r"'[^']*'|\"[^\"]*\"|;|[^\s;'\"]+|['\"]", line):
            if word == ";":
                if words:
                    yield words
                words = []
            else:
                words.append(word)
        if words:
            yield words
