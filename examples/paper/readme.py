"""Assembly of ``examples/paper/README.md``: the claims of the paper with verdicts, and the tables that were measured.

    python -m examples.paper.readme

The section of an experiment is that of the largest scale in ``results/``. Claims and verdicts are in ``claims.md``.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from examples.paper.runner import HERE, RESULTS, SCALES
from kornia_tidy.files import write_bytes

EXPERIMENTS = {
    "theorem": "1. Non-convexity, and the reach of averages",
    "point_psf": "2. All in focus without a network",
    "sequence_length": "3. The number of masks",
    "initialisation": "4. The first masks for depth",
    "state_of_the_art": "5. Other systems",
    "transfer": "6. Transfer to real scenes",
    "switching_time": "7. Switching time",
    "switching_training": "7b. Training with switching",
    "discretisation": "8. The paper's discretisation",
    "boundaries": "9. Boundaries of depth",
    "boundaries_training": "9b. Training with occlusion",
    "burst": "10. Burst against average, and motion",
}
"""Titles by module, in the order of the paper's text."""

INTRODUCTION = """\
# The paper's experiments

Tables and figures of TiDy-PSFs (Shah, Kulshrestha and Metzler, ICCV 2023), each as one command, on the data a person
has and at the scale that their machine allows: `smoke` takes seconds, `cpu` minutes, `gpu` an hour or more on a GPU,
`paper` the paper's own extent. A run goes on where it stopped. `python -m examples.paper.readme` assembles this page.

The same machine, seed and number of threads give the same digits. Run again from a fresh clone on the machine named
below, with one thread, these tables came out alike to the last printed digit: `smoke` of all twelve, twice; `cpu` of
experiments 1 and 4, and five trainings of experiment 3; and 150 starts of experiment 2, fifty each of one, two and five
masks.
"""


def main(arguments: Sequence[str] | None = None) -> str:
    """Assemble the page and return its text."""
    parser = argparse.ArgumentParser(
        prog="python -m examples.paper.readme",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.parse_args(arguments)
    text = page()
    write_bytes(HERE / "README.md", text.encode())
    return text


def page() -> str:
    """Return the text of the page."""
    claims = HERE / "claims.md"
    parts = [INTRODUCTION, claims.read_text(encoding="utf-8")] if claims.exists() else [INTRODUCTION]
    return "\n".join([*parts, *(section(name) for name in EXPERIMENTS)]).rstrip() + "\n"


def section(name: str) -> str:
    """Return the section of an experiment: the largest scale that was run, or that none was."""
    for scale in reversed(SCALES):
        path = RESULTS / f"{name}-{scale}.md"
        if path.exists():
            return path.read_text(encoding="utf-8")
    built = (HERE / f"{name}.py").exists()
    told = f"Not run: `python -m examples.paper.{name} --scale cpu`." if built else "Not built yet."
    return f"## {EXPERIMENTS[name]}\n\n{told}\n"


if __name__ == "__main__":
    sys.exit(not main())
