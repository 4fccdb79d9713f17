"""Load the compiled kernels and register them with XLA; no other module does this.

An installation without a C++ compiler has no kernels. A warning says so once, and the reference implementations run in
place of the kernels. Kernels that exist but do not load are an error. The environment variable `JAXFIT_KERNEL_ISA`
chooses the instruction set of the process: avx512, avx2 or baseline. The default is the best instruction set of the
processor. The value none switches the kernels off.
"""

import functools
import importlib
import importlib.util
import logging
import os
from types import ModuleType

import jax

__all__ = ["ISA_VARIABLE", "available_isas", "choose_isa", "current_isa", "kernels_available", "require_kernels"]

ISA_VARIABLE = "JAXFIT_KERNEL_ISA"
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
    kernels = importlib.import_module(_MODULE)
    kernels.choose_isa(os.environ.get(ISA_VARIABLE) or "auto")
    for name, handler in kernels.handlers().items():
        jax.ffi.register_ffi_target(name, handler, platform="cpu")
    return kernels


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


def available_isas() -> tuple[str, ...]:
    """The instruction sets that the kernels can use on this processor, best first. Empty without kernels."""
    kernels = _kernels()
    return tuple(kernels.available_isas()) if kernels else ()


def current_isa() -> str | None:
    """The instruction set in use. None without kernels."""
    kernels = _kernels()
    return kernels.current_isa() if kernels else None


def choose_isa(name: str) -> None:
    """Choose the instruction set of every later kernel call in this process.

    Args:
        name: one of `available_isas()`, or "auto" for the best of them.

    Raises:
        ValueError: the processor or the build does not have this instruction set.
        RuntimeError: the kernels are not built or are switched off.
    """
    require_kernels().choose_isa(name)
