"""A plan of how many people a study needs: what is supposed, and what a simulation of its design came to."""

from datetime import datetime
from typing import Any

from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy import ForeignKey, String
from sqlalchemy.orm import Mapped, mapped_column

from app.db import Base, now
from app.domain.choices import Choice
from app.domain.protocol import EvaluatedMethod, PlannedTest


class PowerTest(Choice):
    """What the simulated studies are to show, by one test within people or its like between arms."""

    DIFFERENCE = "difference", "A difference of means"
    CUMULATIVE_LINK = "cumulative_link", "A difference of ratings as an order"
    EQUIVALENCE = "equivalence", "That they differ by less than what matters"

    def planned(self, *, paired: bool) -> PlannedTest:
        """As the page of results calls it."""
        within, between = {
            PowerTest.DIFFERENCE: (PlannedTest.PAIRED_T, PlannedTest.WELCH_T),
            PowerTest.CUMULATIVE_LINK: (PlannedTest.CUMULATIVE_LINK, PlannedTest.CUMULATIVE_LINK_BETWEEN),
            PowerTest.EQUIVALENCE: (PlannedTest.EQUIVALENCE, PlannedTest.EQUIVALENCE_BETWEEN),
        }[self]
        return within if paired else between


class PowerInputs(BaseModel):
    """What is supposed about people who have not come yet. Points are those of the scale from 1 to 5."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    better: EvaluatedMethod = EvaluatedMethod.PBARL
    compared: EvaluatedMethod = EvaluatedMethod.REFERENCE
    effect: float = Field(default=0.5, ge=0.0, le=4.0, title="How much better, in points")
    spread: float = Field(default=0.7, ge=0.0, le=3.0, title="How much that differs between people (SD)")
    levels: float = Field(default=0.6, ge=0.0, le=3.0, title="How differently people rate altogether (SD)")
    noise: float = Field(default=0.8, ge=0.0, le=3.0, title="Noise of one rating (SD)")
    dropout_percent: float = Field(default=10.0, ge=0.0, le=90.0, title="Who drops out, %")
    most_people: int = Field(default=48, ge=8, le=400, title="Up to how many people")
    test: PowerTest = PowerTest.DIFFERENCE


class PowerPlan(Base):
    """One simulation that somebody has asked for. The same supposition about the same design is simulated once."""

    __tablename__ = "power_plan"

    id: Mapped[int] = mapped_column(primary_key=True)
    study_id: Mapped[int] = mapped_column(ForeignKey("study.id"), index=True)
    asked_by: Mapped[str] = mapped_column(String(80))
    asked_at: Mapped[datetime] = mapped_column(default=now)
    basis: Mapped[str] = mapped_column(String(64))
    """Fingerprint of what was supposed and of the design."""
    stored_inputs: Mapped[dict[str, Any]]
    contents: Mapped[dict[str, Any] | None]
    """None while the worker simulates; see app.services.studies.power."""

    @property
    def inputs(self) -> PowerInputs:
        """What was supposed, validated."""
        return PowerInputs.model_validate(self.stored_inputs)
