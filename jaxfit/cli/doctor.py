"""The command that checks the installation: one line for every part, with the remedy where a part is missing."""

from __future__ import annotations

import argparse
import os
import platform
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

from jaxfit.cli.tables import EscapedTable, show
from jaxfit.foundation.errors import InputError, counted
from jaxfit.foundation.extras import (
    DISTRIBUTION,
    OPTIONAL_PACKAGES,
    install_command,
    other_jaxfit,
    own_version,
    package_problem,
)

_DECODERS = ("h264", "hevc", "vp9", "av1", "mpeg4", "mjpeg", "prores")
"""Codecs of cameras and of video archives."""


class Finding(NamedTuple):
    """The state of one part of the installation."""

    part: str
    state: str
    remedy: str = ""
    """What to do; empty where nothing is missing."""
    optional: bool = False
    """Whether only some commands need this part."""


def doctor(_options: argparse.Namespace) -> None:
    """Print the state of every part of the installation."""
    findings = [finding for check in _CHECKS for finding in _checked(check)]
    table = EscapedTable(show_header=False)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for finding in findings:
        table.add_row(finding.part, finding.state)
        if finding.remedy:
            table.add_row("", f"→ {finding.remedy}")
    show(table)
    missing = [finding for finding in findings if finding.remedy]
    faults, packages = (sum(finding.optional == optional for finding in missing) for optional in (False, True))
    if faults:
        show(f"{counted(faults, 'part')} missing or in need of repair: → says what to do")
    else:
        show("everything that jaxfit requires works")
    if packages:
        are = "optional package is" if packages == 1 else "optional packages are"
        show(f"{packages} {are} not installed, or too old: → says which commands need them")


def _checked(check: Callable[[], Iterator[Finding]]) -> list[Finding]:
    """Return the findings of a check. A check that fails is a finding, so that the other checks are shown."""
    try:
        return list(check())
    except Exception as error:  # any fault of a library is what this command reports
        name = check.__name__.strip("_").replace("_", " ")
        return [Finding(name, f"fails: {type(error).__name__}: {error}"[:200], "reinstall jaxfit")]


def _versions() -> Iterator[Finding]:
    yield Finding("jaxfit", f"{own_version()}, Python {platform.python_version()}, JAX {metadata.version('jax')}")


def _other_software() -> Iterator[Finding]:
    version = other_jaxfit()
    if version is not None:
        state = f"version {version} of the package index is installed: other software, which replaces files of jaxfit"
        remedy = "run pip uninstall jaxfit, then pip install --force-reinstall --no-deps . in the checkout of jaxfit, "
        remedy += f"which is named {DISTRIBUTION} in pip"
        yield Finding("another jaxfit", state, remedy)


def _processor() -> Iterator[Finding]:
    name = platform.processor() or platform.machine()
    if Path("/proc/cpuinfo").is_file():
        lines = Path("/proc/cpuinfo").read_text(errors="replace").splitlines()
        name = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), name)
    yield Finding("processor", f"{name}, {counted(os.cpu_count() or 1, 'core')}, {platform.system()}")


def _kernels() -> Iterator[Finding]:
    from importlib.util import find_spec

    from jaxfit.raster.kernels import ISA_VARIABLE, available_isas, current_isa, isa_problem, lacks_avx2

    if os.environ.get(ISA_VARIABLE) == "none":
        yield Finding("kernels", f"switched off by {ISA_VARIABLE}=none", f"unset {ISA_VARIABLE}")
    elif find_spec("jaxfit.raster._kernels") is None:
        remedy = "install GCC or Clang, and reinstall jaxfit: fits are hundreds of times slower without kernels"
        yield Finding("kernels", "not built", remedy)
    elif (problem := isa_problem()) is not None:
        yield Finding("kernels", f"environment variable {ISA_VARIABLE}: {problem[0]}", problem[1])
    else:
        state = f"{current_isa()} (this processor supports: {', '.join(available_isas())})"
        yield Finding("kernels", state + "; slow, because this processor lacks AVX2" * lacks_avx2())


def _ffmpeg() -> Iterator[Finding]:
    import av

    from jaxfit.video import CODECS

    codecs = ".".join(map(str, av.library_versions["libavcodec"]))
    yield Finding("FFmpeg", f"PyAV {av.__version__} with libavcodec {codecs}")
    remedy = 'run pip install --upgrade --force-reinstall "av>=18,<19"'
    encoders = {name: encoder for name, (encoder, _) in CODECS.items()}
    for what, mode, codecs in (("read", "r", {name: name for name in _DECODERS}), ("written", "w", encoders)):
        found = [name for name, codec in codecs.items() if _has_codec(codec, mode)]
        lacking = [name for name in codecs if name not in found]
        state = f"{', '.join(found) or 'none'}" + (f"; without {', '.join(lacking)}" if lacking else "")
        yield Finding(f"codecs that are {what}", state, remedy if lacking else "")


def _has_codec(name: str, mode: str) -> bool:
    import av

    try:
        av.Codec(name, mode)  # type: ignore[arg-type]
    except ValueError:  # PyAV's error for unknown codecs
        return False
    return True


def _networks() -> Iterator[Finding]:
    import onnxruntime

    from jaxfit.config.perception import TrackConfig
    from jaxfit.perception.detections import open_keypoint_detector
    from jaxfit.perception.segmentation import load_segmenter

    yield Finding("ONNX Runtime", f"{onnxruntime.__version__}: {', '.join(onnxruntime.get_available_providers())}")
    for name, load in (
        ("built-in segmenter", lambda: load_segmenter("builtin")),
        ("built-in keypoint network", lambda: open_keypoint_detector(TrackConfig())),
    ):
        try:
            load()
            yield Finding(name, "loads")
        except InputError as error:
            yield Finding(name, str(error), "reinstall jaxfit")
    yield _general_segmenter()


def _general_segmenter() -> Finding:
    from jaxfit.perception.general_networks import COMMAND, general_files, installed_general
    from jaxfit.perception.segmentation import load_segmenter

    name = "general segmenter"
    installed = installed_general()
    if installed is None and not any(path.exists() for path in general_files()):
        return Finding(name, "not installed", f"for birds of any species: {COMMAND}", optional=True)
    try:
        load_segmenter(installed or "general")
    except InputError as error:
        return Finding(name, f"{error.source}: {error.problem}", error.remedy)
    return Finding(name, f"`{installed}` loads")


def _optional_packages() -> Iterator[Finding]:
    for name, package in OPTIONAL_PACKAGES.items():
        problem = package_problem(name)
        if problem:
            state = "missing" if "lacks" in problem else f"too old: version {metadata.version(name)}"
            remedy = f"for {package.use}: {install_command(package.extra, upgrade=True)}"
            yield Finding(name, state, remedy, optional=True)
        else:
            yield Finding(name, f"{metadata.version(name)}, for {package.use}")


def _cache() -> Iterator[Finding]:
    from jaxfit.cli.main import cache_folder
    from jaxfit.foundation.files import check_writable

    folder = cache_folder()
    files = [path for path in folder.rglob("*") if path.is_file()] if folder.is_dir() else []
    size = sum(path.stat().st_size for path in files) / 1e6
    try:
        check_writable(folder / "entry")
    except InputError as error:
        yield Finding(
            "cache", f"{folder}: {error.problem}", "make it writable, or set XDG_CACHE_HOME to another folder"
        )
        return
    yield Finding("cache", f"{folder}: {counted(len(files), 'compiled program')}, {size:.0f} MB; may be deleted")


_CHECKS = (_versions, _other_software, _processor, _kernels, _ffmpeg, _networks, _optional_packages, _cache)
