"""Light that is expected beyond full scale where a capture is clipped."""

from __future__ import annotations

import pytest
import torch
from kornia.filters import gaussian_blur2d

from kornia_tidy import PSFBank
from kornia_tidy.reconstruction import RuledClosedForm, ruled_closed_form
from kornia_tidy.reconstruction.clipped_light import MOST, beyond_full_scale
from tests.reconstruction.onnx_export import check_onnx

NOISE = 0.004


def blob(peak: float, side: int = 96) -> torch.Tensor:
    """A bright square before a dark ground."""
    light = torch.full((1, 3, side, side), 0.2)
    light[..., side // 3 : -side // 3, side // 3 : -side // 3] = peak
    return light


def blurred(light: torch.Tensor, sigma: float = 2.0) -> torch.Tensor:
    return gaussian_blur2d(light, (13, 13), (sigma, sigma), "replicate")


def test_only_clipped_pixels_change() -> None:
    seen = blurred(blob(2.5)).clamp(max=1)
    found = beyond_full_scale(seen, NOISE)
    assert torch.equal(found[seen < 0.998], seen[seen < 0.998])
    assert float(found.max()) <= 1 + MOST


def test_a_capture_without_clipped_pixels_is_returned_as_it_is() -> None:
    seen = blurred(blob(0.9))
    assert beyond_full_scale(seen, NOISE) is seen


def test_light_that_is_not_clipped_stays() -> None:
    seen = blurred(blob(2.5))
    found = beyond_full_scale(seen, NOISE)
    assert float((found - seen).abs().max()) < 0.1
    assert float(((found - seen) != 0).float().mean()) < 1e-3


@pytest.mark.parametrize("deviation", [NOISE, 0.012, 0.03])
def test_white_that_noise_lifts_to_full_scale_stays_near_it(deviation: float) -> None:
    noise = deviation * torch.randn(1, 3, 96, 96, generator=torch.Generator().manual_seed(0))
    found = beyond_full_scale((1 + noise).clamp(0, 1), deviation)
    assert abs(float(found.mean()) - 1) < 0.02


def test_a_bright_place_beside_darkness_is_brighter_than_one_that_fades() -> None:
    steep = beyond_full_scale(blurred(blob(2.5)).clamp(max=1), NOISE)
    gentle = beyond_full_scale(blurred(blob(1.05)).clamp(max=1), NOISE)
    assert float(steep[..., 34:-34, 34:-34].min()) > 1.15
    assert float(gentle[..., 35, 35].mean()) < 1.1


def test_the_type_of_numbers_is_kept(dtype: torch.dtype) -> None:
    assert beyond_full_scale(torch.ones(1, 1, 4, 5, dtype=dtype), NOISE).dtype == dtype


def test_a_closed_form_rings_less_beside_clipped_light(monkeypatch: pytest.MonkeyPatch) -> None:
    truth = blob(2.5)
    point = torch.zeros(7, 3, 13, 13)
    point[..., 6, 6] = 1
    form = RuledClosedForm(7, encoded=False)
    form.set_psfs(PSFBank.from_measured(gaussian_blur2d(point, (13, 13), (2.0, 2.0)), torch.arange(7.0)))
    seen = blurred(truth).clamp(max=1)
    known = (seen < 0.999) & (truth < 1)

    def error() -> float:
        return float((form(seen, NOISE).image - truth)[known].square().mean().sqrt())

    filled = error()
    monkeypatch.setattr(ruled_closed_form, "beyond_full_scale", lambda light, noise: light)
    assert filled < 0.8 * error()


def test_a_picture_under_vmap_is_restored_as_one_of_a_batch() -> None:
    light = blurred(torch.cat([blob(2.5), blob(0.9)])).clamp(max=1)
    found = torch.vmap(lambda one: beyond_full_scale(one[None], NOISE)[0])(light)
    torch.testing.assert_close(found, beyond_full_scale(light, NOISE))


class Beyond(torch.nn.Module):
    def forward(self, image: torch.Tensor) -> torch.Tensor:
        return beyond_full_scale(image, NOISE)


@pytest.mark.takes_seconds
def test_onnx_computes_the_same() -> None:
    check_onnx(Beyond(), blurred(blob(2.5, 24)).clamp(max=1), blurred(blob(1.6, 24)).clamp(max=1))
