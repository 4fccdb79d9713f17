"""`model`, `networks`, `prior`, `config`."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from jaxfit.cli.tables import right_aligned, show, show_facts
from jaxfit.foundation.errors import InputError, counted
from jaxfit.foundation.reading import json_text
from jaxfit.model.files import find_bird, read_provenance, save_bird


def model_import(options: argparse.Namespace) -> None:
    """Import a published model and write a model file."""
    from jaxfit.model.bird import rest_length
    from jaxfit.model.published import import_model

    length_cm = options.length_cm
    if length_cm is not None and not 0 < length_cm < float("inf"):
        raise InputError("--length-cm", f"is {length_cm}", "give the length from bill tip to tail tip, above 0")
    bird = import_model(options.kind, options.sources)
    if length_cm is not None:
        bird = replace(bird, metres_per_unit=length_cm / 100 / rest_length(bird))
    save_bird(bird, options.out)
    show(f"{bird.name}: {bird.vertices.shape[0]} vertices, {bird.num_keypoints} keypoints → {options.out}")


def model_get(options: argparse.Namespace) -> None:
    """Download a published model."""
    from jaxfit.foundation.progress import terminal
    from jaxfit.foundation.published import get_published
    from jaxfit.model.published import AVES, models_folder

    (path,) = get_published((AVES,), models_folder(), options.source, terminal)
    show(f"{options.name}: {path}; use the model with `--model {options.name}`")


def networks_get(options: argparse.Namespace) -> None:
    """Download published networks."""
    from jaxfit.foundation.progress import terminal
    from jaxfit.perception.general_networks import get_general_files

    files = get_general_files(options.name, options.source, terminal)
    show(f"{options.name}: {', '.join(map(str, files))}; `--segmenter auto` may use these networks from now on")


def model_info(options: argparse.Namespace) -> None:
    """Print a description of a model."""
    from jaxfit.model.bird import describe_bird

    facts, provenance = describe_bird(find_bird(options.file)), read_provenance(options.file)
    if options.json:
        print(json_text(facts | ({"provenance": provenance} if provenance else {})))  # noqa: T201
        return
    show_facts(facts)
    if provenance:
        show("how the model was made:")
        show_facts(provenance)


def model_view(options: argparse.Namespace) -> None:
    """Draw a model from six sides."""
    from jaxfit.foundation.files import check_writable
    from jaxfit.model.murre import POSTURES
    from jaxfit.view.mesh_views import six_views

    if options.posture and options.posture not in POSTURES:
        raise InputError("--posture", f"{options.posture!r} is not a known posture", f"known: {', '.join(POSTURES)}")
    check_writable(options.out)  # before the rendering, which takes seconds
    six_views(find_bird(options.file), options.out, options.posture)
    show(f"six views → {options.out}")


def prior_learn(options: argparse.Namespace) -> None:
    """Learn a pose prior from results, write a model with this prior and print how the prior changed."""
    import numpy as np

    from jaxfit.data.solution import load_solution
    from jaxfit.foundation.files import check_writable
    from jaxfit.learning.priors import learn_prior

    check_writable(options.out)  # before the long work
    learnt = learn_prior([(folder, *load_solution(folder)) for folder in options.results])
    counts = {"poses": learnt.poses, "birds": learnt.birds, "effective_poses": learnt.effective_poses}
    notes = {f"prior_{name}": value for name, value in counts.items()} | {"prior_shrinkage": learnt.shrinkage}
    save_bird(learnt.bird, options.out, notes)
    title = "change of each joint's mean from the model's prior, and standard deviation (mean of three axes)"
    table = right_aligned("change °", "std. dev. °", title=title)
    table.add_column("joint")
    deviation_rad = np.sqrt(np.diag(learnt.bird.pose_covariance).reshape(-1, 3).mean(axis=1))
    for joint in np.argsort(-learnt.mean_change_rad):
        degrees = np.rad2deg([learnt.mean_change_rad[joint], deviation_rad[joint]])
        table.add_row(*(f"{value:.1f}" for value in degrees), learnt.bird.joint_names[joint + 1])
    show(table)
    skipped = f" ({counted(learnt.diverged, 'diverged track')} skipped)" if learnt.diverged else ""
    poses, tracks = counted(learnt.poses, "pose"), counted(learnt.birds, "track")
    show(f"{poses} of {tracks}{skipped}, equivalent to {learnt.effective_poses:.0f} independent poses")
    bones = "learnt" if learnt.bones_learnt else "from the model, because the results have equal bone lengths"
    show(f"correlations shrunk by {100 * learnt.shrinkage:.0f} % (100 %: no correlations); bone lengths: {bones}")
    weight = f"weight of `pose_prior` in `map` for this width: {learnt.pose_prior_weight:.2g}"
    show(f"width of the poses: {learnt.width:.2g} times the covariance of the model's prior; {weight}")
    show(f"{learnt.bird.name} with this prior → {options.out}; use the model with `--model {options.out}`")


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
    """Print a shipped config, or a file of rules of behaviours, with all values and their descriptions as comments."""
    from jaxfit.behaviour.rules import BehaviourConfig
    from jaxfit.config.fit import FitConfig
    from jaxfit.config.reconstruct import ReconstructConfig
    from jaxfit.config.yaml_file import documented_yaml, read_config, read_yaml_file, shipped_configs
    from jaxfit.evaluation.ablation.grid import GridConfig

    kinds = {"reconstruct": ReconstructConfig, "ablation": GridConfig, "behaviour": BehaviourConfig}
    kind = kinds.get(options.name, FitConfig)
    if options.name not in shipped_configs():
        remedy = f"give one of {', '.join(shipped_configs())}, or a file with rules of behaviours"
        if not Path(options.name).is_file():
            raise InputError(options.name, "is not a shipped config", remedy)
        if "behaviours" not in read_yaml_file(options.name).values:
            raise InputError(options.name, "holds no rules of behaviours", remedy)
        kind = BehaviourConfig
    print(documented_yaml(read_config(kind, options.name)), end="")  # noqa: T201
