"""Rotations: axis-angles, matrices, quaternions, distances between rotations, and grids over SO(3)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def axis_angle_to_matrix(axis_angle: Float[Array, "*B 3"]) -> Float[Array, "*B 3 3"]:
    """Return the rotation matrices of axis-angles in radians (Rodrigues), differentiable at zero rotation.

    R = I + a·[r]× + b·[r]×², a = sin θ/θ, b = (1 − cos θ)/θ².
    """
    a, b, _ = _rodrigues(axis_angle)
    return _cross_polynomial(axis_angle, a, b)


def right_jacobian(axis_angle: Float[Array, "*B 3"]) -> Float[Array, "*B 3 3"]:
    """Return the right Jacobian Jr of axis-angles r, with R(r + dr) = R(r)·R(Jr(r)·dr) to first order.

    Jr = I − b·[r]× + c·[r]×², b = (1 − cos θ)/θ², c = (θ − sin θ)/θ³.

    Source: Solà et al. 2018, A micro Lie theory for state estimation in robotics, equation 143.
    """
    _, b, c = _rodrigues(axis_angle)
    return _cross_polynomial(axis_angle, -b, c)


def _cross_polynomial(
    axis_angle: Float[Array, "*B 3"], linear: Float[Array, "*B"], quadratic: Float[Array, "*B"]
) -> Float[Array, "*B 3 3"]:
    """Return I + p·[r]× + q·[r]×² for an axis-angle r and the factors p and q."""
    x, y, z = axis_angle[..., 0], axis_angle[..., 1], axis_angle[..., 2]
    p, q = linear, quadratic
    rows = [
        [1 - q * (y * y + z * z), q * x * y - p * z, q * x * z + p * y],
        [q * x * y + p * z, 1 - q * (x * x + z * z), q * y * z - p * x],
        [q * x * z - p * y, q * y * z + p * x, 1 - q * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def _rodrigues(axis_angle: Float[Array, "*B 3"]) -> tuple[Float[Array, "*B"], Float[Array, "*B"], Float[Array, "*B"]]:
    """Return sin θ/θ, (1 − cos θ)/θ² and (θ − sin θ)/θ³.

    Below θ = 1e-2, the values come from their series in θ²: values and gradients are then exact to float32 and
    finite at zero rotation.
    """
    theta2 = jnp.sum(axis_angle**2, axis=-1)
    small = theta2 < 1e-4
    safe2 = jnp.where(small, 1.0, theta2)
    theta = jnp.sqrt(safe2)
    a = jnp.where(small, 1 - theta2 / 6 + theta2**2 / 120, jnp.sin(theta) / theta)
    b = jnp.where(small, 0.5 - theta2 / 24 + theta2**2 / 720, (1 - jnp.cos(theta)) / safe2)
    c = jnp.where(small, 1 / 6 - theta2 / 120 + theta2**2 / 5040, (1 - a) / safe2)
    return a, b, c


def matrix_to_axis_angle(R: Float[Array, "*B 3 3"]) -> Float[Array, "*B 3"]:
    """Return the axis-angles in radians, θ in [0, π], of rotation matrices (through unit quaternions)."""
    quaternion = _matrix_to_quaternion(R)
    w, xyz = quaternion[..., :1], quaternion[..., 1:]
    sine = jnp.linalg.norm(xyz, axis=-1, keepdims=True)
    theta = 2 * jnp.arctan2(sine, w)
    return jnp.where(sine < 1e-6, 2 * xyz, xyz * (theta / jnp.maximum(sine, 1e-6)))


def _matrix_to_quaternion(R: Float[Array, "*B 3 3"]) -> Float[Array, "*B 4"]:
    """Return unit quaternions (w ≥ 0), computed from the largest component, which is stable for all rotations."""
    m = [[R[..., i, j] for j in range(3)] for i in range(3)]
    candidates = jnp.stack(
        [
            jnp.stack([1 + m[0][0] + m[1][1] + m[2][2], m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]], -1),
            jnp.stack([m[2][1] - m[1][2], 1 + m[0][0] - m[1][1] - m[2][2], m[1][0] + m[0][1], m[0][2] + m[2][0]], -1),
            jnp.stack([m[0][2] - m[2][0], m[1][0] + m[0][1], 1 - m[0][0] + m[1][1] - m[2][2], m[2][1] + m[1][2]], -1),
            jnp.stack([m[1][0] - m[0][1], m[0][2] + m[2][0], m[2][1] + m[1][2], 1 - m[0][0] - m[1][1] + m[2][2]], -1),
        ],
        axis=-2,
    )
    largest = jnp.argmax(jnp.diagonal(candidates, axis1=-2, axis2=-1), axis=-1)
    quaternion = jnp.take_along_axis(candidates, largest[..., None, None], axis=-2)[..., 0, :]
    quaternion = quaternion / jnp.linalg.norm(quaternion, axis=-1, keepdims=True)
    return jnp.where(quaternion[..., :1] < 0, -quaternion, quaternion)


def rotation_between(Ra: Float[Array, "*B 3 3"], Rb: Float[Array, "*B 3 3"]) -> Float[Array, "*B 3"]:
    """Return log(Raᵀ Rb): an axis-angle whose norm is the angle between two rotations, in radians within [0, π].

    θ = atan2(‖v‖, 1 − ¼‖Rb − Ra‖²) with v = ½ Σ_k b_k × a_k, a_k and b_k the rows of Ra and Rb: ‖v‖ = sin θ, and v has
    the direction of the axis, in the frame of Ra's columns. In contrast to the arccos of the trace, this formula is
    precise at small angles and near π, and its gradient is finite everywhere.
    """
    difference = Rb - Ra  # used instead of Rb, so that the cross product of equal rotations is exactly 0
    v = jnp.sum(jnp.cross(difference, Ra), axis=-2) / 2
    sine, cosine = safe_norm(v), 1 - jnp.sum(difference**2, axis=(-2, -1)) / 4
    theta = jnp.arctan2(sine, cosine)
    no_axis = sine == 0
    ratio = jnp.where(no_axis, 1.0, theta / jnp.where(no_axis, 1.0, sine))
    any_axis = jnp.where(no_axis, theta, 0.0)[..., None] * jnp.array([1.0, 0.0, 0.0])  # for θ = 0 and θ = π
    return ratio[..., None] * v + any_axis


@jax.custom_jvp
def rotation_change(
    before: Float[Array, "*B 3"] | np.ndarray, after: Float[Array, "*B 3"] | np.ndarray
) -> Float[Array, "*B 3"]:
    """Return log(R(a)ᵀ R(b)), the rotation from one axis-angle a to another b, as an axis-angle within [0, π].

    The derivatives are two 3×3 matrices, −Jr⁻¹(−w)·Jr(a) and Jr⁻¹(w)·Jr(b) with the result w, in place of the chain of
    the matrices and the logarithm: products with them cost half as much, and so does the compilation.

    Source: Solà et al. 2018, A micro Lie theory for state estimation in robotics, equations 82 and 144.
    """
    return rotation_between(axis_angle_to_matrix(jnp.asarray(before)), axis_angle_to_matrix(jnp.asarray(after)))


@rotation_change.defjvp
def _rotation_change_jvp(primals, tangents):
    before, after = primals
    change = rotation_change(before, after)
    of_before = -_inverse_right_jacobian(-change) @ right_jacobian(before)
    of_after = _inverse_right_jacobian(change) @ right_jacobian(after)
    d_before, d_after = tangents
    return change, jnp.einsum("...ij,...j->...i", of_before, d_before) + jnp.einsum(
        "...ij,...j->...i", of_after, d_after
    )


def _inverse_right_jacobian(axis_angle: Float[Array, "*B 3"]) -> Float[Array, "*B 3 3"]:
    """Return Jr⁻¹ = I + ½·[r]× + d·[r]×² with d = 1/θ² − cot(θ/2)/(2θ), for θ within [0, π].

    Source: Solà et al. 2018, equation 144, with (1 + cos θ)/sin θ = cot(θ/2), which is finite at π.
    """
    theta2 = jnp.sum(axis_angle**2, axis=-1)
    small = theta2 < 0.06
    theta = jnp.sqrt(jnp.where(small, 1.0, theta2))
    series = 1 / 12 + theta2 / 720 + theta2**2 / 30240
    d = jnp.where(small, series, (1 / theta - jnp.cos(theta / 2) / (2 * jnp.sin(theta / 2))) / theta)
    return _cross_polynomial(axis_angle, jnp.full_like(d, 0.5), d)


def geodesic_distance(Ra: Float[Array, "*B 3 3"], Rb: Float[Array, "*B 3 3"]) -> Float[Array, "*B"]:
    """Return the angle between rotations, in radians within [0, π]; the gradient is 0 where it is not defined."""
    return safe_norm(rotation_between(Ra, Rb))


def safe_norm(x: Float[Array, "*B D"]) -> Float[Array, "*B"]:
    """Return ‖x‖₂ over the last axis, with gradient 0 (not NaN) at x = 0."""
    squared = jnp.sum(x**2, axis=-1)
    zero = squared == 0
    return jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, squared)))


def unwrap_axis_angle(axis_angle: Float[Array, "T 3"]) -> Float[Array, "T 3"]:
    """Return the same rotations as axis-angles r + 2πk·r/‖r‖, with k such that each is nearest to the previous frame's.

    Many axis-angles describe one rotation. Without unwrapping, the axis-angle of a bird that turns through θ = π jumps
    by 2π between two frames, and the velocity term penalises a motion that does not exist.
    """
    _, unwrapped = jax.lax.scan(_nearest_turn, axis_angle[0], axis_angle)
    return unwrapped


def _nearest_turn(previous, current):
    """Return, twice, the axis-angle of the rotation `current` that is nearest to `previous`.

    A function of the module: outside of `jit`, JAX would compile a local function again in every call.
    """
    theta = jnp.linalg.norm(current)
    axis = current / jnp.maximum(theta, 1e-9)
    # choose k so that (θ + 2πk)·axis is closest to the previous axis-angle
    k = jnp.round((jnp.dot(previous, axis) - theta) / (2 * jnp.pi))
    # a zero rotation has no axis: use a whole number of turns about the previous axis
    length = jnp.linalg.norm(previous)
    turns = 2 * jnp.pi * jnp.round(length / (2 * jnp.pi)) * previous / jnp.maximum(length, 1e-9)
    nearest = jnp.where(theta < 1e-6, turns, current + 2 * jnp.pi * k * axis)
    return nearest, nearest


def viewing_axis_rotations(count: int) -> Float[np.ndarray, "C 3 3"]:
    """Return `count` rotations about the camera's z axis in equal steps (Hägerlind et al. 2024: 30 steps of 12°)."""
    angles = 2 * np.pi * np.arange(count) / count
    rotations = np.zeros((count, 3, 3))
    rotations[:, 0, 0] = rotations[:, 1, 1] = np.cos(angles)
    rotations[:, 1, 0], rotations[:, 0, 1] = np.sin(angles), -np.sin(angles)
    rotations[:, 2, 2] = 1
    return rotations


def view_grid(directions: int, turns: int) -> Float[np.ndarray, "C 3 3"]:
    """Return a near-uniform grid over SO(3): a Fibonacci sphere of viewing directions × turns about the view axis.

    Args:
        directions: number of directions from which the camera sees the bird.
        turns: number of equal turns about the camera's z axis for each direction.

    Returns:
        directions · turns rotation matrices, model → camera.
    """
    i = np.arange(directions) + 0.5
    polar, azimuth = np.arccos(1 - 2 * i / directions), np.pi * (1 + 5**0.5) * i
    toward = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], -1)
    helper = np.where(np.abs(toward[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    x = np.cross(helper, toward)
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    facing = np.stack([x, np.cross(toward, x), toward], axis=1)  # rows: camera axes in the model's frame
    return (viewing_axis_rotations(turns)[:, None] @ facing).reshape(-1, 3, 3)
