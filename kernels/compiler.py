"""Print the command of a C++ compiler for the kernels: `CXX`, else `c++`, else Zig's compiler from the package index.

`make install` runs this file with the Python of the virtual environment, and `.ci/wheel.py` uses `zig_compiler` for
wheels that older Linux systems can install.
"""

import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path


def zig_compiler(folder, python, target=None):
    """Write the commands of Zig's compiler into a folder, and return the path of `c++`.

    Args:
        folder: the folder; CMake finds `ar` and `ranlib` beside `c++`.
        python: the Python whose environment holds the package `ziglang`.
        target: the target of the compilation; None compiles for this machine.
    """
    # The program itself, because `python -m ziglang` does not find the package within the isolated build of pip.
    code = "import pathlib, ziglang; print(pathlib.Path(ziglang.__file__).with_name('zig'))"
    zig = subprocess.run([python, "-c", code], check=True, capture_output=True, text=True).stdout.strip()
    # Zig compiles for the processor of this machine by default, but the kernels choose the instruction set themselves.
    # Debian's Python.h includes a file by its path from /usr/include, which Zig does not search.
    options = (f" -target {target}" if target else "") + " -mcpu=baseline -idirafter /usr/include"
    folder.mkdir(exist_ok=True)
    for name, arguments in {"c++": f"c++{options}", "ar": "ar", "ranlib": "ranlib"}.items():
        (folder / name).write_text(f'#!/bin/sh\nexec "{zig}" {arguments} "$@"\n')
        (folder / name).chmod(0o755)
    return folder / "c++"


def main():
    """Print the command, and install Zig where there is no other compiler."""
    named = os.environ.get("CXX") or "c++"
    if shutil.which(named.split()[0]):
        print(named)
        return
    problem = f"No C++ compiler found ({named})"
    if platform.system() == "Windows":
        sys.exit(f"{problem}. Install Clang, or name a compiler: make CXX=/path/to/clang++")
    print(f"{problem}: the kernels are compiled with Zig's compiler from the package index", file=sys.stderr)
    subprocess.run([sys.executable, "-m", "pip", "install", "--quiet", "ziglang"], check=True, stdout=sys.stderr)
    print(zig_compiler(Path(sys.prefix) / "zig", sys.executable))


if __name__ == "__main__":
    main()
