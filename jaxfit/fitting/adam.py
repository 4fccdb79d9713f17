"""Adam: many cheap steps, for any objective. The method's own solver."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import optax
import optimistix as optx
from jaxtyping import Array, Float, Int

from jaxfit.fitting.lane import Hyperparameters, Lane, Solver, lane_loss
from jaxfit.model.pose import Pose

__all__ = ["ADAM"]

NEVER = 2**30
"""Non-finite steps in a row that a lane may refuse: a diverging bird stands still and leaves others alone."""


def _minimiser(hyperparameters: Hyperparameters, carried: Any = None) -> optx.OptaxMinimiser:
    def scale(updates, _):
        return jax.tree.map(lambda update, step: -step * update, updates, hyperparameters.step_size)

    adam = optax.scale_by_adam()
    if carried is not None:
        adam = optax.GradientTransformation(lambda params: carried, adam.update)
    chain = optax.chain(adam, optax.stateless(scale))
    # tolerances of 0: a stage takes exactly its steps, as its source does
    return optx.OptaxMinimiser(optax.apply_if_finite(chain, NEVER), rtol=0.0, atol=0.0)


def _loss(pose: Pose, lane: Lane) -> tuple[Float[Array, ""], None]:
    return lane_loss(pose, lane), None


def _init(pose: Pose, lane: Lane, before: Any) -> Any:
    struct = jax.ShapeDtypeStruct((), jnp.float32)
    minimiser = _minimiser(lane.hyperparameters, None if before is None else before.opt_state.inner_state[0])
    return minimiser.init(_loss, pose, lane, {}, struct, None, frozenset())


def _step(pose: Pose, lane: Lane, state: Any) -> tuple[Pose, Any]:
    pose, state, _ = _minimiser(lane.hyperparameters).step(_loss, pose, lane, {}, state, frozenset())
    return pose, state


def _outcome(state: Any) -> tuple[Float[Array, ""], Int[Array, ""]]:
    return state.f, state.opt_state.total_notfinite


ADAM = Solver(_init, _step, _outcome)
