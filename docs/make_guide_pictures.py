"""Draw the pictures of docs/guides/: the code of each page is run, and its last picture is kept.

    python docs/make_guide_pictures.py         # all pages
    python docs/make_guide_pictures.py slm     # one of them

Each page writes its picture to `guide.png`.
"""

from __future__ import annotations

import argparse
import contextlib
import glob
import re
import shlex
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import torch

from kornia_tidy.cli import main as kornia_tidy

DOCS = Path(__file__).resolve().parent
BLOCK = re.compile(r"(<!-- slow: [^>]*-->\n)?^```(python|bash)\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def main(arguments: Sequence[str] | None = None) -> list[Path]:
    """Draw the pictures and return where they were written."""
    pages = sorted(path.stem for path in (DOCS / "guides").glob("*.md"))
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pages", nargs="*", default=pages, metavar="PAGE", help=f"one of {', '.join(pages)}")
    parser.add_argument("--output", type=Path, default=DOCS / "images" / "guides", help="folder to write to")
    options = parser.parse_args(arguments)
    options.output.mkdir(parents=True, exist_ok=True)
    return [draw(DOCS / "guides" / f"{page}.md", options.output.resolve() / f"{page}.jpg") for page in options.pages]


def draw(page: Path, path: Path) -> Path:
    """Run a page in an empty folder until it has written guide.png, and keep that as a JPEG."""
    names: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        torch.manual_seed(0)
        for slow, language, text in BLOCK.findall(page.read_text(encoding="utf-8")):
            if language == "python":
                exec(compile(text, str(page), "exec"), names)  # noqa: S102 (a page of this repository)
            elif not slow:
                for line in text.replace("\\\n", " ").splitlines():
                    words = shlex.split(line, comments=True)
                    words = [found for word in words for found in sorted(glob.glob(word)) or [word]]
                    if status := kornia_tidy(words[1:]):
                        raise RuntimeError(f"{page.name}: {line} ends with {status}")
            if Path("guide.png").exists():
                break
        cv2.imwrite(str(path), cv2.imread("guide.png"), [cv2.IMWRITE_JPEG_QUALITY, 88])
    print(path)  # noqa: T201
    return path


if __name__ == "__main__":
    main()
