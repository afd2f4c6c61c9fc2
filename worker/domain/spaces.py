"""What the numbers of an observation and an action mean, for every task: names, units, ranges.

The simulator fills observations in this order, the learning code reads them by name, and the bundle's manifest repeats
the table for whoever connects a real robot.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from worker.domain.type_aliases import FloatArray


@dataclass(frozen=True)
class Field:
    """One named stretch of an observation or action vector."""

    name: str
    size: int
    unit: str
    low: float
    high: float
    meaning: str


@dataclass(frozen=True)
class Space:
    """An ordered list of fields, flattened into one vector."""

    fields: tuple[Field, ...]

    @property
    def size(self) -> int:
        """Length of the flattened vector."""
        return sum(field.size for field in self.fields)

    @property
    def widths(self) -> FloatArray:
        """(size,) of the declared range of every number."""
        return np.repeat([field.high - field.low for field in self.fields], [field.size for field in self.fields])

    def slices(self) -> Iterator[tuple[Field, slice]]:
        """Every field with its place in the vector."""
        start = 0
        for field in self.fields:
            yield field, slice(start, start + field.size)
            start += field.size

    @property
    def column_names(self) -> list[str]:
        """A name for every number of the vector; a field of several is numbered from 0."""
        return [
            field.name if field.size == 1 else f"{field.name}_{column}"
            for field in self.fields
            for column in range(field.size)
        ]

    def slice_of(self, name: str) -> slice:
        """The place of one field in the vector. Raises KeyError for a name the space does not have."""
        for field, place in self.slices():
            if field.name == name:
                return place
        known = ", ".join(field.name for field in self.fields)
        raise KeyError(f"No field {name!r}; this space has {known}.")


CONTROL_STEP_S = 0.1

SHARED_FIELDS = (
    Field("tool_position_m", 3, "m", -1.5, 1.5, "working point of the tool, in the robot base frame"),
    Field("tool_forward", 3, "1", -1.0, 1.0, "unit vector of the tool's x axis, base frame"),
    Field("tool_up", 3, "1", -1.0, 1.0, "unit vector of the tool's z axis, base frame"),
    Field("tool_to_target_m", 3, "m", -1.5, 1.5, "target minus tool position, base frame"),
    Field("joint_positions_rad", 7, "rad", -6.2832, 6.2832, "angles of joints 1 to 7"),
    Field("body_to_target_m", 3, "m", -0.5, 0.5, "target minus the joint of the body that carries it, base frame"),
    Field("target_outward", 3, "1", -1.0, 1.0, "unit vector out of the person at the target, base frame"),
    Field("force_on_person_n", 1, "N", 0.0, 50.0, "summed normal force of arm and tool on the person"),
)
"""What every task observes first, in this order; a task's own fields follow."""

JOINT_ACTION = Space(
    (
        Field(
            "joint_deltas",
            7,
            "1",
            -1.0,
            1.0,
            "commanded change of joints 1 to 7, in units of 0.05 rad per step",
        ),
    )
)
