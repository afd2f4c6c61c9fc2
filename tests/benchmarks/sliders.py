"""How soon the film follows a slider, in a browser at a running studio.

    python -m tests.benchmarks.sliders LINK --moves 40

LINK: the personal link of somebody who is at the sliders; their settings are saved as a participant's are. Prints
milliseconds from letting a slider go (the event ``change``) to the first picture of the film that answers it, as the
browser shows it, and how far the filmed setting was from the one that was set.
"""

import argparse
import sys
from typing import Any

import numpy as np
from playwright.sync_api import Page

from tests.chromium import launched

MOVE = """async ([index, stop]) => {
    const page = document.querySelector("[data-setting]");
    const input = document.querySelectorAll("[data-slider] input")[index];
    const film = document.querySelector("[data-film]");
    const said = document.querySelector("[data-status]");
    const before = film.getAttribute("src");
    input.value = stop;
    input.dispatchEvent(new Event("input", { bubbles: true }));
    const begun = performance.now();
    input.dispatchEvent(new Event("change", { bubbles: true }));
    said.textContent = "";
    const since = () => Math.round(performance.now() - begun);
    await new Promise((resolve) => {
        const look = () => (said.textContent === page.dataset.saySaved ? resolve() : setTimeout(look, 5));
        look();
    });
    const answered = since();
    const changed = film.getAttribute("src") !== before;
    if (changed) await new Promise((resolve) => film.requestVideoFrameCallback(resolve));
    return { answered, shown: since(), changed };
}"""
REST_MS = 700
"""Between two moves: a look at the film."""


def measured(page: Page, moves: int, rng: np.random.Generator) -> list[dict[str, Any]]:
    """One move after the other, each of a random slider to a random place."""
    found = []
    for _ in range(moves):
        sliders = page.locator("[data-slider] input")
        index = int(rng.integers(sliders.count()))
        ends = [int(sliders.nth(index).get_attribute(end) or 0) for end in ("min", "max")]
        here = int(sliders.nth(index).input_value())
        stop = int(rng.choice([each for each in range(ends[0], ends[1] + 1) if each != here]))
        found.append(page.evaluate(MOVE, [index, stop]))
        page.wait_for_timeout(REST_MS)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("link")
    parser.add_argument("--moves", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    said = parser.parse_args()
    with launched() as browser:
        page = browser.new_context(bypass_csp=True).new_page()
        page.goto(said.link)
        page.wait_for_selector("[data-setting]")
        moves = measured(page, said.moves, np.random.default_rng(said.seed))
    changed = [each for each in moves if each["changed"]]
    sys.stdout.write(f"{len(moves)} moves, in {len(changed)} of them another film was nearest\n")
    for name, values in (
        ("saved and answered", [each["answered"] for each in moves]),
        ("first picture of the other film", [each["shown"] for each in changed]),
    ):
        median, most, worst = np.quantile(values, [0.5, 0.95, 1.0])
        sys.stdout.write(f"{name}: median {median:.0f} ms, 95 % within {most:.0f} ms, slowest {worst:.0f} ms\n")


if __name__ == "__main__":
    main()
