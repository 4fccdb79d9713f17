"""Terms that cannot be fitted: found by tracing before the fit, and named where a bird's fit broke down."""

from __future__ import annotations

import traceback
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from jaxfit.config.fit import FitConfig
from jaxfit.errors import InputError
from jaxfit.fitting.lane import Hyperparameters, Lane, Problem, lane_window
from jaxfit.fitting.stages import needs_mask, stage_hyperparameters, stage_problem
from jaxfit.model.bird import Bird
from jaxfit.model.camera import Camera
from jaxfit.model.kinematics import Rig
from jaxfit.model.pose import Pose, rest_pose
from jaxfit.objective.objective import weighted_sum
from jaxfit.objective.posed_window import Priors, Targets
from jaxfit.objective.registry import find_term

__all__ = ["check_terms", "name_failures"]


def check_terms(config: FitConfig, bird: Bird, rig: Rig, priors: Priors, camera: Camera) -> None:
    """Trace every term of every stage, and its gradient, without computing anything.

    Raises:
        InputError: a term that returns no scalar, asks for what the model has not, or raises; it is named.
    """
    T, K, pose = config.window, bird.num_keypoints, rest_pose(bird, config.window, config.common_size)
    for stage in config.stages:
        side = camera.size_px if needs_mask(stage) else 0
        problem = stage_problem(config, stage, rig, priors, camera)
        hyperparameters = stage_hyperparameters(config, stage, bird.keypoint_names)
        targets = Targets(
            keypoints_px=np.zeros((T, K, 2), np.float32),
            confidence=np.zeros((T, K), np.float32),
            mask=np.zeros((T, side, side), np.uint8),
            has_mask=np.zeros(T, bool),
            present=np.zeros(T, bool),
            corner_px=np.zeros((T, 2), np.float32),
        )
        for name in stage.terms:
            _trace(name, jax.grad(_weighted(problem, name)), pose, hyperparameters, pose, targets)


def _trace(name: str, function: Callable[..., object], *arguments: object) -> None:
    try:
        jax.eval_shape(function, *arguments)
    except InputError as error:
        if error.source.startswith("term "):
            raise
        raise InputError(f"term {name!r}", f"{error.source} {error.problem}", error.remedy) from error
    except Exception as error:  # whatever somebody's code does
        file = getattr(getattr(find_term(name).function, "__code__", None), "co_filename", None)
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
        where = f" at {file}:{lines[-1]}" if lines else ""
        said = f"{type(error).__name__}: {error}".split("\n")[0].strip()
        problem = f"cannot be traced or differentiated{where}: {said}"
        raise InputError(f"term {name!r}", problem, "it must run under jax.jit and jax.grad") from error


def name_failures(
    told: np.ndarray, step: Int[np.ndarray, "B"], stage: str, problem: Problem, *lanes: Hyperparameters | Pose | Targets
) -> np.ndarray:
    """Say for each lane that broke down which terms did it.

    A step whose gradient is not finite is refused and leaves the pose as it is, so that where a lane stands after
    that is where it broke down: its terms are evaluated there, each by itself.

    Args:
        told: (B,) text of what is known of each lane, empty where nothing is. That stays as it is.
        step: at which step of the stage each lane broke down, from 1; 0 where it did not.
        stage: its name.
        problem: of the stage.
        lanes: hyperparameters, targets, pose and the pose at which the stage began, of all lanes.

    Returns:
        `told`, with the news.
    """
    told = told.copy()
    new = np.flatnonzero((step > 0) & (told == ""))
    if not len(new):
        return told
    value, gradient = _not_finite(problem, *jax.tree.map(lambda x: x[new], lanes))
    for i, lane in enumerate(new):
        worse = [name for name in value if value[name][i]]
        steep = [name for name in gradient if gradient[name][i] and name not in worse]
        parts = [f"the value of {', '.join(worse)}"] * bool(worse) + [f"the gradient of {', '.join(steep)}"] * bool(
            steep
        )
        # each may be finite where their sum is not
        what = " and ".join(parts) or "the sum of all terms"
        told[lane] = f"{what} was not finite at step {step[lane]} of stage {stage}"
    return told


@eqx.filter_jit
def _not_finite(
    problem: Problem, hyperparameters: Hyperparameters, targets: Targets, pose: Pose, start: Pose
) -> tuple[dict[str, Bool[Array, "B"]], dict[str, Bool[Array, "B"]]]:
    """Of each weighted term of each lane: whether its value is not finite, and whether its gradient is not."""

    def one(hyperparameters, targets, pose, start):
        found = {
            name: jax.value_and_grad(_weighted(problem, name))(pose, hyperparameters, start, targets)
            for name in hyperparameters.settings
        }
        bad = jax.tree.map(lambda x: ~jnp.all(jnp.isfinite(x)), found)
        gradient = {name: jnp.any(jnp.stack(jax.tree.leaves(pull))) for name, (_, pull) in bad.items()}
        return {name: value for name, (value, _) in bad.items()}, gradient

    return jax.vmap(one)(hyperparameters, targets, pose, start)


def _weighted(problem: Problem, name: str) -> Callable[..., Array]:
    """One term's share of the objective, as a function of the pose, hyperparameters, start and targets of one lane."""

    def share(pose: Pose, hyperparameters: Hyperparameters, start: Pose, targets: Targets) -> Array:
        window = lane_window(pose, Lane(problem, hyperparameters, start, targets))
        return weighted_sum(window, {name: hyperparameters.settings[name]})

    return share
