"""A bird in glTF: mesh, skin, motion, binary file.

Binary glTF files (`.glb`): arrays as accessors of one buffer, and the chunks of the file. Source: Khronos, glTF 2.0
specification, sections 3.6 (buffers and accessors) and 4 (GLB).

The motion of one bird as glTF needs it: transforms of its joints and its place in the scene, frame by frame. glTF and
the model have the same skinning: a joint has the translation bone · (J_j − J_parent) and the rotation R(θ_j) relative
to its parent, and its inverse bind matrix is the translation −J_j. Size, translation and the length of a model unit
belong to the node above the root joint.
"""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from jaxfit.data.projection import PosedBirds
from jaxfit.data.tracks import frame_step
from jaxfit.export.result import Exported, describe_tracks
from jaxfit.model.bird import Bird
from jaxfit.raster.zbuffer import vertex_normals

_COMPONENT = {"f4": 5126, "u1": 5121, "u2": 5123, "u4": 5125}
_ELEMENT = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}
VERTICES, INDICES = 34962, 34963
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

    def add_array(self, values: np.ndarray, target: int | None = None, bounds: bool = False, normalised: bool = False):
        """Store an array as an accessor and return its index; an equal array is stored once.

        Args:
            values: (count, …) float32, uint8, uint16 or uint32; the size of an element of vertex attributes is a
                multiple of 4 bytes. Matrices are transposed to the order of glTF, column by column.
            target: `VERTICES`, `INDICES`, or None.
            bounds: store the smallest and the largest values, which positions and times require.
            normalised: integers stand for values in [0, 1].
        """
        values = np.ascontiguousarray(values, np.dtype(values.dtype).newbyteorder("<"))
        stored = np.ascontiguousarray(values.transpose(0, 2, 1)) if values.ndim == 3 else values
        content = stored.tobytes()
        key = content, values.dtype.str, values.shape, target, normalised
        if key in self._stored:
            return self._stored[key]
        self._binary += bytes(-len(self._binary) % 4)
        view = {"buffer": 0, "byteOffset": len(self._binary), "byteLength": len(content)}
        self._binary += content
        accessor = {
            "bufferView": self.add("bufferViews", view | ({} if target is None else {"target": target})),
            "componentType": _COMPONENT[values.dtype.str[1:]],
            "count": len(values),
            "type": _ELEMENT[values.shape[1:]],
        }
        if bounds:
            flat = values.reshape(len(values), -1)
            accessor |= {"min": flat.min(0).tolist(), "max": flat.max(0).tolist()}
        if normalised:
            accessor["normalized"] = True
        self._stored[key] = self.add("accessors", accessor)
        return self._stored[key]

    def content(self) -> bytes:
        """Return the bytes of the `.glb`."""
        self._binary += bytes(-len(self._binary) % 4)
        root = self.root | {"buffers": [{"byteLength": len(self._binary)}]}
        text = json.dumps(root, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        chunks = [(b"JSON", text), (b"BIN\0", bytes(self._binary))]
        body = b"".join(struct.pack("<I4s", len(data), kind) + data for kind, data in chunks)
        return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


ANY_NORMAL = np.array([0, 0, 1], np.float32)
"""Normal of a vertex without faces, which must have one."""
FOUR = 4
"""Largest number of joints that move one vertex in glTF."""


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


def bird_motion(exported: Exported, n: int) -> Motion:
    """Return the motion of one bird in the camera frame of the image.

    Args:
        exported: the result.
        n: position of the track, with at least one pose.
    """
    s, bird = exported.solution, exported.bird
    at = np.flatnonzero(s.valid[n])
    orient, body = s.global_orient[n, at], s.body_pose[n, at]
    angles = np.concatenate([orient[:, None], body], axis=1).astype(np.float64)
    rotations = Rotation.from_rotvec(angles.reshape(-1, 3)).as_quat().reshape(*angles.shape[:2], 4)
    joints = np.asarray(bird.joints, np.float64)
    offsets = joints - np.where(np.arange(len(joints))[:, None] > 0, joints[np.maximum(bird.parents, 0)], 0)
    bones = np.concatenate([np.ones((len(at), 1)), s.bone_length[n, at]], axis=1)
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
        betas=s.betas[n, at].astype(np.float64),
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


def add_bird(builder: GltfBuilder, exported: Exported, n: int, motion: Motion, parent: int, animation: int) -> None:
    """Add the mesh, the skin and the motion of one bird.

    Args:
        builder: the file.
        exported: the result.
        n: position of the track.
        motion: the motion of the bird.
        parent: node of the camera frame of the image.
        animation: the animation that receives the channels.
    """
    bird, track = exported.bird, int(exported.solution.track_id[n])
    name = f"bird_{track}"
    joints = _add_joints(builder, bird, motion, name)
    own = builder.add("nodes", {"name": name, "children": [joints[0]], "extras": describe_tracks(exported)[str(track)]})
    builder.root["nodes"][parent].setdefault("children", []).append(own)
    inverse_bind = np.tile(np.eye(4, dtype=np.float32), (len(joints), 1, 1))
    inverse_bind[:, :3, 3] = -np.asarray(bird.joints)
    matrices = builder.add_array(inverse_bind)
    skin = builder.add("skins", {"joints": joints, "skeleton": own, "inverseBindMatrices": matrices})
    mesh = _add_mesh(builder, bird, motion, name)
    mesh_node = builder.add("nodes", {"name": f"{name}_mesh", "mesh": mesh, "skin": skin})
    builder.root["scenes"][0]["nodes"].append(mesh_node)  # viewers ignore the place of a skinned mesh
    _add_motion(builder, exported, motion, animation, own, joints, mesh_node)


def _add_joints(builder: GltfBuilder, bird: Bird, motion: Motion, name: str) -> list[int]:
    """Add a node for every joint, in the pose of the first fitted frame; returns the nodes."""
    first = len(builder.root.get("nodes", []))
    joints = list(range(first, first + bird.num_joints))
    for j, joint in enumerate(bird.joint_names):
        node: dict[str, Any] = {
            "name": f"{name}_{joint}",
            "translation": _floats(motion.translations[0, j]),
            "rotation": _floats(motion.rotations[0, j]),
        }
        children = [joints[k] for k, above in enumerate(bird.parents) if above == j and k > 0]
        builder.add("nodes", node | ({"children": children} if children else {}))
    return joints


def _add_mesh(builder: GltfBuilder, bird: Bird, motion: Motion, name: str) -> int:
    """Add the mesh. Shape coefficients that are constant change the mesh, others become morph targets."""
    vertices = np.asarray(bird.vertices, np.float64)
    basis = np.asarray(bird.shape_basis, np.float64)
    if not _morphs(motion):
        vertices = vertices + np.tensordot(motion.betas[0], basis, axes=1)
    faces = np.asarray(bird.faces)
    normals = vertex_normals(vertices, faces)
    joints, weights = four_weights(bird)
    short = weights.astype(np.float32)
    short[:, 0] = 1 - short[:, 1:].sum(axis=1, dtype=np.float32)  # the sum is 1 after rounding, too
    colours = np.asarray(bird.vertex_colours, np.float64)
    linear = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
    attributes = {
        "POSITION": builder.add_array(vertices.astype(np.float32), VERTICES, bounds=True),
        "NORMAL": builder.add_array(np.where(normals.any(axis=-1, keepdims=True), normals, ANY_NORMAL), VERTICES),
        "COLOR_0": builder.add_array(linear.astype(np.float32), VERTICES),
        "JOINTS_0": builder.add_array(joints.astype(np.uint8), VERTICES),
        "WEIGHTS_0": builder.add_array(short, VERTICES),
    }
    kind = np.uint16 if len(vertices) < 65535 else np.uint32
    primitive: dict[str, Any] = {"attributes": attributes, "material": _plumage(builder)}
    primitive["indices"] = builder.add_array(faces.reshape(-1).astype(kind), INDICES)
    mesh: dict[str, Any] = {"name": name, "primitives": [primitive]}
    if _morphs(motion):
        targets = [builder.add_array(each.astype(np.float32), VERTICES, bounds=True) for each in basis]
        primitive["targets"] = [{"POSITION": target} for target in targets]
        mesh["weights"] = _floats(motion.betas[0])
    return builder.add("meshes", mesh)


def _add_motion(
    builder: GltfBuilder, exported: Exported, motion: Motion, animation: int, own: int, joints: list[int], mesh: int
) -> None:
    """Add the channels of a bird. A bird without a pose in a frame has size 0, which hides the bird."""
    line, column = timeline(exported)
    times = builder.add_array(line[column[motion.at]].astype(np.float32), bounds=True)
    target = builder.root["animations"][animation]

    def animate(node: int, path: str, values: np.ndarray, at: int = times, step: bool = False) -> None:
        sampler: dict[str, Any] = {"input": at, "output": builder.add_array(values.astype(np.float32))}
        sampler["interpolation"] = "STEP" if step else "LINEAR"
        target["samplers"].append(sampler)
        channel = {"sampler": len(target["samplers"]) - 1, "target": {"node": node, "path": path}}
        target["channels"].append(channel)

    node = builder.root["nodes"][own]
    node |= {"translation": _floats(motion.place[0]), "rotation": _floats(motion.facing[0])}
    animate(own, "translation", motion.place)
    animate(own, "rotation", motion.facing)
    size = np.zeros(len(line))
    size[column[motion.at]] = motion.size
    node["scale"] = _floats(np.repeat(size[0], 3))
    if np.ptp(size) > 0:
        every = builder.add_array(line.astype(np.float32), bounds=True)
        animate(own, "scale", np.repeat(size[:, None], 3, axis=1), every, step=True)
    for j, joint in enumerate(joints):
        if np.ptp(motion.rotations[:, j], axis=0).any():
            animate(joint, "rotation", motion.rotations[:, j])
        if np.ptp(motion.translations[:, j], axis=0).any():
            animate(joint, "translation", motion.translations[:, j])
    if _morphs(motion):
        animate(mesh, "weights", motion.betas.reshape(-1))


def timeline(exported: Exported) -> tuple[Float[np.ndarray, "L"], np.ndarray]:
    """Return the times of all frame numbers of the export, from 0 on, and the position of every frame of the result.

    Frame numbers that the result lacks are included.
    """
    numbers = exported.solution.frame_index
    line = np.arange(numbers[0], numbers[-1] + 1, frame_step(numbers))
    times = np.interp(line, numbers, exported.times_s)
    return times - times[0], np.searchsorted(line, numbers)


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
            full, short = (each.vertices_cam_window(n, slice(t, t + 1))[0] for each in posed)
            worst = max(worst, float(np.linalg.norm(full - short, axis=1).max() / s.scale[n, t]))
    return worst / body_length(bird)


def body_length(bird: Bird) -> float:
    """Return the longest side of the box of the mesh in its rest pose, model units."""
    return float(np.ptp(np.asarray(bird.vertices), axis=0).max())


def _morphs(motion: Motion) -> bool:
    return bool(np.ptp(motion.betas, axis=0).any())


def _plumage(builder: GltfBuilder) -> int:
    """Return the material of all birds."""
    materials = builder.root.setdefault("materials", [])
    for i, material in enumerate(materials):
        if material["name"] == "plumage":
            return i
    surface = {"metallicFactor": 0.0, "roughnessFactor": 0.9}
    return builder.add("materials", {"name": "plumage", "pbrMetallicRoughness": surface, "doubleSided": True})


def _floats(values: Any) -> list[float]:
    return [float(value) for value in np.asarray(values, np.float32)]
