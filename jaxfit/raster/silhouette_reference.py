"""Silhouettes in plain JAX, of both kinds of edges: the specification that the tests compare the compiled kernels with.

The reference runs on any platform and JAX derives its gradients. It is a few hundred times slower than the kernels.
"""

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt8

KINDS = ("l1", "smooth_l1")
Edge = Literal["soft_rasterizer", "unbiased"]
EDGES: tuple[Edge, ...] = ("soft_rasterizer", "unbiased")
MIN_DEPTH = 1e-8  # a face with a vertex at or behind this depth is skipped
MIN_AREA = 1e-8  # a face with at most this |2·area|, in units of half the image, is skipped
FAR_AWAY = 2.0**20  # px; coordinates are clamped to ± this, so that their squares stay finite
COVERED = 0.9999  # from this mean number of faces on, a pixel is covered
BAND_EDGE = 0.01  # the Gauss-Newton block sums over the pixels whose silhouette is this far from 0 and from 1
UNKNOWN = 2  # this value of a uint8 mask marks the pixels that may or may not show the bird
_FACES_AT_ONCE = 16


@dataclass(frozen=True)
class Blur:
    """Softness of the silhouette's edge. It has no gradient and is constant under jit.

    `Blur.for_size` gives the values of PyTorch3D's silhouette examples.
    """

    sigma: float
    """Softness s in px²: a face covers a pixel at signed squared distance d by sigmoid(−d/s)."""

    radius: float
    """px. A face does not affect the pixels outside it at this distance or farther. Only for `soft_rasterizer`."""

    edge: Edge = "soft_rasterizer"
    """`soft_rasterizer`: every face has a soft edge, as published; the silhouette is larger than its mesh.
    `unbiased`: the covered area of the pixels, filtered by a Gaussian with the variance 2·ln(2)·s of that edge."""

    def __post_init__(self):
        if self.edge not in EDGES:
            raise ValueError(f"edge: expected one of {EDGES}, got {self.edge!r}")
        if not (math.isfinite(self.sigma) and self.sigma > 0):
            raise ValueError(f"sigma: expected a positive number of px², got {self.sigma}")
        if not (math.isfinite(self.radius) and self.radius >= 0):
            raise ValueError(f"radius: expected a number of px, at least 0, got {self.radius}")

    @staticmethod
    def for_size(size: int, blur: float = 1.0, edge: Edge = "soft_rasterizer") -> "Blur":
        """Return the usual blur of a square image, times `blur`.

        s = 1e-4 (blur · size/2)², radius = (blur · size/2) √(1e-4 ln(1e4 − 1)).
        """
        half = size / 2
        return Blur(1e-4 * half**2 * blur**2, half * math.sqrt(1e-4 * math.log(1e4 - 1)) * blur, edge)

    @property
    def filter_sd_px(self) -> float:
        """Standard deviation of the Gaussian of an unbiased edge, √(2·ln(2)·s): that of the soft rasteriser's edge,
        whose profile is sigmoid(−x·|x|/s)."""
        return math.sqrt(2 * math.log(2) * self.sigma)


class Skin(NamedTuple):
    """A mesh posed by linear blend skinning. Vertex v lies at view · Σ_m weight[v, m] · B[joint[v, m]] · (rest[v], 1),
    and a constant, in the camera frame. The transforms B (J, 3, 4) and the rest vertices depend on D parameters."""

    rest: Float[Array, "V 3"]
    """Vertices at rest."""
    joint: Int[Array, "V M"]
    """The joints that move each vertex."""
    weight: Float[Array, "V M"]
    """Their skinning weights; 0 for entries that are not used."""
    transforms: Float[Array, "J 3 4"]
    """B."""
    generators: Float[Array, "3 4 P"]
    """G: the derivative of B[j] with respect to parameter p of P is moved[j, p] · G[..., p] · [B[j]; 0 0 0 1]."""
    moved: Float[Array, "J P"]
    """1 where a parameter moves a joint, and else 0."""
    view: Float[Array, "3 3"]
    """The linear part of the map to the camera frame."""
    shape_basis: Float[Array, "V 3 S"]
    """Derivatives of the rest vertices with respect to S parameters that follow the P parameters; D = P + S."""


def _segment_distance_squared(x, y, a, b):
    """Squared distance of the pixels (x, y) from the segment a–b. a and b are (x, y) pairs."""
    edge_x, edge_y = b[0] - a[0], b[1] - a[1]
    length_squared = jnp.maximum(edge_x**2 + edge_y**2, 1e-20)
    along = jnp.clip(((x - a[0]) * edge_x + (y - a[1]) * edge_y) / length_squared, 0, 1)
    return (x - a[0] - along * edge_x) ** 2 + (y - a[1] - along * edge_y) ** 2


def _side(x, y, a, b):
    """Twice the area of the triangle (a, b, pixel), positive if the triangle turns from +x to +y."""
    return (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])


def _log_transmitted(corners, x, y, size, blur):
    """Σ_f log(1 − p) over faces (f, 3, 3) at the pixels x (1, size) and y (size, 1): an image (size, size)."""
    behind = jnp.any(corners[..., 2] <= MIN_DEPTH, -1)
    area = _side(corners[:, 2, 0], corners[:, 2, 1], corners[:, 0].T, corners[:, 1].T)
    # Rounding can give a positive area to a face with two equal corners.
    folded = jnp.any(jnp.all(corners[..., :2] == jnp.roll(corners[..., :2], 1, 1), -1), -1)
    skipped = behind | folded | (jnp.abs(area) <= MIN_AREA * (size / 2) ** 2)
    some_triangle = jnp.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], corners.dtype)
    xy = jnp.where(skipped[:, None, None], some_triangle, corners[..., :2])[..., None, None]
    a, b, c = ((xy[:, i, 0], xy[:, i, 1]) for i in range(3))

    turn = jnp.sign(area)[:, None, None]
    inside = (turn * _side(x, y, a, b) > 0) & (turn * _side(x, y, b, c) > 0) & (turn * _side(x, y, c, a) > 0)
    d = _segment_distance_squared(x, y, a, b)
    for start, end in ((b, c), (c, a)):  # on a tie the first edge takes the gradient
        other = _segment_distance_squared(x, y, start, end)
        d = jnp.where(other < d, other, d)
    counts = ~skipped[:, None, None] & (inside | (d < blur.radius**2))
    d = jnp.where(counts, jnp.where(inside, -d, d), 0.0)
    return jnp.sum(jnp.where(counts, -jax.nn.softplus(-d / blur.sigma), 0.0), 0)


def _log_transmitted_of_mesh(vertices, faces, size, blur):
    centres = jnp.arange(size, dtype=vertices.dtype) + 0.5
    xy = jnp.clip(vertices[:, :2], -FAR_AWAY, FAR_AWAY)
    vertices = jnp.concatenate([xy, jax.lax.stop_gradient(vertices[:, 2:])], -1)

    def log_transmitted(chunk):
        indices, is_real = chunk
        corners = vertices[indices]
        behind_camera = corners.at[..., 2].set(-1.0)
        corners = jnp.where(is_real[:, None, None], corners, behind_camera)
        return _log_transmitted(corners, centres[None, :], centres[:, None], size, blur)

    return _sum_over_faces(log_transmitted, jnp.zeros((size, size), vertices.dtype), faces)


def _sum_over_faces(function, start, faces):
    """Return start + Σ function((some faces, whether each face is real)), over all faces.

    A few faces at a time, which the backward pass computes again: the memory is that of a few dozen images.
    """
    count = faces.shape[0]
    padding = -count % _FACES_AT_ONCE
    chunks = jnp.pad(faces, ((0, padding), (0, 0))).reshape(-1, _FACES_AT_ONCE, 3)
    real = (jnp.arange(count + padding) < count).reshape(-1, _FACES_AT_ONCE)

    @jax.checkpoint
    def add(total, chunk):
        return total + function(chunk), None

    return jax.lax.scan(add, start, (chunks, real))[0] if count else start


def _filtered(image: Float[Array, "size size"], blur: Blur) -> Float[Array, "size size"]:
    """Filter an image by the Gaussian of a blur; pixels outside the image are 0."""
    size, sd = image.shape[0], blur.filter_sd_px
    radius = math.ceil(3 * sd)
    taps = [math.exp(-0.5 * (k / sd) ** 2) for k in range(-radius, radius + 1)]
    weights = jnp.asarray(taps, image.dtype) / sum(taps)
    apart = jnp.arange(size)[:, None] - jnp.arange(size)
    matrix = jnp.where(abs(apart) <= radius, weights[jnp.clip(apart + radius, 0, 2 * radius)], 0.0)
    return matrix @ image @ matrix.T


def _areas_below(start, end, column, row):
    """Return the signed area of each pixel below the edges from `start` to `end`, (x, y) pairs, in its column.

    The area is positive if the edge goes to the right. The sum over the edges of a face that turns from +x to +y is the
    area of the pixel inside the face.
    """
    tiny = jnp.asarray(1e-12, start[0].dtype)
    x, y, dx, dy = start[0], start[1], end[0] - start[0], end[1] - start[1]

    def shares(low, at, change):
        """The shares of the edge's length between which it lies between low and low + 1."""
        inverse = 1 / jnp.where(jnp.abs(change) < tiny, tiny, change)
        first, second = (low - at) * inverse, (low + 1 - at) * inverse
        return jnp.minimum(first, second), jnp.maximum(first, second)

    in_column = tuple(jnp.clip(t, 0, 1) for t in shares(column, x, dx))
    in_row = shares(row, y, dy)
    enter, leave = (jnp.clip(t, *in_column) for t in in_row)
    # the share above the pixel is at the side of the smaller y
    above = jnp.where(dy < 0, in_column[1] - leave, enter - in_column[0])
    inside = (leave - enter) * (row + 1 - y - dy * (enter + leave) / 2)
    return dx * (above + inside)


def _coverage(vertices, faces, size):
    """Return the covered area of each pixel: the larger mean number of faces of one of the two sides, at most 1."""
    pixel = jnp.arange(size, dtype=vertices.dtype)
    xy = jnp.clip(vertices[:, :2], -FAR_AWAY, FAR_AWAY)
    vertices = jnp.concatenate([xy, jax.lax.stop_gradient(vertices[:, 2:])], -1)

    def areas(chunk):
        indices, is_real = chunk
        corners = vertices[indices]
        a, b, c = ((corners[:, i, 0, None, None], corners[:, i, 1, None, None]) for i in range(3))
        turn = _side(c[0], c[1], a, b)
        skipped = jnp.any(corners[..., 2] <= MIN_DEPTH, -1)[:, None, None] | (
            jnp.abs(turn) <= MIN_AREA * (size / 2) ** 2
        )
        below = (_areas_below(*ends, pixel[None, :], pixel[:, None]) for ends in ((a, b), (b, c), (c, a)))
        area = jnp.where(skipped | ~is_real[:, None, None], 0.0, sum(below) * jnp.sign(turn))
        return jnp.stack([jnp.sum(jnp.where(side, area, 0.0), 0) for side in (turn > 0, turn < 0)])

    mean = jnp.zeros((2, size, size), vertices.dtype)
    mean = _sum_over_faces(areas, mean, faces).max(axis=0)
    return jnp.where(mean < COVERED, mean, 1.0)


def silhouette(
    vertices: Float[Array, "V 3"], faces: Int[Array, "F 3"], size: int, blur: Blur
) -> Float[Array, "size size"]:
    """Return the silhouette. See `jaxfit.raster.silhouette.silhouette`."""
    finite = jnp.all(jnp.isfinite(vertices))
    vertices_or_zero = jnp.where(finite, vertices, 0.0)
    if blur.edge == "unbiased":
        image = _filtered(_coverage(vertices_or_zero, faces, size), blur)
    else:
        image = -jnp.expm1(_log_transmitted_of_mesh(vertices_or_zero, faces, size, blur))
    # This term also makes the gradient NaN, with respect to every x and y.
    return image + jnp.sum(vertices[:, :2] * jnp.where(finite, 0.0, jnp.nan))


def _known(target):
    """Return the pixels of a mask that are not unknown; float and bool masks have no unknown pixels."""
    return target != UNKNOWN if target.dtype == jnp.uint8 else jnp.ones(target.shape, bool)


def difference(vertices, faces, mask, known, blur):
    """Return the difference of silhouette and mask, without the unknown pixels. A filter is applied to the whole."""
    size = mask.shape[-1]
    if blur.edge != "unbiased":
        return jnp.where(known, silhouette(vertices, faces, size, blur) - mask, 0.0)
    finite = jnp.all(jnp.isfinite(vertices))
    coverage = _coverage(jnp.where(finite, vertices, 0.0), faces, size)
    error = _filtered(jnp.where(known, coverage - mask, 0.0), blur)
    return error + jnp.sum(vertices[:, :2] * jnp.where(finite, 0.0, jnp.nan))


def mask_loss(
    vertices: Float[Array, "V 3"],
    faces: Int[Array, "F 3"],
    target: Bool[Array, "size size"] | UInt8[Array, "size size"] | Float[Array, "size size"],
    weight: Float[Array, ""],
    kind: str,
    blur: Blur,
) -> Float[Array, ""]:
    """Return the unweighted loss. A weight of 0 gives a loss of 0."""
    missing = weight == 0
    vertices = jnp.where(missing, 0.0, vertices)
    mask = target if jnp.issubdtype(target.dtype, jnp.floating) else (target != 0).astype(vertices.dtype)
    error = difference(vertices, faces, mask, _known(target), blur)
    magnitude = jnp.abs(error)
    if kind == "smooth_l1":
        magnitude = jnp.where(magnitude < 1, 0.5 * error**2, magnitude - 0.5)
    return jnp.where(missing, 0.0, jnp.sum(magnitude))


def silhouette_gauss_newton(
    vertices: Float[Array, "V 3"],
    faces: Int[Array, "F 3"],
    target: UInt8[Array, "size size"],
    weight: Float[Array, ""],
    skin: Skin,
    camera_px: tuple[float, float],
    blur: Blur,
) -> Float[Array, "D D"]:
    """Return the unweighted Gauss-Newton block over all known pixels of the band. A weight of 0 gives a block of 0."""
    focal, centre = camera_px
    missing = weight == 0
    vertices = jnp.where(missing, 1.0, vertices)
    rest = jnp.concatenate([skin.rest, jnp.ones_like(skin.rest[:, :1])], axis=1)
    transforms = jnp.pad(skin.transforms, ((0, 0), (0, 1), (0, 0))).at[:, 3, 3].set(1)[skin.joint]  # (V, M, 4, 4)
    points = jnp.einsum("vm,vmcd,vd,vmp->vcp", skin.weight, transforms, rest, skin.moved[skin.joint])
    by_transforms = jnp.einsum("icp,vcp->pvi", skin.generators, points)
    by_shape = jnp.einsum("vm,vmic,vcs->svi", skin.weight, transforms[..., :3, :3], skin.shape_basis)
    moved_cam = jnp.concatenate([by_transforms, by_shape]) @ skin.view.T  # (D, V, 3)
    depth = vertices[:, 2:]
    moved_px = (focal * moved_cam[..., :2] - (vertices[:, :2] - centre) * moved_cam[..., 2:]) / depth
    tangents = jnp.concatenate([moved_px, moved_cam[..., 2:]], axis=-1)

    def image(v):
        return difference(v, faces, jnp.zeros(target.shape, v.dtype), _known(target), blur)

    value = image(vertices)
    rows = jax.vmap(lambda tangent: jax.jvp(image, (vertices,), (tangent,))[1])(tangents)  # (D, size, size)
    counted = (value > BAND_EDGE) & (value < 1 - BAND_EDGE) | (blur.edge == "unbiased")
    block = jnp.einsum("dyx,eyx->de", jnp.where(counted, rows, 0.0), rows)
    return jnp.where(missing, 0.0, block)
