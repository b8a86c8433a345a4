"""Systems of a measured camera: the closed form without training, trained networks that are told what was measured."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from kornia_tidy import PSFBank, SensorNoise, ThinLensCamera
from kornia_tidy.figures.measured_psfs import draw_measured
from kornia_tidy.lab.calibration.psf import MeasuredPSFs, PointReport
from kornia_tidy.lab.capture_file import CaptureLight
from kornia_tidy.lab.measured import check_capture, closed_form_system, measured_settings, takes_psfs, with_measurements
from kornia_tidy.psf import FieldBank
from kornia_tidy.reconstruction.hub import from_pretrained, save_pretrained
from kornia_tidy.reconstruction.light_head import LightHead, reconstruct_light
from kornia_tidy.reconstruction.settings import SystemSettings
from kornia_tidy.reconstruction.state_file import read_state, write_state
from kornia_tidy.reconstruction.trained import TrainedSystem, build_head, build_optics, load_trained, update_psfs
from tests.base import BaseTester
from tests.measured import LENS, measured_psfs

SENSOR = SensorNoise(2e-3, full_well=20_000.0, bits=12)


@pytest.fixture(scope="module")
def psfs():
    return measured_psfs()


@pytest.fixture(scope="module")
def network(psfs):
    """A trained system with the closed form, for the lens and the depths that were measured."""
    lens = {
        name: value for name, value in measured_settings(psfs).items() if name not in {"measured", "masks", "window"}
    }
    settings = SystemSettings(masks=1, head="plain", width=4, closed_form=True, fidelity="draft", window=23, **lens)
    optics, head = build_optics(settings), build_head(settings)
    with torch.no_grad():
        update_psfs(head, optics)
    return TrainedSystem(optics.eval(), head.eval(), settings, 3)


class TestClosedFormSystem(BaseTester):
    def test_feature_a_folder_and_a_checkpoint_hold_the_psfs(self, psfs, tmp_path):
        system = closed_form_system(psfs, SENSOR, "tikhonov")
        folder = save_pretrained(system, tmp_path / "mine")
        again = from_pretrained(folder)
        assert again.settings == system.settings
        assert torch.equal(again.optics.psf_bank().psfs, psfs.bank.psfs)
        assert again.optics.sensor.extra_repr() == SENSOR.extra_repr()
        assert "measured" in (folder / "README.md").read_text()
        capture = torch.rand(1, 3, 40, 40)
        assert torch.equal(again.head(capture), system.head(capture))

    def test_feature_a_folder_holds_psfs_of_several_places(self, psfs, tmp_path):
        system = closed_form_system(psfs, SENSOR, "tikhonov")
        turned = replace(psfs.bank, psfs=psfs.bank.psfs.flip(-1))
        places = FieldBank.from_measured([psfs.bank, turned], [(0, 0), (0, 300)])
        system = system._replace(optics=system.optics.with_bank(places))
        again = from_pretrained(save_pretrained(system, tmp_path / "mine"))
        image, depth = torch.rand(1, 3, 40, 40), torch.full((1, 1, 40, 40), 0.6)
        system.optics.sensor = again.optics.sensor = None
        for place in ((0.0, 0.0), (0.0, 300.0)):
            seen = [one.optics(image, depth, field_center=place) for one in (system, again)]
            assert torch.equal(*seen)

    @pytest.mark.parametrize("channels", [1, 3])
    @torch.no_grad()
    def test_feature_a_file_of_several_places(self, channels, tmp_path):
        """Read as that of one place is; a capture is restored by the PSFs of its place."""
        one = measured_psfs(channels)
        reports = tuple(PointReport(place, 0.0, 0.0, 1.0, 1.0, None) for place in one.distances.tolist())
        one = replace(one, reports=reports)
        far = replace(one, bank=replace(one.bank, psfs=one.bank.psfs.roll(3, -1)))  # moves light by 3 px
        MeasuredPSFs.over_field([one, far], [(0, -9), (0, 9)]).save(tmp_path / "field.safetensors")
        both = MeasuredPSFs.load(tmp_path / "field.safetensors")
        assert both.camera.focal_length == LENS.focal_length
        assert torch.equal(both.distances, one.distances)
        assert [words.split(":")[0] for _, words in both.in_words()] == [w.split(":")[0] for _, w in one.in_words()]
        capture = torch.rand(channels, 24, 24, generator=torch.Generator().manual_seed(0))
        restored = []
        for psfs, center in ((both, -300.0), (both, 300.0), (one, 0.0), (far, 0.0)):
            system = closed_form_system(psfs, SENSOR, "tikhonov")
            system.optics.field_center = 0.0, center
            restored.append(reconstruct_light(LightHead(system, noise=2e-3), capture).image)
        self.assert_close(restored[0], restored[2], rtol=0, atol=1e-4)
        self.assert_close(restored[1], restored[3], rtol=0, atol=1e-4)
        assert float((restored[0] - restored[1]).abs().max()) > 0.1

    def test_exception_of_several_places(self, psfs):
        other = replace(psfs, bank=replace(psfs.bank, defocus=psfs.bank.defocus + 1))
        with pytest.raises(ValueError, match="banks of all places must have the same defocus, colours and window"):
            MeasuredPSFs.over_field([psfs, other], [(0, 0), (0, 9)])
        with pytest.raises(TypeError, match="PSFs of one place are drawn"):
            draw_measured(MeasuredPSFs.over_field([psfs, psfs], [(0, 0), (0, 9)]))

    def test_exception_a_checkpoint_whose_psfs_do_not_fit(self, psfs, tmp_path):
        system = closed_form_system(psfs, SENSOR)
        weights = {f"optics.{name}": value for name, value in system.optics.state_dict().items()}
        weights |= {f"head.{name}": value for name, value in system.head.state_dict().items()}
        state = {"settings": system.settings.as_dict(), "state_dict": weights, "global_step": 0}
        bank = {"psfs": psfs.bank.psfs, "defocus": psfs.bank.defocus, "energy": psfs.bank.energy}
        write_state(tmp_path / "whole", {**state, "psfs": bank})
        assert torch.equal(load_trained(tmp_path / "whole").optics.psf_bank().psfs, psfs.bank.psfs)
        for spoilt, sentence in (
            ({}, "settings of measured PSFs need them"),
            ("psfs", "measured PSFs must be tensors by name, got 'psfs'"),
            ({"psfs": bank["psfs"]}, "measured PSFs must have psfs, defocus and energy"),
            ({**bank, "defocus": bank["defocus"][1:]}, "defocus must have shape"),
            ({**bank, "psfs": bank["psfs"] * torch.nan}, "must be finite"),
            ({**bank, "psfs": bank["psfs"].flip(-1)}, "measured PSFs"),  # of another camera
        ):
            write_state(tmp_path / "spoilt", {**read_state(tmp_path / "whole"), "psfs": spoilt})
            with pytest.raises(ValueError, match=sentence):
                load_trained(tmp_path / "spoilt")

    def test_exception_is_one_sentence(self, psfs):
        four = PSFBank.from_measured(psfs.bank.psfs[:, [0, 1, 1, 2]], psfs.bank.defocus)
        for measured, head, sentence in (
            (replace(psfs, camera=None), "wiener", "come without the lens"),
            (replace(psfs, bank=four, uncertainty=four.psfs), "wiener", "PSFs of 3 channels are needed, got 4"),
            (psfs, "nafnet", "head must be one of 'tikhonov'"),
        ):
            with pytest.raises(ValueError, match=sentence):
                closed_form_system(measured, SENSOR, head)


class TestWithMeasurements(BaseTester):
    def test_feature_the_network_is_told_both_and_the_given_system_stays_as_it_is(self, psfs, network):
        before = network.head.closed_form.psfs.clone()
        told = with_measurements(network, psfs, SENSOR)
        assert torch.equal(told.optics.psf_bank().psfs, psfs.bank.psfs)
        assert told.settings.measured
        assert (told.settings.sigma, told.settings.full_well, told.settings.bits) == (2e-3, 20_000.0, 12)
        wanted = closed_form_system(psfs, SENSOR, "tikhonov-bilateral").head.closed_form
        self.assert_close(told.head.closed_form.psfs, wanted.psfs)
        self.assert_close(told.head.closed_form.noise_model, wanted.noise_model)
        assert network.optics.psf_model.measured is None
        assert network.optics.sensor.full_well is None
        assert torch.equal(network.head.closed_form.psfs, before)
        assert told.head.network.layers[0].weight is network.head.network.layers[0].weight

    def test_feature_the_noise_alone(self, network):
        told = with_measurements(network, sensor=SENSOR)
        assert told.optics.sensor is SENSOR
        assert not told.settings.measured
        assert told.optics.masks is network.optics.masks

    def test_exception_another_lens_and_depths_that_were_not_measured(self, psfs, network):
        def through(**lens):
            optics = network.optics.with_fidelity(network.optics.fidelity)
            known = {"focal_length": LENS.focal_length, "aperture_diameter": LENS.aperture_diameter}
            optics.camera = ThinLensCamera(**{**known, "depth_range": (0.4, 2.5), **lens})
            return network._replace(optics=optics)

        with_measurements(through(depth_range=(0.39, 2.8)), psfs)  # within two radians
        for lens, sentence in (
            ({"pixel_pitch": 3.45e-6}, "measured with a pixel pitch of 8e-06 m, and the network is for 3.45e-06 m"),
            ({"focal_length": 35e-3}, "a focal length of 0.05 m, and the network is for 0.035 m"),
            ({"focus_distance": 1.0}, "a focus distance of 0.595 m, and the network is for 1 m"),
            ({"focus_distance": float("inf")}, "the network is for inf m"),
            ({"depth_range": (0.3, 2.5)}, "from 0.4 to 2.5 m, and the network is for depths from 0.3 to 2.5 m"),
            ({"depth_range": (0.4, float("inf"))}, "depths from 0.4 to inf m"),
        ):
            with pytest.raises(ValueError, match=sentence):
                with_measurements(through(**lens), psfs)

    def test_exception_captures_of_other_colours_or_without_their_noise(self, psfs, network):
        told, by_lens = with_measurements(network, psfs), network._replace(step=0)
        three, grey = (CaptureLight(torch.rand(c, 9, 9), lambda picture: picture, {}, SENSOR) for c in (3, 1))
        check_capture(told, "a.png", three)
        check_capture(by_lens, "a.png", grey)
        with pytest.raises(ValueError, match=r"the PSFs were measured in 3 colours, and a\.png has 1"):
            check_capture(told, "a.png", grey)
        check_capture(told, "a.png", three._replace(noise=None))
        with pytest.raises(ValueError, match=r"the noise of a\.png is not known: give --noise"):
            check_capture(by_lens, "a.png", three._replace(noise=None))

    def test_feature_networks_that_deconvolve(self, network):
        assert takes_psfs(network.head)
        assert not takes_psfs(build_head(SystemSettings(head="plain", width=4)))
        assert takes_psfs(build_head(SystemSettings(head="plain", width=4, refocus=3)))
