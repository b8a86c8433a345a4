"""The encoder of MiDaS Small: its size, its scales and TensorFlow's padding."""

from __future__ import annotations

import pytest
import torch
from torch.nn.functional import conv2d, pad

from kornia_tidy.reconstruction.efficientnet_lite3 import EfficientNetLite3
from tests.base import BaseTester


@pytest.fixture(scope="module")
def encoder():
    return EfficientNetLite3().double().eval().requires_grad_(False)


class TestEfficientNetLite3(BaseTester):
    def test_feature_every_convolution_is_padded_as_tensorflow_does(self, encoder):
        """SAME: ceil(n / stride) outputs; of the pixels that are missing, the odd one is added at the end."""
        records = []
        convolutions = [m for m in encoder.modules() if isinstance(m, torch.nn.Conv2d) and m.kernel_size != (1, 1)]
        hooks = [m.register_forward_hook(lambda m, i, o: records.append((m, i[0], o))) for m in convolutions]
        encoder(torch.rand(1, 3, 64, 96, dtype=torch.float64))
        for hook in hooks:
            hook.remove()
        assert sorted((m.kernel_size[0], m.stride[0]) for m in convolutions).count((3, 2)) == 3
        assert len(records) == 25  # the stem, and one in each of 1 + 3 + 3 + 5 + 5 + 6 + 1 blocks
        for module, x, out in records:
            (kernel, _), (stride, _) = module.kernel_size, module.stride
            margins = []
            for n in reversed(x.shape[-2:]):
                missing = max((-(-n // stride) - 1) * stride + kernel - n, 0)
                margins += [missing // 2, missing - missing // 2]
            expected = conv2d(pad(x, margins), module.weight, stride=stride, groups=module.groups)
            self.assert_close(out, expected, rtol=1e-12, atol=1e-12)
