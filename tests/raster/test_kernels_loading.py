"""Loading the compiled kernels: what is said without them, what a broken build does, which instruction set runs."""

import logging
import os

import jax.numpy as jnp
import numpy as np
import pytest

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
    native._kernels.cache_clear()
    monkeypatch.setenv(native.ISA_VARIABLE, "abacus")
    with pytest.raises(ValueError, match="'abacus' is not available"):
        native.current_isa()
    monkeypatch.delenv(native.ISA_VARIABLE)
    native._kernels.cache_clear()
    assert native.current_isa() == ISAS[0]


@pytest.mark.skipif(not os.environ.get("JAXFIT_REQUIRE_KERNELS"), reason="JAXFIT_REQUIRE_KERNELS is not set")
def test_the_kernels_were_built():
    assert native.kernels_available()
