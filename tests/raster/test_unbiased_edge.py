"""The unbiased edge: areas of meshes, thin parts and sheets; kernels against the reference; gradients."""

import functools

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from jax.test_util import check_grads
from scipy.spatial.transform import Rotation

from jaxfit.raster import silhouette as raster
from jaxfit.raster.silhouette_reference import UNKNOWN, Blur
from jaxfit.raster.zbuffer import hard_mask

SIZE = 40
EDGE = Blur(1.6, 4.0, "unbiased")


@functools.partial(jax.jit, static_argnames=("size", "blur", "backend"))
def image_and_pull(vertices, faces, cotangent, size, blur, backend):
    image, pull = jax.vjp(lambda v: raster.silhouette(v, faces, size, blur=blur, backend=backend), vertices)
    return image, pull(cotangent)[0]


@functools.partial(jax.jit, static_argnames=("kind", "blur", "backend"))
def loss_and_gradient(vertices, faces, target, kind, blur, backend):
    def loss(v):
        return raster.mask_loss(v, faces, target, kind=kind, blur=blur, backend=backend)

    return jax.value_and_grad(loss)(vertices)


def on_screen(mesh, place=(18.0, 21.0), depth=50.0, scale=11.0):
    turned = Rotation.from_rotvec([0.3, 0.5, 0.2]).apply(mesh.vertices) * scale
    return jnp.asarray(turned + np.array([*place, depth]), jnp.float32), jnp.asarray(mesh.faces, jnp.int32)


def soup(seed):
    """Faces of all sizes, some behind the camera, some without area."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-10, SIZE + 10, (20, 2))
    depth = np.where(rng.random(20) < 0.1, -1, rng.uniform(1, 2, 20))
    faces = rng.integers(0, 20, (30, 3))
    return jnp.asarray(np.column_stack([xy, depth]), jnp.float32), jnp.asarray(faces, jnp.int32)


def padded(vertices, faces):
    """Add vertices and faces without area, so that all meshes share the compiled programs."""
    more_vertices, more_faces = VERTICES - len(vertices), FACES - len(faces)
    return jnp.pad(vertices, ((0, more_vertices), (0, 0)), "edge"), jnp.pad(faces, ((0, more_faces), (0, 0)))


VERTICES, FACES = 165, 321
"""Those of the largest ball and one face more."""
MESHES = {
    "ball": padded(*on_screen(trimesh.creation.icosphere(2))),
    "ball at the border": padded(*on_screen(trimesh.creation.icosphere(1), (2.0, 37.0))),
    "soup": padded(*soup(1)),
}


@functools.cache
def expected(name):
    """Image, pulled cotangent, losses and gradients of the reference."""
    return results(name, "reference")


def results(name, backend):
    vertices, faces = MESHES[name]
    random = np.random.default_rng(0)
    target = jnp.asarray(random.choice([0, 1, UNKNOWN, 255], (SIZE, SIZE)), jnp.uint8)
    cotangent = jnp.asarray(random.normal(size=(SIZE, SIZE)), jnp.float32)
    image, pulled = image_and_pull(vertices, faces, cotangent, SIZE, EDGE, backend)
    losses = [loss_and_gradient(vertices, faces, target, kind, EDGE, backend) for kind in ("l1", "smooth_l1")]
    return image, [pulled, *(gradient for _, gradient in losses)], [value for value, _ in losses]


@pytest.mark.parametrize("name", MESHES)
def test_kernels_and_reference_agree(name, native):
    image, gradients, losses = results(name, native)
    own_image, own_gradients, own_losses = expected(name)
    np.testing.assert_allclose(image, own_image, atol=5e-6)
    np.testing.assert_allclose(losses, own_losses, rtol=1e-5)
    for found, own in zip(gradients, own_gradients, strict=True):
        assert np.linalg.norm(found - own) <= 3e-4 * np.linalg.norm(own)


def test_huge_coordinates(native):
    """So far away, float32 does not place the edges of a face, but nothing breaks, and clamped vertices do not move."""
    vertices, faces = soup(2)
    target = jnp.zeros((SIZE, SIZE), jnp.uint8)
    for huge in (1e5, 1e9, -1e20, 3e38):
        far = vertices.at[0, 0].set(huge).at[4, 1].set(huge)
        value, gradient = loss_and_gradient(far, faces, target, "l1", EDGE, native)
        assert np.isfinite(value)
        assert np.all(np.isfinite(gradient))
        if abs(huge) > 2**20:
            assert gradient[0, 0] == gradient[4, 1] == 0


def area_and_perimeter(vertices, faces, fine=16):
    """Return the area (px²) and the perimeter (px) of a mesh, counted on a finer grid."""
    mask = hard_mask((vertices * np.array([fine, fine, 1])).astype(np.float32), faces, fine * SIZE, fine * SIZE)
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    # the staircase of the pixels is no part of the perimeter
    lengths = (cv2.arcLength(cv2.approxPolyDP(contour, 2, True), True) for contour in contours)
    return float(mask.sum()) / fine**2, sum(lengths) / fine


def test_the_silhouette_has_the_area_of_its_mesh(backend):
    """Also of a thin needle, and of a sheet from either side; the soft rasteriser adds 1.4 px around the needle."""
    ball, needle = trimesh.creation.icosphere(3), trimesh.creation.cone(0.05, 2.0)
    sheet = np.array([[10.0, 10, 1], [30, 12, 1], [28, 30, 1], [12, 33, 1]])
    x, y = sheet[:, 0], sheet[:, 1]
    area = 0.5 * abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))
    for turn in (slice(None), slice(None, None, -1)):
        faces = jnp.asarray(np.array([[0, 1, 2], [0, 2, 3]])[:, turn], jnp.int32)
        image = raster.silhouette(jnp.asarray(sheet, jnp.float32), faces, SIZE, blur=EDGE, backend=backend)
        assert image.sum() == pytest.approx(area, rel=1e-4)
    excess = {}
    for name, mesh in {"ball": ball, "needle": needle}.items():
        vertices, faces = (np.asarray(x) for x in on_screen(mesh))
        area, perimeter = area_and_perimeter(vertices, faces)
        for edge in ("unbiased", "soft_rasterizer"):
            image = raster.silhouette(vertices, faces, SIZE, blur=Blur(1.6, 4.0, edge), backend=backend)
            excess[name, edge] = (float(image.sum()) - area) / perimeter  # mean distance outside the mesh, pixels
    assert abs(excess["ball", "unbiased"]) < 0.02
    assert abs(excess["needle", "unbiased"]) < 0.05
    assert excess["needle", "soft_rasterizer"] > 0.5


def test_gradients_by_finite_differences(backend):
    """Of a body with few faces: a face that turns over at the outline gives the silhouette a kink."""
    vertices, faces = on_screen(trimesh.creation.icosphere(0))
    weights = jnp.asarray(np.random.default_rng(1).normal(size=(SIZE, SIZE)), jnp.float32)

    def total(xy):
        v = jnp.concatenate([xy, vertices[:, 2:]], axis=1)
        return jnp.sum(weights * raster.silhouette(v, faces, SIZE, blur=EDGE, backend=backend))

    check_grads(jax.jit(total), (vertices[:, :2],), 1, modes=["rev"], eps=1e-2, rtol=1e-2, atol=1e-2)


def test_unknown_pixels_count_nothing(backend):
    """What lies in unknown pixels changes neither the loss nor the gradient, also not through the filter."""
    vertices, faces = MESHES["ball"]
    mask = raster.silhouette(vertices, faces, SIZE, blur=EDGE, backend=backend) > 0.5
    right = np.arange(SIZE) >= 18
    hidden = jnp.where(right, UNKNOWN, mask.astype(jnp.uint8))
    blob = jnp.asarray([[26.0, 30, 1], [39, 31, 1], [34, 39, 1]])
    with_blob = vertices.at[-3:].set(blob), faces.at[-1].set(jnp.arange(VERTICES - 3, VERTICES))
    assert raster.silhouette(*with_blob, SIZE, blur=EDGE, backend=backend)[33, 33] > 0.9
    value, gradient = loss_and_gradient(vertices, faces, hidden, "smooth_l1", EDGE, backend)
    other, changed = loss_and_gradient(*with_blob, hidden, "smooth_l1", EDGE, backend)
    assert other == pytest.approx(float(value), rel=1e-5)
    np.testing.assert_allclose(changed[:-3], gradient[:-3], atol=1e-5)
    assert not np.any(changed[-3:])
    value, gradient = loss_and_gradient(vertices, faces, jnp.full_like(hidden, UNKNOWN), "l1", EDGE, backend)
    assert value == 0
    assert not np.any(gradient)


def test_broken_and_missing_meshes(backend):
    vertices, faces = MESHES["ball"]
    target = jnp.zeros((SIZE, SIZE), jnp.uint8)
    broken = vertices.at[3, 1].set(jnp.nan)
    value, gradient = loss_and_gradient(broken, faces, target, "l1", EDGE, backend)
    assert np.isnan(value)
    assert np.all(np.isnan(gradient[:, :2]))
    for some, chosen in ((vertices, faces[:0]), (vertices.at[:, 2].set(-1.0), faces), (vertices + 1000, faces)):
        value, gradient = loss_and_gradient(some, chosen, target, "l1", EDGE, backend)
        assert value == 0
        assert not np.any(gradient)


def test_an_unknown_edge_is_refused():
    with pytest.raises(ValueError, match="edge: expected one of"):
        Blur(1.0, 2.0, "sharp")
