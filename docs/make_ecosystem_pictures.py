"""Draw the pictures of docs/ecosystems/: each page's own code is run on a painted scene, before and after side by side.

    python docs/make_ecosystem_pictures.py            # all pages
    python docs/make_ecosystem_pictures.py opencv     # one of them

Needs the package that a page is about. A page names its pictures `before` and `after`.
"""

from __future__ import annotations

import argparse
import contextlib
import re
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from kornia_tidy.cli import main as kornia_tidy

DOCS = Path(__file__).resolve().parent
BLOCK = re.compile(r"^```(python|bash)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
GAP = 8  # pixels between the two


def main(arguments: Sequence[str] | None = None) -> list[Path]:
    """Draw the pictures and return where they were written."""
    pages = sorted(path.stem for path in (DOCS / "ecosystems").glob("*.md"))
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pages", nargs="*", default=pages, metavar="PAGE", help=f"one of {', '.join(pages)}")
    parser.add_argument("--output", type=Path, default=DOCS / "images" / "ecosystems", help="folder to write to")
    options = parser.parse_args(arguments)
    options.output.mkdir(parents=True, exist_ok=True)
    written = []
    for page in options.pages:
        before, after = run(DOCS / "ecosystems" / f"{page}.md")
        both = np.hstack([before, np.full((len(before), GAP, 3), 255, np.uint8), after])
        path = options.output.resolve() / f"{page}.jpg"
        cv2.imwrite(str(path), both[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])
        print(path)  # noqa: T201
        written.append(path)
    return written


def run(page: Path) -> tuple[np.ndarray, np.ndarray]:
    """Run the blocks of a page in an empty folder, and return its pictures as arrays (H, W, 3)."""
    names: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        torch.manual_seed(0)
        for language, text in BLOCK.findall(page.read_text(encoding="utf-8")):
            if language == "python":
                exec(compile(text, str(page), "exec"), names)  # noqa: S102 (a page of this repository)
            else:
                kornia_tidy(text.split()[1:])
            if {"before", "after"} <= names.keys():
                break
        return as_array(names["before"]), as_array(names["after"])


def as_array(picture: Any) -> np.ndarray:
    """Return a tensor (3, H, W), an array (H, W, 3) or a PIL image as 8-bit RGB."""
    if isinstance(picture, torch.Tensor):
        picture = (picture.clamp(0, 1) * 255).round().to(torch.uint8).permute(1, 2, 0).numpy()
    return np.asarray(picture)


if __name__ == "__main__":
    main()
