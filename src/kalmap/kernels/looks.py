"""How the components of a map should look from a pose, in square-root form; and what founds a new one.

Everything here is a factor: the innovation's root is the triangular factor of [E_z, S_R], the root after a sighting
that of [E_m - K E_z, K S_R] (equations (38) and (44) of the SRCKF-PHD-SLAM paper). The columns of E_z are the odd
parts o_i / s of the sensor at the points of the lineariser's rule, and the even parts sqrt(w_e) (e_i - c) of a rule
that has them (see `regression`); a Jacobian has odd parts alone. No covariance is formed and factored again.
"""

import math

import numpy as np

from kalmap.kernels.compiled import compiled
from kalmap.kernels.layout import (
    CENTRAL_DIFFERENCE,
    JACOBIAN,
    MOUNT_HEADING,
    MOUNT_X,
    MOUNT_Y,
    RATIO_RANGE,
    RULE,
    SIGMA_BEARING,
    SIGMA_RANGE,
)
from kalmap.kernels.regression import weights, wrap
from kalmap.kernels.set_layout import (
    BEARING,
    DEPTH,
    HALF_VIEW,
    K11,
    K12,
    K21,
    K22,
    L11,
    L21,
    L22,
    MAX_RANGE,
    MIN_RANGE,
    NORM,
    RANGE,
    RINGS,
    SUREST,
    U11,
    U21,
    U22,
    W11,
    W21,
    W22,
    X,
    Y,
)

_SURE = 6.0  # standard deviations from an edge beyond which it is not felt

_TWO_PI = 2.0 * math.pi


@compiled
def lower_root(first, second, count):
    """(l11, l21, l22) of the rows first, second (count,) of a matrix A: L L' = A A', by modified Gram-Schmidt.

    Overwrites `second`.
    """
    squared = 0.0
    for k in range(count):
        squared += first[k] * first[k]
    l11 = math.sqrt(squared)
    l21 = 0.0
    if l11 > 0.0:
        for k in range(count):
            l21 += first[k] * second[k]
        l21 /= l11
        share = l21 / l11
        for k in range(count):
            second[k] -= share * first[k]
    squared = 0.0
    for k in range(count):
        squared += second[k] * second[k]
    return l11, l21, math.sqrt(squared)


@compiled
def sight(setup, x, y, heading, px, py):
    """Range and bearing of the point (px, py) from a vehicle at (x, y, heading)."""
    cosine, sine = math.cos(heading), math.sin(heading)
    dx, dy = px - x, py - y
    ahead = cosine * dx + sine * dy - setup[MOUNT_X]
    left = cosine * dy - sine * dx - setup[MOUNT_Y]
    return math.hypot(ahead, left), wrap(math.atan2(left, ahead) - setup[MOUNT_HEADING])


@compiled
def sight_jacobian(setup, x, y, heading, px, py, matrix):
    """The same, and d (range, bearing) / d (x, y, heading, px, py): (2, 5), additive."""
    cosine, sine = math.cos(heading), math.sin(heading)
    dx, dy = px - x, py - y
    ahead = cosine * dx + sine * dy - setup[MOUNT_X]
    left = cosine * dy - sine * dx - setup[MOUNT_Y]
    squared = max(ahead * ahead + left * left, 1e-12)
    distance = math.sqrt(squared)
    # the ray in the world's axes
    rx = cosine * ahead - sine * left
    ry = sine * ahead + cosine * left
    matrix[0, 3], matrix[0, 4] = rx / distance, ry / distance
    matrix[1, 3], matrix[1, 4] = -ry / squared, rx / squared
    for r in range(2):
        matrix[r, 0], matrix[r, 1] = -matrix[r, 3], -matrix[r, 4]
        # turning the vehicle by a moves the point by -a about the vehicle
        matrix[r, 2] = matrix[r, 3] * dy - matrix[r, 4] * dx
    return distance, wrap(math.atan2(left, ahead) - setup[MOUNT_HEADING])


@compiled
def noise_root(setup, given, distance):
    """(s_r, c, s_b): lower root of a sighting's noise at that distance.

    given (4,): root of what the frame itself states, -1: nothing; then, m, how far apart the sightings of one landmark
    from different sides are.
    """
    if given[0] >= 0.0:
        return given[0], given[1], given[2]
    s_r = math.hypot(setup[SIGMA_RANGE], setup[RATIO_RANGE] * distance)
    if given[3] == 0.0:
        return s_r, 0.0, setup[SIGMA_BEARING]
    across = given[3] / max(distance, given[3])
    return math.hypot(s_r, given[3]), 0.0, math.hypot(setup[SIGMA_BEARING], across)


@compiled
def _columns_by_jacobian(setup, pose, root, component, matrix, first, second):
    """E_z (2, 5) at the mean; returns range and bearing."""
    distance, bearing = sight_jacobian(setup, pose[0], pose[1], pose[2], component[X], component[Y], matrix)
    for i in range(3):
        a, b = 0.0, 0.0
        for k in range(i, 3):
            a += matrix[0, k] * root[k, i]
            b += matrix[1, k] * root[k, i]
        first[i], second[i] = a, b
    first[3] = matrix[0, 3] * component[L11] + matrix[0, 4] * component[L21]
    second[3] = matrix[1, 3] * component[L11] + matrix[1, 4] * component[L21]
    first[4], second[4] = matrix[0, 4] * component[L22], matrix[1, 4] * component[L22]
    return distance, bearing


@compiled
def _columns_by_points(setup, pose, root, component, first, second):
    """E_z (2, 10) from the points of the rule along the columns of diag(root, L); returns the expected sighting."""
    spread, w_mean, _, w_even = weights(setup, 5)
    r0, b0 = sight(setup, pose[0], pose[1], pose[2], component[X], component[Y])
    mean_r, mean_b = 0.0, 0.0
    for i in range(5):
        dx, dy, turn, mx, my = 0.0, 0.0, 0.0, 0.0, 0.0
        if i < 3:
            dx, dy, turn = spread * root[0, i], spread * root[1, i], spread * root[2, i]
        elif i == 3:
            mx, my = spread * component[L11], spread * component[L21]
        else:
            my = spread * component[L22]
        if dx == 0.0 and dy == 0.0 and turn == 0.0 and mx == 0.0 and my == 0.0:
            first[i], second[i], first[5 + i], second[5 + i] = 0.0, 0.0, 0.0, 0.0
            continue
        x, y, heading = pose[0], pose[1], pose[2]
        px, py = component[X], component[Y]
        r1, b1 = sight(setup, x + dx, y + dy, heading + turn, px + mx, py + my)
        r2, b2 = sight(setup, x - dx, y - dy, heading - turn, px - mx, py - my)
        b1, b2 = wrap(b1 - b0), wrap(b2 - b0)
        first[i], second[i] = 0.5 * (r1 - r2) / spread, 0.5 * (b1 - b2) / spread
        even_r, even_b = 0.5 * (r1 + r2) - r0, 0.5 * (b1 + b2)
        first[5 + i], second[5 + i] = even_r, even_b
        mean_r += even_r
        mean_b += even_b
    mean_r *= 2.0 * w_mean
    mean_b *= 2.0 * w_mean
    centred = 0.0 if int(setup[RULE]) == CENTRAL_DIFFERENCE else 1.0
    scale = math.sqrt(w_even)
    for i in range(5, 10):
        first[i] = scale * (first[i] - centred * mean_r)
        second[i] = scale * (second[i] - centred * mean_b)
    return r0 + mean_r, wrap(b0 + mean_b)


@compiled
def look(setup, pose, root, component, noise, scratch, out):
    """Fill one row `out` (LOOK,) but for the probability of detection.

    pose (3,); root (3, 3): lower root of the pose's additive covariance, zero for a known pose. component
    (COLUMNS,). noise (4,): see `noise_root`. scratch: (4, 12) and more rows than that.
    """
    first, second, matrix = scratch[0], scratch[1], scratch[2:4, :5]
    if int(setup[RULE]) == JACOBIAN:
        count = 5
        distance, bearing = _columns_by_jacobian(setup, pose, root, component, matrix, first, second)
    else:
        count = 10
        distance, bearing = _columns_by_points(setup, pose, root, component, first, second)
    s_r, cross, s_b = noise_root(setup, noise, distance)
    # P_mz = E_m E_z', E_m = [0, L, 0]
    l11, l21, l22 = component[L11], component[L21], component[L22]
    c11, c12 = l11 * first[3], l11 * second[3]
    c21, c22 = l21 * first[3] + l22 * first[4], l21 * second[3] + l22 * second[4]
    third, fourth = scratch[2], scratch[3]
    for k in range(count):
        third[k], fourth[k] = first[k], second[k]
    first[count], second[count], first[count + 1], second[count + 1] = s_r, cross, 0.0, s_b
    w11, w21, w22 = lower_root(first, second, count + 2)
    # K = P_mz (W W')^-1, row by row
    a, b = c11 / w11, (c12 - w21 * c11 / w11) / w22
    k12 = b / w22
    k11 = (a - w21 * k12) / w11
    a, b = c21 / w11, (c22 - w21 * c21 / w11) / w22
    k22 = b / w22
    k21 = (a - w21 * k22) / w11
    for k in range(count):
        zr, zb = third[k], fourth[k]
        first[k], second[k] = -k11 * zr - k12 * zb, -k21 * zr - k22 * zb
    first[3] += l11
    second[3] += l21
    second[4] += l22
    first[count], second[count] = k11 * s_r + k12 * cross, k21 * s_r + k22 * cross
    first[count + 1], second[count + 1] = k12 * s_b, k22 * s_b
    out[RANGE], out[BEARING] = distance, bearing
    out[W11], out[W21], out[W22] = w11, w21, w22
    out[K11], out[K12], out[K21], out[K22] = k11, k12, k21, k22
    out[U11], out[U21], out[U22] = lower_root(first, second, count + 2)
    out[NORM] = math.log(_TWO_PI * w11 * w22)


@compiled
def _inside(distance, sigma):
    """Probability that something `distance` inside an edge, give or take sigma, is inside."""
    if distance > _SURE * sigma:
        return 1.0
    if distance < -_SURE * sigma:
        return 0.0
    return 0.5 * math.erfc(-distance / (sigma * 1.4142135623730951))


@compiled
def detection(rules, profile, beams, row):
    """Probability that a component which looks like `row` is sighted: ring, soft edges of the view, occlusion.

    profile (RINGS,): probability in each ring of equal width up to the largest range, linear between their middles.
    beams: (B, 2) bearing rad ascending and range m of the sweep that the sightings were found in; B = 0: none.
    """
    distance, bearing = row[RANGE], row[BEARING]
    sigma_b = math.hypot(row[W21], row[W22])
    share = _inside(rules[MAX_RANGE] - distance, row[W11])
    if rules[MIN_RANGE] > 0.0:
        share *= _inside(distance - rules[MIN_RANGE], row[W11])
    if rules[HALF_VIEW] < math.pi:
        share *= _inside(rules[HALF_VIEW] - abs(bearing), sigma_b)
    if share == 0.0:
        return 0.0
    rings = int(rules[RINGS])
    at = min(max(distance / rules[MAX_RANGE] * rings - 0.5, 0.0), rings - 1.0)
    low = min(int(at), max(rings - 2, 0))
    high = min(low + 1, rings - 1)
    share *= profile[low] + (at - low) * (profile[high] - profile[low])
    if len(beams) and _hidden(rules, beams, distance, bearing):
        return 0.0
    return min(share, SUREST)


@compiled
def _hidden(rules, beams, distance, bearing):
    """Whether the beam that points at a place came back from well before it, or no beam points there.

    A sweep whose ends are no further apart than two of its beams goes all around.
    """
    count = len(beams)
    first, last = beams[0, 0], beams[count - 1, 0]
    bearing = first + (bearing - first) % _TWO_PI
    if bearing > last:
        if first + _TWO_PI - last > 2.0 * (last - first) / max(count - 1, 1):
            return True
        low = count - 1 if bearing - last < first + _TWO_PI - bearing else 0
    else:
        at = min(max(np.searchsorted(beams[:, 0], bearing), 1), count - 1)
        low = at - 1 if bearing - beams[at - 1, 0] < beams[at, 0] - bearing else at
    return 0.0 < beams[low, 1] < distance - rules[DEPTH]


@compiled
def found(setup, pose, root, z, noise, scratch, component):
    """Fill X, Y and the root of the component that a sighting z (2,) founds, seen from the pose.

    Its covariance is that of the landmark over (pose, range, bearing), by the Jacobian of the inverse sensor; across
    the ray at least as if it were as far away as the range is uncertain, so that it has a root at the sensor itself.
    """
    angle = pose[2] + z[1] + setup[MOUNT_HEADING]
    cosine, sine = math.cos(pose[2]), math.sin(pose[2])
    ray_x, ray_y = math.cos(angle), math.sin(angle)
    from_x = cosine * setup[MOUNT_X] - sine * setup[MOUNT_Y] + z[0] * ray_x
    from_y = sine * setup[MOUNT_X] + cosine * setup[MOUNT_Y] + z[0] * ray_y
    s_r, cross, s_b = noise_root(setup, noise, z[0])
    first, second = scratch[0], scratch[1]
    for i in range(3):
        first[i] = root[0, i] - from_y * root[2, i]
        second[i] = root[1, i] + from_x * root[2, i]
    arm = max(z[0], s_r)
    side_x, side_y = -arm * ray_y, arm * ray_x
    first[3], second[3] = ray_x * s_r + side_x * cross, ray_y * s_r + side_y * cross
    first[4], second[4] = side_x * s_b, side_y * s_b
    component[X], component[Y] = pose[0] + from_x, pose[1] + from_y
    component[L11], component[L21], component[L22] = lower_root(first, second, 5)
