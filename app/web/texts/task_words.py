"""The words for a task and its parts: what the names of axes and signals that the worker stores mean to people.

What all tasks share is worded here, with a task's own nouns; the rest its folder says.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from app.installed_tasks import catalogue
from app.installed_tasks.description import Words
from app.installed_tasks.lab import LabDescription

OF_A_SERVER = (
    "Its policy answers from a server. The server must be running whenever clips are made and filters are trained, and "
    "training waits for its answers."
)
_NEUTRAL = Words(tool="tool", target="target", carried="food or water")


@dataclass(frozen=True)
class TaskWords:
    """What pages call a task and its parts. A name without a word is shown plainly, so asking for it is no error."""

    title: str
    summary: str
    """One sentence for the person who chooses a task."""
    picture: str
    """shapes beside a seated person, as SVG"""
    costs: Mapping[str, str]
    """The paper's preference costs, by symbol; only those that can differ from 0 in this task."""
    axes: Mapping[str, str]
    """The ways in which executions differ; the sign says which end."""
    signals: Mapping[str, str]
    """What the structured reward model weighs."""
    silent_signals: frozenset[str] = frozenset()
    """Always 0 in this task; a weight of them says nothing."""
    warning: str = ""
    """What whoever chooses the task has to know first."""


def words_of(task: str) -> TaskWords:
    """The words of a task; for one that is not installed here, its name and neutral words."""
    installed = catalogue.find(task)
    if installed is None:
        title = task.replace("_", " ").capitalize()
        return TaskWords(title, "", "", _costs(_NEUTRAL), axes={}, signals={})
    words = installed.description.words
    if isinstance(installed.description, LabDescription):
        return _of_lab(installed.description)
    return TaskWords(
        installed.description.title,
        installed.description.summary,
        installed.picture,
        _costs(words),
        {**_approach(words.target), **words.axes},
        _signals(words),
        words.silent_signals,
    )


def _of_lab(described: LabDescription) -> TaskWords:
    """Of a laboratory's own environment: what all labs share in its nouns, and its own signals in its words."""
    words = described.words
    own = {name: signal.words["en"] for name, signal in described.signals.items()}
    shared = _signals(words)
    minus, target = "\N{MINUS SIGN}", words.target
    axes = {
        "speed_far": f"far from the {target}: slower ({minus}), quicker (+)",
        "speed_near": f"near the {target}: slower ({minus}), quicker (+)",
        "speed_early": f"at first: slower ({minus}), quicker (+)",
        "speed_late": f"later: slower ({minus}), quicker (+)",
        **{
            f"gain_{name}": f"{name.replace('_', ' ')} alone: slower ({minus}), quicker (+)"
            for name in described.modes.groups
        },
        "smooth": "smoother (+)",
        "hesitate": f"slows down before the {target} (+)",
        **{f"push_{name}": f"on the way pushed along {name}" for name in described.environment.action_names},
        **{f"shift_{name}": f"ends beside the {target} along {name}" for name in described.environment.action_names},
    }
    return TaskWords(
        described.title,
        described.summary,
        "",
        {name: own[name] for name in described.cost_names},
        {**axes, **words.axes},
        {name: own.get(name) or shared[name] for name in described.signal_names},
        words.silent_signals,
        OF_A_SERVER if any(each.url for each in (described.policy, *described.policies.values())) else "",
    )


def _costs(words: Words) -> Mapping[str, str]:
    costs = {
        "C_d": f"Distance from the {words.target}",
        "C_v": f"Speed of the {words.tool}",
        "C_f": f"Force away from the {words.target}",
        "C_hf": f"High force at the {words.target}",
    }
    if words.carried is not None:
        carried = words.carried.capitalize()
        costs |= {"C_fd": f"{carried} spilled on the person", "C_fdv": f"{carried} entering fast"}
    return costs


def _approach(target: str) -> Mapping[str, str]:
    return {
        "speed_far": f"far from the {target}: slower (\N{MINUS SIGN}), quicker (+)",
        "speed_near": f"near the {target}: slower (\N{MINUS SIGN}), quicker (+)",
        "from_below": "comes from above (\N{MINUS SIGN}), below (+)",
        "to_side": "comes round the person\N{RIGHT SINGLE QUOTATION MARK}s right (\N{MINUS SIGN}), left (+)",
        "hesitate": f"waits before the {target} (+)",
    }


def _signals(words: Words) -> Mapping[str, str]:
    tool, target, carried = words.tool, words.target, words.carried or _NEUTRAL.carried
    return {
        "distance_m": f"distance from the {target} (m)",
        "speed_m_s": f"{tool} speed (m/s)",
        "speed_squared_m2_s2": f"{tool} speed squared (m²/s²)",
        "acceleration_squared_m2_s4": f"{tool} acceleration squared (m²/s⁴)",
        "near_speed_squared_m2_s2": f"speed squared near the {target} (m²/s²)",
        "force_at_target_n": f"force at the {target} (N)",
        "force_away_n": f"force away from the {target} (N)",
        "high_force_n": f"high force at the {target} (N)",
        "force_squared_n2": f"force squared at the {target} (N²)",
        "spilled_on_person": f"{carried} spilled on the person",
        "spilled": f"{carried} spilled anywhere",
        "intake_speed_m_s": f"speed of the {carried} entering (m/s)",
        "height_above_target_m": f"height above the {target} (m)",
        "lateral_offset_m": f"{tool} to one side of the {target} (m)",
        "tilt_rad": f"tilt of the {tool} (rad)",
        "turn_speed_squared_rad2_s2": f"turning of the {tool}, squared (rad²/s²)",
        "undelivered": "task not finished yet",
        "action_change_squared": "jerkiness of the arm",
        "strokes": f"strokes over the {target}",
    }
