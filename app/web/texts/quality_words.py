"""What participants read when they are asked what made the difference between two clips."""

from collections.abc import Sequence

from app.installed_tasks import catalogue, qualities
from app.installed_tasks.lab import LabDescription
from app.web.texts.wording import Wording


def words_of(wording: Wording, task: str) -> Sequence[tuple[str, str]]:
    """(name, words) of what can be said, in the order of the page."""
    installed = catalogue.find(task)
    description = installed.description if installed else None
    own = description.signals if isinstance(description, LabDescription) else {}

    def word(name: str) -> str:
        if name in own:
            words = own[name].words
            return words.get(wording.language) or words["en"]
        return wording(f"mattered-{name}")

    return [(name, word(name)) for name in qualities.of_task(task)]
