"""Which one or two rectangles of a picture to draw so that all moving parts are inside and few pixels are empty."""

import numpy as np

from worker.domain.type_aliases import FloatArray

Pixels = tuple[int, int, int, int]
"""left, top, right, bottom"""

CALL_COST_PX = 3000
"""A second drawing call costs about as much as this many pixels."""

_CUTS = 12


GRID_PX = 4
"""Rectangles start and end on this grid, so that they also fall on whole pixels of a 1.25 or 1.5 times finer one."""


def on_grid(box: FloatArray, width: int, height: int) -> Pixels:
    """The smallest rectangle on the grid around a box (4,), cut to the picture (whose sides are on the grid)."""
    left, top = (np.floor(box[:2] / GRID_PX) * GRID_PX).clip(0, [width, height]).astype(int).tolist()
    right, bottom = (np.ceil(box[2:] / GRID_PX) * GRID_PX).clip(0, [width, height]).astype(int).tolist()
    return left, top, right, bottom


def cover(boxes: FloatArray, width: int, height: int) -> list[Pixels]:
    """At most two rectangles that hold every box (K, 4), split by one straight cut where that saves pixels."""
    boxes = np.clip(boxes, 0, [width, height, width, height])
    boxes = boxes[(boxes[:, 2] > boxes[:, 0] + 0.5) & (boxes[:, 3] > boxes[:, 1] + 0.5)]
    if not len(boxes):
        return []
    if len(boxes) == 1:
        return [on_grid(boxes[0], width, height)]
    whole = np.concatenate([boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)])
    best, best_cost = [whole], (whole[2] - whole[0]) * (whole[3] - whole[1]) - CALL_COST_PX
    for axis in (0, 1):
        cost, pair = _best_cut(boxes, axis)
        if cost < best_cost:
            best, best_cost = pair, cost
    found = [on_grid(box, width, height) for box in best]
    return [pixels for pixels in found if pixels[2] > pixels[0] and pixels[3] > pixels[1]]


def _best_cut(boxes: FloatArray, axis: int) -> tuple[float, list[FloatArray]]:
    """The cut across one axis with the fewest pixels: their number, and the rectangles on both sides."""
    low, high = boxes[:, axis], boxes[:, axis + 2]
    side_low, side_high = boxes[:, 1 - axis], boxes[:, 3 - axis]
    cuts = (np.linspace(low.min(), high.max(), _CUTS)[1:-1] // GRID_PX * GRID_PX)[:, None]
    before, after = low < cuts, high > cuts
    if not (before.any(axis=1) & after.any(axis=1)).all():
        return np.inf, []
    start = np.where(before, low, np.inf).min(axis=1)
    end_before = np.minimum(np.where(before, high, -np.inf).max(axis=1), cuts[:, 0])
    start_after = np.maximum(np.where(after, low, np.inf).min(axis=1), cuts[:, 0])
    end = np.where(after, high, -np.inf).max(axis=1)
    spans = []
    for mask in (before, after):
        spans.append((np.where(mask, side_low, np.inf).min(axis=1), np.where(mask, side_high, -np.inf).max(axis=1)))
    area = (end_before - start) * (spans[0][1] - spans[0][0]) + (end - start_after) * (spans[1][1] - spans[1][0])
    k = int(area.argmin())
    pair = []
    for a, b, (c, d) in ((start[k], end_before[k], spans[0]), (start_after[k], end[k], spans[1])):
        box = np.empty(4)
        box[[axis, axis + 2]], box[[1 - axis, 3 - axis]] = (a, b), (c[k], d[k])
        pair.append(box)
    return float(area[k]), pair
