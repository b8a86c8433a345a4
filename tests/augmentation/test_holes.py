from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.ndimage import distance_transform_edt

from kornia_tidy.augmentation import fill_holes
from kornia_tidy.augmentation.holes import nearest_known
from tests.base import BaseTester


def known_pixels(height: int, width: int, share: float, seed: int = 0) -> torch.Tensor:
    known = torch.rand(2, height, width, generator=torch.Generator().manual_seed(seed)) < share
    known[:, height // 2, width // 3] = True
    return known


class TestFillHoles(BaseTester):
    def test_smoke(self, device, dtype):
        depth = torch.rand(2, 1, 9, 12, device=device, dtype=dtype) + 0.5
        valid = known_pixels(9, 12, 0.4)[:, None].to(device)
        filled = fill_holes(torch.where(valid, depth, 0), valid)
        assert filled.dtype == dtype
        assert (filled > 0).all()
        assert torch.equal(filled[valid], depth[valid])

    @pytest.mark.parametrize("shape", [(7, 5), (1, 7, 5), (2, 1, 7, 5), (2, 3, 1, 7, 5), (0, 1, 7, 5), (1, 1, 1, 1)])
    def test_cardinality(self, shape):
        valid = torch.zeros(shape, dtype=torch.bool)
        valid[..., 0] = True
        assert fill_holes(torch.ones(shape), valid).shape == shape

    @pytest.mark.parametrize(("height", "width"), [(40, 48), (37, 130), (1, 60), (65, 64)])
    @pytest.mark.parametrize("share", [0.5, 0.03, 0.0])
    def test_feature_values_come_from_the_nearest_pixel(self, height, width, share):
        """Against the exact Euclidean distance of scipy: jump flooding may be off by less than a pixel."""
        known = known_pixels(height, width, share)
        for found, mask in zip(nearest_known(known), known, strict=True):
            rows, columns = np.mgrid[:height, :width]
            distance = np.hypot(found.numpy() // width - rows, found.numpy() % width - columns)
            assert mask.flatten()[found.flatten()].all()
            assert np.abs(distance - distance_transform_edt(~mask.numpy())).max() < 1

    def test_feature_without_holes_nothing_is_copied(self):
        depth = torch.ones(1, 4, 4)
        assert fill_holes(depth, depth > 0) is depth

    def test_feature_nan_and_infinity_in_holes_do_not_spread(self):
        depth = torch.tensor([[1.0, torch.nan, torch.inf, 3.0]])
        assert torch.equal(fill_holes(depth, depth.isfinite()), torch.tensor([[1.0, 1.0, 3.0, 3.0]]))

    def test_exception_no_valid_pixel(self):
        with pytest.raises(ValueError, match="every depth map needs a valid pixel"):
            fill_holes(torch.ones(2, 1, 3, 3), torch.zeros(2, 1, 3, 3, dtype=torch.bool))

    def test_exception_shapes_and_types(self):
        with pytest.raises(ValueError, match="must have one shape"):
            fill_holes(torch.ones(1, 3, 3), torch.ones(3, 3, dtype=torch.bool))
        with pytest.raises(TypeError, match="valid must be a tensor of bool"):
            fill_holes(torch.ones(3, 3), torch.ones(3, 3))

    def test_gradcheck(self):
        valid = known_pixels(4, 5, 0.4)[:1]
        self.gradcheck(fill_holes, (torch.rand(1, 4, 5), valid))
