"""The picture of the rooms says what the code says, and the guide to the code names what is there."""

from itertools import permutations

import pytest

from tests.pictures import rooms

PACKAGES = sorted({path.parent for program in rooms.PROGRAMS for path in (rooms.ROOT / program).rglob("__init__.py")})


def test_the_picture_of_the_rooms_is_up_to_date() -> None:
    assert rooms.PICTURE.read_text() == rooms.picture(), "Draw it anew: python -m tests.pictures.rooms"


@pytest.mark.parametrize("package", [".".join(each.relative_to(rooms.ROOT).parts) for each in PACKAGES])
def test_a_package_says_in_one_line_what_it_is_for(package: str) -> None:
    line = rooms.room(package).line
    assert line.endswith(".")
    assert len(line) <= (rooms.LONGEST_LINE if "." in package else rooms.LONGEST_TITLE), "does not fit into its box"


def test_rooms_in_one_box_do_not_know_each_other() -> None:
    graph = rooms.graph()
    boxes = [
        box for each in PACKAGES for box in rooms.layers(".".join(each.relative_to(rooms.ROOT).parts)) if len(box) > 1
    ]
    assert len(boxes) > 10
    known = {
        (knowing, known)
        for box in boxes
        for knowing, known in permutations(box, 2)
        if graph.find_shortest_chains(knowing, known, as_packages=True)
    }
    assert known == set()
