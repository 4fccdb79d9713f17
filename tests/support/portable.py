# ruff: noqa: T201  (the table is the output)
"""Compile the kernels with every compiler that is here, and run their test program: `make portable`.

The table has a line for each compiler and check. A compiler that is not installed is skipped, and the line says what to
install. Programs for other processors and systems run in an emulator where there is one.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import jax.ffi

ROOT = Path(__file__).resolve().parents[2]
SOURCE = ROOT / "kernels"
CASES = ROOT / "tests" / "raster" / "kernel_cases.txt"
BUILD = ROOT / "build" / "portable"


class Target(NamedTuple):
    """One compiler with its flags."""

    name: str
    compiler: str
    """The compiler's command."""
    flags: str = ""
    runner: str = ""
    """The command that runs the program; empty for this machine."""
    cmake: tuple[str, ...] = ()
    """Further options of CMake."""


_CHECKED = "-g -O1 -fno-sanitize-recover=all -fsanitize="
TARGETS = (
    Target("GCC", "g++"),
    Target("Clang, libstdc++", "clang++"),
    Target("Clang, libc++", "clang++", "-stdlib=libc++"),
    Target("GCC, addresses, undefined behaviour", "g++", f"{_CHECKED}address,undefined"),
    Target("GCC, threads", "g++", f"{_CHECKED}thread"),
    Target(
        "GCC for 64-bit ARM",
        "aarch64-linux-gnu-g++",
        "-static",
        "qemu-aarch64",
        ("-DCMAKE_SYSTEM_NAME=Linux", "-DCMAKE_SYSTEM_PROCESSOR=aarch64"),
    ),
    Target(
        "MinGW-w64 for Windows",
        "x86_64-w64-mingw32-g++-posix",
        "-static",
        "wine64",
        ("-DCMAKE_SYSTEM_NAME=Windows", "-DCMAKE_SYSTEM_PROCESSOR=AMD64"),
    ),
)


def check(target: Target) -> list[tuple[str, str, str]]:
    """Return the lines of the table for a target: instruction set, check, result."""
    if shutil.which(target.compiler) is None:
        return [("", "skipped", f"{target.compiler} is not installed")]
    folder = BUILD / target.name.lower().replace(",", "").replace(" ", "-")
    shutil.rmtree(folder, ignore_errors=True)
    # The sanitizers take the level of optimisation from the flags of the target.
    build_type = "None" if "-fsanitize" in target.flags else "Release"
    configure = [
        *("cmake", "-S", str(SOURCE), "-B", str(folder), f"-DCMAKE_BUILD_TYPE={build_type}"),
        *("-DJAXFIT_KERNEL_CASES=ON", f"-DXLA_HEADERS={jax.ffi.include_dir()}"),
        *(f"-DCMAKE_CXX_COMPILER={target.compiler}", f"-DCMAKE_CXX_FLAGS=-Werror {target.flags}", *target.cmake),
    ]
    for command in (configure, ["cmake", "--build", str(folder), "--parallel", "2"]):
        ran = subprocess.run(command, capture_output=True, text=True)
        if ran.returncode:
            print(ran.stdout, ran.stderr, sep="\n", file=sys.stderr)
            return [("", "compile", "FAILED")]
    compiled = ("", "compile", "ok")
    runner = shutil.which(target.runner, path=f"{os.environ['PATH']}:/usr/lib/wine") if target.runner else ""
    if runner is None:
        return [compiled, ("", "run", f"skipped: {target.runner} is not installed")]
    (program,) = (path for path in folder.iterdir() if path.name in ("kernel_cases", "kernel_cases.exe"))
    ran = subprocess.run([*filter(None, [runner]), str(program), str(CASES)], capture_output=True, text=True)
    if "unexpected memory mapping" in ran.stderr:  # GCC 12's thread sanitizer, where Linux spreads addresses widely
        return [compiled, ("", "run", "skipped: this sanitizer does not start on this system")]
    lines = [line.split() for line in ran.stdout.splitlines()]
    isas = list(dict.fromkeys(line[0] for line in lines))
    result = [compiled]
    for isa in isas:
        own = [line for line in lines if line[0] == isa]
        errors = {name: float(error) for _, name, error, _ in own if error != "-"}
        wrong = [name for _, name, _, verdict in own if verdict != "ok"]
        worst = max(errors[name] for name in ("l1_gradient", "smooth_l1_gradient", "pull"))
        text = f"WRONG: {', '.join(wrong)}" if wrong else f"ok, gradients to {worst:.1e}"
        result.append((isa, "run", text))
    if ran.returncode:
        print(ran.stdout, ran.stderr, sep="\n", file=sys.stderr)
        result.append(("", "run", f"FAILED with code {ran.returncode}"))
    return result


def main() -> int:
    """Check all targets and print the table."""
    if shutil.which("cmake") is None:
        print("make portable needs CMake, which is not installed: skipped")
        return 0
    failed = False
    print(f"{'compiler':36} {'instructions':12} {'check':8} result")
    for target in TARGETS:
        for isa, what, result in check(target):
            failed |= any(word in result for word in ("FAILED", "WRONG"))
            print(f"{target.name:36} {isa:12} {what:8} {result}", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
