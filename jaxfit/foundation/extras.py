"""Installed packages: jaxfit itself, optional packages, which extras add, and packages that results depend on."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from jaxfit.foundation.errors import InputError

DISTRIBUTION = "jaxfit-birds"
"""Name of the distribution, as in pyproject.toml. The package and the command are named `jaxfit`, but the package index
has other software of that name."""
_COMMAND = "jaxfit.cli.main:run"

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
    "h5py": OptionalPackage("h5py", "3.14", "formats", "files of DeepLabCut (.h5) and SLEAP"),
    "sleap-io": OptionalPackage(
        "sleap_io", "0.9", "formats", "projects and CSV of SLEAP, AlphaTracker, `jaxfit suggest`"
    ),
    "xarray": OptionalPackage("xarray", "2025.8", "formats", "`jaxfit export --to movement`"),
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
    "starlette": OptionalPackage("starlette", "1.0", "view", "`jaxfit view`"),
    "uvicorn": OptionalPackage("uvicorn", "0.40", "view", "`jaxfit view`"),
    "trackers": OptionalPackage("trackers", "2.6", "trackers", "trackers other than the paper's tracker"),
}
"""Name in the package index → package."""


def own_version() -> str:
    """Return the version of jaxfit: of the installed distribution, or of the checkout; `unknown` without both."""
    try:
        return metadata.version(DISTRIBUTION)
    except metadata.PackageNotFoundError:
        pass
    path = Path(__file__).resolve().parents[2] / "pyproject.toml"
    project = tomllib.loads(path.read_text(encoding="utf-8")).get("project", {}) if path.is_file() else {}
    return str(project["version"]) if project.get("name") == DISTRIBUTION else "unknown"


__version__ = own_version()


def other_jaxfit() -> str | None:
    """Return the version of the other software that the package index names `jaxfit`; None if it is not installed."""
    try:
        distribution = metadata.distribution("jaxfit")
    except metadata.PackageNotFoundError:
        return None
    # earlier versions of this package were distributions of that name too
    is_this_package = any(point.value == _COMMAND for point in distribution.entry_points)
    return None if is_this_package else distribution.version


def install_command(extra: str, upgrade: bool = False) -> str:
    """Return the text that says how to install an extra. The package index does not have this package."""
    return f'pip install {"--upgrade " * upgrade}".[{extra}]" in the checkout of jaxfit, or "NAME.whl[{extra}]"'


def require_extra(extra: str, source: str, *names: str) -> None:
    """Raise InputError if a package of an extra is missing. All versions of the packages are accepted.

    Args:
        extra: name of the extra in `pip install ".[extra]"`.
        source: the command or function that needs the extra, for the message.
        names: names of `OPTIONAL_PACKAGES` that are needed. Without names, all packages of the extra are needed.
    """
    names = names or tuple(name for name, package in OPTIONAL_PACKAGES.items() if package.extra == extra)
    missing = [name for name in names if find_spec(OPTIONAL_PACKAGES[name].module) is None]
    if missing:
        problem = f"needs {' and '.join(missing)}, which this installation lacks"
        raise InputError(source, problem, f"run {install_command(extra)}")


def require_package(name: str, source: str) -> None:
    """Raise InputError if an optional package is missing or too old.

    Args:
        name: a name of `OPTIONAL_PACKAGES`.
        source: the command or option that needs the package, for the message.
    """
    problem = package_problem(name)
    if problem:
        extra = OPTIONAL_PACKAGES[name].extra
        raise InputError(source, f"needs {problem}", f"run {install_command(extra, upgrade=True)}")


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
    """Return the versions of some installed packages, and of `jaxfit`."""
    return {name: own_version() if name == "jaxfit" else metadata.version(name) for name in names}
