"""A simulated accelerator: tensors that live on the CPU, claim another device, and keep its rules.

It is torch's device for backends written in Python, here under the name ``simulated``. A tensor of it wraps one of the
CPU, on which every operation is made. What an accelerator refuses is refused: operations that mix its tensors with
those of the CPU, ``numpy()``, and, where ``float64=False``, double precision, as on Apple's ``mps``. Operators of the
package run their implementation for other devices, so what they launch is counted, not hidden.

    with SimulatedDevice() as device:
        coded = device.put(optics)(device.put(image), device.put(depth))
    device.launches, device.waits, device.uploads
"""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Callable
from functools import partial
from types import CellType, FunctionType, MethodType
from typing import Any, Self

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_iter, tree_map_only
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

from kornia_tidy import PSFBank
from kornia_tidy.kernels.precision import WITHOUT_FLOAT64

# Operators that give another view of the same memory and launch nothing, besides those that the schema tells of.
_NO_LAUNCH = {"detach", "lift_fresh", "alias", "_unsafe_view", "_conj", "_reshape_alias", "set_", "is_same_size"}
_NO_LAUNCH |= {"empty", "empty_like", "empty_strided", "new_empty", "new_empty_strided", "resize_"}
_NO_LAUNCH |= {"_local_scalar_dense"}
# Operators whose result or its shape the host must know before it goes on.
_WAITS = {"_local_scalar_dense", "equal", "nonzero", "masked_select", "_unique2", "unique_dim", "unique_consecutive"}
_WAITS |= {"bincount", "repeat_interleave", "is_nonzero", "_linalg_check_errors"}
_COPIES = {"_to_copy", "copy_"}


class _Hook(torch._C._acc.PrivateUse1Hooks):
    def is_available(self) -> bool:
        return bool(_active)  # nobody is to choose it but who asks for it

    def has_primary_context(self, dev_id: int) -> bool:
        return True

    def is_built(self) -> bool:
        return True


class _Backend:
    """What ``torch.simulated`` must offer for autocast and random numbers."""

    @staticmethod
    def is_available() -> bool:
        return bool(_active)

    @staticmethod
    def is_initialized() -> bool:
        return True

    @staticmethod
    def device_count() -> int:
        return int(bool(_active))

    @staticmethod
    def current_device() -> int:
        return 0

    @staticmethod
    def get_amp_supported_dtype() -> list[torch.dtype]:
        return [torch.float16, torch.bfloat16]

    @staticmethod
    def _is_in_bad_fork() -> bool:
        return False

    @staticmethod
    def manual_seed_all(seed: int) -> None:
        """Do nothing: its random numbers are the CPU's."""

    @staticmethod
    def get_rng_state(device: int = 0) -> Tensor:
        return torch.empty(0, dtype=torch.uint8)

    @staticmethod
    def set_rng_state(state: Tensor, device: int = 0) -> None:
        """Do nothing: its random numbers are the CPU's."""


_setup_privateuseone_for_python_backend("simulated", backend_module=_Backend, hook=_Hook())
DEVICE = torch.device("simulated", 0)


class SimulatedTensor(Tensor):
    """A tensor of :data:`DEVICE`. Make it with :meth:`SimulatedDevice.put`."""

    on_cpu: Tensor

    @staticmethod
    def __new__(cls, on_cpu: Tensor) -> Self:
        return Tensor._make_wrapper_subclass(
            cls,
            on_cpu.shape,
            on_cpu.stride(),
            on_cpu.storage_offset(),
            dtype=on_cpu.dtype,
            device=DEVICE,
        )

    def __init__(self, on_cpu: Tensor) -> None:
        self.on_cpu = on_cpu

    def __repr__(self) -> str:  # type: ignore[override]
        return f"SimulatedTensor({self.on_cpu})"

    def tolist(self) -> Any:
        return self.cpu().tolist()

    def numpy(self, *_: Any, **__: Any) -> Any:
        raise TypeError("a tensor of the simulated device cannot be read by NumPy: copy it to the CPU first")

    @classmethod
    def __torch_dispatch__(cls, operator: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if not _active:
            raise RuntimeError(f"{operator} of a simulated tensor outside of its SimulatedDevice")
        return _active[-1].run(operator, args, kwargs or {})


class SimulatedDevice(TorchDispatchMode):
    """While it is entered, tensors can be made on :data:`DEVICE`, and what an accelerator would do is counted.

    Args:
        float64: whether the device has double precision.

    Attributes:
        launches: operators that a device would launch kernels for; views, allocations and copies to it are none.
        waits: times that the host would wait for a value of the device.
        uploads: copies from the host, for which a CUDA graph cannot be captured either.
        callers: launches, waits and uploads by the operator's name.
    """

    def __init__(self, float64: bool = True) -> None:
        super().__init__()
        self.float64 = float64
        self.on_event: Callable[[str, str], None] | None = None
        self.reset()

    def reset(self) -> None:
        """Count from zero."""
        self.launches = self.waits = self.uploads = 0
        self.callers: Counter[tuple[str, str]] = Counter()

    def __enter__(self) -> Self:
        _active.append(self)
        if not self.float64:
            WITHOUT_FLOAT64.add(DEVICE.type)
        return super().__enter__()

    def __exit__(self, *error: object) -> None:
        _active.pop()
        if all(device.float64 for device in _active):  # it is entered again within itself
            WITHOUT_FLOAT64.discard(DEVICE.type)
        super().__exit__(*error)

    def put(self, value: Any) -> Any:
        """Return a copy of a tensor or module on the device. Nothing is counted."""
        if isinstance(value, Tensor):
            self._check_type(value)
            leaf = SimulatedTensor(value.detach().clone())
            return leaf.requires_grad_(value.requires_grad)
        value = copy.deepcopy(value)
        for module in value.modules():
            for name, parameter in module._parameters.items():
                if parameter is not None:
                    own = SimulatedTensor(parameter.detach().clone())
                    module._parameters[name] = nn.Parameter(own, requires_grad=parameter.requires_grad)
            for name, buffer in module._buffers.items():
                if buffer is not None:
                    module._buffers[name] = SimulatedTensor(buffer.detach().clone())
        return value

    def __torch_dispatch__(self, operator: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return self.run(operator, args, kwargs or {})

    def run(self, operator: Any, args: Any, kwargs: dict[str, Any]) -> Any:
        """Run an operator, on the device if one of its tensors is there or its result is wanted there."""
        given = [x for x in tree_iter((args, kwargs)) if isinstance(x, Tensor)]
        there = any(isinstance(x, SimulatedTensor) for x in given)
        wanted = kwargs.get("device")
        target = there if wanted is None else torch.device(wanted).type == DEVICE.type
        if not (there or target):
            return operator(*args, **kwargs)
        name = operator._schema.name.split("::")[1]
        if operator.namespace == "kornia_tidy":
            with self:
                return operator._op_dk(torch._C.DispatchKey.CompositeExplicitAutograd, *args, **kwargs)
        if there and name not in _COPIES:
            self._check_mixture(operator, name, given)
        self._count(operator, name, args, given, there, target)
        return self._computed(operator, name, args, dict(kwargs), target)

    def _computed(self, operator: Any, name: str, args: Any, kwargs: dict[str, Any], target: bool) -> Any:
        if kwargs.get("device") is not None:
            kwargs["device"] = torch.device("cpu")
        kwargs.pop("pin_memory", None)
        plain_args, plain = tree_map_only(SimulatedTensor, lambda x: x.on_cpu, (args, kwargs))
        found = operator(*plain_args, **plain)
        if kwargs.get("out") is not None:
            return kwargs["out"]
        if name.endswith("_") and not name.endswith("__"):
            return args[0]
        if not target:
            return found.clone() if isinstance(found, Tensor) and name == "_to_copy" else found
        tree_map_only(Tensor, self._check_type, found)
        # The wrapper cannot tell of a conjugation that is still to be done.
        return tree_map_only(Tensor, lambda x: SimulatedTensor(x.resolve_conj().resolve_neg()), found)

    def _check_type(self, tensor: Tensor) -> None:
        if not self.float64 and tensor.dtype in (torch.float64, torch.complex128):
            raise TypeError(f"this simulated device has no double precision, got a tensor of {tensor.dtype}")

    @staticmethod
    def _check_mixture(operator: Any, name: str, given: list[Tensor]) -> None:
        strangers = [tuple(x.shape) for x in given if not isinstance(x, SimulatedTensor) and x.ndim > 0]
        if strangers and not name.startswith(("index", "_index_put_impl")):
            raise RuntimeError(f"{operator} mixes tensors of the device with tensors of the CPU, of shapes {strangers}")

    def _count(self, operator: Any, name: str, args: Any, given: list[Tensor], there: bool, target: bool) -> None:
        kinds = []
        if name in _COPIES:
            source = isinstance(args[1] if name == "copy_" else args[0], SimulatedTensor)
            into = isinstance(args[0], SimulatedTensor) if name == "copy_" else target
            kinds = ["launches" if source and into else "waits" if source else "uploads"]
        else:
            launched = not (operator.is_view or name in _NO_LAUNCH)
            kinds = ["launches"] if launched and (there or target) else []
            masked = name.startswith(("index", "_index_put")) and any(x.dtype == torch.bool for x in given[1:])
            masked = masked and any(isinstance(x, (list, tuple)) for x in args)
            if name in _WAITS or masked or (there and not target):
                kinds.append("waits")
        for kind in kinds:
            setattr(self, kind, getattr(self, kind) + 1)
            self.callers[kind, name] += 1
            if self.on_event is not None:
                self.on_event(kind, name)


_active: list[SimulatedDevice] = []
_kernels = torch.library.Library("aten", "IMPL")


# torch.tensor(..., device=DEVICE) asks the device itself, below all modes.
def _empty_strided(size: Any, stride: Any, dtype: Any = None, **_: Any) -> SimulatedTensor:
    return SimulatedTensor(torch.empty_strided(size, stride, dtype=dtype))


def _empty(size: Any, dtype: Any = None, **_: Any) -> SimulatedTensor:
    return SimulatedTensor(torch.empty(size, dtype=dtype))


def _copy(target: SimulatedTensor, source: Tensor, non_blocking: bool = False) -> SimulatedTensor:
    return _active[-1].run(torch.ops.aten.copy_.default, (target, source), {})


for _name, _kernel in (("empty_strided", _empty_strided), ("empty.memory_format", _empty), ("copy_", _copy)):
    _kernels.impl(_name, _kernel, "PrivateUse1")


def moved(value: Any, device: SimulatedDevice) -> Any:
    """Return a value with all tensors and modules in it on the device, also those that a function encloses."""
    if isinstance(value, (Tensor, nn.Module)):
        return device.put(value)
    if isinstance(value, PSFBank):
        return PSFBank(*(moved(part, device) for part in (value.psfs, value.defocus, value.energy, value.veil)))
    if isinstance(value, dict):
        return {name: moved(part, device) for name, part in value.items()}
    if isinstance(value, (tuple, list)):
        parts = [moved(part, device) for part in value]
        return type(value)(*parts) if hasattr(value, "_fields") else type(value)(parts)
    if isinstance(value, partial):
        return partial(moved(value.func, device), *moved(value.args, device), **moved(value.keywords, device))
    if isinstance(value, MethodType):
        return MethodType(value.__func__, moved(value.__self__, device))
    if isinstance(value, FunctionType) and value.__closure__:
        cells = tuple(CellType(moved(cell.cell_contents, device)) for cell in value.__closure__)
        function = FunctionType(value.__code__, value.__globals__, value.__name__, value.__defaults__, cells)
        function.__kwdefaults__ = value.__kwdefaults__
        return function
    return value
