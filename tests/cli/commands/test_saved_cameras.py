"""Commands that take a saved camera write what the camera simulates: every family, limit, modulator and material."""

from __future__ import annotations

import math
from itertools import cycle, product
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from kornia_tidy import Fidelity, PixelwiseMask, PSFBank, SensorNoise, TiDyOptics
from kornia_tidy import optics as optics_package
from kornia_tidy.camera import camera_of_state
from kornia_tidy.cli import main
from kornia_tidy.lab.mask_export import read_slm_frames
from kornia_tidy.masks.limits import CONSTRAINTS
from kornia_tidy.modulator import (
    DiffractionEfficiency,
    DwellTimes,
    GreyLevels,
    LearnableDwellTimes,
    PixelCrosstalk,
    SpatialLightModulator,
    StrokeError,
    Switching,
)
from kornia_tidy.optics import SYSTEMS, DefocusRange, Material, ThinLensCamera, constant_index
from kornia_tidy.psf.camera_settings import read_settings, write_settings
from kornia_tidy.reconstruction.state_file import write_state
from tests.base import BaseTester
from tests.masks.registry import ONE_MASK, TWO_MASKS

# A family that a new test file brings is crossed with all others here.
FIXED = {kind.__name__: kind for kind in map(type, (make(torch.Generator()) for make in ONE_MASK.values()))}
FIXED = {name: kind for name, kind in FIXED.items() if not list(kind().parameters())}
FAMILIES = {**TWO_MASKS, **FIXED}
LIMITED = [(family, limit) for family in FAMILIES for limit in CONSTRAINTS if limit == "none" or family not in FIXED]
MATERIALS = {own.name: own for own in vars(optics_package).values() if isinstance(own, Material)}
MATERIALS["index 1.6"] = constant_index(1.6)
MODULATORS = {
    "none": lambda _: None,
    "dwell": lambda k: DwellTimes(range(1, k + 1)),
    "learnt": lambda k: LearnableDwellTimes(range(1, k + 1)),
    "grey": lambda k: SpatialLightModulator(GreyLevels(5, 4.0), DwellTimes(range(1, k + 1)), fill_factor=0.9),
    "response": lambda _: SpatialLightModulator(
        GreyLevels(4, response=7 * np.linspace(0, 1, 16) ** 1.3), Switching(4e-3, 0.05, "linear", cyclic=True)
    ),
    "all": lambda _: SpatialLightModulator(
        GreyLevels(8), StrokeError(0.95), PixelCrosstalk(0.2), DiffractionEfficiency(0.8)
    ),
}
IN_TURN = [(*pair, name) for pair, name in zip(LIMITED, cycle(MODULATORS), strict=False)]
CROSSED = [
    pytest.param(*pair, name, marks=[] if (*pair, name) in IN_TURN else pytest.mark.takes_seconds)
    for pair, name in product(LIMITED, MODULATORS)
]
FIDELITY = Fidelity(window=9, layer_spacing=20.0)
PANEL = ["--panel", "100x100"]


@torch.no_grad()
def saved(path: Path, family: str, constraint: str, modulator: str, material: str, **options) -> TiDyOptics:
    """A camera with masks that go beyond their limits, and its state in a file."""
    limits = {} if constraint == "none" else {"constraint": constraint, "max_height": 0.9e-6}
    masks = FAMILIES[family](material=MATERIALS[material], **limits)
    for parameter in masks.parameters():
        parameter.mul_(3)
    optics = TiDyOptics(masks, modulator=MODULATORS[modulator](len(masks.phase)), **{"fidelity": FIDELITY, **options})
    save_file(optics.state_dict(), path)
    return optics


def material_of(family: str, constraint: str, modulator: str) -> str:
    places = LIMITED.index((family, constraint)), list(MODULATORS).index(modulator)
    return list(MATERIALS)[sum(places) % len(MATERIALS)]


def panel_of(modulator: nn.Module) -> GreyLevels | None:
    return next((part for part in modulator.modules() if isinstance(part, GreyLevels)), None)


class TestMasks(BaseTester):
    @pytest.mark.parametrize(("family", "constraint", "modulator"), CROSSED)
    def test_feature_heights_and_frames_are_those_that_the_camera_simulates(
        self, family, constraint, modulator, tmp_path
    ):
        """To half a grey level of the panel, or exactly where the camera has one itself. Materials come in turn."""
        path, slm, material = tmp_path / "a.safetensors", tmp_path / "slm", material_of(family, constraint, modulator)
        optics = saved(path, family, constraint, modulator, material)
        assert main(["masks", "export", str(path), "-o", str(path.with_suffix(".npy"))]) == 0
        heights = torch.from_numpy(np.load(path.with_suffix(".npy")))
        # The camera's own heights are float32.
        self.assert_close(heights, optics.masks.heights().detach().double(), rtol=2e-7, atol=1e-15)
        assert main(["masks", "export", str(path), "-o", str(slm), *PANEL]) == 0
        frames, panel = read_slm_frames(slm), panel_of(optics.modulator)
        simulated, allowed = optics.masks.phase.detach().double(), frames.largest_error()
        if panel is not None:
            simulated, allowed = panel(simulated), 0
            assert torch.equal(frames.level_phases, panel.levels)
        apart = torch.remainder(frames.level_phases[frames.grey] - simulated + math.pi, 2 * math.pi) - math.pi
        assert float(apart.abs().max()) <= allowed + 1e-9

    def test_feature_times_are_those_of_the_modulator(self, tmp_path):
        optics = saved(tmp_path / "a.safetensors", "cubic", "none", "response", "PMMA")
        assert (
            main(["masks", "export", str(tmp_path / "a.safetensors"), "-o", str(tmp_path / "slm"), "--panel", "60x60"])
            == 0
        )
        rows = [line.split(",") for line in (tmp_path / "slm" / "timing.csv").read_text().splitlines()]
        dwell = [float(row[rows[0].index("dwell_ms")]) for row in rows[1:]]
        assert dwell == pytest.approx([1e3 * 0.05 * float(t) for t in optics.timeline(torch.float64).durations[:2]])

    def test_feature_at_another_wavelength_the_levels_are_the_camera_s(self, tmp_path):
        path, options = tmp_path / "a.safetensors", [*PANEL, "--wavelength", "610e-9"]
        for modulator in ("grey", "response"):
            optics = saved(path, "pixelwise", "clamp", modulator, "NOA61")
            assert main(["masks", "export", str(path), "-o", str(tmp_path / modulator), *options]) == 0
            levels = panel_of(optics.modulator).levels * optics.masks.dispersion(610e-9)
            self.assert_close(read_slm_frames(tmp_path / modulator).level_phases, levels)

    def test_feature_show_and_a_checkpoint(self, tmp_path, capsys):
        optics = saved(tmp_path / "a.safetensors", "spiral", "sigmoid", "dwell", "PDMS")
        state = {"state_dict": {f"optics.{k}": v for k, v in optics.state_dict().items()}, "settings": None}
        write_state(tmp_path / "run.safetensors", {**state, "global_step": 1})
        high = float(optics.masks.heights().detach().max()) * 1e9
        for name in ("a", "run"):
            assert main(["masks", "show", str(tmp_path / f"{name}.safetensors")]) == 0
            told = capsys.readouterr().out
            assert f"to {high:.1f} nm" in told
            assert "PDMS" in told
            assert "0.3333 0.6667" in told


BANK = PSFBank.from_measured(torch.rand(1, 3, 5, 5), torch.zeros(1))


class OwnFamily(PixelwiseMask):
    """Of no package."""


class OwnSensor(SensorNoise):
    """Of no package."""


class TestCameraOfState(BaseTester):
    def test_feature_a_range_of_defocus_has_its_camera(self):
        optics = TiDyOptics(PixelwiseMask(1), DefocusRange(-10, 10, ThinLensCamera(f_number=12)), fidelity="draft")
        again = camera_of_state(optics.state_dict())
        assert again.settings() == optics.settings()
        assert again.camera.aperture_radius == optics.camera.aperture_radius

    @pytest.mark.parametrize(("family", "constraint", "modulator"), CROSSED)
    def test_feature_a_capture_is_the_same_to_the_last_bit(self, family, constraint, modulator, tmp_path):
        material = material_of(family, constraint, modulator)
        optics = saved(tmp_path / "a", family, constraint, modulator, material, sensor=SensorNoise(0.02, full_well=9e3))
        before = torch.random.get_rng_state()
        again = camera_of_state(optics.state_dict())
        assert torch.equal(torch.random.get_rng_state(), before)
        assert again.settings() == optics.settings()
        image, depth = torch.rand(1, 3, 16, 20), torch.full((1, 1, 16, 20), 0.5)
        one, other = (each(image, depth, generator=torch.Generator().manual_seed(0)) for each in (optics, again))
        assert torch.equal(one, other)
        assert [p.requires_grad for p in again.parameters()] == [p.requires_grad for p in optics.parameters()]

    @pytest.mark.parametrize("name", SYSTEMS)
    def test_feature_published_systems(self, name):
        optics = TiDyOptics.from_preset(name, generator=torch.Generator().manual_seed(0))
        again = camera_of_state(optics.state_dict())
        assert again.settings() == optics.settings()
        assert torch.equal(again.psf_bank(defocus=[1.0]).psfs, optics.psf_bank(defocus=[1.0]).psfs)

    def test_feature_a_focus_that_was_learnt(self):
        optics = TiDyOptics(camera=ThinLensCamera(focus_distance=torch.tensor(0.595)), fidelity="draft")
        with torch.no_grad():
            optics.camera.focus_distance.add_(0.1)
        again = camera_of_state(optics.state_dict())
        assert torch.equal(again.camera.focus_distance, optics.camera.focus_distance)
        assert again.camera.defocus_range == optics.camera.defocus_range

    @pytest.mark.parametrize(
        ("change", "sentence"),
        [
            (lambda: TiDyOptics(OwnFamily(1), fidelity=FIDELITY), "the masks of .* cannot be made: a OwnFamily is no"),
            (lambda: TiDyOptics(sensor=OwnSensor(), fidelity=FIDELITY), "the sensor .*: a OwnSensor is no class of"),
            (lambda: TiDyOptics(fidelity=FIDELITY).with_bank(BANK), "measured PSFs is 'sha256"),
        ],
    )
    def test_exception_what_no_state_tells(self, change, sentence):
        with pytest.raises(ValueError, match=sentence) as told:
            camera_of_state(change().state_dict())
        assert "\n" not in str(told.value)

    def test_exception_a_small_file_that_names_a_large_mask(self):
        state = TiDyOptics(FAMILIES["spiral"](), fidelity=FIDELITY).state_dict()
        settings = read_settings(state["_extra_state"])
        state["_extra_state"] = write_settings({**settings, "mask_pixels": [1 << 14, 1 << 14]})
        with pytest.raises(ValueError, match="masks of 16384x16384 pixels must take at most"):
            camera_of_state(state)

    def test_exception_weights(self):
        state = TiDyOptics(PixelwiseMask(1), fidelity=FIDELITY).state_dict()
        rest = {name: value for name, value in state.items() if name != "masks.phase"}
        for weights, sentence in (
            ({**rest, "masks.phase": state["masks.phase"].int()}, "phase must be floating point of 16 bits or more"),
            ({**state, "other": torch.ones(1)}, "does not fit its settings: .*Unexpected key"),
            (rest, "the masks of the camera's state cannot be made: it has no weights"),
        ):
            with pytest.raises(ValueError, match=sentence):
                camera_of_state(weights)

    def test_exception_no_settings(self):
        with pytest.raises(ValueError, match="the state has no entry '_extra_state', only phase"):
            camera_of_state(PixelwiseMask(1).state_dict())
