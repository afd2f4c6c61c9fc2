"""Draws the map of the code, docs/pictures/rooms.svg: ``python -m tests.pictures.rooms``.

Every package stands in the layer that the contracts of pyproject.toml give it, with the first line of its docstring.
"""

import argparse
import ast
import sys
import textwrap
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from pathlib import Path

import grimp

ROOT = Path(__file__).resolve().parents[2]
PICTURE = ROOT / "docs/pictures/rooms.svg"
PROGRAMS = ("app", "worker")
EVERYBODY_S = "app.installed_tasks"
"""Made for both programs, so that its readers say nothing."""
LIBRARIES = ("fastapi", "dbos", "torch", "pybullet", "statsmodels")
"""Of which a reader wants to know who loads them."""

COLUMN, MARGIN = 402, 18
WIDTH = 2 * COLUMN + 3 * MARGIN
ROW, HEAD, PAD, GAP = 22, 24, 9, 5
NAME_WIDTH, CHARACTER = 96, 7.2
LONGEST_LINE, LONGEST_TITLE, LONGEST_MODULES = 48, 70, 57
"""Characters that fit into the box of a package, below the name of a program, and into a row of modules."""

STYLE = """
    text { font: 11px system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", "Noto Sans", sans-serif }
    .name { font: 600 11.5px ui-monospace, SFMono-Regular, Menlo, Consolas, "DejaVu Sans Mono", monospace }
    .title { font-size: 17px }
    .modules { font-size: 10.5px; font-weight: 400 }
    .paper { fill: #fbf7f1 } .room { fill: #ffffff; stroke: #e4d8c9 } .inner { fill: #fbf7f1; stroke: #e4d8c9 }
    .hair { stroke: #e4d8c9 } .ink { fill: #2a231d } .muted { fill: #685c50 } .accent { fill: #a4451d }
    @media (prefers-color-scheme: dark) {
      .paper { fill: #191512 } .room { fill: #231e1a; stroke: #3d352e } .inner { fill: #191512; stroke: #3d352e }
      .hair { stroke: #3d352e } .ink { fill: #f3ebe1 } .muted { fill: #b9ac9d } .accent { fill: #f0a679 }
    }"""


@dataclass(frozen=True)
class Room:
    """A package, or modules that share a layer and have no room of their own."""

    name: str
    line: str = ""
    """The first line of the docstring; modules have none here."""
    layers: tuple[tuple["Room", ...], ...] = ()
    """What lies in it, from the layer that may know the others to the one that knows none of them."""


@cache
def graph() -> grimp.ImportGraph:
    """Who imports whom, other people's packages included."""
    return grimp.build_graph(*PROGRAMS, include_external_packages=True)


def room(package: str) -> Room:
    """The package with everything that lies in it."""
    line = ast.get_docstring(ast.parse((ROOT / package.replace(".", "/") / "__init__.py").read_text())) or ""
    return Room(package.rpartition(".")[2], line.partition("\n")[0], tuple(_layer(each) for each in layers(package)))


def layers(package: str) -> list[list[str]]:
    """What lies in the package, as its contract orders it; packages without a contract are one layer."""
    for contract in tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]:
        if contract.get("containers") == [package]:
            return [[f"{package}.{name.strip()}" for name in layer.split("|")] for layer in contract["layers"]]
    inside = sorted(name for name in graph().find_children(package) if is_package(name))
    return [inside] if inside else []


def is_package(name: str) -> bool:
    """Whether it is a folder."""
    return (ROOT / name.replace(".", "/") / "__init__.py").exists()


def loaded_by(library: str) -> Iterator[str]:
    """The rooms directly below the other program, or of other people's packages below both, that import it."""
    rooms = sorted(name for program in PROGRAMS if program != library for name in graph().find_children(program))
    for name in rooms:
        inside = (name, *graph().find_descendants(name))
        imported = {found for each in inside for found in graph().find_modules_directly_imported_by(each)}
        theirs = {
            found for found in imported if found.partition(".")[0] == library and not found.startswith(EVERYBODY_S)
        }
        if theirs and not name.endswith("__main__"):
            yield name


def _layer(names: Sequence[str]) -> tuple[Room, ...]:
    """Packages one by one, modules together."""
    modules = [name.rpartition(".")[2] for name in names if not is_package(name)]
    together = textwrap.wrap("\N{NO-BREAK SPACE}· ".join(modules), LONGEST_MODULES)
    return (*(room(name) for name in names if is_package(name)), *map(Room, together))


# --- drawing ---------------------------------------------------------------------------------------------------------


def height(each: Room) -> int:
    """Of its part of a box."""
    return ROW if not each.layers else HEAD + sum(_box_height(layer) + GAP for layer in each.layers) + PAD - GAP


def _box_height(layer: Sequence[Room]) -> int:
    return sum(height(each) for each in layer)


def draw(each: Room, left: float, top: float, depth: int) -> Iterator[str]:
    """The room's name and line, and below them what lies in it."""
    middle = top + ROW / 2 + 4
    kind = "name ink" if each.line else "name modules muted"
    yield f'<text class="{kind}" x="{left + PAD:g}" y="{middle:g}">{escape(each.name)}</text>'
    if each.line:
        start = left + PAD + max(NAME_WIDTH, CHARACTER * (len(each.name) + 1))
        yield f'<text class="muted" x="{start:g}" y="{middle:g}">{escape(each.line)}</text>'
    top += HEAD
    for layer in each.layers:
        yield from _draw_box(layer, left + PAD, top, depth + 1)
        top += _box_height(layer) + GAP


def _draw_box(layer: Sequence[Room], left: float, top: float, depth: int) -> Iterator[str]:
    width, tall = _width(depth), _box_height(layer)
    kind = "room" if depth % 2 else "inner"
    yield f'<rect class="{kind}" x="{left:g}" y="{top:g}" width="{width:g}" height="{tall:g}" rx="5"/>'
    for index, each in enumerate(layer):
        if index:
            yield f'<path class="hair" d="M{left:g} {top:g}h{width:g}"/>'
        yield from draw(each, left, top, depth)
        top += height(each)


def _width(depth: int) -> int:
    """Of a box so deep in its program's column."""
    return COLUMN - 2 * PAD * (depth - 1)


def _column(program: str, left: float, top: float) -> tuple[float, list[str]]:
    """Where it ends, and what to draw."""
    whole = room(program)
    drawn = [
        f'<text class="name title accent" x="{left:g}" y="{top:g}">{whole.name}</text>',
        f'<text class="muted" x="{left:g}" y="{top + 18:g}">{escape(whole.line)}</text>',
    ]
    top += 30
    for layer in whole.layers:
        drawn += _draw_box(layer, left, top, 1)
        top += _box_height(layer) + GAP
    return top, drawn


def _notes(loads: Mapping[str, Sequence[str]], left: float, top: float) -> tuple[float, list[str]]:
    """Where they end, and what to draw."""
    drawn = [f'<text class="ink" x="{left:g}" y="{top:g}">Who imports what</text>']
    for library, rooms in loads.items():
        whole = "; ".join(
            f"{program}: " + ", ".join(name.partition(".")[2] for name in own)
            for program in PROGRAMS
            if (own := [name for name in rooms if name.startswith(program)])
        )
        drawn.append(f'<text class="name modules muted" x="{left:g}" y="{top + 18:g}">{library}</text>')
        for line in textwrap.wrap(whole, LONGEST_LINE):
            top += 18
            drawn.append(f'<text class="muted" x="{left + NAME_WIDTH:g}" y="{top:g}">{line}</text>')
    return top, drawn


def picture() -> str:
    """The whole drawing."""
    how = "A room may use the rooms below it, never one above. Rooms in one box do not know each other."
    ends, columns = zip(
        *(_column(program, MARGIN + index * (COLUMN + MARGIN), 76) for index, program in enumerate(PROGRAMS)),
        strict=True,
    )
    end, notes = _notes({name: list(loaded_by(name)) for name in ("app", *LIBRARIES)}, MARGIN, ends[0] + 24)
    tall = max(*ends, end) + MARGIN
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {tall:g}" width="{WIDTH}" role="img">',
        "<title>The rooms of PbARL Studio</title>",
        f"<desc>The packages of app and worker in their layers. {how}</desc>",
        f"<style>{STYLE}\n</style>",
        f'<rect class="paper" width="{WIDTH}" height="{tall:g}" rx="10"/>',
        f'<text class="muted" x="{MARGIN}" y="34">{how}</text>',
        *(line for column in columns for line in column),
        *notes,
        "</svg>",
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter).parse_args()
    PICTURE.write_text(picture())
    sys.stdout.write(f"Wrote {PICTURE.relative_to(ROOT)}\n")
