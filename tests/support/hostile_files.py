"""Hostile files for the command line: bombs, loops, wrong kinds of files, and numbers that no machine can serve.

Every function writes its files into a folder and returns the path that the user would name.
"""

from __future__ import annotations

import io
import json
import os
import zipfile
from pathlib import Path

import numpy as np

from support.coco_files import annotation

LONG = "n" * 300


def observations(folder: Path, images: list, annotations: list, names: int = 3) -> Path:
    """Write a COCO file with the keypoint names of `support.coco_files`."""
    category = {"id": 1, "name": "bird", "keypoints": ["bill", "nape", "tail"][:names]}
    path = folder / "observations.json"
    path.write_text(json.dumps({"images": images, "categories": [category], "annotations": annotations}))
    return path


def image(i: int, side: int = 30) -> dict:
    return {"id": i, "width": side, "height": side, "file_name": f"{i}.png", "frame_index": i}


def sparse_tracks(folder: Path, tracks: int = 3600) -> Path:
    """Tracks of one box each, every one in a frame of its own."""
    found = [annotation(i, i, i, segmentation=None) for i in range(tracks)]
    return observations(folder, [image(i) for i in range(tracks)], found)


def zigzag_polygon(folder: Path, points: int = 8000, side: int = 16384) -> Path:
    corners = [float(value) for i in range(points) for value in (i % 2 * side, i % 7)]
    return observations(folder, [image(0, side)], [annotation(1, 0, 1, segmentation=[corners])])


def deep_json(folder: Path, depth: int = 100_000) -> Path:
    path = folder / "deep.json"
    path.write_text("[" * depth + "]" * depth)
    return path


def many_digits(folder: Path) -> Path:
    path = folder / "digits.json"
    path.write_text('{"images": [], "categories": ' + "1" * 5000 + ', "annotations": []}')
    return path


def npz_bomb(folder: Path, megabytes: int = 1500) -> Path:
    """An .npz with one surplus array of zeros, compressed a thousandfold."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": (megabytes * 125_000,)}
    )
    path = folder / "bomb.npz"
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("surplus.npy", "w", force_zip64=True) as member,
    ):
        member.write(header.getvalue())
        for _ in range(megabytes):
            member.write(bytes(1_000_000))
    return path


def npz_claim(folder: Path) -> Path:
    """An .npz of a few bytes whose header declares an array of terabytes."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)})
    path = folder / "claim.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("vertices.npy", header.getvalue())
        archive.writestr("track_id.npy", header.getvalue())
    return path


def yaml_file(folder: Path, text: str) -> Path:
    path = folder / "config.yaml"
    path.write_text(text, encoding="utf-8", errors="surrogateescape")
    return path


def anchors(folder: Path, levels: int = 9) -> Path:
    lines = ["a0: &a0 {k: 1}"]
    for i in range(1, levels + 1):
        content = ", ".join(f"k{j}: *a{i - 1}" for j in range(9))
        lines.append(f"a{i}: &a{i} {{{content}}}")
    lines.append(f"terms: *a{levels}")
    return yaml_file(folder, "\n".join(lines))


def merges(folder: Path, levels: int = 24) -> Path:
    keys = ", ".join(f"k{i}: 1" for i in range(200))
    lines = [f"a0: &a0 {{{keys}}}"]
    for i in range(1, levels):
        lines.append(f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 8)}]}}")
    return yaml_file(folder, "\n".join(lines))


def many_bases(folder: Path, count: int = 1500) -> Path:
    for i in range(count):
        (folder / f"b{i}.yaml").write_text(f"base: b{i + 1}.yaml\n")
    (folder / f"b{count}.yaml").write_text("base: paper\n")
    return folder / "b0.yaml"


def circle_through_folder(folder: Path) -> Path:
    (folder / "s").mkdir()
    (folder / "c.yaml").write_text("base: s/../c.yaml\n")
    return folder / "c.yaml"


def wide_grid(folder: Path) -> Path:
    values = ", ".join(map(str, range(1000)))
    keys = ("velocity", "pose_prior", "keypoints", "mask")
    cross = ", ".join(f"terms.{key}: [{values}]" for key in keys)
    return yaml_file(folder, f"crosses: [{{cross: {{{cross}}}}}]\n")


def loop(folder: Path, name: str = "loop") -> Path:
    """A symbolic link to itself."""
    (folder / name).symlink_to(name)
    return folder / name


def pipe(folder: Path, name: str = "pipe") -> Path:
    """A named pipe without a writer: a reader that opens the pipe never returns."""
    os.mkfifo(folder / name)
    return folder / name
