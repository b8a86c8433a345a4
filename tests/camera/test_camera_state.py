"""What a state restores is the camera that was saved, to the last bit; another camera is refused by name."""

from __future__ import annotations

import copy
import io
import math
import pickle
import random

import pytest
import torch
from safetensors.torch import load, save
from torch import nn
from torch.optim.swa_utils import AveragedModel

from kornia_tidy import DwellTimes, Fidelity, PixelwiseMask, PSFBank, SensorNoise, Switching, TiDyOptics
from kornia_tidy.camera import camera_of_state
from kornia_tidy.masks import CubicMask, RadialMask
from kornia_tidy.optics import FUSED_SILICA, SYSTEMS, DefocusRange, Spectrum, ThinLensCamera, circular_aperture
from kornia_tidy.psf.camera_settings import read_settings, write_settings
from kornia_tidy.training.average import MovingAverage
from tests.base import BaseTester

EXTRA = "_extra_state"
IMAGE = torch.rand(1, 3, 72, 72, generator=torch.Generator().manual_seed(1))


def scene(optics: TiDyOptics) -> tuple[torch.Tensor, torch.Tensor]:
    lo, hi = optics.camera.defocus_range
    defocus = torch.linspace(lo, hi, 72 * 72, dtype=torch.float64)[1:-1]
    defocus = torch.cat([defocus[:1], defocus, defocus[-1:]]).reshape(1, 1, 72, 72)
    return IMAGE, optics.camera.depth(defocus).float()


@torch.no_grad()
def capture(optics: TiDyOptics) -> torch.Tensor:
    return optics(*scene(optics), generator=torch.Generator().manual_seed(2))


def preset(name: str, seed: int = 0) -> TiDyOptics:
    return TiDyOptics.from_preset(name, generator=torch.Generator().manual_seed(seed))


@torch.no_grad()
def trained(optics: TiDyOptics) -> TiDyOptics:
    """The camera with masks that have moved since its window was chosen."""
    for parameter in optics.parameters():
        parameter.mul_(0.3)
    return optics


def small(**changes) -> TiDyOptics:
    options = {"masks": PixelwiseMask(2, generator=torch.Generator().manual_seed(0)), "fidelity": "draft", **changes}
    return TiDyOptics(**options)


def stored(state: dict, way: str) -> dict:
    """A state that went through a file."""
    if way == "safetensors":
        return load(save(state))
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


@pytest.fixture(scope="module", params=list(SYSTEMS))
def saved(request):
    optics = trained(preset(request.param))
    return request.param, optics, capture(optics)


class TestTheSameCamera(BaseTester):
    """Each time against a camera that measured its window before its masks moved, as training leaves it."""

    def test_feature_its_own_state_changes_nothing(self, saved):
        _, optics, before = saved
        window, held = optics.window, optics.light_held
        for strict in (True, False):
            keys = optics.load_state_dict(optics.state_dict(), strict=strict)
            assert not keys.missing_keys
            assert not keys.unexpected_keys
            assert (optics.window, optics.light_held) == (window, held)
        assert torch.equal(capture(optics), before)

    def test_feature_a_file_restores_it_in_another_process_s_camera(self, saved):
        name, optics, before = saved
        other, states = preset(name, seed=5), [stored(optics.state_dict(), way) for way in ("torch", "safetensors")]
        assert all(torch.equal(value, states[1][key]) for key, value in states[0].items())
        other.load_state_dict(states[1])
        assert torch.equal(capture(other), before)

    @pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
    def test_feature_copies_and_pickles_are_it(self, saved, duplicate):
        _, optics, before = saved
        twin = duplicate(optics)
        assert torch.equal(capture(twin), before)
        assert torch.equal(capture(optics), before)

    def test_feature_the_window_had_changed_in_the_systems_that_learn(self):
        """Or the tests above would show nothing."""
        changed = 0
        for name in SYSTEMS:
            optics = trained(preset(name))
            before = optics.window
            changed += before != optics.fit_window()
        assert changed >= 6

    def test_feature_windows_of_any_size_fill_the_same_bytes(self):
        """So that distributed checkpoints, which read into tensors of one size, can be read."""
        optics = preset("tidy-5")
        before = optics.state_dict()[EXTRA]
        trained(optics).fit_window()
        after = optics.state_dict()[EXTRA]
        assert before.shape == after.shape
        assert not torch.equal(before, after)
        assert before.dtype == torch.uint8

    @pytest.mark.parametrize("wrap", ["module", "sequential", "average"])
    def test_feature_it_may_be_part_of_another_module(self, wrap):
        class Pipeline(nn.Module):
            def __init__(self, optics):
                super().__init__()
                self.head, self.optics = nn.Conv2d(3, 3, 3), optics

        make = {"module": Pipeline, "sequential": nn.Sequential, "average": AveragedModel}[wrap]

        def camera(whole):
            return next(m for m in whole.modules() if isinstance(m, TiDyOptics))

        one, two = make(trained(preset("tidy-1"))), make(preset("tidy-1", 5))
        two.load_state_dict(stored(one.state_dict(), "torch"))
        assert torch.equal(capture(camera(two)), capture(camera(one)))

    def test_feature_an_aperture_is_in_it_while_it_is_learnt(self):
        optics, aperture = small(), circular_aperture(23, 0.1)
        for given in (nn.Parameter(aperture), None, nn.Parameter(aperture), aperture):
            optics.aperture = given
            learnt = isinstance(given, nn.Parameter)
            assert ("aperture.amplitude" in optics.state_dict()) == learnt == ("aperture" in optics._modules)

    def test_feature_one_state_of_it(self):
        one, two = (TiDyOptics(PixelwiseMask(2), fidelity="draft") for _ in range(2))
        trained(one)
        with torch.no_grad():
            two.load_state_dict(one.state_dict())
            assert torch.equal(one.psf_bank().psfs, two.psf_bank().psfs)
            view = two.through_state(1)
            view.load_state_dict(one.through_state(1).state_dict())
            assert torch.equal(view.psf_bank().psfs, one.through_state(1).psf_bank().psfs)
        with pytest.raises(ValueError, match="another camera: state is None in the state and 1 here"):
            view.load_state_dict(one.state_dict())

    def test_feature_measured_psfs(self):
        bank = PSFBank.from_measured(torch.rand(2, 3, 5, 5), torch.tensor([-20.0, 20.0]))
        one, two = (small().with_bank(bank) for _ in range(2))
        two.load_state_dict(stored(one.state_dict(), "torch"))
        assert torch.equal(capture(one), capture(two))
        other = PSFBank.from_measured(torch.rand(2, 3, 5, 5), torch.tensor([-20.0, 20.0]))
        with pytest.raises(ValueError, match=r"measured PSFs is 'sha256 \w{16}' in the state and 'sha256 \w{16}' here"):
            small().with_bank(other).load_state_dict(one.state_dict())
        with pytest.raises(ValueError, match=r"measured PSFs is 'sha256 \w{16}' in the state and None here"):
            small().load_state_dict(one.state_dict())

    def test_feature_averages(self):
        optics = small()
        swa, ours = AveragedModel(optics, use_buffers=True), MovingAverage(optics, 0.9)
        for _ in range(3):
            trained(optics)
            optics.fit_window()  # of another length in words: no average may fail over it
            swa.update_parameters(optics)
            ours.update(optics)
        for average in (swa, ours):
            fresh = type(average)(small())
            fresh.load_state_dict(stored(average.state_dict(), "torch"))
            camera, other = (next(m for m in x.modules() if isinstance(m, TiDyOptics)) for x in (average, fresh))
            assert torch.equal(capture(camera), capture(other))


OTHERS = [
    ("camera", {"camera": ThinLensCamera(pixel_pitch=9e-6)}, "pixel_pitch is 9e-06 in the state and 8e-06 here"),
    ("no depths", {"camera": DefocusRange()}, "camera is a DefocusRange in the state and a ThinLensCamera here"),
    ("depths", {"camera": ThinLensCamera(depth_range=(0.4, math.inf))}, r"depth_range is \[0.4, inf\] in the state"),
    ("focus", {"camera": ThinLensCamera(focus_distance=torch.tensor(0.595))}, "focus_distance is not set in the"),
    ("modulator", {"modulator": Switching(4e-3)}, "modulator is a Switching in the state and a DwellTimes here"),
    ("dwell", {"modulator": DwellTimes((3, 1))}, r"modulator.shares is \[0.75, 0.25\] in the state and None here"),
    ("sensor", {"sensor": SensorNoise(0.02)}, "sensor.sigma is 0.02 in the state and 0.01 here"),
    ("no sensor", {"sensor": None}, "sensor is None in the state and a SensorNoise here"),
    ("fidelity", {"fidelity": "balanced"}, r"fidelity.pixel_tolerance is 0.01 in the state and 0.1 here"),
    ("spectrum", {"spectrum": Spectrum((6e-7, 5e-7, 4e-7), torch.eye(3).tolist())}, r"wavelengths is \[6e-07, "),
    ("compositing", {"compositing": "scatter"}, "compositing is 'scatter' in the state and 'gather' here"),
    ("colour", {"color_space": "linear"}, "color_space is 'linear' in the state and 'srgb' here"),
    ("border", {"border": "zero"}, "border is 'zero' in the state and 'reflect' here"),
    ("aperture", {"aperture": 0.9 * circular_aperture(23, 0.12)}, "aperture is a tensor .* and None here"),
    ("family", {"masks": RadialMask(2)}, "masks is a RadialMask in the state and a PixelwiseMask here"),
    ("limits", {"masks": PixelwiseMask(2, constraint="clamp")}, "constraint is 'clamp' in the state and 'none' here"),
    ("material", {"masks": PixelwiseMask(2, material=FUSED_SILICA)}, r"masks.material.dispersion is "),
    ("pixels", {"masks": PixelwiseMask(2, (23, 31))}, r"mask_pixels is \[23, 31\] in the state and \[23, 23\] here"),
]


class TestAnotherCamera(BaseTester):
    @pytest.mark.parametrize("strict", [True, False])
    @pytest.mark.parametrize(("changes", "sentence"), [o[1:] for o in OTHERS], ids=[o[0] for o in OTHERS])
    def test_exception_it_is_refused_by_name_before_a_weight_is_changed(self, changes, sentence, strict):
        state, optics = small(**changes).state_dict(), small()
        before = {name: value.clone() for name, value in optics.state_dict().items()}
        with pytest.raises(ValueError, match=sentence) as told:
            optics.load_state_dict(state, strict=strict)
        assert "\n" not in str(told.value)
        assert all(torch.equal(value, before[name]) for name, value in optics.state_dict().items())

    @pytest.mark.parametrize(("name", "changes"), [o[:2] for o in OTHERS], ids=[o[0] for o in OTHERS])
    def test_feature_its_settings_are_taken_over_where_a_file_can_tell_them(self, name, changes):
        saved, optics = trained(small(**changes)), small()
        before = optics.settings()
        if name in {"no depths", "focus", "modulator", "no sensor", "family", "material", "pixels"}:
            with pytest.raises(ValueError, match=r"settings cannot be taken over: .* in the state and .* here"):
                optics.load_state_dict(saved.state_dict(), take_over=True)
            assert optics.settings() == before
            return
        optics.load_state_dict(stored(saved.state_dict(), "torch"), take_over=True)
        assert optics.settings() == saved.settings()
        assert optics.fidelity == saved.fidelity
        saved.check_inputs = optics.check_inputs = False
        assert torch.equal(capture(optics), capture(saved))

    def test_exception_a_window_that_is_fixed_otherwise(self):
        fixed = Fidelity.preset("draft").replace(window=9)
        with pytest.raises(ValueError, match="its PSF window is 39 px, and this one's is fixed to 9 px"):
            small(fidelity=fixed).load_state_dict(small().state_dict())
        optics = small()
        optics.load_state_dict(small(fidelity=fixed).state_dict())  # what was fixed there may be held here
        assert optics.window == 9

    def test_feature_another_size_of_machine_or_name_is_the_same_camera(self):
        optics = small(
            fidelity=Fidelity.preset("draft").replace(name="mine"), memory_budget=1 << 20, check_inputs=False
        )
        small().load_state_dict(optics.state_dict())

    def test_exception_nothing_to_take_over(self):
        with pytest.raises(ValueError, match=r"the state has no entry .*, only x"):
            small().load_state_dict({"x": torch.ones(1)}, take_over=True)

    @pytest.mark.parametrize(
        ("part", "name", "value", "sentence"),
        [
            ("camera", "focal_length", 0, "focal_length must be positive"),
            ("camera", "focus_distance", -1.0, "focus_distance must be beyond the focal length"),
            ("camera", "depth_range", [1.0, 0.5], "depth_range must be"),
            ("camera", "defocus_range", [1e30, -1e30], "defocus_range must be .* lo < hi"),
            ("camera", "pixel_pitch", None, "pixel_pitch must be a number"),
            ("fidelity", "layer_spacing", 1e-9, "layers of PSFs"),
            ("masks", "constraint", "none of them", "constraint must be one of"),
            ("masks", "max_phase", math.nan, "max_phase must be positive"),
            ("modulator", "shares", [-1.0, 2.0], "dwell shares must be"),
            ("sensor", "full_well", 0, "full_well must be positive"),
            ("sensor", "bits", 8.5, "bits must be a whole number"),
        ],
    )
    def test_exception_settings_that_no_camera_can_have_change_nothing(self, part, name, value, sentence):
        optics, fixed = small(modulator=DwellTimes((1, 2))), Fidelity(window=9)
        before, settings = copy.deepcopy(optics.state_dict()), optics.settings()
        state = trained(small(modulator=DwellTimes((3, 1)), fidelity=fixed)).state_dict()
        saved = read_settings(state[EXTRA])
        saved[part][name] = value
        damaged = {**state, EXTRA: write_settings(saved)}
        for load_it in (camera_of_state, lambda state: optics.load_state_dict(state, take_over=True)):
            with pytest.raises(ValueError, match=sentence):
                load_it(damaged)
        assert optics.settings() == settings
        assert all(torch.equal(optics.state_dict()[key], value) for key, value in before.items())

    def test_exception_a_damaged_state_tells_so(self):
        state, flips = small().state_dict(), random.Random(0)
        length = len(state[EXTRA].numpy().tobytes().rstrip())
        for _ in range(100):
            damaged = state[EXTRA].clone()
            damaged[flips.randrange(length)] ^= 1 << flips.randrange(8)
            with pytest.raises(ValueError, match="cannot read the camera's settings in the state"):
                small_twin.load_state_dict({**state, EXTRA: damaged})
        for other in (state[EXTRA].float(), state[EXTRA][:100], torch.zeros(0, dtype=torch.uint8), {}):
            with pytest.raises(ValueError, match="cannot read the camera's settings in the state"):
                small_twin.load_state_dict({**state, EXTRA: other})

    def test_exception_an_aperture_of_more_pixels_than_are_written(self):
        state = small(aperture=0.9 * circular_aperture(23, 0.12)).state_dict()
        saved = read_settings(state[EXTRA])
        saved["aperture"]["shape"] = [1, (1 << 16) + 1]
        with pytest.raises(ValueError, match=r"a tensor of \[1, 65537\] is too large for settings"):
            camera_of_state({**state, EXTRA: write_settings(saved)})

    def test_exception_settings_nested_deeper_than_python_can_read(self):
        import zlib

        text = b"[" * 100_000
        deep = torch.frombuffer(bytearray(b"%08x" % zlib.crc32(text) + text), dtype=torch.uint8)
        with pytest.raises(ValueError, match="cannot read the camera's settings"):
            small_twin.load_state_dict({**small_twin.state_dict(), EXTRA: deep})


small_twin = small()


class TestWeightsAlone(BaseTester):
    """What masks are saved as, and what versions wrote that did not save settings."""

    @pytest.mark.parametrize("strict", [True, False])
    def test_feature_the_window_is_measured_for_them(self, strict):
        optics, masks = small(), PixelwiseMask(2, initial="flat")
        keys = optics.load_state_dict({"masks.phase": masks.phase.detach()}, strict=strict)
        assert not keys.missing_keys
        assert optics.window == small(masks=masks).window < 39

    def test_feature_as_part_of_another_module_too(self):
        model = nn.Sequential(small(), nn.Conv2d(3, 3, 1))
        state = {name: value for name, value in model.state_dict().items() if not name.endswith(EXTRA)}
        state["0.masks.phase"] = torch.zeros(2, 23, 23)
        model.load_state_dict(state)
        assert model[0].window == small(masks=PixelwiseMask(2, initial="flat")).window

    def test_feature_the_state_of_a_network_alone_leaves_the_camera_as_it_is(self):
        model = nn.Sequential(trained(small()), nn.Conv2d(3, 3, 1))
        before = capture(model[0])
        keys = model.load_state_dict({"1.weight": torch.ones(3, 3, 1, 1)}, strict=False)
        assert "0.masks.phase" in keys.missing_keys
        assert torch.equal(capture(model[0]), before)

    def test_feature_missing_and_unknown_keys_are_reported_as_ever(self):
        optics = small(masks=CubicMask([20.0]))
        keys = optics.load_state_dict({"sensor.x": torch.ones(1), EXTRA: optics.state_dict()[EXTRA]}, strict=False)
        assert keys.missing_keys == ["masks.strength"]
        assert keys.unexpected_keys == ["sensor.x"]
        with pytest.raises(RuntimeError, match=r'Missing key\(s\) in state_dict: "masks.strength"'):
            optics.load_state_dict({EXTRA: optics.state_dict()[EXTRA]})
