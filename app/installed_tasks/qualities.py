"""What people say made the difference between two clips: qualities they can name, each with the signals it is about."""

from collections.abc import Mapping, Sequence

from app.installed_tasks import catalogue
from app.installed_tasks.lab import LabDescription

QUALITIES: Mapping[str, Sequence[str]] = {
    "speed": ("speed_m_s", "speed_squared_m2_s2"),
    "speed_near": ("near_speed_squared_m2_s2", "intake_speed_m_s"),
    "force": ("force_at_target_n", "force_away_n", "high_force_n", "force_squared_n2"),
    "spilling": ("spilled_on_person", "spilled"),
    "path": ("height_above_target_m", "lateral_offset_m", "tilt_rad"),
    "smoothness": ("acceleration_squared_m2_s4", "action_change_squared", "turn_speed_squared_rad2_s2"),
    "outcome": ("undelivered", "distance_m", "strokes"),
}
"""Of tasks with a person of ours; the order is that of the page."""


def of_task(task: str) -> Mapping[str, Sequence[str]]:
    """Signals by quality, in the order of the page. Empty for clips that were recorded elsewhere.

    A laboratory's own signals are a quality each; of the others those that its environment has.
    """
    installed = catalogue.find(task)
    if installed is None:
        return {}
    description = installed.description
    if isinstance(description, LabDescription):
        return {**_among(description.signal_names), **{name: (name,) for name in description.signals}}
    carries = description.words.carried is not None
    return {name: signals for name, signals in QUALITIES.items() if carries or name != "spilling"}


def _among(known: Sequence[str]) -> Mapping[str, Sequence[str]]:
    found = {name: tuple(each for each in signals if each in known) for name, signals in QUALITIES.items()}
    return {name: signals for name, signals in found.items() if signals}
