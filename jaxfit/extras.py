"""Check of optional packages, which the extras of the installation add."""

from __future__ import annotations

from importlib.util import find_spec

from jaxfit.errors import InputError

__all__ = ["require_extra"]

_EXTRAS = {
    "formats": ("h5py", ("h5py",)),
    "report": ("Matplotlib and tabulate", ("matplotlib", "tabulate")),
    "train": ("PyTorch and ONNX", ("torch", "onnx", "onnxscript")),
}


def require_extra(extra: str, source: str) -> None:
    """Raise InputError if a package of an extra is missing.

    Args:
        extra: name of the extra in `pip install "jaxfit[extra]"`.
        source: the command or function that needs the extra, for the message.
    """
    names, packages = _EXTRAS[extra]
    if not all(find_spec(package) for package in packages):
        raise InputError(source, f"needs {names}, which this installation lacks", f'run pip install "jaxfit[{extra}]"')
