"""C++ exceptions: worker threads return them with their own message, and none crosses XLA's C interface."""

import os
import shlex
import shutil
import subprocess
from pathlib import Path

import jax.ffi
import pytest

KERNELS = Path(__file__).resolve().parents[2] / "kernels"
COMPILER = shlex.split(os.environ.get("CXX", "c++"))

# the codes are those of absl::StatusCode: 3 invalid argument, 8 resource exhausted, 13 internal
EXPECTED = """\
task runtime_error: the task's own message
task bad_alloc: std::bad_alloc
task int: int 7
task none: nothing
helpers: 499500
xla runtime_error: 13 jaxfit: the task's own message
xla invalid_argument: 3 jaxfit: faces: too few
xla bad_alloc: 8 jaxfit: out of memory
xla int: 13 jaxfit: unknown C++ exception
xla none: nothing
"""


@pytest.mark.skipif(shutil.which(COMPILER[0]) is None, reason="no C++ compiler")
def test_exceptions_keep_their_message(tmp_path):
    program = tmp_path / "kernel_exceptions"
    source = Path(__file__).with_name("kernel_exceptions.cc")
    include = [f"-I{KERNELS}", f"-I{jax.ffi.include_dir()}"]
    subprocess.run([*COMPILER, "-std=c++17", "-pthread", *include, source, "-o", program], check=True)
    ran = subprocess.run([program], capture_output=True, text=True, check=True, timeout=60)
    assert ran.stdout == EXPECTED
