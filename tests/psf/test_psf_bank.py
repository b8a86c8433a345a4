from __future__ import annotations

import math
import os

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from kornia_tidy import DefocusRange, PSFBank, ThinLensCamera, TiDyOptics
from kornia_tidy.psf import PSFModel
from kornia_tidy.psf.psf_bank import enclosing_window
from kornia_tidy.render import render
from tests.base import BaseTester


@pytest.fixture
def bank() -> PSFBank:
    psfs = torch.rand(4, 3, 7, 7) / 60
    return PSFBank(psfs, torch.linspace(-3, 3, 4), psfs.sum((2, 3)))


class TestPSFBank(BaseTester):
    def test_feature_renormalized_psfs_sum_to_one_and_energy_stays(self, bank):
        whole = bank.with_stray_light("renormalize")
        self.assert_close(whole.psfs.sum((2, 3)), torch.ones(4, 3))
        assert torch.equal(whole.energy, bank.energy)
        assert whole.veil is None

    def test_feature_veil_keeps_the_light_that_leaves(self, bank):
        veiled = bank.with_stray_light("veil")
        self.assert_close(veiled.psfs.sum((2, 3)) + veiled.veil, torch.ones(4, 3))
        assert bank.with_stray_light("discard").veil is None
        assert {x.dtype for x in veiled.to(dtype=torch.float64).present().values()} == {torch.float64}
        assert torch.equal(veiled.to("cpu").veil, veiled.veil)

    def test_feature_a_psf_without_light_stays_finite(self):
        dark = PSFBank(torch.zeros(1, 1, 3, 3), torch.zeros(1), torch.zeros(1, 1)).with_stray_light("renormalize")
        assert float(dark.psfs.abs().max()) == 0

    @pytest.mark.parametrize("psi", [-9.0, -3.0, -1.3, 0.4, 3.0, 12.0])
    def test_feature_at_any_defocus_as_a_capture_has_it(self, bank, psi):
        """A point of light at that depth, photographed through the bank, is the PSF."""
        camera = ThinLensCamera()
        optics = TiDyOptics(camera=camera, sensor=None, color_space="linear").with_bank(bank)
        point = torch.zeros(1, 3, 17, 17)
        point[..., 8, 8] = 1
        depth = camera.depth(torch.full((1, 1, 17, 17), psi))
        seen = optics(point, depth)[0, :, 5:12, 5:12]
        found = optics.psf_bank(defocus=[psi])
        self.assert_close(found.psfs[0], seen, atol=1e-6, rtol=0)
        self.assert_close(found.energy[0], seen.sum((1, 2)), atol=1e-5, rtol=0)

    def test_feature_of_one_node_at_any_defocus_it_is_that(self, bank):
        one = PSFBank(bank.psfs[:1], bank.defocus[:1], bank.energy[:1], bank.energy[:1])
        found = one.at_defocus([-20.0, 0.0, 20.0])
        for name in ("psfs", "energy", "veil"):
            assert torch.equal(getattr(found, name), getattr(one, name).expand(3, *getattr(one, name).shape[1:]))

    def test_feature_channels_from_grey_to_colours_and_green_of_them(self, bank):
        assert torch.equal(bank.with_channels(1).psfs, bank.psfs[:, 1:2])
        assert torch.equal(bank.with_channels(1).with_channels(3).energy, bank.energy[:, [1, 1, 1]])
        assert torch.equal(bank.with_channels(3).psfs, bank.psfs)
        four = PSFBank(bank.psfs[:, [0, 1, 1, 2]], bank.defocus, bank.energy[:, [0, 1, 1, 2]])
        with pytest.raises(ValueError, match="PSFs of 3 channels are needed, got 4"):
            four.with_channels(3)

    @pytest.mark.parametrize("kind", ["renormalize", "veil"])
    def test_feature_saved_and_loaded_it_is_the_same(self, bank, kind, tmp_path):
        bank = bank.with_stray_light(kind)
        bank.save(tmp_path / "bank.safetensors")
        again = PSFBank.load(tmp_path / "bank.safetensors")
        for name in ("psfs", "defocus", "energy", "veil"):
            one, two = getattr(bank, name), getattr(again, name)
            assert (one is None and two is None) or torch.equal(one, two)

    def test_feature_a_bank_with_gradients_can_be_saved(self, tmp_path):
        TiDyOptics().psf_bank().save(tmp_path / "bank.safetensors")
        assert PSFBank.load(tmp_path / "bank.safetensors").psfs.requires_grad is False

    def test_exception_unreadable_files(self, bank, tmp_path):
        path = tmp_path / "bank.safetensors"
        with pytest.raises(FileNotFoundError, match="no such file"):
            PSFBank.load(path)
        path.write_bytes(b"")
        with pytest.raises(ValueError, match="empty"):
            PSFBank.load(path)
        path.write_bytes(b"not a bank, though long enough to have a header")
        with pytest.raises(ValueError, match="it is no PSF bank or is damaged"):
            PSFBank.load(path)
        bank.save(path)
        path.write_bytes(path.read_bytes()[:-100])
        with pytest.raises(ValueError, match="it is no PSF bank or is damaged"):
            PSFBank.load(path)
        save_file({"weights": torch.ones(3)}, path)
        with pytest.raises(ValueError, match="is not a PSF bank"):
            PSFBank.load(path)

    @pytest.mark.parametrize(
        ("psfs", "energy", "nodes", "message"),
        [
            (-torch.ones(2, 3, 5, 5), 1.0, [0.0, 1.0], "psfs must not be negative, got -1.0"),
            (torch.zeros(2, 3, 5, 5), 1.0, [0.0, 1.0], "psfs must hold some light"),
            (torch.ones(2, 3, 5, 5).long(), 1.0, [0.0, 1.0], "psfs must be real .* got torch.int64"),
            (torch.ones(2, 3, 5, 5).to(torch.float8_e5m2), 1.0, [0.0, 1.0], "psfs must be real numbers of 16 bits"),
            (torch.ones(2, 3, 5, 5) * torch.nan, 1.0, [0.0, 1.0], "psfs must be finite, got nan"),
            (torch.ones(2, 3, 5, 5) * 1e3, 1.0, [0.0, 1.0], r"psfs must be shares of .* got a sum of 2.5e\+04"),
            (torch.ones(2, 3, 5, 5), 1.0, [1.0, 0.0], r"defocus must ascend, got \[1.0, 0.0\]"),
            (torch.ones(2, 3, 5, 5), 0.0, [0.0, 1.0], "energy must be positive where psfs hold light, got 0.0"),
        ],
    )
    def test_exception_files_and_banks_of_no_light(self, psfs, energy, nodes, message, tmp_path):
        made = PSFBank(psfs, torch.tensor(nodes), torch.full((2, 3), energy))
        made.save(tmp_path / "bank.safetensors")
        with pytest.raises((TypeError, ValueError), match="cannot read .*" + message):
            PSFBank.load(tmp_path / "bank.safetensors")
        with pytest.raises((TypeError, ValueError), match=message):
            PSFModel().with_bank(made)

    @pytest.mark.parametrize(
        ("defocus", "error", "message"),
        [
            (5, TypeError, "defocus must be a list of nodes in radians, such as .*, got the number 5"),
            ([], ValueError, r"defocus must be one or more nodes in finite radians, got \[\]"),
            ([0.0, math.nan], ValueError, "got .*nan"),
            (["a"], TypeError, "a node of defocus must be a number in radians, got 'a'"),
        ],
    )
    def test_exception_nodes(self, bank, defocus, error, message):
        for psfs_at in (bank.at_defocus, lambda nodes: TiDyOptics().psf_bank(defocus=nodes)):
            with pytest.raises(error, match=message):
                psfs_at(defocus)

    def test_exception_nodes_far_out_of_focus(self):
        with pytest.raises(ValueError, match=r"defocus must be within 20000 rad to be computed, got 1000000"):
            TiDyOptics().psf_bank(defocus=[1e6])

    def test_feature_nodes_of_a_tensor_are_those_of_a_list(self):
        model = PSFModel(fidelity="draft")
        assert torch.equal(model.psf_bank(defocus=torch.tensor([0.0, 1.0])).psfs, model.psf_bank(defocus=[0, 1]).psfs)

    def test_exception_saving_leaves_nothing_behind(self, bank, tmp_path):
        with pytest.raises(FileNotFoundError, match="no folder"):
            bank.save(tmp_path / "missing" / "bank.safetensors")
        assert os.listdir(tmp_path) == []

    @pytest.mark.parametrize(
        ("psfs", "defocus", "message"),
        [
            (torch.ones(2, 3, 4, 4), torch.zeros(2), "P odd"),
            (torch.ones(2, 3, 5), torch.zeros(2), "P odd"),
            (torch.ones(0, 3, 5, 5), torch.zeros(0), "P odd"),
            (torch.ones(2, 3, 5, 5), torch.zeros(3), "defocus must have shape"),
        ],
    )
    def test_exception_shapes(self, psfs, defocus, message):
        with pytest.raises(ValueError, match=message):
            PSFBank(psfs, defocus, torch.ones(2, 3))

    def test_feature_measured_psfs_are_scaled(self):
        bank = PSFBank.from_measured(torch.rand(2, 3, 5, 5) + 1, torch.tensor([-1.0, 2.0]))
        self.assert_close(bank.psfs.sum((2, 3)), torch.ones(2, 3))

    @pytest.mark.parametrize(
        ("psfs", "defocus", "message"),
        [
            (-torch.ones(2, 1, 3, 3), torch.tensor([0.0, 1.0]), "not be negative"),
            (torch.full((2, 1, 3, 3), torch.nan), torch.tensor([0.0, 1.0]), "finite"),
            (torch.zeros(2, 1, 3, 3), torch.tensor([0.0, 1.0]), "must hold some light"),
            (torch.ones(2, 1, 3, 3), torch.tensor([1.0, 0.0]), "ascend"),
            (np.ones((2, 1, 3, 3)), torch.tensor([0.0, 1.0]), "psfs must be a .* torch.from_numpy makes one"),
            (torch.ones(2, 1, 3, 3), [0.0, 1.0], "defocus must be a torch.Tensor, got a list"),
        ],
    )
    def test_exception_measured(self, psfs, defocus, message):
        with pytest.raises((TypeError, ValueError), match=message):
            PSFBank.from_measured(psfs, defocus)


class TestEnclosingWindow(BaseTester):
    def test_feature_equals_the_sum_over_squares(self):
        psfs = torch.rand(3, 2, 11, 11)
        psfs = psfs / psfs.sum((2, 3), keepdim=True)
        for share in (0.05, 0.3, 0.7, 0.99):
            window = enclosing_window(psfs, share)
            held = lambda p: float(psfs[..., 5 - p // 2 : 6 + p // 2, 5 - p // 2 : 6 + p // 2].sum((2, 3)).min())  # noqa: E731
            assert held(window) >= share
            assert window == 1 or held(window - 2) < share

    def test_feature_none_where_the_light_is_not_there(self):
        assert enclosing_window(torch.full((1, 3, 3), 0.01), 0.5) is None


class TestTails(BaseTester):
    def discs(self) -> PSFBank:
        """Cut to zero: a point in focus, and a disc of 12 pixels at +10."""
        radius = torch.hypot(*torch.meshgrid(torch.arange(-16.0, 17), torch.arange(-16.0, 17), indexing="ij"))
        discs = [(radius <= r).float().expand(3, -1, -1) for r in (0.5, 6.0, 12.0)]
        return PSFBank.from_measured(torch.stack(discs), torch.tensor([0.0, 5.0, 10.0]))

    def test_feature_light_stays_and_nothing_is_cut(self):
        bank = self.discs()
        tails = bank.with_tails().psfs
        assert float(tails.min()) > 0
        self.assert_close(tails.sum((2, 3)), bank.psfs.sum((2, 3)))
        assert float((tails - bank.psfs).abs().sum((2, 3)).max()) <= 2e-3 * (1 + 1e-5)

    @torch.no_grad()
    def test_feature_a_camera_gives_tails_to_measured_psfs_that_are_cut_for_occlusion(self):
        parts = {"camera": DefocusRange(0.0, 10.0), "sensor": None, "color_space": "linear"}
        depth, image = torch.zeros(1, 1, 64, 64), torch.ones(1, 3, 64, 64)
        depth[..., :32] = 1.0
        hides = TiDyOptics(**parts, compositing="occlusion").with_bank(self.discs())
        assert float(hides(image, depth).min()) > 0.997
        bank = self.discs()
        gathers, whole = TiDyOptics(**parts).with_bank(bank), PSFBank.from_measured(bank.psfs + 1e-4, bank.defocus)
        image = torch.rand(1, 3, 64, 64)
        self.assert_close(gathers(image, depth), render(image, 10 * depth, bank), rtol=0, atol=1e-6)
        # PSFs without zeros are taken as they are.
        wanted = render(image, 10 * depth, whole, "occlusion")
        self.assert_close(hides.with_bank(whole)(image, depth), wanted, rtol=0, atol=1e-6)
