"""Loading the compiled kernels: what is said without them, what a broken build does, which instruction set runs."""

import logging
import os

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfit.cli import doctor
from jaxfit.cli.main import main
from jaxfit.raster import kernels as native
from jaxfit.raster import silhouette as raster

ISAS = native.available_isas()
needs_kernels = pytest.mark.skipif(not ISAS, reason="built without the kernels")
VERTICES = jnp.asarray([[2.0, 2, 1], [12, 3, 1], [6, 13, 1]])
FACES = jnp.asarray([[0, 1, 2]])


@needs_kernels
def test_choosing_an_instruction_set_that_is_not_there():
    with pytest.raises(ValueError, match=r"'sse9' is not available here: choose one of auto.*baseline"):
        native.choose_isa("sse9")
    for isa in ISAS:
        native.choose_isa(isa)
        assert native.current_isa() == isa
    native.choose_isa("auto")
    assert native.current_isa() == ISAS[0]
    assert ISAS[-1] == "baseline"


class TestWithoutKernels:
    @pytest.fixture(autouse=True)
    def no_kernels(self, monkeypatch):
        native._kernels.cache_clear()
        monkeypatch.setattr(native, "_MODULE", "jaxfit._kernels_that_were_never_built")
        yield
        native._kernels.cache_clear()

    def test_the_reference_takes_over_and_says_so_once(self, caplog):
        with caplog.at_level(logging.WARNING, logger="jaxfit"):
            images = [raster.silhouette(VERTICES, FACES, 16) for _ in range(2)]
        np.testing.assert_array_equal(images[0], raster.silhouette(VERTICES, FACES, 16, backend="reference"))
        assert [r.message.count("without its compiled kernels") for r in caplog.records] == [1]
        assert native.available_isas() == ()
        assert native.current_isa() is None
        assert not native.kernels_available()

    def test_insisting_on_them_is_an_error(self):
        with pytest.raises(RuntimeError, match="without its compiled kernels"):
            raster.silhouette(VERTICES, FACES, 16, backend="native")
        with pytest.raises(RuntimeError, match="without its compiled kernels"):
            native.choose_isa("auto")


def test_broken_kernels_fail_loudly(tmp_path, monkeypatch):
    (tmp_path / "jaxfit_broken_kernels.py").write_text("raise ImportError('undefined symbol: broken')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(native, "_MODULE", "jaxfit_broken_kernels")
    native._kernels.cache_clear()
    try:
        with pytest.raises(ImportError, match="undefined symbol"):
            raster.silhouette(VERTICES, FACES, 16)
    finally:
        native._kernels.cache_clear()


@needs_kernels
def test_the_environment_chooses_the_instruction_set(monkeypatch):
    native._kernels.cache_clear()
    monkeypatch.setenv(native.ISA_VARIABLE, "baseline")
    assert native.current_isa() == "baseline"
    monkeypatch.delenv(native.ISA_VARIABLE)
    native._kernels.cache_clear()
    assert native.current_isa() == ISAS[0]


@pytest.fixture
def old_processor(tmp_path, monkeypatch):
    """Kernels on an x86 processor without AVX2, in place of the compiled kernels."""
    module = "available_isas = lambda: ['baseline']\ncurrent_isa = lambda: 'baseline'\n"
    module += "choose_isa = lambda name: None\nhandlers = dict\n"
    (tmp_path / "jaxfit_kernels_without_avx2.py").write_text(module)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(native, "_MODULE", "jaxfit_kernels_without_avx2")
    monkeypatch.setattr(native.platform, "machine", lambda: "x86_64")
    native._kernels.cache_clear()
    yield
    native._kernels.cache_clear()


@pytest.mark.parametrize(
    ("value", "problem"),
    [
        ("avx2", "this processor lacks avx2"),
        ("abacus", "'abacus' is not an instruction set of the kernels"),
        ("BASELINE", "'BASELINE' is not an instruction set of the kernels"),
    ],
)
def test_an_instruction_set_that_the_variable_cannot_have(value, problem, old_processor, monkeypatch, tmp_path, capsys):
    monkeypatch.setenv(native.ISA_VARIABLE, value)
    remedy = "unset the variable, or set it to auto, baseline or none"
    with pytest.raises(ValueError, match=f"{native.ISA_VARIABLE}: {problem}"):
        native.current_isa()
    assert main(["reconstruct", "no.mp4", "--out", str(tmp_path / "result")]) == 2  # before the work begins
    message = f"jaxfit: environment variable JAXFIT_KERNEL_ISA: {problem} ({remedy})\n"
    assert capsys.readouterr().err.endswith(message)
    (finding,) = doctor._checked(doctor._kernels)
    assert (finding.state, finding.remedy) == (f"environment variable JAXFIT_KERNEL_ISA: {problem}", remedy)


def test_a_processor_without_avx2(old_processor, monkeypatch, caplog):
    with caplog.at_level(logging.WARNING, logger="jaxfit"):
        assert [native.lacks_avx2() for _ in range(2)] == [True, True]
    assert [record.message.count("lacks AVX2") for record in caplog.records] == [1]
    assert "lacks AVX2" in doctor._checked(doctor._kernels)[0].state
    monkeypatch.setattr(native.platform, "machine", lambda: "aarch64")
    assert not native.lacks_avx2()


@pytest.mark.skipif(not os.environ.get("JAXFIT_REQUIRE_KERNELS"), reason="JAXFIT_REQUIRE_KERNELS is not set")
def test_the_kernels_were_built():
    assert native.kernels_available()
