"""The compiled kernels against the plain JAX reference, on every instruction set."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxfit.raster import kernels, silhouette_reference
from jaxfit.raster import silhouette as raster
from jaxfit.raster.silhouette_reference import Blur

ISAS = kernels.available_isas()
needs_kernels = pytest.mark.skipif(not ISAS, reason="built without the kernels")


@pytest.fixture(params=["avx512", "avx2", "baseline"])
def each_isa(request):
    """Runs the test once an instruction set."""
    if request.param not in ISAS:
        pytest.skip(f"no {request.param} kernels here: {ISAS}")
    kernels.choose_isa(request.param)
    yield request.param
    kernels.choose_isa("auto")


def random_mesh(seed, faces=24, size=64, spread=1.2):
    """Vertices over and around the image, depths of which some lie behind the camera; faces of all sizes."""
    rng = np.random.default_rng(seed)
    centres = rng.uniform(0.5 - spread / 2, 0.5 + spread / 2, (faces, 1, 2)) * size
    corners = centres + rng.normal(size=(faces, 3, 2)) * size * rng.choice([0.01, 0.05, 0.3, 2.0], (faces, 1, 1))
    depth = rng.uniform(1, 2, (faces, 3, 1)) * np.where(rng.random((faces, 3, 1)) < 0.03, -1, 1)
    vertices = np.concatenate([corners, depth], -1).reshape(-1, 3).astype(np.float32)
    triples = np.arange(3 * faces, dtype=np.int32).reshape(-1, 3)
    triples[rng.random(faces) < 0.1, 2] = 0  # far-flung faces
    triples[rng.random(faces) < 0.05, 1] = triples[0, 0]
    same = rng.random(faces) < 0.05
    triples[same, 2] = triples[same, 1]  # no area
    return jnp.asarray(vertices), jnp.asarray(triples)


def random_target(seed, size, dtype):
    rng = np.random.default_rng(seed)
    if dtype == np.float32:
        return jnp.asarray(rng.random((size, size), np.float32))
    values = [False, True] if dtype is bool else [0, 1, silhouette_reference.UNKNOWN, 255]
    return jnp.asarray(rng.choice(values, (size, size)), dtype)


# Compiled once for all meshes and instruction sets.
@functools.partial(jax.jit, static_argnames=("size", "blur", "backend"))
def image_and_pull(vertices, faces, cotangent, size, blur, backend):
    image, pull = jax.vjp(lambda v: raster.silhouette(v, faces, size, blur=blur, backend=backend), vertices)
    return image, pull(cotangent)[0]


@functools.partial(jax.jit, static_argnames=("kind", "blur", "backend"))
def loss_of(vertices, faces, target, kind="l1", blur=None, backend="native"):
    return raster.mask_loss(vertices, faces, target, kind=kind, blur=blur, backend=backend)


loss_and_gradient_of = jax.jit(jax.value_and_grad(loss_of), static_argnames=("kind", "blur", "backend"))


def assert_close_gradients(found, expected, tolerance):
    assert np.all(np.isfinite(found))
    assert np.all(found[:, 2] == 0)
    # Where an image is nearly all covered, what the kernels leave out of its saturated pixels shows.
    assert np.linalg.norm(found - expected) <= tolerance * np.linalg.norm(expected) + 1e-3


def agree(vertices, faces, target, kind="l1", blur=None):
    """Checks every kernel against the reference; returns the loss's gradient."""
    size = target.shape[0]
    # The smaller the image, the sharper its edges, and the more a corner's last bit shows.
    sharpness = max(1.0, 256 / size)
    cotangent = jax.random.normal(jax.random.key(0), (size, size))
    found, expected = (image_and_pull(vertices, faces, cotangent, size, blur, b) for b in ("native", "reference"))
    np.testing.assert_allclose(found[0], expected[0], atol=4e-5 * sharpness)
    assert_close_gradients(found[1], expected[1], 5e-5 * sharpness)

    found, expected = (
        loss_and_gradient_of(vertices, faces, target, kind=kind, blur=blur, backend=b) for b in ("native", "reference")
    )
    assert found[0] == pytest.approx(float(expected[0]), rel=2e-5, abs=1e-3)
    assert found[0] == loss_of(vertices, faces, target, kind=kind, blur=blur)
    assert_close_gradients(found[1], expected[1], 5e-5 * sharpness)
    return found[1]


@pytest.mark.parametrize(
    ("seed", "size", "kind", "dtype"),
    [
        (0, 64, "l1", np.uint8),
        pytest.param(1, 100, "smooth_l1", np.float32, marks=pytest.mark.extended),
        (2, 3, "l1", bool),
        pytest.param(3, 37, "smooth_l1", np.uint8, marks=pytest.mark.extended),
    ],
)
def test_random_meshes(each_isa, seed, size, kind, dtype):
    vertices, faces = random_mesh(seed, size=size)
    agree(vertices, faces, random_target(seed, size, dtype), kind)


@needs_kernels
@settings(max_examples=25, deadline=None, derandomize=True)
@given(st.integers(0, 2**31), st.sampled_from(ISAS or ("none",)))
def test_any_mesh(seed, isa):
    kernels.choose_isa(isa)
    try:
        vertices, faces = random_mesh(seed)  # of the same size as other tests, which compiled its programs
        agree(vertices, faces, random_target(seed, 64, np.uint8))
    finally:
        kernels.choose_isa("auto")


@pytest.mark.parametrize("blur", [Blur(0.05, 0.7), Blur(30.0, 15.0), Blur(1.0, 60.0)])
def test_other_blurs(each_isa, blur):
    vertices, faces = random_mesh(5)
    agree(vertices, faces, random_target(5, 64, np.uint8), blur=blur)


def test_many_small_faces_that_share_vertices(each_isa):
    grid = np.stack(np.meshgrid(np.linspace(8, 30, 20), np.linspace(36, 61, 15)), -1).reshape(-1, 2)
    grid = grid + np.random.default_rng(0).normal(size=grid.shape) * 0.3
    corner = (np.arange(14)[:, None] * 20 + np.arange(19)).reshape(-1, 1)
    faces = np.concatenate([corner + np.array([0, 1, 20]), corner + np.array([1, 21, 20])])
    vertices = jnp.asarray(np.concatenate([grid, np.ones((len(grid), 1))], 1), jnp.float32)
    agree(vertices, jnp.asarray(faces, jnp.int32), random_target(0, 64, np.uint8))


def test_faces_that_cannot_be_seen(each_isa):
    corners = jnp.asarray([[8.0, 8, 1], [32, 16, 1], [16, 28, 1]])
    faces = jnp.asarray([[0, 1, 2]], jnp.int32)
    blank = jnp.zeros((40, 40), jnp.uint8)
    cases = {
        "behind the camera": corners.at[1, 2].set(-1.0),
        "at the camera": corners.at[1, 2].set(1e-8),
        "outside": corners.at[:, 0].add(500.0),
        "just outside": corners.at[:, 0].add(-33.0),
        "two equal corners": corners.at[2].set(corners[1]),
        "a line": corners.at[2].set((corners[0] + corners[1]) / 2),
        "no faces": None,
    }
    for name, vertices in cases.items():
        some, chosen = (corners, faces[:0]) if vertices is None else (vertices, faces)
        for backend in ("native", "reference"):
            image, pulled = image_and_pull(some, chosen, jnp.ones((40, 40)), 40, None, backend)
            assert np.all(image == 0), (name, backend)
            assert np.all(pulled == 0), (name, backend)
            value, gradient = loss_and_gradient_of(some, chosen, blank, backend=backend)
            assert value == 0, (name, backend)
            assert np.all(gradient == 0), (name, backend)
    assert raster.silhouette(corners, faces, 40, backend="native").max() > 0.99


def test_area_below_which_a_face_is_skipped(each_isa):
    # |2·area| ≤ 1e-8 (size/2)² = 1e-4 px² at size 200.
    for area, seen in ((0.99e-4, False), (1.01e-4, True)):
        # At y = 0, where so small a height is not rounded away.
        vertices = jnp.asarray([[90.5, 0, 1], [100.5, 0, 1], [95.5, area / 10, 1]], jnp.float32)
        for backend in ("native", "reference"):
            image = raster.silhouette(vertices, jnp.asarray([[0, 1, 2]]), 200, backend=backend)
            assert (image.max() > 0) == seen, (area, backend)


def test_a_coordinate_that_is_not_finite_makes_everything_nan(each_isa):
    vertices, faces = random_mesh(6)
    target = random_target(6, 64, np.uint8)
    for bad, place in itertools.product((np.nan, np.inf, -np.inf), ((0, 0), (4, 1), (7, 2))):
        broken = vertices.at[place].set(bad)
        for backend in ("native", "reference"):
            value, gradient = loss_and_gradient_of(broken, faces, target, backend=backend)
            assert np.isnan(value)
            assert np.all(np.isnan(gradient[:, :2]))
            assert np.all(gradient[:, 2] == 0)
            image, pulled = image_and_pull(broken, faces, jnp.zeros((64, 64)), 64, None, backend)
            assert np.all(np.isnan(image))
            assert np.all(np.isnan(pulled[:, :2]))
        assert np.isnan(loss_of(broken, faces, target))


def test_huge_coordinates(each_isa):
    # A vertex so far away costs float32 the place of its face's edges, but nothing may break.
    mesh, faces = random_mesh(7)
    target = random_target(7, 64, np.uint8)
    for huge in (1e4, 1e5, 1e9, 1e20, -1e20, 3e38):
        vertices = mesh.at[0, 0].set(huge).at[4, 1].set(huge)
        results = [loss_and_gradient_of(vertices, faces, target, backend=b) for b in ("native", "reference")]
        (value, gradient), (expected, own) = jax.tree.map(np.asarray, results)
        assert value == pytest.approx(float(expected), rel=1e-3), huge
        assert np.all(np.isfinite(gradient)), huge
        assert np.all(np.isfinite(own)), huge
        if abs(huge) > 2**20:
            assert gradient[0, 0] == own[0, 0] == 0, huge
            assert gradient[4, 1] == own[4, 1] == 0, huge


def test_results_do_not_depend_on_threads_or_company(each_isa):
    meshes = [random_mesh(seed, faces=60, size=64) for seed in range(9)]
    vertices, faces = jnp.stack([v for v, _ in meshes]), jnp.stack([f for _, f in meshes])
    target = random_target(0, 64, np.uint8)

    def loss(v, f):
        return raster.mask_loss(v, f, target, backend="native")

    together = jax.jit(jax.vmap(jax.value_and_grad(loss)))
    first = together(vertices, faces)
    for _ in range(3):
        again = together(vertices, faces)
        np.testing.assert_array_equal(again[0], first[0])
        np.testing.assert_array_equal(again[1], first[1])
    for i in range(9):
        value, gradient = jax.value_and_grad(loss)(vertices[i], faces[i])
        assert value == first[0][i]
        np.testing.assert_array_equal(gradient, first[1][i])


@needs_kernels
def test_an_index_out_of_range_is_an_error():
    vertices, faces = random_mesh(0, faces=4)
    for bad in (12, -1):
        with pytest.raises(Exception, match="faces: an index is not in"):
            raster.silhouette(vertices, faces.at[2, 1].set(bad), 16, backend="native").block_until_ready()


@needs_kernels
@pytest.mark.parametrize("platform", ["cpu", "cuda"])
def test_only_the_cpu_program_holds_the_call(platform, monkeypatch):
    """On a machine with a second platform; where the CPU is alone, the reference is not even traced."""
    monkeypatch.setattr(jax, "default_backend", lambda: "cuda")
    vertices, faces = random_mesh(0, faces=4)
    gradient = jax.jit(jax.grad(lambda v: raster.mask_loss(v, faces, jnp.zeros((16, 16), bool))))
    checks = [jax.export.DisabledSafetyCheck.custom_call("jaxfit_mask_loss_and_gradient")]
    exported = jax.export.export(gradient, platforms=[platform], disabled_checks=checks)(vertices).mlir_module()
    assert ("jaxfit_mask_loss_and_gradient" in exported) == (platform == "cpu")


@needs_kernels
def test_the_gradient_of_a_mean_is_not_negligible():
    """The kernels leave out blocks whose gradient is small beside the greatest one, not those of a small loss."""
    vertices, faces = random_mesh(0)  # of the same size as other tests, which compiled its program
    pulls = [image_and_pull(vertices, faces, jnp.full((64, 64), c), 64, None, "native")[1] for c in (1.0, 2.0**-30)]
    assert np.any(pulls[0])
    np.testing.assert_allclose(pulls[1] * 2.0**30, pulls[0], rtol=1e-6)


@needs_kernels
def test_without_differentiation_only_the_loss_is_computed():
    vertices, faces = random_mesh(0, faces=4)

    def loss(v):
        return raster.mask_loss(v, faces, jnp.zeros((16, 16), bool))

    assert "gradient" not in jax.jit(loss).lower(vertices).as_text()
    once = jax.jit(jax.value_and_grad(loss)).lower(vertices).compile().as_text()
    assert once.count('custom_call_target="jaxfit_mask_loss') == 1
