import math
import re
import subprocess
import sys
import warnings

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kornia_tidy.optics import REFERENCE_WAVELENGTH, Spectrum, camera_spectrum
from tests.base import BaseTester

NIKON, SIGMA = "Nikon 5100 (NPL)", "Sigma SDMerill (NPL)"


@pytest.fixture(scope="module")
def colour():
    with warnings.catch_warnings(), np.printoptions():
        warnings.simplefilter("ignore")
        import colour
    return colour


def run_python(code: str) -> None:
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


class TestSpectrum(BaseTester):
    def test_smoke(self):
        spectrum = Spectrum((450e-9, 550e-9), ((1.0, 3.0), (2.0, 0.0), (0.0, 1.0)))
        assert spectrum.channel_weights == ((0.25, 0.75), (1.0, 0.0), (0.0, 1.0))

    @pytest.mark.parametrize("wavelength", [0.0, -530e-9, 0.53, 99e-9, 21e-6, 530.0, math.nan, math.inf])
    def test_exception_a_wavelength_is_light_in_metres(self, wavelength):
        words = rf"wavelengths must be metres between 1e-07 and 2e-05 \(530 nm is 530e-9\), got {wavelength}"
        with pytest.raises(ValueError, match=words):
            Spectrum((530e-9, wavelength), ((1.0, 1.0),))

    @pytest.mark.parametrize(
        ("weights", "sentence"),
        [
            *(
                ((1.0, bad), f"must be finite and not negative, got {bad} in channel 1")
                for bad in (-0.1, math.nan, math.inf)
            ),
            ((0.0, 0.0), r"of channel 1 must have a positive sum, got 0\.0"),
            ((1.0, 1.0, 1.0), "of channel 1 must have one number for each of the 2 .*, got 3"),
        ],
    )
    def test_exception_weights_name_the_channel(self, weights, sentence):
        with pytest.raises(ValueError, match=f"weights {sentence}"):
            Spectrum((500e-9, 600e-9), ((1.0, 1.0), weights))

    @pytest.mark.parametrize(("wavelengths", "weights"), [((), ()), ((), ((),)), ((500e-9,), ())])
    def test_exception_an_empty_spectrum_is_refused(self, wavelengths, weights):
        with pytest.raises(ValueError, match="at least one wavelength and one channel"):
            Spectrum(wavelengths, weights)

    def test_feature_rgb_is_the_papers_three_lines(self):
        """610, 530 and 470 nm, one a channel: PhaseCam3D 2019 and TiDy-PSFs 2023."""
        spectrum = Spectrum.rgb()
        assert spectrum.wavelengths == (610e-9, 530e-9, 470e-9)
        assert spectrum.channel_weights == ((1, 0, 0), (0, 1, 0), (0, 0, 1))

    def test_feature_monochrome_is_at_the_reference_wavelength(self):
        assert REFERENCE_WAVELENGTH == 530e-9
        assert Spectrum.monochrome() == Spectrum((530e-9,), ((1.0,),))
        assert Spectrum.monochrome(633e-9).wavelengths == (633e-9,)

    @given(
        st.integers(1, 6).flatmap(
            lambda n: st.lists(st.lists(st.floats(1e-6, 1e6), min_size=n, max_size=n), min_size=1)
        )
    )
    def test_property_channel_weights_add_up_to_one_in_the_same_ratios(self, rows):
        spectrum = Spectrum(np.linspace(400e-9, 700e-9, len(rows[0])), rows)
        for given_row, row in zip(rows, spectrum.channel_weights, strict=True):
            assert sum(row) == pytest.approx(1, abs=1e-12)
            assert row[0] * given_row[-1] == pytest.approx(row[-1] * given_row[0], rel=1e-12)


class TestCameraSpectrum(BaseTester):
    @pytest.mark.parametrize("camera", [NIKON, SIGMA])
    @pytest.mark.parametrize("samples", [1, 7, 31])
    def test_cardinality(self, camera, samples):
        spectrum = camera_spectrum(camera, samples=samples)
        assert len(spectrum.wavelengths) == samples
        assert [len(row) for row in spectrum.weights] == [samples] * 3

    def test_exception_an_unknown_camera_is_answered_with_those_there_are(self):
        with pytest.raises(ValueError, match=re.escape(f"camera must be one of '{NIKON}', '{SIGMA}', got 'Leica M3'")):
            camera_spectrum("Leica M3")

    def test_exception_an_unknown_illuminant_is_answered_with_those_there_are(self):
        with pytest.raises(ValueError, match=r"illuminant must be one of .*'D65'.*'LED-B1'.*, got 'candle'"):
            camera_spectrum(illuminant="candle")

    @pytest.mark.parametrize("samples", [0, -1, 2.5])
    def test_exception_samples(self, samples):
        with pytest.raises(ValueError, match=f"samples must be a whole number of at least 1, got {samples}"):
            camera_spectrum(samples=samples)

    def test_feature_samples_are_the_middles_of_equal_slices_of_the_visible_range(self):
        assert camera_spectrum(samples=3).wavelengths == pytest.approx((450e-9, 550e-9, 650e-9), abs=1e-15)
        steps = np.diff(camera_spectrum(samples=7).wavelengths)
        assert steps == pytest.approx(300e-9 / 7, abs=1e-15)

    @pytest.mark.parametrize("camera", [NIKON, SIGMA])
    @pytest.mark.parametrize("illuminant", ["D65", "A", "FL2"])
    def test_feature_channels_are_centred_where_the_measured_ones_are(self, colour, camera, illuminant):
        """Against the centroid of sensitivity times light on the 5 nm grid of the lamps' tables."""
        sensitivity, light = colour.MSDS_CAMERA_SENSITIVITIES[camera], colour.SDS_ILLUMINANTS[illuminant]
        visible = (light.wavelengths >= 400) & (light.wavelengths <= min(700, sensitivity.wavelengths[-1]))
        nanometres, lamp = light.wavelengths[visible], light.values[visible]
        columns = [np.interp(nanometres, sensitivity.wavelengths, column) * lamp for column in sensitivity.values.T]
        expected = [(nanometres * column).sum() / column.sum() for column in columns]
        for samples, within in ((7, 4.0), (60, 1.0)):
            spectrum = camera_spectrum(camera, illuminant, samples)
            centroids = np.array(spectrum.channel_weights) @ np.array(spectrum.wavelengths) * 1e9
            assert centroids == pytest.approx(expected, abs=within)
            assert centroids[0] > centroids[1] > centroids[2]

    def test_feature_fine_slices_hold_sensitivity_times_light(self, colour):
        """300 slices of 1 nm: the weight around 550.5 nm is the product of the two tables interpolated there."""
        spectrum = camera_spectrum(SIGMA, "A", samples=300)
        sensitivity, light = colour.MSDS_CAMERA_SENSITIVITIES[SIGMA], colour.SDS_ILLUMINANTS["A"]
        fraction = 0.05  # of the way from 550 to 560 nm
        below, above = (sensitivity.values[list(sensitivity.wavelengths).index(nm)] for nm in (550, 560))
        lamp = np.interp(550.5, light.wavelengths, light.values)
        weights = [row[150] for row in spectrum.weights]
        assert weights == pytest.approx(((1 - fraction) * below + fraction * above) * lamp, rel=1e-4)

    def test_feature_lamp_lines_between_samples_are_not_lost(self):
        """A coarse slice is the mean of its finer slices, so no line of a fluorescent lamp falls between samples."""
        coarse, fine = (np.array(camera_spectrum(NIKON, "FL11", samples).weights) for samples in (4, 60))
        assert coarse == pytest.approx(fine.reshape(3, 4, 15).mean(axis=-1), rel=1e-3)

    def test_feature_a_sensor_is_blind_where_it_was_not_measured(self):
        """The Sigma's table ends at 680 nm."""
        weights = np.array(camera_spectrum(SIGMA, samples=30).weights)
        assert np.all(weights[:, 28:] == 0)
        assert np.all(weights[:, :28] > 0)

    def test_feature_samples_reach_the_accuracy_in_the_docstring(self):
        """On-axis PSF of a flat mask, (sin(ψ'/2) / (ψ'/2))² at ψ' = ψ 530 nm / λ, relative to its mean over colours."""
        psi = np.linspace(-20, 20, 41)[:, None]

        def on_axis(wavelengths):
            return np.sinc(psi * REFERENCE_WAVELENGTH / np.array(wavelengths) / (2 * np.pi)) ** 2

        def channels(samples):
            spectrum = camera_spectrum(samples=samples)
            return on_axis(spectrum.wavelengths) @ np.array(spectrum.channel_weights).T

        scale = on_axis(np.linspace(400e-9, 700e-9, 301)).mean(axis=-1, keepdims=True)
        for samples, promised in ((7, 0.013), (16, 0.0024)):
            error = (np.abs(channels(samples) - channels(600)) / scale).mean()
            assert error == pytest.approx(promised, rel=0.05)

    @pytest.mark.takes_seconds
    def test_feature_colour_is_imported_only_when_a_camera_is_asked_for(self):
        run_python("import sys, kornia_tidy.optics.spectrum; assert 'colour' not in sys.modules")

    @pytest.mark.takes_seconds
    def test_feature_leaves_warnings_and_print_options_as_they_were(self):
        """Without matplotlib too: colour warns of its absence, and warnings are errors here."""
        run_python(
            "import sys, warnings, numpy\n"
            "sys.modules['matplotlib'] = None\n"
            "from kornia_tidy.optics.spectrum import camera_spectrum\n"
            "filters, options = list(warnings.filters), numpy.get_printoptions()\n"
            "camera_spectrum()\n"
            "assert warnings.filters == filters, 'filters'\n"
            "assert numpy.get_printoptions() == options, 'print options'\n"
        )
