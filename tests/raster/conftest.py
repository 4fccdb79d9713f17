import pytest

from jaxfit.raster import kernels as native


@pytest.fixture(params=["avx512", "avx2", "baseline", "none"])
def each_isa(request, monkeypatch):
    """Runs the test once with each instruction set, and once without kernels."""
    if request.param == "none":
        monkeypatch.setenv(native.ISA_VARIABLE, "none")
        native._kernels.cache_clear()
        yield
        native._kernels.cache_clear()
        return
    isas = native.available_isas()
    if request.param not in isas:
        pytest.skip(f"no {request.param} kernels here: {isas}")
    native.choose_isa(request.param)
    yield
    native.choose_isa("auto")


@pytest.fixture(params=["reference", *native.available_isas()])
def backend(request):
    """The reference, and the kernels of each instruction set."""
    if request.param == "reference":
        yield request.param
    else:
        native.choose_isa(request.param)
        yield "native"
        native.choose_isa("auto")


@pytest.fixture(name="native", params=native.available_isas() or [None])
def _native(request):
    """The kernels of each instruction set."""
    if request.param is None:
        pytest.skip("no compiled kernels here")
    native.choose_isa(request.param)
    yield "native"
    native.choose_isa("auto")
