"""A browser without scripts, as far as a rehearsal needs one: follows redirects, fills in forms, presses buttons.

Whoever sits in front of it answers whatever a page asks (``Visitor``), so that every study can be gone through.
"""

import re
import secrets
import ssl
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from functools import cache
from html.parser import HTMLParser
from typing import Protocol, Self
from urllib.parse import urljoin

import httpx2

from app.errors import AppError

_LANGUAGE = re.compile(r"/p/language$")
_AGAIN = "/p/next"
_TAGS = re.compile(r"<(?:main|form|input|button|textarea|select)\b[^>]*>|</textarea>")
"""What is read of a page: our templates escape > in attributes, and the parser takes longer than the server."""


class Asked(Enum):
    """What a page asks for; the value: where its form is sent."""

    PAIR = re.compile(r"/p/queries/(\d+)/label$")
    BREAK = re.compile(r"/p/break$")
    HINTS = re.compile(r"/p/hints$")
    SLIDERS = re.compile(r"/p/setting$")
    RATING = re.compile(r"/p/evaluation/trials/(\d+)/rating$")
    HEAD_TO_HEAD = re.compile(r"/p/head-to-heads/(\d+)/answer$")
    ROBOT_SCALE = re.compile(r"/p/evaluation/robots/([A-E])/([a-z0-9_]+)$")
    SCALE = re.compile(r"/p/questionnaire/([a-z0-9_]+)$")
    QUESTIONS = re.compile(r"/p/(demographics|questionnaire)$")
    GOING_ON = re.compile(r"/p/(?:consent|instructions|debrief)$")
    """One button."""


MATTERED = "mattered"
"""The field of what made the difference between two clips."""
HINT = "hint-"
"""Before the name of a hint in the name of its box."""
OVER = ("finished", "ended")
"""Pages, by the name they give themselves, after which there is nothing to do: the end, and being sent back before."""
WAITING = ("waiting", "self-setting-waiting", "evaluation-waiting")
"""Pages that wait for the studio."""
UP_TO_PAIRS = ("consent", "demographics", "instructions", "practice", "pair", "hints", "break", "waiting")
"""Pages up to the last pair."""


@dataclass(frozen=True)
class Offered:
    """One question of a form as a browser sees it."""

    kind: str
    """choice, number or text"""
    choices: Sequence[str] = ()


@dataclass
class Form:
    """A form of a page: what is sent when somebody only presses its button, and what could be filled in."""

    action: str
    fields: dict[str, str] = field(default_factory=dict)
    questions: dict[str, Offered] = field(default_factory=dict)


class Visitor(Protocol):
    """Who answers; every method gets what the page's address says, and gives what is filled in."""

    def answer(self, query_id: int) -> str:
        """Which of two clips: an answer's name."""

    def name_quality(self, query_id: int, answer: str) -> str:
        """What made the difference between them; empty: nothing in particular."""

    def hint(self, names: Sequence[str]) -> Sequence[str]:
        """Which of these hints."""

    def set_robot(self) -> Mapping[str, int]:
        """The place of every slider, by axis."""

    def rate(self, trial_id: int) -> tuple[int, int]:
        """Satisfaction and personalisation."""

    def prefer(self, head_to_head_id: int) -> str:
        """Which of two robots: left, right or equal."""

    def describe(self, instrument: str, letter: str | None) -> Mapping[str, str]:
        """The points of a standard questionnaire, about the robot of this letter or about none."""

    def reply(self, questions: Mapping[str, Offered]) -> Mapping[str, str]:
        """Answers to the study's own questions, and reasons in words."""


class WentAstray(AppError):
    """A page was not what a visitor expects."""


class FormBrowser:
    """One visitor with cookies of their own; a context that closes the connection at its end."""

    def __init__(self, base_url: str, path: str) -> None:
        self._client = httpx2.Client(
            base_url=base_url, follow_redirects=True, timeout=60.0, headers={"Origin": base_url}, verify=_trusted()
        )
        self._page = _Page("", "")
        self._first = path

    def __enter__(self) -> Self:
        self._open(self._first)
        return self

    def __exit__(self, *exception: object) -> None:
        self._client.close()

    def log_in(self, name: str, password: str) -> None:
        """As an experimenter, choosing a new password on the way when asked to."""
        self._send_first({"name": name, "password": password})
        chosen = secrets.token_urlsafe(16)
        if "/password" in self._page.address:
            self._send_first({"current": password, "new": chosen, "again": chosen})

    def fill_in(self, path: str, **filled_in: str) -> None:
        """Open the page at this address and send its form to the same address."""
        self._open(path)
        form = next((each for each in self._page.forms if each.action.endswith(path)), None)
        if form is None:
            raise WentAstray(f"There is no form to {path} on {self._page.address}.")
        self._send(path, {**form.fields, **filled_in})

    def download(self, path: str) -> bytes:
        """The bytes behind an address."""
        response = self._client.get(path)
        if response.is_error:
            raise WentAstray(f"GET {path} answered {response.status_code}.")
        return response.content

    @property
    def page(self) -> str:
        """The name that the page gives itself, such as pair, waiting or finished."""
        return self._page.name

    @property
    def text(self) -> str:
        """The page as it was sent."""
        return self._page.text

    def look(self) -> None:
        """Open the page on which one should be now."""
        self._open(_AGAIN)

    def query_id(self) -> int | None:
        """The pair on the page; None where there is none."""
        found = self._asked()
        return int(found[1].group(1)) if found is not None and found[0] is Asked.PAIR else None

    def act(self, visitor: Visitor) -> Asked | None:
        """Do what the page asks; None, and the page anew, where there is nothing to do but to wait or to go on."""
        found = self._asked()
        if found is None:
            self.look()
            return None
        asked, match, form = found
        self._send(match.group(0), {**form.fields, **_filled_in(visitor, asked, match.groups(), form)})
        return asked

    def _asked(self) -> tuple[Asked, re.Match[str], Form] | None:
        for form in self._page.forms:
            for asked in Asked:
                if self._page.name not in OVER and (match := asked.value.search(form.action)):
                    return asked, match, form
        return None

    def _send_first(self, filled_in: dict[str, str]) -> None:
        """Send the page's first form, that for the language left out, with these fields filled in."""
        forms = [form for form in self._page.forms if not _LANGUAGE.search(form.action)]
        if not forms:
            raise WentAstray(f"There is nothing to press on {self._page.address}.")
        self._send(forms[0].action, {**forms[0].fields, **filled_in})

    def _open(self, path: str) -> None:
        self._arrive(self._client.get(path))

    def _send(self, path: str, fields: dict[str, str]) -> None:
        self._arrive(self._client.post(urljoin(self._page.address or "/", path), data=fields))

    def _arrive(self, response: httpx2.Response) -> None:
        if response.is_error:
            raise WentAstray(f"{response.request.method} {response.url.path} answered {response.status_code}.")
        self._page = _Page(str(response.url), response.text)


@cache
def _trusted() -> ssl.SSLContext:
    """Whom to trust, read once for all visitors: it takes a tenth of a second."""
    return httpx2.create_ssl_context()


def _filled_in(visitor: Visitor, asked: Asked, says: tuple[str, ...], form: Form) -> dict[str, str]:
    """What the visitor fills in; in words as well where there is room for it."""
    words = {name: each for name, each in form.questions.items() if name == "reason"}
    match asked:
        case Asked.PAIR:
            said = visitor.answer(int(says[0]))
            mattered = visitor.name_quality(int(says[0]), said) if MATTERED in form.questions else ""
            return {"response": said, MATTERED: mattered}
        case Asked.HINTS:
            names = [name.removeprefix(HINT) for name in form.questions]
            return {f"{HINT}{name}": "yes" for name in visitor.hint(names)}
        case Asked.SLIDERS:
            return {"goes_on": "true", **{f"axis-{axis}": str(stop) for axis, stop in visitor.set_robot().items()}}
        case Asked.RATING:
            satisfaction, personalisation = visitor.rate(int(says[0]))
            points = {"satisfaction": str(satisfaction), "personalisation": str(personalisation)}
            return {**points, **visitor.reply(words)}
        case Asked.HEAD_TO_HEAD:
            return {"response": visitor.prefer(int(says[0])), **visitor.reply(words)}
        case Asked.ROBOT_SCALE:
            return dict(visitor.describe(says[1], says[0]))
        case Asked.SCALE:
            return dict(visitor.describe(says[0], None))
        case Asked.QUESTIONS:
            return dict(visitor.reply(form.questions))
        case Asked.BREAK | Asked.GOING_ON:
            return {}


class _Page(HTMLParser):
    """The forms of a page with the fields a person would leave as they are; boxes are ticked, nothing is chosen."""

    def __init__(self, address: str, text: str) -> None:
        super().__init__()
        self.address, self.text, self.name = address, text, ""
        self.forms: list[Form] = []
        self.feed("".join(_TAGS.findall(text)))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collect forms and their fields."""
        named = {name: value or "" for name, value in attrs}
        self.name = named.get("data-page", self.name)
        if tag == "form" and named.get("method", "").lower() == "post":
            self.forms.append(Form(named.get("action", "")))
        elif tag in ("input", "button", "textarea", "select") and self.forms and named.get("name"):
            self._field(tag, named["name"], named)

    def _field(self, tag: str, name: str, named: dict[str, str]) -> None:
        form, kind, value = self.forms[-1], named.get("type", "text"), named.get("value", "on")
        if tag == "input" and kind == "radio":
            choices = form.questions.get(name, Offered("choice")).choices
            form.questions[name] = Offered("choice", [*choices, value] if value else choices)
        elif tag == "select" or (kind == "checkbox" and name.startswith(HINT)):
            form.questions[name] = Offered("choice")
            return
        elif tag == "textarea" or (tag == "input" and kind == "text"):
            form.questions[name] = Offered("number" if named.get("inputmode") == "decimal" else "text")
        if tag in ("input", "button") and (kind != "radio" or "checked" in named):
            form.fields.setdefault(name, named.get("value", "on"))
