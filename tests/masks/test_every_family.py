"""Contract of every mask family: shapes, limits, states, copies, gradients, half precision, compilation."""

from __future__ import annotations

import copy
import math
import pickle

import pytest
import torch
from torch import Tensor

from kornia_tidy import Fidelity, ThinLensCamera, TiDyOptics
from kornia_tidy import masks as package
from kornia_tidy.masks import PhaseMasks
from kornia_tidy.masks.limits import CONSTRAINTS
from kornia_tidy.optics import PMMA, Spectrum, circular_aperture, constant_index
from kornia_tidy.psf import Pupil, exact_psf_bank
from tests.base import BaseTester
from tests.masks.registry import ONE_MASK, OVER_PUPIL, TWO_MASKS

FIDELITY = Fidelity(window=9, layer_spacing=20.0)


@pytest.mark.parametrize("family", TWO_MASKS.values(), ids=TWO_MASKS.keys())
class TestEveryFamily(BaseTester):
    @pytest.mark.parametrize("size", [23, 24, (23, 41), (40, 24)])
    def test_cardinality(self, family, size):
        masks = family(size=size)
        rows, columns = (size, size) if isinstance(size, int) else size
        assert masks.phase.shape == masks.heights().shape == (2, rows, columns)
        assert list(masks.parameters())

    @pytest.mark.parametrize("constraint", CONSTRAINTS)
    def test_gradcheck_from_the_parameters_to_the_psfs(self, family, constraint):
        limit = {} if constraint == "none" else {"max_height": 6e-6}
        masks = family(constraint=constraint, size=8, **limit).double()
        names, values = zip(*masks.named_parameters(), strict=True)
        pupil = Pupil(circular_aperture(8, 2.3 / 8), 2.3 / 8)

        def psfs(*parameters: Tensor) -> Tensor:
            masks._parameters.update(zip(names, parameters, strict=True))
            share = torch.tensor([0.4, 0.6])
            return exact_psf_bank(masks.phase, share, pupil, Spectrum.monochrome(), [1.1], [5.0, -8.0], 2e-7, 5).psfs

        self.gradcheck(psfs, values)

    def test_feature_states_round_trip(self, family):
        masks, other = family(), family()
        with torch.no_grad():
            for parameter in masks.parameters():
                parameter.add_(torch.randn_like(parameter))
        assert not torch.equal(masks.phase, other.phase)
        other.load_state_dict(masks.state_dict())
        assert torch.equal(masks.phase, other.phase)
        assert set(masks.state_dict()) == {name for name, _ in masks.named_parameters()}  # no precomputed tables

    def test_feature_copies_and_pickles(self, family):
        masks = family(constraint="sigmoid")
        for twin in (copy.deepcopy(masks), pickle.loads(pickle.dumps(masks))):
            assert torch.equal(masks.phase, twin.phase)
            with torch.no_grad():
                next(twin.parameters()).add_(1.0)
            assert not torch.equal(masks.phase, twin.phase)

    @pytest.mark.parametrize("constraint", [c for c in CONSTRAINTS if c != "none"])
    def test_feature_heights_stay_within_the_limit_and_still_learn(self, family, constraint):
        masks = family(constraint=constraint, max_height=1.2e-6, material=constant_index(1.45))
        with torch.no_grad():
            for parameter in masks.parameters():
                parameter.mul_(5)
        heights = masks.heights()
        assert 0 <= float(heights.detach().min()) <= float(heights.detach().max()) <= 1.2e-6 * (1 + 1e-6)
        heights.mul(1e6 * torch.randn(heights.shape)).sum().backward()
        for parameter in masks.parameters():
            assert float(parameter.grad.abs().max()) > 0

    def test_feature_the_camera_learns_it(self, family):
        """One Adam step changes every parameter by the learning rate in metres, and lowers the loss."""
        optics = TiDyOptics(family(), fidelity=FIDELITY)
        (group,) = optics.parameter_groups(lr_metres=1e-10)
        assert group["params"] == list(optics.masks.parameters())
        optimizer = torch.optim.Adam([group])
        before = [p.detach().clone() for p in group["params"]]
        loss = -optics.psf_bank().psfs[..., 4, 4].sum()
        loss.backward()
        optimizer.step()
        assert float(-optics.psf_bank().psfs.detach()[..., 4, 4].sum()) < float(loss.detach())
        radians = 1e-10 * math.pi / 530e-9
        for old, new in zip(before, group["params"], strict=True):
            assert float((new - old).detach().abs().max()) == pytest.approx(radians, rel=0.01)

    def test_feature_gradients_of_a_capture_reach_every_parameter(self, family):
        """Through a lens with axial colour and a limit of height."""
        camera = ThinLensCamera(lens_material=PMMA)
        optics = TiDyOptics(family(constraint="sigmoid"), camera, fidelity=FIDELITY)
        coded = optics(torch.rand(1, 3, 16, 20), torch.full((1, 1, 16, 20), 0.5))
        coded.mul(torch.randn(coded.shape)).sum().backward()
        for name, parameter in optics.masks.named_parameters():
            assert float(parameter.grad.abs().max()) > 0, name

    def test_feature_half_precision_keeps_the_height(self, family):
        """To eight roundings of the largest height; heights in metres in half precision would lose all."""
        masks: PhaseMasks = family()
        before = masks.heights().detach()
        after = masks.half().heights().detach()
        assert after.dtype == torch.float32
        assert float((after - before).abs().max()) < 8 * 2**-11 * float(before.abs().max())

    @pytest.mark.filterwarnings("ignore:.*should not be instantiated:DeprecationWarning")  # by the compiler itself
    def test_dynamo(self, family):
        masks = family(constraint="clamp")
        compiled = torch.compile(lambda: masks.heights() * 1e6, fullgraph=True, backend="eager")
        assert torch.equal(compiled(), masks.heights() * 1e6)


@pytest.mark.parametrize("name", OVER_PUPIL)
@pytest.mark.parametrize("size", [(23, 41), (41, 23)])
class TestLongerMasks(BaseTester):
    def test_feature_a_longer_side_changes_nothing_over_the_pupil(self, name, size):
        square, longer = TWO_MASKS[name](), TWO_MASKS[name](size=size)
        longer.load_state_dict(square.state_dict())
        one, two = (TiDyOptics(masks, fidelity=FIDELITY).psf_bank().psfs for masks in (square, longer))
        self.assert_close(one, two)


class TestRegistry(BaseTester):
    def test_feature_every_family_is_in_it(self):
        """A test file that names no masks would leave its family out of the tests above."""
        kinds = [kind for kind in vars(package).values() if isinstance(kind, type)]
        families = {kind for kind in kinds if issubclass(kind, PhaseMasks) and kind is not PhaseMasks}
        single = [make(torch.Generator().manual_seed(0)) for make in ONE_MASK.values()]
        assert {type(masks) for masks in single} == families
        learning = {type(masks) for masks in single if list(masks.parameters())}
        assert {type(make()) for make in TWO_MASKS.values()} == learning
