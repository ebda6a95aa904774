"""The state of a sampled environment map: its layout, and what is done to it as a whole.

In order: pose (3), the scanner's calibration (2), the lever of the odometry's point (2), the latency of scans, the
wheels' scales (2), then two numbers a sample. The update is that of several hundred scalars as one block (equations (9)
to (11) of Sun et al. 2010).
"""

import math

import numpy as np
from numba import njit

from kalmap.kernels.compiled import compiled
from kalmap.kernels.layout import INNOVATION_NOT_POSITIVE
from kalmap.kernels.packed import pack, unpack
from kalmap.kernels.regression import wrap
from kalmap.kernels.update import apply_rows, gather_rows

CALIBRATION = 3  # where the scanner's calibration stands in the state: bearing scale, range offset
LEVER = 5  # x, y m of the point that the odometry speaks of, in the vehicle's frame
LATENCY = 7  # s by which a scan is stamped later than it was taken
WHEELS = 8  # by which share odometry's ways, and its turns, are too short
SAMPLES = 10  # where the samples begin


@compiled
def shift_point(mean, packed, n, sign):
    """Speak of the odometry's point instead of the vehicle's (sign 1), or the other way round (-1): O(n)."""
    c, s = sign * math.cos(mean[2]), sign * math.sin(mean[2])
    x, y = c * mean[LEVER] - s * mean[LEVER + 1], s * mean[LEVER] + c * mean[LEVER + 1]
    mean[0] += x
    mean[1] += y
    block, across = np.empty((SAMPLES, SAMPLES)), np.empty((2, SAMPLES))
    unpack(packed, SAMPLES, block)
    for j in range(SAMPLES):
        across[0, j] = c * block[LEVER, j] - s * block[LEVER + 1, j] - y * block[2, j]
        across[1, j] = s * block[LEVER, j] + c * block[LEVER + 1, j] + x * block[2, j]
    block[:2] += across
    for i in range(SAMPLES):
        from_x, from_y, turn = block[i, LEVER], block[i, LEVER + 1], block[i, 2]
        block[i, 0] += c * from_x - s * from_y - y * turn
        block[i, 1] += s * from_x + c * from_y + x * turn
    pack(block, SAMPLES, packed)
    for i in range(SAMPLES, n):
        row = packed[i * (i + 1) // 2 :]
        row[0] += c * row[LEVER] - s * row[LEVER + 1] - y * row[2]
        row[1] += s * row[LEVER] + c * row[LEVER + 1] + x * row[2]


@compiled
def blame(packed, n, entry, effect):
    """Give the pose the share of a number's error that has just moved it: effect (3,) m, m, rad a unit of it. O(n).

    entry: of the number, one of those between the pose and the samples.
    """
    block = np.empty((SAMPLES, SAMPLES))
    unpack(packed, SAMPLES, block)
    for k in range(3):
        block[k] += effect[k] * block[entry]
    for i in range(SAMPLES):
        own = block[i, entry]
        for k in range(3):
            block[i, k] += effect[k] * own
    pack(block, SAMPLES, packed)
    for i in range(SAMPLES, n):
        row = packed[i * (i + 1) // 2 :]
        for k in range(3):
            row[k] += effect[k] * row[entry]


@compiled
def acquit(packed, n, entry):
    """Take a number for independent of all the rest: what comes next has nothing to say about it. O(n).

    entry: of the number, one of those between the pose and the samples.
    """
    first = entry * (entry + 1) // 2
    packed[first : first + entry] = 0.0
    for i in range(entry + 1, n):
        packed[i * (i + 1) // 2 + entry] = 0.0


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def _fill_scalar_rows(n, matrices, rows, work):
    """work[m, :n] = A_m P from the gathered rows of P: two of the calibration, two a sample, three of the pose."""
    pose = 2 * len(matrices) + 2
    x_row, y_row, turn_row, scale_row, offset_row = (
        rows[pose],
        rows[pose + 1],
        rows[pose + 2],
        rows[0],
        rows[1],
    )
    for m in range(len(matrices)):
        first, second, row = rows[2 * m + 2], rows[2 * m + 3], work[m]
        a, b, c, d, e = matrices[m, 0], matrices[m, 1], matrices[m, 2], matrices[m, 3], matrices[m, 4]
        f, g = matrices[m, 5], matrices[m, 6]
        for i in range(n):
            row[i] = a * x_row[i] + b * y_row[i] + c * turn_row[i] + f * first[i] + g * second[i]
        for i in range(n):
            row[i] += d * scale_row[i] + e * offset_row[i]


@compiled
def apply_distances(setup, mean, packed, n, indices, matrices, innovation, noise, left, right):
    """One joint update with M scalars, each of (pose, calibration, one sample). Returns (status, NIS).

    indices: (M,) where the samples begin. matrices: (M, 7). innovation: (M,) m, overwritten. noise: (M, M) m^2, the
    lower triangle is read. left, right: work space of at least (2 M + 6, n). After an error nothing has been changed.
    """
    count = len(indices)
    wanted = np.empty(count + 1, dtype=np.int64)
    wanted[0] = CALIBRATION
    wanted[1:] = indices
    gather_rows(packed, n, wanted, left)
    _fill_scalar_rows(n, matrices, left, right)
    left[count + 2, :n] = left[2 * count + 4, :n]
    root = np.zeros((count, count))
    for i in range(count):
        for j in range(i + 1):
            index = indices[j]
            total = noise[i, j] + matrices[j, 5] * right[i, index] + matrices[j, 6] * right[i, index + 1]
            for p in range(5):
                total += matrices[j, p] * right[i, p]
            for p in range(j):
                total -= root[i, p] * root[j, p]
            if i == j:
                if not total > 0.0:
                    return INNOVATION_NOT_POSITIVE, 0.0
                root[i, i] = math.sqrt(total)
            else:
                root[i, j] = total / root[j, j]
    return apply_rows(setup, mean, packed, n, count, root, innovation, left, right)


@compiled
def calibration_effect(points, normals, mount, effect):
    """effect (M, 2): how far the scanner shifts what it shows at `points` along `normals`, m a unit of its calibration.

    points, normals: (M, 2) in the robot's frame. A bearing b truly is (1 + scale) b, a range r truly r + offset.
    """
    for m in range(len(points)):
        x, y = points[m, 0] - mount[0], points[m, 1] - mount[1]
        r = max(1e-9, math.hypot(x, y))
        bearing = wrap(math.atan2(y, x) - mount[2])
        effect[m, 0] = bearing * (normals[m, 1] * x - normals[m, 0] * y)
        effect[m, 1] = (normals[m, 0] * x + normals[m, 1] * y) / r


@compiled
def _entry(packed, i, j):
    """P[i, j] of the packed lower triangle."""
    return packed[i * (i + 1) // 2 + j] if j <= i else packed[j * (j + 1) // 2 + i]


@compiled
def append_samples(mean, packed, n, points, normal, effect, noise):
    """Append samples that a scan shows at `points` (M, 2), in the robot's frame; returns the new n.

    The buffers must have room. normal: (M, 2) unit, in the robot's frame. effect: (M, 2), see `calibration_effect`.
    noise: (M, M) m^2, covariance of the points along their normals; along the contour a sample is where it is by
    definition. O(M n).
    """
    c, s = math.cos(mean[2]), math.sin(mean[2])
    count, before = len(points), n
    lever = np.empty(2)
    turned = np.empty((count, 2))
    for m in range(count):
        turned[m, 0] = c * normal[m, 0] - s * normal[m, 1]
        turned[m, 1] = s * normal[m, 0] + c * normal[m, 1]
        rx, ry = c * points[m, 0] - s * points[m, 1], s * points[m, 0] + c * points[m, 1]
        lever[0], lever[1] = -ry, rx
        for r in range(2):
            start = (n + r) * (n + r + 1) // 2
            for j in range(before + 2 * m + r + 1):
                if j < before:
                    own = packed[r * (r + 1) // 2 + j] if j <= r else packed[j * (j + 1) // 2 + r]
                    turn = packed[3 + j] if j <= 2 else packed[j * (j + 1) // 2 + 2]
                    bias, shift = _entry(packed, CALIBRATION, j), _entry(packed, CALIBRATION + 1, j)
                    calibrated = effect[m, 0] * bias + effect[m, 1] * shift
                    packed[start + j] = own + lever[r] * turn + turned[m, r] * calibrated
                else:  # another new sample, or this one: through the pose, and the piece's noise
                    q, a = (j - before) // 2, (j - before) % 2
                    px, py = c * points[q, 0] - s * points[q, 1], s * points[q, 0] + c * points[q, 1]
                    arm = -py if a == 0 else px
                    total = packed[start + a] + arm * packed[start + 2]
                    bias, shift = packed[start + CALIBRATION], packed[start + CALIBRATION + 1]
                    total += turned[q, a] * (effect[q, 0] * bias + effect[q, 1] * shift)
                    packed[start + j] = total + turned[m, r] * turned[q, a] * noise[m, q]
            mean[n + r] = mean[r] + (rx if r == 0 else ry)
        n += 2
    return n
