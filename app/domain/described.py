"""Settings with all that an experimenter is told about them, beside their type, default and bounds.

What is written here is read by the form, by locking, and by the schema that the API shows.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel, Field

from app.domain.choices import Choice


class Section(Choice):
    """Where a setting stands on the page; in the order of the page."""

    START = "start", "Study"
    CONSENT = "consent", "Consent and questions"
    PAIRS = "pairs", "Pairs"
    EVALUATION = "evaluation", "Blinded evaluation and debrief"
    DESIGN = "design", "Arms and who takes part"
    PANEL = "panel", "Recruitment panel and the end"
    LEARNING = "learning", "Learning"
    CLIPS = "clips", "Clips"
    TESTS = "tests", "Planned tests"


class Use(Choice):
    """After what a setting cannot be changed any more."""

    CLIPS = "clips", "Fixed: clips have been made."
    PAIRS = "pairs", "Fixed: participants have been given pairs."
    EVALUATION = "evaluation", "Fixed: somebody has reached the evaluation."
    ARMS = "arms", "Fixed: somebody has been allocated to an arm."


@dataclass(frozen=True)
class Shown:
    """How a setting is shown to an experimenter."""

    section: Section
    label: str
    hint: str = ""
    unit: str = ""
    """Of a number; "%": typed in percent, stored as a share."""
    fixed_by: Use | None = None
    """None: it may be changed at any time."""
    complaint: str = ""
    """What is said about a value that is not allowed; empty: the bound that it breaks."""
    options: tuple[tuple[str, str, str], ...] = ()
    """(value, label, hint) of a switch that is shown as two choices, ``no`` and ``yes``."""
    new_row: bool = False
    """The row of fields before it ends."""
    simulated: bool = False
    """It is about what a simulator makes: studies of recordings have none of it."""

    def __call__(self, schema: dict[str, Any]) -> None:
        """Add to the JSON schema what it has no word for: the unit. A share is stored without one."""
        if self.unit not in ("", "%"):
            schema["x-unit"] = self.unit


def setting(
    default: Any,
    section: Section,
    label: str,
    hint: str = "",
    *,
    unit: str = "",
    fixed_by: Use | None = None,
    complaint: str = "",
    options: tuple[tuple[str, str, str], ...] = (),
    new_row: bool = False,
    simulated: bool = False,
    **bounds: Any,
) -> Any:
    """A field of a model of settings. ``bounds`` are pydantic's: ge, le, min_length, max_length, pattern."""
    shown = Shown(section, label, hint, unit, fixed_by, complaint, options, new_row, simulated)
    return Field(default, title=label, description=hint or None, json_schema_extra=shown, **bounds)


def settings_of(model: type[BaseModel]) -> Iterator[tuple[str, Any, Shown]]:
    """Name, type and words of every setting of a model, in its order. Raises TypeError for a field without words."""
    for name, field in model.model_fields.items():
        shown = field.json_schema_extra
        if not isinstance(shown, Shown):
            raise TypeError(f"{model.__name__}.{name} is no setting(): it does not say how it is shown.")
        yield name, field.annotation, shown


def bounds_of(model: type[BaseModel], name: str) -> tuple[Any, Any]:
    """The smallest and the largest value that a setting can have; None where there is no bound."""
    rules = model.model_fields[name].metadata
    smallest, largest = ([getattr(rule, end) for rule in rules if hasattr(rule, end)] for end in ("ge", "le"))
    return (smallest or [None])[0], (largest or [None])[0]
