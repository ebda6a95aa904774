"""Predicting the robot block over a run of odometry samples.

The block handed to the lineariser is (pose, biases, control): equations (27)-(31) of Chen & Cheng 2012, with the
matrices of several samples multiplied up, so that the cross-covariance with the map is touched once a frame.
"""

import math

import numpy as np

from kalmap.kernels.compiled import compiled
from kalmap.kernels.controls import (
    bias_jacobian,
    control_corrections,
    control_covariance,
    increment_jacobian,
    sample_increment,
)
from kalmap.kernels.layout import (
    BAD_SAMPLE,
    BIAS_CODE,
    BIAS_COUNT,
    BIAS_COURSE_OFFSET,
    INVARIANT,
    JACOBIAN,
    NOT_FINITE,
    NOT_POSITIVE,
    OK,
    RULE,
)
from kalmap.kernels.packed import pack, unpack
from kalmap.kernels.regression import left_jacobian, regress, square_root, weights, wrap


@compiled
def _next_difference(setup, pose, heading, step0, deviation, control, noise, biases, dt):
    """Next pose at a deviated (pose, biases, control), as a difference from the undeviated next pose.

    pose: triple; heading: (cos, sin) of its angle; step0: the undeviated increment. In invariant coordinates
    the pose deviation is a twist about the robot's position; with control and biases undeviated the answer is
    linear in it, exactly.
    """
    invariant = setup[INVARIANT] != 0.0
    moved = noise[0] != 0.0 or noise[1] != 0.0 or noise[2] != 0.0
    for i in range(len(biases)):
        if deviation[3 + i] != 0.0:
            moved = True
    turn = deviation[2]
    cosine, sine = heading
    ox = cosine * step0[0] - sine * step0[1]
    oy = sine * step0[0] + cosine * step0[1]
    if not moved and (invariant or turn == 0.0):
        return deviation[0] - oy * turn, deviation[1] + ox * turn, turn
    step = step0
    if moved:
        step = sample_increment(setup, control, noise, biases, deviation, dt)
    dx, dy = deviation[0], deviation[1]
    if turn != 0.0:
        cosine, sine = math.cos(pose[2] + turn), math.sin(pose[2] + turn)
        if invariant:
            s, v = left_jacobian(turn)
            dx, dy = s * dx - v * dy, v * dx + s * dy
    dx += cosine * step[0] - sine * step[1] - ox
    dy += sine * step[0] + cosine * step[1] - oy
    dt_angle = turn + step[2] - step0[2]
    if invariant:
        s, v = left_jacobian(dt_angle)
        scale = 1.0 / (s * s + v * v)
        dx, dy = scale * (s * dx + v * dy), scale * (s * dy - v * dx)
    return dx, dy, dt_angle


@compiled
def _write_turn(heading, step, matrix):
    """The pose's own columns: the next pose turns about the present one."""
    cosine, sine = heading
    for r in range(3):
        for k in range(3):
            matrix[r, k] = 1.0 if r == k else 0.0
    matrix[0, 2] = -(sine * step[0] + cosine * step[1])
    matrix[1, 2] = cosine * step[0] - sine * step[1]


@compiled
def _step_by_points(
    setup,
    pose,
    heading,
    step0,
    control,
    biases,
    c,
    dt,
    root,
    matrix,
    residual,
    offset,
    plus,
    minus,
    deviation,
):
    """Regress the next pose on (pose, biases, control) by sigma points along the columns of `root`.

    In invariant coordinates and without biases the pose's own points go through exactly linearly, whatever the
    control (`_next_difference` says how), and their part of the matrix is written down instead of sampled.
    """
    d = 3 + len(biases)
    n = d + c
    s = weights(setup, n)[0]
    linear = 3 if setup[INVARIANT] != 0.0 and d == 3 else 0
    if linear:
        _write_turn(heading, step0, matrix)
    for i in range(linear, n):
        for sign in range(2):
            spread = s if sign == 0 else -s
            for k in range(n):
                deviation[k] = spread * root[k, i]
            first, turn = deviation[d], deviation[n - 1]
            second = deviation[d + 1] if c == 3 else 0.0
            dx, dy, angle = _next_difference(
                setup, pose, heading, step0, deviation, control, (first, second, turn), biases, dt
            )
            if sign == 0:
                plus[i, 0], plus[i, 1], plus[i, 2] = dx, dy, angle
            else:
                minus[i, 0], minus[i, 1], minus[i, 2] = dx, dy, angle
    regress(setup, plus, minus, n, 3, root, offset, matrix, residual, linear)


@compiled
def _step_by_jacobian(setup, heading, step0, control, biases, c, dt, matrix, scratch):
    """d next pose / d (pose, biases, control), analytically, at the mean. scratch: (10, 5)."""
    nb = len(biases)
    jac, by_bias, none = scratch[:3], scratch[3:6], scratch[9]
    speed_scale, turn_scale, turn_offset, course = control_corrections(setup, biases, none)
    raw, corrected = scratch[6], scratch[7]
    raw[0], raw[1], raw[c - 1] = control[0], control[1], control[2]
    corrected[0], corrected[1] = speed_scale * raw[0], speed_scale * raw[1]
    corrected[c - 1] = turn_scale * raw[c - 1] + turn_offset
    increment_jacobian(setup, corrected, dt, jac)
    bias_jacobian(setup, raw, c, by_bias)
    matrix[:, :] = 0.0
    _write_turn(heading, step0, matrix)
    for i in range(nb):
        if int(setup[BIAS_CODE + i]) == BIAS_COURSE_OFFSET:  # turns the way as the heading does
            matrix[0, 3 + i], matrix[1, 3 + i] = matrix[0, 2], matrix[1, 2]
    cosine, sine = math.cos(course), math.sin(course)
    cosine, sine = heading[0] * cosine - heading[1] * sine, heading[1] * cosine + heading[0] * sine
    for k in range(c):
        scale = turn_scale if k == c - 1 else speed_scale
        gx = cosine * jac[0, k] - sine * jac[1, k]
        gy = sine * jac[0, k] + cosine * jac[1, k]
        gt = jac[2, k]
        for i in range(nb):
            matrix[0, 3 + i] += gx * by_bias[k, i]
            matrix[1, 3 + i] += gy * by_bias[k, i]
            matrix[2, 3 + i] += gt * by_bias[k, i]
        matrix[0, 3 + nb + k] = scale * gx
        matrix[1, 3 + nb + k] = scale * gy
        matrix[2, 3 + nb + k] = scale * gt


@compiled
def propagate(setup, mean, packed, phi, controls, durations, covariances):
    """Carry the robot block (pose, biases) through T samples; the map's cross-covariance waits in `phi`.

    mean: its first d = 3 + nb entries are changed. packed: its leading d x d triangle is changed.
    phi: (d, d), multiplied from the left by each sample's regression matrix.
    controls: (T, c). durations: (T,) s. covariances: (T, c, c), or (0, c, c) to use the setup's sigmas.
    Returns a status code; after an error nothing has been changed.
    """
    nb = int(setup[BIAS_COUNT])
    d = 3 + nb
    c = controls.shape[1]
    n = d + c
    jacobian, invariant = int(setup[RULE]) == JACOBIAN, setup[INVARIANT] != 0.0
    pose, biases = (mean[0], mean[1], mean[2]), mean[3:d].copy()
    block, total = np.empty((d, d)), phi.copy()
    unpack(packed, d, block)
    q, root = np.zeros((c, c)), np.zeros((n, n))
    matrix, residual, offset = np.zeros((3, n)), np.zeros((3, 3)), np.zeros(3)
    scratch, plus, minus, top = (
        np.zeros((10, max(n, 5))),
        np.empty((n, 3)),
        np.empty((n, 3)),
        np.empty((3, n)),
    )
    state_root, noise_root = root[:d, :d], root[d:, d:]
    nothing, deviation = scratch[9], scratch[8]
    for t in range(len(durations)):
        dt = durations[t]
        control = (controls[t, 0], controls[t, 1] if c == 3 else 0.0, controls[t, c - 1])
        if not (dt >= 0.0 and math.isfinite(dt + control[0] + control[1] + control[2])):
            return BAD_SAMPLE
        if len(covariances) > 0:
            q[:, :] = covariances[t]
            if jacobian and not square_root(q, c, noise_root):
                return NOT_POSITIVE
        else:
            control_covariance(setup, control, dt, q)
        step = sample_increment(setup, control, (0.0, 0.0, 0.0), biases, nothing, dt)
        heading = (math.cos(pose[2]), math.sin(pose[2]))
        if jacobian:
            _step_by_jacobian(setup, heading, step, control, biases, c, dt, matrix, scratch)
        else:
            if (d > 3 or not invariant) and not square_root(block, d, state_root):
                return NOT_POSITIVE
            if not square_root(q, c, noise_root):
                return NOT_POSITIVE
            _step_by_points(
                setup,
                pose,
                heading,
                step,
                control,
                biases,
                c,
                dt,
                root,
                matrix,
                residual,
                offset,
                plus,
                minus,
                deviation,
            )
        pose = _move_mean(setup, pose, heading, step, offset, matrix, residual)
        _advance(matrix, residual, q, d, c, block, total, top)
    for i in range(3):
        if not math.isfinite(pose[i]) or not math.isfinite(block[i, i]):
            return NOT_FINITE
        if block[i, i] < 0.0:
            return NOT_POSITIVE
    for i in range(3):
        mean[i] = pose[i]
    pack(block, d, packed)
    phi[:, :] = total
    return OK


@compiled
def _move_mean(setup, pose, heading, step, offset, matrix, residual):
    """The pose after `step` and the mean's `offset`; invariant errors are carried along with the latter."""
    s, v = 1.0, 0.0
    if setup[INVARIANT] != 0.0:
        s, v = left_jacobian(offset[2])
    shift_x = s * offset[0] - v * offset[1]
    shift_y = v * offset[0] + s * offset[1]
    if setup[INVARIANT] != 0.0 and (shift_x != 0.0 or shift_y != 0.0):
        for k in range(matrix.shape[1]):
            matrix[0, k] -= shift_y * matrix[2, k]
            matrix[1, k] += shift_x * matrix[2, k]
        for k in range(3):
            residual[0, k] -= shift_y * residual[2, k]
            residual[1, k] += shift_x * residual[2, k]
        for k in range(3):
            residual[k, 0] -= shift_y * residual[k, 2]
            residual[k, 1] += shift_x * residual[k, 2]
    return (
        pose[0] + heading[0] * step[0] - heading[1] * step[1] + shift_x,
        pose[1] + heading[1] * step[0] + heading[0] * step[1] + shift_y,
        wrap(pose[2] + step[2] + offset[2]),
    )


@compiled
def _advance(matrix, residual, q, d, c, block, total, top):
    """block <- F block F' + G Q G' + Lambda and total <- F total, with [F G] = matrix over [0 I 0].

    top: (3, d + c) work space for [F block, G Q].
    """
    for r in range(3):
        for k in range(d):
            value = 0.0
            for i in range(d):
                value += matrix[r, i] * block[i, k]
            top[r, k] = value
        for k in range(c):
            value = 0.0
            for i in range(c):
                value += matrix[r, d + i] * q[i, k]
            top[r, d + k] = value
    for r in range(3):
        for k in range(r + 1):
            value = residual[r, k]
            for i in range(d + c):
                value += top[r, i] * matrix[k, i]
            block[r, k] = value
            block[k, r] = value
        for k in range(3, d):
            block[r, k] = top[r, k]
            block[k, r] = top[r, k]
    for r in range(3):
        for k in range(d):
            value = 0.0
            for i in range(d):
                value += matrix[r, i] * total[i, k]
            top[r, k] = value
    for r in range(3):
        for k in range(d):
            total[r, k] = top[r, k]
