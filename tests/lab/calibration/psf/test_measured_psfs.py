from __future__ import annotations

import pytest
import torch
from safetensors.torch import load_file, save_file

from kornia_tidy import PixelwiseMask, PSFBank, SensorNoise, Spectrum, ThinLensCamera, TiDyOptics
from kornia_tidy.lab.calibration.psf import (
    MeasuredPSFs,
    PointImage,
    diffraction_cutoff,
    measure_psfs,
    measured_psfs,
    point_images,
)
from kornia_tidy.masks import fisher_mask
from tests.base import BaseTester
from tests.lab.calibration.psf.captures import exposed, on_pixels, point_light

WINDOW, SIDE = 21, 85
CAMERA, SPECTRUM = ThinLensCamera(), Spectrum.rgb()
CUTOFF = [diffraction_cutoff(CAMERA, wavelength) for wavelength in SPECTRUM.wavelengths]
SENSOR = SensorNoise.physical(10500, 2.4)
EXPOSURES = torch.tensor([1.0, 8.0])
DISTANCES = (0.5, 0.8)
INSIDE = slice(SIDE // 2 - WINDOW // 2, SIDE // 2 + WINDOW // 2 + 1)


def lights(masks):
    """Return the light of a point at each distance, on a grid of ninths of a pixel."""
    return {z: point_light(masks, float(CAMERA.defocus(torch.tensor(z))), SIDE, SPECTRUM, CAMERA) for z in DISTANCES}


@pytest.fixture(scope="module")
def coded():
    return lights(PixelwiseMask(1, initial=fisher_mask()))


@pytest.fixture(scope="module")
def flat():
    return lights(PixelwiseMask(1, initial="flat"))


@pytest.fixture(scope="module")
def truth(coded):
    """Return the true PSFs (D, C, P, P), from far to near, each with a sum of one in the window."""
    psfs = torch.stack([on_pixels(coded[z])[:, INSIDE, INSIDE] for z in sorted(DISTANCES, reverse=True)])
    return psfs / psfs.sum((2, 3), keepdim=True)


def captured(coded, flat, count, seed=0, spoil=None, background=0.0):
    """Return point images at random sub-pixel positions; the long exposure saturates the core."""
    generator = torch.Generator().manual_seed(seed)
    images = {}
    for z in coded:
        images[z] = []
        for n in range(count):
            ninths = tuple(torch.randint(-31, 32, (2,), generator=generator).tolist())  # up to 3.5 pixels
            light = on_pixels(coded[z], ninths)
            frames = exposed(0.5 * light / light.max() + background, EXPOSURES, generator, 10500, 2.4, 0.003)
            clear = on_pixels(flat[z], ninths)
            clear = exposed(0.8 * clear / clear.max() + background, torch.ones(1), generator, 10500, 2.4, 0.003)[0]
            if spoil is not None:
                frames = spoil(n, frames)
            images[z] += point_images(frames, EXPOSURES, SENSOR, WINDOW, reference=clear)
    return images


@pytest.fixture(scope="module")
def images(coded, flat):
    return captured(coded, flat, 12)


@pytest.fixture(scope="module")
def measured(images):
    return measure_psfs(images, CAMERA, WINDOW, CUTOFF)


class TestMeasurePSFs(BaseTester):
    @pytest.mark.takes_seconds
    def test_feature_noisy_captures_give_the_psfs_to_two_percent(self, measured, truth):
        error = (measured.bank.psfs - truth).abs().sum((2, 3))
        assert float(error.max()) < 0.02

    def test_feature_errors_are_as_large_as_it_says(self, measured, truth):
        expected = 0.798 * measured.uncertainty.sum((2, 3))
        assert bool(((measured.bank.psfs - truth).abs().sum((2, 3)) < 1.6 * expected).all())
        assert bool(((measured.bank.psfs - truth).abs().sum((2, 3)) > 0.4 * expected).all())

    def test_feature_errors_follow_from_those_of_the_light_and_of_its_sum(self, images, monkeypatch):
        """By the derivatives of x_i / (x_1 + ... + x_n) at a sum of one: d_ij - p_i."""
        raws, own = [], measured_psfs._raw
        monkeypatch.setattr(measured_psfs, "_raw", lambda *given: raws.append(own(*given)) or raws[-1])
        monkeypatch.setattr(measured_psfs, "shrink", lambda psf, variance: (psf, variance))
        found = measure_psfs({0.8: images[0.8]}, CAMERA, WINDOW, CUTOFF)
        (raw,) = raws
        for channel, psf in enumerate(raw.psf.flatten(1)):
            slopes = torch.eye(len(psf), dtype=psf.dtype) - psf[:, None]
            light, together = raw.variance[channel].flatten(), raw.common[channel].flatten(1)
            expected = slopes.square() @ light + (slopes @ together.mT).square().sum(1)
            self.assert_close(found.uncertainty[0, channel].flatten(), expected.sqrt().float(), rtol=1e-4, atol=1e-9)

    @pytest.mark.parametrize("gradient", [3e-5, 1e-3])
    def test_feature_a_gradient_of_the_background_is_taken_off(self, coded, flat, truth, gradient):
        """Full scales a pixel, per unit of exposure: a lamp beside the point, or vignetting."""
        background = gradient * torch.arange(SIDE, dtype=torch.float64)
        found = measure_psfs(captured({0.8: coded[0.8]}, flat, 12, background=background), CAMERA, WINDOW, CUTOFF)
        error = (found.bank.psfs[0] - truth[0]).abs().sum((1, 2))
        assert bool((error < 1.6 * 0.798 * found.uncertainty[0].sum((1, 2))).all())

    def test_feature_the_bank_is_that_of_the_cameras_defocus(self, measured):
        self.assert_close(measured.bank.defocus, CAMERA.defocus(torch.tensor([0.8, 0.5])))
        assert measured.distances.tolist() == [0.8, 0.5]
        self.assert_close(measured.bank.psfs.sum((2, 3)), torch.ones(2, 3))

    def test_feature_a_capture_with_something_in_it_is_left_out(self, coded, flat):
        def spoil(n, frames):
            frames = frames.clone()
            if n == 3:
                frames[..., 46:49, 36:39] += 0.3  # a reflection beside the point
            if n == 5:
                frames[..., 40:44, 40:44] = 1.0  # saturated in every exposure
            return frames

        found = measure_psfs(captured({0.8: coded[0.8]}, flat, 8, spoil=spoil), CAMERA, WINDOW, CUTOFF)
        words = [report.rejected for report in found.reports if report.rejected is not None]
        assert len(words) == 2
        assert any("residuals" in word for word in words)
        assert any("saturated in every exposure" in word for word in words)

    def test_feature_too_faint_and_cut_short_are_left_out(self, coded):
        light = on_pixels(coded[0.5])
        faint = exposed(1e-4 * light / light.max(), EXPOSURES, torch.Generator().manual_seed(0), 10500, 2.4, 0.003)
        (image,) = point_images(faint, EXPOSURES, SENSOR, WINDOW)
        assert image.fault is not None
        (image,) = point_images(torch.roll(light / light.max(), 38, 2)[None] * 0.5, torch.ones(1), SENSOR, WINDOW)
        assert "leave the picture" in image.fault
        with pytest.raises(ValueError, match=r"no point image at 0\.5 m can be used: .* leave the picture"):
            measure_psfs({0.5: [image]}, CAMERA, WINDOW)

    @pytest.mark.parametrize(("tile", "enough", "channel"), [(None, 4, 2), (((0, 1), (1, 2)), 13, 2)])
    def test_feature_too_few_places_are_told_before_any_work(self, tile, enough, channel, monkeypatch):
        """A disc of the cutoff's radius has at most 4 aliased frequencies for the sensor's pixels, 13 for a plane's."""
        planes_ = 3 if tile is None else 4
        light = torch.ones(planes_, 31, 31, dtype=torch.float64)
        images = [PointImage((40.0 + 4 * n, 40.0), light, light, tile) for n in range(enough)]
        monkeypatch.setattr("kornia_tidy.lab.calibration.psf.measured_psfs.register", lambda *_: pytest.fail("at work"))
        words = rf"^{enough - 1} places of the point at 0.7 m .* resolve channel {channel}, .* {enough} are needed"
        with pytest.raises(UserWarning, match=words):
            measure_psfs({0.7: images[1:], 0.8: images}, CAMERA, WINDOW, CUTOFF)
        with pytest.raises(pytest.fail.Exception, match="at work"):
            measure_psfs({0.7: images}, CAMERA, WINDOW, CUTOFF)

    def test_exception_psfs_that_do_not_explain_their_captures(self, images):
        """Images of two distances given as one: there are too few to identify outliers."""
        mixed = images[0.5][:2] + images[0.8][:1]
        with (
            pytest.warns(UserWarning, match="too few"),
            pytest.raises(ValueError, match=r"found at 0\.5 m do not explain their captures: .* times the noise"),
        ):
            measure_psfs({0.5: mixed}, CAMERA, WINDOW, CUTOFF)


class TestMeasuredPSFs(BaseTester):
    def test_feature_saved_and_loaded_it_is_the_same(self, measured, tmp_path):
        path = tmp_path / "bank.safetensors"
        measured.save(path)
        again = MeasuredPSFs.load(path)
        assert again.reports == measured.reports
        for one, other in (
            (again.bank.psfs, measured.bank.psfs),
            (again.uncertainty, measured.uncertainty),
            (again.distances, measured.distances),
            (PSFBank.load(path).psfs, measured.bank.psfs),
        ):
            assert torch.equal(one, other)

    def test_exception_files_that_do_not_fit(self, measured, tmp_path):
        path = tmp_path / "bank.safetensors"
        measured.bank.save(path)
        with pytest.raises(ValueError, match="is a PSF bank, but not one that was measured"):
            MeasuredPSFs.load(path)
        save_file({"weights": torch.ones(3)}, path)
        with pytest.raises(ValueError, match="is not a PSF bank"):
            MeasuredPSFs.load(path)
        measured.save(path)
        tensors = load_file(path)
        tensors["measured.uncertainty"] = tensors["measured.uncertainty"][:, :, 1:, 1:].contiguous()
        save_file(tensors, path, metadata={"format": "kornia_tidy.psf_bank/1", "reports": "[]"})
        with pytest.raises(ValueError, match="uncertainty must have the shape of the PSFs"):
            MeasuredPSFs.load(path)
        with pytest.raises(FileNotFoundError, match="no such file"):
            MeasuredPSFs.load(tmp_path / "none.safetensors")

    def test_exception_other_channels_or_states(self, measured):
        optics = TiDyOptics(sensor=None).with_bank(measured.bank)
        with pytest.raises(ValueError, match="the measured PSFs have 3 channels, not 1"):
            optics(torch.rand(1, 48, 48), torch.ones(1, 48, 48))
        with pytest.raises(ValueError, match="known for the whole exposure"):
            optics.through_state(0)
