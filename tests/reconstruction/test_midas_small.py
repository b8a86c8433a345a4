"""MiDaS Small against the published network's names and numbers, and files in the published format."""

from __future__ import annotations

import json
import math

import pytest
import torch

from kornia_tidy.reconstruction import MiDaSSmall, load_midas_small
from tests.base import BaseTester, shared


def wave_state(head):
    """Weights that anyone can make: sines of their index, scaled by what kind of weight they are."""
    state = {}
    for index, (name, value) in enumerate(head.state_dict().items()):
        a = torch.sin(0.7391 * torch.arange(value.numel(), dtype=torch.float64) + index).view(value.shape)
        if name.endswith("num_batches_tracked"):
            state[name] = torch.zeros_like(value)
        elif name.endswith("running_var"):
            state[name] = (1 + 0.2 * a).float()
        elif name.endswith(("running_mean", "bias")):
            state[name] = (0.05 * a).float()
        elif value.ndim == 4:
            state[name] = (a * math.sqrt(2 / value[0].numel())).float()
        else:
            state[name] = (1 + 0.1 * a).float()
    return state


@pytest.fixture(scope="module")
def published():
    return wave_state(MiDaSSmall())


class TestMiDaSSmall(BaseTester):
    def test_feature_names_shapes_and_order_are_the_published_ones(self):
        published = json.loads(shared("midas-small-keys.json").read_text())
        with torch.device("meta"):
            state = MiDaSSmall().state_dict()
        assert [[name, list(value.shape)] for name, value in state.items()] == published

    def test_feature_outputs_are_those_of_the_published_network(self, published):
        """Literals: the network of isl-org/MiDaS at 4545977 with the same weights and normalised input, float64."""
        head = MiDaSSmall().eval()
        head.load_state_dict(published)
        head.double().requires_grad_(False)
        features = []
        head.pretrained.layer4.register_forward_hook(lambda _, i, o: features.append(o))
        normalised = torch.sin(0.01 * torch.arange(3 * 64 * 96, dtype=torch.float64)).view(1, 3, 64, 96)
        mean, deviation = torch.tensor([[0.485, 0.456, 0.406], [0.229, 0.224, 0.225]]).double()[..., None, None]
        out = head(normalised * deviation + mean)
        assert out.shape == (1, 1, 64, 96)
        assert out.sum().item() == pytest.approx(1.363470962e03, rel=1e-6)
        assert out[0, 0, 0, 0].item() == pytest.approx(1.027525134e-01, rel=1e-6)
        assert out[0, 0, 63, 95].item() == pytest.approx(4.669377914e-02, rel=1e-6)
        assert out.max().item() == pytest.approx(1.417551061, rel=1e-6)
        assert out.count_nonzero() == 3041
        assert features[0].sum().item() == pytest.approx(-3.390544110, rel=1e-6)
        assert features[0].abs().sum().item() == pytest.approx(2.978493232e03, rel=1e-6)

    def test_convention_imagenets_mean_colour_is_zero_inside(self, device, dtype):
        head = MiDaSSmall().to(device, dtype).eval()
        seen = []
        head.pretrained.register_forward_pre_hook(lambda _, i: seen.append(i[0]))
        colours = torch.tensor([[0.485, 0.456, 0.406], [0.714, 0.68, 0.631]], device=device, dtype=dtype)
        head(colours[..., None, None].expand(2, 3, 32, 32))
        expected = torch.tensor([0.0, 1.0], device=device, dtype=dtype).view(2, 1, 1, 1).expand(2, 3, 32, 32)
        self.assert_close(seen[0], expected, atol=1e-6)


class TestLoadMiDaSSmall(BaseTester):
    @staticmethod
    def saved(path, state, **options):
        torch.save(state, path, **options)
        return path

    @pytest.mark.parametrize("kind", ["plain", "wrapped", "old archive"])
    def test_feature_a_file_in_the_published_format_is_read(self, kind, published, tmp_path):
        state = {"model": published, "epoch": 3} if kind == "wrapped" else published
        zipped = kind != "old archive"
        path = self.saved(tmp_path / "midas.pt", state, _use_new_zipfile_serialization=zipped)
        head = load_midas_small(path)
        assert all(torch.equal(value, published[name]) for name, value in head.state_dict().items())
        assert not head.scratch.refinenet4.resConfUnit1.conv1.weight.requires_grad
        assert head.scratch.refinenet4.resConfUnit2.conv1.weight.requires_grad
        if kind == "plain":
            assert 0 < head.eval()(torch.rand(1, 3, 32, 32)).max() < 100

    def test_feature_weights_stored_in_half_precision_become_the_networks(self, published, tmp_path):
        path = self.saved(tmp_path / "midas.pt", {k: v.half() if v.ndim else v for k, v in published.items()})
        head = load_midas_small(path)
        assert {p.dtype for p in head.parameters()} == {torch.float32}
        name = "scratch.layer1_rn.weight"
        assert torch.equal(head.state_dict()[name], published[name].half().float())

    @pytest.mark.parametrize(
        ("damage", "sentence"),
        [
            (lambda s: s.pop("scratch.layer1_rn.weight"), "1 of 482 weights are missing, first scratch.layer1_rn"),
            (lambda s: s.update(more=torch.zeros(1)), "1 weights are unknown, first more"),
            (
                lambda s: s.update({"scratch.layer1_rn.weight": torch.zeros(64, 32, 1, 1)}),
                r"scratch.layer1_rn.weight must have shape \(64, 32, 3, 3\), got \(64, 32, 1, 1\)",
            ),
            (
                lambda s: s.update({"scratch.layer1_rn.weight": 1.0}),
                r"scratch.layer1_rn.weight must have shape \(64, 32, 3, 3\), got float",
            ),
        ],
    )
    def test_exception_names_the_weight(self, damage, sentence, published, tmp_path):
        state = dict(published)
        damage(state)
        state = {k: torch.zeros(()).expand(v.shape) if torch.is_tensor(v) else v for k, v in state.items()}
        path = self.saved(tmp_path / "midas.pt", state)
        with pytest.raises(ValueError, match=f"cannot read .*midas.pt: {sentence}"):
            load_midas_small(path)

    @pytest.mark.parametrize(
        ("content", "sentence"),
        [(b"version https://git-lfs.github.com/spec/v1", "a pointer"), (b"PK\x03\x04 cut", "must be a state dict")],
    )
    def test_exception_names_a_file_that_is_something_else(self, content, sentence, tmp_path):
        path = tmp_path / "midas.pt"
        path.write_bytes(content)
        with pytest.raises(ValueError, match=f"cannot read .*midas.pt: it .*{sentence}"):
            load_midas_small(path)

    def test_exception_names_what_is_no_state_dict(self, tmp_path):
        with pytest.raises(ValueError, match="must hold a state dict, got list"):
            load_midas_small(self.saved(tmp_path / "midas.pt", [torch.zeros(1)]))
        with pytest.raises(FileNotFoundError, match="there is no such file"):
            load_midas_small(tmp_path / "none.pt")
        with pytest.raises(ValueError, match="it is a folder"):
            load_midas_small(tmp_path)
