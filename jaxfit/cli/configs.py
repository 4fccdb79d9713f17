"""Commands that list the shipped configs and print their settings."""

from __future__ import annotations

import argparse

from jaxfit.errors import InputError

__all__ = ["list_configs", "show_config"]


def list_configs(options: argparse.Namespace) -> None:
    """Print the purpose of every shipped config of fits, and the data on which its values were chosen."""
    from itertools import groupby

    from jaxfit.cli.tables import EscapedTable, show
    from jaxfit.config.fit import describe_fit_configs

    for group, configs in groupby(describe_fit_configs(), lambda config: config.group):
        table = EscapedTable("config", "for", "chosen on", title=group, show_lines=True)
        for config in configs:
            table.add_row(config.name, config.purpose, config.chosen_on)
        show(table)
    show("`jaxfit fit --config NAME` uses a config, and `jaxfit config show NAME` prints its settings")


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
