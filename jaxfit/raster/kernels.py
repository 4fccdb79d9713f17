"""The compiled kernels: the only module that loads them and registers them with XLA.

A build without a C++ compiler has none: that is announced once, and the references take over. Kernels that are there
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

__all__ = ["ISA_VARIABLE", "available_isas", "choose_isa", "current_isa", "kernels_available", "require_kernels"]

ISA_VARIABLE = "JAXFIT_KERNEL_ISA"
_MODULE = "jaxfit.raster._kernels"
_logger = logging.getLogger(__name__)


@functools.cache
def _kernels() -> ModuleType | None:
    """The extension module, its handlers registered; None, said once, where it was not built or not wanted."""
    slower = "silhouettes run in plain JAX and renderings in NumPy, hundreds of times slower"
    if os.environ.get(ISA_VARIABLE) == "none":
        _logger.warning("%s=none: %s.", ISA_VARIABLE, slower)
        return None
    if importlib.util.find_spec(_MODULE) is None:
        _logger.warning(
            "jaxfit was installed without its compiled kernels, so %s. Install a C++17 compiler and reinstall jaxfit.",
            slower,
        )
        return None
    kernels = importlib.import_module(_MODULE)
    kernels.choose_isa(os.environ.get(ISA_VARIABLE) or "auto")
    for name, handler in kernels.handlers().items():
        jax.ffi.register_ffi_target(name, handler, platform="cpu")
    return kernels


def require_kernels() -> ModuleType:
    """The extension module.

    Raises:
        RuntimeError: the kernels were not built, or are switched off.
    """
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
    require_kernels().choose_isa(name)
