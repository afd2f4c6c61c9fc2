"""Pages from templates: one Jinja environment, strict about what is missing, and the words for numbers and times."""

import posixpath
import re
from collections.abc import Callable, Iterable, Mapping
from datetime import datetime
from functools import cache
from math import floor, log10
from pathlib import PurePosixPath
from typing import Any

from fastapi import Request
from fastapi.responses import HTMLResponse
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from starlette.datastructures import URLPath

from app.db import now
from app.paths import STATIC, TEMPLATES
from app.web.texts.own_texts import missing_facts, missing_translations
from app.web.texts.task_words import words_of
from app.web.texts.wording import page_language, say, study_question

_UNITS = {
    "_rad2_s2": "rad²/s²",
    "_n2": "N²",
    "_m2_s2": "m²/s²",
    "_m2_s4": "m²/s⁴",
    "_m_s": "m/s",
    "_m": "m",
    "_n": "N",
    "_rad": "rad",
}
_IMPORT = re.compile(r"""^import .* from "(\.[a-z_./]+\.js)";$""", re.MULTILINE)
_MINUTE_S, _HOUR_S, _DAY_S = 60, 3600, 86400


def percent(share: float) -> str:
    """A share as whole percent."""
    return f"{share * 100:.0f}\N{NO-BREAK SPACE}%"


def signed_points(difference: float) -> str:
    """A difference of shares in percentage points, with its sign."""
    return _minus(f"{difference * 100:+z.1f}")


def quantity(value: float | None) -> str:
    """A number with three significant digits."""
    return "\N{EN DASH}" if value is None else _minus(_rounded(value, 3))


def signed(value: float) -> str:
    """A difference with its sign and two significant digits."""
    return _minus(("+" if value > 0 else "") + _rounded(value, 2))


def ago(moment: datetime | None) -> str:
    """How long ago, coarse enough not to change while one looks at it."""
    if moment is None:
        return "never"
    seconds = (now() - moment).total_seconds()
    if seconds < _MINUTE_S:
        return "just now"
    if seconds < _HOUR_S:
        return f"{seconds // _MINUTE_S:.0f} min ago"
    if seconds < 2 * _DAY_S:
        return f"{seconds // _HOUR_S:.0f} h ago"
    return f"{seconds // _DAY_S:.0f} days ago"


def time_left(seconds: int) -> str:
    """A remaining time, rounded as roughly as it is known."""
    if seconds < 90:
        return "about a minute"
    minutes = round(seconds / _MINUTE_S)
    return f"about {minutes} min" if minutes < 90 else f"about {seconds / _HOUR_S:.1f} h"


def moment(value: datetime) -> str:
    """A time as people write it, in UTC."""
    return value.strftime("%Y-%m-%d %H:%M UTC")


def seconds(value_ms: int) -> str:
    """A time in milliseconds as seconds."""
    return f"{value_ms / 1000:.1f} s"


def bytes_in_words(count: int) -> str:
    """A number of bytes in the unit that suits it."""
    size = float(count)
    for unit in ("B", "kB", "MB"):
        if size < 1000:
            return f"{size:.0f} {unit}"
        size /= 1000
    return f"{size:.1f} GB"


def in_words(name: str) -> str:
    """An identifier as words: speed_squared_m2_s2 becomes "speed squared (m²/s²)"."""
    for suffix, unit in _UNITS.items():
        if name.endswith(suffix):
            return f"{name.removesuffix(suffix).replace('_', ' ')} ({unit})"
    return name.replace("_", " ")


def named(values: Iterable[str], names: Mapping[str, str] | None = None) -> list[tuple[str, str]]:
    """Values with what people call them, as the options of a select need them."""
    return [(str(value), (names or {}).get(str(value), str(value))) for value in values]


def task_title(task: str) -> str:
    """What people call a task."""
    return words_of(task).title


def page(request: Request, template: str, context: Mapping[str, Any], status: int = 200) -> HTMLResponse:
    """A whole page; ``may_change``: what changes something is offered to whoever asks for it."""
    may_change = getattr(request.state, "may_change", True)
    return HTMLResponse(fragment(request, template, {"may_change": may_change, **context}), status)


def fragment(request: Request, template: str, context: Mapping[str, Any]) -> str:
    """The text of one template."""
    environment: Environment = request.app.state.templates
    return environment.get_template(template).render(context)


@cache
def imports_of(script: str) -> tuple[str, ...]:
    """The modules that a script of ours imports, and those that they import, each once, by their paths in static/."""
    path = PurePosixPath(script)
    written = _IMPORT.findall((STATIC / path).read_text(encoding="utf-8"))
    direct = [posixpath.normpath(path.parent / each) for each in written]
    return tuple(dict.fromkeys(name for each in direct for name in (each, *imports_of(each))))


def make_environment(path_for: Callable[..., URLPath]) -> Environment:
    """The environment of every template: escapes everything, and refuses names that were not given.

    ``path_for`` gives the path of a route by its name.
    """
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    numbers = (percent, signed_points, quantity, signed)
    words = (ago, time_left, moment, seconds, bytes_in_words, in_words, named, task_title)
    environment.filters.update({word.__name__: word for word in (*numbers, *words)})
    environment.globals["path_for"] = path_for
    for word in (say, page_language, study_question, imports_of, missing_facts, missing_translations):
        environment.globals[word.__name__] = word
    return environment


def _rounded(value: float, significant_digits: int) -> str:
    if value == 0:
        return "0"
    decimals = max(0, significant_digits - 1 - floor(log10(abs(value))))
    return f"{value:.{min(decimals, 4)}f}"


def _minus(text: str) -> str:
    """A typographic minus lines up with plus."""
    return text.replace("-", "\N{MINUS SIGN}")
