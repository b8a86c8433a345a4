"""Every head leaves as ONNX and computes the same there."""

from __future__ import annotations

import pytest
import torch

from tests.base import BaseTester
from tests.reconstruction.onnx_export import check_onnx
from tests.reconstruction.test_head import SeeingHead, every_head, trained


class TestONNX(BaseTester):
    @pytest.mark.slow
    @every_head
    def test_feature_onnx_is_equal(self, name):
        check_onnx(trained(name), torch.rand(1, 3, 37, 50))

    def test_feature_onnx_takes_another_batch(self):
        check_onnx(SeeingHead(3, 3), torch.rand(2, 3, 13, 16), torch.rand(5, 3, 13, 16))
