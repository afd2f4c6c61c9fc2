"""What people may judge by in recordings that nobody has measured anything in: it follows from states and actions."""

import numpy as np

from worker.domain.type_aliases import Float32Array
from worker.jobs.clips.own_clips import Signal

TIME = Signal(name="time_s", unit="s", meaning="how long it takes")
OF_STATES = (
    Signal(name="speed", unit="state/s", meaning="how fast the state changes"),
    Signal(name="speed_squared", unit="state²/s²", meaning="the same squared: counts fast moments"),
    Signal(name="acceleration_squared", unit="state²/s⁴", meaning="how jerkily the state changes"),
)
OF_ACTIONS = (Signal(name="action_change_squared", unit="action²", meaning="how jerky the actions are"),)


def signals(has_states: bool, has_actions: bool) -> tuple[Signal, ...]:
    """What of_steps will have as columns."""
    return (TIME, *(OF_STATES if has_states else ()), *(OF_ACTIONS if has_actions else ()))


def of_steps(states: Float32Array, actions: Float32Array, rate_hz: float) -> Float32Array:
    """(T, D) states and (T, A) actions, either perhaps without columns -> (T, S) in the order of signals()."""
    columns = [np.full(len(states), 1.0 / rate_hz)]
    if states.shape[1]:
        velocity = _change(states) * rate_hz
        speed = np.linalg.norm(velocity, axis=1)
        columns += [speed, speed**2, ((_change(velocity) * rate_hz) ** 2).sum(axis=1)]
    if actions.shape[1]:
        columns.append((_change(actions) ** 2).sum(axis=1))
    return np.stack(columns, axis=1).astype(np.float32)


def _change(values: Float32Array) -> Float32Array:
    """(T, D) from the step before; nothing at the first."""
    return np.diff(values.astype(np.float64), axis=0, prepend=values[:1]).astype(np.float32)
