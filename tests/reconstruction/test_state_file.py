from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import save_file

from kornia_tidy.reconstruction.state_file import FORMAT, read_state, write_state
from tests.base import BaseTester

KEYS = st.one_of(st.text(max_size=5), st.integers(-3, 3))
LEAVES = st.one_of(
    st.none(), st.booleans(), st.integers(-(2**70), 2**70), st.floats(allow_nan=False), st.text(max_size=5)
)
TREES = st.recursive(
    LEAVES,
    lambda inner: st.one_of(
        st.lists(inner, max_size=3),
        st.lists(inner, max_size=3).map(tuple),
        st.dictionaries(KEYS, inner, max_size=3),
    ),
    max_leaves=12,
)


class TestStateFile(BaseTester):
    @pytest.mark.takes_seconds
    @settings(max_examples=60)
    @given(tree=st.dictionaries(st.text(max_size=5), TREES, max_size=3))
    def test_feature_any_nesting_of_plain_values_comes_back_as_it_was(self, tree, tmp_path_factory):
        path = tmp_path_factory.getbasetemp() / "tree.safetensors"
        write_state(path, tree)
        back = read_state(path)
        assert back == tree
        assert repr(back) == repr(tree)  # 1 == True == 1.0, and dictionaries of another order

    @pytest.mark.parametrize(
        "kind", [torch.float32, torch.float64, torch.bfloat16, torch.int64, torch.uint8, torch.bool]
    )
    def test_feature_tensors_keep_type_shape_and_bits(self, kind, tmp_path):
        tensors = [torch.rand(2, 3).mul(9).to(kind), torch.zeros((), dtype=kind), torch.zeros(0, 2, dtype=kind)]
        write_state(tmp_path / "a", {"here": tensors})
        for one, other in zip(read_state(tmp_path / "a")["here"], tensors, strict=True):
            assert one.dtype == other.dtype
            assert torch.equal(one, other)

    def test_feature_tensors_may_share_memory_and_be_strided(self, tmp_path):
        whole = torch.arange(12.0).view(3, 4)
        write_state(tmp_path / "a", {"whole": whole, "row": whole[1], "turned": whole.T, 4: {0: whole}})
        back = read_state(tmp_path / "a")
        assert torch.equal(back["row"], whole[1])
        assert torch.equal(back["turned"], whole.T)
        assert torch.equal(back[4][0], whole)

    def test_feature_infinity_and_nan_come_back(self, tmp_path):
        write_state(tmp_path / "a", {"best": math.inf, "score": math.nan})
        back = read_state(tmp_path / "a")
        assert back["best"] == math.inf
        assert math.isnan(back["score"])

    @pytest.mark.parametrize("foreign", [object(), np.float64(1.0), {1, 2}, b"bytes", print])
    def test_exception_anything_else_is_named_by_its_place(self, foreign, tmp_path):
        with pytest.raises(TypeError, match=r"/callbacks/1/thing is <class"):
            write_state(tmp_path / "a", {"callbacks": [1, {"thing": foreign}]})
        assert list(tmp_path.iterdir()) == []

    @pytest.mark.parametrize("keep", [5, 100, -1])
    def test_exception_a_damaged_file_is_refused(self, keep, tmp_path):
        path = tmp_path / "a.safetensors"
        write_state(path, {"weights": torch.rand(100)})
        path.write_bytes(path.read_bytes()[:keep])
        with pytest.raises(ValueError, match=r"a.safetensors: it is no checkpoint of kornia_tidy or is damaged"):
            read_state(path)

    def test_exception_other_files_are_refused(self, tmp_path):
        save_file({"weight": torch.ones(2)}, tmp_path / "a.safetensors", {"format": "pt"})
        torch.save({"weight": torch.ones(2)}, tmp_path / "a.ckpt")
        with pytest.raises(ValueError, match="its format is 'pt'"):
            read_state(tmp_path / "a.safetensors")
        with pytest.raises(ValueError, match="no checkpoint"):
            read_state(tmp_path / "a.ckpt")
        with pytest.raises(FileNotFoundError, match="there is no such file"):
            read_state(tmp_path / "none")

    @pytest.mark.parametrize(
        "state",
        [
            "[1, 2]",
            "[" * 100_000,
            '{"a": ' + "[" * 600 + "]" * 600 + "}",
            '{"a": {"$tensor": ["x"]}}',
            '{"a": {"$pairs": 3}}',
            "\x00",
        ],
    )
    def test_exception_a_state_that_cannot_be(self, state, tmp_path):
        save_file({"weight": torch.ones(2)}, tmp_path / "a", {"format": FORMAT, "state": state})
        with pytest.raises(ValueError, match="it is no checkpoint of kornia_tidy or is damaged"):
            read_state(tmp_path / "a")

    @pytest.mark.parametrize(
        ("state", "sentence"),
        [
            ('[{"$tensor": "q"}, {"$tensor": "q"}]', "'q' stands in two places"),
            ('[{"$tensor": "q", "$scale": "s"}, {"$tensor": "q", "$scale": "s"}]', "'q' stands in two places"),
            ('[{"$tensor": "q", "$scale": "s"}, {"$tensor": "p", "$scale": "s"}]', "'s' stands in two places"),
            ('[{"$tensor": "q", "$scale": "q"}]', "'q' stands in two places"),
            ('[{"$tensor": "row", "$scale": "s"}]', r"a scale of \(2, 1\) does not fit a weight of \(1, 4\)"),
            ('[{"$tensor": "q", "$scale": "wide"}]', r"a scale of \(2, 4\) does not fit a weight of \(2, 4\)"),
            ('[{"$tensor": "none"}]', "no tensor 'none'"),
        ],
    )
    def test_exception_a_tensor_cannot_unfold(self, state, sentence, tmp_path):
        """Neither by standing in many places nor by a scale that it would be expanded to."""
        tensors = {name: torch.ones(2, 4, dtype=torch.int8) for name in "pq"}
        tensors |= {"row": torch.ones(1, 4, dtype=torch.int8), "s": torch.ones(2, 1), "wide": torch.ones(2, 4)}
        save_file(tensors, tmp_path / "a", {"format": FORMAT, "state": f'{{"a": {state}}}'})
        with pytest.raises(ValueError, match=sentence):
            read_state(tmp_path / "a")

    def test_feature_names_with_slashes_keep_their_tensors_apart(self, tmp_path):
        state = {
            "a/b": torch.zeros(1),
            "a": {"b": torch.ones(1), "b'": torch.full((1,), 2.0)},
            "$a": {1: torch.ones(2)},
        }
        write_state(tmp_path / "a", state)
        back = read_state(tmp_path / "a")
        assert [back["a/b"].item(), back["a"]["b"].item(), back["a"]["b'"].item()] == [0, 1, 2]
