"""Installing jaxfit: the content of wheels, a clean environment, and the build problems that fail an installation.

The tests build wheels and install packages from the package index.
"""

import os
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
from support.exported import write_result

from jaxfit.export.export import export_result

pytestmark = pytest.mark.extended

ROOT = Path(__file__).resolve().parents[2]
SOURCES = ("pyproject.toml", "README.md", "LICENSE", ".gitignore", "configs", "jaxfit", "kernels")
ANNOUNCEMENT = "installs WITHOUT its compiled kernels"
TRACKER_TESTS = ("tests/perception/test_tracker.py", "tests/evaluation/test_tracking_metrics.py")


def run(*command, fails=False, **changed_environment):
    """Runs a command without access to the checkout, and returns its output."""
    environment = os.environ | {"PYTHONPATH": "", "JAX_PLATFORMS": "cpu"} | changed_environment
    done = subprocess.run(
        list(map(str, command)), cwd="/", env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    assert (done.returncode != 0) == fails, done.stdout[-5000:]
    return done.stdout


def new_environment(folder, *requirements):
    """Makes a virtual environment with some packages, and returns its Python."""
    run(sys.executable, "-m", "venv", folder)
    python = folder / "bin" / "python"
    run(python, "-m", "pip", "install", "--quiet", "--no-compile", *requirements)  # few modules are imported
    return python


@pytest.fixture(scope="module")
def build_python(tmp_path_factory):
    """The Python of an environment with all packages that a build requires."""
    requires = tomllib.loads((ROOT / "pyproject.toml").read_text())["build-system"]["requires"]
    return new_environment(tmp_path_factory.mktemp("build") / "venv", *requires, "cmake", "ninja")


@pytest.fixture
def source(tmp_path):
    """A copy of everything that a build reads."""
    folder = tmp_path / "source"
    folder.mkdir()
    for name in SOURCES:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("*.so", "__pycache__"))
        else:
            shutil.copy(ROOT / name, folder / name)
    return folder


def build_wheel(python, source, *settings, fails=False, **environment):
    """Builds a wheel. Returns the wheel, or None where the build fails, and the output of the build."""
    command = (python, "-m", "pip", "wheel", "-v", "--no-deps", "--no-build-isolation", "-w", source / "dist", source)
    path = f"{python.parent}{os.pathsep}{os.environ['PATH']}"
    output = run(*command, *settings, fails=fails, **({"PATH": path} | environment))
    wheels = list((source / "dist").glob("*.whl")) if (source / "dist").exists() else []
    assert len(wheels) == (0 if fails else 1)
    return (None if fails else wheels[0]), output


def names_in(wheel):
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


def kernels_in(wheel):
    return [name for name in names_in(wheel) if name.startswith("jaxfit/raster/_kernels") and name.endswith(".so")]


@pytest.fixture(scope="module")
def sdist(build_python, tmp_path_factory):
    """The folder of an unpacked source distribution."""
    folder = tmp_path_factory.mktemp("sdist")
    code = f"import os; os.chdir({str(ROOT)!r}); from scikit_build_core.build import build_sdist"
    run(build_python, "-c", f"{code}; build_sdist({str(folder)!r})")
    (archive,) = folder.glob("jaxfit_birds-*.tar.gz")
    with tarfile.open(archive) as file:
        file.extractall(folder, filter="data")
    return archive.with_name(archive.name.removesuffix(".tar.gz"))


@pytest.fixture(scope="module")
def wheel(build_python, sdist):
    """A wheel of the source distribution."""
    return build_wheel(build_python, sdist)[0]


def test_a_source_distribution_holds_what_builds_and_readers_need(sdist):
    assert {path.name for path in sdist.iterdir()} - {"dist"} == {*SOURCES, "CHANGELOG.md", "CITATION.cff", "PKG-INFO"}


def test_a_wheel_holds_kernels_configs_and_all_files_of_the_package(wheel):
    files = (p for p in (ROOT / "jaxfit").rglob("*") if p.is_file() and p.suffix not in (".so", ".pyc"))
    expected = {str(path.relative_to(ROOT)) for path in files}
    expected |= {f"jaxfit/configs/{path.name}" for path in (ROOT / "configs").iterdir()}
    names = {name for name in names_in(wheel) if ".dist-info/" not in name}
    assert names - set(kernels_in(wheel)) == expected
    assert len(kernels_in(wheel)) == 1
    for name in (
        "jaxfit/configs/paper.yaml",
        "jaxfit/model/murre.npz",
        "jaxfit/model/murre_postures.json",
        "jaxfit/perception/networks/keypoints.onnx",
    ):
        assert name in names


@pytest.fixture(scope="module")
def clean_python(wheel, tmp_path_factory):
    """The Python of an environment with the wheel and what the wheel requires, and nothing else."""
    return new_environment(tmp_path_factory.mktemp("clean") / "venv", wheel)


def test_the_wheel_works_in_a_clean_environment(clean_python):
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert run(clean_python.with_name("jaxfit"), "--version").strip() == f"jaxfit {version}"
    code = "import jaxfit; jaxfit.load_config('paper'); from jaxfit.raster.kernels import kernels_available; "
    code += "assert kernels_available(); print(jaxfit.__file__)"
    assert str(clean_python.parents[1]) in run(clean_python, "-c", code)


def test_the_extra_trackers(clean_python, wheel):
    """The extra brings another OpenCV, so its tests run in an environment of their own. None of them may skip."""
    run(clean_python, "-m", "pip", "install", "--quiet", "--no-compile", f"{wheel}[trackers]", "pytest", "hypothesis")
    tests = [ROOT / name for name in TRACKER_TESTS]
    pytest_command = (clean_python.with_name("pytest"), "-rA", "-p", "no:cacheprovider", "--rootdir", ROOT)
    output = run(*pytest_command, "-c", ROOT / "pyproject.toml", *tests)
    assert " passed" in output
    assert "SKIPPED" not in output


def test_movement_opens_an_export(tmp_path):
    """movement requires other packages, so it opens the file in an environment of its own; 0.15 has plural names."""
    write_result(tmp_path / "result", with_detections=True)
    out = tmp_path / "birds.nc"
    export_result(tmp_path / "result", "movement", out, dims="plural")
    python = new_environment(tmp_path / "venv", "movement<0.17", "h5netcdf")
    code = "import sys, xarray; from movement.kinematics import compute_velocity; "
    code += "from movement.validators.datasets import ValidPosesInputs; data = xarray.load_dataset(sys.argv[1]); "
    code += "ValidPosesInputs.validate(data); print(*compute_velocity(data.position).dims, data.attrs['fps'])"
    assert run(python, "-c", code, out).split()[-5:] == ["time", "space", "keypoints", "individuals", "12.5"]


@pytest.mark.parametrize("named", [False, True], ids=["no compiler in PATH", "CXX names no program"])
def test_without_a_compiler_the_package_installs_without_kernels(build_python, source, named):
    # By default CMake also searches /usr/bin and the like, where this machine has a compiler.
    only_path = "--config-settings=cmake.define.CMAKE_FIND_USE_CMAKE_SYSTEM_PATH=OFF"
    environment = {"CXX": "/nonexistent/c++"} if named else {"CXX": "", "PATH": str(build_python.parent)}
    wheel, output = build_wheel(build_python, source, *(() if named else (only_path,)), **environment)
    assert not kernels_in(wheel)
    assert f"{ANNOUNCEMENT}: there is no C++ compiler" in " ".join(output.split())


def test_for_another_processor_the_package_installs_without_kernels(build_python, source):
    system = ("CMAKE_SYSTEM_NAME=Linux", "CMAKE_SYSTEM_PROCESSOR=s390x")
    settings = [f"--config-settings=cmake.define.{definition}" for definition in system]
    wheel, output = build_wheel(build_python, source, *settings)
    assert not kernels_in(wheel)
    assert f"{ANNOUNCEMENT}: the kernels do not support the processor 's390x'" in " ".join(output.split())


@pytest.mark.parametrize(
    ("line", "message"),
    [("int broken(", "error: expected"), ('#include "no_such_header.h"', "no_such_header.h: No such file")],
)
def test_a_compile_error_fails_the_installation(build_python, source, line, message):
    file = source / "kernels" / "mesh.h"  # in all files, so the first compilation fails
    file.write_text(file.read_text() + f"\n{line}\n")
    _, output = build_wheel(build_python, source, fails=True)
    assert message in output


def test_a_compiler_that_does_not_work_fails_the_installation(build_python, source):
    _, output = build_wheel(build_python, source, fails=True, CXX=shutil.which("false"))
    assert "is not able to compile a simple test program" in " ".join(output.split())
