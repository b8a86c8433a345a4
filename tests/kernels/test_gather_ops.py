"""Gather by direct convolution as operators: values, refused arguments."""

from __future__ import annotations

import random
from typing import Any

import pytest
import torch

from kornia_tidy.augmentation.depth_blur import disc
from kornia_tidy.kernels.gather_ops import SOURCE, count_terms, gather_direct
from kornia_tidy.kernels.overlap_ops import gather_overlap, window_size
from tests.kernels import kernel_shapes
from tests.kernels.operator_tester import LayeredSceneTester, needs_compiler


def scene(dtype=torch.float64, **changes: Any) -> dict[str, Any]:
    """Arguments of ``gather_direct``: 2 images, 2 channels, 3 layers, 3x3 PSFs."""
    height, width = 5, 16 if dtype == torch.float64 else 32
    arguments = {
        "plane": torch.randn(2, 2, height + 2, width + 2, dtype=dtype),
        "psfs": torch.randn(3, 2, 3, 3, dtype=dtype),
        "layer_index": torch.randint(2, (2, height, width)),
        "layer_weight": torch.rand(2, height, width, dtype=dtype),
    }
    return {**arguments, **changes}


class TestGatherDirect(LayeredSceneTester):
    scene, operator = staticmethod(scene), staticmethod(gather_direct)
    draw = staticmethod(kernel_shapes.gather)
    source = SOURCE

    def smallest(self):
        return gather_direct(**scene())

    @needs_compiler
    def test_feature_negated_and_shared_memory(self):
        """Views whose sign torch keeps as a bit, and planes that channels and images share."""
        given = scene()
        plane = (
            torch.view_as_complex(torch.randn(2, 1, 7, 18, 2, dtype=torch.float64)).conj().imag.expand(-1, 2, -1, -1)
        )
        assert plane.is_neg()
        index = given["layer_index"][:1].expand(2, -1, -1)
        expected = gather_direct(plane.clone().contiguous(), given["psfs"], index.contiguous())
        assert torch.equal(gather_direct(plane, given["psfs"], index), expected)

    @needs_compiler
    def test_feature_flipped_psfs_as_by_windows(self):
        given = scene()
        expected = gather_overlap(**given, size=window_size(3), correlate=True)
        self.assert_close(gather_direct(**given, correlate=True), expected)

    @needs_compiler
    @pytest.mark.parametrize("radius", [0.0, 0.7, 2.0, 5.0, 11.0, 16.0])
    def test_feature_discs_take_few_terms_and_blur_as_the_definition(self, radius, dtype):
        """Beside rows and columns of blocks and tiles, with the sharp layer beside the disc's."""
        psfs = torch.stack([disc(0.0, 33), disc(radius, 33)]).to(dtype)[:, None]
        plane = torch.rand(1, 1, 35 + 32, 301 + 32, dtype=dtype)
        index, weight = torch.zeros(1, 35, 301, dtype=torch.int64), torch.rand(1, 35, 301, dtype=dtype)
        sharp, blurred = torch.nn.functional.conv2d(plane.double(), psfs.double())[0]
        expected = torch.lerp(sharp, blurred, weight[0].double())
        # A term is at most the light of 49 rows, of which a column of a disc takes two ends of several terms.
        self.assert_close(
            gather_direct(plane, psfs, index, weight)[0, 0].double(), expected, rtol=0, atol=40 * torch.finfo(dtype).eps
        )
        assert count_terms(psfs[1:]) <= max(13 * radius, 10)

    @needs_compiler
    @pytest.mark.parametrize("layer", [-(2**63), -1, 3, 2**40])
    def test_exception_pixels_in_no_layer(self, layer):
        """A depth that is not a number may give any of these."""
        given = scene()
        given["layer_index"][1, 4, 15] = layer
        with pytest.raises(IndexError, match="a pixel lies in none of the 3 layers"):
            gather_direct(**given)

    @pytest.mark.parametrize(
        ("changes", "error", "words"),
        [
            ({"layer_index": torch.zeros(2, 5, 16)}, TypeError, "layer_index must be torch.int64, got torch.float32"),
            (
                {
                    "plane": torch.zeros(2, 2, 5, 16).double(),
                    "layer_index": torch.zeros(2, 3, 14).long(),
                    "layer_weight": None,
                },
                ValueError,
                "at least 4x16 pixels, got 3x14",
            ),
            ({"layer_weight": None, "weight_gradient": True}, ValueError, "weight_gradient needs a layer_weight"),
        ],
    )
    def test_exception(self, changes, error, words):
        with pytest.raises(error, match=words):
            gather_direct(**scene(**changes))


@needs_compiler
class TestRandomScenes:
    def test_smoke_all_kinds_of_memory_are_drawn(self):
        about = {kernel_shapes.gather(random.Random(seed)).about.split(") ")[1].split(" psfs")[0] for seed in range(60)}
        assert about == {"whole", "shared by channels", "cut out", "columns first"}
