"""NAFNet: its size, its block written out, and how far it sees. What all heads share is in test_head.py."""

from __future__ import annotations

import pytest
import torch
from torch import nn
from torch.nn import functional

from kornia_tidy.reconstruction import NAFNet
from kornia_tidy.reconstruction.nafnet import deepened
from tests.base import BaseTester
from tests.reconstruction.test_head import trained


class TestNAFNet(BaseTester):
    def test_feature_has_1_7_million_parameters(self):
        """Counted by hand: a block of c channels has 6 c^2 + 32 c, with attention c^2 + c more."""
        blocks = {16: 2, 32: 2, 64: 2, 128: 3, 256: 2}
        count = sum(n * (6 * c * c + 32 * c) for c, n in blocks.items()) + 2 * (256**2 + 256)
        count += sum(8 * c * c + 2 * c + 8 * c * c for c in (16, 32, 64, 128))  # down and up
        count += 9 * 3 * 16 + 16 + 9 * 16 * 3 + 3
        assert sum(p.numel() for p in NAFNet(width=16).parameters()) == count

    def test_feature_a_block_is_the_formula(self):
        block = trained("nafnet").double().middle[0]
        x = torch.randn(1, 32, 5, 6, dtype=torch.float64)

        def normalised(value, norm):
            value = (value - value.mean(1, keepdim=True)) / (value.var(1, keepdim=True, correction=0) + 1e-5).sqrt()
            return value * norm.weight[:, None, None] + norm.bias[:, None, None]

        def linear(value, layer):
            return torch.einsum("oi,bihw->bohw", layer.weight[..., 0, 0], value) + layer.bias[:, None, None]

        u = functional.pad(linear(normalised(x, block.norm1), block.expand1), (1, 1, 1, 1))
        taps = block.depthwise.weight[:, 0]
        u = sum(taps[:, v, w, None, None] * u[..., v : v + 5, w : w + 6] for v in range(3) for w in range(3))
        u = u + block.depthwise.bias[:, None, None]
        u = u[:, :32] * u[:, 32:]
        inside = functional.pad(torch.ones(1, 1, 5, 6, dtype=torch.float64), (1, 1, 1, 1))
        around = functional.pad(u, (1, 1, 1, 1))
        total, count = (sum(p[..., v : v + 5, w : w + 6] for v in range(3) for w in range(3)) for p in (around, inside))
        u = u * linear(total / count, block.attention)
        y = x + block.beta * linear(u, block.project1)
        u = linear(normalised(y, block.norm2), block.expand2)
        expected = y + block.gamma * linear(u[:, :32] * u[:, 32:], block.project2)
        self.assert_close(block(x), expected)

    @pytest.mark.parametrize("height", [144, 528])  # of which strips of 16, 8 and 2 rows are left
    def test_feature_strips_without_gradients_are_the_whole(self, height):
        head, image = NAFNet(width=4, repeats=3).double(), torch.rand(2, 3, height, 16, dtype=torch.float64)
        for parameter in head.parameters():
            nn.init.normal_(parameter, std=0.3)  # blocks start as the identity
        with torch.no_grad():
            found = head(image)
        self.assert_close(found, head(image), atol=1e-12, rtol=0)

    def test_feature_repeats_blocks_of_each_level_but_the_coarsest(self):
        once, twice = (NAFNet(width=4, repeats=repeats) for repeats in (1, 2))
        for part in ("encoder", "decoder"):
            counts = [[len(blocks) for blocks in getattr(network, part)] for network in (once, twice)]
            assert counts[1] == [2 * count for count in counts[0]]
        assert len(once.middle) == len(twice.middle)

    @pytest.mark.parametrize("repeats", [1, 3])
    def test_feature_a_deeper_network_begins_as_the_one_it_is_made_from(self, repeats):
        """Also if its own new blocks are no longer the identity; those that it has in common are taken."""
        small, large = (NAFNet(width=4, repeats=count).eval() for count in (1, repeats))
        for network in (small, large):
            for parameter in network.parameters():
                nn.init.normal_(parameter, std=0.2)
        large.load_state_dict(deepened(small.state_dict(), large))
        image = torch.rand(1, 3, 32, 48)
        with torch.no_grad():
            assert torch.equal(large(image), small(image))

    def test_exception_repeats(self):
        with pytest.raises(ValueError, match="repeats must be a whole number of at least 1, got 0"):
            NAFNet(width=4, repeats=0)
