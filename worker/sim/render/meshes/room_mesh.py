"""A calm, light room: nothing behind the path of the spoon that draws the eye."""

from worker.domain.type_aliases import FloatArray
from worker.sim.render.meshes.colours import Palette
from worker.sim.render.meshes.distance_fields import DistanceField, cone, smooth_step, union
from worker.sim.render.meshes.mesh import Mesh, joined, panel, softly_lit

LEFT, RIGHT, FRONT, BACK, CEILING = -2.2, 1.6, -2.6, 1.5, 3.0


def room_meshes(palette: Palette, furniture: DistanceField) -> dict[str, Mesh]:
    """Floor, three walls and skirting boards."""

    def wall(points: FloatArray) -> FloatArray:
        return palette.along("wall", smooth_step(points[:, 2], 1.9, 0.2))

    def side_wall(points: FloatArray) -> FloatArray:
        return palette.along("side_wall", smooth_step(points[:, 2], 1.9, 0.2))

    floor = panel(
        [(LEFT, FRONT, 0), (RIGHT, FRONT, 0), (RIGHT, BACK, 0), (LEFT, BACK, 0)], 36, 30, palette.at("floor", 0.2)
    )
    stand = cone((-0.45, -0.55, 0.0), (-0.45, -0.55, 0.4), 0.12, 0.04)
    floor = softly_lit(union(furniture, stand), floor, 0.5, 0.8)
    back = panel([(LEFT, BACK, 0), (RIGHT, BACK, 0), (RIGHT, BACK, CEILING), (LEFT, BACK, CEILING)], 20, 24, wall)
    side = panel([(LEFT, FRONT, 0), (LEFT, BACK, 0), (LEFT, BACK, CEILING), (LEFT, FRONT, CEILING)], 20, 24, side_wall)
    # The walls face the room only, so that every camera looks in through the one behind it.
    right = panel(
        [(RIGHT, BACK, 0), (RIGHT, FRONT, 0), (RIGHT, FRONT, CEILING), (RIGHT, BACK, CEILING)], 20, 24, side_wall
    )
    return {"floor": floor, "walls": joined(back, side, right), "skirting": _skirting(palette)}


def _skirting(palette: Palette) -> Mesh:
    thick, high = 0.02, 0.10
    y, x = BACK - thick, LEFT + thick
    colour = palette.at("skirting")
    opposite = RIGHT - thick
    return joined(
        panel(
            [(opposite, BACK, 0), (opposite, FRONT, 0), (opposite, FRONT, high), (opposite, BACK, high)], 8, 1, colour
        ),
        panel(
            [(opposite, BACK, high), (opposite, FRONT, high), (RIGHT, FRONT, high), (RIGHT, BACK, high)], 8, 1, colour
        ),
        panel([(LEFT, y, 0), (RIGHT, y, 0), (RIGHT, y, high), (LEFT, y, high)], 8, 1, colour),
        panel([(LEFT, y, high), (RIGHT, y, high), (RIGHT, BACK, high), (LEFT, BACK, high)], 8, 1, colour),
        panel([(x, FRONT, 0), (x, BACK, 0), (x, BACK, high), (x, FRONT, high)], 8, 1, colour),
        panel([(x, FRONT, high), (x, BACK, high), (LEFT, BACK, high), (LEFT, FRONT, high)], 8, 1, colour),
    )
