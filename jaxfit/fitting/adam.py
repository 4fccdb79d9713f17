"""Adam, the solver of the paper: many cheap steps, for any differentiable objective."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
import optimistix as optx
from jaxtyping import Array, Float, Int

from jaxfit.fitting.problem import Hyperparameters, Problem, Program, Solver, problem_loss
from jaxfit.model.pose import Pose

__all__ = ["ADAM"]


class _State(NamedTuple):
    minimiser: Any
    """The state of the optimistix minimiser, with Adam's moments. This module does not access its fields."""
    loss: Float[Array, ""]
    """The loss before the last step."""
    rejected: Int[Array, ""]
    """Number of rejected steps in this stage."""


def _minimiser(hyperparameters: Hyperparameters) -> optx.OptaxMinimiser:
    def scale(updates, _):
        return jax.tree.map(lambda update, step: -step * update, updates, hyperparameters.step_size)

    # with tolerances of 0 a stage takes all its steps, as in the paper
    return optx.OptaxMinimiser(optax.chain(optax.scale_by_adam(), optax.stateless(scale)), rtol=0.0, atol=0.0)


def _init(program: Program, problem: Problem, carried: _State | None) -> _State:
    if carried is not None:
        # the minimiser's state has the moments but no step sizes: the step sizes of this stage apply
        return carried._replace(rejected=jnp.int32(0))
    scalar = jax.ShapeDtypeStruct((), jnp.float32)
    minimiser = _minimiser(problem.hyperparameters)
    state = minimiser.init(_loss_of(program), problem.anchor, problem, {}, scalar, scalar, frozenset())
    return _State(state, jnp.float32(jnp.inf), jnp.int32(0))


def _step(program: Program, problem: Problem, pose: Pose, state: _State) -> tuple[Pose, _State]:
    """Take a step of Adam, or reject the step if the loss or its gradient is not finite.

    A rejected step changes neither the pose nor the moments, so all later steps of the stage are rejected, too.
    """
    minimiser = _minimiser(problem.hyperparameters)
    moved, stepped, loss = minimiser.step(_loss_of(program), pose, problem, {}, state.minimiser, frozenset())
    # every component of the gradient changes the pose: if the new pose is finite, the gradient is finite
    finite = jnp.stack([jnp.isfinite(loss), *(jnp.isfinite(x).all() for x in jax.tree.leaves(moved))]).all()
    pose, kept = jax.tree.map(lambda a, b: jnp.where(finite, a, b), (moved, stepped), (pose, state.minimiser))
    return pose, _State(kept, loss, state.rejected + ~finite)


def _loss_of(program: Program):
    def loss(pose: Pose, problem: Problem) -> tuple[Float[Array, ""], Float[Array, ""]]:
        value = problem_loss(program, problem, pose)
        return value, value  # optimistix minimises the first value, and `step` returns the second value

    return loss


def _outcome(state: _State) -> tuple[Float[Array, ""], Int[Array, ""]]:
    return state.loss, state.rejected


ADAM = Solver(_init, _step, _outcome)
