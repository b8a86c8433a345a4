"""Kernels in Triton as the operators of gather and occlusion, on random calls of the C sources; compiled for GPUs."""

from __future__ import annotations

import os
import random
import subprocess
import sys

import pytest
import torch
from torch import Tensor

from kornia_tidy.kernels import gather_ops, occlusion_ops, triton_ops
from tests.base import BaseTester
from tests.kernels import kernel_shapes
from tests.kernels.operator_tester import needs_compiler
from tests.triton_interpreter import DEVICE, needs_triton

CHEAP = 200  # taps of tiles, or rows of products, of a call: the interpreter takes some milliseconds for each
IN_TRITON = {
    "gather": gather_ops._gather_in_triton,
    "correlate": gather_ops._psf_gradient_in_triton,
    "occlude": occlusion_ops._occlude_in_triton,
}
# Triton compiles without a GPU, in a process that does not interpret.
COMPILED = """
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from kornia_tidy.kernels import triton_kernels

TILE = {"ROWS": 8, "COLUMNS": 32}
CONSTANTS = {
    "gather_kernel": {"PADDED": True, "LINEAR": True, "WEIGHT_GRADIENT": False, **TILE},
    "scatter_kernel": {"PADDED": True, "LINEAR": True, **TILE},
    "occlusion_kernel": {"EPSILON": 1e-6, "LINEAR": True, "STRAY": True, "SPAN": 32, **TILE},
    "correlate_kernel": {"LINEAR": True, "WEIGHT_GRADIENT": False, "LAYERS": 16, "TAPS": 64, "PIXELS": 32},
}
POINTERS = ("light", "taps", "weight", "out", "values", "mean", "stray_light")
for name, constants in CONSTANTS.items():
    kernel = getattr(triton_kernels, name)
    for real in ("fp32", "fp64"):
        types = {
            x: "constexpr" if x in constants else f"*{real}" if x in POINTERS else "*i32" if x == "index" else "i32"
            for x in kernel.arg_names
        }
        numbered = {(kernel.arg_names.index(x),): value for x, value in constants.items()}
        for capability in (80, 90):
            source = ASTSource(fn=kernel, signature=types, constexprs=numbered)
            made = triton.compile(source, target=GPUTarget("cuda", capability, 32))
            print(name, real, capability, len(made.asm["cubin"]) > 0)
"""


def cost(name: str, arguments: tuple) -> int:
    """Return about how many steps the interpreter takes for a call."""
    plane, other = arguments[:2]
    images, channels, rows, columns = plane.shape
    if name == "correlate":
        side = columns - other.shape[-1] + 1
        return images * channels * (rows - side + 1) * -(-other.shape[-1] // triton_ops.PIXELS) * side
    side = other.shape[-1]
    tiles = -(-(rows - side + 1) // triton_ops.ROWS) * -(-(columns - side + 1) // triton_ops.COLUMNS)
    return images * channels * tiles * side**2 * (len(other) if name == "occlude" else 1)


def on_device(arguments: tuple) -> tuple:
    return tuple(x.to(DEVICE) if isinstance(x, Tensor) else x for x in arguments)


@needs_triton
class TestCallsOfTheCSources(BaseTester):
    @needs_compiler
    @pytest.mark.parametrize("seed", range(4))
    @pytest.mark.parametrize("name", IN_TRITON)
    def test_feature_equals_the_definition_in_float64_within_round_off(self, name, seed):
        """Odd sizes, and light that is cut out of a larger plane, has columns first, or is shared by channels."""
        torch.manual_seed(seed)
        draw, kind = random.Random(seed), getattr(kernel_shapes, name)
        call = next(call for call in iter(lambda: kind(draw), None) if cost(name, call.arguments) < CHEAP)
        got = IN_TRITON[name](*on_device(call.arguments)).cpu()
        expected, allowed = call.truth()
        off = (got.double() - expected).abs()
        assert float(torch.where(off > 0, off / allowed, 0).max()) <= 1, call.about
        assert float(off.square().mean().sqrt()) <= 1e-6 * float(expected.square().mean().sqrt()), call.about


@needs_triton
class TestCorrelate(BaseTester):
    def test_feature_many_layers_large_psfs_and_parts(self, monkeypatch):
        """Several chunks of layers, blocks of taps and parts of rows, each with a rest."""
        monkeypatch.setattr(triton_ops, "MOST_TAPS", 16)
        monkeypatch.setattr(triton_ops, "ROWS_EACH", 2)
        layers, side = 18, 17
        light, values = torch.randn(1, 1, 3 + side - 1, 2 + side - 1), torch.randn(1, 1, 3, 2)
        index = torch.tensor([[[0, 5], [15, 16], [17, 5]]])
        got = triton_ops.correlate(*on_device((light, values, index)), None, layers, side).cpu()
        expected = torch.zeros(layers, 1, side, side, dtype=torch.float64)
        for y, x in torch.cartesian_prod(torch.arange(3), torch.arange(2)).tolist():
            part = light[0, 0, y : y + side, x : x + side].double()
            expected[index[0, y, x], 0] += values[0, 0, y, x].double() * part
        assert float((got - expected).square().mean().sqrt()) <= 1e-6 * float(expected.square().mean().sqrt())

    def test_cardinality_no_images(self):
        light, values, index = torch.rand(0, 1, 4, 4), torch.rand(0, 1, 2, 2), torch.zeros(0, 2, 2, dtype=torch.int64)
        assert not triton_ops.correlate(light, values, index, None, 2, 3).any()
        assert triton_ops.gather(light, torch.rand(2, 1, 3, 3), index).shape == values.shape


@needs_triton
class TestSharedMaps(BaseTester):
    def test_feature_images_share_layers_and_have_weights_of_their_own(self):
        """And the other way round: as with maps of each image in memory."""
        light, psfs = torch.rand(2, 1, 4, 5), torch.rand(3, 1, 3, 3)
        index, weight = torch.randint(2, (2, 2, 3)), torch.rand(2, 2, 3)
        shared = index[:1].expand(2, -1, -1), weight[:1].expand(2, -1, -1)
        for labels in ((shared[0], weight), (index, shared[1]), shared):
            expected = triton_ops.gather(*on_device((light, psfs, *(x.clone().contiguous() for x in labels))))
            assert torch.equal(triton_ops.gather(*on_device((light, psfs)), *on_device(labels)), expected)


@needs_triton
class TestPixelsInNoLayer(BaseTester):
    """The depth of such a pixel is not a number. Its index may be any, and nothing beyond the PSFs is read."""

    @pytest.mark.filterwarnings("ignore:invalid value encountered")
    @pytest.mark.parametrize("layer", [-(2**63), -1, 3, 2**40])
    def test_feature_they_become_nan_and_no_other(self, layer):
        index = torch.zeros(1, 4, 5, dtype=torch.int64)
        index[0, 2, 3] = layer
        light, psfs, index = on_device((torch.rand(1, 1, 6, 7), torch.rand(3, 1, 3, 3), index))
        gathered = triton_ops.gather(light, psfs, index).isnan().cpu()
        assert gathered.nonzero().tolist() == [[0, 0, 2, 3]]
        scattered = triton_ops.scatter(light[..., :4, :5], psfs, index, None, (2, 3)).isnan().cpu()
        assert scattered.nonzero().tolist() == [[0, 0, y, x] for y in (0, 1) for x in (1, 2)]
        weight = torch.full((1, 4, 5), 0.5, device=DEVICE)
        values = torch.zeros(1, 1, 4, 5, device=DEVICE)
        values[0, 0, 2, 3] = 1.0
        assert not triton_ops.correlate(light, values, index, weight, 3, 3).any()


@needs_triton
class TestCompiled(BaseTester):
    def test_smoke_kernels_compile_for_gpus(self, tmp_path):
        pytest.importorskip("triton.backends.nvidia", reason="this Triton compiles for no CUDA GPU")
        environment = {k: v for k, v in os.environ.items() if k != "TRITON_INTERPRET"}
        environment["TRITON_CACHE_DIR"] = str(tmp_path)
        done = subprocess.run(
            [sys.executable, "-c", COMPILED], capture_output=True, text=True, check=False, env=environment
        )
        assert done.returncode == 0, done.stderr[-2000:]
        lines = done.stdout.splitlines()
        assert len(lines) == 16
        assert all(line.endswith("True") for line in lines)
