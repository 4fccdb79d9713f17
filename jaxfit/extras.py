"""Optional packages, which come with the extras of the installation."""

from __future__ import annotations

from importlib.util import find_spec

from jaxfit.errors import InputError

__all__ = ["require_extra"]

_EXTRAS = {
    "report": ("Matplotlib and tabulate", ("matplotlib", "tabulate")),
    "train": ("PyTorch and ONNX", ("torch", "onnx", "onnxscript")),
}


def require_extra(extra: str, source: str) -> None:
    """Raise InputError where a package of the extra is missing, before the work of `source` begins."""
    what, packages = _EXTRAS[extra]
    if not all(find_spec(package) for package in packages):
        raise InputError(source, f"needs {what}, which are not installed", f'pip install "jaxfit[{extra}]"')
