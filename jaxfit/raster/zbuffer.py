"""Z-buffer renderer for pictures and hard masks, not differentiable, and the shading of a lit mesh."""

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int, Int32, UInt8

from jaxfit.raster import zbuffer_reference
from jaxfit.raster.kernels import kernels_available, require_kernels

MAX_SIZE, MAX_SAMPLES = 2**14, 8


class Fragments(NamedTuple):
    """The visible face at the centre of every pixel."""

    face: Int32[np.ndarray, "*B H W"]
    """Index of the nearest face. −1 without a face."""

    barycentric: Float32[np.ndarray, "*B H W 3"]
    """Perspective-correct weights of the vertices of that face. Their sum is 1. Without a face they are 0."""

    depth: Float32[np.ndarray, "*B H W"]
    """Depth in the camera frame, in the unit of the vertices. inf without a face."""


class MaskOverlap(NamedTuple):
    """The masks of meshes, and what they share with runs of pixels."""

    box_px: Int32[np.ndarray, "B 4"]
    """x, y, width and height of the tight box; 0 for an empty mask."""

    area_px: Int32[np.ndarray, "B"]
    """Number of pixels."""

    shared_px: Int32[np.ndarray, "R"]
    """Number of pixels that each run shares with the mask of its mesh."""


def zbuffer(
    vertices_screen: Float[Array | np.ndarray, "*B V 3"], faces: Int[Array | np.ndarray, "F 3"], width: int, height: int
) -> Fragments:
    """Return the nearest face at the centre of every pixel.

    At a centre inside the projection of a face, with screen-space barycentrics λ, 1/depth = Σ λ_i / z_i, and the
    weights are λ_i · depth / z_i. Edges belong to the face. Of faces with equal depths, the face with the lowest index
    is visible. Both sides of a face are visible.

    Faces are not clipped. A face is skipped if a vertex has a depth of 1e-3 or less, if a coordinate is not finite, or
    if the area is 0. Coordinates are converted to float32.

    Args:
        vertices_screen: x and y in pixels (x right, y down, pixel centres at i + 0.5) and depth in the camera frame,
            in any unit, as `jaxfit.model.camera.to_screen` gives them.
        faces: vertex indices, in any orientation, the same for the whole batch.
        width: width of the image in pixels, 1 to 16384.
        height: height of the image in pixels, 1 to 16384.

    Raises:
        ValueError: the shape, type or value of an argument is not as described.

    Source: Pineda, "A parallel algorithm for polygon rasterization" (1988); Heckbert & Moreton, "Interpolation for
    polygon texture mapping and shading" (1991).
    """
    vertices, faces, batch = _mesh(vertices_screen, faces)
    _check_size(width, height)
    shape = (len(vertices), height, width)
    face, barycentric, depth = np.empty(shape, np.int32), np.empty((*shape, 3), np.float32), np.empty(shape, np.float32)
    if kernels_available():
        require_kernels().zbuffer(vertices, faces, face, barycentric, depth)
    else:
        for i, one in enumerate(vertices):
            face[i], barycentric[i], depth[i] = zbuffer_reference.fragments(one, faces, width, height)
    return Fragments(*(a.reshape(batch + a.shape[1:]) for a in (face, barycentric, depth)))


def hard_mask(
    vertices_screen: Float[Array | np.ndarray, "*B V 3"], faces: Int[Array | np.ndarray, "F 3"], width: int, height: int
) -> Bool[np.ndarray, "*B {height} {width}"]:
    """Return the masks of the pixels whose centre lies inside the projection of a face or on its edge.

    The time depends on the area that a mesh covers, not on the size of the image.

    Arguments, skipped faces and errors are those of `zbuffer`.
    """
    vertices, faces, batch = _mesh(vertices_screen, faces)
    _check_size(width, height)
    mask = np.zeros((len(vertices), height, width), bool)
    if kernels_available():
        require_kernels().hard_mask(vertices, faces, mask)
    else:
        for i, one in enumerate(vertices):
            mask[i] = zbuffer_reference.raster(one, faces, width, height, 1)[0] >= 0
    return mask.reshape(*batch, height, width)


def mask_overlap(
    vertices_screen: Float[Array | np.ndarray, "B V 3"],
    faces: Int[Array | np.ndarray, "F 3"],
    sizes_px: Int[np.ndarray, "B 2"],
    mesh: Int[np.ndarray, "R"],
    runs: Int[np.ndarray, "R 2"],
) -> MaskOverlap:
    """Return the boxes and areas of the masks of `hard_mask`, and their overlap with runs, without the masks.

    Each mesh has an image of its own. The time depends on the area that a mesh covers, not on the size of the image.

    Args:
        vertices_screen: as for `zbuffer`.
        faces: as for `zbuffer`.
        sizes_px: width and height of the image of each mesh, 1 to 16384.
        mesh: position of the mesh that each run is compared with.
        runs: first pixel of each run, and the pixel after its last. Pixels are counted from 0, column by column from
            the left, and from the top in each column, as in the run lengths of COCO.

    Raises:
        ValueError: the shape, type or value of an argument is not as described.
    """
    vertices, faces, batch = _mesh(vertices_screen, faces)
    if len(batch) != 1:
        raise ValueError(f"vertices_screen: expected shape (B, V, 3), got {np.shape(vertices_screen)}")
    sizes = _integers("sizes_px", sizes_px, (len(vertices), 2), 1, MAX_SIZE)
    mesh = _integers("mesh", mesh, (np.size(mesh),), 0, len(vertices) - 1)
    runs = _integers("runs", runs, (len(mesh), 2), 0, MAX_SIZE**2)
    if (runs[:, 0] > runs[:, 1]).any() or (runs[:, 1] > sizes.prod(1)[mesh]).any():
        raise ValueError("runs: expected first pixels that are not after the ends, and ends within the images")
    box, area, shared = (np.zeros(shape, np.int32) for shape in ((len(vertices), 4), len(vertices), len(runs)))
    if kernels_available():
        order = np.argsort(mesh, kind="stable")
        found = np.zeros(len(runs), np.int32)
        ends = np.bincount(mesh, minlength=len(vertices)).cumsum()
        require_kernels().mask_overlap(vertices, faces, sizes, runs[order], ends, box, area, found)
        shared[order] = found
    else:
        for i, one in enumerate(vertices):
            own = mesh == i
            found = zbuffer_reference.mask_overlap(one, faces, sizes[i, 0], sizes[i, 1], runs[own])
            box[i], area[i], shared[own] = found
    return MaskOverlap(box, area, shared)


def interpolate(
    vertices_screen: Float[Array | np.ndarray, "*B V 3"],
    faces: Int[Array | np.ndarray, "F 3"],
    attributes: Float[Array | np.ndarray, "... V C"],
    width: int,
    height: int,
    samples: int = 2,
) -> tuple[Float32[np.ndarray, "*B H W C"], Float32[np.ndarray, "*B H W"], Int32[np.ndarray, "*B H W"]]:
    """Return interpolated vertex attributes over the image, anti-aliased.

    Every pixel has samples² samples on a regular grid. At each sample the nearest face is visible, as in `zbuffer`.

    Args:
        vertices_screen: as for `zbuffer`.
        faces: as for `zbuffer`.
        attributes: any number of channels for each vertex, in any unit. Leading dimensions may be omitted or 1.
        width: as for `zbuffer`.
        height: as for `zbuffer`.
        samples: number of samples along the side of a pixel, 1 to 8.

    Returns:
        Values: the sum of the perspective-correct attributes over the covered samples, divided by samples². The values
        are therefore premultiplied by the coverage. Coverage: the fraction of covered samples, 0 to 1. Face: the
        visible face at the nearest sample, −1 without a covered sample.

    Raises:
        ValueError: the shape, type or value of an argument is not as described.
    """
    vertices, faces, batch = _mesh(vertices_screen, faces)
    _check_size(width, height)
    _check_samples(samples)
    channels = _attributes(attributes, batch, vertices.shape[1])
    shape = (len(vertices), height, width)
    values = np.empty((*shape, channels.shape[-1]), np.float32)
    coverage, face = np.empty(shape, np.float32), np.empty(shape, np.int32)
    if kernels_available():
        require_kernels().interpolate(vertices, faces, channels, samples, values, coverage, face)
    else:
        for i, one in enumerate(vertices):
            drawn = zbuffer_reference.interpolate(one, faces, channels[i], width, height, samples)
            values[i], coverage[i], face[i] = drawn
    values, coverage, face = (a.reshape(batch + a.shape[1:]) for a in (values, coverage, face))
    return values, coverage, face


def draw(
    image: UInt8[np.ndarray, "H W 3"],
    vertices_screen: Float[Array | np.ndarray, "V 3"],
    faces: Int[Array | np.ndarray, "F 3"],
    colours: Float[Array | np.ndarray, "V 3"],
    samples: int = 2,
) -> UInt8[np.ndarray, "H W 3"]:
    """Return an image with a mesh drawn over it: (1 − coverage) · image + 255 · interpolated colours, rounded.

    Draw several birds in one call, as one mesh, so that near birds hide far birds.

    Args:
        image: the background, which is not changed. Its channels have the order of the colours.
        vertices_screen: as for `zbuffer`, in pixels of this image.
        faces: as for `zbuffer`.
        colours: colours of the vertices, in [0, 1].
        samples: as for `interpolate`.

    Returns:
        A new image.

    Raises:
        ValueError: the shape, type or value of an argument is not as described.
    """
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        got = f"{image.dtype} {image.shape}" if isinstance(image, np.ndarray) else type(image).__name__
        raise ValueError(f"image: expected uint8 of shape (H, W, 3), got {got}")
    vertices, faces, batch = _mesh(vertices_screen, faces)
    if batch:
        raise ValueError(f"vertices_screen: expected shape (V, 3), got {np.shape(vertices_screen)}")
    _check_size(image.shape[1], image.shape[0])
    _check_samples(samples)
    channels = _attributes(colours, (), vertices.shape[1], "colours")
    if channels.shape[-1] != 3:
        raise ValueError(f"colours: expected shape ({vertices.shape[1]}, 3), got {np.shape(colours)}")
    drawn = np.array(image, order="C")
    if kernels_available():
        require_kernels().draw(vertices, faces, channels[0], samples, drawn)
    else:
        zbuffer_reference.draw(drawn, vertices[0], faces, channels[0], samples)
    return drawn


def _mesh(vertices_screen: Any, faces: Any) -> tuple[np.ndarray, np.ndarray, tuple[int, ...]]:
    """Check a mesh. Returns contiguous float32 vertices (B, V, 3), contiguous int32 faces, and the batch shape."""
    vertices, indices = np.asarray(vertices_screen), np.asarray(faces)
    if vertices.ndim < 2 or vertices.shape[-1] != 3:
        raise ValueError(f"vertices_screen: expected shape (…, V, 3), got {vertices.shape}")
    if not np.issubdtype(vertices.dtype, np.floating):
        raise ValueError(f"vertices_screen: expected floats, got {vertices.dtype}")
    if indices.ndim != 2 or indices.shape[1] != 3:
        raise ValueError(f"faces: expected shape (F, 3), got {indices.shape}")
    if not np.issubdtype(indices.dtype, np.integer):
        raise ValueError(f"faces: expected integers, got {indices.dtype}")
    batch, count = vertices.shape[:-2], vertices.shape[-2]
    if indices.size and not 0 <= indices.min() <= indices.max() < count:
        raise ValueError(f"faces: expected indices in [0, {count}), got {indices.min()} to {indices.max()}")
    with np.errstate(over="ignore"):  # coordinates too large for float32 become infinite, and their faces are skipped
        vertices = np.ascontiguousarray(vertices, np.float32)
    return vertices.reshape(math.prod(batch), count, 3), np.ascontiguousarray(indices, np.int32), batch


def _attributes(attributes: Any, batch: tuple[int, ...], count: int, name: str = "attributes") -> np.ndarray:
    """Check attributes. Returns them as contiguous float32 (B, V, C)."""
    given = np.asarray(attributes)
    if not np.issubdtype(given.dtype, np.floating):
        raise ValueError(f"{name}: expected floats, got {given.dtype}")
    leading = (*batch, count)
    try:
        full = np.broadcast_to(given, (*leading, *given.shape[-1:]))
    except ValueError:
        full = None
    if full is None or given.ndim < 2 or given.shape[-2] != count:
        raise ValueError(f"{name}: expected shape ({', '.join(map(str, leading))}, channels), got {given.shape}")
    return np.ascontiguousarray(full, np.float32).reshape(math.prod(batch), count, given.shape[-1])


def _integers(name: str, given: Any, shape: tuple[int, ...], low: int, high: int) -> np.ndarray:
    """Check an array of integers. Returns it as contiguous int32."""
    array = np.asarray(given)
    if array.shape != shape:
        raise ValueError(f"{name}: expected shape {shape}, got {array.shape}")
    if not np.issubdtype(array.dtype, np.integer):
        raise ValueError(f"{name}: expected integers, got {array.dtype}")
    if array.size and not low <= array.min() <= array.max() <= high:
        raise ValueError(f"{name}: expected integers in [{low}, {high}], got {array.min()} to {array.max()}")
    return np.ascontiguousarray(array, np.int32)


def _check_size(width: Any, height: Any) -> None:
    for name, value in (("width", width), ("height", height)):
        if isinstance(value, bool) or not isinstance(value, int | np.integer) or not 0 < value <= MAX_SIZE:
            raise ValueError(f"{name}: expected an integer from 1 to {MAX_SIZE}, got {value!r}")


def _check_samples(samples: Any) -> None:
    if isinstance(samples, bool) or not isinstance(samples, int | np.integer) or not 0 < samples <= MAX_SAMPLES:
        raise ValueError(f"samples: expected an integer from 1 to {MAX_SAMPLES}, got {samples!r}")


LIGHT = (-0.4, -0.8, -0.6)
"""Direction from the scene to the light, in the camera frame (x right, y down, z forward). The light is above, left of
the scene and on the side of the camera."""


def vertex_normals(
    vertices: Float[Array | np.ndarray, "*B V 3"], faces: Int[Array | np.ndarray, "F 3"]
) -> Float32[np.ndarray, "*B V 3"]:
    """Return unit normals of the vertices: the normalised sum of the face normals, weighted by the face areas.

    The normals point outwards if the faces turn counter-clockwise seen from outside, in right-handed axes such as those
    of the camera frame. A vertex without faces, or only with faces of area 0, has the normal 0.

    Args:
        vertices: in any unit and frame.
        faces: vertex indices.

    Raises:
        ValueError: the shape of an argument is not as described.
    """
    vertices, faces = _checked(vertices, faces)
    return _vertex_normals(vertices, faces, _face_normals(vertices, faces))


def _face_normals(vertices: Float[np.ndarray, "*B V 3"], faces: Int[np.ndarray, "F 3"]) -> Float[np.ndarray, "3 *B F"]:
    """Return the normals of the faces, axis by axis; their lengths are twice the areas."""
    corners = np.take(np.moveaxis(vertices, -1, 0).copy(), faces.T, axis=-1)  # much faster with the axes first
    (ax, ay, az), (bx, by, bz) = (corners[..., i, :] - corners[..., 0, :] for i in (1, 2))
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def _vertex_normals(vertices: np.ndarray, faces: np.ndarray, doubled: np.ndarray) -> np.ndarray:
    """Return `vertex_normals` from the normals of the faces."""
    batch, count = vertices.shape[:-2], vertices.shape[-2]
    flat = doubled.reshape(3, math.prod(batch), len(faces))
    sums = np.zeros((flat.shape[1], count, 3))
    for axis, b in np.ndindex(flat.shape[:2]):
        sums[b, :, axis] = np.bincount(faces.ravel(), np.repeat(flat[axis, b], 3), minlength=count)
    length = np.linalg.norm(sums, axis=-1, keepdims=True)
    unit = sums / np.where(length > 0, length, 1)
    return unit.reshape(*batch, count, 3).astype(np.float32)


def shade(
    vertices: Float[Array | np.ndarray, "V 3"],
    faces: Int[Array | np.ndarray, "F 3"],
    colours: Float[Array | np.ndarray, "V 3"],
    light: tuple[float, float, float] = LIGHT,
    ambient: float = 0.45,
) -> Float32[np.ndarray, "V 3"]:
    """Return colours under a sky and a distant light: colour · (a · (3 − n_y)/4 + (1 − a) · ((1 + n · l)/2)²).

    The sky is bright above (−y) and half as bright below. The light wraps around the bird, so that no part is black.
    If the volume of the mesh is negative, its faces turn inwards, and the normals are reversed.

    Args:
        vertices: camera frame, any unit.
        faces: vertex indices.
        colours: colours of the unlit vertices, in [0, 1].
        light: l, the direction from the bird to the light, in the camera frame, of any length but 0.
        ambient: a, the fraction of the light that comes from the sky, 0 to 1.

    Returns:
        Colours, clipped to [0, 1], for `jaxfit.raster.zbuffer.draw`.

    Raises:
        ValueError: the shape or value of an argument is not as described.
    """
    vertices, faces = _checked(vertices, faces)
    colours = np.asarray(colours)
    if vertices.ndim != 2 or colours.shape != vertices.shape:
        raise ValueError(f"colours: expected the shape of vertices, {vertices.shape}, (V, 3), got {colours.shape}")
    towards = np.asarray(light, np.float64)
    if towards.shape != (3,) or not np.isfinite(towards).all() or not towards.any():
        raise ValueError(f"light: expected a finite direction (3,) other than 0, got {light!r}")
    if not 0 <= ambient <= 1:
        raise ValueError(f"ambient: expected a fraction in [0, 1], got {ambient!r}")
    doubled = _face_normals(vertices, faces)
    volume = np.sum((np.take(vertices, faces[:, 0], axis=0) - vertices.mean(0)) * doubled.T)
    normals = _vertex_normals(vertices, faces, doubled) * (-1 if volume < 0 else 1)
    sky = (3 - normals[:, 1:2]) / 4
    sun = ((1 + normals @ (towards / np.linalg.norm(towards)))[:, None] / 2) ** 2
    return np.clip(colours * (ambient * sky + (1 - ambient) * sun), 0, 1).astype(np.float32)


def _checked(vertices, faces) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces)
    if vertices.ndim < 2 or vertices.shape[-1] != 3:
        raise ValueError(f"vertices: expected shape (…, V, 3), got {vertices.shape}")
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise ValueError(f"faces: expected shape (F, 3), got {faces.shape}")
    return vertices, faces
