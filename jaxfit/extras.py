"""Installed packages: check of optional packages, which extras add, and versions of packages that results depend on."""

from __future__ import annotations

import re
from collections.abc import Sequence
from importlib import metadata
from importlib.util import find_spec
from typing import NamedTuple

from jaxfit.errors import InputError

__all__ = [
    "LIBRARIES",
    "OPTIONAL_PACKAGES",
    "TRACKING_LIBRARIES",
    "OptionalPackage",
    "library_versions",
    "package_problem",
    "require_extra",
    "require_package",
]

LIBRARIES = ("jaxfit", "jax", "jaxlib", "equinox", "optimistix", "optax", "numpy")
"""Packages that a fit depends on."""
TRACKING_LIBRARIES = ("onnxruntime", "opencv-python-headless", "av", "scipy")
"""Further packages that tracking depends on."""


class OptionalPackage(NamedTuple):
    """A package of an extra."""

    module: str
    """Name in an import."""
    lowest: str
    """Lowest version that works, as in pyproject.toml."""
    extra: str
    use: str
    """What needs the package."""


OPTIONAL_PACKAGES = {
    "h5py": OptionalPackage("h5py", "3.12", "formats", "files of DeepLabCut (.h5) and SLEAP, `jaxfit suggest`"),
    "xarray": OptionalPackage("xarray", "2024.10", "formats", "`jaxfit export --to movement`"),
    "h5netcdf": OptionalPackage("h5netcdf", "1.4", "formats", "`jaxfit export --to movement`"),
    "pyarrow": OptionalPackage("pyarrow", "18", "formats", "`jaxfit export --to parquet`"),
    "pynwb": OptionalPackage("pynwb", "4.2", "formats", "`jaxfit export --to nwb`"),
    "ndx-pose": OptionalPackage("ndx_pose", "0.4", "formats", "`jaxfit export --to nwb`"),
    "matplotlib": OptionalPackage("matplotlib", "3.9", "report", "`jaxfit ablate`"),
    "tabulate": OptionalPackage("tabulate", "0.9", "report", "`jaxfit ablate`"),
    "torch": OptionalPackage("torch", "2.9", "train", "`jaxfit train`"),
    "onnx": OptionalPackage("onnx", "1.18", "train", "`jaxfit train`"),
    "onnxscript": OptionalPackage("onnxscript", "0.5", "train", "`jaxfit train`"),
    "dask": OptionalPackage("dask", "2026.8", "cluster", "`--workers`, `--scheduler`"),
    "distributed": OptionalPackage("distributed", "2026.8", "cluster", "`--workers`, `--scheduler`"),
    "trackers": OptionalPackage("trackers", "2.6", "trackers", "trackers other than the paper's tracker"),
}
"""Name in the package index → package."""


def require_extra(extra: str, source: str, *names: str) -> None:
    """Raise InputError if a package of an extra is missing. All versions of the packages are accepted.

    Args:
        extra: name of the extra in `pip install "jaxfit[extra]"`.
        source: the command or function that needs the extra, for the message.
        names: names of `OPTIONAL_PACKAGES` that are needed. Without names, all packages of the extra are needed.
    """
    names = names or tuple(name for name, package in OPTIONAL_PACKAGES.items() if package.extra == extra)
    missing = [name for name in names if find_spec(OPTIONAL_PACKAGES[name].module) is None]
    if missing:
        problem = f"needs {' and '.join(missing)}, which this installation lacks"
        raise InputError(source, problem, f'run pip install "jaxfit[{extra}]"')


def require_package(name: str, source: str) -> None:
    """Raise InputError if an optional package is missing or too old.

    Args:
        name: a name of `OPTIONAL_PACKAGES`.
        source: the command or option that needs the package, for the message.
    """
    problem = package_problem(name)
    if problem:
        extra = OPTIONAL_PACKAGES[name].extra
        raise InputError(source, f"needs {problem}", f'run pip install --upgrade "jaxfit[{extra}]"')


def package_problem(name: str) -> str:
    """Return why an optional package cannot be used, such as `pynwb 3.0, which is not installed`; empty if it can."""
    package = OPTIONAL_PACKAGES[name]
    if find_spec(package.module) is None:
        return f"{name}, which this installation lacks"
    try:
        version = metadata.version(name)
    except metadata.PackageNotFoundError:  # installed without metadata, so the version is unknown
        return ""
    if _numbers(version) < _numbers(package.lowest):
        return f"{name} {package.lowest} or newer, but version {version} is installed"
    return ""


def _numbers(version: str) -> tuple[int, ...]:
    """Return the leading numbers of a version: (2, 13, 0) for `2.13.0+cpu`."""
    match = re.match(r"\d+(\.\d+)*", version)
    return tuple(int(part) for part in match[0].split(".")) if match else ()


def library_versions(names: Sequence[str]) -> dict[str, str]:
    """Return the versions of some installed packages."""
    return {name: metadata.version(name) for name in names}
