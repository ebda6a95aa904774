"""Laying one contour map over another: a field of nearest contour, a search over all places, and the fine alignment.

The search is branch and bound on grids that hold, for every cell and direction of a contour's normal, how well a point
fits there, pooled over ever larger windows (Olson 2009; Hess et al. 2016): exact on its lattice.
"""

import math

import numpy as np

from kalmap.kernels.compiled import compiled

_PARALLEL = 0.8  # cosine between the normals of contours that may be one


@compiled
def nearest_segments(segments, low, cell, reach, nearest, distance):
    """Write for every cell of a grid the segment nearest to its middle, where one is within `reach` m.

    segments: (S, 4) m. low: (2,) m, the grid's lower left corner; cell: m. nearest (H, W) int32 is left at -1 and
    distance (H, W) float32 at what it was where there is none.
    """
    rows, columns = nearest.shape
    for s in range(len(segments)):
        ax, ay, bx, by = segments[s, 0], segments[s, 1], segments[s, 2], segments[s, 3]
        c0 = max(0, int((min(ax, bx) - reach - low[0]) / cell))
        c1 = min(columns - 1, int((max(ax, bx) + reach - low[0]) / cell))
        r0 = max(0, int((min(ay, by) - reach - low[1]) / cell))
        r1 = min(rows - 1, int((max(ay, by) + reach - low[1]) / cell))
        length = max(1e-12, (bx - ax) ** 2 + (by - ay) ** 2)
        for r in range(r0, r1 + 1):
            y = low[1] + (r + 0.5) * cell
            for c in range(c0, c1 + 1):
                x = low[0] + (c + 0.5) * cell
                t = min(1.0, max(0.0, ((x - ax) * (bx - ax) + (y - ay) * (by - ay)) / length))
                d = math.hypot(x - ax - t * (bx - ax), y - ay - t * (by - ay))
                if d < distance[r, c]:
                    distance[r, c] = d
                    nearest[r, c] = s


@compiled
def fill_levels(nearest, distance, normals, sigma, levels):
    """How well a point fits each cell, by the direction of its normal, and the maxima of that over larger windows.

    normals: (S, 2) of the segments. levels: (L, D, H, W) uint8, zeros: level 0 is 255 exp(-d^2 / 2 sigma^2) for the D
    directions within about 66 degrees of the nearest contour's normal; level l holds the maxima over 2^l x 2^l cells.
    """
    count, directions, rows, columns = levels.shape
    for r in range(rows):
        for c in range(columns):
            s = nearest[r, c]
            if s < 0:
                continue
            value = np.uint8(255.0 * math.exp(-0.5 * (distance[r, c] / sigma) ** 2))
            for b in range(directions):
                angle = 2.0 * math.pi * b / directions
                if math.cos(angle) * normals[s, 0] + math.sin(angle) * normals[s, 1] > 0.4:
                    levels[0, b, r, c] = value
    for level in range(1, count):
        half = 1 << (level - 1)
        for b in range(directions):
            below, grid = levels[level - 1, b], levels[level, b]
            for r in range(rows):
                for c in range(columns):
                    best = below[r, c]
                    if r + half < rows:
                        best = max(best, below[r + half, c])
                    if c + half < columns:
                        best = max(best, below[r, c + half])
                        if r + half < rows:
                            best = max(best, below[r + half, c + half])
                    grid[r, c] = best


@compiled
def _fit(level, size, cells, shift_row, shift_column):
    """The sum over points of the best fit in a window of `size` cells from the shifted cell on: an upper bound."""
    total = 0
    _, rows, columns = level.shape
    for p in range(len(cells)):
        r, c = cells[p, 0] + shift_row, cells[p, 1] + shift_column
        if r < 0 and r + size > 0:
            r = 0
        if c < 0 and c + size > 0:
            c = 0
        if 0 <= r < rows and 0 <= c < columns:
            total += level[cells[p, 2], r, c]
    return total


@compiled
def _insert(values, places, kept, angles, value, angle, row, column, apart):
    """Keep a place among the best; of those in one neighbourhood only the best. Returns how many are kept."""
    at = kept
    for q in range(kept):
        near = abs(places[q, 1] - row) <= apart and abs(places[q, 2] - column) <= apart
        if near and abs(angles[places[q, 0]] - angles[angle]) < 0.15:
            if value <= values[q]:
                return kept
            at = q
            break
    if at == kept:
        if kept == len(values):
            at = kept - 1
            if value <= values[at]:
                return kept
        else:
            kept += 1
    values[at] = value
    places[at, 0], places[at, 1], places[at, 2] = angle, row, column
    while at > 0 and values[at] > values[at - 1]:
        values[at], values[at - 1] = values[at - 1], values[at]
        for z in range(3):
            places[at, z], places[at - 1, z] = places[at - 1, z], places[at, z]
        at -= 1
    return kept


@compiled
def search_places(levels, low, cell, points, normals, centre, angles, half, least, apart, values, places):
    """The best places of a cloud of points with normals on a map, over all shifts within `half` cells and all angles.

    points: (N, 2) m about their own centre, normals: (N, 2); centre: (2,) m, where the cloud's centre is looked for
    first. least: the share of a perfect fit that is asked for. apart: cells, how far apart two answers are. Writes
    values (T,), shares of a perfect fit, and places (T, 3): angle's index, shift in rows and in columns, best first;
    returns how many.
    """
    count, directions = levels.shape[0], levels.shape[1]
    coarse = 1 << (count - 1)
    steps = 2 * half // coarse + 1
    cells = np.empty((len(angles), len(points), 3), dtype=np.int64)
    first = np.empty(len(angles) * steps * steps, dtype=np.int64)
    for a in range(len(angles)):
        c, s = math.cos(angles[a]), math.sin(angles[a])
        for p in range(len(points)):
            x, y = c * points[p, 0] - s * points[p, 1], s * points[p, 0] + c * points[p, 1]
            cells[a, p, 0] = math.floor((y + centre[1] - low[1]) / cell)
            cells[a, p, 1] = math.floor((x + centre[0] - low[0]) / cell)
            turn = math.atan2(s * normals[p, 0] + c * normals[p, 1], c * normals[p, 0] - s * normals[p, 1])
            cells[a, p, 2] = round(turn / (2.0 * math.pi) * directions) % directions
        for i in range(steps):
            for j in range(steps):
                at = (a * steps + i) * steps + j
                first[at] = _fit(levels[count - 1], coarse, cells[a], i * coarse - half, j * coarse - half)
    full = 255.0 * len(points)
    kept = 0
    values[:] = 0.0
    stack = np.empty((4 * count + 4, 5), dtype=np.int64)
    for at in np.argsort(-first):
        bound = max(least * full, values[-1])
        if first[at] < bound:
            break
        stack[0, 0], stack[0, 1] = at // (steps * steps), (at // steps % steps) * coarse - half
        stack[0, 2], stack[0, 3], stack[0, 4] = (at % steps) * coarse - half, count - 1, first[at]
        top = 1
        while top > 0:
            top -= 1
            a, row, column, level, value = (
                stack[top, 0],
                stack[top, 1],
                stack[top, 2],
                stack[top, 3],
                stack[top, 4],
            )
            if value < max(least * full, values[-1]):
                continue
            if level == 0:
                kept = _insert(values, places, kept, angles, float(value), a, row, column, apart)
                continue
            size = 1 << (level - 1)
            for quarter in range(4):
                r, c = row + (quarter // 2) * size, column + (quarter % 2) * size
                if r > half or c > half:
                    continue  # the coarse windows reach beyond what is asked for
                value = _fit(levels[level - 1], size, cells[a], r, c)
                if value >= max(least * full, values[-1]):
                    stack[top, 0], stack[top, 1], stack[top, 2] = a, r, c
                    stack[top, 3], stack[top, 4] = level - 1, value
                    top += 1
    values /= full
    return kept


@compiled
def facing_segment(x, y, nx, ny, segments, normals, nearest, low, cell):
    """The segment that a point with a normal lies beside, and its signed distance m; (-1, 0) if there is none."""
    row, column = math.floor((y - low[1]) / cell), math.floor((x - low[0]) / cell)
    if row < 0 or column < 0 or row >= nearest.shape[0] or column >= nearest.shape[1]:
        return -1, 0.0
    s = nearest[row, column]
    if s < 0 or normals[s, 0] * nx + normals[s, 1] * ny < _PARALLEL:
        return -1, 0.0
    ex, ey = segments[s, 2] - segments[s, 0], segments[s, 3] - segments[s, 1]
    t = ((x - segments[s, 0]) * ex + (y - segments[s, 1]) * ey) / (ex * ex + ey * ey)
    if t < -0.2 or t > 1.2:
        return -1, 0.0
    return s, (x - segments[s, 0]) * normals[s, 0] + (y - segments[s, 1]) * normals[s, 1]


@compiled
def align_points(
    pose, points, point_normals, segments, normals, nearest, low, cell, limits, rounds, sigma, beside, offsets
):
    """Move `pose`, of the points' frame in the map's, to where the points lie best on the map's contours.

    limits: (2,) m, the greatest distance of a match in the first and the last round. sigma: m, scale of Cauchy's
    weights. Writes for every point the segment that it matches, or -1 (none beside it) or -2 (beside one, but too far),
    and its signed distance m, both of the last round. Returns (matches, points beside a contour, mean squared
    distance).
    """
    normal, right = np.empty((3, 3)), np.empty(3)
    matched, near, squares = 0, 0, 0.0
    for turn in range(rounds):
        limit = max(limits[1], limits[0] * 0.7**turn)
        normal[:] = 0.0
        right[:] = 0.0
        matched, near, squares = 0, 0, 0.0
        c, s = math.cos(pose[2]), math.sin(pose[2])
        for p in range(len(points)):
            rx, ry = c * points[p, 0] - s * points[p, 1], s * points[p, 0] + c * points[p, 1]
            nx = c * point_normals[p, 0] - s * point_normals[p, 1]
            ny = s * point_normals[p, 0] + c * point_normals[p, 1]
            k, d = facing_segment(rx + pose[0], ry + pose[1], nx, ny, segments, normals, nearest, low, cell)
            beside[p], offsets[p] = k, d
            if k < 0:
                continue
            near += 1
            if abs(d) > limit:
                beside[p] = -2
                continue
            matched += 1
            squares += d * d
            row0, row1 = normals[k, 0], normals[k, 1]
            row2 = row1 * rx - row0 * ry
            weight = 1.0 / (1.0 + d * d / (9.0 * sigma * sigma))
            right[0] -= weight * row0 * d
            right[1] -= weight * row1 * d
            right[2] -= weight * row2 * d
            normal[0, 0] += weight * row0 * row0
            normal[0, 1] += weight * row0 * row1
            normal[0, 2] += weight * row0 * row2
            normal[1, 1] += weight * row1 * row1
            normal[1, 2] += weight * row1 * row2
            normal[2, 2] += weight * row2 * row2
        if matched < 3:
            return matched, near, squares
        for i in range(3):
            normal[i, i] += 1e-3  # where nothing holds it, as along a corridor, it stays
            for j in range(i):
                normal[i, j] = normal[j, i]
        step = np.linalg.solve(normal, right)
        for i in range(3):
            pose[i] += step[i]
        if turn > 3 and limit <= limits[1] and np.abs(step).max() < 1e-5:
            break
    return matched, near, squares / matched
