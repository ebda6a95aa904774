"""Straight runs of a scan made into pieces: a bent line each, or one conic or cubic that explains several as well."""

import math

import numpy as np

from kalmap.kernels.compiled import compiled
from kalmap.kernels.contour_curves import fit_polynomial, is_sound, weighted_squares
from kalmap.kernels.contour_cut import line_cost
from kalmap.kernels.contour_fit import fit_bent_line, fit_line

_RUN, _CONIC, _CUBIC = (
    5,
    6,
    10,
)  # numbers in a bent line, a conic and a cubic, and one more for where each begins
_LEAST_CONIC, _LEAST_CUBIC = 7, 11  # points
_FAILURES = 3  # of one curve to hold more runs, until it is left as it is
_JOINT = math.radians(60.0)  # most that a contour turns from one run to the next
_BENT = 2.0  # chi-square per degree of freedom up to which a straight run is left straight
_MARGIN = 0.05  # m beyond its ends in which a curve must still be sound


@compiled
def run_line(sums, a, b, points):
    """The line through points a to b - 1: a point on it and its unit direction, the way that the points go."""
    w = sums[b, 0] - sums[a, 0]
    x, y = (sums[b, 1] - sums[a, 1]) / w, (sums[b, 2] - sums[a, 2]) / w
    xx = sums[b, 3] - sums[a, 3] - w * x * x
    xy = sums[b, 4] - sums[a, 4] - w * x * y
    yy = sums[b, 5] - sums[a, 5] - w * y * y
    angle = 0.5 * math.atan2(2.0 * xy, xx - yy)
    tx, ty = math.cos(angle), math.sin(angle)
    if tx * (points[b - 1, 0] - points[a, 0]) + ty * (points[b - 1, 1] - points[a, 1]) < 0.0:
        tx, ty = -tx, -ty
    return points[0, 0] + x, points[0, 1] + y, tx, ty


@compiled
def may_join(sums, a, b, c, points, noise):
    """Whether the runs a to b - 1 and b to c - 1 may be chords of one smooth contour: no sharp turn, and no step."""
    ax, ay, atx, aty = run_line(sums, a, b, points)
    bx, by, btx, bty = run_line(sums, b, c, points)
    if b - a > 2 and c - b > 2 and atx * btx + aty * bty < math.cos(_JOINT):
        return False
    spacing = math.hypot(points[b, 0] - points[b - 1, 0], points[b, 1] - points[b - 1, 1])
    slack = spacing * math.sin(_JOINT) + 3.0 * math.sqrt(noise[b])
    ahead = abs(atx * (points[b, 1] - ay) - aty * (points[b, 0] - ax))
    behind = abs(btx * (points[b - 1, 1] - by) - bty * (points[b - 1, 0] - bx))
    return (b - a < 3 or ahead <= slack) and (c - b < 3 or behind <= slack)


@compiled
def try_curve(points, rays, along, across, rough, limit, cost, highest, coef, cov, origin):
    """The lowest order from 2 to `highest` whose curve costs less than `limit` and is sound, 1 if none.

    cost: chi-square that every number of it counts for.

    Returns order, scale and the excess variance; fills coef, cov and origin.
    """
    count = len(points)
    residuals = np.empty(count)
    sigma = math.sqrt(along.max() + rough)
    for degree in (2, 3):
        if degree > highest or count < (_LEAST_CONIC if degree == 2 else _LEAST_CUBIC):
            break
        left = limit - cost * (_CONIC if degree == 2 else _CUBIC)
        if left <= 0.0:
            break
        scale, _chi, excess, exists = fit_polynomial(
            points, rays, along, across, degree, left, rough, coef, cov, origin, residuals
        )
        fits = exists and weighted_squares(residuals, along, rough) < left
        if fits and is_sound(coef, origin, scale, points, sigma, _MARGIN):
            return degree, scale, excess
    return 1, 1.0, 0.0


@compiled
def copy_fit(coef, cov, origin, to_coef, to_cov, to_origin):
    """Coefficients (10,), covariance (10, 10) and origin (2,) of one fit to the place of another."""
    for i in range(10):
        to_coef[i] = coef[i]
        for j in range(10):
            to_cov[i, j] = cov[i, j]
    to_origin[0], to_origin[1] = origin[0], origin[1]


@compiled
def bend_runs(cuts, points, rays, along, across, rough, sigma_bend, coef, cov, origin, shape):
    """A line through every run, bent as `fit_bent_line` does: fills the rows of coef (R, 10), cov (R, 10, 10), origin
    (R, 2), shape (R, 3: scale m, squares by `along` + `rough`, excess variance m^2). sigma_bend 0: straight lines."""
    for r in range(len(cuts) - 1):
        a, b = cuts[r], cuts[r + 1]
        if b - a < 2:
            continue
        if sigma_bend > 0.0:
            shape[r, 0], shape[r, 1], shape[r, 2] = fit_bent_line(
                points[a:b], rays[a:b], along[a:b], across[a:b], sigma_bend, rough, coef[r], cov[r], origin[r]
            )
        else:
            shape[r, 0], shape[r, 1], shape[r, 2] = fit_line(
                points[a:b], rays[a:b], along[a:b], across[a:b], coef[r], cov[r], origin[r]
            )


@compiled
def smooth_chain(cuts, run, sums, linked, points, noise):
    """How many runs, from number `run` on, follow one another without a gap, a step or a sharp turn, and go round by
    no more than half a turn: a piece is shifted and turned as a whole by what a scan's errors do to it
    (`contour_noise`), and one that closes round the scanner would hold the pose as if there were none."""
    length, turn = 1, 0.0
    _x, _y, before_x, before_y = run_line(sums, cuts[run], cuts[run + 1], points)
    while run + length < len(cuts) - 1:
        j = run + length
        if not (linked[cuts[j] - 1] and may_join(sums, cuts[j - 1], cuts[j], cuts[j + 1], points, noise)):
            break
        _x, _y, tx, ty = run_line(sums, cuts[j], cuts[j + 1], points)
        turn += math.atan2(before_x * ty - before_y * tx, before_x * tx + before_y * ty)
        if abs(turn) > math.pi:
            break
        before_x, before_y = tx, ty
        length += 1
    return length


@compiled
def cost_apart(cuts, run, count, squares, cost):
    """What `count` runs from number `run` on cost with a bent line each, and what every number counts for.

    squares (R,): the lines' weighted squares. A number saves as much of them as one point's noise makes, which is less
    than `cost` where the noise is less than is said of the sensor: the points themselves tell. Never more than `cost`,
    or lines that misfit would make room for a curve that does.
    """
    apart, freedom = 0.0, 0
    for j in range(run, run + count):
        apart += squares[j] if cuts[j + 1] - cuts[j] > 1 else 0.0
        freedom += max(0, cuts[j + 1] - cuts[j] - _RUN)
    number = cost * min(1.0, apart / freedom) if freedom > 0 else cost
    return apart + _RUN * count * number, number


@compiled
def shape_run(
    cuts, run, sums, linked, points, rays, along, across, rough, cost, highest, squares, coef, cov, origin
):
    """A conic or cubic that begins with run number `run`: fills coef, cov, origin; returns the run after it, order,
    scale m and excess variance m^2. Order 1: there is none, and nothing is filled.

    Runs are added as long as one curve explains them all as well as a bent line each, whose weighted squares are
    `squares` (R,), every number of both weighed (`cost_apart`): a misfit within the noise of one scan is the same in
    all. As many are added at once as the curve holds, and once that has failed, one by one; three failures end it:
    with two or three runs chance alone often decides, with many it does not.
    """
    after, order, scale, excess = run + 1, 1, 1.0, 0.0
    if highest == 1:
        return after, order, scale, excess
    tried_coef, tried_cov, tried_origin = np.empty(10), np.empty((10, 10)), np.empty(2)
    a, end = cuts[run], cuts[run + 1]
    chain, freedom = smooth_chain(cuts, run, sums, linked, points, along), max(1, end - a - 2)
    straight = line_cost(sums, a, end) < _BENT * freedom + 3.0 * math.sqrt(2.0 * freedom)
    count, doubling, failed = 2 if straight else 1, True, 0
    while count <= chain and failed < _FAILURES:
        end = cuts[run + count]
        apart, number = cost_apart(cuts, run, count, squares, cost)
        degree, size, surplus = try_curve(
            points[a:end],
            rays[a:end],
            along[a:end],
            across[a:end],
            rough,
            apart,
            number,
            highest,
            tried_coef,
            tried_cov,
            tried_origin,
        )
        if degree > 1:
            after, order, scale, excess = run + count, degree, size, surplus
            copy_fit(tried_coef, tried_cov, tried_origin, coef, cov, origin)
            count = min(2 * count, max(chain, count + 1)) if doubling else count + 1
        elif doubling and order > 1 and count > after - run + 1:
            doubling, count = False, after - run + 1
        else:
            failed += end - a >= _LEAST_CONIC
            count += 1
    return after, order, scale, excess
