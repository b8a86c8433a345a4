"""The gallery: each script of examples/ with its output and pictures, made when the site is built.

Results are kept in outputs/gallery, and made again when the script or the values below change.
"""

from __future__ import annotations

import ast
import hashlib
import os
import re
import shutil
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

TITLES = {
    "simulate_photo": "Simulate a photo",
    "plain_training_loop": "A camera in a plain training loop",
    "dataloader_transform": "A camera in a data loader",
    "lightning_training": "Train with Lightning",
    "train_on_rendered": "Train on captures made once",
    "ray_rendering": "Photograph a data set with Ray",
    "learn_point_psf": "Masks with a sharp PSF at all depths",
    "design_masks": "Masks designed without images",
    "mask_families": "Which mask family learns how fast",
    "nonconvex_psfs": "Averages that no single mask makes",
    "learn_with_switching": "Masks for a slow modulator",
    "time_average_or_burst": "One exposure or a burst",
    "motion_blur": "The direction of motion",
    "four_lenses": "One scene behind four lenses",
}
# Smaller than the defaults where these take minutes: each page shows the command that made it.
ARGUMENTS = {
    "plain_training_loop": "--steps 60",
    "learn_point_psf": "--masks 1 3 5 --trials 1",
    "learn_with_switching": "--trials 1 --iterations 60",
    "mask_families": "--trials 1 --iterations 60",
    "lightning_training": "--epochs 2 --scenes 16",
    "train_on_rendered": "--scenes 16 --size 96 --epochs 4 --output captures",
}
NEEDS = {"ray_rendering": "ray"}  # packages without which only the script is shown
CARD_LINES = 14  # of an example's output, in its card
DRAW = Path(__file__).with_name("run_example.py")
COMMAND = re.compile(r"^ *python examples/.*\n", re.MULTILINE)

PAGE = """# {title}

{words}
{pictures}
{result}
## The script

```{{literalinclude}} {stem}.py
:language: python
```
"""
INDEX = """# Gallery

Each script of `examples/` answers one question. Pictures and numbers are made when this site is built.

::::{{grid}} 1 2 2 3
:gutter: 3

{cards}
::::

```{{toctree}}
:hidden:

{stems}
```
"""


def write_gallery(pages: Path, results: Path, examples: list[Path], *, run: bool) -> None:
    """Write the index and the page of each example; run those with missing or stale results."""
    (pages / "images").mkdir(parents=True, exist_ok=True)
    examples.sort(key=lambda path: [*TITLES, path.stem].index(path.stem))
    for example in examples:
        if run and (example.stem not in NEEDS or find_spec(NEEDS[example.stem])):
            run_example(example, results / example.stem)
        write_page(example, results / example.stem, pages)
    cards = "\n".join(card(example, pages, results) for example in examples)
    write(pages / "index.md", INDEX.format(cards=cards, stems="\n".join(example.stem for example in examples)))


def run_example(example: Path, folder: Path) -> None:
    """Run a script in a separate folder, unless its results there are up to date; an error ends the build."""
    made_of = hashlib.sha256(ARGUMENTS.get(example.stem, "").encode() + DRAW.read_bytes())
    for script in [example, *(path for path in example.parent.glob("*.py") if f"from {path.stem} " in text(example))]:
        made_of.update(script.read_bytes())
    stamp = folder / "made_of.txt"
    if stamp.exists() and text(stamp) == made_of.hexdigest():
        return
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    print(f"examples/{example.name} {ARGUMENTS.get(example.stem, '')}", end=" ... ", flush=True)
    start = time.perf_counter()
    paths = os.pathsep.join([str(example.parents[1]), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(  # noqa: S603
        [sys.executable, str(DRAW), str(example), *ARGUMENTS.get(example.stem, "").split()],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": paths},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(f"examples/{example.name} failed:\n{done.stderr}")
    print(f"{time.perf_counter() - start:.0f} s")
    (folder / "printed.txt").write_text(done.stdout, encoding="utf-8")
    stamp.write_text(made_of.hexdigest(), encoding="utf-8")


def write_page(example: Path, folder: Path, pages: Path) -> None:
    """Write the page of an example from its docstring and from the files of a run."""
    shutil.copyfile(example, pages / example.name)
    described = ast.get_docstring(ast.parse(text(example))) or ""
    words = COMMAND.sub("", described + "\n").strip()
    commands = "".join(line.strip() + "\n" for line in COMMAND.findall(described + "\n"))
    pictures = []
    for picture in sorted(folder.rglob("*.png")):
        name = f"{example.stem}-{picture.name}"
        shutil.copyfile(picture, pages / "images" / name)
        pictures.append(f"![{picture.stem.replace('_', ' ')}](images/{name})\n")
    printed = folder / "printed.txt"
    if printed.exists():
        used = f"python examples/{example.name} {ARGUMENTS.get(example.stem, '')}".strip()
        result = f"## What it prints\n\n```bash\n{used}\n```\n```text\n{text(printed)}```\n"
    else:
        package = NEEDS.get(example.stem)
        result = (
            f"Pictures and numbers are made by `make docs`{f', where {package} is installed' if package else ''}.\n"
        )
    words += f"\n\n```bash\n{commands}```\n" if commands else "\n"
    title = TITLES.get(example.stem, example.stem.replace("_", " ").capitalize())
    page = PAGE.format(title=title, words=words, pictures="\n".join(pictures), result=result, stem=example.stem)
    write(pages / f"{example.stem}.md", page)


def card(example: Path, pages: Path, results: Path) -> str:
    """Return the card of an example in the index: its first picture, or its output."""
    described = ast.get_docstring(ast.parse(text(example))) or ""
    lead = " ".join(described.partition("\n\n")[0].split())
    pictures = sorted((pages / "images").glob(f"{example.stem}-*.png"))
    title = TITLES.get(example.stem, example.stem.replace("_", " ").capitalize())
    shown = [f":img-top: images/{pictures[0].name}", f":img-alt: {title}"] if pictures else []
    head = [f":::{{grid-item-card}} {title}", f":link: {example.stem}", ":link-type: doc", *shown]
    printed = results / example.stem / "printed.txt"
    lines = [] if shown or not printed.exists() else text(printed).splitlines()[:CARD_LINES]
    shown_instead = ["```text", *lines, "```"] if lines else []
    return "\n".join([*head, "", lead, *shown_instead, ":::", ""])


def text(path: Path) -> str:
    """Return the text of a file."""
    return path.read_text(encoding="utf-8")


def write(path: Path, content: str) -> None:
    """Write a page if its text is new, so that Sphinx reads it again only then."""
    if not path.exists() or text(path) != content:
        path.write_text(content, encoding="utf-8")
