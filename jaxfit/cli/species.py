"""`adapt`, `model compare`, `model rig`, `model keypoints`."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

import numpy as np

from jaxfit.cli.tables import right_aligned, show
from jaxfit.foundation.errors import InputError, counted
from jaxfit.foundation.files import check_writable
from jaxfit.foundation.progress import terminal
from jaxfit.foundation.reading import json_text
from jaxfit.model.bird import MAX_FACES, MAX_VERTICES, Bird
from jaxfit.model.files import find_bird, load_bird, save_bird

if TYPE_CHECKING:
    from jaxfit.learning.species.photo_fit import BoneWidths

FEW_INDIVIDUALS = 5
"""A warning says that fewer individuals than these do not represent a species."""
_AXES = {"X": (1, 0, 0), "Y": (0, 1, 0), "Z": (0, 0, 1)}


def adapt_scan(options: argparse.Namespace) -> None:
    """Fit a model to a 3D scan, write the adapted model and a picture of the errors."""
    from jaxfit.learning.species.scan_files import read_scan, read_scan_keypoints
    from jaxfit.learning.species.scan_fit import UNITS_MM, ScanSettings, draw_scan, fit_scan, measure_scan
    from jaxfit.learning.species.species import mean_keypoints, provenance_notes
    from jaxfit.learning.species.surface import is_mirrored

    check_writable(options.out)  # before the long work
    bird = find_bird(options.model)
    scan = read_scan(options.scan)
    for remark in scan.remarks:
        show(remark)
    keypoints, unknown = read_scan_keypoints(options.keypoints, bird.keypoint_names, scan.numbered_vertices)
    if unknown:
        show(f"not used, because the model has no such keypoints: {', '.join(unknown)}")
    index = [bird.keypoint_names.index(name) for name in keypoints]
    annotated = np.stack(list(keypoints.values()))
    if is_mirrored(mean_keypoints(bird)[index], annotated):
        remedy = "mirror the scan, or exchange the names of the left and the right keypoints"
        raise InputError(options.keypoints, "left and right are exchanged: the scan is a mirror image", remedy)
    _check_near(scan, keypoints, options)
    up = None
    if options.up:
        up = np.array(_AXES[options.up[-1]], float) * (-1 if options.up.startswith("-") else 1)
    settings = ScanSettings(modes=40 if options.offset else 0)
    name = options.out.stem
    fit = fit_scan(bird, scan.vertices, scan.faces, keypoints, settings, name, up, terminal)
    errors = measure_scan(fit, scan.vertices, scan.faces, keypoints, UNITS_MM[options.unit])
    picture = options.out.with_suffix(".png")
    draw_scan(picture, fit, scan.vertices, scan.faces, errors)
    facts = {"source": "scan", "scan": options.scan.name, "keypoints": len(keypoints), "offset": bool(options.offset)}
    facts |= {"unit": options.unit, "mm_per_model_unit": fit.size * UNITS_MM[options.unit]}
    facts |= {"free": "pose, size, bone lengths, shape" + (", vertex offset" if options.offset else "")}
    facts |= {f"error_{key}": round(value, 5) for key, value in errors.summary.items()}
    save_bird(fit.bird, options.out, provenance_notes(bird, facts) | fit.pose_notes())
    _show_bones(bird, fit.bird)
    summary = errors.summary
    show(
        f"length of the bird from bill to tail, in its rest pose: {errors.length:.4g} {options.unit}; its size is free"
    )
    if errors.implausible_size:
        show(f"warning: {errors.implausible_size}")
    if up is not None and (tilt := fit.tilt_deg(up)) > 100:
        show(f"warning: the back of the bird points {tilt:.0f}° away from --up")
    show(f"distance of the scan from the model: median {errors.shown(summary['median'])}, ")
    show(f"  95 % below {errors.shown(summary['p95'])}; keypoints, median {errors.shown(summary['keypoints'])}")
    show(f"the scan covers {100 * errors.covered:.0f} % of the model's visible surface")
    for problem in errors.problems:
        show(f"warning: the model does not fit this scan: {problem}")
    show(f"{name} → {options.out}, picture → {picture}")


def adapt_photos(options: argparse.Namespace) -> None:
    """Fit the means of a species to photographs, and write the adapted model."""
    from jaxfit.cli.observations import observations_for
    from jaxfit.learning.species.photo_fit import FREE, fit_photographs
    from jaxfit.learning.species.photographs import read_photographs
    from jaxfit.learning.species.species import provenance_notes

    fixed = tuple(part for part in options.fix.split(",") if part)
    unknown = [part for part in fixed if part not in FREE]
    if unknown:
        raise InputError("--fix", f"{unknown[0]!r} is not a part of a species", f"known: {', '.join(FREE)}")
    if set(fixed) == set(FREE):
        raise InputError("--fix", "all parts are fixed, so that nothing is left to fit", "fix fewer parts")
    if options.frames_per_track < 1:
        raise InputError("--frames-per-track", f"is {options.frames_per_track}", "give a number from 1")
    check_writable(options.out)  # before the long work
    bird = find_bird(options.model)
    sources = [
        (path.name, observations_for(path, bird.keypoint_names, options, untracked="photographs")[0])
        for path in options.birds
    ]
    photographs = read_photographs(sources, bird, terminal, options.frames_per_track)
    for remark in photographs.remarks:
        show(remark)
    count = len(photographs.names)
    without = int((~photographs.has_mask).sum())
    if without:
        show(f"{without} of {counted(count, 'image')} have no mask; their keypoints are used")
    name = options.out.stem
    fit = fit_photographs(photographs, bird, fixed=fixed, name=name, progress=terminal)
    facts = {
        "source": "photographs",
        "images": count,
        "individuals": fit.individuals,
        "images_with_mask": count - without,
    }
    facts |= {"free": ", ".join(part for part in FREE if part not in fixed)}
    facts |= {f"setting_{key}": value for key, value in fit.settings._asdict().items()}
    facts |= {"images_that_disagree": len(fit.disagreeing), "frames_per_track": options.frames_per_track}
    undetermined = _undetermined_bones(bird, fit.widths)
    if fit.widths is not None:
        facts |= {"bones_not_determined": ", ".join(undetermined) or "none"}
    save_bird(fit.bird, options.out, provenance_notes(bird, facts))
    _show_bones(bird, fit.bird, fit.widths)
    if undetermined:
        text = f"warning: the images do not determine the length of {', '.join(undetermined)}: they say less than the "
        show(text + "prior of the model; add images with masks and from other sides, or use --fix bones")
    for i in fit.disagreeing:
        show(f"disagrees with the other images, weight {fit.weight[i]:.2f}: {photographs.names[i]}")
    if fit.individuals < FEW_INDIVIDUALS:
        show(f"warning: {counted(fit.individuals, 'individual')}: too few to determine a species")
    show(f"{counted(count, 'image')} of {counted(fit.individuals, 'individual')} → {options.out}")


def _undetermined_bones(bird: Bird, widths: BoneWidths | None) -> list[str]:
    """Return the bones about which the photographs say less than the prior; a left and a right bone have one name."""
    bones = [] if widths is None else widths.undetermined
    names = (bird.joint_names[bone + 1] for bone in bones)
    return list(dict.fromkeys(name.removeprefix("left_").removeprefix("right_") for name in names))


def _show_bones(base: Bird, adapted: Bird, widths: BoneWidths | None = None) -> None:
    """Print the change of the mean bone lengths, in per cent of the bones of the base, and the widths if known."""
    from jaxfit.learning.species.species import absolute_bones

    before, after = absolute_bones(base), absolute_bones(adapted)
    columns = ("± %", "prior ± %") if widths is not None else ()
    table = right_aligned("base", "adapted", "change %", *columns, title="mean bone lengths, model units")
    table.add_column("bone")
    if widths is not None:
        table.caption = "±: standard deviation of the mean length with the images, and in the prior of the model"
    mean = np.maximum(np.asarray(base.bone_mean), 1e-9)
    for bone in np.argsort(-np.abs(after / np.maximum(before, 1e-9) - 1)):
        change = 100 * (after[bone] / max(before[bone], 1e-9) - 1)
        both = () if widths is None else (widths.posterior, widths.prior)
        cells = (f"{100 * each[bone] / mean[bone]:.1f}" for each in both)
        row = f"{before[bone]:.2f}", f"{after[bone]:.2f}", f"{change:+.1f}"
        table.add_row(*row, *cells, base.joint_names[bone + 1])
    show(table)


def _check_near(scan, keypoints, options: argparse.Namespace) -> None:
    """Report keypoints off the surface; raise InputError if most keypoints are far from the scan."""
    from jaxfit.learning.species.scan_fit import keypoints_off_surface

    length = float(np.ptp(scan.vertices, axis=0).max())
    off = keypoints_off_surface(scan.vertices, scan.faces, keypoints, length)
    far = [name for name, distance in off.items() if distance > 0.3]
    if len(far) > len(keypoints) / 2:
        problem = f"{len(far)} of {len(keypoints)} keypoints are far from the surface of the scan"
        raise InputError(options.keypoints, problem, "give keypoints in the coordinates and the unit of the scan")
    if off:
        listed = ", ".join(f"{name} ({100 * distance:.0f} %)" for name, distance in off.items())
        show(f"warning: keypoints off the surface, in per cent of the scan's size: {listed}; wrong, or at holes")


def model_compare(options: argparse.Namespace) -> None:
    """Print the differences between two models, and draw them."""
    from jaxfit.learning.species.models import compare_birds, draw_comparison

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
    from jaxfit.learning.species.models import read_placement, rest_placement, rig_mesh
    from jaxfit.learning.species.scan_files import read_scan
    from jaxfit.learning.species.species import body_length

    check_writable(options.out)
    bird, mesh = load_bird(options.like), read_scan(options.mesh)
    for remark in mesh.remarks:
        show(remark)
    if len(mesh.vertices) > MAX_VERTICES or len(mesh.faces) > MAX_FACES:
        problem = f"has {len(mesh.vertices):,} vertices and {len(mesh.faces):,} faces"
        remedy = f"a model has at most {MAX_VERTICES:,} and {MAX_FACES:,}: decimate the mesh"
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
    from jaxfit.learning.species.models import write_keypoint_page

    check_writable(options.out)
    write_keypoint_page(find_bird(options.file), options.out)
    show(f"keypoints → {options.out}")
