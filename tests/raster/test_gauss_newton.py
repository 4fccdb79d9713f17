"""The Gauss-Newton block of the silhouette: JᵀJ with J from automatic differentiation of the reference."""

import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.birds import tiny_bird

from jaxfit.model.camera import CropCamera, to_screen
from jaxfit.model.kinematics import (
    Pose,
    fold_bird,
    joint_transforms,
    moved_joints,
    posed_vertices,
    shaped_vertices,
    transform_generators,
)
from jaxfit.raster import silhouette as raster
from jaxfit.raster import silhouette_reference
from jaxfit.raster.silhouette_reference import UNKNOWN, Blur, Skin

BIRD = tiny_bird()
RIG = fold_bird(BIRD)
FACES = np.concatenate([RIG.faces, [[0, 0, 1], [5, 5, 5]]]).astype(np.int32)
"""With two faces without area, which do not count."""
SIZE = 40
SOFT = Blur(sigma=1.0, radius=3.0)
"""So sharp that all pixels of the band fit into the rows of the kernels."""
UNBIASED = Blur(sigma=1.0, radius=3.0, edge="unbiased")
edges = pytest.mark.parametrize("blur", [SOFT, UNBIASED], ids=["soft_rasterizer", "unbiased"])
PLACED = 3 * 4 + 4
"""Columns before the lengths of the bones: 4 joints, translation, scale."""
RATIO = SIZE / CropCamera().size_px
CAMERA_PX = CropCamera().focal_px * RATIO, CropCamera().centre_px * RATIO
EMPTY = np.zeros((SIZE, SIZE), np.uint8)
MASKED = np.random.default_rng(3).choice([0, 1, UNKNOWN, 255], (SIZE, SIZE)).astype(np.uint8)


def pose_of(row) -> Pose:
    bones, betas = row[PLACED : PLACED + 3], row[PLACED + 3 :]
    return Pose(
        row[:3], row[3 : PLACED - 4].reshape(-1, 3), row[PLACED - 4 : PLACED - 1], row[PLACED - 1], bones, betas
    )


def row_of(transl=(0.3, -0.2, 180.0), seed=0):
    angles = [1.2, 0.3, 0.5, *np.random.default_rng(seed).normal(scale=0.2, size=9)]
    return np.float32([*angles, *transl, 1.1, *np.linspace(0.9, 1.1, 3), 0.5, -0.3])


def on_screen(row):
    pose = pose_of(row)
    screen = to_screen(posed_vertices(RIG, joint_transforms(RIG, pose), pose), CropCamera())
    return screen * jnp.array([RATIO, RATIO, 1.0])


@jax.jit
def posed(row):
    """Return the vertices on the screen, and the skin."""
    pose = pose_of(row)
    A, rest = joint_transforms(RIG, pose), shaped_vertices(RIG, pose).T
    generators, moved = transform_generators(RIG, A, pose, with_bones=True), jnp.asarray(moved_joints(RIG, True))
    factors = pose.scale * A, generators, moved, jnp.eye(3), RIG.shape_basis.transpose(2, 1, 0)
    return on_screen(row), Skin(rest, RIG.vertex_joints, RIG.vertex_weights, *factors)


@functools.partial(jax.jit, static_argnames="blur")
def by_kernel(vertices, target, weight, skin, blur):
    return raster.mask_loss_and_block(vertices, FACES, target, weight, skin, CAMERA_PX, blur=blur, backend="native")[1]


@functools.partial(jax.jit, static_argnames="edge")
def by_reference(vertices, target, weight, skin, sigma, radius, edge):
    blur = UNBIASED if edge == "unbiased" else SimpleNamespace(sigma=sigma, radius=radius, edge=edge)
    own = silhouette_reference.silhouette_gauss_newton(vertices, FACES, target, weight, skin, CAMERA_PX, blur)
    return weight * own


def block(row, backend, weight=1.0, vertices=None, blur=SOFT, target=EMPTY):
    on, skin = posed(row)
    operands = on if vertices is None else vertices, target, np.float32(weight), skin
    if backend == "native":
        return np.asarray(by_kernel(*operands, blur))
    return np.asarray(by_reference(*operands, np.float32(blur.sigma), np.float32(blur.radius), blur.edge))


@functools.partial(jax.jit, static_argnames="blur")
def by_autodiff(row, known, blur):
    """JᵀJ over the known pixels of the band, and their number; over all pixels for an edge that is filtered."""

    def image(row):
        return silhouette_reference.difference(on_screen(row), RIG.faces, jnp.zeros((SIZE, SIZE)), known, blur)

    value, J = image(row), jax.jacfwd(image)(row)
    band = (value > 0.01) & (value < 0.99) & known
    counted = band | (blur.edge == "unbiased")
    return jnp.einsum("yxd,yxe->de", jnp.where(counted[..., None], J, 0.0), J), band.sum()


PLACES = {"inside": (0.3, -0.2, 180.0), "at the border": (9.0, 4.0, 180.0), "partly behind the camera": (0.0, 2.0, 2.0)}


@functools.cache
def expected_block(place, masked=False, blur=SOFT):
    """JᵀJ and the number of pixels of its band, by automatic differentiation."""
    return by_autodiff(row_of(PLACES[place]), (MASKED if masked else EMPTY) != UNKNOWN, blur)


@edges
@pytest.mark.parametrize("place", PLACES)
def test_it_is_the_square_of_the_jacobian(backend, place, blur):
    expected, band = expected_block(place, blur=blur)
    assert band > 10
    assert band <= 256 or blur == UNBIASED
    found = block(row_of(PLACES[place]), backend, blur=blur)
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


@edges
def test_unknown_pixels_have_no_curvature(backend, blur):
    expected, band = expected_block("inside", masked=True, blur=blur)
    assert 10 < band < 0.9 * expected_block("inside", blur=blur)[1]
    found = block(row_of(), backend, target=MASKED, blur=blur)
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())
    assert not np.any(block(row_of(), backend, target=np.full_like(MASKED, UNKNOWN), blur=blur))


@pytest.mark.parametrize("backend", ["native", "reference"])
@pytest.mark.parametrize("blur", [SOFT, UNBIASED], ids=["soft_rasterizer", "unbiased"])
def test_loss_and_gradient_are_those_of_the_mask_loss(backend, blur):
    """In a batch, with weights, for both kinds of losses."""
    rows, weights = np.stack([row_of(seed=n) for n in range(3)]), np.float32([1.0, 0.0, 2.0])
    vertices, skins = jax.vmap(posed)(rows)
    for kind in ("l1", "smooth_l1") if backend == "native" else ("l1",)[blur == UNBIASED :]:
        settings = {"kind": kind, "blur": blur}

        def with_block(vertices, weight, skin, settings=settings):
            found = raster.mask_loss_and_block(
                vertices, FACES, MASKED, weight, skin, CAMERA_PX, backend=backend, **settings
            )
            return found[0]

        def alone(vertices, weight, _, settings=settings):
            return raster.mask_loss(vertices, FACES, MASKED, weight, backend="native", **settings)

        found, expected = (
            jax.jit(jax.vmap(jax.value_and_grad(loss, argnums=(0, 1))))(vertices, weights, skins)
            for loss in (with_block, alone)
        )
        for own, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            accuracy = 1e-6 if backend == "native" else 1e-4
            np.testing.assert_allclose(own, other, atol=accuracy * float(np.abs(other).max()))


def test_a_bird_outside_the_image_has_no_curvature(backend):
    assert not np.any(block(row_of((60.0, 0.0, 180.0)), backend))


def test_weights(backend):
    row, broken = row_of(), np.full((len(BIRD.vertices), 3), np.nan, np.float32)
    np.testing.assert_allclose(block(row, backend, 2.5), 2.5 * block(row, backend), rtol=1e-6)
    assert not np.any(block(row, backend, 0.0, vertices=broken)), "an image of weight 0 is not rendered"
    assert np.isnan(block(row, backend, vertices=broken)).any()


def test_many_pixels_are_sampled_evenly(native):
    """With a wide band, the kernels sum over a part of the pixels, and scale the sum."""
    row, blur = row_of((0.3, -0.2, 120.0)), Blur(sigma=12.0, radius=12.0)
    image = np.asarray(raster.silhouette(posed(row)[0], FACES, SIZE, blur=blur))
    assert ((image > 0.01) & (image < 0.99)).sum() > 2 * 256
    exact, sampled = (block(row, each, blur=blur).astype(np.float64) for each in ("reference", native))
    np.testing.assert_allclose(np.trace(sampled), np.trace(exact), rtol=0.1)
    assert np.linalg.norm(sampled - exact) < 0.15 * np.linalg.norm(exact)
    np.testing.assert_array_equal(sampled, sampled.T)


def test_a_batch_equals_single_images(native):
    vertices, skins = jax.vmap(posed)(np.stack([row_of(seed=n) for n in range(3)]))
    weights = np.float32([1.0, 0.0, 2.0])
    together = jax.jit(jax.vmap(lambda *of: by_kernel(of[0], EMPTY, *of[1:], SOFT)))(vertices, weights, skins)
    for n in range(3):
        alone = block(row_of(seed=n), native, weights[n])
        np.testing.assert_allclose(together[n], alone, atol=1e-5 * max(float(np.abs(alone).max()), 1))


def test_without_kernels_a_batch_needs_the_memory_of_one_image():
    def of_one_image(vertices, skin):
        return raster.mask_loss_and_block(vertices, FACES, EMPTY, 1.0, skin, CAMERA_PX, blur=SOFT, backend="reference")

    rows = np.stack([row_of(seed=n) for n in range(100)])
    program = jax.jit(jax.vmap(of_one_image)).lower(*jax.vmap(posed)(rows)).compile()
    derivatives_of_all_images = 100 * rows.shape[1] * SIZE**2 * 4
    assert program.memory_analysis().temp_size_in_bytes < derivatives_of_all_images / 2


def test_wrong_arguments(native):
    with pytest.raises(ValueError, match=r"target: expected shape \(size, size\)"):
        block(row_of(), native, target=np.zeros((3, 4), np.uint8))
    with pytest.raises(ValueError, match="target: expected bool or uint8, got float32"):
        block(row_of(), native, target=EMPTY.astype(np.float32))
    np.testing.assert_array_equal(block(row_of(), native, target=EMPTY == 1), block(row_of(), native))
    vertices, skin = posed(row_of())
    wrong = skin._replace(joint=skin.joint + 100)
    with pytest.raises(Exception, match=r"joint: an index is not in \[0, 4\)"):
        by_kernel(vertices, MASKED, np.float32(1.0), wrong, SOFT).block_until_ready()


def test_derivatives_and_weights_of_the_rig():
    def transforms(row):
        pose = pose_of(row)
        A = joint_transforms(RIG, pose)
        return jnp.concatenate([pose.scale * A[..., :3], (pose.scale * A[..., 3] + pose.transl)[..., None]], axis=-1)

    expected = jax.jit(jax.jacfwd(transforms))(row_of())[..., : PLACED + 3]
    skin = posed(row_of())[1]
    B = np.pad(skin.transforms, ((0, 0), (0, 1), (0, 0))) + np.diag([0, 0, 0, 1])
    found = np.einsum("jp,icp,jcd->jidp", skin.moved, skin.generators, B)
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())
    dense = np.zeros(np.shape(BIRD.skin_weights))
    np.put_along_axis(dense, np.asarray(RIG.vertex_joints), np.asarray(RIG.vertex_weights), axis=1)
    np.testing.assert_allclose(dense, BIRD.skin_weights, atol=1e-7)
    assert RIG.vertex_joints.shape[1] == 2, "no vertex of this bird has more joints"
