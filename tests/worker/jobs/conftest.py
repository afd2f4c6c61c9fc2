"""Jobs that are done in the test's own process make small films, five frames a second."""

from collections.abc import Iterator

import pytest

from worker.compute import simulation
from worker.sim.render.clip import STYLES, RenderStyle
from worker.sim.render.passes import Supersampling

SMALL = RenderStyle(fps=5, width=320, height=240, supersampling=Supersampling(still=1.0, moving=1.0), rate_factor=30)


@pytest.fixture(scope="package", autouse=True)
def small_films() -> Iterator[None]:
    """In the style of quick clips, which these studies have; the rest of the code is what participants' films need."""
    usual = STYLES["quick"]
    STYLES["quick"] = SMALL
    yield
    STYLES["quick"] = usual
    simulation.renderer.cache_clear()
