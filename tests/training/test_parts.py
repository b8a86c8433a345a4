"""Random states, moving average, tasks, settings, heads: the small parts of training."""

from __future__ import annotations

import json
import random

import numpy as np
import pytest
import torch
from torch import nn

from kornia_tidy import DefocusRange, ThinLensCamera
from kornia_tidy.reconstruction.depth_distribution import distribution_loss
from kornia_tidy.reconstruction.heads import make_head
from kornia_tidy.reconstruction.metrics import psnr, ssim
from kornia_tidy.reconstruction.pretrained import FOLDER, PRETRAINED
from kornia_tidy.reconstruction.settings import RENAMED, SystemSettings
from kornia_tidy.reconstruction.state_file import read_state, write_state
from kornia_tidy.reconstruction.tasks import (
    depth_logits,
    deviation_in_metres,
    metres,
    normalised_inverse_depth,
    split_maps,
)
from kornia_tidy.reconstruction.trained import TrainedSystem
from kornia_tidy.training.average import MovingAverage
from kornia_tidy.training.random_state import own_random_state, random_state, random_states, seeded, set_random_state
from kornia_tidy.training.settings import JOINT_RUN, NETWORK_RUN, TrainingSettings, usual_settings
from kornia_tidy.training.task_loss import LOSSES, task_loss
from tests.base import BaseTester
from tests.reconstruction.shipped import shipped


def draws():
    return torch.rand(3).tolist(), torch.randn(1).item(), np.random.rand(), np.random.randn(), random.gauss(0, 1)  # noqa: NPY002


class TestRandomState(BaseTester):
    def test_feature_generators_go_on_from_a_file_where_they_were(self, tmp_path):
        draws()  # leaves half a pair of normal numbers in NumPy's and Python's generators
        write_state(tmp_path / "a", random_state())
        expected = draws()
        draws()
        set_random_state(read_state(tmp_path / "a"))
        assert draws() == expected

    def test_feature_a_seeded_block_repeats_and_leaves_no_trace(self):
        set_random_state(before := random_state())
        expected = draws()
        set_random_state(before)
        with seeded(5):
            one = draws()
        with seeded(5):
            assert draws() == one
        assert draws() == expected

    def test_feature_each_process_takes_its_own_of_the_states_and_a_single_one_is_for_all(self):
        (state,) = random_states()
        assert torch.equal(own_random_state([state, {}])["torch"], torch.get_rng_state())
        assert own_random_state({"torch": 1}) == {"torch": 1}


class TestMovingAverage(BaseTester):
    def test_feature_it_is_the_weighted_sum_of_all_weights_that_were(self):
        network, decay = nn.Linear(2, 1, bias=False), 0.6
        average = MovingAverage(network, decay)
        expected = network.weight.detach().double()
        for step in range(8):
            with torch.no_grad():
                network.weight.copy_(torch.randn(1, 2))
            average.update(network)
            weight = min(decay, (1 + step) / (10 + step))
            expected = weight * expected + (1 - weight) * network.weight.detach().double()
        self.assert_close(average.network.weight, expected, rtol=1e-6, atol=1e-6)
        assert not any(p.requires_grad for p in average.parameters())

    def test_feature_buffers_that_stay_are_not_loaded_again(self):
        network, loaded = nn.BatchNorm1d(2), []
        average = MovingAverage(network)
        average.network.register_load_state_dict_post_hook(lambda *_: loaded.append(average))
        average.update(network)
        assert not loaded
        network(torch.randn(8, 2))
        average.update(network)
        assert loaded == [average]

    @pytest.mark.parametrize("decay", [-0.1, 1.0])
    def test_exception_decay(self, decay):
        with pytest.raises(ValueError, match="must be in"):
            MovingAverage(nn.Linear(1, 1), decay)


class TestTasks(BaseTester):
    def test_feature_nearness_is_linear_in_inverse_depth(self):
        depth = torch.tensor([0.3, 0.4, 0.8, 3.0, float("inf")])
        camera = ThinLensCamera(depth_range=(0.3, float("inf")))
        self.assert_close(normalised_inverse_depth(camera, depth), 0.3 / depth, atol=1e-6)
        assert normalised_inverse_depth(camera, torch.tensor([0.1]))[0] == 1
        self.assert_close(normalised_inverse_depth(DefocusRange(), torch.tensor([0.25])), torch.tensor([0.25]))

    def test_feature_decibels_of_error_and_similarity_count_each_image_alike(self):
        truth = torch.rand(3, 3, 16, 16, dtype=torch.float64)
        estimate = truth + torch.tensor([0.3, 0.03, 0.003]).view(3, 1, 1, 1) * torch.randn_like(truth)
        each = [LOSSES["psnr-ssim"](estimate[i : i + 1], truth[i : i + 1], None) for i in range(3)]
        self.assert_close(LOSSES["psnr-ssim"](estimate, truth, None), torch.stack(each).mean())
        expected = -psnr(estimate, truth) + 20 * (1 - ssim(estimate, truth))
        self.assert_close(torch.stack(each[:2]), expected[:2], atol=0.1, rtol=0)  # 1e-5 is added to the squared error
        assert each[2] > expected[2]

    def test_feature_the_joint_loss_weighs_both_and_masks_depth_only(self):
        output, truth = torch.rand(1, 4, 2, 2), {"depth": torch.rand(1, 1, 2, 2), "image": torch.rand(1, 3, 2, 2)}
        mask = torch.tensor([[[[True, False], [False, False]]]])
        estimate = split_maps("joint", output)
        loss = task_loss(LOSSES["mse"], estimate, truth, mask, {"depth": 2.0, "image": 3.0})
        depth = (output[0, 0, 0, 0] - truth["depth"][0, 0, 0, 0]) ** 2
        self.assert_close(loss, 2 * depth + 3 * (output[:, 1:] - truth["image"]).square().mean())

    @pytest.mark.parametrize("depth_range", [(0.3, float("inf")), (0.5, 4.0)])
    def test_feature_metres_bring_back_the_depth_that_was_learnt_as_nearness(self, depth_range):
        depth = torch.tensor([*depth_range, 0.6, 1.5, 3.9], dtype=torch.float64)
        camera = ThinLensCamera.for_scene(depth_range)
        self.assert_close(metres(camera, normalised_inverse_depth(camera, depth)), depth, rtol=1e-12)
        ends = metres(camera, torch.tensor([-0.5, 1.5]))
        self.assert_close(ends, torch.tensor(depth_range[::-1]))

    @pytest.mark.parametrize("depth_range", [(0.3, float("inf")), (0.5, 4.0)])
    def test_feature_deviations_in_metres_are_half_of_what_lies_between_one_nearer_and_one_farther(self, depth_range):
        """Near zero it is the deviation times the derivative of depth, and it is unbounded where infinity is within."""
        camera = ThinLensCamera.for_scene(depth_range)
        inverse = torch.tensor([0.3, 0.5, 0.9], dtype=torch.float64, requires_grad=True)
        small = torch.full_like(inverse, 1e-6)
        (slope,) = torch.autograd.grad(metres(camera, inverse).sum(), inverse)
        self.assert_close(deviation_in_metres(camera, inverse.detach(), small), -slope * small, rtol=1e-6, atol=0)
        wide = deviation_in_metres(camera, torch.tensor([0.1]), torch.tensor([0.2]))
        assert bool(wide.isinf()) == (depth_range[1] == float("inf"))

    def test_feature_a_distribution_has_its_mean_as_depth_and_a_loss_of_its_own(self):
        output, truth = torch.randn(1, 8, 3, 3), {"depth": torch.rand(1, 1, 3, 3), "image": torch.rand(1, 3, 3, 3)}
        logits, estimate = depth_logits("joint", output), split_maps("joint", output)
        assert torch.equal(logits, output[:, :5])
        assert torch.equal(estimate["image"], output[:, 5:])
        self.assert_close(estimate["depth"], (logits.softmax(1) * torch.linspace(0, 1, 5).view(5, 1, 1)).sum(1, True))
        mask = torch.rand(1, 1, 3, 3) > 0.3
        loss = task_loss(LOSSES["l1"], estimate, truth, mask, {"depth": 2.0, "image": 3.0}, logits)
        image = (output[:, 5:] - truth["image"]).abs().mean()
        self.assert_close(loss, 2 * distribution_loss(logits, truth["depth"], mask) + 3 * image)

    def test_exception_a_head_of_other_channels_is_refused(self):
        with pytest.raises(ValueError, match=r"must return \(B, 1, H, W\)"):
            split_maps("depth", torch.rand(1, 3, 2, 2))


class TestSettings(BaseTester):
    def test_feature_json_brings_back_what_was_written(self, tmp_path):
        settings = TrainingSettings(
            task="joint",
            depth_range=(0.5, float("inf")),
            f_number=48.0,
            focus_distance=float("inf"),
            electrons=(500.0, 57e3),
        )
        settings.write(tmp_path / "a.json")
        assert TrainingSettings.read(tmp_path / "a.json") == settings

    def test_convention_defaults_are_the_papers(self):
        settings = TrainingSettings()
        assert (settings.lr, settings.lr_metres, settings.batch, settings.masks) == (1e-4, 1e-8, 32, 5)
        assert (settings.depth_weight, settings.image_weight, settings.size) == (1, 1, 278)
        assert (settings.head, settings.width, settings.loss) == ("attention-unet", None, "mse")

    @pytest.mark.parametrize("depth_range", [None, (0.5, 4.0)])
    def test_feature_a_lens_has_the_aperture_and_the_focus_that_are_given(self, depth_range):
        """What is not given is as without both; the focus then is that of the middle of the range of inverse depth."""
        usual = SystemSettings(depth_range=depth_range).camera()
        slow = SystemSettings(depth_range=depth_range, f_number=48.0).camera()
        far = SystemSettings(depth_range=depth_range, f_number=48.0, focus_distance=float("inf")).camera()
        near = SystemSettings(depth_range=depth_range, focus_distance=0.6).camera()
        assert slow.f_number == far.f_number == pytest.approx(48)
        assert far.focus_distance == float("inf")
        assert near.focus_distance == 0.6
        assert near.aperture_diameter == usual.aperture_diameter
        assert slow.focus_distance == pytest.approx(usual.focus_distance)
        assert {lens.depth_range for lens in (usual, slow, far, near)} == {usual.depth_range}

    @pytest.mark.parametrize(
        ("given", "changes"),
        [
            ({"learn": "both"}, None),
            ({"learn": "network", "task": "joint", "depth_classes": 8, "refocus": 2, "closed_form": False}, set()),
            ({"learn": "network", "task": "joint", "residual": True}, {"closed_form"}),
            ({"learn": "network"}, set()),
            ({"learn": "network", "head": "midas-small"}, {"closed_form", "width"}),
            ({"learn": "network", "residual": True}, {"closed_form"}),
            ({"learn": "network", "inverse": "tikhonov"}, set()),
        ],
    )
    def test_feature_defaults_of_the_network_alone_fit_what_is_given(self, given, changes):
        usual = usual_settings(given)
        settings = TrainingSettings(**{**usual, **given})
        assert settings.learn == given["learn"]
        assert usual.pop("inverse", None) == ("wiener" if settings.closed_form else None)
        assert set(usual) == (set() if changes is None else set(NETWORK_RUN) - changes)

    def test_feature_image_and_depth_with_the_closed_form_have_a_distribution_of_depth(self):
        alone = usual_settings({"learn": "network", "task": "joint"})
        assert set(alone) == set(NETWORK_RUN) | set(JOINT_RUN) | {"inverse"}
        given = {"task": "joint", "closed_form": True, "refocus": 5}
        settings = TrainingSettings(**{**usual_settings(given), **given})
        assert (settings.depth_classes, settings.refocus) == (JOINT_RUN["depth_classes"], 5)
        assert usual_settings({"task": "edof", "closed_form": True}) == {"inverse": "wiener"}

    def test_feature_settings_stored_before_there_was_a_choice_of_loss_are_read(self):
        values = TrainingSettings(head="plain").as_dict()
        del values["loss"]
        assert TrainingSettings.from_dict(values) == TrainingSettings(head="plain", loss="mse")

    @pytest.mark.parametrize(
        ("change", "sentence"),
        [
            ({"ema": 1.0}, r"ema must be in \[0, 1\), got 1.0"),
            ({"loss": "psnr-ssim", "size": 10}, "'psnr-ssim' needs images of at least 11 pixels a side, got 10"),
            ({"loss": "psnr-ssim", "crop": 8}, "'psnr-ssim' needs images of at least 11 pixels a side, got 8"),
            ({"learn": "refiner"}, "learn='refiner' needs the second network of refined=True"),
            ({"start": "fisher"}, "start must be one of 'noise', 'fisher, noise', .*, got 'fisher'"),
            ({"start": "fisher, noise", "masks": 6}, "start 'fisher, noise' has five masks, got masks=6; 'noise' has"),
            ({"design": 5, "task": "joint"}, "designed before training for the task 'edof' only, got 'joint'"),
            ({"head": "nafnett"}, "head must be one of .*, got 'nafnett'"),
            ({"head": "tikhonov", "task": "depth"}, "head 'tikhonov' restores images, .* 'edof' only, got 'depth'"),
            ({"residual": True, "closed_form": True}, "residual adds the capture and closed_form its restoration"),
            ({"inverse": "wiener"}, "inverse 'wiener' is the filter of closed_form, which is not asked for"),
            ({"learn": "masks", "masks": 0}, "learn='masks' needs masks to learn, got masks=0"),
            ({"size": 64, "crop": 65}, "crop must be at most the size of the scenes, 64, got 65"),
            ({"focus_distance": 0.05}, "focus_distance must be metres beyond the focal length of 0.05 m, got 0.05"),
            ({"noise_range": [0.1, 0.01]}, "noise_range must be least and largest, got 0.1 and 0.01"),
        ],
    )
    def test_exception(self, change, sentence):
        with pytest.raises(ValueError, match=sentence):
            TrainingSettings(**change)

    @pytest.mark.parametrize("name", PRETRAINED)
    @pytest.mark.takes_seconds
    def test_feature_a_checkpoint_tells_the_settings_of_its_run(self, name):
        stored = json.loads(json.dumps(read_state(FOLDER / f"{name}.safetensors")["settings"]))
        settings = json.loads(json.dumps(TrainingSettings.of(shipped(name)).as_dict()))
        assert {key: settings[RENAMED.get(key, key)] for key in stored} == stored

    @pytest.mark.parametrize(
        ("run", "sentence"),
        [({"augment": 1}, "augment must be true or false, got 1"), ({"a" * 5000: 1}, "hold unknown names: a{1,200}$")],
    )
    def test_exception_settings_of_a_run_that_cannot_be(self, run, sentence):
        system = TrainedSystem(nn.Identity(), nn.Identity(), SystemSettings(), 0, run)
        with pytest.raises(ValueError, match=sentence):
            TrainingSettings.of(system)

    @pytest.mark.parametrize("text", ["{", '{"maskz": 5}', "[1]", '{"masks": "five"}'])
    def test_exception_a_file_that_holds_no_settings_is_named(self, text, tmp_path):
        (tmp_path / "a.json").write_text(text)
        with pytest.raises(ValueError, match=r"cannot read .*a\.json"):
            TrainingSettings.read(tmp_path / "a.json")


class TestPlainHead(BaseTester):
    def test_exception_unknown_name(self):
        with pytest.raises(ValueError, match=r"one of 'attention-unet', .*, or the path of a class .*, got 'plane'"):
            make_head("plane", 3)
