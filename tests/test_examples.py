from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path
from types import ModuleType

import cv2
import pytest
import torch

from kornia_tidy.data import write_depth, write_image
from tests.base import BaseTester

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
NAMES = sorted(path.stem for path in EXAMPLES.glob("*.py"))


@pytest.fixture
def example(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(EXAMPLES)  # not by file, so that a data loader's workers can import it too
    return importlib.import_module(request.param)


def picture(path: Path) -> torch.Tensor:
    read = cv2.imread(str(path))
    assert read is not None, f"{path} is not a picture"
    return torch.from_numpy(read)


@pytest.fixture
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("example", NAMES, indirect=True)
class TestEveryExample(BaseTester):
    def test_smoke_help_teaches(self, example, capsys):
        with pytest.raises(SystemExit) as leaving:
            example.main(["--help"])
        assert leaving.value.code == 0
        assert f"python examples/{example.__name__}.py" in capsys.readouterr().out

    def test_exception_unknown_options_are_refused(self, example):
        with pytest.raises(SystemExit):
            example.main(["--nonsense"])


class TestStartNotebook(BaseTester):
    @pytest.fixture
    def cells(self):
        notebook = json.loads((EXAMPLES / "start.ipynb").read_text(encoding="utf-8"))
        return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]

    @pytest.mark.takes_seconds
    def test_feature_its_cells_run_in_their_order_and_show_what_they_say(self, cells, capsys):
        pyplot = pytest.importorskip("matplotlib.pyplot")
        pyplot.switch_backend("agg")  # draws no window
        names = {"__name__": "__main__"}
        for number, cell in enumerate(cells):
            exec(compile("".join(cell["source"]), f"start.ipynb, code cell {number}", "exec"), names)
        assert len(pyplot.get_fignums()) == 6
        pyplot.close("all")
        told = dict(line.strip().split(": ") for line in capsys.readouterr().out.splitlines() if line.endswith(" dB"))
        plain, coded, restored = (float(told[name].split()[0]) for name in ("its restoration", "coded", "restored"))
        assert restored > max(plain, coded) + 2
        assert names["losses"][-1] < 0.6 * names["losses"][0]

    def test_feature_it_is_kept_without_outputs(self, cells):
        assert [cell["id"] for cell in cells if cell["outputs"] or cell["execution_count"] is not None] == []


@pytest.mark.parametrize("example", ["simulate_photo"], indirect=True)
class TestSimulatePhoto(BaseTester):
    def test_feature_the_made_up_scene_is_blurred(self, example, tmp_path, capsys):
        coded = example.main(["--size", "96", "--output", str(tmp_path)])
        before, after = picture(tmp_path / "scene.png").float(), picture(coded).float()
        assert before.shape == after.shape == (96, 96, 3)
        assert after.std() < before.std()
        assert "f/17.6" in capsys.readouterr().out

    def test_feature_own_files_and_a_seed_repeat_the_same_photo(self, example, tmp_path):
        image, depth = torch.rand(3, 70, 80), torch.full((1, 70, 80), 1.25)
        write_image(tmp_path / "image.png", image)
        write_depth(tmp_path / "depth.png", depth, scale=0.001)
        files = ["--image", str(tmp_path / "image.png"), "--depth", str(tmp_path / "depth.png")]
        runs = [
            picture(example.main([*files, "--depth-scale", "0.001", "--output", str(tmp_path / name)])) for name in "ab"
        ]
        assert runs[0].shape == (70, 80, 3)
        assert torch.equal(*runs)

    def test_exception_image_and_depth_go_together(self, example, capsys):
        with pytest.raises(SystemExit):
            example.main(["--image", "a.png"])
        assert "go together" in capsys.readouterr().err


@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
@pytest.mark.parametrize("example", ["dataloader_transform"], indirect=True)
class TestDataLoaderTransform(BaseTester):
    @pytest.mark.parametrize("workers", ["0", "2"])
    def test_feature_workers_give_the_same_bits(self, example, workers, capsys, two_threads):
        """A worker has one thread, however many this process has."""
        batches = example.main(["--items", "3", "--size", "64", "--batch", "2", "--workers", workers])
        assert [tuple(batch.shape) for batch in batches] == [(2, 3, 64, 64), (1, 3, 64, 64)]
        out = capsys.readouterr().out
        assert "bit for bit the same: True" in out
        assert "gradients: False" in out


@pytest.mark.parametrize("example", ["learn_point_psf"], indirect=True)
class TestLearnPointPSF(BaseTester):
    @pytest.mark.takes_seconds
    def test_feature_learnt_masks_beat_a_plain_lens(self, example, tmp_path):
        lens = example.TiDyOptics(example.PixelwiseMask(1, initial="flat"), fidelity=example.FIDELITY)
        plain = float(example.point_error(lens).detach())
        finals = example.main(["--masks", "1", "2", "--trials", "2", "--iterations", "60", "--output", str(tmp_path)])
        assert sorted(finals) == [1, 2]
        assert max(error for errors in finals.values() for error in errors) < plain
        assert picture(tmp_path / "learn_point_psf.png").float().std() > 20


@pytest.mark.parametrize("example", ["nonconvex_psfs"], indirect=True)
class TestNonconvexPSFs(BaseTester):
    def test_feature_only_single_masks_reach_one(self, example, tmp_path):
        bounds = example.main(["--masks", "3", "--sets", "20", "--output", str(tmp_path)])
        assert (bounds[1] - 1).abs().max() < 1e-9
        assert max(bounds[2].max(), bounds[3].max()) < 1
        assert picture(tmp_path / "nonconvex_psfs.png").float().std() > 20


@pytest.mark.parametrize("example", ["mask_families"], indirect=True)
class TestMaskFamilies(BaseTester):
    @pytest.mark.takes_seconds
    def test_feature_every_family_learns_both_tasks(self, example, capsys):
        histories = example.main(["--trials", "2", "--iterations", "25"])
        assert len(histories) == 2 * len(example.FAMILIES) >= 12
        for runs in histories.values():
            assert len(runs) == 2
            assert min(runs[0][-1] / runs[0][0], runs[1][-1] / runs[1][0]) < 0.99
        assert max(errors[-1] for errors in histories["pixelwise", "target"]) < 0.4
        lines = capsys.readouterr().out.splitlines()
        assert len(lines) == 2 + len(histories)
        assert lines[2].startswith("pixelwise  point")


@pytest.mark.parametrize("example", ["learn_with_switching"], indirect=True)
class TestLearnWithSwitching(BaseTester):
    @pytest.mark.takes_seconds
    @pytest.mark.parametrize("between", ["exponential", "random"])
    def test_feature_masks_that_know_of_switching_lose_less(self, example, between, tmp_path):
        few = ["--masks", "3", "--trials", "1", "--iterations", "60", "--output", str(tmp_path)]
        errors = example.main([*few, "--between", between, "--switching-time", "0.03"])
        without, known, dwell = (trials[0] for trials in errors.values())
        assert without[0] < known[0]  # nothing is free: without switching, masks learnt without it are better
        assert known[-1] < without[-1]
        assert known[-1] - known[0] < without[-1] - without[0]
        assert len(dwell) == len(known) == 6
        assert picture(tmp_path / f"learn_with_switching_{between}.png").float().std() > 20


@pytest.mark.parametrize("example", ["time_average_or_burst"], indirect=True)
class TestTimeAverageOrBurst(BaseTester):
    def test_feature_the_dark_favours_one_exposure_and_light_the_burst(self, example, tmp_path, capsys):
        few = ["--masks", "3", "--size", "96", "--iterations", "40", "--output", str(tmp_path)]
        result = example.main([*few, "--electrons", "10", "10000"])
        single, added, every = result.values()
        assert single[0] > max(added[0], every[0]) + 1
        assert every[1] > single[1]
        assert single[1] > added[1]
        assert "84% of the light, readouts: 3, pictures stored: 1" in capsys.readouterr().out
        assert picture(tmp_path / "time_average_or_burst.png").float().std() > 20


@pytest.mark.parametrize("example", ["design_masks"], indirect=True)
class TestDesignMasks(BaseTester):
    @pytest.mark.takes_seconds
    def test_feature_each_design_is_the_best_at_its_task(self, example, tmp_path, monkeypatch):
        monkeypatch.setattr(example, "FIDELITY", example.FIDELITY.replace(layer_spacing=2.0))
        scores = example.main(["--iterations", "60", "--output", str(tmp_path)])
        assert min(scores, key=lambda name: scores[name][0]) == "depth design"
        assert min(scores, key=lambda name: scores[name][1]) == "EDoF design"
        assert picture(tmp_path / "design_masks.png").float().std() > 20


@pytest.mark.parametrize("example", ["motion_blur"], indirect=True)
class TestMotionBlur(BaseTester):
    @pytest.mark.takes_seconds
    def test_feature_only_masks_that_change_tell_right_from_left(self, example, tmp_path):
        few = ["--masks", "3", "--pixels", "8", "--size", "112", "--iterations", "30", "--output", str(tmp_path)]
        one, random, learnt = (apart for apart, _ in example.main(few).values())
        assert one < 1e-6
        assert min(random, learnt) > 1e-3
        assert picture(tmp_path / "motion_blur.png").float().std() > 20


@pytest.mark.parametrize("example", ["plain_training_loop"], indirect=True)
class TestPlainTrainingLoop(BaseTester):
    @pytest.mark.takes_seconds
    def test_feature_the_loss_falls_in_under_forty_lines(self, example, capsys):
        losses = example.main(["--steps", "30"])
        assert len(losses) == 30
        assert sum(losses[-5:]) < 0.8 * sum(losses[:5])
        assert "at first" in capsys.readouterr().out
        assert len(Path(example.__file__).read_text().splitlines()) < 40


@pytest.mark.filterwarnings("ignore:.*LeafSpec:FutureWarning", "ignore:.*does not have many workers")
@pytest.mark.filterwarnings("ignore:.*smaller than the logging interval")
@pytest.mark.parametrize("example", ["lightning_training"], indirect=True)
class TestLightningTraining(BaseTester):
    @pytest.mark.takes_seconds
    def test_feature_a_network_of_ones_own_is_trained_saved_and_used(self, example, tmp_path):
        pytest.importorskip("lightning.pytorch")
        error = example.main(["--epochs", "2", "--scenes", "8", "--size", "48", "--output", str(tmp_path)])
        assert 0 < error < 0.3
        assert {"best.safetensors", "last.safetensors"} == {path.name for path in tmp_path.iterdir()}


@pytest.mark.parametrize("example", ["train_on_rendered"], indirect=True)
class TestTrainOnRendered(BaseTester):
    @pytest.mark.takes_seconds
    def test_feature_the_loss_falls_and_captures_are_made_once(self, example, tmp_path, capsys):
        few = ["--scenes", "8", "--size", "64", "--epochs", "6", "--output", str(tmp_path)]
        losses = example.main(few)
        assert len(losses) == 12
        assert sum(losses[-4:]) < 0.8 * sum(losses[:4])
        assert "8 captures made, 0 found" in capsys.readouterr().out
        assert example.main(few) == losses
        assert "0 captures made, 8 found" in capsys.readouterr().out


@pytest.mark.parametrize("example", ["ray_rendering"], indirect=True)
class TestRayRendering(BaseTester):
    def test_exception_without_ray_it_says_how_to_install_it(self, example, monkeypatch):
        monkeypatch.setitem(sys.modules, "ray", None)
        with pytest.raises(SystemExit, match=r"this example needs Ray: pip install 'ray\[data\]'"):
            example.main([])
