"""Contract of modulators: masks in, states and their fractions of the exposure out, and gradients to both."""

from __future__ import annotations

import pytest
import torch
from torch.func import functional_call

from kornia_tidy import DwellTimes, Fidelity, LearnableDwellTimes, PixelwiseMask, SpatialLightModulator, TiDyOptics
from kornia_tidy.modulator import DiffractionEfficiency, GreyLevels, PixelCrosstalk, Switching
from tests.base import BaseTester

SMALL = Fidelity(window=9, layer_spacing=20.0, stray_light="discard")


class TestDwellTimes(BaseTester):
    @pytest.mark.parametrize(
        "modulator",
        [DwellTimes(), DwellTimes((1,)), DiffractionEfficiency(0.7), SpatialLightModulator(), Switching(1e-3)],
        ids=lambda modulator: type(modulator).__name__,
    )
    def test_exception_no_masks(self, modulator):
        with pytest.raises(ValueError, match=r"phase must hold at least one mask, got the shape \(0, 5, 5\)"):
            modulator(torch.zeros(0, 5, 5))

    @pytest.mark.parametrize("unit", [5e-324, 1e-300, 1.0, 5.9e307])
    def test_feature_shares_are_relative_in_any_unit(self, unit):
        _, weights = DwellTimes((3 * unit, unit, 0.0))(torch.zeros(3, 5, 5))
        assert weights.tolist() == [0.75, 0.25, 0.0]


class TestLearnableDwellTimes(BaseTester):
    def test_exception(self):
        for shares in ((), (1, 0), (1, -1), (1, float("inf"))):
            with pytest.raises(ValueError, match="must be positive and finite"):
                LearnableDwellTimes(shares)
        with pytest.raises(ValueError, match="dwell shares must be one for each of the 2 masks, got 3"):
            LearnableDwellTimes((1, 1, 1))(torch.zeros(2, 5, 5))

    @pytest.mark.parametrize("shares", [(1, 1, 1), (5, 2, 0.1)])
    def test_feature_they_start_as_the_fixed_ones(self, shares):
        masks = PixelwiseMask(3)
        banks = [
            TiDyOptics(masks, modulator=module(shares), fidelity=SMALL).psf_bank().psfs.detach()
            for module in (DwellTimes, LearnableDwellTimes)
        ]
        self.assert_close(*banks, rtol=0, atol=1e-7)

    def test_gradcheck(self):
        module = Switching(20e-3, between="linear", dwell=LearnableDwellTimes((1, 2)), samples=3)

        def mean_field(phase, logits):
            states, weights = functional_call(module, {"dwell.logits": logits}, (phase,))
            return torch.einsum("k,kyx->yx", weights, states.cos())

        self.gradcheck(mean_field, (6 * torch.rand(2, 4, 4), torch.tensor([0.3, -0.2])))


class TestSpatialLightModulator(BaseTester):
    def test_exception(self):
        with pytest.raises(TypeError, match=r"as DwellTimes and Switching do, got \['GreyLevels'\]"):
            SpatialLightModulator(GreyLevels(8))(torch.zeros(2, 5, 5))
        for fill_factor in (0, -0.5, 1.1, float("nan")):
            with pytest.raises(ValueError, match="fill_factor must be above 0 and at most 1"):
                SpatialLightModulator(DwellTimes(), fill_factor=fill_factor)

    def test_feature_parts_work_one_after_the_other(self):
        phase = 6 * torch.rand(3, 7, 7)
        levels, crosstalk = GreyLevels(3), PixelCrosstalk(0.4)
        states, weights = SpatialLightModulator(levels, crosstalk, Switching(10e-3, between="linear"))(phase)
        self.assert_close(states[:3], crosstalk(levels(phase)), rtol=0, atol=0)
        self.assert_close(weights[:3], torch.full((3,), 0.8 / 3))

    def test_feature_gradients_pass_all_parts(self):
        modulator = SpatialLightModulator(
            GreyLevels(4),
            PixelCrosstalk(0.3),
            Switching(5e-3, between="exponential", dwell=LearnableDwellTimes((1, 1))),
            fill_factor=0.9,
        )
        optics = TiDyOptics(PixelwiseMask(2), modulator=modulator, sensor=None, fidelity=SMALL)
        optics(torch.rand(1, 3, 16, 16), torch.full((1, 1, 16, 16), 0.7)).square().mean().backward()
        for parameter in optics.parameters():
            assert float(parameter.grad.abs().max()) > 0
            assert bool(torch.isfinite(parameter.grad).all())

    def test_dynamo_the_psfs_are_one_graph(self):
        parts = (GreyLevels(6), PixelCrosstalk(0.3), Switching(5e-3, dwell=LearnableDwellTimes((1, 2))))
        modulator = SpatialLightModulator(*parts, fill_factor=0.9)
        optics = TiDyOptics(PixelwiseMask(2), modulator=modulator, sensor=None, fidelity=SMALL)
        compiled = torch.compile(lambda: optics.psf_bank(1, defocus=[0.0]).psfs, fullgraph=True, backend="eager")
        self.assert_close(compiled(), optics.psf_bank(1, defocus=[0.0]).psfs)

    @pytest.mark.parametrize(
        "change",
        [
            lambda panel, _: setattr(panel, "levels", GreyLevels(1).levels),
            lambda _, switching: setattr(switching, "switching_time", 0.05),
            lambda _, switching: setattr(switching, "between", "linear"),
            lambda _, switching: switching.dwell.logits.data.add_(torch.tensor([1.0, 0.0])),
        ],
        ids=["levels", "switching time", "states between", "dwell times"],
    )
    @torch.no_grad()
    def test_feature_what_is_changed_in_place_is_never_stale(self, change):
        panel, switching = GreyLevels(6), Switching(0.01, dwell=LearnableDwellTimes((1, 1)))
        optics = TiDyOptics(PixelwiseMask(2), modulator=SpatialLightModulator(panel, switching), fidelity=SMALL)
        before = optics.psf_bank().psfs
        change(panel, switching)
        after = optics.psf_bank().psfs
        fresh = TiDyOptics(optics.masks, modulator=optics.modulator, fidelity=SMALL).psf_bank().psfs
        assert float((after - before).abs().max()) > 1e-4
        self.assert_close(after, fresh, rtol=0, atol=1e-7)

    def test_feature_a_cast_reaches_the_parts(self):
        modulator = SpatialLightModulator(GreyLevels(8), LearnableDwellTimes((1, 3))).double()
        assert {parameter.dtype for parameter in modulator.parameters()} == {torch.float64}

    def test_smoke_repr_tells_the_panel(self):
        modulator = SpatialLightModulator(
            GreyLevels(8), Switching(4e-3, dwell=LearnableDwellTimes((1, 3))), fill_factor=0.93
        )
        for words in (
            "8 bits",
            "4 ms a transition",
            "random",
            "fill factor 0.93",
            "learnable dwell shares (0.25, 0.75)",
        ):
            assert words in repr(modulator)


class TestDiffractionEfficiency(BaseTester):
    def test_exception(self):
        for efficiency in (0.0, -0.1, 1.1, float("nan")):
            with pytest.raises(ValueError, match=f"efficiency must be above 0 and at most 1, got {efficiency}"):
                DiffractionEfficiency(efficiency)

    def test_feature_what_the_masks_do_not_take_passes_flat(self):
        masks = PixelwiseMask(2)
        mixed, own = (
            TiDyOptics(masks, modulator=part, fidelity=SMALL).psf_bank().psfs.detach()
            for part in (DiffractionEfficiency(0.6), DwellTimes())
        )
        flat = TiDyOptics(PixelwiseMask(1, initial="flat"), fidelity=SMALL).psf_bank().psfs.detach()
        self.assert_close(mixed, 0.6 * own + 0.4 * flat, rtol=0, atol=1e-7)

    def test_gradcheck(self):
        self.gradcheck(DiffractionEfficiency(0.7), (torch.rand(2, 3, 3),))
