"""Image and distribution of depth by one network that refines the closed forms of both."""

from __future__ import annotations

import pytest
import torch
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from torch.nn import functional

from kornia_tidy import PSFBank
from kornia_tidy.reconstruction import (
    ClosedFormHead,
    JointClosedFormHead,
    JointHead,
    NAFNet,
    closed_form_channels,
)
from kornia_tidy.reconstruction.bilateral import bilateral_filter
from kornia_tidy.reconstruction.closed_form import (
    BLEND_WEIGHT,
    COLOR,
    LEAST,
    LIKELIHOOD_WINDOW,
    SHARPNESS,
    SPACE,
    WINDOW,
    ClosedForm,
)
from kornia_tidy.reconstruction.depth_distribution import layer_weights
from kornia_tidy.reconstruction.depth_likelihood import depth_likelihood, likelihood_filters
from kornia_tidy.reconstruction.guided_classes import smoothed_classes
from kornia_tidy.reconstruction.heads import PlainHead
from kornia_tidy.reconstruction.joint_closed_form import as_refiner, widened_for_depth
from kornia_tidy.reconstruction.kernel_convolution import convolve_kernels
from kornia_tidy.reconstruction.tikhonov_kernels import tikhonov_kernels
from tests.base import BaseTester
from tests.reconstruction.onnx_export import check_onnx
from tests.reconstruction.test_closed_form import bank, photo

LAYERS, CLASSES = 4, 7


def joint(psfs=None, layers=LAYERS, dtype=torch.float32, *, trained=False, kind=NAFNet, refined=False, **options):
    torch.manual_seed(0)
    network = kind(closed_form_channels(layers, likelihood=True), CLASSES + 3, width=2)
    refiner = kind(closed_form_channels(layers), 3, width=2) if refined else None
    head = JointClosedFormHead(network, layers, refiner, **options).eval().to(dtype)
    head.closed_form.set_psfs(bank(layers, dtype=dtype) if psfs is None else psfs)
    if trained:
        generator = torch.Generator().manual_seed(1)
        for parameter in head.parameters():
            if not parameter.any():
                torch.nn.init.normal_(parameter, std=0.02, generator=generator)
    return head


def image_head(kind, layers):
    """Return a network for the image with weights other than zero."""
    head = ClosedFormHead(kind(closed_form_channels(layers), 3, width=2), layers).eval()
    for parameter in head.parameters():
        torch.nn.init.normal_(parameter, std=0.1, generator=torch.Generator().manual_seed(2))
    return head


def initial_logits(head, capture, noise):
    """The logits of the classes by only the likelihood in closed form."""
    return head._initial_logits(head.closed_form(capture, noise).maps)


def blended(head, capture, noise):
    """Return the deconvolved depths blended by the likelihood of the classes in closed form, and smoothed."""
    layers = head.closed_form(capture, noise).layers
    shares = layer_weights(initial_logits(head, capture, noise), LAYERS)
    return head.closed_form.blend(layers, shares, torch.full_like(capture, noise))


class TestJointClosedFormHead(BaseTester):
    @pytest.mark.parametrize("refined", [False, True])
    def test_smoke_begins_as_the_closed_forms(self, refined):
        head, capture = joint(refined=refined), photo(20, 33, dtype=torch.float32)
        with torch.no_grad():
            output = head(capture, 0.01)
            padded = functional.pad(capture, (7, 8, 6, 6), "reflect")
            image, likelihood = blended(head, padded, 0.01), initial_logits(head, padded, 0.01)
        assert output.shape == (2, CLASSES + 3, 20, 33)
        assert torch.equal(output[:, -3:], image[..., 6:26, 7:40])
        assert torch.equal(output[:, :CLASSES], smoothed_classes(likelihood, image)[..., 6:26, 7:40])

    def test_feature_the_last_maps_are_the_likelihood_of_each_depth(self):
        """Of the light's brightness; every other class is one of the layers."""
        head, capture = joint(dtype=torch.float64), photo(32, 48)
        light = rgb_to_linear_rgb(capture).mean(1, keepdim=True)
        fits = depth_likelihood(light, *likelihood_filters(bank(LAYERS).psfs.mean(1)))
        expected = (fits / SHARPNESS).clamp(min=LEAST)
        self.assert_close(head.closed_form(capture).maps[:, -LAYERS:], 1 - expected / LEAST)
        self.assert_close(head.train()(capture)[:, :CLASSES:2], expected)

    def test_feature_blends_the_depths_by_their_likelihood(self):
        """Each is a deconvolution with its own PSF; the noisier the capture, the wider the likelihood."""
        restore, capture = ClosedForm(LAYERS, bilateral=False, likelihood=True), photo(32, 48)
        restore.set_psfs(bank(LAYERS))
        light = rgb_to_linear_rgb(capture)
        fits = depth_likelihood(light.mean(1, keepdim=True), *likelihood_filters(bank(LAYERS).psfs.mean(1)))
        kernels = torch.cat([tikhonov_kernels(psf, (BLEND_WEIGHT,)) for psf in bank(LAYERS).psfs])
        single = convolve_kernels(light, kernels)
        for noise, temperature in ((1e-4, 0.5), (2e-3, 0.5), (2e-2, 5.0)):
            blended = ((fits / temperature).softmax(1).unsqueeze(2) * single).sum(1)
            expected = linear_rgb_to_rgb(blended.clamp(0, 1))
            self.assert_close(restore(capture, noise).image, expected, atol=1e-9, rtol=0)

    def test_feature_the_image_is_deconvolved_for_the_depth_that_the_network_finds(self):
        """Sure of one depth, it is that depth's deconvolution, smoothed."""
        head, capture = joint(dtype=torch.float64), photo(32, 48)
        with torch.no_grad():
            head.network.last.bias[2] = 1e4  # class 2 of 7 is the second of four layers
            image = head(capture, 0.002)[:, -3:]
            kernels = tikhonov_kernels(bank(LAYERS).psfs[1], (BLEND_WEIGHT,))
            single = convolve_kernels(rgb_to_linear_rgb(capture), kernels)
            expected = bilateral_filter(linear_rgb_to_rgb(single[:, 0].clamp(0, 1)), COLOR, WINDOW, SPACE)
        self.assert_close(image, expected, atol=1e-9, rtol=0)

    def test_feature_the_refiner_sees_the_image_in_place_of_the_restored_one(self):
        """It adds to the image of the head without it, and leaves depth before the averages as it is."""
        head, capture = joint(trained=True, refined=True).train(), photo(16, 16, dtype=torch.float32)
        seen = []
        head.refiner.register_forward_hook(lambda _, inputs, output: seen.append((*inputs, output)))
        with torch.no_grad():
            found = head(capture, 0.01)
            refiner, head.refiner = head.refiner, None
            image, restored = head(capture, 0.01), head.closed_form(capture, 0.01)
        maps, added = seen[0]
        assert torch.equal(found[:, :CLASSES], image[:, :CLASSES])
        assert torch.equal(found[:, CLASSES:], image[:, CLASSES:] + added)
        assert torch.equal(maps[:, 15:18], image[:, CLASSES:])
        assert torch.equal(maps[:, :15], restored.maps[:, :15])
        assert torch.equal(maps[:, 18:], restored.maps[:, 18 : refiner.in_channels])
        assert added.any()

    @pytest.mark.parametrize("refined", [False, True])
    def test_feature_no_gradient_of_the_image_reaches_the_depth(self, refined):
        head = joint(trained=True, refined=refined).train()
        logits = head.network.last.bias
        head(photo(16, 16, dtype=torch.float32), 0.01)[:, -3:].square().sum().backward()
        assert not logits.grad[:CLASSES].any()
        assert logits.grad[CLASSES:].all()

    def test_feature_the_likelihood_takes_the_middle_of_wide_psfs(self):
        side = LIKELIHOOD_WINDOW
        narrow = torch.rand(2, 3, side, side)
        wide = functional.pad(narrow, (4, 4, 4, 4))
        restore = ClosedForm(2, likelihood=True)
        for psfs in (narrow, wide):
            restore.set_psfs(PSFBank.from_measured(psfs, torch.arange(2.0)))
            assert restore.whitening.shape[-1] == 3 * side
        expected, _ = likelihood_filters(restore.psfs[..., 4:-4, 4:-4].mean(1))
        self.assert_close(restore.whitening, expected)

    def test_feature_temperature_widens_the_distribution_and_leaves_the_image(self):
        head, capture = joint(trained=True), photo(16, 16, dtype=torch.float32)
        with torch.no_grad():
            before = head(capture)
            head.temperature.fill_(2.0)
            after, in_training = head(capture), head.train()(capture)
        self.assert_close(after[:, :CLASSES], before[:, :CLASSES] / 2)
        assert torch.equal(after[:, CLASSES:], before[:, CLASSES:])
        assert torch.equal(in_training[:, CLASSES:], before[:, CLASSES:])
        self.assert_close(smoothed_classes(*in_training.split([CLASSES, 3], 1)), before[:, :CLASSES])
        assert "temperature" in head.state_dict()

    @pytest.mark.slow
    def test_feature_onnx(self):
        capture = photo(18, 21, dtype=torch.float32)
        head = JointHead(joint(layers=2, trained=True, kind=PlainHead, refined=True))
        assert len(check_onnx(head, capture, capture.flip(-1))) == 3

    @pytest.mark.parametrize("kind", [NAFNet, PlainHead])
    @pytest.mark.parametrize("layers", [0, LAYERS])
    def test_feature_begins_as_a_network_for_the_image(self, kind, layers):
        """With as many depths it sees the same in its first convolution; image and depth are the closed forms'."""
        image = image_head(kind, layers)
        head, capture = joint(kind=kind, refined=True), photo(16, 16, dtype=torch.float32)
        head.load_state_dict(widened_for_depth(image.state_dict(), head))
        (_, begun), (_, trained) = (
            next(iter(head.network.named_parameters())),
            next(iter(image.network.named_parameters())),
        )
        self.assert_close(begun[:, : trained.shape[1]], trained)
        assert not begun[:, trained.shape[1] :].any()
        with torch.no_grad():
            self.assert_close(head(capture, 0.01)[:, -3:], blended(head, capture, 0.01))
            self.assert_close(head.train()(capture, 0.01)[:, :CLASSES], initial_logits(head, capture, 0.01))

    @pytest.mark.parametrize("kind", [NAFNet, PlainHead])
    @pytest.mark.parametrize("layers", [0, LAYERS])
    def test_feature_the_refiner_begins_as_a_network_for_the_image(self, kind, layers):
        image = image_head(kind, layers)
        head = joint(kind=kind, refined=True)
        head.load_state_dict(head.state_dict() | as_refiner(image.state_dict(), head))
        maps = torch.rand(1, closed_form_channels(LAYERS), 16, 16)
        with torch.no_grad():
            self.assert_close(head.refiner(maps), image.network(maps[:, : closed_form_channels(layers)]))

    def test_exception(self):
        with pytest.raises(ValueError, match="number of classes of network must be a whole number of at least 2"):
            JointClosedFormHead(NAFNet(closed_form_channels(2, likelihood=True), 4, width=2), 2)
        with pytest.raises(ValueError, match="layers must be a whole number of at least 2, got 1"):
            JointClosedFormHead(NAFNet(21, 8, width=2), 1)
        with pytest.raises(ValueError, match="the network must take 23 channels, got in_channels=3"):
            JointClosedFormHead(NAFNet(3, 8, width=2), 2)
        network = NAFNet(closed_form_channels(2, likelihood=True), 8, width=2)
        with pytest.raises(ValueError, match="refiner must have 21 input and 3 output channels, got 3 and 3"):
            JointClosedFormHead(network, 2, NAFNet(3, 3, width=2))
