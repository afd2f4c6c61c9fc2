"""Forms as a browser would send them: every control of a page with what is in it."""

from html.parser import HTMLParser

from fastapi.testclient import TestClient


class _Controls(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.sent: dict[str, list[str]] = {}
        self._area: str | None = None

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        name = given.get("name")
        if name is None or "disabled" in given:
            return
        if tag == "textarea":
            self._area = name
            self.sent[name] = [""]
        if tag != "input":
            return
        if given.get("type") not in ("radio", "checkbox") or "checked" in given:
            self.sent.setdefault(name, []).append(given.get("value") or "")

    def handle_data(self, data: str) -> None:
        if self._area is not None:
            self.sent[self._area][0] += data.removeprefix("\n") if not self.sent[self._area][0] else data

    def handle_endtag(self, tag: str) -> None:
        if tag == "textarea":
            self._area = None


def controls(text: str) -> dict[str, list[str]]:
    """What the forms of a page would send, disabled fields left out (whole fieldsets are not looked at)."""
    parser = _Controls()
    parser.feed(text)
    return parser.sent


def typed(browser: TestClient, address: str = "/studies/new", **changes: str | list[str]) -> dict[str, list[str]]:
    """What the form of a study sends when only these fields are changed."""
    form = controls(browser.get(address).text)
    if not form["name"][0]:
        form["name"] = ["Pilot"]
    return form | {name: [value] if isinstance(value, str) else value for name, value in changes.items()}
