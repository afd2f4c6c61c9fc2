"""Keys of runs: what a run is about, in one line that is the same whenever the same work is due. Written and read here.

clips/study-1/scenario-17                       the clips of a scenario of the pool
clips/study-1/whole-17                          its whole episodes, for the introduction
clips/study-1/preview-2                         films ahead for people who set a robot themselves, the third batch
clips/participant-3/setting-17                  a film of somebody's setting 17
clips/participant-3/made/labels-20              pairs that follow somebody, after a model of 20 labels
clips/study-1/again-5-1763811000                lost files of rollout 5, lost at that moment
reward/participant-3/labels-20                  a reward model of 20 labels
reward/participant-3/labels-200/answer-345      of all labels, the last of them answer 345
filter/participant-3/labels-200/answer-345-exclusion-6
refinement/participant-3/ahead/labels-100      of half the answers, while they give the others
method/participant-3/prefft/labels-200/answer-345
films/participant-3/trials/labels-200/answer-345
films/participant-3/others/labels-200/answer-345    of the trials, while their own filter is still fitted
films/participant-3/ahead                       of the reference, while they still answer
films/participant-3/lent-4-19ab0c3d4e5      of what donor draw 4 of that moment lends them, while they still answer
films/participant-3/again-8-1763811000          lost files of film 8
shared/study-1/filter-7-19ab0c3d4e5             what shared filter 7 asks for, which was asked for at that moment
report/study-1/basis-0123456789abcdef           the report of what there was then
export/study-1/archive-4                        the file that export 4 asks for
power/study-1/plan-4                            the simulation that power plan 4 asks for
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace

from app.domain.models import RunKind

ROWS = {
    "answer": "label_event",
    "exclusion": "exclusion",
    "clips/again": "rollout",
    "clips/setting": "self_setting",
    "films/again": "film",
    "films/lent": "donor_draw",
}
"""Tables whose ids stand in keys, by what they stand behind."""
SCENARIO, WHOLE, AGAIN = "scenario", "whole", "again"
PREVIEW, SETTING, MADE = "preview", "setting", "made"
BEFORE_AFTER, TRIALS, CONTROLLERS, OTHERS = "before-after", "trials", "controllers", "others"
AHEAD, LENT = "ahead", "lent"
SHARED_FILTER = "filter"
BASIS, PLAN = "basis", "plan"

_ASKED_FOR = (RunKind.SHARED, RunKind.EXPORT, RunKind.POWER)
"""Kinds of which each run is what one row asks for."""

_PATTERN = re.compile(
    r"(?P<kind>[a-z]+)/(?:study-(?P<study>\d+)|participant-(?P<participant>\d+))"
    r"(?:/(?!labels-)(?P<subject>[a-z_]+(?:-[a-z_]+)*?)(?:(?<!basis)-(?P<number>\d+))?(?:-(?P<mark>[0-9a-f]+))?)?"
    r"(?:/labels-(?P<labels>\d+)(?:/(?P<answers>(?:answer-\d+)?-?(?:exclusion-\d+)?))?)?"
    r"(?P<copy>/imported-[0-9a-f-]+)?"
)


@dataclass(frozen=True)
class RunKey:
    """What a run is about."""

    kind: RunKind
    study_id: int | None = None
    """Of work for a whole study."""
    participant_id: int | None = None
    """Of work for one person."""
    subject: str = ""
    """Which of several works of the kind: whole clips, a method, what the films are for, what is exported."""
    number: int | None = None
    """What the subject is about: a scenario, or the row of a rollout, film or export."""
    mark: str = ""
    """By which work on the same subject is told from earlier one: when files were lost, what a report rests on."""
    labels: int | None = None
    """How many labels models learn from."""
    answers: str = ""
    """The last answer and exclusion that models know, once all labels are there."""
    copy: str = ""
    """Makes the key of a run that came with an archive its own, where there is one of this key already."""

    def __str__(self) -> str:
        """The key as it is stored."""
        owner = f"study-{self.study_id}" if self.participant_id is None else f"participant-{self.participant_id}"
        subject = "-".join(str(part) for part in (self.subject, self.number, self.mark) if part not in ("", None))
        labels = "" if self.labels is None else f"labels-{self.labels}"
        return "/".join(part for part in (self.kind.value, owner, subject, labels, self.answers) if part) + self.copy

    @property
    def series(self) -> "RunKey":
        """What a later run makes good: the same work, from whichever labels or after whichever loss."""
        of_row = self.number if self.subject == AGAIN or self.kind in _ASKED_FOR else None
        subject = self.subject if of_row or self.kind in (RunKind.METHOD, RunKind.FILMS) else ""
        return RunKey(self.kind, self.study_id, self.participant_id, subject, of_row)


def read(stored: str) -> RunKey | None:
    """A stored key; None for one that this studio has not written."""
    found = _PATTERN.fullmatch(stored)
    if found is None or found["kind"] not in set(RunKind):
        return None
    return RunKey(
        RunKind(found["kind"]),
        _number(found["study"]),
        _number(found["participant"]),
        found["subject"] or "",
        _number(found["number"]),
        found["mark"] or "",
        _number(found["labels"]),
        found["answers"] or "",
        found["copy"] or "",
    )


def renumbered(key: RunKey, new_id: Callable[[str, int], int]) -> RunKey:
    """The key after its study has got new row ids. ``new_id``: of a table's row, by its old id."""
    renamed = replace(
        key,
        study_id=None if key.study_id is None else new_id("study", key.study_id),
        participant_id=None if key.participant_id is None else new_id("participant", key.participant_id),
        answers=re.sub(r"(answer|exclusion)-(\d+)", lambda m: f"{m[1]}-{new_id(ROWS[m[1]], int(m[2]))}", key.answers),
    )
    table = ROWS.get(f"{key.kind}/{key.subject}")
    return renamed if table is None or key.number is None else replace(renamed, number=new_id(table, key.number))


def _number(text: str | None) -> int | None:
    return None if text is None else int(text)
