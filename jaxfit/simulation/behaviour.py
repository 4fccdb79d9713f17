"""What one bird does: postures at points in time, joined smoothly.

A behaviour writes `Key`s: at a time, a posture with its pitch, where the feet stand, which way the bird looks and
how high it flies. Between keys everything follows a monotone cubic (PCHIP), so that nothing overshoots its keys.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.interpolate import PchipInterpolator

from jaxfit.model.murre import POSTURES, Posture

__all__ = ["BEHAVIOURS", "REACH", "Key", "Motion", "Performer", "motion_of"]

BEHAVIOURS = ("stand", "incubate", "preen", "walk", "flap", "approach", "jab", "fly_off")
STEP_S = 0.28
"""Time of a step."""
STEP_UNITS = 2.4
"""Length of a step."""
FLAP_S = 0.11
"""Time of half a wingbeat."""


@dataclass(frozen=True)
class Key:
    """The state of a bird at one time."""

    time_s: float
    posture: Posture
    feet: tuple[float, float]
    """x, y in the world, model units."""
    heading: float
    """Direction that the bird looks in, radians from +y towards −x."""
    altitude: float = 0.0
    """Height of its lowest point above the ledge."""


@dataclass(frozen=True)
class Motion:
    """T frames of one bird before noise is added."""

    body_pose: Float[np.ndarray, "T bones 3"]
    pitch: Float[np.ndarray, "T"]
    """Of the body above the horizontal, radians."""
    feet: Float[np.ndarray, "T 2"]
    heading: Float[np.ndarray, "T"]
    altitude: Float[np.ndarray, "T"]
    behaviour: Int[np.ndarray, "T"]
    """Index into BEHAVIOURS."""


@dataclass
class Performer:
    """A bird that performs one behaviour after another, writing keys."""

    rng: np.random.Generator
    keys: list[Key]
    labels: list[tuple[float, str]] = field(default_factory=list)
    """From which time on which behaviour."""

    @property
    def now(self) -> Key:
        """The last key."""
        return self.keys[-1]

    def to(self, posture: Posture | str, seconds: float, **changes) -> None:
        """Add a key `seconds` later, in another posture and with other `changes`."""
        pose = POSTURES[posture] if isinstance(posture, str) else posture
        self.keys.append(replace(self.now, time_s=self.now.time_s + seconds, posture=pose, **changes))

    def face(self, posture: str, target: tuple[float, float]) -> None:
        """Turn towards a place, the shorter way round and no faster than a bird does."""
        x, y = np.subtract(target, self.now.feet)
        turn = (np.arctan2(-x, y) - self.now.heading + np.pi) % (2 * np.pi) - np.pi  # model +y looks to (−sin, cos)
        self.to(posture, 0.25 + 0.25 * abs(turn), heading=self.now.heading + turn)

    def perform(self, behaviour: str, until_s: float, target: tuple[float, float] | None = None) -> None:
        """Write the keys of one behaviour, from the last key on; the next one begins at its last key.

        Args:
            behaviour: one of BEHAVIOURS.
            until_s: when it should end. A walk that arrives ends before; what has begun, such as a wingbeat, is
                finished after.
            target: x, y in the world: where a walk leads to, or whom an approach or a jab is meant for. Only a
                walk needs one.
        """
        self.labels.append((self.now.time_s, behaviour))
        _ACTS[behaviour](self, until_s, target)


def blend(a: Posture | str, b: Posture | str, share: float) -> Posture:
    """The posture `share` of the way from a to b."""
    a, b = (POSTURES[p] if isinstance(p, str) else p for p in (a, b))
    return Posture(a.body_pose + share * (b.body_pose - a.body_pose), a.pitch_rad + share * (b.pitch_rad - a.pitch_rad))


def _stand(bird: Performer, until_s: float, _target) -> None:
    while bird.now.time_s < until_s:
        bird.to(blend("standing", "alert", bird.rng.uniform(0, 0.6)), bird.rng.uniform(0.5, 1.2))


def _incubate(bird: Performer, until_s: float, _target) -> None:
    while bird.now.time_s < until_s:
        bird.to(blend("incubating", "standing", bird.rng.uniform(0, 0.12)), bird.rng.uniform(0.7, 1.5))


def _preen(bird: Performer, until_s: float, _target) -> None:
    reach = f"preening_{bird.rng.choice(['left', 'right'])}"
    bird.to(reach, bird.rng.uniform(0.5, 0.8))
    while bird.now.time_s < until_s:
        bird.to(blend("standing", reach, bird.rng.uniform(0.75, 0.9)), 0.2)
        bird.to(reach, 0.2)


def _walk(bird: Performer, until_s: float, target) -> None:
    bird.face("standing", target)
    way, foot = np.hypot(*np.subtract(target, bird.now.feet)), 0
    while bird.now.time_s < until_s and way > 0:
        ahead = min(STEP_UNITS, way) * np.array([-np.sin(bird.now.heading), np.cos(bird.now.heading)])
        step = f"walking_{('left', 'right')[foot]}"
        bird.to(step, STEP_S, feet=tuple(np.add(bird.now.feet, ahead)))
        way, foot = way - STEP_UNITS, 1 - foot
    bird.to("standing", 0.3)


def _flap(bird: Performer, until_s: float, _target) -> None:
    bird.to("wings_half", 0.25)
    for _ in range(int(bird.rng.integers(3, 7))):
        bird.to("flapping_up", FLAP_S)
        bird.to("flapping_down", FLAP_S)
    bird.to("wings_half", 0.2)
    bird.to("standing", 0.35)
    _stand(bird, until_s, None)


def _jab(bird: Performer, until_s: float, target) -> None:
    if target is not None:
        bird.face("alert", target)
    for _ in range(int(bird.rng.integers(2, 4))):
        bird.to("jab", 0.16)
        bird.to(blend("alert", "jab", 0.3), 0.2)
    _stand(bird, until_s, None)


def _approach(bird: Performer, until_s: float, target) -> None:
    if target is not None:
        offset = np.subtract(bird.now.feet, target)
        distance = max(float(np.hypot(*offset)), 1e-6)
        if distance > REACH:
            _walk(bird, until_s, tuple(np.add(target, offset * REACH / distance)))
    bird.perform("jab", until_s, target)


REACH = 17.0
"""Distance of the feet from which a bird jabs at a neighbour, model units."""


def _fly_off(bird: Performer, until_s: float, _target) -> None:
    """Turns to the edge, leaps and flies away from the wall; afterwards it is out of the picture."""
    outward = np.pi + bird.rng.uniform(-0.4, 0.4)
    bird.face("standing", tuple(np.add(bird.now.feet, [-np.sin(outward), np.cos(outward)])))
    bird.to("wings_half", 0.2)
    heading = bird.now.heading
    flight, way, speed, beat = POSTURES["wings_up"].pitch_rad, 0.0, 20.0, 0
    start, ahead = np.array(bird.now.feet), np.array([-np.sin(heading), np.cos(heading)])
    upright = bird.now.posture.pitch_rad
    while way < 260:
        seconds = FLAP_S
        way += speed * seconds
        speed = min(speed + 420 * seconds, 420)
        pitch = flight + (upright - flight) * max(0.0, 1 - beat / 3)
        bird.to(
            _pitched(("wings_up", "wings_down")[beat % 2], pitch),
            seconds,
            feet=tuple(start + way * ahead),
            altitude=min(3.0 * (beat + 1), 14.0),
        )
        beat += 1
    bird.to("wings_half", max(until_s - bird.now.time_s, 0.1))


def _pitched(posture: str, pitch_rad: float) -> Posture:
    return Posture(POSTURES[posture].body_pose, pitch_rad)


_ACTS: dict[str, Callable[[Performer, float, tuple[float, float] | None], None]] = {
    "stand": _stand,
    "incubate": _incubate,
    "preen": _preen,
    "walk": _walk,
    "flap": _flap,
    "approach": _approach,
    "jab": _jab,
    "fly_off": _fly_off,
}


def motion_of(performer: Performer, frames: int, fps: float) -> Motion:
    """The curves through a performer's keys at T frames; times before its first key hold that key."""
    keys = performer.keys
    times = np.array([key.time_s for key in keys])
    if (np.diff(times) <= 0).any():
        raise ValueError("the keys' times must increase")
    at = np.clip(np.arange(frames) / fps, times[0], times[-1])

    def curve(values) -> np.ndarray:
        return PchipInterpolator(times, np.asarray(values, np.float64), axis=0)(at)

    starts = np.array([start for start, _ in performer.labels])
    names = np.array([BEHAVIOURS.index(name) for _, name in performer.labels])
    return Motion(
        body_pose=curve([key.posture.body_pose for key in keys]),
        pitch=curve([key.posture.pitch_rad for key in keys]),
        feet=curve([key.feet for key in keys]),
        heading=curve([key.heading for key in keys]),
        altitude=curve([key.altitude for key in keys]),
        behaviour=names[np.maximum(np.searchsorted(starts, at, side="right") - 1, 0)],
    )
