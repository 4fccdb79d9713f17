"""Behaviour of one bird: keyframes with postures, and their interpolation.

A behaviour adds keyframes (`Key`): time, posture with pitch, position of the feet, heading and altitude. Monotone cubic
interpolation (PCHIP) between keyframes avoids overshoot.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.interpolate import PchipInterpolator

from jaxfit.model.murre import POSTURES, Posture

BEHAVIOURS = ("stand", "incubate", "preen", "walk", "flap", "approach", "jab", "fly_off")
STEP_S = 0.28
"""Duration of a step, seconds."""
STEP_UNITS = 2.4
"""Length of a step, model units."""
FLAP_S = 0.11
"""Duration of half a wingbeat, seconds."""


@dataclass(frozen=True)
class Key:
    """The state of a bird at one time."""

    time_s: float
    posture: Posture
    feet: tuple[float, float]
    """x, y in the world frame, model units."""
    heading: float
    """Direction of the body, radians from +y towards −x."""
    altitude: float = 0.0
    """Height of the lowest point above the ledge, model units."""


@dataclass(frozen=True)
class Motion:
    """Motion of one bird over T frames, before sway is added."""

    body_pose: Float[np.ndarray, "T bones 3"]
    pitch: Float[np.ndarray, "T"]
    """Pitch of the body above the horizontal, radians."""
    feet: Float[np.ndarray, "T 2"]
    heading: Float[np.ndarray, "T"]
    altitude: Float[np.ndarray, "T"]
    behaviour: Int[np.ndarray, "T"]
    """Index into BEHAVIOURS."""


@dataclass
class Keyframes:
    """The keyframes of one bird that shows one behaviour after another."""

    rng: np.random.Generator
    keys: list[Key]
    labels: list[tuple[float, str]] = field(default_factory=list)
    """Start time and name of each behaviour."""

    @property
    def last(self) -> Key:
        """The last keyframe."""
        return self.keys[-1]

    def add(self, posture: Posture | str, seconds: float, **changes) -> None:
        """Add a keyframe `seconds` later with the given posture and `changes`."""
        pose = POSTURES[posture] if isinstance(posture, str) else posture
        self.keys.append(replace(self.last, time_s=self.last.time_s + seconds, posture=pose, **changes))

    def turn_towards(self, posture: str, target: tuple[float, float]) -> None:
        """Turn to a position by the smaller angle, at the speed of a bird."""
        x, y = np.subtract(target, self.last.feet)
        # the direction of a heading is (−sin, cos)
        turn = (np.arctan2(-x, y) - self.last.heading + np.pi) % (2 * np.pi) - np.pi
        self.add(posture, 0.25 + 0.25 * abs(turn), heading=self.last.heading + turn)

    def add_behaviour(self, behaviour: str, until_s: float, target: tuple[float, float] | None = None) -> None:
        """Add the keyframes of one behaviour after the last keyframe.

        Args:
            behaviour: one of BEHAVIOURS.
            until_s: intended end, seconds. A walk may end earlier, at its target. A movement that has begun, such as a
                wingbeat, may end later.
            target: x, y in the world frame: the end of a walk, or the neighbour of an approach or a jab. Only a walk
                requires a target.
        """
        self.labels.append((self.last.time_s, behaviour))
        _BEHAVIOUR_FUNCTIONS[behaviour](self, until_s, target)

    def begin(self, behaviour: str) -> None:
        """Say that a behaviour begins only now, and that the bird stood since the label before."""
        self.labels[-1] = self.labels[-1][0], "stand"
        if self.last.time_s > self.labels[-1][0]:
            self.labels.append((self.last.time_s, behaviour))
        else:
            self.labels[-1] = self.last.time_s, behaviour


def blend(a: Posture | str, b: Posture | str, share: float) -> Posture:
    """Interpolate between two postures: share 0 is a, share 1 is b."""
    a, b = (POSTURES[p] if isinstance(p, str) else p for p in (a, b))
    return Posture(a.body_pose + share * (b.body_pose - a.body_pose), a.pitch_rad + share * (b.pitch_rad - a.pitch_rad))


def _stand(bird: Keyframes, until_s: float, _target) -> None:
    while bird.last.time_s < until_s:
        bird.add(blend("standing", "alert", bird.rng.uniform(0, 0.6)), bird.rng.uniform(0.5, 1.2))


def _incubate(bird: Keyframes, until_s: float, _target) -> None:
    while bird.last.time_s < until_s:
        bird.add(blend("incubating", "standing", bird.rng.uniform(0, 0.12)), bird.rng.uniform(0.7, 1.5))


def _preen(bird: Keyframes, until_s: float, _target) -> None:
    preening = f"preening_{bird.rng.choice(['left', 'right'])}"
    bird.add(preening, bird.rng.uniform(0.5, 0.8))
    while bird.last.time_s < until_s:
        bird.add(blend("standing", preening, bird.rng.uniform(0.75, 0.9)), 0.2)
        bird.add(preening, 0.2)


def _walk(bird: Keyframes, until_s: float, target) -> None:
    behaviour = bird.labels[-1][1]
    bird.turn_towards("standing", target)
    bird.begin(behaviour)
    distance, foot = np.hypot(*np.subtract(target, bird.last.feet)), 0
    while bird.last.time_s < until_s and distance > 0:
        ahead = min(STEP_UNITS, distance) * np.array([-np.sin(bird.last.heading), np.cos(bird.last.heading)])
        step = f"walking_{('left', 'right')[foot]}"
        bird.add(step, STEP_S, feet=tuple(np.add(bird.last.feet, ahead)))
        distance, foot = distance - STEP_UNITS, 1 - foot
    bird.labels.append((bird.last.time_s, "stand"))
    bird.add("standing", 0.3)


def _flap(bird: Keyframes, until_s: float, _target) -> None:
    bird.add("wings_half", 0.25)
    for _ in range(int(bird.rng.integers(3, 7))):
        bird.add("flapping_up", FLAP_S)
        bird.add("flapping_down", FLAP_S)
    bird.add("wings_half", 0.2)
    bird.add("standing", 0.35)
    bird.add_behaviour("stand", until_s)


def _jab(bird: Keyframes, until_s: float, target) -> None:
    if target is not None:
        bird.turn_towards("alert", target)
        bird.begin("jab")
    for _ in range(int(bird.rng.integers(2, 4))):
        bird.add("jab", 0.16)
        bird.add(blend("alert", "jab", 0.3), 0.2)
    bird.add_behaviour("stand", until_s)


def _approach(bird: Keyframes, until_s: float, target) -> None:
    if target is not None:
        offset = np.subtract(bird.last.feet, target)
        distance = max(float(np.hypot(*offset)), 1e-6)
        if distance > JAB_DISTANCE:
            _walk(bird, until_s, tuple(np.add(target, offset * JAB_DISTANCE / distance)))
    bird.add_behaviour("jab", until_s, target)


JAB_DISTANCE = 17.0
"""Distance between the feet of two birds at which one jabs at the other, model units."""


def _fly_off(bird: Keyframes, until_s: float, _target) -> None:
    """Turn to the edge, leap and fly away from the wall, out of the picture."""
    outward = np.pi + bird.rng.uniform(-0.4, 0.4)
    bird.turn_towards("standing", tuple(np.add(bird.last.feet, [-np.sin(outward), np.cos(outward)])))
    bird.begin("fly_off")
    bird.add("wings_half", 0.2)
    heading = bird.last.heading
    flight, distance, speed, beat = POSTURES["wings_up"].pitch_rad, 0.0, 20.0, 0
    start, ahead = np.array(bird.last.feet), np.array([-np.sin(heading), np.cos(heading)])
    upright = bird.last.posture.pitch_rad
    while distance < 260:
        seconds = FLAP_S
        distance += speed * seconds
        speed = min(speed + 420 * seconds, 420)
        pitch = flight + (upright - flight) * max(0.0, 1 - beat / 3)
        bird.add(
            _pitched(("wings_up", "wings_down")[beat % 2], pitch),
            seconds,
            feet=tuple(start + distance * ahead),
            altitude=min(3.0 * (beat + 1), 14.0),
        )
        beat += 1
    bird.add("wings_half", max(until_s - bird.last.time_s, 0.1))


def _pitched(posture: str, pitch_rad: float) -> Posture:
    return Posture(POSTURES[posture].body_pose, pitch_rad)


_BEHAVIOUR_FUNCTIONS: dict[str, Callable[[Keyframes, float, tuple[float, float] | None], None]] = {
    "stand": _stand,
    "incubate": _incubate,
    "preen": _preen,
    "walk": _walk,
    "flap": _flap,
    "approach": _approach,
    "jab": _jab,
    "fly_off": _fly_off,
}


def interpolate_keyframes(keyframes: Keyframes, frames: int, fps: float) -> Motion:
    """Interpolate keyframes at T frames; frames before the first keyframe have its values."""
    keys = keyframes.keys
    times = np.array([key.time_s for key in keys])
    if (np.diff(times) <= 0).any():
        raise ValueError("the times of the keyframes must increase")
    at = np.clip(np.arange(frames) / fps, times[0], times[-1])

    def curve(values) -> np.ndarray:
        return PchipInterpolator(times, np.asarray(values, np.float64), axis=0)(at)

    starts = np.array([start for start, _ in keyframes.labels])
    names = np.array([BEHAVIOURS.index(name) for _, name in keyframes.labels])
    return Motion(
        body_pose=curve([key.posture.body_pose for key in keys]),
        pitch=curve([key.posture.pitch_rad for key in keys]),
        feet=curve([key.feet for key in keys]),
        heading=curve([key.heading for key in keys]),
        altitude=curve([key.altitude for key in keys]),
        behaviour=names[np.maximum(np.searchsorted(starts, at, side="right") - 1, 0)],
    )
