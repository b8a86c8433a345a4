"""Wrong units and value ranges: each message names the remedy, and real scenes cause none."""

from __future__ import annotations

import math
import re
import shutil
import warnings

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from kornia_tidy import (
    DefocusRange,
    Fidelity,
    NoMask,
    PSFBank,
    SensorNoise,
    ThinLensCamera,
    TiDyOptics,
    burst,
    moving_capture,
)
from kornia_tidy.arrays import depth_tensor
from kornia_tidy.augmentation import LinearCamera, RandomDepthBlur, depth_blur
from kornia_tidy.camera.samples import DEPTH_UNIT
from kornia_tidy.cli import main
from kornia_tidy.data import read_depth, write_depth
from kornia_tidy.data.depth_files import check_depth_options
from kornia_tidy.data.pfm import encode_pfm
from kornia_tidy.lab.calibration.psf import diffraction_cutoff
from kornia_tidy.lab.mask_export import frame_times
from kornia_tidy.masks import PixelwiseMask, ZernikeMask, initial_heights
from kornia_tidy.modulator import (
    DwellTimes,
    GreyLevels,
    LearnableDwellTimes,
    PixelCrosstalk,
    SpatialLightModulator,
    Switching,
)
from kornia_tidy.optics import cauchy_through
from kornia_tidy.reconstruction import PhaseCam3DUNet
from kornia_tidy.reconstruction.trained import check_weights
from kornia_tidy.sensor import full_well_of
from tests.base import BaseTester, shared
from tests.scenes import ENTRIES, load_scene

INF = math.inf


def camera(**options):
    options = {"masks": PixelwiseMask(1, initial="flat"), "fidelity": "draft", **options}
    return TiDyOptics(**options)


def scene(depth=0.8, size=64, dtype=torch.float32, device="cpu"):
    return torch.rand(1, 3, size, size, dtype=dtype, device=device), torch.full(
        (1, 1, size, size), depth, dtype=dtype, device=device
    )


class TestDepth(BaseTester):
    @pytest.mark.parametrize(
        ("near", "far", "said"),
        [
            (700, 1500, "700 m away, .*: are these millimetres.* by 0.001 .*--depth-scale 0.001"),
            (500, 65535, "are these millimetres"),
            (70, 150, "70 m away, .*: are these centimetres.* by 0.01 .*--depth-scale 0.01"),
            (5e5, 3e6, "are these micrometres.* by 1e-06 .*; give a sky as infinity"),
            (5e8, INF, "are these nanometres"),  # holes are often infinite
            (5e-4, 3e-3, "farthest pixel is 0.003 m away, .*: are these kilometres.* by 1000"),
        ],
    )
    def test_feature_other_units_are_told_once(self, near, far, said, device, dtype):
        optics, (image, depth) = camera().to(device), scene(near, dtype=dtype, device=device)
        depth[..., :20] = far
        with pytest.warns(UserWarning, match=said) as told:
            optics(image, depth)
        assert len(told) == 1
        optics(image, depth)

    def test_feature_a_range_is_told_where_the_unit_is_known(self):
        optics = camera()
        optics.notes.told.add(DEPTH_UNIT)  # as for painted scenes in training
        with pytest.warns(UserWarning, match="beyond the camera's range"):
            optics(*scene(1e-3))

    def test_feature_all_beyond_a_camera_s_range_are_told_by_their_unit(self):
        optics = camera(camera=ThinLensCamera.for_scene((0.5, 4.0)))
        with pytest.warns(UserWarning, match="900 m away.*are these millimetres") as told:
            optics(*scene(900.0))
        assert len(told) == 1

    def test_feature_a_fast_lens_sees_millimetres_apart_and_they_are_told(self):
        optics = camera(masks=NoMask(), camera=ThinLensCamera(f_number=1.8, focus_distance=2.0), border="replicate")
        with pytest.warns(UserWarning, match="400 m away, .*: are these millimetres"):
            optics.check_scene(*scene(400.0))
        optics.check_scene(*scene(150.0))  # warnings are errors

    @pytest.mark.parametrize(
        ("depths", "options"),
        [
            ((0.5, 3.0), {}),
            ((2.0, 400.0), {}),  # a street
            ((30.0, INF), {}),  # a landscape under a sky
            ((INF, INF), {}),
            ((0.5, 1e10), {}),  # as Blender writes infinity
            ((60.0, 2000.0), {"camera": ThinLensCamera(0.3, 0.1, 100.0, depth_range=(50.0, INF))}),  # a telephoto lens
            ((3.9, 4.0), {"camera": ThinLensCamera.for_scene((0.5, 4.0))}),
            ((0.0, 1.0), {"camera": DefocusRange()}),
            ((900.0, 900.0), {"check_inputs": False}),
        ],
    )
    def test_feature_real_depths_raise_no_alarm(self, depths, options):
        image, depth = scene(depths[0])
        depth[..., 30:] = depths[1]
        camera(**options)(image, depth)

    def test_exception_a_normalised_camera_says_what_metres_need(self):
        with pytest.raises(ValueError, match=r"normalised disparity in \[0, 1\], got 1.5.*: metres need a ThinLens"):
            camera(camera=DefocusRange())(*scene(1.5))

    @pytest.mark.parametrize(
        ("use", "said"),
        [
            (lambda: ThinLensCamera.for_scene((700.0, 1500.0)), "1500 m need .* 0.188 m .* millimetres, .* 0.001"),
            (lambda: ThinLensCamera(focus_distance=595), "focus_distance is 595 m away, .*: are these mill"),
            (lambda: ThinLensCamera(focus_distance=5.95e5), r"micrometres\? Multiply it by 1e-06, or give inf"),
            (lambda: ThinLensCamera(f_number=1.8, focus_distance=2000), "focus_distance is 2000 m away.*millimetres"),
            (lambda: ThinLensCamera(f_number=1.8, depth_range=(300, 5000)), "depth_range is 300 m away.*millimetres"),
            (lambda: ThinLensCamera(4.2, f_number=1.8, focus_distance=8), "focal_length is 4.2 m: if .* millimetres"),
            (lambda: ThinLensCamera(depth_range=(300, 5000)), "depth_range is 300 m away.*: are these millimetres"),
            (lambda: RandomDepthBlur((500, 5000)), r"focus_distance is 500 m away.*millimetres\? Multiply it by 0.001"),
            (lambda: LinearCamera(camera(), scene(700.0)[1]), "nearest pixel is 700 m away"),
            (lambda: camera().plan(scene(700.0)[1]), "nearest pixel is 700 m away"),
            (lambda: burst(camera(), *scene(1.0), exposure=100), "exposure is 100 s: if these are milliseconds"),
            (lambda: ThinLensCamera().chromatic_defocus(530), "wavelength must be metres between .*530 nm is 530e-9"),
            (lambda: PixelwiseMask(1).dispersion(0.53), "wavelength must be metres between"),
            (lambda: diffraction_cutoff(ThinLensCamera(), 530), "wavelength must be metres between"),
            (lambda: cauchy_through("", "", ((486, 1.5), (656, 1.4))), "wavelength must be metres between .*got 486"),
            (lambda: GreyLevels(8, 360), "phase_range must be at most 4 pi radians, got 360: multiply degrees by"),
            (lambda: GreyLevels(2, response=(0, 0.3, 0.6, 0.9)), "response spans 0.9 rad: multiply waves by 2 pi"),
            (lambda: PixelCrosstalk(8e-6), "sigma is 8e-06 pixels, as if none: divide metres by the pixel pitch"),
            (lambda: depth_blur(*scene(1e-3), 1.0, 2.0), "farthest pixel is 0.001 m away, .* kilometres"),
            (lambda: check_depth_options(kind="disparity", focal_px=1, baseline_m=193.5), "is 193.5 m, .* 0.001"),
            (lambda: full_well_of(8), "pixel_pitch must be metres between"),
            (lambda: ThinLensCamera(50), "focal_length must be metres between 1e-05 and 10 .50 mm is 50e-3., got 50"),
            (lambda: ThinLensCamera(aperture_diameter=2.8), "at most 0.1 m, which is f/0.5, .*got 2.8"),
            (lambda: ThinLensCamera(aperture_diameter=28), "aperture_diameter must be metres between"),
            (lambda: ThinLensCamera(pixel_pitch=8), "between 1e-07 and 0.001 .8 um is 8e-6., got 8"),
            (lambda: ThinLensCamera(pixel_pitch=8e-3), "pixel_pitch must be metres between"),
            (lambda: PixelwiseMask(1, constraint="clamp", max_height=1.2), "max_height .* .1 um is 1e-6., got 1.2"),
            (lambda: PixelwiseMask(initial=torch.ones(1, 23, 23)), "initial heights .* 0.001 .1 um is 1e-6., got 1"),
            (lambda: camera().parameter_groups(lr_metres=10), "lr_metres must be metres .* .10 nm is 10e-9., got 10"),
            (lambda: Switching(20, exposure=100), "switching_time must be .*seconds up to 10 .4 ms is 4e-3., got 20"),
            (lambda: frame_times((1, 1), 100, 8e-3), "exposure is 100 s: if these are milliseconds, give 0.1"),
        ],
    )
    def test_exception_other_units_of_lengths_and_times_are_told(self, use, said, monkeypatch):
        """Warnings are errors here."""
        monkeypatch.setattr("kornia_tidy.optics.units._TOLD", set())
        with pytest.raises((ValueError, UserWarning), match=said):
            use()

    @pytest.mark.filterwarnings("default")
    def test_smoke_command_says_it_in_a_line(self, tmp_path, capsys):
        cv2.imwrite(str(tmp_path / "rgb.png"), np.full((80, 80, 3), 90, np.uint8))
        cv2.imwrite(str(tmp_path / "depth.png"), np.full((80, 80), 1100, np.uint16))
        args = ["simulate", str(tmp_path / "rgb.png"), "--depth", str(tmp_path / "depth.png"), "--fidelity", "draft"]
        assert main([*args, "-o", str(tmp_path / "out.png"), "--masks", "1"]) == 0
        told = capsys.readouterr().err.splitlines()
        assert [line for line in told if "--depth-scale 0.001" in line and line.startswith("kornia-tidy: warning: ")]
        assert not any(".py" in line for line in told)


class TestDepthScale(BaseTester):
    """Units per metre, as Open3D, TUM RGB-D and ROS give them, where metres per unit are asked for."""

    READERS = (
        lambda stored, scale, folder: depth_tensor(stored, scale),
        lambda stored, scale, folder: depth_tensor(torch.from_numpy(stored)[None], scale),
        lambda stored, scale, folder: read_depth(saved(stored, folder), scale).depth,
    )

    @pytest.mark.parametrize("read", READERS)
    @settings(max_examples=40)
    @given(
        st.sampled_from([100, 256, 1000, 5000]) | st.floats(50, 20_000),
        st.floats(0.3, 20),
        st.floats(1.2, 10),
        st.sampled_from(["<u2", "<i4", "<f4", "<f8"]),
    )
    def test_property_whole_numbers_are_refused_and_read_by_the_inverse(
        self, tmp_path_factory, read, scale, near, span, kind
    ):
        metres = near * np.geomspace(1, span, 48).reshape(6, 8)
        stored = np.rint(metres * scale)
        stored = (stored.clip(1, 65534) if kind == "<u2" else stored).astype(kind)
        stored[2, 3] = 0  # a hole, which is not the nearest pixel
        folder = tmp_path_factory.getbasetemp()
        with pytest.raises(ValueError, match=re.escape(f"units in a metre give {1 / scale:.6g}, not {scale:g}")):
            read(stored, scale, folder)
        found = read(stored, 1 / scale, folder).numpy()[0]
        np.testing.assert_allclose(found[stored > 0], stored[stored > 0] / scale, rtol=1e-6)

    @pytest.mark.parametrize("read", READERS)
    @pytest.mark.parametrize(
        ("stored", "scale"),
        [
            (np.linspace(2000.3, 9000, 48, dtype=np.float32), 1.0),  # a landscape in metres
            (np.linspace(0.31, 40, 48, dtype=np.float32), 1000.0),  # in kilometres
            (np.linspace(15.0, 255, 48).astype(np.uint8), 10.0),  # eight bits to 2550 m
            (np.linspace(300, 60_000, 48).astype(np.uint16), 1.0),  # metres, far
            (np.full(48, np.inf, np.float32), 5.0),
        ],
    )
    def test_feature_far_scenes_are_no_mistake(self, read, stored, scale, tmp_path):
        found = read(stored.reshape(6, 8), scale, tmp_path).numpy()[0]
        np.testing.assert_allclose(found, stored.reshape(6, 8) * np.float64(scale), rtol=1e-6)


def saved(stored, folder):
    np.save(folder / "depth.npy", stored)
    return folder / "depth.npy"


class TestImage(BaseTester):
    @pytest.mark.parametrize("color_space", ["srgb", "paper"])
    @pytest.mark.parametrize(("value", "said"), [(255.0, "255: divide 8-bit"), (1e30, r"1e\+30: divide 8-bit")])
    def test_exception_codes_beyond_white(self, color_space, value, said, device, dtype):
        optics, (image, depth) = camera(color_space=color_space), scene(dtype=dtype, device=device)
        image[0, 1, 2, 3] = value
        with pytest.raises(ValueError, match=f"image must hold values from 0 to 1, got {said}"):
            optics(image, depth)
        with pytest.raises(ValueError, match="image must hold values from 0 to 1"):
            burst(optics, image, depth)
        with pytest.raises(ValueError, match="image must hold values from 0 to 1"):
            moving_capture(optics, image[:, None], depth[:, None])

    def test_exception_light_that_sums_to_infinity(self):
        image, depth = scene()
        with pytest.raises(ValueError, match=r"within 1e\+30 .*, got 3e\+38"):
            camera(color_space="linear", sensor=None)(image * 0 + 3e38, depth)

    def test_feature_light_beyond_white_passes_where_it_is_linear(self):
        image, depth = scene()
        assert camera(color_space="linear", sensor=None)(1e4 * image, depth).isfinite().all()

    @pytest.mark.parametrize("color_space", ["srgb", "linear"])
    def test_feature_normalised_images_are_told_once(self, color_space, device, dtype):
        optics, (image, depth) = camera(color_space=color_space), scene(dtype=dtype, device=device)
        with pytest.warns(UserWarning, match=r"undo that first: image \* std \+ mean") as told:
            optics((image - 0.45) / 0.225, depth)
        assert len(told) == 1
        optics((image - 0.45) / 0.225, depth)

    def test_feature_codes_a_little_beyond_white_are_told(self):
        image, depth = scene()
        with pytest.warns(UserWarning, match=r"from 0 to 1, got 3"):
            camera()(image * 0 + 3, depth)

    def test_feature_noise_and_overshoot_raise_no_alarm(self):
        image, depth = scene()
        camera()(1.4 * image - 0.2, depth)
        camera(color_space="linear", sensor=None)(2.7 * image - 0.8, depth)
        camera(check_inputs=False, sensor=None)(255 * image, depth)

    @pytest.mark.parametrize(("whole", "scale"), [(torch.uint8, 255), (torch.int32, 65535)])
    def test_exception_whole_numbers_say_how_to_convert(self, whole, scale):
        image, depth = scene()
        with pytest.raises(TypeError, match=rf"image must be floating .*: convert it with image.float\(\) / {scale}$"):
            camera()(image.to(whole), depth)
        with pytest.raises(TypeError, match=r"convert it with depth.float\(\) \* 0.001 if it is in millimetres"):
            camera()(image, depth.to(torch.int32))

    @pytest.mark.parametrize(
        ("shape", "remedy"),
        [
            ((1, 4, 64, 64), r"drop alpha with image\[:, :3\]"),
            ((4, 64, 64), r"drop alpha with image\[:3\]"),
            ((1, 64, 64, 3), r"channels first with image.permute\(0, 3, 1, 2\)$"),
            ((64, 64, 3), r"channels first with image.permute\(2, 0, 1\)$"),
            ((64, 64, 4), r"channels first with image.permute\(2, 0, 1\)\[:3\]$"),
        ],
    )
    def test_exception_layout_says_what_to_do(self, shape, remedy):
        depth = torch.ones(1, 64, 64) if len(shape) == 3 else torch.ones(1, 1, 64, 64)
        with pytest.raises(ValueError, match=remedy):
            camera()(torch.rand(shape), depth)
        if len(shape) == 4:
            with pytest.raises(ValueError, match=remedy):
                PhaseCam3DUNet(width=2)(torch.rand(shape))

    def test_exception_depth_layout_says_what_to_do(self):
        image, _ = scene()
        with pytest.raises(ValueError, match=r"depth.unsqueeze\(-3\)"):
            camera()(image, torch.ones(1, 64, 64))
        with pytest.raises(ValueError, match=r"depth.permute\(0, 3, 1, 2\)"):
            camera()(image, torch.ones(1, 64, 64, 1))

    @pytest.mark.parametrize(("low", "high", "said"), [(0, 255, "divide by 255"), (-2.1, 2.6, "undo that first")])
    def test_feature_a_network_is_told_once(self, low, high, said, device):
        head, image = PhaseCam3DUNet(width=2).to(device), torch.linspace(low, high, 3 * 32 * 32, device=device)
        with pytest.warns(UserWarning, match=said) as told:
            head(image.view(1, 3, 32, 32))
        assert len(told) == 1
        head(image.view(1, 3, 32, 32))

    def test_dynamo_does_not_look(self):
        image = 255 * torch.rand(1, 3, 32, 32)
        torch.compile(PhaseCam3DUNet(width=2).eval(), fullgraph=True, backend="eager")(image)


class TestLens(BaseTester):
    @pytest.mark.parametrize(
        ("options", "said"),
        [
            ({"focal_length": "50 mm"}, "focal_length must be a number in metres, got '50 mm'"),
            ({"focus_distance": None}, "focus_distance must be a number in metres, got None"),
            ({"depth_range": (0.5, None)}, "depth_range must be a number in metres, got None"),
            ({"depth_range": 5}, "depth_range must be two numbers, .near, far. in metres, got 5"),
            ({"lens_material": "PMMA"}, "lens_material must be a material such as .*, got 'PMMA'"),
        ],
    )
    def test_exception_types(self, options, said):
        with pytest.raises(TypeError, match=said):
            ThinLensCamera(**options)

    def test_exception_too_much_defocus_is_refused_before_any_work(self):
        wide = ThinLensCamera(aperture_diameter=50e-3)
        with pytest.raises(ValueError, match=r"needs 6226 layers of PSFs 573 px wide, .* at most 4096 and 650 px"):
            camera(camera=wide, fidelity=Fidelity(wide_blur="waves"))
        with pytest.raises(ValueError, match="at most 4096"):
            camera(fidelity=Fidelity(layer_spacing=1e-3))

    def test_feature_a_place_in_the_field_in_metres_is_told(self, monkeypatch):
        monkeypatch.setattr("kornia_tidy.optics.units._TOLD", set())
        for center in ((0.0, 0.0), (1e-9, 0.0), (0.0, -0.3)):
            camera(field_center=center)  # warnings are errors
        with pytest.warns(UserWarning, match=r"in sensor pixels, and \(0.0, -0.003\) is the axis: divide metres by"):
            camera(field_center=(0.0, -3e-3))


class TestTypes(BaseTester):
    @pytest.mark.parametrize(
        ("name", "value", "said"),
        [
            ("masks", 5, r"masks must be phase masks such as PixelwiseMask\(5\), got the number 5"),
            ("masks", ThinLensCamera(), "masks must be phase masks .*, got a ThinLensCamera"),
            ("camera", "lens", "camera must be a camera such as .*, got 'lens'"),
            ("camera", PixelwiseMask(1), "camera must be a camera such as .*, got a PixelwiseMask"),
            ("modulator", 5, r"modulator must be a modulator such as DwellTimes\(\), got the number 5"),
            ("sensor", 0.01, r"sensor must be a sensor such as SensorNoise\(0.01\), .*, got the number 0.01"),
            ("fidelity", 3, "fidelity must be a Fidelity or one of 'paper', .*, got the number 3"),
            ("spectrum", (530e-9,), "spectrum must be a Spectrum such as .*, got a tuple"),
            ("aperture", 23, "aperture must be a tensor .*, got the number 23"),
            ("memory_budget", "1 GB", "memory_budget must be a number in bytes, got '1 GB'"),
        ],
    )
    def test_exception_arguments_of_the_camera(self, name, value, said):
        with pytest.raises(TypeError, match=said):
            TiDyOptics(**{name: value})

    def test_exception_a_part_is_swapped_for_another_kind(self):
        optics = camera()
        with pytest.raises(TypeError, match=r"masks must be phase masks"):
            optics.masks = DwellTimes()
        with pytest.raises(TypeError, match=r"fidelity must be a Fidelity .*, got 'draft'"):
            optics.fidelity = "draft"

    def test_exception_generators(self):
        optics, (image, depth) = camera(), scene()
        calls = [
            lambda: optics(image, depth, generator=0),
            lambda: optics.draw(image, generator=0),
            lambda: TiDyOptics.from_preset("tidy-5", generator=0),
            lambda: PixelwiseMask(generator=0),
            lambda: ZernikeMask(generator=0),
            lambda: initial_heights("noise", generator=0),
            lambda: SensorNoise()(image, generator=0),
            lambda: burst(optics, image, depth, generator=0),
        ]
        for call in calls:
            with pytest.raises(TypeError, match=r"such as torch.Generator\(\).manual_seed\(0\), got the number 0"):
                call()

    def test_exception_dwell_times(self):
        for kind in (DwellTimes, LearnableDwellTimes):
            with pytest.raises(TypeError, match=r"a number for each mask, such as \(3, 1\), got the number 5"):
                kind(5)

    def test_feature_a_panel_without_parts_shows_each_mask_as_long(self):
        phase = torch.rand(4, 23, 23)
        states, weights = SpatialLightModulator(fill_factor=0.93)(phase)
        assert torch.equal(states, phase)
        assert weights.tolist() == [0.25] * 4

    def test_exception_a_part_of_a_panel(self):
        with pytest.raises(TypeError, match=r"each part of a modulator must be a module such as .*, got the number 5"):
            SpatialLightModulator(5)


class TestNotANumber(BaseTester):
    def test_exception_masks_at_a_capture(self, device, dtype):
        optics = camera().to(device, dtype)
        with torch.no_grad():
            optics.masks.phase[0, 3, 4] = math.nan
        with pytest.raises(ValueError, match="the phase of the masks must be finite, got nan"):
            optics(*scene(dtype=dtype, device=device))

    def test_exception_dwell_times_at_a_capture(self):
        optics = camera(masks=PixelwiseMask(2), modulator=LearnableDwellTimes((1, 1)))
        with torch.no_grad():
            optics.modulator.logits[0] = math.nan
        with pytest.raises(ValueError, match="the weights of the modulator must be finite"):
            optics(*scene())

    def test_exception_masks_that_are_loaded(self):
        state = camera().state_dict()
        state["masks.phase"] = torch.full_like(state["masks.phase"], math.inf)
        with pytest.raises(ValueError, match="must be finite, got inf"):
            camera().load_state_dict(state)

    def test_exception_a_checkpoint_s_weights(self):
        head = nn.Linear(2, 1)
        weights = {**head.state_dict(), "bias": torch.tensor([math.nan])}
        with pytest.raises(ValueError, match=r"a.ckpt does not fit: bias holds NaN or infinity"):
            check_weights(head, weights, "a.ckpt")

    @pytest.mark.parametrize("name", ["psfs", "defocus", "energy", "veil"])
    def test_exception_psf_banks(self, name, tmp_path):
        tensors = {
            "psfs": torch.ones(2, 3, 1, 1),
            "defocus": torch.tensor([-1.0, 1.0]),
            "energy": torch.ones(2, 3),
            "veil": torch.zeros(2, 3),
        }
        tensors[name].view(-1)[1] = math.nan
        PSFBank(**tensors).save(tmp_path / "bank.safetensors")
        with pytest.raises(ValueError, match=f"bank.safetensors: {name} must be finite, got nan"):
            PSFBank.load(tmp_path / "bank.safetensors")
        if name in ("psfs", "defocus"):
            with pytest.raises(ValueError, match="must be finite"):
                PSFBank.from_measured(tensors["psfs"], tensors["defocus"])


class TestDepthFiles(BaseTester):
    @staticmethod
    def disparity():
        """Return a disparity map like Middlebury's: 20 to 60 px, with scattered unknown pixels."""
        values = np.random.default_rng(0).uniform(20, 60, (40, 40)).astype(np.float32)
        values[np.random.default_rng(1).uniform(size=(40, 40)) < 0.1] = np.inf
        return values

    def test_feature_a_disparity_read_as_metres_is_told_once_a_folder(self, tmp_path):
        for name in ("a.pfm", "b.pfm"):
            (tmp_path / name).write_bytes(encode_pfm(self.disparity()))
        with pytest.warns(UserWarning, match=r"a.pfm holds infinity, .*--depth-kind disparity --invalid inf") as told:
            read_depth(tmp_path / "a.pfm")
        assert len(told) == 1
        read_depth(tmp_path / "b.pfm")

    def test_feature_disparities_skies_and_rooms_raise_no_alarm(self, tmp_path):
        path = tmp_path / "a.pfm"
        path.write_bytes(encode_pfm(self.disparity()))
        read_depth(path, kind="disparity", focal_px=1000.0, baseline_m=0.1)
        read_depth(path, invalid=[INF])
        sky = np.full((40, 40), 30, np.float32)
        sky[:15, :30] = sky[18, 4:9] = np.inf  # the second patch: sky below a branch
        path.write_bytes(encode_pfm(sky))
        assert read_depth(path).valid.all()
        path.write_bytes(encode_pfm(self.disparity() / 20))
        read_depth(path)

    @pytest.mark.parametrize("name", [name for name, entry in ENTRIES.items() if entry["invalid"] == "inf"])
    def test_feature_real_disparities_without_their_options_are_told(self, name, tmp_path):
        path = shutil.copy(shared(f"data/{ENTRIES[name]['depth']}"), tmp_path)
        with pytest.warns(UserWarning, match="kind='disparity'"):
            read_depth(path)

    @pytest.mark.parametrize("kind", ["u2", "i2", "u4", "i4", "f4"])
    def test_feature_the_largest_number_of_a_type_is_told(self, kind, tmp_path):
        most = np.finfo(kind).max if kind == "f4" else np.iinfo(kind).max
        with pytest.warns(UserWarning, match="end at 4000, .*" + re.escape(f"--invalid {most:.10g}")):
            read_depth(saved(np.array([[700, most], [900, 4000]], kind), tmp_path), 0.001)
        assert read_depth(tmp_path / "depth.npy", 0.001, invalid=[float(most)]).valid.sum() == 3

    def test_feature_65535_that_is_meant_raises_no_alarm(self, tmp_path):
        path = tmp_path / "a.png"
        cv2.imwrite(str(path), np.array([[700, 65535], [900, 4000]], np.uint16))
        assert read_depth(path, 0.001, invalid=[65535]).valid.sum() == 3
        cv2.imwrite(str(path), np.array([[700, 65535], [900, 64000]], np.uint16))
        assert read_depth(path, 0.001).valid.all()
        write_depth(path, torch.tensor([[[0.25, INF]]]), 0.001, saturate=True)
        assert read_depth(path, 0.001).valid.all()


class TestNoFalseAlarm(BaseTester):
    """Warnings are errors here, as in all tests."""

    @pytest.mark.parametrize("name", list(ENTRIES)[::9])
    def test_feature_real_scenes(self, name):
        found = load_scene(name)
        step = max(1, min(found.image.shape[1:]) // 96)
        image, depth = found.image[:, ::step, ::step].contiguous(), found.depth[:, ::step, ::step].contiguous()
        near, far = float(depth.min()), float(depth.max())
        with warnings.catch_warnings():
            # Warnings about the default range and about windows may come, but none about units.
            warnings.filterwarnings("ignore", message=".*beyond the camera's range|the largest PSF window")
            for lens in (ThinLensCamera(), ThinLensCamera.for_scene((near, max(far, 1.1 * near)))):
                camera(camera=lens)(image, depth)
            inverse_depth = (1 / depth - 1 / far) / (1 / near - 1 / far)
            camera(camera=DefocusRange())(image, inverse_depth.clamp(0, 1))
