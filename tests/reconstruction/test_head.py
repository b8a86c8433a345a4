"""What all heads share, on one that estimates the image itself, and the contract of every head."""

from __future__ import annotations

import copy
import functools

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from kornia_tidy.reconstruction import AttentionUNet, MiDaSSmall, NAFNet, PhaseCam3DUNet, ReconstructionHead
from tests.base import BaseTester

HEADS = {
    "attention": lambda: AttentionUNet(width=2),
    "midas": MiDaSSmall,
    "nafnet": lambda: NAFNet(width=2),
    "phasecam3d": lambda: PhaseCam3DUNet(width=2),
}
every_head = pytest.mark.parametrize("name", HEADS)


class SeeingHead(ReconstructionHead):
    """Returns its input and keeps what it was shown."""

    stride = 8

    def predict(self, image):
        self.seen = image
        return image


@functools.cache
def drawn(name):
    return HEADS[name]()


def fresh(name):
    """A head as it starts."""
    return copy.deepcopy(drawn(name))


def trained(name):
    """A head whose layers all matter: the last one starts small, and statistics start as the identity."""
    head = fresh(name)
    generator = torch.Generator().manual_seed(1)
    for module in head.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.running_mean.normal_(0, 0.1, generator=generator)
            module.running_var.uniform_(0.5, 2.0, generator=generator)
    if name == "nafnet":  # its blocks start as the identity
        for label, parameter in head.named_parameters():
            if label.endswith(("beta", "gamma")):
                torch.nn.init.normal_(parameter, std=0.1, generator=generator)
    if name == "midas":
        torch.nn.init.normal_(head.scratch.output_conv[4].weight, std=0.2, generator=generator)
    return head.eval()


class TestReconstructionHead(BaseTester):
    @settings(max_examples=60)
    @given(st.integers(1, 40), st.integers(1, 40))
    def test_property_any_size_comes_back_pixel_for_pixel(self, height, width):
        head, image = SeeingHead(2, 2), torch.rand(1, 2, height, width)
        assert torch.equal(head(image), image)
        assert head.seen.shape[-2:] == (-(-height // 8) * 8, -(-width // 8) * 8)

    @pytest.mark.parametrize(
        ("size", "mode", "margins"),
        [
            ((13, 22), "reflect", [(1, 2), (1, 1)]),
            ((5, 16), "reflect", [(1, 2), (0, 0)]),
            ((4, 21), "reflect", [(2, 2), (1, 2)]),
            ((3, 21), "edge", [(2, 3), (1, 2)]),
            ((1, 1), "edge", [(3, 4), (3, 4)]),
        ],
    )
    def test_feature_borders_are_those_of_numpy(self, size, mode, margins, device, dtype):
        head, image = SeeingHead(3, 3), torch.rand(2, 3, *size, device=device, dtype=dtype)
        head(image)
        expected = np.pad(image.cpu().numpy(), [(0, 0), (0, 0), *margins], mode=mode)
        assert np.array_equal(head.seen.cpu().numpy(), expected)

    def test_feature_a_multiple_of_the_stride_is_not_copied(self, device, dtype):
        head, image = SeeingHead(3, 3), torch.rand(2, 3, 16, 24, device=device, dtype=dtype)
        assert head(image).data_ptr() == image.data_ptr()

    def test_exception_names_what_is_wrong_with_the_image(self):
        head = SeeingHead(3, 3)
        with pytest.raises(ValueError, match="image must have 3 channels, got 4"):
            head(torch.rand(1, 4, 8, 8))
        with pytest.raises(ValueError, match=r"image must have shape \(B, C, H, W\), got \(3, 8, 8\)"):
            head(torch.rand(3, 8, 8))
        with pytest.raises(TypeError, match=r"image must be floating point .* got torch.uint8"):
            head(torch.zeros(1, 3, 8, 8, dtype=torch.uint8))

    @pytest.mark.parametrize("value", [0, -1, 2.0, "3"])
    def test_exception_names_the_number_of_channels(self, value):
        with pytest.raises(ValueError, match=f"in_channels must be a whole number of at least 1, got {value!r}"):
            SeeingHead(value, 1)
        with pytest.raises(ValueError, match=f"out_channels must be a whole number of at least 1, got {value!r}"):
            SeeingHead(1, value)


class TestEveryHead(BaseTester):
    @every_head
    def test_cardinality(self, name, device):
        head = fresh(name).to(device).eval()
        for size in [(32, 64), (33, 31), (1, 50), (17, 3), (1, 1)]:
            with torch.no_grad():
                assert head(torch.rand(2, 3, *size, device=device)).shape == (2, head.out_channels, *size)

    @every_head
    def test_feature_images_of_a_batch_do_not_mix_when_predicting(self, name, device):
        head, images = trained(name).to(device), torch.rand(3, 3, 32, 32, device=device)
        with torch.no_grad():
            self.assert_close(head(images)[1:2], head(images[1:2]), atol=1e-4)

    @pytest.mark.parametrize("name", ["attention", "phasecam3d"])
    def test_feature_a_shift_by_the_stride_is_a_shift(self, name, device):
        """Where the borders, which are padded with zeros inside, are out of sight. MiDaS interpolates across all."""
        head = fresh(name).to(device).double().eval()
        image = torch.zeros(2, 3, 256, 256, device=device, dtype=torch.float64)
        image[0, :, 100:104, 100:104] = 1
        image[1] = image[0].roll((16, 16), (1, 2))
        with torch.no_grad():
            out = head(image)
        middle = slice(96, 144)
        assert out[0, :, middle, middle].std() > 1e-3
        self.assert_close(out[1].roll((-16, -16), (1, 2))[:, middle, middle], out[0][:, middle, middle], atol=1e-9)

    @every_head
    def test_feature_every_parameter_that_may_learn_gets_a_gradient(self, name, device):
        head = fresh(name).to(device)
        torch.manual_seed(1)
        for parameter in head.parameters():  # zero residual units hide what is before them
            if not parameter.any():
                torch.nn.init.normal_(parameter, std=0.1)
        head(torch.rand(2, 3, 64, 64, device=device)).square().mean().backward()
        for label, parameter in head.named_parameters():
            assert parameter.requires_grad == (parameter.grad is not None), label
        silent = [label for label, p in head.named_parameters() if p.requires_grad and not p.grad.any()]
        assert not silent

    @every_head
    def test_feature_a_reset_draws_anew_and_follows_the_seed(self, name, device):
        head = fresh(name).to(device)
        first = {key: value.clone() for key, value in head.state_dict().items()}
        head(torch.rand(2, 3, 32, 64, device=device))  # statistics move
        torch.manual_seed(3)
        head.reset_parameters()
        again = {key: value.clone() for key, value in head.state_dict().items()}
        random = {key for key in first if first[key].ndim == 4 and first[key].any()}
        assert {key for key in first if torch.equal(first[key], again[key])} == set(first) - random
        torch.manual_seed(3)
        head.reset_parameters()
        assert all(torch.equal(value, again[key]) for key, value in head.state_dict().items())

    @every_head
    def test_feature_weights_start_with_the_spread_that_keeps_the_variance(self, name):
        """He: 2 / fan_in; 1 / fan_in in MiDaS' decoder, which nothing normalises. Of the larger weights, to 10 %."""
        for label, weight in fresh(name).named_parameters():
            if weight.ndim == 4 and weight.numel() > 2000 and weight.any():
                gain = 1 if label.startswith("scratch") else 2
                expected = (gain / weight[0].numel()) ** 0.5
                assert abs(weight.std().item() / expected - 1) < 0.1, label

    @pytest.mark.takes_seconds
    @every_head
    def test_feature_half_precision_autocast_is_near(self, name, device):
        head, image = trained(name).to(device), torch.rand(2, 3, 64, 64, device=device)
        expected = head(image)
        with torch.autocast(device.type, dtype=torch.bfloat16):
            out = head(image)
        out.float().square().mean().backward()
        assert all(p.grad.isfinite().all() for p in head.parameters() if p.requires_grad)
        assert (out.float() - expected).square().mean() < 1e-2 * expected.var()
