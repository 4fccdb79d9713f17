"""The operations: batching, gradients, weights and what they refuse."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxfit.raster import kernels, silhouette_reference
from jaxfit.raster import silhouette as raster

SIZE = 32
BACKENDS = ["reference"] + (["native"] if kernels.kernels_available() else [])
FACES = jnp.asarray([[0, 1, 2], [2, 1, 3], [0, 3, 4]], jnp.int32)


def quad(seed=0):
    rng = np.random.default_rng(seed)
    corners = np.array([[6.0, 7, 1], [25, 9, 1], [8, 24, 1], [23, 22, 2], [1, 27, 1]])
    return jnp.asarray(corners + rng.normal(size=corners.shape) * [1, 1, 0], jnp.float32)


def mask(seed=0):
    return jnp.asarray(np.random.default_rng(seed).random((SIZE, SIZE)) < 0.5)


@pytest.mark.parametrize("backend", BACKENDS)
def test_silhouette_by_hand(backend):
    # One face whose edge runs along x = 8: the pixel at 8 + n/2 lies n/2 from it, on the outside.
    vertices = jnp.asarray([[8.0, -40, 1], [8.0, 60, 1], [-60.0, 10, 1]])
    blur = silhouette_reference.Blur(sigma=2.0, radius=2.0)
    image = raster.silhouette(vertices, jnp.asarray([[0, 1, 2]]), 20, blur=blur, backend=backend)
    d = np.array([-2.25, -0.25, 0.25, 2.25])  # squared distances of the pixels 6 to 9, signed
    np.testing.assert_allclose(image[10, 6:10], 1 / (1 + np.exp(d / 2.0)), rtol=1e-4)
    assert np.all(image[:, 10:] == 0)  # 2.5 px and more is beyond the radius
    assert image.dtype == jnp.float32


@pytest.mark.parametrize("backend", BACKENDS)
def test_loss_by_hand(backend):
    target = jax.random.uniform(jax.random.key(1), (SIZE, SIZE))
    image = np.asarray(raster.silhouette(quad(), FACES, SIZE, backend=backend), np.float64)
    e = np.abs(image - np.asarray(target))
    for kind, expected in (("l1", e.sum()), ("smooth_l1", np.where(e < 1, 0.5 * e**2, e - 0.5).sum())):
        loss = raster.mask_loss(quad(), FACES, target, 1.5, kind=kind, backend=backend)
        assert loss == pytest.approx(1.5 * expected, rel=1e-5), kind


@pytest.mark.parametrize("backend", BACKENDS)
def test_gradients_by_finite_differences(backend):
    # Smooth: a wide blur whose radius is beyond every pixel, and a target that no pixel crosses.
    blur = silhouette_reference.Blur(sigma=25.0, radius=100.0)
    middle = jnp.asarray([[12.0, 13, 1], [20, 12.5, 1], [15, 21, 1]])

    weights = jnp.linspace(0, 1, SIZE)[:, None] * jnp.linspace(1, 0.3, SIZE)

    def on_xy(function):
        return jax.jit(lambda xy: function(jnp.concatenate([xy, middle[:, 2:]], 1)))

    def image(v):
        return raster.silhouette(v, FACES[:1], SIZE, blur=blur, backend=backend)

    def loss(kind, value):
        target = jnp.full((SIZE, SIZE), value)
        return lambda v: raster.mask_loss(v, FACES[:1], target, kind=kind, blur=blur, backend=backend)

    checked = [loss("l1", 0.0), loss("l1", 1.0), loss("smooth_l1", 0.3), lambda v: jnp.sum(weights * image(v))]
    # JAX derives the reference's gradients; one loss and the image, which share all of its code, do for it.
    for function in checked if backend == "native" else (checked[2], checked[3]):
        check_grads(on_xy(function), (middle[:, :2],), 1, modes=["rev"], eps=0.05, rtol=1e-2, atol=1e-2)


@pytest.mark.parametrize("backend", BACKENDS)
def test_batches_equal_single_images(backend):
    vertices = jnp.stack([jnp.stack([quad(3 * i + j) for j in range(3)]) for i in range(2)])  # (2, 3, V, 3)
    targets = jnp.stack([mask(j) for j in range(3)])  # shared by the outer batch
    weights = jnp.asarray([2.0, 0.5])  # shared by the inner batch
    faces = jnp.stack([FACES, FACES[::-1]])

    def loss(v, f, t, w):
        return raster.mask_loss(v, f, t, w, backend=backend)

    def over_frames(function, faces_axis=None):
        return jax.vmap(function, in_axes=(0, faces_axis, 0, None))

    nested = jax.jit(jax.vmap(over_frames(jax.value_and_grad(loss)), in_axes=(0, None, None, 0)))
    values, gradients = nested(vertices, FACES, targets, weights)
    own_faces = jax.jit(jax.vmap(over_frames(loss), in_axes=(0, 0, None, 0)))(vertices, faces, targets, weights)

    def total(vertices):
        each = jax.vmap(over_frames(loss), in_axes=(0, None, None, 0))(vertices, FACES, targets, weights)
        return jnp.sum(each * jnp.arange(6.0).reshape(2, 3))

    of_total = jax.jit(jax.grad(total))(vertices)
    single = jax.jit(jax.value_and_grad(loss))
    for i in range(2):
        for j in range(3):
            arguments = (vertices[i, j], FACES, targets[j], weights[i])
            value, gradient = single(*arguments)
            assert values[i, j] == pytest.approx(float(value), rel=1e-6)
            np.testing.assert_allclose(gradients[i, j], gradient, rtol=1e-5, atol=1e-6)
            np.testing.assert_allclose(of_total[i, j], (3 * i + j) * gradient, rtol=1e-5, atol=1e-5)
            own = single(vertices[i, j], faces[i], *arguments[2:])[0]
            assert own_faces[i, j] == pytest.approx(float(own), rel=1e-6)


@pytest.mark.parametrize("backend", BACKENDS)
def test_batches_of_images_and_of_their_gradients(backend):
    vertices = jnp.stack([quad(i) for i in range(3)])
    cotangents = jax.random.normal(jax.random.key(0), (2, SIZE, SIZE))

    def image_of(v):
        return raster.silhouette(v, FACES, SIZE, backend=backend)

    @jax.jit
    def pull(v, c):
        return jax.vjp(image_of, v)[1](c)[0]

    images = jax.jit(jax.vmap(image_of))(vertices)
    pulled = jax.vmap(jax.vmap(pull, in_axes=(None, 0)), in_axes=(0, None))(vertices, cotangents)
    for i in range(3):
        np.testing.assert_allclose(images[i], jax.jit(image_of)(vertices[i]), atol=1e-6)
        for j in range(2):
            np.testing.assert_allclose(pulled[i, j], pull(vertices[i], cotangents[j]), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("backend", BACKENDS)
def test_weight(backend):
    def loss(v, w):
        return raster.mask_loss(v, FACES, mask(), w, backend=backend)

    both = jax.jit(jax.value_and_grad(loss, argnums=(0, 1)))
    one, (gradient, _) = both(quad(), 1.0)
    three, by_weight = both(quad(), 3.0)
    assert three == pytest.approx(3 * float(one))
    np.testing.assert_allclose(by_weight[0], 3 * gradient, rtol=1e-5)
    assert by_weight[1] == pytest.approx(float(one))

    for vertices in (quad(), quad().at[0, 0].set(jnp.nan)):
        value, gradients = both(vertices, 0.0)
        assert value == 0
        assert np.all(gradients[0] == 0)
        assert gradients[1] == 0


@pytest.mark.parametrize("backend", BACKENDS)
def test_other_bytes_are_inside(backend):
    losses = {
        float(raster.mask_loss(quad(), FACES, mask().astype(dtype) * factor, backend=backend))
        for dtype, factor in ((bool, True), (jnp.uint8, 1), (jnp.uint8, 255), (jnp.float32, 1))
    }
    assert max(losses) - min(losses) <= 1e-3
    assert min(losses) > 100


@pytest.mark.parametrize("kind", ["l1", "smooth_l1"])
@pytest.mark.parametrize("backend", BACKENDS)
def test_unknown_pixels_cost_nothing(backend, kind):
    target = mask().astype(jnp.uint8)
    known = np.random.default_rng(4).random((SIZE, SIZE)) < 0.6
    both = jax.jit(jax.value_and_grad(lambda v, t: raster.mask_loss(v, FACES, t, kind=kind, backend=backend)))

    def by_hand(vertices):
        e = jnp.abs(raster.silhouette(vertices, FACES, SIZE, backend="reference") - target)[known]
        return jnp.sum(e if kind == "l1" else 0.5 * e**2)

    value, gradient = both(quad(), jnp.where(known, target, silhouette_reference.UNKNOWN))
    expected = jax.jit(jax.value_and_grad(by_hand))(quad())
    assert value == pytest.approx(float(expected[0]), rel=1e-4)
    np.testing.assert_allclose(gradient, expected[1], rtol=1e-3, atol=1e-3 * np.abs(expected[1]).max())
    nothing = both(quad(), jnp.full_like(target, silhouette_reference.UNKNOWN))
    assert nothing[0] == 0
    assert not np.any(nothing[1])


@pytest.mark.parametrize("backend", BACKENDS)
def test_empty_and_full_masks_and_a_bird_out_of_the_frame(backend):
    both = jax.jit(jax.value_and_grad(lambda v, t: raster.mask_loss(v, FACES, t, backend=backend)))
    for target in (jnp.zeros((SIZE, SIZE), bool), jnp.ones((SIZE, SIZE), bool)):
        value, gradient = both(quad(), target)
        assert value > 0
        assert np.all(np.isfinite(gradient))
        assert np.any(gradient[:, :2] != 0)
        value, gradient = both(quad().at[:, 0].add(1000.0), target)
        assert value == target.sum()
        assert np.all(gradient == 0)


@pytest.mark.parametrize("backend", BACKENDS)
def test_orientation_and_order_of_the_faces_do_not_matter(backend):
    expected = raster.silhouette(quad(), FACES, SIZE, backend=backend)
    for faces in (FACES[:, ::-1], FACES[::-1], FACES[:, jnp.asarray([1, 2, 0])]):
        np.testing.assert_allclose(raster.silhouette(quad(), faces, SIZE, backend=backend), expected, atol=2e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"vertices_screen": jnp.zeros((4, 2))}, r"vertices_screen: expected shape \(V, 3\), got \(4, 2\)"),
        ({"vertices_screen": jnp.zeros((4, 3), int)}, "vertices_screen: expected floats"),
        ({"faces": jnp.zeros((4, 4), int)}, r"faces: expected shape \(F, 3\), got \(4, 4\)"),
        ({"faces": jnp.zeros((4, 3))}, "faces: expected integers"),
        ({"target": jnp.zeros((4, 5), bool)}, r"target: expected shape \(size, size\), got \(4, 5\)"),
        ({"target": jnp.zeros((4, 4), int)}, "target: expected bool, uint8 or floats"),
        ({"weight": jnp.ones(2)}, r"weight: expected a scalar, got shape \(2,\)"),
        ({"kind": "l2"}, "kind: expected one of"),
        ({"backend": "gpu"}, "backend: expected one of"),
    ],
)
def test_wrong_arguments_are_named(change, message):
    arguments = {"vertices_screen": quad(), "faces": FACES, "target": mask()} | change
    with pytest.raises(ValueError, match=message):
        raster.mask_loss(**arguments)


def test_wrong_sizes_and_blurs_are_named():
    for size in (0, -1, 2.5, True, 2**14 + 1):
        with pytest.raises(ValueError, match="size: expected an integer"):
            raster.silhouette(quad(), FACES, size)
    for sigma, radius, name in ((0, 1, "sigma"), (-1, 1, "sigma"), (np.nan, 1, "sigma"), (1, -1, "radius")):
        with pytest.raises(ValueError, match=name):
            silhouette_reference.Blur(sigma, radius)
