"""Derivatives beyond the first backward pass: second ones, the transforms of torch.func; and what cannot be traced."""

from __future__ import annotations

import copy
import warnings

import pytest
import torch
from torch import Tensor, nn
from torch.autograd import forward_ad
from torch.func import functional_call, grad, jvp, linearize, vmap

from kornia_tidy import Fidelity, PixelwiseMask, SensorNoise, TiDyOptics
from kornia_tidy.kernels.build import compiled
from kornia_tidy.kernels.occlusion_ops import SOURCE
from kornia_tidy.render.compositing import COMPOSITING
from tests.base import BaseTester

OPTIONS = {"window": 9, "layer_spacing": 10.0, "double": True}
FIDELITIES = {
    "veil": Fidelity(stray_light="veil", **OPTIONS),
    "renormalize": Fidelity(**OPTIONS),
    "nearest": Fidelity(layers="nearest", **OPTIONS),
    "bandlimited": Fidelity(layers="bandlimited", **{**OPTIONS, "layer_spacing": 2.0}),
    "mean": Fidelity(occlusion_states="mean", **OPTIONS),
}
over_compositing = pytest.mark.parametrize("compositing", COMPOSITING)


def camera(compositing: str = "gather", fidelity: Fidelity = FIDELITIES["veil"], **options) -> TiDyOptics:
    options = {"color_space": "linear", "sensor": None, **options}
    optics = TiDyOptics(PixelwiseMask(2), fidelity=fidelity, compositing=compositing, **options)
    return optics.double()


def scene(height: int = 12, width: int = 20) -> tuple[Tensor, Tensor]:
    image, depth = torch.rand(1, 3, height, width), 0.4 + torch.rand(1, 1, height, width)
    return image.double(), depth.double()


def masks_of(optics: TiDyOptics) -> dict[str, Tensor]:
    return {name: value.detach().clone() for name, value in optics.named_parameters()}


def moved(masks: dict[str, Tensor], way: dict[str, Tensor], step: float) -> dict[str, Tensor]:
    return {name: value + step * way[name] for name, value in masks.items()}


def ways(masks: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: torch.randn_like(value) for name, value in masks.items()}


def slopes(loss, masks: dict[str, Tensor], *, again: bool = False) -> dict[str, Tensor]:
    leaves = {name: value.requires_grad_() for name, value in masks.items()}
    return dict(zip(leaves, torch.autograd.grad(loss(leaves), list(leaves.values()), create_graph=again), strict=True))


class TestDepth(BaseTester):
    @pytest.mark.takes_seconds
    def test_feature_gradients_to_depth_are_as_exact_as_the_documentation_says(self):
        """Dense linear layers are the reference, which differences of captures confirm."""
        ramp = torch.linspace(0, 1, 24, dtype=torch.float64)
        depth = 1 / (3.3 - 2.5 * (ramp[:, None] + ramp) / 2)[None, None]
        generator = torch.Generator().manual_seed(0)
        image, weights = (torch.rand(1, 3, 24, 24, generator=generator).double() for _ in range(2))
        masks = PixelwiseMask(1, generator=generator)

        def loss(depth: Tensor, layers: str = "linear", spacing: float = 1 / 16) -> Tensor:
            fidelity = Fidelity(window=17, layers=layers, layer_spacing=spacing, double=True)
            optics = TiDyOptics(masks, fidelity=fidelity, color_space="linear", sensor=None)
            return ((weights - 0.5) * optics(image, depth)).sum()

        def gradient(*layers) -> Tensor:
            moved = depth.clone().requires_grad_()
            return torch.autograd.grad(loss(moved, *layers), moved)[0]

        truth = gradient()
        step = 1e-2 * truth / truth.norm()  # many layers, whose PSFs are exact
        with torch.no_grad():
            assert float(loss(depth + step) - loss(depth - step)) == pytest.approx(2e-2 * float(truth.norm()), rel=2e-2)
        errors = {
            layers: float((gradient(layers, 2.0) - truth).norm() / truth.norm()) for layers in ("linear", "bandlimited")
        }
        assert errors["bandlimited"] < 0.08
        assert 0.24 < errors["linear"] < 0.4


class TestSecondDerivatives(BaseTester):
    """Hessian-vector products of the masks against central differences of the gradient.

    With steps of 1e-4 rad differences are off by 1e-8 times a fourth derivative, of the order of the second, and by
    rounding of the gradient over the step, 1e-16 / 1e-4 times the sums that it is made of.
    """

    @pytest.mark.parametrize("fidelity", FIDELITIES.values(), ids=FIDELITIES)
    @over_compositing
    def test_feature_they_are_those_of_the_capture(self, compositing, fidelity):
        self.check(camera(compositing, fidelity), "linear", *scene())

    @pytest.mark.filterwarnings("ignore::kornia_tidy.psf.paper.AliasingWarning")
    def test_feature_of_the_papers_discretisation(self):
        fidelity = Fidelity.preset("paper").replace(layer_spacing=10.0, double=True)
        self.check(camera("gather", fidelity, color_space="paper"), "square", *scene(24, 26))

    @over_compositing
    @pytest.mark.parametrize("border", ["zero", "circular", "valid"])
    def test_feature_at_every_border(self, compositing, border):
        self.check(camera(compositing, border=border), "square", *scene())

    def check(self, optics: TiDyOptics, loss: str, image: Tensor, depth: Tensor) -> None:
        masks = masks_of(optics)
        target = torch.rand(1, generator=torch.Generator().manual_seed(1)).double()

        def value(parameters):
            coded = functional_call(optics, parameters, (image, depth))
            pattern = torch.linspace(-1, 1, coded.numel(), dtype=coded.dtype).sin().view(coded.shape)
            return (coded * pattern).sum() if loss == "linear" else ((coded - target).square() * pattern).sum()

        way = ways(masks)
        first = slopes(value, masks, again=True)
        along = sum((first[name] * way[name]).sum() for name in masks)
        found = torch.autograd.grad(along, list(masks.values()))
        sides = [slopes(value, moved(masks_of(optics), way, step)) for step in (1e-4, -1e-4)]
        for name, product in zip(masks, found, strict=True):
            expected = (sides[0][name] - sides[1][name]) / 2e-4
            scale = float(expected.abs().max())
            assert scale > 0
            self.assert_close(product, expected, rtol=0, atol=1e-4 * scale)

    @pytest.mark.parametrize("layers", ["linear", "nearest"])
    @pytest.mark.parametrize("way", ["compiled", "batched"])
    @over_compositing
    def test_gradgradcheck(self, compositing, way, layers):
        """Of image, defocus, PSFs and veil."""
        if way == "compiled" and compiled(SOURCE, torch.float64) is None:
            pytest.skip("there is no C compiler")
        image, psfs = torch.rand(1, 1, 8, 16).double(), torch.rand(3, 1, 3, 3).double()
        defocus = torch.tensor([-4.5, -1.0, 2.2, 3.9]).double()[torch.randint(4, (1, 1, 8, 16))]
        nodes, veil = torch.tensor([-5.0, 0.0, 5.0]).double(), 0.1 * torch.rand(3, 1).double()
        inputs = [x.requires_grad_() for x in (image, psfs, veil)]
        if layers == "linear":
            inputs.append(defocus.requires_grad_())

        def rendered(image, psfs, veil, defocus=defocus):
            options = {"layers": layers, "border": "replicate", "method": way}
            return COMPOSITING[compositing](image, defocus, nodes, psfs, veil, **options)

        assert torch.autograd.gradgradcheck(rendered, inputs, fast_mode=True)

    @over_compositing
    def test_feature_the_first_derivative_is_the_same_whether_or_not_a_second_follows(self, compositing):
        optics, (image, depth) = camera(compositing), scene()
        results = []
        for again in (False, True):
            masks = masks_of(optics)
            results.append(
                slopes(lambda p: functional_call(optics, p, (image, depth)).square().mean(), masks, again=again)
            )
        scale = float(results[0]["masks.phase"].abs().max())
        self.assert_close(results[1]["masks.phase"], results[0]["masks.phase"], rtol=0, atol=1e-11 * scale)


@pytest.mark.filterwarnings("ignore:There is a performance drop:UserWarning", "ignore:.torch.jit:DeprecationWarning")
@over_compositing
class TestTransformsOfTorch(BaseTester):
    def test_feature_jvp_and_dual_numbers_are_the_product_with_the_gradient(self, compositing):
        optics, (image, depth) = camera(compositing), scene()
        masks = masks_of(optics)
        way = ways(masks)

        def loss(masks):
            return functional_call(optics, masks, (image, depth)).square().mean()

        first = grad(loss)(masks)
        expected = sum((first[name] * way[name]).sum() for name in masks)
        self.assert_close(jvp(loss, (masks,), (way,))[1], expected, rtol=1e-9, atol=0)
        with forward_ad.dual_level():
            dual = {name: forward_ad.make_dual(value, way[name]) for name, value in masks.items()}
            slope = forward_ad.unpack_dual(loss(dual)).tangent
        self.assert_close(slope, expected, rtol=1e-9, atol=0)

    def test_feature_vmap_is_a_loop(self, compositing):
        """Over masks, over scenes, and over the gradients of scenes."""
        optics, (image, depth) = camera(compositing), scene()
        masks = masks_of(optics)
        many = {name: torch.stack([value, 0.5 * value, -value]) for name, value in masks.items()}
        images, depths = torch.stack([image, 1 - image]), torch.stack([depth, 1.2 * depth])

        def loss(masks, image, depth):
            return functional_call(optics, masks, (image, depth)).square().mean()

        with torch.no_grad():
            found = vmap(lambda m: functional_call(optics, m, (image, depth)))(many)
            for k, coded in enumerate(found):
                own = functional_call(optics, {name: value[k] for name, value in many.items()}, (image, depth))
                self.assert_close(coded, own, rtol=0, atol=1e-11)
            found = vmap(optics)(images, depths)
            for coded, *one in zip(found, images, depths, strict=True):
                self.assert_close(coded, optics(*one), rtol=0, atol=1e-11)
        found = vmap(grad(loss), in_dims=(None, 0, 0))(masks, images, depths)["masks.phase"]
        for slope, *one in zip(found, images, depths, strict=True):
            own = grad(loss)(masks, *one)["masks.phase"]
            self.assert_close(slope, own, rtol=0, atol=1e-10 * float(own.abs().max()))

    def test_feature_vmap_draws_and_replays_noise(self, compositing):
        optics, (image, depth) = camera(compositing, sensor=SensorNoise(0.01, full_well=60.0)), scene()
        drawn = optics.draw(image)
        with torch.no_grad():
            both = vmap(lambda i: optics(i, depth, params=drawn))(torch.stack([image, image]))
            self.assert_close(both[1], optics(image, depth, params=drawn), rtol=0, atol=1e-9)
            one, other = vmap(lambda i: optics(i, depth), randomness="different")(torch.stack([image, image]))
        assert not torch.equal(one, other)

    @pytest.mark.takes_seconds
    @pytest.mark.filterwarnings("ignore:Attempted to insert a get_attr Node:UserWarning")  # masks are its constants
    def test_feature_linearize_is_the_derivative(self, compositing):
        optics, (image, depth) = camera(compositing), scene()
        way = 1 - image
        with torch.no_grad():
            found = linearize(lambda i: optics(i, depth), image)[1](way)
            self.assert_close(found, jvp(lambda i: optics(i, depth), (image,), (way,))[1], rtol=0, atol=1e-11)

    def test_feature_nothing_of_a_transform_is_remembered(self, compositing):
        """Cameras, kernels and PSFs that were first used within one serve outside of it, to the last bit."""
        optics, (image, depth) = camera(compositing), scene()
        optics.check_inputs = False
        untouched = copy.deepcopy(optics)
        depth[..., :4] = 0.05  # beyond the camera's range
        optics.camera = optics.camera  # window and pupil are found anew, within the transform
        grad(lambda m: functional_call(optics, m, (image, depth)).mean())(masks_of(optics))
        assert optics.clamped_pixels == 48
        with torch.no_grad():
            vmap(lambda i: optics(i, depth))(image[None])
            assert torch.equal(optics(image, depth), untouched(image, depth))
        assert optics.clamped_pixels == 48


@pytest.mark.filterwarnings("ignore:.torch.jit:DeprecationWarning")
class TestTracing(BaseTester):
    @pytest.mark.parametrize("wrapped", [False, True])
    def test_exception_torchscript_is_refused_at_once(self, wrapped):
        optics, sample = camera(), scene()
        part = Wrapper(optics) if wrapped else optics
        for attempt in (lambda: torch.jit.trace(part, sample), lambda: torch.jit.script(part)):
            with pytest.raises(NotImplementedError, match=r"cannot become TorchScript.* torch\.export\.export"):
                attempt()

    def test_exception_psfs_are_not_traced_either(self):
        class PSFs(nn.Module):
            def __init__(self):
                super().__init__()
                self.lens = camera()

            def forward(self, light):
                return light * self.lens.psf_bank(defocus=[0.0]).psfs

        with pytest.raises(NotImplementedError, match="cannot become TorchScript"):
            torch.jit.trace(PSFs(), torch.ones(()))

    @pytest.mark.takes_seconds
    def test_exception_onnx_is_refused_in_a_sentence(self):
        with (
            warnings.catch_warnings(action="ignore"),
            pytest.raises(Exception, match=r"cannot become ONNX, .* torch\.exp"),
        ):
            torch.onnx.export(camera(), scene(), dynamo=True, verbose=False)

    @pytest.mark.slow
    def test_feature_export_gives_the_same_capture(self):
        optics, sample = camera(), scene()
        exported = torch.export.export(optics, sample).module()
        with torch.no_grad():
            self.assert_close(exported(*sample), optics(*sample), rtol=0, atol=1e-11)


class Wrapper(nn.Module):
    def __init__(self, optics):
        super().__init__()
        self.optics = optics

    def forward(self, image: Tensor, depth: Tensor) -> Tensor:
        return self.optics(image, depth)
