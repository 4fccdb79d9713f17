"""The arguments of the commands that adapt, compare and rig models."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from jaxfit.cli.arguments import MODEL, add_command, add_observation_options, add_out

__all__ = ["add_adapt_commands", "add_model_commands"]


def add_adapt_commands(commands: Any) -> None:
    """Add `jaxfit adapt scan` and `jaxfit adapt photos`."""
    adapt = commands.add_parser("adapt", help="adapt a bird model to a species")
    actions = adapt.add_subparsers(required=True, metavar="ACTION")
    scan = add_command(actions, "scan", "adapt.adapt_scan", "fit bone lengths and shape of a model to a 3D scan")
    scan.add_argument("scan", type=Path, metavar="SCAN", help="scan as a triangle mesh (.ply, .obj, .stl, .glb)")
    text = "annotated keypoints: JSON of names with vertex numbers or points, or picked points of MeshLab (.pp)"
    scan.add_argument("--keypoints", type=Path, required=True, metavar="K.json", help=text)
    scan.add_argument("--model", default="murre", metavar="BASE", help=f"model to start from: {MODEL} (default murre)")
    add_out(scan, "M.npz", "model file to write, and its picture")
    text = "also move the vertices by a smooth, left-right symmetric offset: for shapes outside the model's shape space"
    scan.add_argument("--offset", action="store_true", help=text)
    text = "axis of the scan that points up (X, Y, Z, -X, …): helps the start, and is checked"
    scan.add_argument(
        "--up", type=str.upper, choices=[s + a for s in ("", "-") for a in "XYZ"], metavar="AXIS", help=text
    )
    text = "unit of the scan, for errors in mm; the size of the model is free (default %(default)s)"
    scan.add_argument("--unit", choices=("mm", "cm", "m"), default="cm", help=text)
    _photos(actions)


def _photos(actions: Any) -> None:
    text = "fit the mean bone lengths and the mean shape of a species to photographs"
    photos = add_command(actions, "photos", "adapt.adapt_photos", text)
    text = "keypoints and masks of photographs or tracks (COCO, or files of other programs)"
    photos.add_argument("birds", type=Path, nargs="+", metavar="BIRDS.json", help=text)
    photos.add_argument("--model", default="murre", metavar="M", help=f"model to start from: {MODEL} (default murre)")
    add_out(photos, "N.npz", "model file to write")
    text = "parts that stay as in the model: bones, shape, offset, or several with commas"
    photos.add_argument("--fix", default="", metavar="PARTS", help=text)
    text = "largest number of images of a track, which shows one individual: images at equal distances (default "
    text += "%(default)s)"
    photos.add_argument("--frames-per-track", type=int, default=10, metavar="N", help=text)
    add_observation_options(photos)


def add_model_commands(actions: Any) -> None:
    """Add `jaxfit model compare`, `rig` and `keypoints`."""
    compare = add_command(actions, "compare", "adapt_models.model_compare", "compare bones and surfaces of two models")
    for name in ("first", "second"):
        compare.add_argument(name, metavar=name[0].upper() + name[1:], help=MODEL)
    text = "picture of both models from six sides, coloured by their distance"
    compare.add_argument("--out", type=Path, metavar="PNG", help=text)
    compare.add_argument("--json", action="store_true", help="print JSON instead of a table")
    text = "transfer joints, skin weights and keypoints of a model to a mesh, so that the mesh can be posed"
    rig = add_command(actions, "rig", "adapt_models.model_rig", text)
    rig.add_argument("mesh", type=Path, metavar="MESH", help="triangle mesh (.ply, .obj, .stl, .glb), such as a scan")
    text = "model that lies on the mesh: a model that `jaxfit adapt scan` wrote for this scan, or a model "
    text += "in whose rest pose the mesh is"
    rig.add_argument("--like", type=Path, required=True, metavar="MODEL", help=text)
    add_out(rig, "M.npz", "model file to write")
    text = "write a page (.html) that shows annotators where each keypoint sits"
    keypoints = add_command(actions, "keypoints", "adapt_models.model_keypoints", text)
    keypoints.add_argument("file", metavar="MODEL", help=MODEL)
    add_out(keypoints, "PAGE.html", "page to write")
