"""What the API takes and gives, with an example of each: the OpenAPI document is made from these."""

from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from app.domain.study_settings import StudySettings
from app.installed_tasks import catalogue

Link = Annotated[str, Field(examples=["http://localhost:8000/p/3mZ0c1..."])]


class Account(BaseModel):
    """Whose token this is."""

    name: str = Field(examples=["experimenter"])
    role: Literal["administrator", "experimenter", "reader"]
    scope: Literal["read", "write"]
    study: str | None = Field(description="The only study that the token opens; null: all that are yours.")
    expires_at: datetime | None
    software_version: str = Field(examples=["0.1.0"])


class StudyLine(BaseModel):
    """One study in a list."""

    slug: str = Field(examples=["pilot-at-home"])
    name: str = Field(examples=["Pilot at home"])
    task: str = Field(examples=[catalogue.usual()])
    created_at: datetime
    locked: bool
    blinded: bool


class StudyAnswer(StudyLine):
    """One study with everything that was decided before it began."""

    seed: int
    lock_hash: str | None = Field(description="SHA-256 of the locked settings and plan; null while not locked.")
    deviations: str = Field(examples=["none"])
    unblinded_at: datetime | None
    settings: StudySettings


class MemberAnswer(BaseModel):
    """One member of a study."""

    account_id: int
    name: str = Field(examples=["A colleague"])
    role: Literal["owner", "editor", "viewer"]
    added_at: datetime


class NewMember(BaseModel):
    """Whom to make a member, by the name of the account, and what they may do."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"example": {"name": "A colleague", "role": "viewer"}})

    name: str = Field(min_length=1, max_length=80)
    role: Literal["owner", "editor", "viewer"]


class ParticipantAnswer(BaseModel):
    """One participant. Of somebody who withdrew only code, status and time are left."""

    participant: str = Field(examples=["P01"])
    status: str = Field(examples=["invited"], description="invited, consented, completed or withdrawn")
    invited_at: datetime | None
    consented_at: datetime | None
    completed_at: datetime | None
    last_seen_at: datetime | None
    withdrawn_at: datetime | None


class NewParticipants(BaseModel):
    """How many people to add."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"example": {"count": 2}})

    count: int = Field(default=1, ge=1, le=50)


class Invitation(BaseModel):
    """A new participant and the personal link, which is given here once and never again."""

    participant: str = Field(examples=["P01"])
    link: Link


class Page(BaseModel):
    """Some rows of a table. All pages together are the rows that were there when the first one was read."""

    table: str = Field(examples=["ratings"])
    rows: list[dict[str, Any]] = Field(
        examples=[[{"participant": "P01", "letter": "A", "repetition": 1, "satisfaction": 4, "personalisation": 3}]]
    )
    next: str | None = Field(
        description="Address of the rows that follow; null at the end.",
        examples=["/api/v1/studies/pilot-at-home/tables/ratings?limit=100&cursor=eyJvZiI6InBpbG90LWF0LWhv..."],
    )
    later: str | None = Field(
        description="At the end of a table that grows: address of the rows that will have been added; keep it.",
        examples=["/api/v1/studies/pilot-at-home/tables/ratings?limit=100&cursor=eyJvZiI6InBpbG90LWF0LWhv..."],
    )


class ColumnAnswer(BaseModel):
    """One column of the data dictionary."""

    name: str = Field(examples=["satisfaction"])
    type: str = Field(examples=["integer"])
    unit: str
    allowed: str = Field(examples=["1 to 5; empty: not rated"])
    meaning: str = Field(examples=["Overall satisfaction."])


class TableAnswer(BaseModel):
    """One table and its columns."""

    name: str = Field(examples=["ratings"])
    meaning: str
    columns: list[ColumnAnswer]


class BundleAnswer(BaseModel):
    """A filter that was published as a zip file."""

    version: int
    label_count: int
    created_at: datetime
    byte_count: int
    sha256: str
    download: str = Field(examples=["/api/v1/studies/pilot-at-home/participants/P01/bundles/1.zip"])


class ReportAnswer(BaseModel):
    """The newest report: its statistics (layout in worker/analysis/study/statistics.py and answers.py) and figures."""

    made_at: datetime
    lock_hash: str = Field(description="As in every export; “not locked” while the study is not.")
    deviations: str = Field(examples=["none"])
    blinded: bool
    contents: dict[str, Any]
    figures: dict[str, dict[str, str]] = Field(
        examples=[{"ratings": {"svg": "/api/v1/studies/pilot-at-home/report/figures/ratings.svg"}}]
    )


class NewExport(BaseModel):
    """Which file to make."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"example": {"kind": "data"}})

    kind: Literal["data", "lerobot", "archive"] = "data"


class ExportAnswer(BaseModel):
    """A file that was asked for; the worker makes it within seconds to minutes."""

    id: int
    kind: str = Field(examples=["data"])
    requested_at: datetime
    finished_at: datetime | None
    byte_count: int | None
    error: str | None = Field(description="What went wrong at the last attempt.")
    download: str | None = Field(examples=["/api/v1/studies/pilot-at-home/exports/1.zip"])


class Problem(BaseModel):
    """What went wrong, in words (RFC 9457)."""

    title: str = Field(examples=["Nothing here"])
    status: int = Field(examples=[404])
    detail: str = Field(
        examples=["There is no such study. It may have been renamed; the list of studies shows what there is."]
    )
