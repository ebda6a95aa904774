"""Beams traced through the cells of a grid (Amanatides & Woo 1987)."""

import math

from kalmap.kernels.compiled import compiled


@compiled
def pass_cells(x, y, c, s, length, passed, passes, marks):
    """Count the cells along a beam once: from (x, y) along the unit vector (c, s), all in cells.

    A cell whose mark is `passed` or more has been counted for this scan already. The number of steps is fixed by the
    two end cells, so that rounding of the crossings can neither miss the last cell nor run past it.
    """
    rows, columns = passes.shape
    column, row = math.floor(x), math.floor(y)
    across, up = math.floor(x + length * c) - column, math.floor(y + length * s) - row
    step_x, step_y = 1 if across > 0 else -1, 1 if up > 0 else -1
    left_x, left_y = abs(across), abs(up)
    # beam lengths at which the next column and the next row begin, and from one to the next
    pitch_x, pitch_y = abs(1.0 / c) if left_x else math.inf, abs(1.0 / s) if left_y else math.inf
    next_x = (column + (step_x > 0) - x) / c if left_x else math.inf
    next_y = (row + (step_y > 0) - y) / s if left_y else math.inf
    entered = False
    while True:
        if 0 <= row < rows and 0 <= column < columns:
            entered = True
            if marks[row, column] < passed:
                marks[row, column] = passed
                passes[row, column] += 1
        elif entered:
            return
        if left_x and (next_x <= next_y or not left_y):
            column += step_x
            next_x += pitch_x
            left_x -= 1
        elif left_y:
            row += step_y
            next_y += pitch_y
            left_y -= 1
        else:
            return


@compiled
def trace_beams(poses, firsts, ranges, bearings, limits, origin, resolution, hits, passes, marks):
    """In how many scans a cell was hit, and in how many it was passed without being hit: counts into `hits`, `passes`.

    poses (K, 3) of the scanner; the beams of scan k are those from firsts[k] to firsts[k + 1] - 1 of ranges and
    bearings (B,). limits: (3,) m, shortest and longest range that hit something, and how far a longer one clears;
    shorter ones and NaN say nothing. origin: (2,) m of the lower left corner. hits, passes, marks: (H, W) int32, to
    start from zeros (32 bits, for a grid of a large building is far larger than the processor's cache); marks is
    working space. A cell counts once a scan, and as hit where one beam hits and another passes: at a flat angle, beams
    pass through the cells of the wall that their neighbours hit.
    """
    rows, columns = hits.shape
    shortest, longest, clears = limits[0], limits[1], limits[2]
    for k in range(len(poses)):
        x, y, heading = (
            (poses[k, 0] - origin[0]) / resolution,
            (poses[k, 1] - origin[1]) / resolution,
            poses[k, 2],
        )
        passed, hit = 2 * k + 1, 2 * k + 2
        for b in range(firsts[k], firsts[k + 1]):
            if shortest <= ranges[b] <= longest:
                length = ranges[b] / resolution
                column = math.floor(x + length * math.cos(heading + bearings[b]))
                row = math.floor(y + length * math.sin(heading + bearings[b]))
                if 0 <= row < rows and 0 <= column < columns and marks[row, column] < hit:
                    marks[row, column] = hit
                    hits[row, column] += 1
        for b in range(firsts[k], firsts[k + 1]):
            if ranges[b] >= shortest:
                reach = ranges[b] if ranges[b] <= longest else min(ranges[b], clears)
                c, s = math.cos(heading + bearings[b]), math.sin(heading + bearings[b])
                pass_cells(x, y, c, s, reach / resolution, passed, passes, marks)
