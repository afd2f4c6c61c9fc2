"""A browser without scripts, as far as a rehearsal needs one: follows redirects, fills in forms, presses buttons."""

import re
import secrets
import time
from collections.abc import Mapping
from dataclasses import dataclass
from html.parser import HTMLParser
from typing import Self
from urllib.parse import urljoin

import httpx2

from app.errors import AppError

_QUERY = re.compile(r"/p/queries/(\d+)/label")
_BREAK = re.compile(r"/p/break$")
_RATING = re.compile(r"/p/evaluation/trials/(\d+)/rating")
_SETTING = re.compile(r"/p/setting$")
_HEAD_TO_HEAD = re.compile(r"/p/head-to-heads/(\d+)/answer")
_SCALE = re.compile(r"/p/(?:questionnaire|evaluation/robots/[A-E])/[a-z0-9_]+$")
_LANGUAGE = re.compile(r"/p/language$")
_END = "/p/finished"
_MOST_PAGES = 60
"""Forms between the pairs and the end."""


class WentAstray(AppError):
    """A page was not what a visitor expects."""


class FormBrowser:
    """One visitor with cookies of their own; a context that closes the connection at its end."""

    def __init__(self, base_url: str, path: str) -> None:
        self._client = httpx2.Client(
            base_url=base_url, follow_redirects=True, timeout=60.0, headers={"Origin": base_url}
        )
        self._page = _Page("", "")
        self._first = path

    def __enter__(self) -> Self:
        self._open(self._first)
        return self

    def __exit__(self, *exception: object) -> None:
        self._client.close()

    def come_in(self) -> None:
        """Go through consent and instructions to the first pair."""
        for _ in range(5):
            if self._page.address.endswith("/p/next") or self._page.form_to(_QUERY):
                return
            self._send_first({})
        raise WentAstray(f"The way from the personal link to the first pair ended at {self._page.address}.")

    def log_in(self, name: str, password: str) -> None:
        """As an experimenter, choosing a new password on the way when asked to."""
        self._send_first({"name": name, "password": password})
        chosen = secrets.token_urlsafe(16)
        if "/password" in self._page.address:
            self._send_first({"current": password, "new": chosen, "again": chosen})

    def fill_in(self, path: str, **filled_in: str) -> None:
        """Open the page at this address and send its form to the same address."""
        self._open(path)
        form = self._page.form_to(re.compile(rf"{re.escape(path)}$"))
        if form is None:
            raise WentAstray(f"There is no form to {path} on {self._page.address}.")
        self._send(form.target.group(0), {**form.fields, **filled_in})

    def download(self, path: str) -> bytes:
        """The bytes behind an address."""
        response = self._client.get(path)
        if response.is_error:
            raise WentAstray(f"GET {path} answered {response.status_code}.")
        return response.content

    def query_id(self) -> int | None:
        """The query on the page, after loading the page anew; None while there is none. Breaks are not needed."""
        self._open("/p/next")
        if rest := self._page.form_to(_BREAK):
            self._send(rest.target.group(0), rest.fields)
        form = self._page.form_to(_QUERY)
        return None if form is None else int(form.target.group(1))

    @property
    def text(self) -> str:
        """The page as it was sent."""
        return self._page.text

    def answer(self, response: str) -> float:
        """Press a button; returns the seconds until the next page was there."""
        form = self._page.form_to(_QUERY)
        if form is None:
            raise WentAstray(f"There is no pair on {self._page.address}.")
        started = time.perf_counter()
        self._send(form.target.group(0), {**form.fields, "response": response})
        return time.perf_counter() - started

    def trial_id(self) -> int | None:
        """The trial to be rated on the page, after loading it anew; None while the robots are prepared."""
        self._open_after_scales()
        form = self._page.form_to(_RATING)
        return None if form is None else int(form.target.group(1))

    def rate(self, satisfaction: int, personalisation: int) -> None:
        """Give a rating and go on."""
        form = self._page.form_to(_RATING)
        if form is None:
            raise WentAstray(f"There is no robot to rate on {self._page.address}.")
        points = {"satisfaction": str(satisfaction), "personalisation": str(personalisation)}
        self._send(form.target.group(0), {**form.fields, **points})

    def head_to_head_id(self) -> int | None:
        """The head-to-head on the page, after loading it anew; None while there is none."""
        self._open_after_scales()
        form = self._page.form_to(_HEAD_TO_HEAD)
        return None if form is None else int(form.target.group(1))

    def prefer(self, response: str) -> None:
        """Answer the head-to-head and go on."""
        form = self._page.form_to(_HEAD_TO_HEAD)
        if form is None:
            raise WentAstray(f"There are no two robots to compare on {self._page.address}.")
        self._send(form.target.group(0), {**form.fields, "response": response})

    def is_at_sliders(self) -> bool | None:
        """Whether the sliders are on the page, after loading it anew; None while there are none."""
        self._open("/p/next")
        return self._page.form_to(_SETTING) is not None or None

    def set_robot(self, stops: Mapping[str, int]) -> None:
        """Move the sliders to these places, by axis, and go on."""
        form = self._page.form_to(_SETTING)
        if form is None:
            raise WentAstray(f"There are no sliders on {self._page.address}.")
        moved = {f"axis-{axis}": str(stop) for axis, stop in stops.items()}
        self._send(form.target.group(0), {**form.fields, **moved, "goes_on": "true"})

    def go_to_the_end(self) -> None:
        """Through whatever forms are left, as they are."""
        self._open("/p/next")
        for _ in range(_MOST_PAGES):
            if self._page.address.endswith(_END):
                return
            self._send_first({})
        raise WentAstray(f"The way to the end ended at {self._page.address}.")

    def _open_after_scales(self) -> None:
        """Standard questionnaires about robots are sent as they are, without answers: nobody scripted has a view."""
        self._open("/p/next")
        for _ in range(_MOST_PAGES):
            form = self._page.form_to(_SCALE)
            if form is None:
                return
            self._send(form.target.group(0), form.fields)
        raise WentAstray(f"The way through the questionnaires ended at {self._page.address}.")

    def _send_first(self, filled_in: dict[str, str]) -> None:
        """Send the page's first form, that for the language left out, with these fields filled in."""
        forms = [form for form in self._page.forms if not _LANGUAGE.search(form[0])]
        if not forms:
            raise WentAstray(f"There is nothing to press on {self._page.address}.")
        action, fields = forms[0]
        self._send(action, {**fields, **filled_in})

    def _open(self, path: str) -> None:
        self._arrive(self._client.get(path))

    def _send(self, path: str, fields: dict[str, str]) -> None:
        self._arrive(self._client.post(urljoin(self._page.address or "/", path), data=fields))

    def _arrive(self, response: httpx2.Response) -> None:
        if response.is_error:
            raise WentAstray(f"{response.request.method} {response.url.path} answered {response.status_code}.")
        self._page = _Page(str(response.url), response.text)


@dataclass(frozen=True)
class _Form:
    """A form whose address has been recognised."""

    target: re.Match[str]
    fields: dict[str, str]


class _Page(HTMLParser):
    """The forms of a page with the fields a person would leave as they are; boxes are ticked, nothing is chosen."""

    def __init__(self, address: str, text: str) -> None:
        super().__init__()
        self.address, self.text = address, text
        self.forms: list[tuple[str, dict[str, str]]] = []
        self.feed(text)

    def form_to(self, address: re.Pattern[str]) -> _Form | None:
        """The first form that is sent to such an address."""
        for action, fields in self.forms:
            if found := address.search(action):
                return _Form(found, fields)
        return None

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collect forms and their input fields."""
        named = {name: value or "" for name, value in attrs}
        if tag == "form" and named.get("method", "").lower() == "post":
            self.forms.append((named.get("action", ""), {}))
        elif tag == "input" and named.get("type") == "radio" and "checked" not in named:
            return
        elif tag in {"input", "button"} and self.forms and named.get("name"):
            self.forms[-1][1].setdefault(named["name"], named.get("value", "on"))
