"""One row of the table of extremes, and how it is measured."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from kornia_tidy import TiDyOptics

HELD, REFUSED = "exact", "refused"


@dataclass(frozen=True)
class Row:
    """A quantity, the values that are tried, and what must come out.

    Args:
        group: heading under which the row stands.
        quantity: what is varied, with its unit.
        tried: the values, in words.
        measure: returns the largest error over all of them, or raises.
        bound: largest error allowed. None: every value is refused by a sentence, which ``measure`` returns.
        against: what the error is measured against, and in which unit.
        note: what happens there, in words.
        slow: over about half a second; left out of the test suite.
        absent: why the row cannot be measured on this machine; empty if it can.
    """

    group: str
    quantity: str
    tried: str
    measure: Callable[[], float | str]
    bound: float | None
    against: str = ""
    note: str = ""
    slow: bool = False
    absent: str = ""

    @property
    def name(self) -> str:
        """Name of the row, unique in the table."""
        return f"{self.quantity}: {self.tried}"


def refusals(*attempts: Callable[[], object]) -> Callable[[], str]:
    """Return a measurement that passes if each attempt raises ``ValueError`` or ``TypeError`` with one sentence.

    It returns the first sentence.
    """

    def measure() -> str:
        sentences = []
        for number, attempt in enumerate(attempts):
            try:
                attempt()
            except (ValueError, TypeError) as error:
                sentences.append(str(error))
            else:
                raise AssertionError(f"attempt {number} was not refused")
        assert all(sentence and "\n" not in sentence for sentence in sentences)
        return sentences[0]

    return measure


def worst(errors: Iterable[float]) -> float:
    """Return the largest error; NaN if any is NaN, which no bound admits."""
    values = torch.tensor(list(errors), dtype=torch.float64)
    return float(values.max()) if not values.isnan().any() else float("nan")


def difference(found: Tensor, expected: Tensor) -> float:
    """Return the largest absolute difference; NaN if anything is NaN or infinite."""
    gap = (found.double() - expected.double()).abs()
    return float(gap.max()) if gap.numel() else 0.0


def rounding(optics: TiDyOptics, image: Tensor, depth: Tensor) -> float:
    """Return the largest difference of a capture computed in float32 from the same one computed in float64.

    The difference is divided by the largest value of the image if that is above 1, so that full scale is 1.
    """
    with torch.no_grad():
        single = optics(image.float(), depth.float())
        double = optics(image.float().double(), depth.float().double())
    return difference(single, double) / max(1.0, float(image.abs().max()) if image.numel() else 1.0)


def scene(height: int = 40, width: int = 44, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Return an image of random values (1, 3, H, W) and depths from 0.3 m to infinity with sharp edges."""
    generator = torch.Generator().manual_seed(seed)
    image = torch.rand(1, 3, height, width, generator=generator, dtype=torch.float64)
    nearness = 3.3 * torch.rand(1, 1, height, width, generator=generator, dtype=torch.float64)
    nearness[..., : width // 3] = 0.0  # infinity
    nearness[..., height // 2 :, : width // 4] = 3.3
    return image, nearness.reciprocal()
