"""Command that prints the settings of configs."""

from __future__ import annotations

import argparse

from jaxfit.errors import InputError

__all__ = ["show_config"]


def show_config(options: argparse.Namespace) -> None:
    """Print a shipped config with all values, and with their descriptions as comments."""
    from jaxfit.config.fit import FitConfig
    from jaxfit.config.grid import GridConfig
    from jaxfit.config.reconstruct import ReconstructConfig
    from jaxfit.config.yaml_file import documented_yaml, read_config, shipped_configs

    if options.name not in shipped_configs():
        raise InputError(options.name, "is not a shipped config", f"give one of {', '.join(shipped_configs())}")
    kind = {"reconstruct": ReconstructConfig, "ablation": GridConfig}.get(options.name, FitConfig)
    print(documented_yaml(read_config(kind, options.name)), end="")  # noqa: T201
