from __future__ import annotations

import numpy as np
import pytest
import torch

from kornia_tidy.reconstruction.periodic import periodic_extension
from tests.base import BaseTester

SIZES = [(1, 1, 8, 9), (2, 3, 20, 19), (7, 5, 7, 12), (7, 5, 7, 5), (5, 1, 6, 4)]


def by_hand(image: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """NumPy's mirror on both sides of each axis, the one below or right faded into the one above or left."""
    for axis, count in ((0, rows - image.shape[0]), (1, columns - image.shape[1])):
        sides = [(0, 0), (0, 0)]
        sides[axis] = (count, count)
        before, _, after = np.split(np.pad(image, sides, mode="reflect"), [count, count + image.shape[axis]], axis)
        w = np.expand_dims((1 - np.cos(np.pi * np.arange(1, count + 1) / (count + 1))) / 2, 1 - axis)
        image = np.concatenate([image, (1 - w) * after + w * before], axis)
    return image


class TestPeriodicExtension(BaseTester):
    @pytest.mark.parametrize(("height", "width", "rows", "columns"), SIZES)
    def test_feature_equals_numpy(self, height, width, rows, columns, device, dtype):
        image = torch.rand(2, 3, height, width, device=device, dtype=dtype)
        out = periodic_extension(image, (rows, columns))
        expected = [by_hand(plane, rows, columns) for plane in image.double().cpu().flatten(0, 1).numpy()]
        assert (out.shape, out.dtype) == ((2, 3, rows, columns), dtype)
        self.assert_close(
            out.double().cpu().flatten(0, 1), torch.from_numpy(np.stack(expected)), *self.tolerance(dtype)
        )

    @staticmethod
    def tolerance(dtype) -> tuple[float, float]:
        return (1e-2, 1e-2) if dtype.itemsize == 2 else (1e-5, 1e-5)

    def test_gradcheck(self, device):
        self.gradcheck(lambda x: periodic_extension(x, (9, 8)), (torch.rand(1, 2, 4, 5, device=device),))
