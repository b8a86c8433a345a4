"""Run one example for the gallery, and draw the result of its main() unless it draws itself."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any


def main(script: str, arguments: list[str]) -> None:
    """Run a script in the current folder, and draw its result unless it draws itself."""
    sys.path.insert(0, str(Path(script).parent))
    returned = importlib.import_module(Path(script).stem).main(arguments)
    if not any(Path().rglob("*.png")):
        draw(returned)


def draw(returned: Any) -> None:
    """Draw the losses of a training as a curve, or the pictures of a batch beside each other."""
    if not isinstance(returned, list):
        return
    if all(isinstance(value, float) for value in returned):
        from matplotlib.figure import Figure  # noqa: PLC0415

        figure = Figure(figsize=(6, 3.4), layout="constrained")
        axes = figure.subplots()
        axes.plot(returned, linewidth=1)
        axes.set(xlabel="step", ylabel="loss", yscale="log")
        figure.savefig("loss.png", dpi=120)
        return
    from torch import Tensor, cat  # noqa: PLC0415

    from kornia_tidy.data import write_image  # noqa: PLC0415

    if isinstance(returned[0], Tensor):
        write_image("captures.png", cat(list(returned[0]), dim=-1))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
