"""Commands that compare models, rig meshes, and show keypoints to annotators."""

from __future__ import annotations

import argparse

import numpy as np

from jaxfit.cli.tables import right_aligned, show
from jaxfit.errors import InputError
from jaxfit.limits import MODEL_FACES, MODEL_VERTICES
from jaxfit.model.files import find_bird, load_bird, save_bird
from jaxfit.storage.files import check_writable
from jaxfit.storage.json_values import json_text

__all__ = ["model_compare", "model_keypoints", "model_rig"]


def model_compare(options: argparse.Namespace) -> None:
    """Print the differences between two models, and draw them."""
    from jaxfit.adapt.compare import compare_birds, draw_comparison

    if options.out:
        check_writable(options.out)
    first, second = find_bird(options.first), find_bird(options.second)
    comparison = compare_birds(first, second)
    distances = {"of_first": comparison.of_first, "of_second": comparison.of_second}
    if options.json:
        facts = {"size": comparison.size, "bones": comparison.bones}
        facts |= {f"mean_distance_{key}": float(value.mean()) for key, value in distances.items()}
        print(json_text(facts))  # noqa: T201
    else:
        table = right_aligned("change %", title=f"bones of {second.name}, relative to {first.name}, at equal size")
        table.add_column("bone")
        for name, ratio in sorted(comparison.bones.items(), key=lambda bone: -abs(np.log(bone[1]))):
            table.add_row(f"{100 * (ratio - 1):+.1f}", name)
        show(table)
        show(f"size of {second.name}: {100 * comparison.size:.1f} % of the size of {first.name}")
        for one, other, distance in ((first, second, distances["of_first"]), (second, first, distances["of_second"])):
            mean, p95 = 100 * distance.mean(), 100 * np.percentile(distance, 95)
            show(f"distance of {one.name} from {other.name}: mean {mean:.2f}, 95 % below {p95:.2f} % of length")
    if options.out:
        draw_comparison(options.out, first, second, comparison)
        if not options.json:
            show(f"picture → {options.out}")


def model_rig(options: argparse.Namespace) -> None:
    """Transfer the rig of a model to a mesh."""
    from jaxfit.adapt.rig import read_placement, rest_placement, rig_mesh
    from jaxfit.adapt.scan_file import read_scan
    from jaxfit.adapt.species import body_length

    check_writable(options.out)
    bird, mesh = load_bird(options.like), read_scan(options.mesh)
    for remark in mesh.remarks:
        show(remark)
    if len(mesh.vertices) > MODEL_VERTICES or len(mesh.faces) > MODEL_FACES:
        problem = f"has {len(mesh.vertices):,} vertices and {len(mesh.faces):,} faces"
        remedy = f"a model has at most {MODEL_VERTICES:,} and {MODEL_FACES:,}: decimate the mesh"
        raise InputError(options.mesh, problem, remedy)
    placement = read_placement(options.like, bird)
    if placement is None:
        show(f"{options.like} holds no pose of a scan: the mesh must be in the frame of the model's rest pose")
        placement = rest_placement(bird)
    rigged, distance = rig_mesh(mesh.vertices, mesh.faces, bird, placement, options.out.stem)
    share = distance / body_length(bird)
    if np.median(share) > 0.05:
        problem = f"its vertices are far from {options.like.name}: median {100 * np.median(share):.0f} % of length"
        raise InputError(options.mesh, problem, "fit the model to the mesh first, by `jaxfit adapt scan`")
    save_bird(rigged, options.out)
    far = int((share > 0.05).sum())
    if far:
        show(f"warning: {far:,} of {len(share):,} vertices are farther than 5 % of the length from the model")
    show(
        f"{rigged.name}: {len(mesh.vertices):,} vertices; median distance from the model {100 * np.median(share):.2f} %"
    )
    show(f"→ {options.out}; draw it by `jaxfit model view {options.out} --out PNG`")


def model_keypoints(options: argparse.Namespace) -> None:
    """Write a page that shows where the keypoints of a model sit."""
    from jaxfit.adapt.keypoint_page import write_keypoint_page

    check_writable(options.out)
    write_keypoint_page(find_bird(options.file), options.out)
    show(f"keypoints → {options.out}")
