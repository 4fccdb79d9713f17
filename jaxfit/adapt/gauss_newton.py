"""Gauss-Newton fit of a posed bird to 3D points: the parameters, their priors and one damped step."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfit.adapt.species import symmetric_bone_precision, symmetric_bones
from jaxfit.model.bird import Bird
from jaxfit.model.kinematics import Rig, fold_bird, joint_transforms, posed_keypoints, posed_vertices
from jaxfit.model.pose import Pose

__all__ = ["Linear", "PosedFit", "Rows", "normal_equations"]


class Rows(NamedTuple):
    """Weighted residuals and their derivatives by the P parameters."""

    residual: Float[np.ndarray, "R"]
    jacobian: Float[np.ndarray, "R P"]
    weight: Float[np.ndarray, "R"]


class Linear(NamedTuple):
    """Posed points and their derivatives by the P parameters."""

    vertices: Float[np.ndarray, "V 3"]
    keypoints: Float[np.ndarray, "K 3"]
    by_vertices: Float[np.ndarray, "V 3 P"]
    by_keypoints: Float[np.ndarray, "K 3 P"]


class _Layout(eqx.Module):
    """What the compiled function needs besides the parameters."""

    rig: Rig
    bones: Float[Array, "bones Q"]
    bone_mean: Float[Array, "bones"]
    joints: int = eqx.field(static=True)


def _pose(x: Float[Array, "P"], layout: _Layout) -> Pose:
    orient, transl, log_scale, rest = x[:3], x[3:6], x[6], x[7:]
    angles, bones = 3 * (layout.joints - 1), layout.bones.shape[1]
    return Pose(
        global_orient=orient,
        body_pose=rest[:angles].reshape(-1, 3),
        transl=transl,
        scale=jnp.exp(log_scale),
        bone_length=layout.bone_mean + layout.bones @ rest[angles : angles + bones],
        betas=rest[angles + bones :],
    )


def _points(x, layout: _Layout):
    pose = _pose(x, layout)
    A = joint_transforms(layout.rig, pose)
    return posed_vertices(layout.rig, A, pose), posed_keypoints(layout.rig, A, pose)


_linearise = jax.jit(lambda x, layout: (*_points(x, layout), *jax.jacfwd(_points)(x, layout)))


class PosedFit:
    """The parameters x of a posed bird: orientation, translation, log scale, body pose, bone lengths, shape.

    The lengths of left and right bones are equal. The priors are those of the bird, with bone lengths that differ
    between species (`widened_bone_covariance`); orientation, translation and scale have no prior.
    """

    def __init__(self, bird: Bird):
        self.bird = bird
        bones = symmetric_bones(bird)
        self.layout = _Layout(fold_bird(bird), jnp.asarray(bones, jnp.float32), bird.bone_mean, bird.num_joints)
        angles = len(np.asarray(bird.pose_mean))
        self.size = 7 + angles + bones.shape[1] + bird.num_shapes
        self.prior_mean = np.zeros(self.size)
        self.prior_mean[7 : 7 + angles] = bird.pose_mean
        self.precision = np.zeros((self.size, self.size))
        bones_at = slice(7 + angles, 7 + angles + bones.shape[1])
        self.precision[7 : 7 + angles, 7 : 7 + angles] = np.linalg.inv(np.asarray(bird.pose_covariance, np.float64))
        self.precision[bones_at, bones_at] = symmetric_bone_precision(bird)
        shapes = np.arange(bones_at.stop, self.size)
        self.precision[shapes, shapes] = 1 / np.asarray(bird.shape_variance, np.float64)

    def pose(self, x: Float[np.ndarray, "P"]) -> Pose:
        """Return the pose of parameters, as NumPy arrays."""
        return jax.tree.map(np.asarray, _pose(jnp.asarray(x, jnp.float32), self.layout))

    def linearise(self, x: Float[np.ndarray, "P"]) -> Linear:
        """Return the posed vertices and keypoints with their derivatives."""
        values: Any = _linearise(jnp.asarray(x, jnp.float32), self.layout)
        return Linear(*(np.asarray(value) for value in values))

    def step(self, x: Float[np.ndarray, "P"], rows: Rows, damping: float = 1e-3) -> Float[np.ndarray, "P"]:
        """Return the parameters after one damped Gauss-Newton step on the rows and the priors."""
        hessian, gradient = normal_equations(rows)
        hessian += self.precision
        gradient += self.precision @ (x - self.prior_mean)
        # the damping keeps a step finite in directions that neither the data nor a prior determines
        hessian[np.diag_indices(self.size)] += damping * np.diag(hessian) + 1e-6
        step = -np.linalg.solve(hessian, gradient)
        # a rotation by more than half a radian is outside the range of the linearisation
        largest = np.abs(np.concatenate([step[:3], step[6 : 7 + len(self.bird.pose_mean)]])).max()
        return x + step * min(1.0, 0.5 / max(largest, 1e-12))


def normal_equations(rows: Rows) -> tuple[Float[np.ndarray, "P P"], Float[np.ndarray, "P"]]:
    """Return Jᵀ·diag(w)·J and Jᵀ·diag(w)·r, in float64."""
    weighted = rows.jacobian * rows.weight[:, None].astype(np.float32)
    hessian = (weighted.T @ rows.jacobian).astype(np.float64)
    return (hessian + hessian.T) / 2, (weighted.T @ rows.residual.astype(np.float32)).astype(np.float64)
