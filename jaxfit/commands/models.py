"""Import, inspect and show bird models."""

from __future__ import annotations

import argparse

from jaxfit.errors import InputError
from jaxfit.model.files import find_bird, save_bird
from jaxfit.tables import plain_json, show, show_facts

__all__ = ["model_import", "model_info", "model_view"]


def model_import(options: argparse.Namespace) -> None:
    from jaxfit.model.sources import import_sources

    bird = import_sources(options.kind, options.sources)
    save_bird(bird, options.out)
    show(f"{bird.name}: {bird.vertices.shape[0]} vertices, {bird.num_keypoints} keypoints → {options.out}")


def model_info(options: argparse.Namespace) -> None:
    from jaxfit.model.describe import describe_bird

    facts = describe_bird(find_bird(options.file))
    if options.json:
        print(plain_json(facts))  # noqa: T201
    else:
        show_facts(facts)


def model_view(options: argparse.Namespace) -> None:
    from jaxfit.model.murre import POSTURES
    from jaxfit.view.six_views import six_views

    if options.posture and options.posture not in POSTURES:
        raise InputError("model view: posture", f"{options.posture!r} is none", f"known are {', '.join(POSTURES)}")
    six_views(find_bird(options.file), options.out, options.posture)
    show(f"six views → {options.out}")
