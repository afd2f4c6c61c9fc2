"""What participants read of the hints that they can give."""

from collections.abc import Iterable, Sequence

from app.installed_tasks import catalogue, hints
from app.web.texts.wording import Wording


def words_of(wording: Wording, task: str, names: Iterable[str]) -> Sequence[tuple[str, str]]:
    """(name, words) of each; a hint that the task does not know any more is left out."""
    known, installed = hints.of_task(task), catalogue.find(task)
    declared = installed.description.hints if installed else {}

    def word(name: str) -> str:
        said = known[name].words.get(wording.language) or known[name].words["en"]
        if name in declared:
            return said
        return wording("hints-less" if known[name].less else "hints-more", what=said)

    return [(name, word(name)) for name in names if name in known]
