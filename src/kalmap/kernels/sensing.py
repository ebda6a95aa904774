"""Range-bearing sightings of point landmarks: regression of one, its inverse, and its noise.

The block handed to the lineariser is (pose, landmark): equations (32)-(34) of Chen & Cheng 2012. Its inverse,
which founds a landmark, reads (pose, range, bearing).
"""

import math

import numpy as np

from kalmap.kernels.compiled import compiled
from kalmap.kernels.layout import (
    INVARIANT,
    JACOBIAN,
    MOUNT_HEADING,
    MOUNT_X,
    MOUNT_Y,
    NOT_POSITIVE,
    OK,
    RATIO_RANGE,
    RULE,
    SIGMA_BEARING,
    SIGMA_RANGE,
)
from kalmap.kernels.regression import left_jacobian, regress, square_root, weights, wrap


@compiled
def sighting_covariance(setup, distance, out):
    """(range, bearing) noise from the sensor class's sigmas, at this distance in m."""
    out[0, 0] = setup[SIGMA_RANGE] ** 2 + (setup[RATIO_RANGE] * distance) ** 2
    out[1, 1] = setup[SIGMA_BEARING] ** 2
    out[0, 1] = out[1, 0] = 0.0


@compiled
def first_bad_sighting(z):
    """Index of the first sighting that is not finite or has a negative range; -1 if there is none."""
    for m in range(len(z)):
        if not (math.isfinite(z[m, 0]) and math.isfinite(z[m, 1]) and z[m, 0] >= 0.0):
            return m
    return -1


@compiled
def fill_noises(setup, z, out):
    """out (M, 2, 2): the noise of every sighting of z (M, 2). Returns the first bad sighting's index, or -1."""
    for m in range(len(z)):
        sighting_covariance(setup, z[m, 0], out[m])
    return first_bad_sighting(z)


@compiled
def first_bad_noise(noises):
    """Index of the first (2, 2) that is not finite or not positive semi-definite; -1 if there is none."""
    for m in range(len(noises)):
        a, b, c, d = noises[m, 0, 0], noises[m, 0, 1], noises[m, 1, 0], noises[m, 1, 1]
        finite = math.isfinite(a) and math.isfinite(b) and math.isfinite(c) and math.isfinite(d)
        if not (finite and a >= 0.0 and d >= 0.0 and a * d - b * c >= -1e-9 * a * d):
            return m
    return -1


@compiled
def predict_sighting(setup, pose, x, y):
    """(range, bearing) of the point (x, y) from the mounted sensor."""
    return _seen_along(setup, math.cos(pose[2]), math.sin(pose[2]), x - pose[0], y - pose[1])


@compiled
def _seen_along(setup, cosine, sine, dx, dy):
    """The same for a point (dx, dy) m from the robot, whose heading has this cosine and sine."""
    forward = cosine * dx + sine * dy - setup[MOUNT_X]
    left = cosine * dy - sine * dx - setup[MOUNT_Y]
    return math.hypot(forward, left), wrap(math.atan2(left, forward) - setup[MOUNT_HEADING])


@compiled
def _sighting_jacobian(setup, pose, x, y, matrix):
    """d (range, bearing) / d (pose, landmark), analytically: (2, 5)."""
    cosine, sine = math.cos(pose[2]), math.sin(pose[2])
    dx, dy = x - pose[0], y - pose[1]
    forward = cosine * dx + sine * dy - setup[MOUNT_X]
    left = cosine * dy - sine * dx - setup[MOUNT_Y]
    square = max(forward * forward + left * left, 1e-300)
    distance = math.sqrt(square)
    gradient = np.empty((2, 2))
    gradient[0, 0], gradient[0, 1] = forward / distance, left / distance
    gradient[1, 0], gradient[1, 1] = -left / square, forward / square
    for r in range(2):
        along, across = gradient[r, 0], gradient[r, 1]
        gx = cosine * along - sine * across
        gy = sine * along + cosine * across
        matrix[r, 0], matrix[r, 1], matrix[r, 3], matrix[r, 4] = -gx, -gy, gx, gy
        matrix[r, 2] = gx * dy - gy * dx


@compiled
def _sighting_at(setup, pose, cosine, sine, x, y, deviation):
    """(range, bearing) with (pose, landmark) deviated; in invariant coordinates by a twist about the robot.

    cosine, sine: of the undeviated heading.
    """
    if setup[INVARIANT] == 0.0:
        moved = (pose[0] + deviation[0], pose[1] + deviation[1], pose[2] + deviation[2])
        return predict_sighting(setup, moved, x + deviation[3], y + deviation[4])
    # Seen from the robot, only V' (xi_landmark - xi_position) is left of the twist.
    s, v = left_jacobian(deviation[2])
    ux, uy = deviation[3] - deviation[0], deviation[4] - deviation[1]
    dx, dy = x + s * ux + v * uy - pose[0], y - v * ux + s * uy - pose[1]
    return _seen_along(setup, cosine, sine, dx, dy)


@compiled
def to_twist(cov, dx, dy):
    """Change a (pose, landmark) covariance in place from additive errors to twists about the robot.

    dx, dy: landmark minus robot. xi_landmark = d_landmark - J (dx, dy) d_theta, J = [[0, -1], [1, 0]].
    """
    for k in range(5):
        cov[3, k] += dy * cov[2, k]
        cov[4, k] -= dx * cov[2, k]
    for k in range(5):
        cov[k, 3] += dy * cov[k, 2]
        cov[k, 4] -= dx * cov[k, 2]


@compiled
def regress_sighting(setup, pose, x, y, cov, predicted, matrix, residual):
    """Predicted (range, bearing), regression matrix on the additive (pose, landmark) errors, and Lambda.

    cov: (5, 5), overwritten. predicted: (2,). matrix: (2, 5). residual: (2, 2). Returns a status code.
    """
    distance, bearing = predict_sighting(setup, pose, x, y)
    predicted[0], predicted[1] = distance, bearing
    if int(setup[RULE]) == JACOBIAN:
        _sighting_jacobian(setup, pose, x, y, matrix)
        residual[:, :] = 0.0
        return OK
    invariant = setup[INVARIANT] != 0.0
    dx, dy = x - pose[0], y - pose[1]
    if invariant:
        to_twist(cov, dx, dy)
    root = np.empty((5, 5))
    if not square_root(cov, 5, root):
        return NOT_POSITIVE
    spread = weights(setup, 5)[0]
    points = np.empty((2, 5, 2))
    deviation = np.empty(5)
    cosine, sine = math.cos(pose[2]), math.sin(pose[2])
    for i in range(5):
        for sign in range(2):
            for k in range(5):
                deviation[k] = spread * root[k, i] if sign == 0 else -spread * root[k, i]
            r, b = _sighting_at(setup, pose, cosine, sine, x, y, deviation)
            points[sign, i, 0], points[sign, i, 1] = r - distance, wrap(b - bearing)
    offset = np.empty(2)
    regress(setup, points[0], points[1], 5, 2, root, offset, matrix, residual, 0)
    predicted[0] += offset[0]
    predicted[1] = wrap(bearing + offset[1])
    if invariant:
        for r in range(2):
            matrix[r, 2] += dy * matrix[r, 3] - dx * matrix[r, 4]
    return OK


@compiled
def _landmark_jacobian(setup, pose, distance, bearing, matrix):
    """d landmark / d (pose, range, bearing), analytically: (2, 5). Also returns the landmark."""
    cosine, sine = math.cos(pose[2]), math.sin(pose[2])
    angle = pose[2] + bearing + setup[MOUNT_HEADING]
    ray_x, ray_y = math.cos(angle), math.sin(angle)
    from_x = cosine * setup[MOUNT_X] - sine * setup[MOUNT_Y] + distance * ray_x
    from_y = sine * setup[MOUNT_X] + cosine * setup[MOUNT_Y] + distance * ray_y
    matrix[0, 0], matrix[0, 1], matrix[0, 2] = 1.0, 0.0, -from_y
    matrix[1, 0], matrix[1, 1], matrix[1, 2] = 0.0, 1.0, from_x
    matrix[0, 3], matrix[0, 4] = ray_x, -distance * ray_y
    matrix[1, 3], matrix[1, 4] = ray_y, distance * ray_x
    return pose[0] + from_x, pose[1] + from_y


@compiled
def regress_landmark(setup, pose, z, cov, noise, landmark, matrix, residual):
    """Where a first sighting z = (range, bearing) puts its landmark: mean, matrix (2, 5) and Lambda.

    cov: (3, 3) of the pose. noise: (2, 2) of the sighting. The matrix acts on the additive errors of
    (pose, range, bearing). Returns a status code.
    """
    landmark[0], landmark[1] = _landmark_jacobian(setup, pose, z[0], z[1], matrix)
    if int(setup[RULE]) == JACOBIAN:
        residual[:, :] = 0.0
        return OK
    invariant = setup[INVARIANT] != 0.0
    root = np.zeros((5, 5))
    if not square_root(cov, 3, root[:3, :3]) or not square_root(noise, 2, root[3:, 3:]):
        return NOT_POSITIVE
    spread = weights(setup, 5)[0]
    points = np.empty((2, 5, 2))
    deviation, moved, unused = np.empty(5), np.empty(3), np.empty((2, 5))
    dx, dy = landmark[0] - pose[0], landmark[1] - pose[1]
    for i in range(5):
        for sign in range(2):
            for k in range(5):
                deviation[k] = spread * root[k, i] if sign == 0 else -spread * root[k, i]
            if invariant and i < 3:  # the whole map turns with the robot: the answer is the twist itself
                points[sign, i, 0], points[sign, i, 1] = deviation[0], deviation[1]
                continue
            for k in range(3):
                moved[k] = pose[k] + deviation[k]
            x, y = _landmark_jacobian(setup, moved, z[0] + deviation[3], z[1] + deviation[4], unused)
            points[sign, i, 0], points[sign, i, 1] = x - landmark[0], y - landmark[1]
    offset = np.empty(2)
    regress(setup, points[0], points[1], 5, 2, root, offset, matrix, residual, 0)
    landmark[0] += offset[0]
    landmark[1] += offset[1]
    if invariant:
        matrix[0, 2] -= dy
        matrix[1, 2] += dx
    return OK


@compiled
def sighting_block(packed, index, out):
    """The (pose, landmark) block (5, 5) of the packed covariance; `index` is where the landmark begins."""
    position = 0
    for i in range(3):
        for j in range(i + 1):
            out[i, j] = packed[position]
            out[j, i] = packed[position]
            position += 1
    for r in range(2):
        start = (index + r) * (index + r + 1) // 2
        for j in range(3):
            out[3 + r, j] = packed[start + j]
            out[j, 3 + r] = packed[start + j]
        for k in range(r + 1):
            out[3 + r, 3 + k] = packed[start + index + k]
            out[3 + k, 3 + r] = packed[start + index + k]
