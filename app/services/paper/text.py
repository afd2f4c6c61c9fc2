"""The text of methods and results that an experimenter pastes into a paper; while blinded, of methods alone."""

from collections.abc import Iterator

from sqlalchemy.orm import Session

from app.domain.studies import Study
from app.services.evaluation import unblinding
from app.services.paper.methods import methods_part
from app.services.paper.people import closing_answers
from app.services.paper.prose import quoted
from app.services.paper.results import results_part
from app.services.runs import reports
from app.services.studies import preregistration

FILE_NAME = "methods_and_results.md"


def methods_and_results(session: Session, study: Study) -> str:
    """Markdown. Counts are of now, statistics those of the newest report."""
    return "\n\n".join(each for each in _paragraphs(session, study) if each) + "\n"


def _paragraphs(session: Session, study: Study) -> Iterator[str]:
    yield (
        f"> Written from the data of the study “{quoted(study.name)}”. Every number was recorded or computed; what the "
        "studio cannot know is marked as not recorded. Read it, shorten it, and put it into your own words."
    )
    yield from methods_part(session, study)
    report = reports.newest(session, study)
    if unblinding.is_blinded(study) or (report is not None and report.contents["blinded"]):
        yield "> The study is blinded. The results are written once it is unblinded and a report has been made since."
    elif report is None:
        yield "> There are no results yet: no report has been made."
    else:
        yield from results_part(report.contents, preregistration.plan_of(session, study))
        yield from closing_answers(session, study)
        yield f"> Statistics: report of {report.created_at:%Y-%m-%d %H:%M} UTC."
