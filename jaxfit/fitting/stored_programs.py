"""Traced programs in JAX's cache folder, so that later processes do not trace them again.

JAX stores compiled programs under keys that it computes from the traced programs. So every process traces the objective
of every stage, which takes seconds, before it finds the compiled program. Here the traced program (StableHLO by
`jax.export`) is stored, too. Its key holds everything that decides the trace: the source of the package, the versions
of the libraries that trace it, and the arguments except for the numbers in their arrays. Programs with terms from
outside of the package are not stored, because their traces may depend on other files.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import FunctionType
from typing import Any

import equinox as eqx
import jax
import jax.export

from jaxfit.config.fit import InitialiseConfig
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.files import write_whole
from jaxfit.objective.registry import Term
from jaxfit.raster.kernels import ffi_targets
from jaxfit.raster.silhouette_reference import Blur

PACKAGE = Path(__file__).resolve().parents[1]
LIBRARIES = ("jax", "jaxlib", "equinox", "optimistix", "optax")
"""The libraries whose code becomes part of a trace."""
SETTINGS = ("jax_enable_x64", "jax_default_matmul_precision", "jax_numpy_dtype_promotion")
"""The settings of JAX that decide a trace."""
MAX_LOADED = 32
"""Most compiled programs that one function keeps in a process."""
FOLDER = "jax_compilation_cache_dir"
CHECKSUM = hashlib.sha256


class StoredProgram:
    """A compiled function whose trace is stored.

    Without a local cache folder, with a device other than CPUs, and for arguments that have no key, it is compiled by
    `eqx.filter_jit` as usual.
    """

    def __init__(self, function: Callable[..., Any], structure: Callable[..., Any], reuses_state: bool = False):
        """Compile a function.

        Args:
            function: a pure function, whose result is a pytree of arrays.
            structure: returns from the same arguments a pytree with the structure of the result, with any leaves.
            reuses_state: whether the result takes the memory of the second and last argument.
        """
        self._function = function
        self._structure = structure
        self._reuses_state = reuses_state
        self._compiled = eqx.filter_jit(function, donate="all-except-first" if reuses_state else "none")
        self._loaded: dict[str, Callable[..., list]] = {}
        self._loading = threading.Lock()  # threads that need a program at the same time compile it once
        functools.update_wrapper(self, function)

    def __call__(self, *all_arguments: Any) -> Any:
        arguments, others = eqx.partition(all_arguments, eqx.is_array)
        key = _key(self._function, arguments, others)
        if key is None:
            with self._loading:
                return self._compiled(*all_arguments)
        leaves = [jax.tree.leaves(part) for part in arguments]
        with self._loading:
            if key not in self._loaded:
                if len(self._loaded) == MAX_LOADED:
                    self._loaded.pop(next(iter(self._loaded)))
                program = self._traced(key, leaves, [*map(jax.tree.structure, arguments)], others)
                call = functools.update_wrapper(lambda *leaves: program.call(*leaves), self._function)
                # a jitted function would be compiled once more for its own results, which are bound to a device
                self._loaded[key] = jax.jit(call, donate_argnums=(1,) * self._reuses_state).lower(*leaves).compile()
            compiled = self._loaded[key]
        result = compiled(*leaves)
        return jax.tree.unflatten(jax.tree.structure(self._structure(*all_arguments)), result)

    def _traced(self, key: str, leaves: list, structures: list, others: Any) -> jax.export.Exported:
        """Return the stored program, a function of lists of arrays. Trace and store it first where it is not."""
        path = Path(getattr(jax.config, FOLDER)) / "traced" / key
        stored = _read(path)
        if stored is not None:
            return stored

        def of_leaves(*leaves: list) -> list:
            arrays = tuple(map(jax.tree.unflatten, structures, leaves))
            return jax.tree.leaves(self._function(*eqx.combine(arrays, others)))

        allowed = [jax.export.DisabledSafetyCheck.custom_call(name) for name in ffi_targets()]
        program = jax.export.export(jax.jit(of_leaves), disabled_checks=allowed)(*leaves)
        content = bytes(program.serialize())
        with suppress(InputError, OSError):  # a full or protected disk: the next process traces again
            path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(path, CHECKSUM(content).digest() + content)
        return program


def _read(path: Path) -> jax.export.Exported | None:
    """Return a stored program; None if there is no whole file."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    size = CHECKSUM().digest_size
    whole = CHECKSUM(content[size:]).digest() == content[:size]
    return jax.export.deserialize(bytearray(content[size:])) if whole else None


def _key(function: Callable, arguments: Any, others: Any) -> str | None:
    """Return the name of the file of a program; None if its trace is not stored."""
    folder = getattr(jax.config, FOLDER)
    if not folder or "://" in folder or jax.default_backend() != "cpu":
        return None
    described = [_described(leaf) for leaf in (function, *jax.tree.leaves(others))]
    if None in described:
        return None
    arrays = [(x.shape, x.dtype.name, getattr(x, "weak_type", False)) for x in jax.tree.leaves(arguments)]
    structures = jax.tree.structure(arguments), jax.tree.structure(others)
    settings = [getattr(jax.config, name) for name in SETTINGS]
    settings.append(jax.config.read("jax_disable_most_optimizations"))  # it decides the compilation
    whole = _source(), settings, ffi_targets(), described, arrays, structures
    return CHECKSUM(repr(whole).encode()).hexdigest()


def _described(leaf: Any) -> str | None:
    """Return a text that determines a leaf that is no array; None for an unknown kind of leaf."""
    if isinstance(leaf, Term):
        parts = [_described(each) for each in (leaf.function, leaf.with_blocks)]
        return None if None in parts else repr(parts)
    if isinstance(leaf, FunctionType):  # the key holds the source of the package, so the line determines the function
        ours = leaf.__module__.startswith("jaxfit.") and leaf.__closure__ is None
        return f"{leaf.__module__} {leaf.__qualname__} {leaf.__code__.co_firstlineno}" if ours else None
    return repr(leaf) if isinstance(leaf, str | int | float | Blur | InitialiseConfig | None) else None


@functools.cache
def _source() -> str:
    """Return the checksum of the source of the package and of the versions of the libraries."""
    checksum = CHECKSUM(repr([importlib.metadata.version(name) for name in LIBRARIES]).encode())
    for path in sorted(PACKAGE.rglob("*.py")):
        checksum.update(path.read_bytes())
    return checksum.hexdigest()
