"""Standard questionnaires: items, wording, scoring key and source of each, read from its data file.

A score is the mean of its items, those that are reversed mirrored within the range of answers; where the source gives
the score another range (SUS: 0 to 100), the mean is mapped linearly onto it. An item that was left out leaves its
scores empty (``missing = "none"``) or counts as the centre of the range (``"centre"``), as the source has it.

A wording is in the languages that the file has. What it lacks, of an instrument whose words are not free all of it, a
study has to give itself, as texts called ``scale-`` and the instrument and the part: ``de:scale-sus-complex``.
"""

import tomllib
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from statistics import fmean
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

_Name = Field(pattern=r"^[a-z][a-z0-9_]{0,39}$")


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Words(_Part):
    """One text by language; empty where there is none."""

    en: str = ""
    de: str = ""


class Labels(_Part):
    """What every point means, by language; empty where only the two ends say something."""

    en: tuple[str, ...] = ()
    de: tuple[str, ...] = ()


class Answers(_Part):
    """The points that people choose from, and what they are called where each has a name."""

    lowest: int
    highest: int
    step: int = 1
    labels: Labels = Labels()

    @property
    def points(self) -> Sequence[str]:
        """As they are stored, ascending."""
        return [str(point) for point in range(self.lowest, self.highest + 1, self.step)]


class Item(Words):
    """One question. One without words of its own is called by its two ends."""

    name: str = _Name
    reversed: bool = False
    low: Words | None = None
    high: Words | None = None


class Score(_Part):
    """A scale or subscale, and its items. ``lowest`` and ``highest``: its range where that is not the answers'."""

    name: str = _Name
    title: str
    items: tuple[str, ...]
    lowest: int | None = None
    highest: int | None = None


class Instrument(_Part):
    """A standard questionnaire."""

    name: str = Field(pattern=r"^[a-z][a-z0-9_]{0,19}$")
    title: str
    about: str
    """For the form of a study: what it measures, how long it is, which languages it has."""
    measures: str
    citation: str
    licence: str
    wording: str
    """Where the words come from, and what was changed."""
    missing: Literal["none", "centre"]
    missing_because: str
    answers: Answers
    instruction: Words = Words()
    low: Words = Words()
    high: Words = Words()
    items: tuple[Item, ...]
    scores: tuple[Score, ...]

    @model_validator(mode="after")
    def _fits_together(self) -> "Instrument":
        names = [item.name for item in self.items]
        unknown = {name for score in self.scores for name in score.items} - set(names)
        if unknown or len(set(names)) < len(names):
            raise ValueError(f"{self.name}: items {sorted(unknown) or names} are unknown or named twice.")
        return self

    def published(self, language: str) -> dict[str, str]:
        """The words of every part in a language, by part; empty where the file has none.

        Parts: ``instruction``, ``low`` and ``high`` (the ends of the range), every item by its name, and its own ends
        as ``<item>-low`` and ``<item>-high``.
        """
        parts = {"instruction": getattr(self.instruction, language)}
        if any(item.low is None for item in self.items):
            labels = getattr(self.answers.labels, language)
            ends = (labels[0], labels[-1]) if labels else (getattr(self.low, language), getattr(self.high, language))
            parts |= {"low": ends[0], "high": ends[1]}
        for item in self.items:
            if item.low is None or item.high is None:
                parts[item.name] = getattr(item, language)
                continue
            ends = getattr(item.low, language), getattr(item.high, language)
            if item.en:
                parts[item.name] = getattr(item, language)
            parts |= {f"{item.name}-low": ends[0], f"{item.name}-high": ends[1]}
        return parts

    def score(self, score: Score, answers: Mapping[str, float | None]) -> float | None:
        """What somebody's answers come to; None where the source's rule for missing items gives no score."""
        given = [answers.get(name) for name in score.items]
        if all(each is None for each in given) or (self.missing == "none" and None in given):
            return None
        low, high = self.answers.lowest, self.answers.highest
        mean = fmean(self.keyed(name, answers) for name in score.items)
        bottom, top = self.range_of(score)
        return bottom + (mean - low) * (top - bottom) / (high - low)

    def keyed(self, name: str, answers: Mapping[str, float | None]) -> float:
        """The answer to an item as it enters its scores: mirrored where it is reversed, the centre where left out."""
        low, high = self.answers.lowest, self.answers.highest
        value = answers.get(name)
        value = (low + high) / 2 if value is None else value
        return low + high - value if name in self.reversed_items else value

    @property
    def reversed_items(self) -> Sequence[str]:
        """Items that say the opposite of their scores."""
        return [item.name for item in self.items if item.reversed]

    def range_of(self, score: Score) -> tuple[int, int]:
        """The lowest and the highest value a score can have."""
        low = self.answers.lowest if score.lowest is None else score.lowest
        return low, self.answers.highest if score.highest is None else score.highest


def text_name(instrument: str, part: str) -> str:
    """What a study's own words for a part of an instrument are called."""
    return f"scale-{instrument}-{part}".replace("_", "-")


@cache
def every() -> Mapping[str, Instrument]:
    """All questionnaires by name, in the order of their files."""
    files = sorted(Path(__file__).parent.glob("*.toml"))
    read = {path.stem: tomllib.loads(path.read_text(encoding="utf-8")) for path in files}
    return {name: Instrument.model_validate({"name": name, **contents}) for name, contents in read.items()}
