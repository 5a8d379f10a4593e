"""A CUDA device that is not there: tensors that say ``cuda:0`` and hold their numbers on the CPU.

Import this before torch.  Every operator is dispatched here; it raises PyTorch's error where CUDA
and CPU tensors are mixed, counts what would wait for the GPU, and computes on the CPU.  gsplat's
own Python (1.5.3) runs unchanged: only its compiled module ``_C`` is replaced, by ``fake_gsplat``.
The environment's PRETENDED_GUARD names the built guard.
"""

from __future__ import annotations

import ctypes
import importlib.util
import os
import sys
from collections import Counter
from contextlib import contextmanager
from pathlib import Path

_lib = Path(importlib.util.find_spec("torch").origin).parent / "lib"
for _each in ("libc10.so", "libtorch_cpu.so"):
    ctypes.CDLL(str(_lib / _each), ctypes.RTLD_GLOBAL)
ctypes.CDLL(os.environ["PRETENDED_GUARD"], ctypes.RTLD_GLOBAL)

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_map

GPU = torch.device("cuda", 0)
aten = torch.ops.aten
COUNTS: Counter = Counter()  # launches
WHERE: Counter = Counter()  # (kind, file:line) of what waits for the GPU
PINNED: set[int] = set()  # addresses of memory from which copies are queued


class Pretend(torch.Tensor):
    @staticmethod
    def __new__(cls, elem):
        assert not isinstance(elem, Pretend)
        strided = elem.layout == torch.strided
        where = (elem.stride(), elem.storage_offset()) if strided else (None, 0)
        self = torch.Tensor._make_wrapper_subclass(
            cls, elem.size(), *where, dtype=elem.dtype, layout=elem.layout, device=GPU
        )
        self.elem = elem
        return self

    @classmethod
    def __torch_function__(cls, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if func == torch.Tensor.data.__set__:
            target, value = args
            if not isinstance(value, Pretend) or not isinstance(target, Pretend):
                raise TypeError("data of another device")
            with torch._C.DisableTorchFunctionSubclass():
                func(target, value)
            target.elem = value.elem
            return None
        if func is torch.Tensor.numpy:
            raise TypeError(
                "can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() to copy "
                "the tensor to host memory first."
            )
        with torch._C.DisableTorchFunctionSubclass():
            return func(*args, **kwargs)

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return dispatch(func, args, kwargs or {})


def check_input(dtype=torch.float32, **tensors):
    """What gsplat's kernels check of what is given."""
    for name, t in tensors.items():
        if t is not None and not (
            isinstance(t, Pretend) and t.is_contiguous() and t.dtype == dtype
        ):
            raise RuntimeError(f"{name} must be a contiguous CUDA tensor of {dtype}")


def elem(t):
    return t.elem.detach() if isinstance(t, Pretend) else t


CROSS = {aten.copy_.default, aten._copy_from.default}
PINNING = {aten.is_pinned.default, aten._pin_memory.default}
TAKES_CPU_SCALARS = {
    *(aten.where.self, aten.where.ScalarSelf, aten.fill_.Tensor, aten.fill.Tensor),
    *(aten.masked_fill_.Tensor, aten.masked_fill.Tensor),
}
INDEXING = {
    *(aten.index.Tensor, aten.index_put_.default, aten.index_put.default),
    *(aten._index_put_impl_.default, aten._unsafe_index.Tensor),
}
WAITS = {
    "_local_scalar_dense", "nonzero", "_unique2", "unique_consecutive", "masked_select", "equal",
    "bincount", "_assert_async", "multinomial",
}  # fmt: skip


def note(kind):
    """Count what waits for the GPU, by the line outside of PyTorch that asked for it."""
    frame = sys._getframe(1)
    while frame and any(part in frame.f_code.co_filename for part in ("/torch/", "pretend_cuda")):
        frame = frame.f_back
    if frame:
        name = frame.f_code.co_filename.split("site-packages/")[-1].split("/src/")[-1]
        WHERE[kind, f"{name}:{frame.f_lineno}"] += 1


def _layout(t):
    strides = tuple(k for k, n in zip(t.stride(), t.shape, strict=True) if n != 1)
    return t.dtype, tuple(t.shape), strides


def _tf32(x):
    """Ten bits of mantissa, rounded to nearest."""
    bits = x.contiguous().view(torch.int32)
    return ((bits + 0x1000) & ~0x1FFF).view(torch.float32)


def map_leaves(function, x):
    """As PyTorch's tree_map, which takes most of the time: operators have lists and tuples only."""
    if isinstance(x, (list, tuple)):
        mapped = [map_leaves(function, each) for each in x]
        return mapped if isinstance(x, list) else tuple(mapped)
    if isinstance(x, dict):
        return {name: map_leaves(function, each) for name, each in x.items()}
    return function(x)


def _plain(x):
    """What the CPU's operator is given."""
    if isinstance(x, Pretend):
        return x.elem
    return "cpu" if isinstance(x, torch.device) and x.type == "cuda" else x


def dispatch(func, args, kwargs):
    """Compute an operator on the CPU; its results are on the GPU if its inputs or target are."""
    flat = []
    map_leaves(flat.append, (args, kwargs))
    gpu = [t for t in flat if isinstance(t, Pretend)]
    target = kwargs.get("device") and torch.device(kwargs["device"]).type
    if not gpu and target != "cuda" and func not in PINNING and not kwargs.get("pin_memory"):
        return func(*args, **kwargs)  # the CPU's own
    cpu = [t for t in flat if isinstance(t, torch.Tensor) and not isinstance(t, Pretend)]
    if gpu:
        COUNTS["launch"] += 1
        _check(func, args, cpu)
        if func.overloadpacket.__name__ in WAITS:
            note(func.overloadpacket.__name__)
        if func is aten.index.Tensor and any(
            isinstance(i, Pretend) and i.dtype == torch.bool for i in args[1]
        ):
            note("bool index")
    if func in CROSS:
        if isinstance(args[0], Pretend) != isinstance(args[1], Pretend):
            note("copy")
        func(*map(elem, args[:2]), *args[2:])
        return args[0]
    if func == aten.is_pinned.default:
        return elem(args[0]).data_ptr() in PINNED
    a, k = map_leaves(_plain, (args, kwargs))
    if target:
        k["device"] = "cpu"
    pinned = k.pop("pin_memory", None) or func is aten._pin_memory.default
    if gpu and torch.backends.cudnn.allow_tf32:
        # cuDNN rounds the inputs of convolutions, where PyTorch's settings let it.
        inputs = {aten.convolution.default: 2, aten.convolution_backward.default: 3}.get(func, 0)
        a = (*map(_tf32, a[:inputs]), *a[inputs:])
    out = a[0].clone() if func is aten._pin_memory.default else func(*a, **k)
    if pinned:
        PINNED.add(out.data_ptr())
    if func is aten._to_copy.default and target and (target == "cuda") != bool(gpu):
        queued = kwargs.get("non_blocking") and a[0].data_ptr() in PINNED
        note("queued copy" if queued and not gpu else "copy")
    on_gpu = target == "cuda" if target else bool(gpu)
    given = {id(t.elem): t for t in gpu} | {id(t): t for t in cpu}

    def wrap(o):
        if not isinstance(o, torch.Tensor) or (id(o) not in given and not on_gpu):
            return o
        again = given.get(id(o))
        if again is not None and again.shape != o.shape:
            raise NotImplementedError(f"{func} changes the shape in place")
        return Pretend(o) if again is None else again

    return map_leaves(wrap, out)


def _check(func, args, cpu):
    """What PyTorch refuses on a GPU: other devices' tensors but for scalars and indices, ..."""
    scalars = all(t.dim() == 0 for t in cpu)
    allowed = scalars and (torch.Tag.pointwise in func.tags or func in TAKES_CPU_SCALARS)
    if func in INDEXING and isinstance(args[0], Pretend):
        values = [t for t in args[2:] if isinstance(t, torch.Tensor)]
        allowed = all(isinstance(t, Pretend) or t.dim() == 0 for t in values)
    if cpu and not allowed and func not in CROSS:
        raise RuntimeError(
            "Expected all tensors to be on the same device, but found at least two devices, cuda:0 "
            f"and cpu! (in {func})"
        )
    if func in (aten._fused_adam_.default, aten._fused_adam_.tensor_lr):
        for group in zip(*args[:4], strict=False):  # ... on which the CPU's kernel does not insist
            if len({_layout(t) for t in group}) != 1:
                raise RuntimeError("params, grads, exp_avgs and exp_avg_sqs must have same layout")


class PretendMode(TorchDispatchMode):
    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return dispatch(func, args, kwargs or {})


def _patch_torch():
    def mem_get_info(*_):
        note("mem_get_info")
        return (20 << 30, 24 << 30)

    answers = {
        "is_available": True, "device_count": 1, "current_device": 0, "is_initialized": True,
        "_lazy_init": None, "_is_in_bad_fork": False, "get_device_name": "pretended GPU",
        "manual_seed_all": None, "manual_seed": None, "set_rng_state": None, "empty_cache": None,
        "get_rng_state": torch.zeros(16, dtype=torch.uint8), "synchronize": None,
        "is_current_stream_capturing": False, "memory_reserved": 0, "memory_allocated": 0,
        "max_memory_allocated": 1 << 30,
    }  # fmt: skip
    for name, answer in answers.items():
        setattr(torch.cuda, name, lambda *_, answer=answer, **__: answer)
    torch.cuda.mem_get_info = mem_get_info
    load, save = torch.load, torch.save

    def pretended_load(*args, map_location=None, **kwargs):
        gpu = map_location is not None and torch.device(map_location).type == "cuda"
        content = load(*args, map_location="cpu" if gpu else map_location, **kwargs)
        return map_leaves(
            lambda x: Pretend(x) if gpu and isinstance(x, torch.Tensor) else x, content
        )

    torch.load = pretended_load
    torch.save = lambda content, *args: save(tree_map(elem, content), *args)


@contextmanager
def pretended_gpu():
    before = torch._C._only_lift_cpu_tensors()
    torch._C._set_only_lift_cpu_tensors(True)
    try:
        with PretendMode():
            yield
    finally:
        torch._C._set_only_lift_cpu_tensors(before)


_patch_torch()
