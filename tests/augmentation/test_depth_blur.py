from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.ndimage import convolve

from kornia_tidy import NoMask, TiDyOptics
from kornia_tidy.augmentation import DepthBlur, RandomDepthBlur, depth_blur
from kornia_tidy.augmentation.depth_blur import blur_radius, disc, disc_radius
from kornia_tidy.optics import Lens
from tests.base import BaseTester
from tests.camera.pipeline_samples import scene

LENS = {"focal_length": 10e-3, "pixel_pitch": 4e-6}  # blur of a few pixels


def sampled_disc(radius: float, side: int, samples: int = 40) -> np.ndarray:
    """A disc by counting points in each pixel."""
    points = (np.arange(side * samples) + 0.5) / samples - side / 2
    inside = np.hypot(points[:, None], points) <= radius
    counts = inside.reshape(side, samples, side, samples).sum((1, 3)).astype(float)
    return counts / counts.sum()


class TestDepthBlur(BaseTester):
    @pytest.mark.parametrize("depth", [0.3, 0.9, 2.0, float("inf")])
    def test_feature_one_depth_is_a_convolution_with_its_disc(self, depth):
        """Against scipy with a disc of counted points, at the largest disc: the f-number is chosen for it."""
        image = torch.rand(1, 1, 24, 30, dtype=torch.float64)
        unit = float(blur_radius(torch.tensor(depth, dtype=torch.float64), 0.6, 1.0, **LENS))
        f_number = abs(unit) / 2.5
        options = {"max_radius": 2.5, "color_space": "linear", **LENS}
        blurred = depth_blur(image, torch.full_like(image, depth), 0.6, f_number, **options)
        expected = convolve(image[0, 0].numpy(), sampled_disc(2.5, 7), mode="nearest")
        # Points on a grid of 1/40 px: the rim, 2 pi r long, is off by less than half a spacing.
        bound = 2 * 2 * np.pi * 2.5 * 0.5 / 40 / (np.pi * 2.5**2)
        assert np.abs(blurred[0, 0].numpy() - expected).max() < bound

    def test_feature_each_pixel_has_the_disc_of_its_depth(self):
        """Against a mean by a disc of counted points for each pixel: a blend of two discs is off by 0.15 in L1."""
        image, depth = torch.rand(1, 1, 20, 23, dtype=torch.float64), scene(1, height=20, width=23)[1].double()
        blurred = depth_blur(image, depth, 0.6, 0.7, max_radius=5.0, color_space="linear", **LENS)[0, 0]
        radius = blur_radius(depth, 0.6, 0.7, **LENS)[0, 0].abs().clamp(max=5.0)
        assert radius.min() < 1
        assert radius.max() > 4
        around = np.pad(image[0, 0].numpy(), 5, mode="edge")
        for y in range(20):
            for x in range(23):
                expected = (around[y : y + 11, x : x + 11] * sampled_disc(max(float(radius[y, x]), 0.1), 11)).sum()
                assert abs(float(blurred[y, x]) - expected) < 0.5 * 0.15 + 0.005

    def test_feature_blends_of_discs_are_within_their_bound(self):
        for number in range(15):
            first, middle, last = (disc_radius(number + part, 16.0) for part in (0, 0.5, 1))
            blend = (disc(first, 33) + disc(last, 33)) / 2
            assert np.abs(blend.numpy() - sampled_disc(middle, 33)).sum() < 0.16

    def test_feature_a_limit_below_half_a_pixel_is_sharp(self):
        image, depth = scene(1)
        self.assert_close(depth_blur(image, depth, 0.6, 2.0, max_radius=0.4, **LENS), image, atol=1e-5)

    def test_feature_radius_of_a_thin_lens(self):
        """50 mm at f/2, focused at 1 m: s' = 52.63 mm, so that infinity has a disc of 25 mm * 52.63 mm / 1 m."""
        radius = blur_radius(torch.tensor([torch.inf, 1.0, 0.5], dtype=torch.float64), 1.0, 2.0)
        expected = 25e-3 * (0.05 / 0.95) / 2 / 8e-6
        self.assert_close(radius, torch.tensor([-expected, 0.0, expected], dtype=torch.float64))

    def test_feature_white_stays_white_and_focus_stays_sharp(self):
        image, depth = scene(2)
        self.assert_close(depth_blur(torch.ones_like(image), depth, 1.0, 1.4), torch.ones_like(image))
        sharp = depth_blur(image, torch.full_like(depth, 1.0), 1.0, 1.4)
        self.assert_close(sharp, image, atol=1e-5)

    def test_feature_each_image_has_its_own_lens(self):
        image, depth = scene(2)
        focus, number = torch.tensor([0.5, 2.0]), torch.tensor([2.0, 4.0])
        both = depth_blur(image, depth, focus, number, **LENS)
        for row in range(2):
            alone = depth_blur(
                image[row : row + 1], depth[row : row + 1], focus[row].item(), number[row].item(), **LENS
            )
            self.assert_close(both[row : row + 1], alone, atol=1e-5)

    @pytest.mark.parametrize("compositing", ["gather", "scatter", "occlusion"])
    def test_feature_compositing(self, compositing):
        image, depth = scene(1)
        blurred = depth_blur(image, torch.full_like(depth, 0.9), 0.6, 2.0, compositing=compositing, **LENS)
        gathered = depth_blur(image, torch.full_like(depth, 0.9), 0.6, 2.0, **LENS)
        self.assert_close(blurred, gathered, atol=1e-4)  # one layer looks alike

    @pytest.mark.filterwarnings("ignore:There is a performance drop:UserWarning")
    def test_feature_vmap_is_a_loop(self):
        image, depth = scene(2)
        found = torch.vmap(lambda i, d: depth_blur(i[None], d[None], 0.6, 2.0, **LENS))(image, depth)
        self.assert_close(found[:, 0], depth_blur(image, depth, 0.6, 2.0, **LENS), atol=1e-5)

    @pytest.mark.parametrize("near", [1e-45, 1e-30, 1e-18])
    def test_feature_gradients_are_finite_at_any_depth(self, near):
        image, depth = scene(1)
        depth[..., :3], focus = near, torch.tensor(0.6, requires_grad=True)
        blurred = depth_blur(image, depth.requires_grad_(), focus, 2.0, **LENS)
        for slope in torch.autograd.grad(blurred.sum(), (depth, focus)):
            assert slope.isfinite().all()

    def test_exception(self):
        image, depth = scene(1)
        with pytest.raises(ValueError, match=r"focus_distance must be beyond the focal length 0.05 m, got 0.04"):
            depth_blur(image, depth, 0.04, 2.0)
        with pytest.raises(ValueError, match=r"f_number must be at least 0\.5, .*, got 0\.3"):
            depth_blur(image, depth, 1.0, 0.3)
        with pytest.raises(ValueError, match=r"pixel_pitch must be metres between 1e-07 and 0.001 .*, got 8"):
            depth_blur(image, depth, 1.0, 2.0, pixel_pitch=8)
        with pytest.raises(ValueError, match=r"focal_length must be metres between 1e-05 and 10 .*, got 50"):
            DepthBlur(1.0, 2.0, focal_length=50)
        with pytest.raises(TypeError, match="focus_distance must be a number in metres, got '1'"):
            depth_blur(image, depth, "1", 2.0)
        with pytest.raises(ValueError, match="f_number must be one number or one for each of 1 images, got 3"):
            depth_blur(image, depth, 1.0, torch.ones(3))
        with pytest.raises(ValueError, match="focus_distance must be one number or one for each of 1 images, got 0"):
            depth_blur(image, depth, torch.ones(0), 2.0)
        with pytest.raises(ValueError, match="depth must be positive metres, got 0"):
            depth_blur(image, torch.zeros_like(depth), 1.0, 2.0)
        with pytest.raises(ValueError, match="color_space must be one of 'srgb', 'linear'"):
            depth_blur(image, depth, 1.0, 2.0, color_space="lab")
        with pytest.raises(TypeError, match="image must be floating point"):
            depth_blur(image.byte(), depth, 1.0, 2.0)
        with pytest.raises(ValueError, match="image must be finite, got nan"):
            depth_blur(image * torch.nan, depth, 1.0, 2.0)
        with pytest.raises(ValueError, match=r"image must hold values from 0 to 1, got 2\d\d"):
            depth_blur(255 * image, depth, 1.0, 2.0)
        channels_last = image.movedim(1, -1)
        with pytest.raises(ValueError, match=r"to fit the image, .*: put channels first with image.permute"):
            depth_blur(channels_last, depth, 1.0, 2.0)

    def test_feature_a_long_lens_sees_far_depths_apart_and_takes_them_for_metres(self, monkeypatch):
        monkeypatch.setattr("kornia_tidy.optics.units._TOLD", set())
        image, depth = torch.rand(1, 3, 8, 8), torch.linspace(300.0, 9000.0, 64).view(1, 1, 8, 8)
        depth_blur(image, depth, 1000.0, 4.0, focal_length=0.5)  # warnings are errors
        with pytest.warns(UserWarning, match="300 m away.*are these millimetres"):
            depth_blur(image, depth, 1.0, 4.0)


class TestRandomDepthBlur(BaseTester):
    def test_feature_millimetres_are_told_once_and_metres_are_not(self, monkeypatch, device):
        monkeypatch.setattr("kornia_tidy.optics.units._TOLD", set())
        image, depth = torch.rand(1, 3, 40, 40, device=device), torch.linspace(0.3, 9.0, 1600, device=device)
        blur, metres = RandomDepthBlur(p=1.0), depth.view(1, 1, 40, 40)
        blur(image, metres)  # warnings are errors
        with pytest.warns(UserWarning, match=r"300 m away.*are these millimetres\? Multiply depth by 0.001"):
            blur(image, 1000 * metres)
        blur(image, 1000 * metres)

    def test_feature_is_the_function_with_the_drawn_lens(self):
        image, depth = scene(3)
        augmentation = RandomDepthBlur(p=1.0, **LENS)
        blurred = augmentation(image, depth)
        drawn = augmentation._params
        self.assert_close(blurred, depth_blur(image, depth, drawn["focus_distance"], drawn["f_number"], **LENS))
        assert torch.equal(augmentation(image, depth, params=drawn), blurred)

    def test_exception(self):
        with pytest.raises(ValueError, match="focus_distance must be beyond the focal length"):
            RandomDepthBlur(focus_distance=(0.01, 1.0))
        augmentation, (image, depth) = RandomDepthBlur(p=1.0), scene(2)
        augmentation(image, depth)
        with pytest.raises(ValueError, match="params must be the draw of a batch of 1, as the image is, got that of 2"):
            augmentation(image[:1], depth[:1], params=augmentation._params)
        with pytest.raises(ValueError, match=r"f_number must be a range \(low, high\)"):
            RandomDepthBlur(f_number=(4.0, 2.0))
        with pytest.raises(ValueError, match="compositing must be one of 'gather', 'scatter', 'occlusion', got 'x'"):
            RandomDepthBlur(compositing="x")
        for name in ("max_radius", "focal_length", "pixel_pitch"):
            with pytest.raises(ValueError, match=f"{name} must be positive"):
                RandomDepthBlur(**{name: -1.0})

    @pytest.mark.takes_seconds
    @pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")
    def test_dynamo(self):
        image, depth = scene(2)
        augmentation = RandomDepthBlur(p=0.5, **LENS)
        params = augmentation.forward_parameters(image.shape)
        compiled = torch.compile(augmentation, backend="eager")
        self.assert_close(compiled(image, depth, params=params), augmentation(image, depth, params=params))
        blur, lens = DepthBlur(0.6, 2.0, **LENS), torch.tensor([0.6, 0.7])
        whole = torch.compile(depth_blur, backend="eager", fullgraph=True)(image, depth, lens, lens + 1, **LENS)
        self.assert_close(whole, depth_blur(image, depth, lens, lens + 1, **LENS))
        self.assert_close(torch.export.export(blur, (image, depth)).module()(image, depth), blur(image, depth))


class TestBehindALens(BaseTester):
    @torch.no_grad()
    def test_feature_places_are_drawn_and_blur_by_the_lens(self):
        lens = Lens.named("single-50mm", 17.6, 0.595)
        augmentation = RandomDepthBlur(lens=lens, p=1.0, color_space="linear")
        image, depth = torch.rand(2, 1, 24, 24), torch.full((2, 1, 24, 24), 0.5)
        torch.manual_seed(1)
        blurred = augmentation(image, depth)
        places = augmentation._params["field_center"]
        assert places.shape == (2, 2)
        assert not torch.equal(places[0], places[1])
        settings = {"sensor": None, "color_space": "linear", "border": "replicate"}
        bare = TiDyOptics(NoMask(23), lens.camera(8e-6), lens=lens, **settings)
        for i in range(2):
            expected = bare(image[i], depth[i], field_center=places[i])
            self.assert_close(blurred[i], expected, rtol=0, atol=1e-5)
        assert torch.equal(augmentation(image, depth, params=augmentation._params), blurred)
        assert float((blurred - image).abs().max()) > 0.05

    @pytest.mark.parametrize(
        ("options", "error", "message"),
        [
            ({"lens": "single-50mm", "f_number": (4, 8)}, ValueError, "leave f_number out, got \\(4.0, 8.0\\)"),
            ({"lens": "single-50mm", "max_radius": 8}, ValueError, "leave max_radius out, got 8"),
            ({"lens": 5}, TypeError, "lens must be a Lens or the name of one"),
            ({"lens": "single"}, ValueError, "name of a lens must be one of"),
        ],
    )
    def test_exception_a_lens_has_its_own(self, options, error, message):
        with pytest.raises(error, match=message):
            RandomDepthBlur(**options)
