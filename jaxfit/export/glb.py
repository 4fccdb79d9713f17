"""Animated birds as glTF: one file, or a file per bird, with the ground.

A bird is a mesh with a skeleton. The scene has y up, and lengths in metres where the length of a model unit is known.
The node `footage_camera` is a camera with the field of view of the images: a picture of this camera shows the birds at
their places in the footage. Birds have the size of the model, because one camera measures neither size nor distance.
Birds in a world have their own size, and the scene of a result on a ledge is the world: its ledge is y = 0.

glTF and the model have the same skinning: a joint has the translation bone · (J_j − J_parent) and the rotation R(θ_j)
relative to its parent, and its inverse bind matrix is the translation −J_j. Size, translation and the length of a model
unit belong to the node above the root joint. Source: Khronos, glTF 2.0 specification, sections 3.6 (buffers and
accessors) and 4 (binary files).
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from jaxfit.data.projection import PosedBirds, upward
from jaxfit.data.tracks import frame_step
from jaxfit.export.result import Exported, describe_tracks, export_folder
from jaxfit.foundation.extras import __version__
from jaxfit.foundation.files import write_whole
from jaxfit.foundation.progress import ProgressTask
from jaxfit.model.bird import Bird
from jaxfit.raster.zbuffer import vertex_normals

FOUR = 4
"""Largest number of joints that move one vertex in glTF."""
_MARGIN = 0.5
"""Margin of the ground around the birds, as a share of their spread and of a body length."""
_FARTHEST = 5.0
"""Birds beyond this multiple of the median distance do not widen the ground: their fits are wrong."""
_CAMERA_TO_GLTF = np.diag([1.0, -1.0, -1.0])
"""Rotation from the camera frame (y down, z forward) to that of glTF (y up, z backward)."""
_WORLD_TO_GLTF = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
"""Rotation from a world with z up to the frame of glTF."""
_COMPONENT = {"f4": 5126, "u1": 5121, "u2": 5123, "u4": 5125}
_ELEMENT = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}
_VERTICES, _INDICES = 34962, 34963
"""Targets of buffer views: vertex attributes, and indices of vertices."""


class GltfBuilder:
    """Collects the objects and the arrays of a glTF file."""

    def __init__(self, asset: dict[str, Any]):
        self.root: dict[str, Any] = {"asset": {"version": "2.0", **asset}, "scene": 0, "scenes": [{"nodes": []}]}
        self._binary = bytearray()
        self._stored: dict[tuple, int] = {}

    def add(self, kind: str, value: dict[str, Any]) -> int:
        """Append an object to one of the lists of the file (`nodes`, `meshes`, …) and return its index."""
        entries = self.root.setdefault(kind, [])
        entries.append(value)
        return len(entries) - 1

    def add_array(self, values: np.ndarray, target: int | None = None, bounds: bool = False) -> int:
        """Store an array as an accessor and return its index; an equal array is stored once.

        Args:
            values: (count, …) float32, uint8, uint16 or uint32; the size of an element of vertex attributes is a
                multiple of 4 bytes. Matrices are transposed to the order of glTF, column by column.
            target: `_VERTICES`, `_INDICES`, or None.
            bounds: store the smallest and the largest values, which positions and times require.
        """
        values = np.ascontiguousarray(values, np.dtype(values.dtype).newbyteorder("<"))
        content = (values.transpose(0, 2, 1) if values.ndim == 3 else values).tobytes()
        key = content, values.dtype.str, values.shape, target
        if key not in self._stored:
            view = {"buffer": 0, "byteOffset": len(self._binary), "byteLength": len(content)}
            self._binary += content + bytes(-len(content) % 4)
            accessor = {
                "bufferView": self.add("bufferViews", view | ({} if target is None else {"target": target})),
                "componentType": _COMPONENT[values.dtype.str[1:]],
                "count": len(values),
                "type": _ELEMENT[values.shape[1:]],
            }
            if bounds:
                flat = values.reshape(len(values), -1)
                accessor |= {"min": flat.min(0).tolist(), "max": flat.max(0).tolist()}
            self._stored[key] = self.add("accessors", accessor)
        return self._stored[key]

    def content(self) -> bytes:
        """Return the bytes of the `.glb`."""
        root = self.root | {"buffers": [{"byteLength": len(self._binary)}]}
        text = json.dumps(root, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        chunks = [(b"JSON", text), (b"BIN\0", bytes(self._binary))]
        body = b"".join(struct.pack("<I4s", len(data), kind) + data for kind, data in chunks)
        return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


class Motion(NamedTuple):
    """The motion of one bird in its M fitted frames. Frames of the camera: x right, y down, z forward."""

    at: Int[np.ndarray, "M"]
    """Positions of the fitted frames."""
    rotations: Float[np.ndarray, "M J 4"]
    """Rotation of every joint relative to its parent: unit quaternions x, y, z, w of continuous sign."""
    translations: Float[np.ndarray, "M J 3"]
    """Translation of every joint relative to its parent, model units."""
    place: Float[np.ndarray, "M 3"]
    """Translation of the bird in the camera frame of the image, in the unit of the export."""
    facing: Float[np.ndarray, "M 4"]
    """Rotation from the camera frame of the crop to the camera frame of the image: unit quaternions x, y, z, w."""
    size: Float[np.ndarray, "M"]
    """Length of a model unit, in the unit of the export. It changes where the bird has another size in each frame."""
    betas: Float[np.ndarray, "M S"]
    """Shape coefficients."""

    @property
    def morphs(self) -> bool:
        """Whether the shape changes over time."""
        return bool(np.ptp(self.betas, axis=0).any())


def bird_motion(exported: Exported, n: int) -> Motion:
    """Return the motion of one bird in the camera frame of the image.

    Args:
        exported: the result.
        n: position of the track, with at least one pose.
    """
    s, bird = exported.solution, exported.bird
    at = np.flatnonzero(s.valid[n])
    angles = np.concatenate([s.poses.global_orient[n, at][:, None], s.poses.body_pose[n, at]], axis=1).astype(
        np.float64
    )
    rotations = Rotation.from_rotvec(angles.reshape(-1, 3)).as_quat().reshape(*angles.shape[:2], 4)
    joints = np.asarray(bird.joints, np.float64)
    offsets = joints - np.where(np.arange(len(joints))[:, None] > 0, joints[np.maximum(bird.parents, 0)], 0)
    bones = np.concatenate([np.ones((len(at), 1)), s.poses.bone_length[n, at]], axis=1)
    turn = Rotation.from_matrix(exported.in_image.turn[n, at])
    size = exported.in_image.size[n, at]
    place = exported.in_image.root[n, at] - turn.apply(size[:, None] * joints[0])  # the turn is about the root joint
    return Motion(
        at=at,
        rotations=_continuous(rotations),
        translations=bones[..., None] * offsets,
        place=place * exported.length,
        facing=_continuous(turn.as_quat()),
        size=size * exported.length,
        betas=np.asarray(s.poses.betas, np.float64)[n, at],
    )


def _continuous(quaternions: Float[np.ndarray, "M *B 4"]) -> Float[np.ndarray, "M *B 4"]:
    """Return the same rotations with signs such that consecutive quaternions have a positive product."""
    products = np.sum(quaternions[1:] * quaternions[:-1], axis=-1, keepdims=True)
    signs = np.cumprod(np.where(products < 0, -1.0, 1.0), axis=0)
    return np.concatenate([quaternions[:1], quaternions[1:] * signs])


def four_weights(bird: Bird) -> tuple[Int[np.ndarray, "V 4"], Float[np.ndarray, "V 4"]]:
    """Return the four joints with the largest weights of every vertex, and their weights, scaled to a sum of 1."""
    weights = np.asarray(bird.skin_weights, np.float64)
    weights = np.pad(weights, ((0, 0), (0, max(FOUR - bird.num_joints, 0))))
    joints = np.argsort(-weights, axis=1, kind="stable")[:, :FOUR]
    kept = np.take_along_axis(weights, joints, axis=1)
    kept /= kept.sum(axis=1, keepdims=True)
    return np.where(kept > 0, joints, 0), kept


def weight_error(exported: Exported) -> float:
    """Return the largest error of a vertex if it has at most four weights, as a share of the body length.

    The error is taken over ten fitted frames of every bird; 0 where no vertex has more than four weights.
    """
    bird, s = exported.bird, exported.solution
    weights = np.asarray(bird.skin_weights)
    if (weights > 0).sum(axis=1).max() <= FOUR:
        return 0.0
    joints, kept = four_weights(bird)
    fewer = np.zeros(weights.shape, np.float32)
    np.add.at(fewer, (np.arange(len(fewer))[:, None], joints), kept.astype(np.float32))
    posed = PosedBirds(s, bird), PosedBirds(s, replace(bird, skin_weights=jnp.asarray(fewer)))
    worst = 0.0
    for n in range(len(s.track_id)):
        at = np.flatnonzero(s.valid[n])
        for t in at[np.linspace(0, len(at) - 1, min(len(at), 10)).astype(int)]:
            full, short = (birds.vertices_cam_window(n, slice(t, t + 1))[0] for birds in posed)
            worst = max(worst, float(np.linalg.norm(full - short, axis=1).max() / s.poses.scale[n, t]))
    return worst / _body_length(bird)


def _body_length(bird: Bird) -> float:
    """Return the longest side of the box of the mesh in its rest pose, model units."""
    return float(np.ptp(np.asarray(bird.vertices), axis=0).max())


def _add_bird(builder: GltfBuilder, exported: Exported, n: int, motion: Motion) -> tuple[int, list[int], int]:
    """Add the skeleton of one bird in the pose of its first fitted frame, its skin and its mesh.

    Returns:
        The nodes of the bird, of its joints, and of its mesh.
    """
    bird, track = exported.bird, int(exported.solution.track_id[n])
    name = f"bird_{track}"
    first = len(builder.root["nodes"])
    joints = list(range(first, first + bird.num_joints))
    for j, joint in enumerate(bird.joint_names):
        node: dict[str, Any] = {
            "name": f"{name}_{joint}",
            "translation": _floats(motion.translations[0, j]),
            "rotation": _floats(motion.rotations[0, j]),
        }
        children = [joints[k] for k, above in enumerate(bird.parents) if above == j and k > 0]
        builder.add("nodes", node | ({"children": children} if children else {}))
    whole = builder.add("nodes", {"name": name, "children": [first], "extras": describe_tracks(exported)[str(track)]})
    inverse_bind = np.tile(np.eye(4, dtype=np.float32), (len(joints), 1, 1))
    inverse_bind[:, :3, 3] = -np.asarray(bird.joints)
    matrices = builder.add_array(inverse_bind)
    skin = builder.add("skins", {"joints": joints, "skeleton": whole, "inverseBindMatrices": matrices})
    mesh = _add_mesh(builder, bird, motion, name)
    mesh_node = builder.add("nodes", {"name": f"{name}_mesh", "mesh": mesh, "skin": skin})
    builder.root["scenes"][0]["nodes"].append(mesh_node)  # viewers ignore the place of a skinned mesh
    return whole, joints, mesh_node


def _add_mesh(builder: GltfBuilder, bird: Bird, motion: Motion, name: str) -> int:
    """Add the mesh. Shape coefficients that are constant change the mesh, others become morph targets."""
    vertices = np.asarray(bird.vertices, np.float64)
    basis = np.asarray(bird.shape_basis, np.float64)
    if not motion.morphs:
        vertices = vertices + np.tensordot(motion.betas[0], basis, axes=1)
    faces = np.asarray(bird.faces)
    normals = vertex_normals(vertices, faces)
    normals[~normals.any(axis=-1)] = [0, 0, 1]  # a vertex without faces needs a normal, too
    joints, weights = four_weights(bird)
    weights = weights.astype(np.float32)
    weights[:, 0] = 1 - weights[:, 1:].sum(axis=1, dtype=np.float32)  # the sum is 1 after rounding, too
    colours = np.asarray(bird.vertex_colours, np.float64)
    linear = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
    attributes = {
        "POSITION": builder.add_array(vertices.astype(np.float32), _VERTICES, bounds=True),
        "NORMAL": builder.add_array(normals, _VERTICES),
        "COLOR_0": builder.add_array(linear.astype(np.float32), _VERTICES),
        "JOINTS_0": builder.add_array(joints.astype(np.uint8), _VERTICES),
        "WEIGHTS_0": builder.add_array(weights, _VERTICES),
    }
    materials = [material["name"] for material in builder.root.get("materials", [])]
    if "plumage" not in materials:
        surface = {"metallicFactor": 0.0, "roughnessFactor": 0.9}
        materials.append("plumage")
        builder.add("materials", {"name": "plumage", "pbrMetallicRoughness": surface, "doubleSided": True})
    primitive: dict[str, Any] = {"attributes": attributes, "material": materials.index("plumage")}
    kind = np.uint16 if len(vertices) < 65535 else np.uint32
    primitive["indices"] = builder.add_array(faces.reshape(-1).astype(kind), _INDICES)
    mesh: dict[str, Any] = {"name": name, "primitives": [primitive]}
    if motion.morphs:
        targets = [builder.add_array(direction.astype(np.float32), _VERTICES, bounds=True) for direction in basis]
        primitive["targets"] = [{"POSITION": target} for target in targets]
        mesh["weights"] = _floats(motion.betas[0])
    return builder.add("meshes", mesh)


def _animate_bird(
    builder: GltfBuilder, exported: Exported, motion: Motion, whole: int, joints: Sequence[int], mesh: int
) -> None:
    """Add the motion of a bird to the animation. A bird without a pose in a frame has size 0, which hides the bird.

    The times are those of all frame numbers from the first to the last frame, from 0 on; frame numbers that the result
    lacks are included.
    """
    numbers = exported.solution.frame_index
    line = np.arange(numbers[0], numbers[-1] + 1, frame_step(numbers))
    times_s = np.interp(line, numbers, exported.times_s)
    times_s = (times_s - times_s[0]).astype(np.float32)
    at = np.searchsorted(line, numbers)[motion.at]
    fitted = builder.add_array(times_s[at], bounds=True)
    animation = builder.root["animations"][0]

    def animate(node: int, path: str, values: np.ndarray, times: int = fitted, step: bool = False) -> None:
        sampler: dict[str, Any] = {"input": times, "output": builder.add_array(values.astype(np.float32))}
        sampler["interpolation"] = "STEP" if step else "LINEAR"
        animation["samplers"].append(sampler)
        channel = {"sampler": len(animation["samplers"]) - 1, "target": {"node": node, "path": path}}
        animation["channels"].append(channel)

    node = builder.root["nodes"][whole]
    node |= {"translation": _floats(motion.place[0]), "rotation": _floats(motion.facing[0])}
    animate(whole, "translation", motion.place)
    animate(whole, "rotation", motion.facing)
    size = np.zeros(len(line))
    size[at] = motion.size
    node["scale"] = _floats(np.repeat(size[0], 3))
    if np.ptp(size) > 0:
        every = builder.add_array(times_s, bounds=True)
        animate(whole, "scale", np.repeat(size[:, None], 3, axis=1), every, step=True)
    for j, joint in enumerate(joints):
        if np.ptp(motion.rotations[:, j], axis=0).any():
            animate(joint, "rotation", motion.rotations[:, j])
        if np.ptp(motion.translations[:, j], axis=0).any():
            animate(joint, "translation", motion.translations[:, j])
    if motion.morphs:
        animate(mesh, "weights", motion.betas.reshape(-1))


class Ground(NamedTuple):
    """Rotation and translation from the camera frame of the image to a frame with the ground at y = 0, y up."""

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    low: Float[np.ndarray, "2"]
    """Smallest x and z of the ground."""
    high: Float[np.ndarray, "2"]


def ground_of(exported: Exported, motions: dict[int, Motion]) -> Ground:
    """Return the ground: the ledge of the result, the plane z = 0 of its world, or an estimate from the birds.

    Every pose on a ledge is known in the frame of the camera and in the world, so the first pose gives the camera in
    the world. The estimate has the upward direction of `upward`, and the median over the birds of the median height of
    their lower foot; it is rough, because the depth of a bird is not measured.

    Args:
        exported: the result.
        motions: position of a track → its motion.
    """
    s = exported.solution
    named = [k for k, name in enumerate(s.keypoint_names) if "foot" in name] or list(range(len(s.keypoint_names)))
    points = exported.in_image.points(s.keypoints.cam[:, :, named], np.asarray(s.poses.scale)) * exported.length
    feet = [points[n, motion.at] for n, motion in motions.items()]
    if s.contact is not None and s.world is not None:
        n, t = np.argwhere(s.valid)[0].tolist()
        R_cam_root = Rotation.from_rotvec(exported.in_image.orientation[n, t]).as_matrix()
        R_world_cam = s.world.R_world_root[n, t] @ R_cam_root.T
        position_m = s.world.transl_world_m[n, t] - R_world_cam @ exported.in_image.root[n, t] * exported.length
        rotation, translation = _WORLD_TO_GLTF @ R_world_cam, _WORLD_TO_GLTF @ position_m
    else:
        bodies = []
        for n, motion in motions.items():
            turn = Rotation.from_quat(motion.facing)
            bodies.append(
                (turn * Rotation.from_rotvec(s.poses.global_orient[n, motion.at].astype(np.float64))).as_matrix()
            )
        up = upward(np.concatenate(bodies))
        forward = np.array([0, 0, 1.0]) if abs(up[2]) < 0.99 else np.array([0, -1.0, 0])
        backward = -(forward - (forward @ up) * up)
        backward /= np.linalg.norm(backward)
        rotation = np.stack([np.cross(up, backward), up, backward])
        height = float(np.median([np.median((places @ rotation[1]).min(axis=1)) for places in feet]))
        translation = np.array([0, -height, 0])
    all_feet = np.concatenate([places.reshape(-1, 3) for places in feet])
    distance = np.linalg.norm(all_feet, axis=1)
    near = all_feet[distance <= _FARTHEST * np.median(distance)]
    flat = (near @ rotation.T + translation)[:, [0, 2]]
    low, high = flat.min(0), flat.max(0)
    margin = _MARGIN * (_body_length(exported.bird) * exported.length + float((high - low).max()))
    return Ground(rotation, translation, low - margin, high + margin)


def _add_ground(builder: GltfBuilder, ground: Ground) -> None:
    """Add a level rectangle at y = 0."""
    (x0, z0), (x1, z1) = ground.low, ground.high
    corners = np.array([[x0, 0, z0], [x0, 0, z1], [x1, 0, z1], [x1, 0, z0]], np.float32)
    surface = {"baseColorFactor": [0.35, 0.33, 0.3, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0}
    material = {"name": "ground", "pbrMetallicRoughness": surface, "doubleSided": True}
    primitive = {
        "attributes": {
            "POSITION": builder.add_array(corners, _VERTICES, bounds=True),
            "NORMAL": builder.add_array(np.tile(np.array([[0, 1, 0]], np.float32), (4, 1)), _VERTICES),
        },
        "indices": builder.add_array(np.array([0, 1, 2, 0, 2, 3], np.uint16), _INDICES),
        "material": builder.add("materials", material),
    }
    mesh = builder.add("meshes", {"name": "ground", "primitives": [primitive]})
    builder.root["scenes"][0]["nodes"].append(builder.add("nodes", {"name": "ground", "mesh": mesh}))


def write_glb(
    exported: Exported,
    out: Path,
    progress: ProgressTask,
    ground: bool = False,
    overwrite: bool = False,
) -> tuple[list[Path], list[str]]:
    """Write one `.glb` for every bird with a pose, or one for all birds.

    Args:
        exported: the result.
        out: a folder for a file of every bird, or a file for all birds whose name ends with `.glb`.
        progress: shows progress.
        ground: add a rectangle below the feet, and turn the scene so that the rectangle is level. A result on a ledge
            is always in its world, and the rectangle is the ledge.
        overwrite: replace an earlier export in the folder.

    Returns:
        The files, and notes on the precision.

    Raises:
        InputError: no pose is chosen, or the frame rate is unknown.
    """
    exported.require_poses()
    exported.require_fps()
    s = exported.solution
    fitted = np.flatnonzero(s.valid.any(axis=1)).tolist()
    with progress("Writing glTF", len(fitted)) as report_progress:
        motions: dict[int, Motion] = {}
        for n in fitted:
            motions[n] = bird_motion(exported, n)
            report_progress(0.5, f"track {s.track_id[n]}")
        level = ground_of(exported, motions) if ground or s.contact is not None else None
        error = weight_error(exported)
        facts = {"largest_error_of_four_weights": error, "focal_length_px": exported.focal_px}
        if out.suffix == ".glb":
            about = facts | {"tracks": describe_tracks(exported)}
            write_whole(out, _content(exported, motions, level, ground, about))
            files = [out]
        else:
            tracks = {n: int(s.track_id[n]) for n in fitted}
            names = {track: f"bird_{track}.glb" for track in tracks.values()}
            with export_folder(exported, out, overwrite, names, facts) as folder:
                for n, track in tracks.items():
                    about = facts | ({"tracks": describe_tracks(exported)} if len(fitted) == 1 else {})
                    write_whole(folder / names[track], _content(exported, {n: motions[n]}, level, ground, about))
                    report_progress(0.5, names[track])
            files = [out / name for name in names.values()]
    moved = f"glTF has four joints for a vertex at most: vertices move by up to {error:.2%} of the body length"
    return files, [moved] if error else []


def _content(
    exported: Exported, motions: dict[int, Motion], level: Ground | None, ground: bool, facts: dict[str, Any]
) -> bytes:
    """Return a `.glb` with some birds, in a scene whose ground is level where `level` is given."""
    s = exported.solution
    times = {"fps": exported.fps, "first_frame": int(s.frame_index[0]), "first_time_s": float(exported.times_s[0])}
    extras = {"unit_of_lengths": exported.unit, "model": exported.bird.name, **times, **facts}
    builder = GltfBuilder({"generator": f"jaxfit {__version__}", "extras": extras})
    rotation = _CAMERA_TO_GLTF if level is None else level.rotation
    frame: dict[str, Any] = {"name": "camera_frame", "rotation": _quaternion(rotation)}
    builder.root["scenes"][0]["nodes"].append(builder.add("nodes", frame))
    if level is not None:
        frame["translation"] = level.translation.tolist()
        if ground:
            _add_ground(builder, level)
    width, height = np.median(s.crops.image_size_px[s.valid], axis=0).tolist()
    view = {"yfov": 2 * float(np.arctan(height / 2 / exported.focal_px)), "aspectRatio": width / height, "znear": 0.01}
    camera = builder.add("cameras", {"type": "perspective", "perspective": view})
    looking = {"name": "footage_camera", "camera": camera, "rotation": _quaternion(_CAMERA_TO_GLTF)}
    frame["children"] = [builder.add("nodes", looking)]
    builder.add("animations", {"name": "motion", "channels": [], "samplers": []})
    for n, motion in motions.items():
        whole, joints, mesh = _add_bird(builder, exported, n, motion)
        frame["children"].append(whole)
        _animate_bird(builder, exported, motion, whole, joints, mesh)
    return builder.content()


def _quaternion(rotation: np.ndarray) -> list[float]:
    return _floats(Rotation.from_matrix(rotation).as_quat())


def _floats(values: Any) -> list[float]:
    return [float(value) for value in np.asarray(values, np.float32)]
