"""Lists that are typed one per line: questions of a form, arms, who may take part, texts in the study's own words.

A question is ``name | kind | question | more``: for a choice the choices, with semicolons; for a scale (likert) what
its two ends mean. An arm is ``name | methods``, with semicolons. Who may take part is ``name | 18 to 75``, or of a
choice the answers, with semicolons. A text is ``name = text``; it goes on in lines that begin with spaces.
"""

import re
from collections.abc import Iterable, Mapping, Sequence

from pydantic import ValidationError

from app.domain.designs import Arm, Screen
from app.domain.protocol import EvaluatedMethod, FormItem

_SPAN = re.compile(r"^(-?[0-9]+(?:\.[0-9]+)?) to (-?[0-9]+(?:\.[0-9]+)?)$")
_TEXT = re.compile(r"^((?:[a-z]{2}:)?[a-z][a-z0-9-]*)\s*=\s?(.*)$")


class LineBroken(ValueError):
    """A line cannot be understood; says which and why."""


def items_of(typed: str) -> tuple[FormItem, ...]:
    """The questions. Raises LineBroken."""
    items: list[FormItem] = []
    for number, line in enumerate(_lines(typed), 1):
        if not line.strip():
            continue
        item = _item(number, line)
        if any(item.name == other.name for other in items):
            raise LineBroken(f"Line {number}: the name {item.name} is taken by a line above.")
        items.append(item)
    return tuple(items)


def lines_of(items: Iterable[FormItem]) -> str:
    """Questions as they are typed."""
    return "\n".join(" | ".join(_parts(item)) for item in items)


def arms_of(typed: str) -> tuple[Arm, ...]:
    """The arms. Raises LineBroken."""
    return tuple(_arm(number, *_halves(number, line)) for number, line in _filled(typed))


def lines_of_arms(arms: Iterable[Arm]) -> str:
    """Arms as they are typed."""
    return "\n".join(f"{each.name} | {'; '.join(each.methods)}" for each in arms)


def screens_of(typed: str) -> tuple[Screen, ...]:
    """Who may take part. Raises LineBroken."""
    return tuple(_screen(number, *_halves(number, line)) for number, line in _filled(typed))


def lines_of_screens(screens: Iterable[Screen]) -> str:
    """Screens as they are typed."""
    return "\n".join(f"{each.name} | {'; '.join(each.answers) or f'{each.low:g} to {each.high:g}'}" for each in screens)


def _filled(typed: str) -> Sequence[tuple[int, str]]:
    return [(number, line) for number, line in enumerate(_lines(typed), 1) if line.strip()]


def _halves(number: int, line: str) -> tuple[str, str]:
    name, bar, rest = (part.strip() for part in line.partition("|"))
    if not (name and bar and rest):
        raise LineBroken(f"Line {number}: write a name, “|”, and what belongs to it.")
    return name, rest


def _arm(number: int, name: str, rest: str) -> Arm:
    methods = [each.strip() for each in rest.split(";") if each.strip()]
    unknown = [each for each in methods if each not in set(EvaluatedMethod)]
    if unknown:
        raise LineBroken(f"Line {number}: there is no method {unknown[0]}; there are {', '.join(EvaluatedMethod)}.")
    try:
        return Arm.model_validate({"name": name, "methods": methods})
    except ValidationError as found:
        raise LineBroken(f"Line {number}: {_why(found)}") from found


def _screen(number: int, name: str, rest: str) -> Screen:
    span = _SPAN.match(rest)
    answers = [] if span else [each.strip() for each in rest.split(";") if each.strip()]
    low, high = (float(span[1]), float(span[2])) if span else (None, None)
    try:
        return Screen.model_validate({"name": name, "low": low, "high": high, "answers": answers})
    except ValidationError as found:
        raise LineBroken(f"Line {number}: {_why(found)}") from found


def texts_of(typed: str) -> dict[str, str]:
    """The texts by name. Raises LineBroken."""
    texts: dict[str, list[str]] = {}
    name = None
    for number, line in enumerate(_lines(typed), 1):
        found = _TEXT.match(line)
        if found and found[1] in texts:
            raise LineBroken(f"Line {number}: {found[1]} has a text already.")
        if found:
            name = found[1]
            texts[name] = [found[2]]
        elif name is not None and (not line.strip() or line[0].isspace()):
            texts[name].append(line.strip())
        elif line.strip():
            raise LineBroken(f"Line {number}: write “name = text”; lines that go on with a text begin with spaces.")
    return {each: "\n".join(lines).strip() for each, lines in texts.items()}


def lines_of_texts(texts: Mapping[str, str]) -> str:
    """Texts as they are typed."""
    return "\n".join(f"{name} = {text.strip()}".replace("\n", "\n    ") for name, text in texts.items())


def _lines(typed: str) -> Sequence[str]:
    """As they were typed: other characters that some take for the end of a line are part of a text."""
    return re.split(r"\r\n|\r|\n", typed)


def _item(number: int, line: str) -> FormItem:
    name, kind, question, *more = [*(part.strip() for part in line.split("|")), *[""] * 3]
    if kind not in ("choice", "number", "text", "likert"):
        raise LineBroken(f"Line {number}: after the name comes choice, number, text or likert, with “|” between.")
    choices = [choice.strip() for choice in more[0].split(";") if choice.strip()] if kind == "choice" else []
    low, high = more[:2] if kind == "likert" else ("", "")
    try:
        return FormItem.model_validate(
            {"name": name, "kind": kind, "question": question, "choices": choices, "low_label": low, "high_label": high}
        )
    except ValidationError as found:
        raise LineBroken(f"Line {number}: {_why(found)}") from found


def _why(found: ValidationError) -> str:
    error = found.errors()[0]
    place = error["loc"][0] if error["loc"] else ""
    if place == "name":
        return "a name has small letters, digits and underscores, and begins with a letter."
    if place:
        return f"{str(place).replace('_', ' ')}: {error['msg'].lower()}."
    if error["type"] == "value_error" and not error["msg"].endswith("nothing else has any."):
        return error["msg"].removeprefix("Value error, ")
    return "a choice needs its choices, with “;” between them."


def _parts(item: FormItem) -> Sequence[str]:
    parts = [item.name, item.kind, item.question, "; ".join(item.choices)]
    if item.kind == "likert":
        parts = [item.name, item.kind, item.question, item.low_label, item.high_label]
    while not parts[-1]:
        parts.pop()
    return parts
