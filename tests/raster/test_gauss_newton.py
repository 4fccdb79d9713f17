"""The Gauss-Newton block of the silhouette: JᵀJ with J from automatic differentiation of the reference."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.birds import toy_bird

from jaxfit.model.camera import CropCamera, to_screen
from jaxfit.model.kinematics import (
    Pose,
    fold_bird,
    joint_transforms,
    posed_vertices,
    shape_derivatives,
    shaped_vertices,
    transform_derivatives,
)
from jaxfit.raster import silhouette as raster
from jaxfit.raster import silhouette_reference

pytestmark = pytest.mark.usefixtures("optimised")

BIRD = toy_bird(subdivisions=1)  # few faces: the reference draws all of them for every parameter
RIG = fold_bird(BIRD)
SIZE = 40
BLUR = silhouette_reference.Blur(sigma=1.0, radius=3.0)
"""So sharp that all pixels of the band fit into the rows of the kernels."""
UNBIASED = silhouette_reference.Blur(sigma=1.0, radius=3.0, edge="unbiased")
PLACED = 3 * 8 + 4
"""Columns before the lengths of the bones: 8 joints, translation, scale."""


def pose_of(row) -> Pose:
    bones, betas = row[PLACED : PLACED + 7], row[PLACED + 7 :]
    return Pose(
        row[:3], row[3 : PLACED - 4].reshape(-1, 3), row[PLACED - 4 : PLACED - 1], row[PLACED - 1], bones, betas
    )


def row_of(transl=(0.3, -0.2, 180.0), seed=0):
    rng = np.random.default_rng(seed)
    angles = [1.2, 0.3, 0.5, *rng.normal(scale=0.2, size=21)]
    return jnp.asarray([*angles, *transl, 1.1, *np.linspace(0.9, 1.1, 7), 0.5, -0.3], jnp.float32)


@functools.partial(jax.jit, static_argnames="size")
def on_screen(row, size=SIZE):
    pose, ratio = pose_of(row), size / CropCamera().size_px
    screen = to_screen(posed_vertices(RIG, joint_transforms(RIG, pose), pose), CropCamera())
    return screen * jnp.array([ratio, ratio, 1.0])


@jax.jit
def skin_of(row):
    pose = pose_of(row)
    A, rest = joint_transforms(RIG, pose), shaped_vertices(RIG, pose).T
    slope = transform_derivatives(RIG, A, pose, with_bones=True)
    shapes = shape_derivatives(RIG, A, pose)
    return silhouette_reference.Skin(rest, RIG.vertex_joints, RIG.vertex_weights, slope, shapes)


def block(row, backend, weight=1.0, vertices=None, faces=RIG.faces, blur=BLUR, size=SIZE, target=None):
    vertices = on_screen(row, size) if vertices is None else vertices
    target = jnp.zeros((size, size), jnp.uint8) if target is None else target
    return compiled_block(vertices, faces, target, weight, skin_of(row), backend, blur)


@functools.partial(jax.jit, static_argnames=("backend", "blur"))
def compiled_block(vertices, faces, target, weight, skin, backend, blur):
    ratio = target.shape[0] / CropCamera().size_px
    camera_px = CropCamera().focal_px * ratio, CropCamera().centre_px * ratio
    return raster.mask_loss_and_block(vertices, faces, target, weight, skin, camera_px, blur=blur, backend=backend)[1]


@functools.partial(jax.jit, static_argnames="blur")
def by_autodiff(row, known, blur):
    """JᵀJ over the known pixels of the band, and their number; over all pixels for an edge that is filtered."""

    def image(row):
        empty = jnp.zeros((SIZE, SIZE))
        return silhouette_reference.difference(on_screen(row), RIG.faces, empty, known, blur)

    value, J = image(row), jax.jacfwd(image)(row)
    band = (value > 0.01) & (value < 0.99) & known
    counted = band | (blur.edge == "unbiased")
    return jnp.einsum("yxd,yxe->de", jnp.where(counted[..., None], J, 0.0), J), band.sum()


def test_transform_derivatives():
    def transforms(row):
        pose = pose_of(row)
        A = joint_transforms(RIG, pose)
        return jnp.concatenate([pose.scale * A[..., :3], (pose.scale * A[..., 3] + pose.transl)[..., None]], axis=-1)

    row = row_of()
    pose = pose_of(row)
    actual = transform_derivatives(RIG, joint_transforms(RIG, pose), pose, with_bones=True)
    expected = jax.jit(jax.jacfwd(transforms))(row)[..., : PLACED + 7]
    np.testing.assert_allclose(actual, expected, atol=1e-5 * np.abs(expected).max())


PLACES = {"inside": (0.3, -0.2, 180.0), "at the border": (9.0, 4.0, 180.0), "partly behind the camera": (0.0, 0.0, 3.5)}


@functools.cache
def expected_block(place, masked=False, blur=BLUR):
    """JᵀJ and the number of pixels of its band, by automatic differentiation."""
    known = random_target(SIZE) != silhouette_reference.UNKNOWN if masked else jnp.ones((SIZE, SIZE), bool)
    return by_autodiff(row_of(PLACES[place]), known, blur)


@pytest.mark.parametrize("blur", [BLUR, UNBIASED], ids=["soft_rasterizer", "unbiased"])
@pytest.mark.parametrize("place", PLACES)
def test_it_is_the_square_of_the_jacobian(backend, place, blur):
    expected, band = expected_block(place, blur=blur)
    assert band > 10
    assert band <= 256 or blur == UNBIASED
    found = block(row_of(PLACES[place]), backend, blur=blur)
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


def random_target(size):
    """A mask of background, bird and unknown pixels, and one other byte, which is bird."""
    values = [0, 1, silhouette_reference.UNKNOWN, 255]
    return jnp.asarray(np.random.default_rng(3).choice(values, (size, size)), jnp.uint8)


@pytest.mark.parametrize("blur", [BLUR, UNBIASED], ids=["soft_rasterizer", "unbiased"])
def test_unknown_pixels_have_no_curvature(backend, blur):
    row, target = row_of(), random_target(SIZE)
    expected, band = expected_block("inside", masked=True, blur=blur)
    assert 10 < band < 0.9 * expected_block("inside", blur=blur)[1]
    found = block(row, backend, target=target, blur=blur)
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())
    assert not np.any(block(row, backend, target=jnp.full_like(target, silhouette_reference.UNKNOWN), blur=blur))
    np.testing.assert_array_equal(block(row, backend, target=target == 1, blur=blur), block(row, backend, blur=blur))


@pytest.mark.parametrize("blur", [BLUR, UNBIASED], ids=["soft_rasterizer", "unbiased"])
@pytest.mark.parametrize("kind", ["l1", "smooth_l1"])
def test_loss_and_gradient_are_those_of_the_mask_loss(native, kind, blur):
    rows, weights, target = (
        jnp.stack([row_of(seed=n) for n in range(3)]),
        jnp.asarray([1.0, 0.0, 2.0]),
        random_target(SIZE),
    )
    camera_px = CropCamera().focal_px * SIZE / CropCamera().size_px, SIZE / 2
    settings = {"kind": kind, "blur": blur, "backend": native}

    def with_block(vertices, weight, row):
        return raster.mask_loss_and_block(vertices, RIG.faces, target, weight, skin_of(row), camera_px, **settings)[0]

    def alone(vertices, weight, _):
        return raster.mask_loss(vertices, RIG.faces, target, weight, **settings)

    vertices = jax.vmap(on_screen)(rows)
    found, expected = (
        jax.jit(jax.vmap(jax.value_and_grad(loss, argnums=(0, 1))))(vertices, weights, rows)
        for loss in (with_block, alone)
    )
    for own, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(own, other, atol=1e-6 * float(np.abs(other).max()))


def test_a_bird_outside_the_image_has_no_curvature(backend):
    assert not np.any(block(row_of((60.0, 0.0, 180.0)), backend))


def test_degenerate_faces_are_skipped(backend):
    row = row_of()
    more = jnp.concatenate([RIG.faces, jnp.asarray([[0, 0, 1], [5, 5, 5]], jnp.int32)])
    expected = block(row, backend)
    np.testing.assert_allclose(block(row, backend, faces=more), expected, atol=1e-5 * np.abs(expected).max())


def test_weights(backend):
    row = row_of()
    broken = jnp.full_like(on_screen(row), jnp.nan)
    np.testing.assert_allclose(block(row, backend, 2.5), 2.5 * block(row, backend), rtol=1e-6)
    assert not np.any(block(row, backend, 0.0, vertices=broken)), "an image of weight 0 is not rendered"
    assert np.isnan(block(row, backend, vertices=broken)).any()


def test_many_pixels_are_sampled_evenly(native):
    """With a wide band, the kernels sum over a part of the pixels, and scale the sum."""
    row, blur = row_of(), silhouette_reference.Blur(sigma=12.0, radius=12.0)
    image = raster.silhouette(on_screen(row, 64), RIG.faces, 64, blur=blur)
    assert ((image > 0.01) & (image < 0.99)).sum() > 2 * 256
    exact, sampled = (
        np.asarray(block(row, backend, blur=blur, size=64), np.float64) for backend in ("reference", native)
    )
    np.testing.assert_allclose(np.trace(sampled), np.trace(exact), rtol=0.1)
    assert np.linalg.norm(sampled - exact) < 0.15 * np.linalg.norm(exact)
    np.testing.assert_array_equal(sampled, sampled.T)


def test_a_batch_equals_single_images(native):
    rows = jnp.stack([row_of(seed=n) for n in range(3)])
    weights = jnp.asarray([1.0, 0.0, 2.0])
    together = jax.jit(jax.vmap(lambda row, weight: block(row, native, weight)))(rows, weights)
    for n in range(3):
        alone = block(rows[n], native, weights[n])
        np.testing.assert_allclose(together[n], alone, atol=1e-5 * max(float(np.abs(alone).max()), 1))


def test_without_kernels_a_batch_needs_the_memory_of_one_image():
    rows = jnp.stack([row_of(seed=n) for n in range(100)])
    program = jax.jit(jax.vmap(lambda row: block(row, "reference"))).lower(rows).compile()
    derivatives_of_all_images = 100 * rows.shape[1] * SIZE**2 * 4
    assert program.memory_analysis().temp_size_in_bytes < derivatives_of_all_images / 2


def test_wrong_arguments(native):
    row = row_of()
    with pytest.raises(ValueError, match=r"target: expected shape \(size, size\)"):
        block(row, native, target=jnp.zeros((3, 4), jnp.uint8))
    with pytest.raises(ValueError, match="target: expected bool or uint8, got float32"):
        block(row, native, target=jnp.zeros((SIZE, SIZE)))
    wrong = skin_of(row)._replace(joint=skin_of(row).joint + 100)
    with pytest.raises(Exception, match=r"joint: an index is not in \[0, 8\)"):
        compiled_block(on_screen(row), RIG.faces, random_target(SIZE), 1.0, wrong, native, BLUR).block_until_ready()


def test_the_rig_lists_the_joints_of_every_vertex():
    dense = np.zeros(np.shape(BIRD.skin_weights))
    np.put_along_axis(dense, np.asarray(RIG.vertex_joints), np.asarray(RIG.vertex_weights), axis=1)
    np.testing.assert_allclose(dense, BIRD.skin_weights, atol=1e-7)
    assert RIG.vertex_joints.shape[1] == 2, "no vertex of this bird has more joints"
