"""The compiled kernels: the only module that loads them and registers them with XLA.

A build without a C++ compiler has none: that is announced once, and the reference takes over. Kernels that are there
but do not load are an error. The environment variable `JAXFIT_KERNEL_ISA` chooses the instruction set for the process
(avx512, avx2 or baseline; by default the best one that the processor has), or does without the kernels (none).
"""

import functools
import importlib
import importlib.util
import logging
import os
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from jaxfit.silhouette.reference import KINDS, Blur

ISA_VARIABLE = "JAXFIT_KERNEL_ISA"
_MODULE = "jaxfit._kernels"
_logger = logging.getLogger(__name__)


@functools.cache
def _kernels() -> ModuleType | None:
    """The extension module, its handlers registered; None, said once, where it was not built or not wanted."""
    if os.environ.get(ISA_VARIABLE) == "none":
        _logger.warning("%s=none: silhouettes run in plain JAX, hundreds of times slower.", ISA_VARIABLE)
        return None
    if importlib.util.find_spec(_MODULE) is None:
        _logger.warning(
            "jaxfit was installed without its compiled kernels, so silhouettes run in plain JAX, hundreds of times "
            "slower. Install a C++17 compiler and reinstall jaxfit."
        )
        return None
    kernels = importlib.import_module(_MODULE)
    kernels.choose_isa(os.environ.get(ISA_VARIABLE) or "auto")
    for name, handler in kernels.handlers().items():
        jax.ffi.register_ffi_target(name, handler, platform="cpu")
    return kernels


def _require() -> ModuleType:
    kernels = _kernels()
    if kernels is None:
        raise RuntimeError("jaxfit runs without its compiled kernels: use backend='auto' or 'reference'")
    return kernels


def kernels_available() -> bool:
    """Whether the compiled kernels were built with this installation, and are not switched off."""
    return _kernels() is not None


def available_isas() -> tuple[str, ...]:
    """The instruction sets that the kernels can use on this processor, best first; empty without kernels."""
    kernels = _kernels()
    return tuple(kernels.available_isas()) if kernels else ()


def current_isa() -> str | None:
    """The instruction set in use, None without kernels."""
    kernels = _kernels()
    return kernels.current_isa() if kernels else None


def choose_isa(name: str) -> None:
    """Chooses the instruction set of every later kernel call in this process.

    Args:
        name: one of `available_isas()`, or "auto" for the best of them.

    Raises:
        ValueError: the processor or the build has no such instruction set.
        RuntimeError: the kernels were not built.
    """
    _require().choose_isa(name)


def _call(name: str, results, *operands, blur: Blur, **attributes):
    _require()
    call = jax.ffi.ffi_call(name, results, vmap_method="expand_dims")
    return call(*operands, sigma=np.float32(blur.sigma), radius=np.float32(blur.radius), **attributes)


def _shape_like(vertices) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(vertices.shape, jnp.float32)


def silhouette(vertices: Float[Array, "V 3"], faces: Int[Array, "F 3"], size: int, blur: Blur):
    """The image (size, size)."""
    image = jax.ShapeDtypeStruct((size, size), jnp.float32)
    return _call("jaxfit_silhouette", image, vertices, faces, blur=blur)


def silhouette_gradient(
    vertices: Float[Array, "V 3"], faces: Int[Array, "F 3"], cotangent: Float[Array, "size size"], blur: Blur
) -> Float[Array, "V 3"]:
    """The gradient of Σ cotangent · silhouette with respect to the vertices."""
    return _call("jaxfit_silhouette_gradient", _shape_like(vertices), vertices, faces, cotangent, blur=blur)


def mask_loss(
    vertices: Float[Array, "V 3"],
    faces: Int[Array, "F 3"],
    target: Bool[Array, "size size"] | UInt8[Array, "size size"] | Float[Array, "size size"],
    weight: Float[Array, ""],
    kind: str,
    blur: Blur,
) -> Float[Array, ""]:
    """The loss, 0 where the weight is 0; otherwise the weight is not applied."""
    loss = jax.ShapeDtypeStruct((), jnp.float32)
    operands = (vertices, faces, target, weight)
    return _call("jaxfit_mask_loss", loss, *operands, blur=blur, kind=np.int32(KINDS.index(kind)))


def mask_loss_and_gradient(
    vertices: Float[Array, "V 3"],
    faces: Int[Array, "F 3"],
    target: Bool[Array, "size size"] | UInt8[Array, "size size"] | Float[Array, "size size"],
    weight: Float[Array, ""],
    kind: str,
    blur: Blur,
) -> tuple[Float[Array, ""], Float[Array, "V 3"]]:
    """`mask_loss` and its gradient with respect to the vertices, in one pass."""
    results = (jax.ShapeDtypeStruct((), jnp.float32), _shape_like(vertices))
    operands = (vertices, faces, target, weight)
    return _call("jaxfit_mask_loss_and_gradient", results, *operands, blur=blur, kind=np.int32(KINDS.index(kind)))
