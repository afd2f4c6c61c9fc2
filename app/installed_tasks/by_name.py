"""What is usual in a task, by its name; also of one that is not installed here, as tasks of imported studies may be."""

from app.installed_tasks import catalogue
from app.installed_tasks.lab import LabDescription

USUAL_CLIP_STEPS = 60
"""Of a task that is not installed here."""
CONTROL_RATE_HZ = 10.0
"""Of the studio's own tasks."""


def longest_clip_steps(task: str) -> int | None:
    """A whole episode of a task; None for one that is not installed here."""
    installed = catalogue.find(task)
    return installed.description.episode_steps if installed else None


def usual_clip_steps(task: str) -> int:
    """Control steps from the start in which what matters in a task has happened."""
    installed = catalogue.find(task)
    return installed.description.usual_clip_steps if installed else USUAL_CLIP_STEPS


def archived_policy_count(task: str) -> int:
    """How many policies were refined for a task beforehand, for people who mind one thing."""
    installed = catalogue.find(task)
    return len(list(installed.archive.glob("*.safetensors"))) if installed else 0


def usual_behaviours(task: str, wanted: int) -> int:
    """So many ways of doing a scenario, or as many as there are."""
    installed = catalogue.find(task)
    most = installed.description.most_behaviours if installed else None
    return wanted if most is None else min(wanted, most)


def control_rate_hz(task: str) -> float:
    """Control steps per second; a laboratory's task has its own."""
    installed = catalogue.find(task)
    described = installed.description if installed else None
    return described.environment.rate_hz if isinstance(described, LabDescription) else CONTROL_RATE_HZ
