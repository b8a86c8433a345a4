"""The library against an independent model of the whole camera, ``tests/oracle``: PSFs, captures, noise."""

from __future__ import annotations

import ast
import math
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.special import fresnel, sici

from kornia_tidy import DwellTimes, Fidelity, PixelwiseMask, SensorNoise, Switching, TiDyOptics
from kornia_tidy.masks import CubicMask, PhaseMasks, ZernikeMask
from kornia_tidy.optics import FUSED_SILICA, DefocusRange, Spectrum, ThinLensCamera
from kornia_tidy.render.borders import BORDERS
from tests import oracle
from tests.base import BaseTester
from tests.base import oracle as shared_oracle

REFERENCE = Fidelity.preset("reference")
COMPOSITINGS = ("gather", "scatter", "occlusion")
PROMISED = 1e-6  # L1 error of PSFs of "reference" relative to the light in their window, see Fidelity.pixel_tolerance
HEIGHT, WIDTH = 24, 20
RADIUS, FOCUS = 2.835e-3 / 2, 0.595  # m, of the default camera
PIXEL = RADIUS * 8e-6 / oracle.image_distance(50e-3, FOCUS)  # m; a sensor pixel in the pupil
# A channel is a mixture of two wavelengths, of which they share the middle one.
RESPONSE = ((0.0, 1.0, 3.0), (1.0, 2.0, 0.0), (4.0, 1.0, 0.0))
WAVELENGTHS = (470e-9, 540e-9, 620e-9)


def heights(masks: PhaseMasks, index: float = 1.5) -> np.ndarray:
    """Heights in metres for a refractive index at 530 nm, in float64 (those of the library are float32)."""
    return masks.phase.detach().double().numpy() * 530e-9 / (2 * math.pi * (index - 1))


def scene() -> tuple[np.ndarray, np.ndarray]:
    """An image, sRGB of all values, and depths over the camera's range, from 0.3 m to infinity, with sharp edges."""
    random = np.random.default_rng(4)
    image = random.uniform(0, 1, (3, HEIGHT, WIDTH)) ** 3
    psi = random.uniform(-20, 19.9, (HEIGHT, WIDTH))
    psi[6:17, 5:12] = 15.0
    depth = 1 / (psi * 530e-9 / (math.pi * RADIUS**2) + 1 / FOCUS)
    depth[0, :3] = math.inf
    return image, depth


def capture_of(optics: TiDyOptics, image: np.ndarray, depth: np.ndarray) -> np.ndarray:
    with torch.no_grad():
        return optics(torch.from_numpy(image), torch.from_numpy(depth)[None]).numpy()


@torch.no_grad()
def psfs_of_states(optics: TiDyOptics) -> np.ndarray:
    return np.stack([optics.through_state(k).psf_bank().psfs.numpy() for k in range(len(optics.masks.phase))])


class TestOracle(BaseTester):
    """The oracle itself against closed forms and, if there is one, another model."""

    def test_feature_it_imports_numpy_and_nothing_of_ours(self):
        allowed = {"__future__", "collections.abc", "functools", "math", "numpy"}
        for path in Path(oracle.__file__).parent.glob("*.py"):
            nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
            names = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
            names |= {str(node.module) for node in nodes if isinstance(node, ast.ImportFrom)}
            assert {name for name in names if not name.startswith("tests.oracle")} <= allowed

    @pytest.mark.parametrize("psi", [0.0, 7.0, -40.0])
    def test_feature_a_square_pupil_gives_fresnel_integrals(self, psi):
        """Pixels so small that they sample; the field is the integral of exp(i psi x^2 - 2 pi i u x) for each axis."""
        step = 1e-4
        psf = oracle.psfs(
            np.zeros((1, 8, 8)), [1.0], [psi], 530e-9, 5, step * 530e-9, pitch=0.25, aperture=np.ones((8, 8))
        )
        u = (np.arange(5) - 2) * step
        if psi == 0:
            wave = 2 * np.sinc(2 * u)
        else:  # completed to a square: x - pi u / psi
            scale = math.sqrt(2 * abs(psi) / math.pi)
            upper, lower = fresnel(scale * (1 - math.pi * u / psi)), fresnel(scale * (-1 - math.pi * u / psi))
            wave = np.abs((upper[1] - lower[1]) + 1j * (upper[0] - lower[0])) / scale
        expected = np.outer(wave, wave) ** 2 * step**2 / 4
        # Ripples have two cycles at most: the mean over a pixel is off by (4 pi step)^2 / 24 for each axis.
        assert np.abs(psf[0] - expected).max() < (14 * step**2 + 1e-8) * 16 * step**2 / 4

    def test_feature_pixels_add_up_the_light_that_falls_on_them(self):
        """The integral of sinc^2 has a closed form: a square pupil in focus, pixels of 0.44 cycles a radius."""
        step = 0.44
        psf = oracle.psfs(
            np.zeros((1, 4, 4)), [1.0], [0.0], 530e-9, 7, step * 530e-9, pitch=0.5, aperture=np.ones((4, 4))
        )
        edges = 2 * (np.arange(8) - 3.5) * step
        held = sici(2 * math.pi * edges)[0] / math.pi - np.sin(math.pi * edges) ** 2 / (math.pi**2 * edges)
        assert np.abs(psf[0] - np.outer(np.diff(held), np.diff(held))).max() < 1e-8

    def test_feature_coarser_points_change_no_more_than_their_bounds(self):
        height = np.random.default_rng(3).uniform(0, 1.2e-6, (1, 23, 23))
        first, second = (
            oracle.psfs(height, [1.0], [20.0], 470e-9, 5, PIXEL, errors=(error, error)) for error in (1e-8, 1e-10)
        )
        cycles = 5 * PIXEL / 470e-9
        bound = 4 * 1e-8 * cycles * math.sqrt(3.17 * second.sum()) + 2 * 1e-8 * cycles**2 * 3.17  # see oracle.psfs
        assert np.abs(first - second).sum() < bound

    def test_feature_psfs_agree_with_the_shared_model(self):
        """Its midpoint sums err as the square of the spacing: twice the points leave a third of what they change."""
        other, lens = shared_oracle(), (8e-6, RADIUS, oracle.image_distance(50e-3, FOCUS))
        height = np.random.default_rng(5).uniform(0, 1.2e-6, (2, 23, 23))
        coarse, fine = (other.physical_psf(height[0], 9.0, 530e-9, 7, *lens, samples=n, subpixels=n) for n in (8, 16))
        own = oracle.psfs(height[:1], [1.0], [9.0], 530e-9, 7, PIXEL)[0]
        assert np.abs(fine - own).sum() < 0.5 * np.abs(fine - coarse).sum() < 0.01 * own.sum()
        assert np.abs(fine + (fine - coarse) / 3 - own).sum() < 0.1 * np.abs(fine - own).sum()
        psi = [-14.0, 0.0, 9.0]
        assert np.abs(other.paper_psfs(height, psi) - oracle.paper_psfs(height, psi)).max() < 1e-14

    def test_feature_defocus_and_dwell_times_agree_with_the_shared_model(self):
        other, depth = shared_oracle(), np.array([0.3, 0.595, 2.0, math.inf])
        assert np.abs(other.defocus(depth, RADIUS, FOCUS) - oracle.defocus(depth, RADIUS, FOCUS)).max() < 1e-12
        ours, theirs = oracle.switching_shares(5, 0.1, 8e-3), other.switching_weights(5, 0.1, 8e-3)
        assert np.abs(np.concatenate(ours) - np.concatenate(theirs)).max() < 1e-15

    @pytest.mark.parametrize("border", ["reflect", "replicate", "zero", "circular"])
    def test_feature_compositing_agrees_with_the_shared_model(self, border):
        other, random, nodes = shared_oracle(), np.random.default_rng(5), [-2.0, 0.0, 3.0, 9.0]
        image, psi = random.uniform(size=(3, HEIGHT, WIDTH)), random.uniform(-3, 10, (HEIGHT, WIDTH))
        bank = random.uniform(size=(4, 3, 7, 7))
        bank /= bank.sum((2, 3), keepdims=True)
        label, weights = other.nearest(psi, nodes), oracle.layer_weights(psi, nodes, "nearest")
        for name, near_first in (("gather", ()), ("scatter", ()), ("occlusion", ([3, 2, 1, 0],))):
            theirs = getattr(other, name)(image, label, bank, *near_first, border=border)
            ours = oracle.capture(image, weights, bank[None], [1.0], name, border, "discard")
            # Its transforms round off by some 1e-15, which occlusion divides by 1e-6 or more.
            assert np.abs(ours - theirs).max() < (1e-9 if near_first else 1e-13)


class TestPSFs(BaseTester):
    @pytest.mark.parametrize(
        ("kind", "wavelength"), [("random", 530e-9), ("Zernike", 610e-9), ("Zernike", 470e-9), ("cubic", 470e-9)]
    )
    def test_feature_reference_keeps_its_promise_over_defocus_and_colour(self, kind, wavelength):
        generator = torch.Generator().manual_seed(2)
        index = oracle.fused_silica if kind == "Zernike" else lambda _: 1.5
        masks = {
            "random": lambda: PixelwiseMask(1, generator=generator),
            "Zernike": lambda: ZernikeMask(1, generator=generator, material=FUSED_SILICA),
            "cubic": lambda: CubicMask(20.0),
        }[kind]()
        fidelity = REFERENCE.replace(window=5, stray_light="discard")
        optics = TiDyOptics(
            masks, DefocusRange(-60, 60), None, None, fidelity, spectrum=Spectrum.monochrome(wavelength)
        )
        for psi in ([-20.0, 0.0, 20.0], [-60.0, 60.0]):
            found = optics.psf_bank(defocus=psi).psfs[:, 0].detach().numpy()
            height = heights(masks, index(530e-9))
            expected = oracle.psfs(
                height, [1.0], psi, wavelength, 5, PIXEL, index=index(wavelength), errors=(1e-10, 1e-11)
            )
            light = expected.sum((1, 2))
            cycles = 5 * PIXEL / wavelength
            own = 4e-10 * cycles * np.sqrt(3.17 / light) + 2e-11 * cycles**2 * 3.17 / light  # see oracle.psfs
            assert (np.abs(found - expected).sum((1, 2)) / light < PROMISED + own).all()

    def test_feature_the_published_discretisation_is_the_sum_it_stands_for(self):
        masks, nodes = PixelwiseMask(3), [-14.0, -3.0, 0.0, 8.0, 14.0]
        optics = TiDyOptics(masks, DefocusRange(-14, 14), fidelity="paper")
        found = optics.psf_bank(dtype=torch.float64, defocus=nodes).psfs.detach().numpy()
        assert np.abs(found - oracle.paper_psfs(heights(masks), nodes)).max() < 1e-12

    @pytest.mark.parametrize(("down", "right"), [(0, 2), (3, 0), (-1, -2)])
    def test_convention_a_phase_that_rises_to_the_right_moves_the_psf_to_the_right(self, down, right):
        """By as many pixels as the ramp has waves over the pupil, in the model as in the library."""
        at = (np.arange(23) - 11) * 0.1
        ramp = PIXEL * (down * at[:, None] + right * at) / 0.5  # metres of an index of 1.5
        masks = PixelwiseMask(initial=torch.from_numpy(ramp))
        fidelity = REFERENCE.replace(window=11, stray_light="discard")
        optics = TiDyOptics(masks, DefocusRange(-2, 2), None, None, fidelity, spectrum=Spectrum.monochrome())
        found = optics.psf_bank(defocus=[0.0]).psfs[0, 0].detach().numpy()
        expected = oracle.psfs(heights(masks), [1.0], [0.0], 530e-9, 11, PIXEL)[0]
        assert divmod(int(found.argmax()), 11) == divmod(int(expected.argmax()), 11) == (5 + down, 5 + right)

    def test_feature_states_between_masks_are_shown_as_long_as_the_model_says(self):
        _, weights = Switching(8e-3)(torch.zeros(5, 3, 3, dtype=torch.float64))
        expected = np.concatenate(oracle.switching_shares(5, 0.1, 8e-3))
        assert np.abs(weights.numpy() - expected).max() < 1e-15


@cache
def model_of_a_camera() -> tuple[PhaseMasks, tuple[float, float], np.ndarray, np.ndarray]:
    """Two masks, their shares, four nodes and the model's PSFs of each mask, (2, 4, 3, 7, 7)."""
    masks = PixelwiseMask(2, generator=torch.Generator().manual_seed(8))
    nodes = np.linspace(oracle.defocus(np.inf, RADIUS, FOCUS), oracle.defocus(np.array(FOCUS / 2), RADIUS, FOCUS), 4)
    states = [
        oracle.channels([oracle.psfs(one[None], [1.0], nodes, w, 7, PIXEL) for w in WAVELENGTHS], np.array(RESPONSE))
        for one in heights(masks)
    ]
    return masks, (0.75, 0.25), nodes, np.stack(states)


class TestCaptures(BaseTester):
    @pytest.mark.parametrize("compositing", COMPOSITINGS)
    @pytest.mark.parametrize("border", BORDERS)
    def test_feature_a_capture_through_known_psfs_is_the_models(self, compositing, border):
        """All that lies between PSFs and capture, for two masks shown for unequal times."""
        masks, shares = PixelwiseMask(2), (0.75, 0.25)
        image, depth = scene()
        psi = oracle.defocus(depth, RADIUS, FOCUS)
        for layers, stray_light, space in (
            ("nearest", "discard", "linear"),
            ("linear", "renormalize", "srgb"),
            ("linear", "veil", "linear"),
        ):
            fidelity = Fidelity(window=11, layers=layers, layer_spacing=13.4, stray_light=stray_light, double=True)
            optics = TiDyOptics(masks, None, DwellTimes(shares), None, fidelity, compositing, space, border)
            states = psfs_of_states(optics.with_fidelity(fidelity.replace(stray_light="discard")))
            weights = oracle.layer_weights(psi, optics.defocus_nodes, layers)
            light = oracle.decode(image) if space == "srgb" else image
            expected = oracle.capture(light, weights, states, shares, compositing, border, stray_light)
            expected = oracle.encode(expected) if space == "srgb" else expected
            found = capture_of(optics, image, depth)
            assert found.shape == expected.shape
            assert np.abs(found - expected).max() < 1e-9, (layers, stray_light)

    @pytest.mark.parametrize("compositing", COMPOSITINGS)
    @pytest.mark.parametrize(
        ("border", "stray_light"),
        [("reflect", "renormalize"), ("zero", "veil"), ("valid", "discard"), ("circular", "veil")],
    )
    def test_feature_a_capture_is_the_models_from_depth_and_heights_alone(self, compositing, border, stray_light):
        """Nothing but the masks' phase is taken from the library; windows of 7 px, channels of two wavelengths each."""
        masks, shares, nodes, states = model_of_a_camera()
        fidelity = REFERENCE.replace(window=7, layers="linear", layer_spacing=13.4, stray_light=stray_light)
        optics = TiDyOptics(
            masks,
            None,
            DwellTimes(shares),
            None,
            fidelity,
            compositing,
            border=border,
            spectrum=Spectrum(WAVELENGTHS, RESPONSE),
        )
        assert np.abs(np.array(optics.defocus_nodes) - nodes).max() < 1e-9
        difference = np.abs(psfs_of_states(optics.with_fidelity(fidelity.replace(stray_light="discard"))) - states)
        off = float((difference.sum((-2, -1)) / states.sum((-2, -1))).max())
        assert off < PROMISED
        image, depth = scene()
        weights = oracle.layer_weights(oracle.defocus(depth, RADIUS, FOCUS), nodes, "linear")
        light = oracle.decode(image)
        expected = oracle.encode(oracle.capture(light, weights, states, shares, compositing, border, stray_light))
        # By as much as a PSF is off, and as much again by its sum or by the stray light that the sum leaves.
        bound = 2 * off + 1e-12
        if compositing == "occlusion":
            # Where each pixel of a PSF is off by a share e, so are light, opacity and normaliser, their quotients by
            # 2 e, and D layers over one another by D (D + 1) e. Round-off is divided by 1e-6 at most.
            e, layers = float((difference / states).max()), len(nodes)
            bound = layers * (layers + 1) * e + layers * 2 * off + 1e-9
        error = np.abs(capture_of(optics, image, depth) - expected).max()
        assert error < 12.92 * bound  # the steepest that sRGB gets

    @pytest.mark.parametrize("kind", ["flat", "noise"])
    def test_feature_reference_captures_depths_between_its_layers(self, kind):
        r"""Three depths between layers; the interpolation error is bounded by the second derivative of a PSF.

        Between layers h apart a straight line is off by h^2 / 8 times the second derivative, and layers are moved by
        half of that to meet it. But for a constant phase the field in the pupil has the derivative i (rho^2 - 1/2) over
        psi, so by Cauchy-Schwarz and Parseval sum |h''| <= 2 sqrt(m4) + 2 m2 of the light, with the mean fourth and
        second powers of rho^2 - 1/2 over the open cells, 0.0142 and 0.0872.
        """
        masks, spectrum = PixelwiseMask(1, initial=kind), Spectrum.monochrome()
        fidelity = REFERENCE.replace(window=7, stray_light="discard")
        optics = TiDyOptics(masks, None, None, None, fidelity, color_space="linear", spectrum=spectrum)
        psi = [-7.77, 0.45, 12.3]
        label = np.add.outer(np.arange(HEIGHT) // 7, np.arange(WIDTH) // 6) % 3
        depth = 1 / (np.array(psi)[label] * 530e-9 / (math.pi * RADIUS**2) + 1 / FOCUS)
        image = scene()[0][:1]
        states = oracle.psfs(heights(masks), [1.0], psi, 530e-9, 7, PIXEL)[None, :, None]
        weights = np.stack([label == d for d in range(3)]).astype(float)
        expected = oracle.capture(image, weights, states, [1.0], "gather", "reflect", "discard")
        error = capture_of(optics, image, depth) - expected
        apart = (optics.defocus_nodes[1] - optics.defocus_nodes[0]) / 3  # of the layers that pixels lie between
        bend = 2 * math.sqrt(0.0142) + 2 * 0.0872
        assert np.abs(error).max() < (1 / 8 + 1 / 16) * bend * apart**2
        assert math.sqrt(np.mean(error**2)) < 1e-4  # as Fidelity says; linear layers as far apart miss it ten times

    def test_feature_the_published_system_is_the_models(self):
        """Nearest layers, turned PSFs as in its code, sRGB taken as light, no renormalising."""
        masks = PixelwiseMask(2)
        optics = TiDyOptics(masks, DefocusRange(-14, 14), None, None, "paper")
        random = np.random.default_rng(6)
        image, disparity = random.uniform(size=(3, HEIGHT, WIDTH)), random.uniform(size=(HEIGHT, WIDTH))
        nodes = np.linspace(-14, 14, 15)
        bank = oracle.paper_psfs(heights(masks), nodes)[..., ::-1, ::-1]
        weights = oracle.layer_weights(28 * disparity - 14, nodes, "nearest")
        expected = oracle.capture(image, weights, bank[None], [1.0], "gather", "reflect", "discard")
        assert np.abs(capture_of(optics, image, disparity) - expected).max() < 1e-9


class TestNoise(BaseTester):
    @pytest.mark.parametrize(
        ("light", "options"),
        [
            (0.3, {"sigma": 0.02, "clip": False}),
            (0.01, {"sigma": 0.02, "clip": True}),
            (0.99, {"sigma": 0.02, "clip": True}),
            (0.4, {"sigma": 0.0, "full_well": 800.0, "clip": False}),
            (0.4, {"sigma": 0.01, "full_well": 800.0, "dark": 20.0, "bits": 10, "clip": False}),
            (0.02, {"sigma": 0.004, "full_well": 300.0, "dark": 3.0, "bits": 8, "clip": True}),
            (0.0, {"sigma": 0.0, "full_well": 300.0, "dark": 3.0, "clip": True}),
        ],
        ids=str,
    )
    def test_feature_mean_and_variance_are_the_models(self, light, options):
        """Within five standard errors, which follow from the model's own second and fourth moments."""
        count = 200_000
        image = torch.full((1, 1, 400, count // 400), light, dtype=torch.float64)
        drawn = SensorNoise(**options)(image, generator=torch.Generator().manual_seed(1))
        mean, variance, fourth = oracle.noise_moments(light, **options)
        assert abs(float(drawn.mean()) - mean) < 5 * math.sqrt(variance / count)
        spread = math.sqrt((fourth - variance**2) / count)
        assert abs(float((drawn - mean).square().mean()) - variance) < 5 * spread

    def test_feature_a_camera_puts_its_noise_into_linear_light(self):
        """A grey wall in focus: the decoded capture has the mean of its light and the deviation of the sensor noise."""
        optics = TiDyOptics(PixelwiseMask(1), ThinLensCamera(), None, SensorNoise(0.01), Fidelity(window=7))
        grey = torch.full((1, 3, 200, 200), 0.6, dtype=torch.float64)
        with torch.no_grad():
            coded = optics(grey, torch.full((1, 1, 200, 200), FOCUS), generator=torch.Generator().manual_seed(1))
        light = oracle.decode(coded.numpy())
        mean, variance, fourth = oracle.noise_moments(float(oracle.decode(np.array(0.6))), 0.01)
        assert abs(light.mean() - mean) < 5 * math.sqrt(variance / light.size)
        assert abs(np.mean((light - mean) ** 2) - variance) < 5 * math.sqrt((fourth - variance**2) / light.size)
