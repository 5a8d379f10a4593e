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
from collections import Counter
from contextlib import contextmanager
from pathlib import Path

_lib = Path(importlib.util.find_spec("torch").origin).parent / "lib"
for _each in ("libc10.so", "libtorch_cpu.so"):
    ctypes.CDLL(str(_lib / _each), ctypes.RTLD_GLOBAL)
ctypes.CDLL(os.environ["PRETENDED_GUARD"], ctypes.RTLD_GLOBAL)

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map, tree_unflatten

GPU = torch.device("cuda", 0)
aten = torch.ops.aten
COUNTS: Counter = Counter()  # operators that wait for the GPU, and launches
WHERE: Counter = Counter()  # (kind, file:line) of those
PINNED: set[int] = set()  # addresses of memory from which copies are queued


class Pretend(torch.Tensor):
    @staticmethod
    def __new__(cls, elem):
        assert not isinstance(elem, Pretend)
        self = torch.Tensor._make_wrapper_subclass(
            cls,
            elem.size(),
            strides=elem.stride() if elem.layout == torch.strided else None,
            storage_offset=elem.storage_offset() if elem.layout == torch.strided else 0,
            dtype=elem.dtype,
            layout=elem.layout,
            device=GPU,
            requires_grad=False,
        )
        self.elem = elem
        return self

    def __repr__(self, *, tensor_contents=None):
        return f"Pretend({self.elem!r})"

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

    def __reduce_ex__(self, proto):
        return (_rebuilt, (self.elem.detach(), self.requires_grad))


def check_input(dtype=torch.float32, **tensors):
    for name, t in tensors.items():
        if t is None:
            continue
        if not isinstance(t, Pretend):
            raise RuntimeError(f"{name} must be a CUDA tensor")
        if not t.is_contiguous():
            raise RuntimeError(f"{name} must be contiguous")
        if dtype is not None and t.dtype != dtype:
            raise RuntimeError(f"expected scalar type {dtype} but found {t.dtype} for {name}")


def elem(t):
    return t.elem.detach() if isinstance(t, Pretend) else t


def _rebuilt(elem, requires_grad):
    return Pretend(elem).requires_grad_(requires_grad)


CROSS = {aten.copy_.default, aten._copy_from.default}
SCALARS = {
    aten.where.self,
    aten.where.ScalarSelf,
    aten.fill_.Tensor,
    aten.fill.Tensor,
    aten.masked_fill_.Tensor,
    aten.masked_fill.Tensor,
}
INDEXING = {
    aten.index.Tensor,
    aten.index_put_.default,
    aten.index_put.default,
    aten._index_put_impl_.default,
    aten._unsafe_index.Tensor,
}
SYNC = {
    aten._local_scalar_dense.default: "item",
    aten.nonzero.default: "nonzero",
    aten._unique2.default: "unique",
    aten.unique_consecutive.default: "unique",
    aten.masked_select.default: "masked_select",
    aten.equal.default: "equal",
    aten.bincount.default: "bincount",
    aten._assert_async.default: "assert",
    aten.multinomial.default: "multinomial?",
}


def _note(kind):
    COUNTS[kind] += 1
    import sys

    frame = sys._getframe(2)
    while frame and (
        "/torch/" in frame.f_code.co_filename or "pretend_cuda" in frame.f_code.co_filename
    ):
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


def dispatch(func, args, kwargs):
    flat, spec = tree_flatten((args, kwargs))
    gpu = [t for t in flat if isinstance(t, Pretend)]
    cpu = [t for t in flat if isinstance(t, torch.Tensor) and not isinstance(t, Pretend)]
    target = kwargs.get("device")
    target = None if target is None else torch.device(target)
    if gpu and cpu:
        _check_mixed(func, args, cpu)
    if gpu:
        COUNTS["launch"] += 1
        if func in SYNC:
            _note(SYNC[func])
        if func is aten.index.Tensor and any(
            isinstance(i, Pretend) and i.dtype == torch.bool for i in args[1]
        ):
            _note("bool index")
    if func in CROSS and isinstance(args[0], Pretend) != isinstance(args[1], Pretend):
        _note("copy to GPU" if isinstance(args[0], Pretend) else "copy to CPU")
    if gpu and func in (aten._fused_adam_.default, aten._fused_adam_.tensor_lr):
        for group in zip(*args[:4], strict=False):  # the CUDA kernel insists, the CPU's does not
            if len({_layout(t) for t in group}) != 1:
                raise RuntimeError(
                    "params, grads, exp_avgs, and exp_avg_sqs must have same dtype, device, and "
                    f"layout: {[(t.dtype, tuple(t.shape), t.stride()) for t in group]}"
                )
    if func == aten.is_pinned.default:
        return getattr(args[0], "_pinned", False)
    real = [t.elem if isinstance(t, Pretend) else t for t in flat]
    real = [
        torch.device("cpu") if isinstance(t, torch.device) and t.type == "cuda" else t for t in real
    ]
    a, k = tree_unflatten(real, spec)
    if isinstance(k.get("device"), str) and "cuda" in k["device"]:
        k["device"] = torch.device("cpu")
    pinned = k.pop("pin_memory", None) or func is aten._pin_memory.default
    if gpu and torch.backends.cudnn.allow_tf32:
        # cuDNN rounds the inputs of convolutions, where PyTorch's settings let it.
        inputs = {aten.convolution.default: 2, aten.convolution_backward.default: 3}.get(func, 0)
        a = (*map(_tf32, a[:inputs]), *a[inputs:])
    moved = func is aten._to_copy.default and target is not None
    out = a[0].clone() if func is aten._pin_memory.default else func(*a, **k)
    if pinned:
        PINNED.add(out.data_ptr())
    if moved:
        was, goes = isinstance(args[0], Pretend), target.type == "cuda"
        if was != goes:
            queued = goes and kwargs.get("non_blocking") and args[0].data_ptr() in PINNED
            _note("queued copy" if queued else "copy to GPU" if goes else "copy to CPU")
    on_gpu = target.type == "cuda" if target is not None else bool(gpu)
    if func in CROSS:
        return args[0]
    back = {id(t.elem): t for t in gpu}
    mine = {id(t): t for t in cpu}

    def wrap(o):
        if not isinstance(o, torch.Tensor):
            return o
        if id(o) in back:
            w = back[id(o)]
            if tuple(w.shape) != tuple(w.elem.shape):
                raise NotImplementedError(f"{func} changes the shape in place")
            return w
        if id(o) in mine:
            return o
        return Pretend(o) if on_gpu else o

    return tree_map(wrap, out)


def _check_mixed(func, args, cpu):
    if func in CROSS:
        return
    if (
        func in INDEXING
        and isinstance(args[0], Pretend)
        and all(
            not isinstance(args[i], torch.Tensor)
            or isinstance(args[i], Pretend)
            or args[i].dim() == 0
            for i in range(2, len(args))
        )
    ):
        COUNTS["index with CPU tensors"] += 1
        return
    if torch.Tag.pointwise in func.tags and all(t.dim() == 0 for t in cpu):
        return
    if func in SCALARS and all(t.dim() == 0 for t in cpu):
        return
    raise RuntimeError(
        "Expected all tensors to be on the same device, but found at least two devices, cuda:0 and "
        f"cpu! (in {func})"
    )


class PretendMode(TorchDispatchMode):
    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return dispatch(func, args, kwargs or {})


def _patch_torch():
    cuda = torch.cuda
    cuda.is_available = lambda: True
    cuda.device_count = lambda: 1
    cuda.current_device = lambda: 0
    cuda.is_initialized = lambda: True
    cuda._lazy_init = lambda: None
    cuda._is_in_bad_fork = lambda: False
    cuda.get_device_name = lambda *_: "pretended GPU"
    cuda.manual_seed_all = lambda *_: None
    cuda.manual_seed = lambda *_: None
    cuda.get_rng_state = lambda *_: torch.zeros(16, dtype=torch.uint8)
    cuda.set_rng_state = lambda *_, **__: None
    cuda.empty_cache = lambda: COUNTS.update(["empty_cache"])
    cuda.synchronize = lambda *_: COUNTS.update(["synchronize"])
    cuda.is_current_stream_capturing = lambda: False

    def mem_get_info(*_):
        _note("mem_get_info")
        return (20 << 30, 24 << 30)

    cuda.mem_get_info = mem_get_info
    cuda.memory_reserved = cuda.memory_allocated = lambda *_: 0
    cuda.max_memory_allocated = lambda *_: 1 << 30
    load = torch.load

    def pretended_load(*args, map_location=None, **kwargs):
        gpu = map_location is not None and torch.device(map_location).type == "cuda"
        content = load(*args, map_location="cpu" if gpu else map_location, **kwargs)
        return tree_map(lambda x: Pretend(x) if gpu and isinstance(x, torch.Tensor) else x, content)

    torch.load = pretended_load
    save = torch.save

    def pretended_save(content, *args, **kwargs):
        def plain(x):
            return x.detach().elem if isinstance(x, Pretend) else x

        return save(tree_map(plain, content), *args, **kwargs)

    torch.save = pretended_save


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
