"""Loads the compiled kernels, registers them with XLA, and calls those of the silhouette.

Load the compiled kernels and register them with XLA; no other module does this. An installation without a C++ compiler
has no kernels. A warning says so once, and the reference implementations run in place of the kernels. Kernels that
exist but do not load are an error. The environment variable `JAXFIT_KERNEL_ISA` chooses the instruction set of the
process: avx512, avx2 or baseline. The default is the best instruction set of the processor. The value none switches the
kernels off. Another value, or an instruction set that the processor lacks, is an error.
"""

import functools
import importlib
import importlib.util
import logging
import os
import platform
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from jaxfit.raster.silhouette_reference import EDGES, KINDS, Blur, Skin

ISA_VARIABLE = "JAXFIT_KERNEL_ISA"
_ISAS = ("avx512", "avx2", "baseline")
"""All instruction sets for which kernels are built. Every processor has the last."""
_MODULE = "jaxfit.raster._kernels"
_logger = logging.getLogger(__name__)


@functools.cache
def _kernels() -> ModuleType | None:
    """The extension module with its handlers registered. None, with one warning, if it is not built or switched off."""
    slower = "silhouettes run in plain JAX and renderings in NumPy, hundreds of times slower"
    if os.environ.get(ISA_VARIABLE) == "none":
        _logger.warning("%s=none: %s.", ISA_VARIABLE, slower)
        return None
    if importlib.util.find_spec(_MODULE) is None:
        _logger.warning(
            "jaxfit was installed without its compiled kernels, so %s. Install GCC or Clang and reinstall jaxfit.",
            slower,
        )
        return None
    problem = isa_problem()
    if problem is not None:
        raise ValueError(f"environment variable {ISA_VARIABLE}: {problem[0]} ({problem[1]})")
    kernels = importlib.import_module(_MODULE)
    kernels.choose_isa(os.environ.get(ISA_VARIABLE) or "auto")
    if _lack_avx2(kernels.available_isas()):
        _logger.warning("This processor lacks AVX2, so silhouettes and renderings take two to three times as long.")
    for name, handler in kernels.handlers().items():
        jax.ffi.register_ffi_target(name, handler, platform="cpu")
    return kernels


def isa_problem() -> tuple[str, str] | None:
    """Why the kernels cannot use the value of the environment variable, and the remedy. None if they can."""
    name = os.environ.get(ISA_VARIABLE) or "auto"
    if name in ("auto", "none") or importlib.util.find_spec(_MODULE) is None:
        return None
    available = importlib.import_module(_MODULE).available_isas()
    if name in available:
        return None
    problem = f"this processor lacks {name}" if name in _ISAS else f"'{name}' is not an instruction set of the kernels"
    return problem, f"unset the variable, or set it to {', '.join(['auto', *available])} or none"


def _lack_avx2(available: list[str] | tuple[str, ...]) -> bool:
    """Whether these are the instruction sets of an x86 processor without AVX2. Other processors never have AVX2."""
    return platform.machine().lower() in ("x86_64", "amd64") and "avx2" not in available


def require_kernels() -> ModuleType:
    """Return the extension module.

    Raises:
        RuntimeError: the kernels are not built or are switched off.
    """
    kernels = _kernels()
    if kernels is None:
        raise RuntimeError("jaxfit runs without its compiled kernels: use backend='auto' or 'reference'")
    return kernels


def kernels_available() -> bool:
    """Whether this installation has compiled kernels that are not switched off."""
    return _kernels() is not None


def ffi_targets() -> tuple[str, ...]:
    """The names of the kernels in compiled programs. Empty without kernels."""
    kernels = _kernels()
    return tuple(kernels.handlers()) if kernels else ()


def available_isas() -> tuple[str, ...]:
    """The instruction sets that the kernels can use on this processor, best first. Empty without kernels."""
    kernels = _kernels()
    return tuple(kernels.available_isas()) if kernels else ()


def current_isa() -> str | None:
    """The instruction set in use. None without kernels."""
    kernels = _kernels()
    return kernels.current_isa() if kernels else None


def lacks_avx2() -> bool:
    """Whether the kernels are slow because this x86 processor lacks AVX2. False without kernels."""
    return kernels_available() and _lack_avx2(available_isas())


def choose_isa(name: str) -> None:
    """Choose the instruction set of every later kernel call in this process.

    Args:
        name: one of `available_isas()`, or "auto" for the best of them.

    Raises:
        ValueError: the processor or the build does not have this instruction set.
        RuntimeError: the kernels are not built or are switched off.
    """
    require_kernels().choose_isa(name)


PARAMETER_MULTIPLE = 16
"""The kernels need a number of parameters that is a multiple of this."""


def _call(name: str, results, *operands, blur: Blur, **attributes):
    require_kernels()
    call = jax.ffi.ffi_call(name, results, vmap_method="expand_dims")
    softness = {"sigma": np.float32(blur.sigma), "radius": np.float32(blur.radius)}
    return call(*operands, **softness, edge=np.int32(EDGES.index(blur.edge)), **attributes)


def _shape_like(vertices) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(vertices.shape, jnp.float32)


def silhouette(vertices: Float[Array, "V 3"], faces: Int[Array, "F 3"], size: int, blur: Blur):
    """Return the soft silhouette, an image of shape (size, size)."""
    image = jax.ShapeDtypeStruct((size, size), jnp.float32)
    return _call("jaxfit_silhouette", image, vertices, faces, blur=blur)


def silhouette_gradient(
    vertices: Float[Array, "V 3"], faces: Int[Array, "F 3"], cotangent: Float[Array, "size size"], blur: Blur
) -> Float[Array, "V 3"]:
    """Return the gradient of Σ cotangent · silhouette with respect to the vertices."""
    return _call("jaxfit_silhouette_gradient", _shape_like(vertices), vertices, faces, cotangent, blur=blur)


def mask_loss(
    vertices: Float[Array, "V 3"],
    faces: Int[Array, "F 3"],
    target: Bool[Array, "size size"] | UInt8[Array, "size size"] | Float[Array, "size size"],
    weight: Float[Array, ""],
    kind: str,
    blur: Blur,
) -> Float[Array, ""]:
    """Return the unweighted loss. A weight of 0 gives a loss of 0 and skips the rendering."""
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
    """Return `mask_loss` and its gradient with respect to the vertices. One pass computes both."""
    results = (jax.ShapeDtypeStruct((), jnp.float32), _shape_like(vertices))
    operands = (vertices, faces, target, weight)
    return _call("jaxfit_mask_loss_and_gradient", results, *operands, blur=blur, kind=np.int32(KINDS.index(kind)))


def mask_loss_gradient_and_block(
    vertices: Float[Array, "V 3"],
    faces: Int[Array, "F 3"],
    target: UInt8[Array, "size size"],
    weight: Float[Array, ""],
    skin: Skin,
    camera_px: tuple[float, float],
    kind: str,
    blur: Blur,
) -> tuple[Float[Array, ""], Float[Array, "V 3"], Float[Array, "D D"]]:
    """Return `mask_loss_and_gradient` and the unweighted Gauss-Newton block, which is 0 for a weight of 0."""
    generators, moved, shape_basis = (_padded(x) for x in (skin.generators, skin.moved, skin.shape_basis))
    padded = moved.shape[-1] + shape_basis.shape[-1]
    shapes = ((), vertices.shape, (padded, padded))
    results = tuple(jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes)
    operands = (vertices, faces, target, weight, skin.rest, skin.joint, skin.weight, skin.transforms)
    operands += (generators, moved, skin.view, shape_basis)
    focal, centre = (np.float32(x) for x in camera_px)
    settings = {"kind": np.int32(KINDS.index(kind)), "focal": focal, "centre": centre}
    loss, gradient, block = _call("jaxfit_mask_loss_gradient_and_block", results, *operands, blur=blur, **settings)
    parameters, own_shapes = skin.moved.shape[-1], skin.shape_basis.shape[-1]
    kept = np.r_[:parameters, moved.shape[-1] : moved.shape[-1] + own_shapes]
    return loss, gradient, block[kept][:, kept] if own_shapes else block[:parameters, :parameters]


def _padded(derivatives: Float[Array, "... P"]) -> Float[Array, "... M"]:
    """Return derivatives with columns of zeros up to a multiple of `PARAMETER_MULTIPLE`."""
    padding = -derivatives.shape[-1] % PARAMETER_MULTIPLE
    return jnp.pad(derivatives, ((0, 0),) * (derivatives.ndim - 1) + ((0, padding),))
