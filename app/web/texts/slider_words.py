"""What participants read beside a slider: the way of moving it stands for, and what each of its places is called."""

from app.installed_tasks import catalogue
from app.installed_tasks.description import SliderWords
from app.web.texts import task_words
from app.web.texts.wording import Wording

_OF_ACTIONS = ("push", "shift", "gain")
"""Ways that there are for each action or group of them; its name follows."""


def words_of(wording: Wording, task: str, axis: str) -> SliderWords:
    """The task's own words in this language; else those that all tasks share; else what experimenters read."""
    installed = catalogue.find(task)
    own = installed.description.sliders.get(axis, {}) if installed else {}
    if wording.language in own:
        return own[wording.language]
    key = f"setting-{axis}"
    if key in wording:
        return SliderWords(label=wording(key), low=wording(f"{key}-low"), high=wording(f"{key}-high"))
    way, _, action = axis.partition("_")
    if way in _OF_ACTIONS:
        label = wording(f"setting-{way}", name=action.replace("_", " "))
    else:
        label = task_words.words_of(task).axes.get(axis) or axis.replace("_", " ").capitalize()
    return SliderWords(label=label, low=wording("setting-less"), high=wording("setting-more"))


def place_in_words(wording: Wording, words: SliderWords, stop: int) -> str:
    """What a slider says when it stands there, as a screen reader does: ``slower, clearly``."""
    if stop == 0:
        return wording("setting-middle")
    degree = wording(f"setting-degree-{abs(stop)}")
    return wording("setting-place", end=words.low if stop < 0 else words.high, degree=degree)
