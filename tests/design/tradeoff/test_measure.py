from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from kornia_tidy import Fidelity, FresnelLens, TiDyOptics
from kornia_tidy.design.tradeoff import Setting, capture, measure, pareto, sweep, sweep_settings
from kornia_tidy.optics import Lens
from kornia_tidy.psf import PSFModel
from tests.base import BaseTester
from tests.design.tradeoff.samples import ROW

QUICK = Fidelity("quick", window=9, layer_spacing=20.0, pixel_tolerance=1.0)


def scene(size=32):
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(3, size, size, generator=generator)
    return image, torch.linspace(0.3, 3.0, size * size).view(1, size, size)


def settings():
    return [Setting("window", n, QUICK.replace(window=n)) for n in (5, 9)]


class TestCapture(BaseTester):
    @pytest.mark.parametrize("real", [False, True])
    def test_feature_is_the_linear_capture_without_noise(self, real):
        image, depth = scene()
        lens = Lens.from_seidel(50e-3, 17.6, 0.595, field=5e-3, coma=2.0) if real else None
        camera = None if lens is None else lens.camera(8e-6)
        optics = TiDyOptics(camera=camera, fidelity="draft", lens=lens, field_center=(300.0, 300.0))
        at = {"camera": camera, "lens": lens, "field_center": (300.0, 300.0)}
        clean = TiDyOptics(optics.masks, fidelity=QUICK, sensor=None, **at)  # encodes: decoded again by sRGB's formula
        encoded = clean(image, depth).double()
        linear = torch.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
        self.assert_close(capture(optics, image, depth, QUICK), linear, rtol=0, atol=1e-5)

    def test_feature_light_stays_light_where_the_camera_is_linear(self):
        image, depth = scene()
        white = torch.full_like(image, 3.0)  # beyond full scale: an encoding would bend it
        self.assert_close(capture(TiDyOptics(color_space="linear"), white, depth, QUICK), white)

    def test_cardinality_keeps_rank_and_dtype(self, dtype):
        image, depth = (x.to(dtype) for x in scene())
        for case in ((image, depth), (image[None], depth[None]), (image[:1], depth)):
            out = capture(TiDyOptics(), *case, QUICK)
            assert (out.shape, out.dtype) == (case[0].shape, dtype)

    def test_exception_border_valid(self):
        with pytest.raises(ValueError, match="differ in size with the border 'valid'"):
            capture(TiDyOptics(border="valid", fidelity=QUICK), *scene(), QUICK)


class TestMeasure(BaseTester):
    def test_feature_errors_are_those_of_the_definition(self):
        image, depth = scene()
        optics = TiDyOptics(fidelity=QUICK)
        truth = torch.rand(3, 32, 32)
        row = measure(optics, image, depth, QUICK, truth, repeats=1)
        difference = (capture(optics, image, depth, QUICK) - truth).double().numpy()
        assert row.rmse == pytest.approx((difference**2).mean() ** 0.5, rel=1e-6)
        assert row.max_error == pytest.approx(abs(difference).max(), rel=1e-6)
        assert (row.layers, row.window, row.repeats) == (3, 9, 1)

    @pytest.mark.takes_seconds
    def test_feature_every_captures_masks_are_new_and_rendering_keeps_its_bank(self, monkeypatch):
        versions, banks = [], []
        original = PSFModel._computed_bank

        def counted(self, *args, **kwargs):
            versions.append(self.masks.phase._version)
            banks.append(torch.is_grad_enabled())
            return original(self, *args, **kwargs)

        monkeypatch.setattr(PSFModel, "_computed_bank", counted)
        image, depth = scene()
        measure(TiDyOptics(fidelity=QUICK), image, depth, QUICK, torch.zeros_like(image), repeats=3, training=True)
        # error, (warm-up, 3) captures, memory, (warm-up, 3) renderings; memory, (warm-up, 3) with gradients
        assert banks == [False] * 10 + [True] * 5
        assert versions[6:10] == [versions[6]] * 4
        assert versions[1:6] == list(range(versions[0] + 1, versions[0] + 6))

    @pytest.mark.parametrize(
        ("optics", "changes", "sentence"),
        [
            (TiDyOptics(fidelity=QUICK), {"truth": torch.zeros(3, 4, 4)}, "truth must have the image's shape"),
            (TiDyOptics(fidelity=QUICK), {"repeats": 0}, "repeats must be 1 or more, got 0"),
            (TiDyOptics(FresnelLens(), fidelity=QUICK), {"training": True}, "masks that can be learned"),
        ],
    )
    def test_exception(self, optics, changes, sentence):
        image, depth = scene()
        with pytest.raises(ValueError, match=sentence):
            measure(optics, image, depth, QUICK, **{"truth": torch.zeros_like(image), "repeats": 1, **changes})


class TestSweep(BaseTester):
    @pytest.fixture
    def measured(self, monkeypatch):
        """Replace measurements by invented rows, and count them."""
        calls = []

        def made_up(optics, image, depth, fidelity, truth, *, repeats, training):
            calls.append(fidelity)
            return replace(ROW, fidelity=fidelity, repeats=repeats, training_seconds=1.0 if training else None)

        monkeypatch.setitem(sweep.__globals__, "measure", made_up)
        monkeypatch.setitem(sweep.__globals__, "capture", lambda *_: calls.append("truth") or torch.zeros(1))
        return calls

    @pytest.mark.takes_seconds
    def test_feature_the_reference_itself_has_no_error(self):
        optics = TiDyOptics(fidelity=QUICK)
        rows = list(sweep(optics, *scene(), settings(), repeats=1, reference=QUICK))
        assert [row.window for row in rows] == [5, 9]
        assert rows[0].rmse > 0
        assert rows[1].rmse == rows[1].max_error == 0

    def test_feature_the_same_setting_is_measured_once_and_the_reference_once(self, measured):
        rows = list(sweep(TiDyOptics(fidelity=QUICK), *scene(), sweep_settings("draft")))
        assert len(measured) == 1 + len({replace(s.fidelity, name="") for s in sweep_settings("draft")})
        assert [(r.knob, r.value, r.fidelity) for r in rows] == sweep_settings("draft")

    def test_feature_a_row_comes_before_the_next_is_measured(self, measured):
        rows = sweep(TiDyOptics(fidelity=QUICK), *scene(), settings())
        next(rows)
        assert measured == ["truth", settings()[0].fidelity]


class TestPareto(BaseTester):
    def test_feature_against_the_definition(self):
        generator = torch.Generator().manual_seed(0)
        numbers = torch.randint(1, 9, (60, 2), generator=generator).tolist()
        rows = [replace(ROW, capture_seconds=t / 10, rmse=e / 10) for t, e in numbers]
        places = {(row.capture_seconds, row.rmse) for row in rows}
        expected = {(t, e) for t, e in places if not any(u <= t and f <= e and (u, f) != (t, e) for u, f in places)}
        front = pareto(rows)
        assert {(row.capture_seconds, row.rmse) for row in front} == expected
        assert [row.capture_seconds for row in front] == sorted(row.capture_seconds for row in front)

    def test_feature_one_row_is_its_own_front(self):
        assert pareto([ROW]) == [ROW]
