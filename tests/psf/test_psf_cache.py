"""What is remembered between captures: never stale, never in the way of gradients, never more than asked."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from unittest.mock import patch

import pytest
import torch

from kornia_tidy import DwellTimes, Fidelity, PixelwiseMask, ThinLensCamera, TiDyOptics
from kornia_tidy.psf import psf_model as module
from kornia_tidy.psf.psf_cache import PSFMemory, values_of
from tests.base import BaseTester

SMALL = Fidelity(window=9, layer_spacing=5.0)


@pytest.fixture
def optics() -> TiDyOptics:
    return TiDyOptics(PixelwiseMask(2), sensor=None, fidelity=SMALL)


def depths_built(optics: TiDyOptics, depth: torch.Tensor) -> int:
    """Number of depths whose PSFs a capture computes."""
    image = torch.rand(depth.shape[0], 3, *depth.shape[-2:])
    built = []
    real = module.exact_psf_bank

    def spy(*arguments, **options):
        built.extend(arguments[5])
        return real(*arguments, **options)

    with patch.object(module, "exact_psf_bank", spy):
        optics(image, depth)
    return len(built)


class TestOnlyWhatTheSceneRequires(BaseTester):
    @pytest.mark.parametrize("span", [(0.25, 0.26), (0.2975, 0.3), (0.5, 0.595), (0.6, 1.0), (3.0, float("inf"))])
    def test_feature_present_depths_give_the_capture_of_all_depths(self, optics, span):
        near, far = span
        inverse = 1 / far + (1 / near - 1 / far) * torch.rand(1, 1, 20, 24, dtype=torch.float64)
        image, depth = torch.rand(1, 3, 20, 24, dtype=torch.float64), 1 / inverse
        optics.check_inputs = False  # no warning of depths beyond the range
        few = optics(image, depth)
        with patch.object(module, "nodes_around", lambda nodes, _: nodes):
            every = optics(image, depth)
        self.assert_close(few, every, rtol=0, atol=1e-12)

    def test_feature_depth_keeps_its_gradient_on_a_node(self, optics):
        depth = torch.full((1, 1, 16, 16), 0.595, dtype=torch.float64, requires_grad=True)
        optics(torch.rand(1, 3, 16, 16, dtype=torch.float64), depth).sum().backward()
        assert float(depth.grad.abs().max()) > 0


class TestPSFMemory(BaseTester):
    @torch.no_grad()
    def test_feature_without_gradients_each_depth_is_computed_once(self, optics):
        assert depths_built(optics, torch.full((1, 1, 16, 16), 0.5)) == 2
        assert depths_built(optics, torch.full((1, 1, 16, 16), 0.5)) == 0
        assert depths_built(optics, torch.tensor([0.5, 0.7]).reshape(2, 1, 1, 1).expand(2, 1, 16, 16)) == 1

    def test_feature_training_always_computes(self, optics):
        for _ in range(2):
            assert depths_built(optics, torch.full((1, 1, 16, 16), 0.5)) == 2
        with torch.no_grad():
            optics(torch.rand(1, 3, 16, 16), torch.full((1, 1, 16, 16), 0.5))
        optics(torch.rand(1, 3, 16, 16), torch.full((1, 1, 16, 16), 0.5)).sum().backward()
        assert float(optics.masks.phase.grad.abs().max()) > 0

    @pytest.mark.parametrize(
        "change",
        [
            lambda o: o.masks.phase.add_(1.0 * torch.rand(23, 23)),
            lambda o: o.masks.phase.data.mul_(0.5),
            lambda o: setattr(o, "masks", PixelwiseMask(3)),
            lambda o: setattr(o, "camera", ThinLensCamera(pixel_pitch=5e-6)),
            lambda o: setattr(o, "modulator", DwellTimes((1, 4))),
            lambda o: setattr(o, "fidelity", SMALL.replace(window=11)),
            lambda o: o.load_state_dict({"masks.phase": torch.rand(2, 23, 23)}),
        ],
        ids=["in place", "through data", "masks", "camera", "modulator", "fidelity", "state dict"],
    )
    @torch.no_grad()
    def test_feature_never_stale(self, optics, change):
        before = optics.psf_bank().psfs
        change(optics)
        after = optics.psf_bank().psfs
        assert after.shape != before.shape or float((after - before).abs().max()) > 1e-4
        fresh = TiDyOptics(optics.masks, optics.camera, optics.modulator, None, optics.fidelity)
        self.assert_close(after, fresh.psf_bank().psfs, rtol=0, atol=1e-7)

    @torch.no_grad()
    def test_feature_masks_of_a_glass_that_a_buffer_describes(self):
        class Tuned(PixelwiseMask):
            def dispersion(self, wavelength: float) -> float:
                return 1 + float(self.slope) * (wavelength * 1e9 - 530)

        masks = Tuned(1)
        masks.register_buffer("slope", torch.tensor(0.0))
        optics = TiDyOptics(masks, sensor=None, fidelity=SMALL)
        before = optics.psf_bank(defocus=[0.0]).psfs
        masks.slope.fill_(5e-3)
        after = optics.psf_bank(defocus=[0.0]).psfs
        assert torch.equal(after, TiDyOptics(masks, sensor=None, fidelity=SMALL).psf_bank(defocus=[0.0]).psfs)
        assert float((after - before).abs().max()) > 1e-4

    def test_feature_apertures_that_come_and_go_are_told_apart(self, optics):
        """One that is gone leaves its place in memory to another."""
        for index in range(60):
            aperture = torch.rand(23, 23, dtype=torch.float64, generator=torch.Generator().manual_seed(index))
            optics.aperture = aperture
            if index % 2:
                continue
            fresh = TiDyOptics(optics.masks, sensor=None, fidelity=SMALL, aperture=aperture)
            with torch.no_grad():
                assert torch.equal(optics.psf_bank().psfs, fresh.psf_bank().psfs), index

    def test_feature_what_inference_mode_remembers_serves_training(self, optics):
        image, depth = torch.rand(1, 3, 16, 16, requires_grad=True), torch.full((1, 1, 16, 16), 0.5)
        optics.masks.requires_grad_(False)
        with torch.inference_mode():
            expected = optics(image, depth)
        coded = optics(image, depth)
        coded.sum().backward()
        assert image.grad is not None
        self.assert_close(coded, expected)

    def test_feature_what_was_not_used_for_long_goes(self):
        memory, asked = PSFMemory(3 * 40), []

        def make(nodes: tuple[float, ...]) -> tuple[torch.Tensor]:
            asked.append(nodes)
            return (torch.zeros(len(nodes), 5, dtype=torch.float64),)

        for kind in ("one", "two", "three", "one", "four", "one", "two"):
            memory.recall((kind,), (0.0,), make)
        assert len(asked) == 5  # "two" again
        kept = [*memory._held]
        memory.recall(("five",), (0.0, 1.0, 2.0, 3.0), make)  # larger than all that may be kept
        memory.recall(values_of(torch.zeros(31)), (0.0,), make)  # so are masks
        assert [*memory._held] == kept  # and nothing goes for them

    def test_feature_a_stream_of_other_depths_stays_within_the_limit_and_copies_nothing(self):
        memory, made = PSFMemory(10 * 40), []

        def make(nodes: tuple[float, ...]) -> tuple[torch.Tensor]:
            made.append(torch.zeros(len(nodes), 5, dtype=torch.float64))
            return (made[-1],)

        for n in range(40):
            (found,) = memory.recall(("lens",), (float(n),), make)
            assert found.data_ptr() == made[-1].data_ptr()
            held = memory._held[("lens",)]
            assert sum(x.nbytes for own in held.depths.values() for x in own) <= held.nbytes <= 400
        assert len(made) == 40

    def test_feature_threads_together_keep_to_the_limit(self):
        memory, both = PSFMemory(4 * 40), threading.Barrier(4)

        def work(name: int) -> None:
            for n in range(20):
                both.wait(timeout=30)
                memory.recall((name, n), (0.0,), lambda _: (both.wait(timeout=30), torch.zeros(1, 5).double())[1:])

        with ThreadPoolExecutor(4) as pool:
            list(pool.map(work, range(4)))
        assert sum(own.nbytes for own in memory._held.values()) <= memory.most_bytes

    def test_feature_values_of_attributes_that_have_no_hash_are_told_apart(self):
        masks, table = PixelwiseMask(1), torch.ones(2)
        seen = []
        for change in (0.0, 1e-6):
            masks.table = {"settings": [table + change, (1, [2])]}
            seen.append(values_of(masks))
        assert len(set(seen)) == 2

    def test_exception_nothing_is_kept_of_what_could_not_be_made(self):
        memory = PSFMemory()
        with pytest.raises(ZeroDivisionError):
            memory.recall(("one",), (0.0,), lambda _: (torch.ones(1) * (1 // 0),))
        assert not memory._held
