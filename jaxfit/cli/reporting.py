"""The command that writes the report of a result."""

from __future__ import annotations

import argparse

from jaxfit.cli.tables import show

__all__ = ["report"]


def report(options: argparse.Namespace) -> None:
    """Write the report of a result."""
    from jaxfit.report.write import report_of_result

    path = report_of_result(options.result, options.video, options.out, options.overwrite, options.force)
    show(f"{path} ({path.stat().st_size / 1e6:.2f} MB): open it in a browser")
