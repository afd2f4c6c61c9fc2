"""A task's folder, as far as it can be read without running any of its code: ``task.toml`` and ``picture.svg``."""

import re
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar
from xml.etree import ElementTree

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import ErrorDetails

DESCRIPTION, PICTURE, CHECKPOINT = "task.toml", "picture.svg", "checkpoint"
SHORTEST_CLIP_STEPS, LONGEST_CLIP_STEPS = 20, 600
"""Control steps of 0.1 s."""
NAME = "[a-z][a-z0-9_]{0,39}"
PICTURE_FRAME = "0 0 240 150"
_SHAPES = {"g", "path", "circle", "ellipse", "rect", "line", "polyline", "polygon"}
_PLACES = {"cx", "cy", "x", "y", "x1", "y1", "x2", "y2"}
_ATTRIBUTES = {"class", "d", "points", "transform", "width", "height", "r", "rx", "ry"} | _PLACES


def _flowing(text: str) -> str:
    """An empty line makes a paragraph; other line breaks are those of the file."""
    if "{" in text or "}" in text:
        raise ValueError("must not have braces, which mean a variable in the texts of pages")
    return "\n\n".join(" ".join(paragraph.split()) for paragraph in re.split(r"\n\s*\n", text.strip()))


def _code(language: str) -> str:
    if not re.fullmatch("[a-z]{2,3}", language):
        raise ValueError("must be the code of a language, such as en")
    return language


_EXPLAINED = {
    "missing": "is missing",
    "extra_forbidden": "is not known here",
}


def like(pattern: str, words: str) -> AfterValidator:
    """Text has to look so; else ``words`` say what it must be."""

    def matching(said: str) -> str:
        if not re.fullmatch(pattern, said):
            raise ValueError(f"must be {words}")
        return said

    return AfterValidator(matching)


NAMED = like(NAME, "at most 40 small letters, digits and underscores, and begin with a letter")
Word = Annotated[str, Field(min_length=1, max_length=200)]
Text = Annotated[str, Field(min_length=1, max_length=4000), AfterValidator(_flowing)]
LanguageCode = Annotated[str, AfterValidator(_code)]
Reference = Annotated[
    str, like(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*", "like module:name, a name in a module of the package")
]
"""An object of the task's package: ``module:name``."""


_Described = TypeVar("_Described", bound="DescribedTask")


class TaskRefused(ValueError):
    """A task's folder is not as it must be; the message says where and why."""


class Words(BaseModel):
    """What experimenters' pages call the parts of a task, in English."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    tool: Word
    """what the robot holds"""
    target: Word
    """where it goes"""
    carried: Word | None = None
    """what can be spilled; None: nothing"""
    axes: dict[str, Word] = {}
    """The ways in which executions differ, beyond those of every approach; the sign says which end."""
    silent_signals: frozenset[str] = frozenset()
    """Always 0 in this task; a weight of them says nothing."""


class SliderWords(BaseModel):
    """What participants read beside the slider of one axis."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    label: Word
    low: Word
    """its left end, the negative values; where there are none it is not shown"""
    high: Word


class HintedAt(BaseModel):
    """What somebody may wish for in general: a direction of some signals, and what participants read of it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    less: tuple[str, ...] = ()
    """signals that are to be less"""
    more: tuple[str, ...] = ()
    words: dict[LanguageCode, Word]
    """as in "slower near me"; en is needed"""

    @model_validator(mode="after")
    def _says_something(self) -> Self:
        if not (self.less or self.more) or set(self.less) & set(self.more):
            raise ValueError("needs signals in less or in more, none in both")
        if "en" not in self.words:
            raise ValueError("needs words.en")
        return self

    def contradicts(self, other: "HintedAt") -> bool:
        """Whether both cannot be wished for at once."""
        return bool(set(self.less) & set(other.more) or set(self.more) & set(other.less))


class DescribedTask(BaseModel):
    """What both ways to describe a task say: a folder of code with ``task.toml``, and a ``lab.toml``."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    title: str = Field(min_length=1, max_length=60)
    summary: str = Field(max_length=200)
    """One sentence for the person who chooses a task."""
    episode_steps: int = Field(ge=SHORTEST_CLIP_STEPS, le=LONGEST_CLIP_STEPS)
    usual_clip_steps: int = Field(ge=SHORTEST_CLIP_STEPS)
    """from the start, in which what matters has happened"""
    words: Words
    instructions: dict[LanguageCode, Text]
    """What participants read of the task, by language; an empty line makes a paragraph."""
    sliders: dict[str, dict[LanguageCode, SliderWords]] = {}
    """What participants who set a robot themselves read beside the slider of an axis, by axis and language; where it is
    missing, the words that all tasks share."""
    hints: dict[Annotated[str, NAMED], HintedAt] = {}
    """What participants may wish for in general, where a study asks; their order is that of the file."""

    @property
    def policy_is_looked_into(self) -> bool:
        """Whether methods may use the policy's own weights, and not only ask it what it does."""
        return True

    @property
    def policy_is_packed(self) -> bool:
        """Whether bundles hold the policy itself."""
        return True

    @property
    def most_behaviours(self) -> int | None:
        """In how many ways a scenario can be executed; None: in as many as are asked for."""
        return None

    @model_validator(mode="after")
    def _shown_within_the_episode(self) -> Self:
        if self.usual_clip_steps > self.episode_steps:
            raise ValueError(f"usual_clip_steps must not be more than the {self.episode_steps} steps of an episode")
        return self


class TaskDescription(DescribedTask):
    """What ``task.toml`` says."""

    environment: Reference
    """a subclass of worker.sim.assistive.AssistiveEnv"""
    look: Reference | None = None
    """a worker.sim.render.task_look.TaskLook; None: the usual one"""
    demonstrator: Reference | None = None
    """returns a scripted controller that the reference policy imitates first; None: trial and error alone"""
    training: dict[str, Any] = {}
    """What the reference policy's training does otherwise than worker.ml.policies.sac.SacConfig."""


@dataclass(frozen=True)
class InstalledTask:
    """One task that studies can have."""

    name: str
    """as stored in studies, trajectories and bundles"""
    package: str
    folder: Path
    description: DescribedTask
    picture: str
    """shapes beside a seated person, as SVG; empty: none"""

    @property
    def checkpoint(self) -> Path:
        """The folder with the reference policy and what was learned with it."""
        return self.folder / CHECKPOINT

    @property
    def archive(self) -> Path:
        """The folder of the policies that were refined for it beforehand; it need not have any."""
        return self.checkpoint / "refined"


def read(name: str, package: str, folder: Path) -> InstalledTask:
    """What a folder says. Raises TaskRefused."""
    return InstalledTask(name, package, folder, _description(folder / DESCRIPTION), _picture(folder / PICTURE))


def _description(file: Path) -> TaskDescription:
    return parsed(TaskDescription, file)


def parsed(kind: type[_Described], file: Path) -> _Described:
    """What a TOML file says. Raises TaskRefused, which names the file and every key that is wrong."""
    try:
        return kind.model_validate(tomllib.loads(_text(file)))
    except tomllib.TOMLDecodeError as error:
        raise TaskRefused(f"{file} is not valid TOML: {error}.") from error
    except ValidationError as error:
        raise TaskRefused(f"{file}: {'; '.join(map(_in_words, error.errors()))}.") from error


def _in_words(wrong: ErrorDetails) -> str:
    place, said = ".".join(map(str, wrong["loc"])), wrong["msg"]
    if wrong["type"] in _EXPLAINED:
        return f"{place} {_EXPLAINED[wrong['type']]}"
    if wrong["type"] == "value_error":
        return f"{place} {said.removeprefix('Value error, ')}".strip()
    return f"{place}: {said}"


def _picture(file: Path) -> str:
    """Its shapes alone, so that a page can hold them."""
    if not file.exists():
        return ""
    try:
        drawing = ElementTree.fromstring(_text(file))  # noqa: S314 -- its package runs code anyway, and expat caps entities
    except ElementTree.ParseError as error:
        raise TaskRefused(f"{file} is not valid SVG: {error}.") from error
    if drawing.get("viewBox") != PICTURE_FRAME:
        raise TaskRefused(f'{file}: its viewBox must be "{PICTURE_FRAME}", the person sits on the left of it.')
    for element in drawing.iter():
        element.tag = element.tag.rpartition("}")[2]
        unknown = [element.tag] if element.tag not in _SHAPES else sorted(set(element.keys()) - _ATTRIBUTES)
        if element is not drawing and unknown:
            raise TaskRefused(f"{file}: a picture has no {unknown[0]}; use {', '.join(sorted(_SHAPES))} and classes.")
    return "".join(ElementTree.tostring(shape, encoding="unicode") for shape in drawing)


def _text(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8")
    except OSError as error:
        raise TaskRefused(f"{file} cannot be read: {error.strerror}.") from error
    except UnicodeDecodeError as error:
        raise TaskRefused(f"{file} is not UTF-8.") from error
