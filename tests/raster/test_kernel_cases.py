"""The stored cases of the kernels: they are what the reference computes, and the test program compares with them."""

import os
import shlex
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from support.kernel_cases import STORED, cases, read_cases

KERNELS = Path(__file__).resolve().parents[2] / "kernels"
pytestmark = pytest.mark.extended
COMPILER = shlex.split(os.environ.get("CXX", "c++"))


def test_stored_cases_are_those_of_the_reference():
    stored, expected = read_cases(STORED.read_text(encoding="utf-8")), cases()
    assert len(stored) == len(expected)
    for of_file, of_reference in zip(stored, expected, strict=True):
        assert list(of_file) == list(of_reference)
        for name, values in of_reference.items():
            scale = np.abs(values).max()
            np.testing.assert_allclose(of_file[name], values, rtol=0, atol=2e-5 * scale, err_msg=name)


@pytest.mark.skipif(shutil.which(COMPILER[0]) is None, reason="no C++ compiler")
def test_program_finds_wrong_numbers(tmp_path):
    program, wrong = tmp_path / "kernel_cases", tmp_path / "wrong.txt"
    sources = [KERNELS / f"{name}.cc" for name in ("silhouette", "filtered", "zbuffer", "instruction_set")]
    source = Path(__file__).with_name("kernel_cases.cc")
    flags = ["-std=gnu++17", "-O1", "-ffp-contract=off", "-Wno-psabi", "-pthread", f"-I{KERNELS}"]
    subprocess.run([*COMPILER, *flags, source, *sources, "-o", program], check=True)
    ran = subprocess.run([program, STORED], capture_output=True, text=True, timeout=60)
    assert ran.returncode == 0, ran.stdout
    results = {line.split()[1]: line.split()[3] for line in ran.stdout.splitlines()}
    assert set(results) == {
        *("silhouette", "pull", "l1", "l1_gradient", "smooth_l1", "smooth_l1_gradient", "block", "face", "depth"),
        "threads",
    }
    assert set(results.values()) == {"ok"}

    lines = STORED.read_text(encoding="utf-8").splitlines()
    number = next(i for i, line in enumerate(lines) if line.startswith("pull "))
    name, count, first, *rest = lines[number].split()
    lines[number] = " ".join([name, count, str(float(first) + 1), *rest])
    wrong.write_text("\n".join(lines) + "\n", encoding="utf-8")
    ran = subprocess.run([program, wrong], capture_output=True, text=True, timeout=60)
    assert ran.returncode == 1
    assert [line.split()[1] for line in ran.stdout.splitlines() if line.endswith("WRONG")] == ["pull"]

    wrong.write_text("\n".join(lines)[:5000], encoding="utf-8")
    ran = subprocess.run([program, wrong], capture_output=True, text=True, timeout=60)
    assert (ran.returncode, ran.stdout) == (2, "")
    assert "is not a complete file of cases" in ran.stderr
