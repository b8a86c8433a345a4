from __future__ import annotations

from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor

from kornia_tidy import PixelwiseMask, Spectrum, TiDyOptics
from tests.base import BaseTester
from tests.camera.pipeline_samples import camera, scene


class Scene(NamedTuple):
    image: Tensor
    depth: Tensor
    valid: Tensor


class TestCallingForms(BaseTester):
    @pytest.mark.parametrize("channels", [1, 3])
    @pytest.mark.parametrize("batch", [1, 3])
    def test_cardinality_batched(self, batch, channels, device, dtype):
        image, depth = (x.to(device, dtype) for x in scene(batch, channels))
        coded = camera().to(device)(image, depth)
        assert coded.shape == image.shape
        assert coded.dtype == dtype

    def test_feature_all_forms_give_the_same_picture(self):
        optics, (image, depth) = camera(), scene()
        params = optics.draw(image)
        expected = optics(image, depth, params=params)
        forms: list[Any] = [(image, depth), [image, depth], {"image": image, "depth": depth}]
        forms.append({"image": image, "mask_depth": depth})
        for form in forms:
            out = optics(form, params=params)
            assert type(out) is type(form)
            assert torch.equal(out["image"] if isinstance(out, dict) else out[0], expected)

    @pytest.mark.parametrize("channels", [1, 3])
    def test_feature_an_unbatched_sample_keeps_its_rank_and_equals_a_batch_of_one(self, channels):
        optics, (image, depth) = camera(), scene(1, channels)
        params = optics.draw(image[0])
        coded = optics(image[0], depth[0], params=params)
        assert coded.shape == image[0].shape
        assert torch.equal(coded, optics(image, depth, params=params)[0])
        sample = optics({"image": image[0], "depth": depth[0]}, params=params)
        assert torch.equal(sample["image"], coded)
        assert torch.equal(sample["all_in_focus"], image[0])

    def test_feature_a_batch_equals_its_pictures_taken_one_by_one(self):
        optics, (image, depth) = camera(sensor=None), scene(3)
        self.assert_close(
            optics(image, depth), torch.cat([optics(i[None], d[None]) for i, d in zip(image, depth, strict=True)])
        )

    def test_feature_one_depth_serves_a_batch(self):
        optics, (image, depth) = camera(sensor=None), scene(3)
        self.assert_close(optics(image, depth[:1]), optics(image, depth[:1].expand(3, -1, -1, -1)))

    def test_feature_extras_come_back_untouched(self):
        optics, (image, depth), extra = camera(), scene(), object()
        assert optics((image, depth, extra, 4))[2:] == (extra, 4)
        assert optics([image, depth, extra])[2] is extra
        out = optics({"image": image, "depth": depth, "extra": extra, "name": "x"})
        assert out["extra"] is extra
        assert set(out) == {"image", "depth", "extra", "name", "all_in_focus"}

    def test_feature_a_named_tuple_stays_one(self):
        image, depth = scene()
        out = camera()(Scene(image, depth, depth.isfinite()))
        assert isinstance(out, Scene)
        assert torch.equal(out.valid, depth.isfinite())
        assert not torch.equal(out.image, image)

    def test_feature_the_sample_passed_in_is_not_changed(self):
        image, depth = scene()
        sample, before = {"image": image, "depth": depth}, image.clone()
        camera()(sample)
        assert set(sample) == {"image", "depth"}
        assert torch.equal(image, before)

    def test_feature_valid_border_crops_image_depth_and_clean_image_alike(self):
        image, depth = scene()
        optics = camera(border="valid", sensor=None)
        out = optics({"image": image, "mask_depth": depth})
        inside = (..., slice(4, -4), slice(4, -4))  # windows of 9 pixels
        assert torch.equal(out["all_in_focus"], image[inside])
        assert torch.equal(out["mask_depth"], depth[inside])
        # Where the whole PSF fits, the border does not matter.
        self.assert_close(out["image"], camera_like(optics, border="zero")(image, depth)[inside])
        assert torch.equal(optics((image, depth))[1], depth[inside])
        noisy = camera(border="valid")
        assert noisy(image, depth, params=noisy.draw(image)).shape == out["image"].shape

    def test_feature_one_channel_is_taken_as_the_green_of_a_colour_image(self):
        # Green is at 530 nm, as is a picture of one channel.
        optics, (image, depth) = camera(sensor=None), scene(1, 1)
        self.assert_close(optics(image, depth), optics(image.expand(-1, 3, -1, -1), depth)[:, 1:2])

    def test_feature_a_spectrum_of_two_channels_is_encoded_like_three(self):
        two = camera(spectrum=Spectrum((610e-9, 530e-9), ((1, 0), (0, 1))), sensor=None)
        three = camera_like(two, spectrum=Spectrum.rgb())
        image, depth = scene()
        self.assert_close(two(image[:, :2], depth), three(image, depth)[:, :2])


def camera_like(optics: TiDyOptics, **options: Any) -> TiDyOptics:
    """A second camera with the same masks and other options."""
    return camera(**{"masks": optics.masks, "sensor": optics.sensor, **options})


IMAGE, DEPTH = torch.full((1, 3, 40, 48), 0.5), torch.ones(1, 1, 40, 48)


def spoilt(tensor: Tensor, value: float) -> Tensor:
    return tensor.index_put((torch.tensor(0),) * 4, torch.tensor(value))


BAD_CALLS: list[tuple[str, tuple[Any, ...], type[Exception], str]] = [
    ("rank 2", (IMAGE[0, 0], DEPTH), ValueError, r"image must have shape \(B, C, H, W\) or .* got \(40, 48\)"),
    ("rank 5", (IMAGE[None], DEPTH), ValueError, r"image must have shape"),
    ("no pixels", (IMAGE[..., :0, :], DEPTH[..., :0, :]), ValueError, r"one pixel, got shape \(1, 3, 0, 48\)"),
    ("ranks differ", (IMAGE, DEPTH[0]), ValueError, r"depth must have shape .* got \(1, 40, 48\)"),
    ("sizes differ", (IMAGE, DEPTH[..., 1:]), ValueError, r"\(1, 1, 40, 48\) .* got \(1, 1, 40, 47\)"),
    ("batches differ", (IMAGE, DEPTH.expand(2, -1, -1, -1)), ValueError, r"have shape .* got \(2, 1, 40, 48\)"),
    ("depth of 3 channels", (IMAGE, DEPTH.expand(-1, 3, -1, -1)), ValueError, r"depth must have shape"),
    ("integer image", ((255 * IMAGE).byte(), DEPTH), TypeError, r"image must be floating point .* got torch.uint8"),
    ("sparse image", (IMAGE.to_sparse(), DEPTH), TypeError, "must be a dense tensor, got a torch.sparse_coo one"),
    (
        "8-bit floats",
        (IMAGE.to(torch.float8_e4m3fn), DEPTH),
        TypeError,
        "have 16 bits or more, got torch.float8_e4m3fn",
    ),
    ("integer depth", (IMAGE, DEPTH.long()), TypeError, r"depth must be floating point .* got torch.int64"),
    ("an array", (IMAGE.numpy(), DEPTH), TypeError, r"image must be a torch.Tensor, got ndarray"),
    ("NaN image", (spoilt(IMAGE, torch.nan), DEPTH), ValueError, r"image must be finite, got nan"),
    ("infinite image", (spoilt(IMAGE, torch.inf), DEPTH), ValueError, r"image must be finite, got inf"),
    ("NaN depth", (IMAGE, spoilt(DEPTH, torch.nan)), ValueError, r"depth must be positive metres, got nan"),
    ("zero depth", (IMAGE, spoilt(DEPTH, 0.0)), ValueError, r"depth must be positive metres, got 0.0"),
    ("negative depth", (IMAGE, spoilt(DEPTH, -1.0)), ValueError, r"depth must be positive metres, got -1.0"),
    ("no depth", (IMAGE,), ValueError, r"depth is missing"),
    ("no depth in a tuple", ((IMAGE,),), ValueError, r"depth is missing"),
    ("two depths", ((IMAGE, DEPTH), DEPTH), ValueError, r"holds its depth"),
    ("no depth in a mapping", ({"image": IMAGE, "z": DEPTH},), KeyError, r"depth under 'depth' or 'mask_depth'"),
    ("a mapping and a depth", ({"image": IMAGE, "depth": DEPTH}, DEPTH), ValueError, r"holds its depth"),
    ("no image in a mapping", ({"depth": DEPTH},), KeyError, r"needs an 'image'"),
    ("both keys", ({"image": IMAGE, "depth": DEPTH, "mask_depth": DEPTH},), KeyError, r"in one place only"),
    ("2 channels", (IMAGE[:, :2], DEPTH), ValueError, r"must have 3 channels as the spectrum has, or 1, got 2"),
    ("4 channels", (IMAGE[:, [0, 1, 2, 2]], DEPTH), ValueError, r"must have 3 channels .* got 4"),
    (
        "smaller than a PSF",
        (IMAGE[..., :4, :], DEPTH[..., :4, :]),
        ValueError,
        r"border 'reflect' needs an image of at least 5 ",
    ),
]


class TestBadInput(BaseTester):
    @pytest.mark.filterwarnings("ignore:The PyTorch API of MaskedTensors")
    def test_exception_a_masked_tensor_says_how_to_fill_it(self):
        with pytest.raises(TypeError, match=r"depth must be a plain tensor, .*depth.to_tensor\(0\)"):
            camera()(IMAGE, torch.masked.masked_tensor(DEPTH, DEPTH > 0))

    @pytest.mark.parametrize(("inputs", "error", "message"), [b[1:] for b in BAD_CALLS], ids=[b[0] for b in BAD_CALLS])
    def test_exception_comes_before_any_work(self, inputs, error, message, monkeypatch):
        optics, before = camera(), torch.get_rng_state()
        monkeypatch.setattr(TiDyOptics, "psf_bank", lambda *_, **__: pytest.fail("a PSF was computed first"))
        with pytest.raises(error, match=message):
            optics(*inputs)
        assert torch.equal(torch.get_rng_state(), before)

    @pytest.mark.parametrize(
        ("border", "smallest"), [("valid", 9), ("reflect", 5), ("circular", 4), ("replicate", 1), ("zero", 1)]
    )
    def test_feature_smallest_image_of_each_border(self, border, smallest):
        optics, (image, depth) = camera(border=border, sensor=None), scene(1, height=smallest, width=smallest)
        coded = optics(image, depth.nan_to_num(posinf=1.0))
        assert coded.shape[-1] == (1 if border == "valid" else smallest)
        assert coded.isfinite().all()

    @pytest.mark.parametrize(
        "options", [{"color_space": "srgb"}, {"color_space": "linear"}, {"compositing": "scatter"}]
    )
    def test_exception_fidelity_paper_refuses_contradictions(self, options):
        with pytest.raises(ValueError, match="fidelity 'paper' means color_space='paper' and compositing='gather'"):
            TiDyOptics(fidelity="paper", **options)

    @pytest.mark.parametrize(
        "options", [{"fidelity": "best"}, {"color_space": "lab"}, {"compositing": "sum"}, {"border": "mirror"}]
    )
    def test_exception_unknown_choice_names_what_there_is(self, options):
        with pytest.raises(
            ValueError, match=f"{next(iter(options))} must be one of .* got '{next(iter(options.values()))}'"
        ):
            TiDyOptics(**options)

    def test_exception_an_aperture_must_fit_the_masks(self):
        with pytest.raises(ValueError, match="whole number of cells for each of the 23 mask pixels"):
            TiDyOptics(aperture=torch.ones(30, 30)).psf_bank()

    def test_exception_params_and_generator_exclude_each_other(self):
        optics = camera()
        with pytest.raises(ValueError, match="params to replay or generator to draw"):
            optics(IMAGE, DEPTH, params=optics.draw(IMAGE), generator=torch.Generator())

    def test_feature_unchecked_inputs_are_rendered_as_they_are(self):
        optics = camera(check_inputs=False, masks=PixelwiseMask(1), sensor=None)
        assert optics(spoilt(IMAGE, torch.nan), DEPTH).isnan().any()
