from __future__ import annotations

import gc
import sys

import pytest
import torch
from safetensors.torch import save_file

from kornia_tidy.tensor_files import read_tensors
from tests.base import BaseTester

COUNT, TIMES = 20, 50


class TestReadTensors(BaseTester):
    def test_smoke(self, tmp_path):
        save_file({"a": torch.ones(2, 3), "b": torch.zeros(0, 4)}, tmp_path / "x.safetensors", {"of": "a test"})
        tensors, header = read_tensors(tmp_path / "x.safetensors")
        assert header == {"of": "a test"}
        assert {name: tuple(tensor.shape) for name, tensor in tensors.items()} == {"a": (2, 3), "b": (0, 4)}

    @pytest.mark.parametrize("kind", [
        torch.float64, torch.float32, torch.float16, torch.bfloat16, torch.complex64, torch.int64, torch.int32,
        torch.int16, torch.int8, torch.uint8, torch.bool,
    ])  # fmt: skip
    def test_cardinality(self, tmp_path, kind):
        written = {"scalar": torch.tensor(3).to(kind), "odd": torch.arange(15).reshape(3, 5).to(kind)}
        save_file(written, tmp_path / "x.safetensors")
        tensors, header = read_tensors(tmp_path / "x.safetensors")
        assert header == {}
        for name, tensor in written.items():
            assert tensors[name].dtype == kind
            assert torch.equal(tensors[name], tensor)

    def test_feature_a_tensor_may_be_changed_and_outlives_the_file(self, tmp_path):
        path = tmp_path / "x.safetensors"
        save_file({"a": torch.zeros(1000)}, path)
        tensors, _ = read_tensors(path)
        path.write_bytes(b"")
        tensors["a"] += 1
        assert bool((tensors["a"] == 1).all())

    def test_feature_reading_leaves_nothing_in_memory(self, tmp_path):
        """``safe_open(...).get_tensor`` of safetensors 0.8 leaves two integers for each tensor."""
        path = tmp_path / "x.safetensors"
        save_file({f"tensor {number}": torch.zeros(1000) for number in range(COUNT)}, path, {"of": "a test"})
        read_tensors(path)
        gc.collect()
        before = sys.getallocatedblocks()
        for _ in range(TIMES):
            read_tensors(path)
        gc.collect()
        assert sys.getallocatedblocks() - before < COUNT * TIMES // 2

    @pytest.mark.parametrize("damage", [
        lambda data: data[:-1], lambda data: data + b"\0", lambda data: data[:7],
        lambda data: data.replace(b'"F32"', b'"F33"'), lambda data: data.replace(b"[2,3]", b"[2,4]"),
    ])  # fmt: skip
    def test_exception_names_the_damaged_file(self, tmp_path, damage):
        path = tmp_path / "x.safetensors"
        save_file({"a": torch.ones(2, 3)}, path)
        path.write_bytes(damage(path.read_bytes()))
        with pytest.raises(ValueError, match=r"cannot read .*x\.safetensors: it is no mask or is damaged: "):
            read_tensors(path, "mask")

    def test_exception_a_header_of_very_many_tensors(self, tmp_path):
        """Each takes 26 times its entry: 100 MB, which safetensors allows, would take 2.5 GB."""
        entry = '"%x":{"dtype":"F32","shape":[0],"data_offsets":[0,0]}'
        header = f"{{{','.join(entry % i for i in range(320_000))}}}".encode()
        (tmp_path / "x.safetensors").write_bytes(len(header).to_bytes(8, "little") + header)
        with pytest.raises(ValueError, match=r"its header must have at most 16777216 bytes, got 1[78]\d{6}"):
            read_tensors(tmp_path / "x.safetensors")
