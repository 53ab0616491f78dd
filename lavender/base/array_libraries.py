"""Convert results to arrays of the caller's library: PyTorch, JAX, CuPy, Warp, or one of the array API standard.

`lavender.base.arrays.to_numpy` is the conversion in the other direction.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from lavender.base.errors import InputError


def find_converter(like: Any) -> Callable[[np.ndarray], Any] | None:
    """Return the function that copies NumPy arrays to the library of the array `like`, for results.

    For PyTorch, JAX, CuPy and Warp, also to its device and floating precision; other libraries with DLPack get neither.
    None if `like` is None or a NumPy array.
    """
    if like is None or isinstance(like, np.ndarray):
        return None
    library = type(like).__module__.partition(".")[0]
    if convert := _CONVERTERS.get(library):
        return lambda array: convert(array, like)
    if hasattr(like, "__array_namespace__") and hasattr(like, "__dlpack__"):
        namespace = like.__array_namespace__()
        return lambda array: namespace.from_dlpack(np.array(array))
    raise InputError(
        f"like is a {type(like).__name__}; an array of a library with DLPack (PyTorch, JAX, CuPy, Warp) is needed"
    )


def _to_torch(array: np.ndarray, like: Any) -> Any:
    import torch

    is_float = array.dtype.kind == "f" and like.dtype.is_floating_point
    if like.device.type == "meta":
        raise InputError(
            "like is on the device meta, which holds no numbers: give one of another device"
        )
    return torch.from_dlpack(np.array(array)).to(
        device=like.device, dtype=like.dtype if is_float else None
    )


def _to_jax(array: np.ndarray, like: Any) -> Any:
    import jax

    is_float = array.dtype.kind == "f" and np.dtype(like.dtype).kind == "f"
    values = np.array(array, like.dtype if is_float else None)
    # An abstract array, as JAX passes while tracing, has no devices.
    devices = getattr(like, "devices", None)
    if isinstance(like, jax.core.Tracer) or devices is None:
        raise InputError("like is an abstract array of JAX: use lavender.jax inside of jit or grad")
    if values.dtype.kind in "iu" and not jax.config.jax_enable_x64:
        values = values.astype(np.int32)
    return jax.device_put(values, next(iter(devices())))


def _to_cupy(array: np.ndarray, like: Any) -> Any:
    import cupy

    is_float = array.dtype.kind == "f" and like.dtype.kind == "f"
    with like.device:
        return cupy.asarray(array, dtype=like.dtype if is_float else None)


def _to_warp(array: np.ndarray, like: Any) -> Any:
    import warp

    floats = (warp.float16, warp.float32, warp.float64)
    is_float = array.dtype.kind == "f" and like.dtype in floats
    dtype = like.dtype if is_float else warp.dtype_from_numpy(array.dtype)
    return warp.array(np.ascontiguousarray(array), dtype=dtype, device=like.device)


_CONVERTERS = {
    "torch": _to_torch,
    "jax": _to_jax,
    "jaxlib": _to_jax,
    "cupy": _to_cupy,
    "warp": _to_warp,
}
