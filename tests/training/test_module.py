from __future__ import annotations

import math

import pytest
import torch
from torch import nn

from kornia_tidy import PixelwiseMask, TiDyOptics
from kornia_tidy.data import DeadLeaves
from kornia_tidy.reconstruction.depth_distribution import fit_temperature
from kornia_tidy.reconstruction.trained import build_optics, check_weights, load_trained, load_weights
from kornia_tidy.sensor import electrons_at
from kornia_tidy.training.scenes import Broken, SceneLoader
from kornia_tidy.training.settings import TrainingSettings
from tests.base import BaseTester

pl = pytest.importorskip("lightning.pytorch")

from kornia_tidy.training.checkpoint import SafetensorsIO  # noqa: E402
from kornia_tidy.training.module import TidyTraining  # noqa: E402

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*LeafSpec:FutureWarning"),
    pytest.mark.filterwarnings("ignore::lightning.pytorch.utilities.warnings.PossibleUserWarning"),
]
SETTINGS = TrainingSettings(task="joint", masks=2, head="plain", width=4, size=48, window=23, lr=1e-3)
REFINED = {"depth_classes": 6, "refocus": 2, "closed_form": True, "refined": True, "learn": "refiner"}


def made(**changes):
    torch.manual_seed(0)
    return TidyTraining.from_settings(SETTINGS.replace(**changes))


def batch(count=2):
    return next(iter(SceneLoader(DeadLeaves(count, 48, 48), count)))


def trainer(folder, steps=2, **options):
    return pl.Trainer(
        accelerator="cpu",
        max_steps=steps,
        plugins=[SafetensorsIO()],
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        default_root_dir=folder,
        **options,
    )


class TestTidyTraining(BaseTester):
    @pytest.mark.parametrize("task", ["edof", "depth", "joint"])
    def test_cardinality_every_task_sees_its_maps(self, task):
        module = made(task=task)
        result = module.reconstruct(batch())
        wanted = {"edof": {"image": 3}, "depth": {"depth": 1}, "joint": {"depth": 1, "image": 3}}[task]
        assert {name: maps.shape for name, maps in result.estimate.items()} == {
            name: (2, channels, 48, 48) for name, channels in wanted.items()
        }
        assert all(result.truth[name].shape == maps.shape for name, maps in result.estimate.items())

    def test_feature_the_loss_reaches_masks_and_network(self, monkeypatch):
        module = made()
        monkeypatch.setattr(module, "log", lambda *args, **options: None)
        module.training_step(batch(), 0).backward()
        assert module.optics.masks.phase.grad.abs().max() > 0
        assert all(p.grad.abs().max() > 0 for p in module.head.parameters())

    def test_feature_rates_are_those_of_masks_and_network(self):
        """One Adam step moves every mask pixel under the aperture by 1e-8 m, and every weight by lr."""
        module = made(lr=1e-4)
        optimizer = module.configure_optimizers()
        heights, weight = module.optics.masks.heights().detach().clone(), module.head.layers[0].weight.detach().clone()
        result = module.reconstruct(batch())
        (result.estimate["image"] - result.truth["image"]).square().mean().backward()
        optimizer.step()
        moved = (module.optics.masks.heights() - heights).detach().abs()[module.optics.masks.phase.grad != 0]
        self.assert_close(moved, torch.full_like(moved, 1e-8), rtol=2e-3, atol=1e-12)
        moved = (module.head.layers[0].weight - weight).detach().abs()
        self.assert_close(moved.median(), torch.tensor(1e-4), rtol=1e-2)
        assert {group["betas"] for group in optimizer.param_groups} == {(0.99, 0.999)}

    def test_feature_a_fixed_lens_trains_the_network_alone(self):
        module = made(masks=0)
        assert not list(module.optics.parameters())
        assert len(module.configure_optimizers().param_groups) == 1

    @pytest.mark.parametrize("precision", ["32-true", "bf16-mixed"])
    def test_feature_optics_stay_in_float32_and_the_network_has_its_precision(self, precision, tmp_path):
        module, types = made(), []
        module.optics.register_forward_hook(lambda m, i, o: types.append(o["image"].dtype))
        module.head.layers[0].register_forward_hook(lambda m, i, o: types.append(o.dtype))
        trainer(tmp_path, 1, precision=precision).fit(module, SceneLoader(DeadLeaves(2, 48, 48), 2))
        assert types == [torch.float32, torch.float32 if precision == "32-true" else torch.bfloat16]
        assert module.optics.masks.phase.dtype == torch.float32

    def test_feature_the_average_is_what_validation_sees(self):
        module = made()
        with torch.no_grad():
            module.head.layers[-1].bias += 1
        coded = torch.rand(1, 3, 48, 48)
        difference = module(coded) - module.eval()(coded)
        self.assert_close(difference, torch.ones_like(difference))

    @pytest.mark.parametrize("closed_form", [True, False])
    def test_feature_the_temperature_is_fitted_to_what_validation_sees(self, closed_form, tmp_path):
        """Weights do not depend on it, and a checkpoint holds it."""
        module = made(depth_classes=6, refocus=2, masks=1, closed_form=closed_form)
        module.head.temperature.fill_(5.0)
        loader = SceneLoader(DeadLeaves(2, 48, 48), 2, train=False)
        trainer(tmp_path).validate(module, loader, verbose=False)
        result = module.eval().reconstruct(next(iter(loader)))
        fitted = float(module.average.network.temperature)
        assert fitted == float(module.head.temperature)
        seen = [part[..., ::4, ::4] for part in (result.logits * fitted, result.truth["depth"], result.mask)]
        assert fitted == pytest.approx(fit_temperature(*seen), rel=1e-4)
        assert fitted != 5.0
        assert "head.temperature" in module.state_dict()

    def test_feature_a_valid_border_crops_truth_and_mask_alike(self):
        module, sample = made(border="valid"), batch()
        sample["mask"][..., 11, 11], sample["mask"][..., 0, 0] = False, False
        result = module.reconstruct(sample)
        assert result.coded.shape[-1] == result.truth["depth"].shape[-1] == result.mask.shape[-1] == 26
        assert torch.equal(result.truth["image"], sample["image"][..., 11:-11, 11:-11])
        assert (~result.mask).nonzero()[:, 2:].tolist() == [[0, 0], [0, 0]]

    def test_feature_noise_follows_from_the_batch(self):
        module, sample = made(), batch()
        torch.manual_seed(1)
        one = module.reconstruct(sample).coded
        assert torch.equal(one, module.reconstruct(sample).coded)
        assert not torch.equal(one, module.reconstruct({**sample, "noise_seed": 1}).coded)
        plain = {name: sample[name] for name in ("image", "depth")}
        assert not torch.equal(module.reconstruct(plain).coded, module.reconstruct(plain).coded)

    def test_feature_a_network_conditioned_on_noise_is_told_that_of_each_capture(self):
        class Told(nn.Module):
            def __init__(self):
                super().__init__()
                self.weight, self.noise = nn.Parameter(torch.zeros(1)), "not called"

            def forward(self, image, noise=None):
                self.noise = noise
                return image + self.weight

        module = TidyTraining(build_optics(SETTINGS), Told(), ema=0)
        levels = torch.tensor([0.002, 0.03]).view(2, 1, 1, 1)
        known = torch.ones(2, 1, 8, 8, dtype=torch.bool)
        captures = {"coded": torch.rand(2, 3, 8, 8), "image": torch.rand(2, 3, 8, 8), "mask": known}
        result = module.reconstruct({**captures, "inverse_depth": torch.rand(2, 1, 8, 8), "noise": levels})
        assert module.head.noise is levels
        assert result.coded is captures["coded"]
        assert result.truth["image"] is captures["image"]
        module.reconstruct(batch())
        assert module.head.noise is None  # as the camera's sensor has it

    def test_feature_the_network_alone_has_adamw_and_optics_without_gradients(self):
        module = made(learn="network", channels_last=True)
        (group,) = module.configure_optimizers().param_groups
        assert isinstance(module.configure_optimizers(), torch.optim.AdamW)
        assert {id(p) for p in group["params"]} == {id(p) for p in module.head.parameters()}
        assert not any(p.requires_grad for p in module.optics.parameters())
        assert module.head.layers[0].weight.is_contiguous(memory_format=torch.channels_last)

    def test_feature_the_refiner_alone_learns_and_depth_stays_as_it_is(self, monkeypatch):
        module = made(**REFINED)
        (group,) = module.configure_optimizers().param_groups
        assert {id(p) for p in group["params"]} == {id(p) for p in module.head.refiner.parameters()}
        monkeypatch.setattr(module, "log", lambda *args, **options: None)
        module.on_fit_start()
        module.training_step(batch(), 0).backward()
        assert {name for name, p in module.named_parameters() if p.grad is not None} == {
            name for name, _ in module.named_parameters() if name.startswith("head.refiner.")
        }

    def test_feature_the_masks_alone_learn_through_a_network_that_stays(self, monkeypatch):
        module = made(learn="masks", closed_form=True, task="edof", ema=0.9, lr_metres=1e-8)
        optimizer = module.configure_optimizers()
        (group,) = optimizer.param_groups
        assert {id(p) for p in group["params"]} == {id(p) for p in module.optics.parameters()}
        assert module.average is None
        assert module.train().training
        assert not module.head.training
        monkeypatch.setattr(module, "log", lambda *args, **options: None)
        before = {name: value.clone() for name, value in module.state_dict().items() if isinstance(value, torch.Tensor)}
        module.training_step(batch(), 0).backward()
        optimizer.step()
        changed = {name for name, value in before.items() if not torch.equal(value, module.state_dict()[name])}
        assert "optics.masks.phase" in changed
        network = changed - {"optics.masks.phase"}
        assert all(name.startswith("head.closed_form.") for name in network)  # it follows the camera

    def test_feature_masks_see_each_scene_with_a_noise_of_its_own_and_the_network_is_told(self, monkeypatch):
        module = made(learn="masks", closed_form=True, task="edof", noise_range=(0.001, 0.001), electrons=(100, 100))
        told, own = [], module.optics.sensor
        monkeypatch.setattr(module.head, "forward", lambda coded, noise: told.append(noise) or coded)
        scenes = batch(8)
        coded = module.reconstruct(scenes).coded
        assert torch.equal(coded, module.reconstruct(scenes).coded)  # noise and sensors follow from the batch
        assert module.optics.sensor is own
        levels = told[0].amin((1, 2, 3))
        reads = levels == 0.001
        assert 0 < reads.sum() < 8  # half of the sensors have shot noise, here 2.4 electrons of 100 in the dark
        electrons = electrons_at(module.optics.camera.f_number, 100, 17.6)
        assert torch.equal(told[0][reads], torch.full_like(told[0][reads], 0.001))
        light = module.optics.decode(coded[~reads])
        wanted = ((2.4 / electrons) ** 2 + light / electrons).sqrt()
        self.assert_close(told[0][~reads], wanted, rtol=1e-4, atol=1e-6)

    def test_exception_there_is_no_refiner(self):
        with pytest.raises(ValueError, match="needs a JointClosedFormHead with a refiner"):
            TidyTraining(build_optics(SETTINGS), nn.Identity(), SETTINGS, **REFINED)

    def test_feature_the_psnr_of_validation_is_that_of_the_clipped_image(self, monkeypatch):
        module, logged = made(task="edof", learn="network").eval(), {}
        monkeypatch.setattr(module, "forward", lambda coded, noise=None: coded + 5)
        monkeypatch.setattr(module, "log_dict", lambda scores, **options: logged.update(scores))
        known, half = torch.ones(1, 1, 8, 8, dtype=torch.bool), torch.full((1, 3, 8, 8), 0.5)
        scene = {"coded": half, "image": half, "inverse_depth": known.float(), "mask": known}
        module.validation_step(scene, 0)
        assert float(logged["val_image_psnr"]) == pytest.approx(20 * math.log10(2), abs=1e-4)
        assert float(logged["val_image_rmse"]) == pytest.approx(5)

    def test_exception_a_broken_batch_tells_why(self):
        with pytest.raises(ValueError, match="scene 3 is gone"):
            made().reconstruct(Broken("scene 3 is gone"))

    def test_exception_unknown_task(self):
        with pytest.raises(ValueError, match="task must be one of"):
            TidyTraining(build_optics(SETTINGS), nn.Identity(), task="all")


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    module, run = made(), trainer(folder)
    run.fit(module, SceneLoader(DeadLeaves(2, 48, 48), 1))
    run.save_checkpoint(folder / "a.safetensors")
    return module, folder / "a.safetensors"


class TestCheckpoint(BaseTester):
    def test_feature_a_trained_system_takes_the_same_pictures_and_sees_the_same(self, saved):
        module, path = saved
        system = load_trained(path)
        sample = batch()
        module.eval()
        noise = torch.Generator().manual_seed(1)
        coded = system.optics(sample["image"], sample["depth"], generator=noise)
        assert torch.equal(coded, module.optics(sample["image"], sample["depth"], generator=noise.manual_seed(1)))
        assert torch.equal(system.head(coded), module(coded))
        assert TrainingSettings.of(system) == module.settings
        assert system.step == 2

    @pytest.mark.parametrize(
        "options",
        [
            {"refocus": 2},
            {"closed_form": True},
            {"closed_form": True, "refocus": 2},
            {"closed_form": True, "refocus": 2, "fine": True},
        ],
    )
    def test_feature_a_network_that_refocuses_looks_through_the_masks_as_they_were_learnt(self, options, tmp_path):
        module, run = made(**options), trainer(tmp_path)
        before = module.optics.masks.phase.detach().clone()
        run.fit(module, SceneLoader(DeadLeaves(2, 48, 48), 1))
        run.save_checkpoint(tmp_path / "a.safetensors")
        system = load_trained(tmp_path / "a.safetensors")
        assert not torch.equal(module.optics.masks.phase, before)
        coded = module.eval().reconstruct(batch()).coded
        # PSFs with and without gradients are computed in two ways, equal to round-off.
        torch.testing.assert_close(system.head(coded), module(coded), rtol=1e-5, atol=1e-5)

    def test_feature_weights_go_into_objects_of_ones_own(self, saved):
        module, path = saved
        optics, head = TiDyOptics(PixelwiseMask(2)), made().head
        load_weights(path, optics, head)
        assert torch.equal(optics.masks.phase, module.optics.masks.phase)
        assert torch.equal(head.layers[0].weight, module.average.network.layers[0].weight)

    def test_exception_other_weights_are_refused_before_anything_is_loaded(self, saved):
        optics, head = TiDyOptics(PixelwiseMask(3)), made().head
        before = head.layers[0].weight.detach().clone()
        with pytest.raises(ValueError, match=r"masks.phase is \(2, 23, 23\), wanted \(3, 23, 23\)"):
            load_weights(saved[1], optics, head)
        assert torch.equal(head.layers[0].weight, before)

    @pytest.mark.parametrize(
        ("changes", "sentence"),
        [
            ({"task": "edof"}, r"task \(joint / edof\)"),
            ({"focal_length": 0.06}, r"camera \(ThinLensCamera.*/ ThinLensCamera"),
            ({"sigma": 0.02}, r"sensor \(SensorNoise\(read noise 0.01.*/ SensorNoise\(read noise 0.02"),
            ({"border": "zero"}, r"border \(reflect / zero\)"),
            ({"width": 5}, r"head.layers.0.weight is \(4, 3, 3, 3\), wanted \(5, 3, 3, 3\)"),
            ({"ema": 0.0}, "unknown average.steps"),
        ],
    )
    def test_exception_a_run_that_differs_is_not_resumed_from_it(self, changes, sentence, saved, tmp_path):
        module = made(**changes)
        with pytest.raises(ValueError, match=sentence):
            trainer(tmp_path).fit(module, SceneLoader(DeadLeaves(2, 48, 48), 1), ckpt_path=saved[1])

    def test_exception_objects_of_ones_own_cannot_be_made_from_a_file(self, tmp_path):
        module, run = TidyTraining(build_optics(SETTINGS), made().head, task="joint"), trainer(tmp_path, 1)
        run.fit(module, SceneLoader(DeadLeaves(1, 48, 48), 1))
        run.save_checkpoint(tmp_path / "b.safetensors")
        with pytest.raises(ValueError, match="were given as objects"):
            load_trained(tmp_path / "b.safetensors")

    @pytest.mark.parametrize("averaged", [False, True])
    def test_feature_lightning_restores_the_camera_of_a_checkpoint(self, averaged, tmp_path):
        """Its masks had moved since its window was chosen, and the camera it is loaded into has another window."""

        def own(masks):
            return {"optics": TiDyOptics(masks, fidelity="draft", border="zero"), "head": nn.Conv2d(3, 3, 1)}

        module = TidyTraining(**own(PixelwiseMask(1, generator=torch.Generator().manual_seed(0))), ema=0.0)
        window = module.optics.window
        with torch.no_grad():
            module.optics.masks.phase.mul_(0.2)
        average = [pl.callbacks.EMAWeightAveraging(decay=0.5)] if averaged else []
        run = pl.Trainer(
            default_root_dir=tmp_path, max_steps=2, accelerator="cpu", logger=False, enable_checkpointing=False,
            enable_progress_bar=False, enable_model_summary=False, callbacks=average,
        )  # fmt: skip
        run.fit(module, SceneLoader(DeadLeaves(2, 48, 48), 1))
        run.save_checkpoint(tmp_path / "a.ckpt")
        flat = own(PixelwiseMask(1, initial="flat"))
        assert flat["optics"].window != window
        again = TidyTraining.load_from_checkpoint(tmp_path / "a.ckpt", weights_only=True, **flat, ema=0.0)
        assert again.optics.window == window
        sample, noise = batch(), torch.Generator()
        expected = module.optics(sample["image"], sample["depth"], generator=noise.manual_seed(1))
        coded = again.optics(sample["image"], sample["depth"], generator=noise.manual_seed(1))
        assert torch.equal(coded, expected)
        other = {"optics": TiDyOptics(PixelwiseMask(1), fidelity="draft"), "head": flat["head"]}
        with pytest.raises(ValueError, match=r"border \(zero / reflect\)"):
            TidyTraining.load_from_checkpoint(tmp_path / "a.ckpt", weights_only=True, **other, ema=0.0)

    def test_exception_names_of_missing_and_unknown_weights(self):
        with pytest.raises(ValueError, match="x does not fit: missing weight, bias; unknown other"):
            check_weights(nn.Linear(1, 1), {"other": torch.ones(1)}, "x")
