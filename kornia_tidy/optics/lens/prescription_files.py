"""Prescriptions from files: Zemax, CODE V, and JSON of Optiland, DeepLens or this package."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

from kornia_tidy.files import error_prefix, parse_json, read_bytes
from kornia_tidy.optics.lens.codev_file import read_codev
from kornia_tidy.optics.lens.file_surfaces import lens_of
from kornia_tidy.optics.lens.json_lenses import read_json_lens
from kornia_tidy.optics.lens.prescription import Prescription, half_diagonal
from kornia_tidy.optics.lens.zemax_file import read_zemax

SUFFIXES = (".zmx", ".seq", ".json")
LONGEST = 4 << 20  # bytes of a file; those of lenses have some ten thousand


def read_prescription_file(path: str | os.PathLike[str]) -> tuple[Prescription, float | None]:
    """Return the prescription in a file, and its largest height on the sensor in metres if it says one.

    Args:
        path: of a Zemax file (``.zmx``), a CODE V file (``.seq``), or a ``.json`` by Optiland or DeepLens or with the
            keys of :meth:`Prescription.read`.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if it is of another kind, damaged, or holds unsupported things; the path is named.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"a prescription must be a file {', '.join(SUFFIXES)}, got {path}")
    data = read_bytes(path)
    with error_prefix(f"cannot read {path}", TypeError):
        if len(data) > LONGEST:
            raise ValueError(f"it must have at most {LONGEST} bytes, got {len(data)}")
        text = _text(data)
        if suffix == ".json":
            value = parse_json(text)
            lens = read_json_lens(value)
            found, height = (Prescription.read(value), half_diagonal(value)) if lens is None else lens_of(lens)
        else:
            found, height = lens_of(read_zemax(text) if suffix == ".zmx" else read_codev(text))
        return replace(found, name=found.name or Path(path).stem), height


def _text(data: bytes) -> str:
    """Return a text in UTF-16 with or without its mark, UTF-8, or else in 8 bits with a sign for each byte."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        encodings = ["utf-16"]
    elif data[1:200:2].count(0) > 50:
        encodings = ["utf-16-le"]
    else:
        encodings = ["utf-8-sig", "latin-1"]
    for encoding in encodings:
        try:
            return data.decode(encoding)
        except UnicodeDecodeError:
            continue
    raise ValueError(f"it is no text in {encodings[0]}")
