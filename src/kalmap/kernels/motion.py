"""Predicting the robot block over a run of odometry samples.

All motion models are a pose composed with a body increment Delta(u, b, dt), b the constant biases; they
differ in Delta alone. The block handed to the lineariser is (pose, biases, control): equations (27)-(31)
of Chen & Cheng 2012, with the matrices of several samples multiplied up, so that the cross-covariance with
the map is touched once a frame.
"""

import math

import numpy as np
from numba import njit

from kalmap.kernels.layout import (
    BAD_SAMPLE,
    BIAS_CODE,
    BIAS_COUNT,
    BIAS_SPEED_SCALE,
    BIAS_STEERING_OFFSET,
    BIAS_STEERING_SCALE,
    BIAS_TURN_RATE_OFFSET,
    BIAS_TURN_RATE_SCALE,
    ENCODER_OFFSET,
    EXACT_STANDSTILL,
    INVARIANT,
    JACOBIAN,
    MOTION,
    MOTION_ACKERMANN,
    MOTION_INCREMENTS,
    MOTION_VELOCITY_STEERING,
    NOT_FINITE,
    NOT_POSITIVE,
    OK,
    RATIO_DISTANCE,
    RATIO_ROTATION,
    RATIO_SPEED,
    RATIO_TURN,
    RULE,
    SAMPLE_TIME,
    SIGMA_ROTATION,
    SIGMA_SPEED,
    SIGMA_TURN,
    WHEELBASE,
)
from kalmap.kernels.packed import pack, unpack
from kalmap.kernels.regression import left_jacobian, regress, square_root, weights, wrap


@njit(cache=True, nogil=True, error_model="numpy")
def control_corrections(setup, biases, deviation):
    """(speed scale, turn scale, turn offset) that the constant errors biases + deviation[3:] amount to."""
    speed_scale, turn_scale, turn_offset = 1.0, 1.0, 0.0
    for i in range(len(biases)):
        code = int(setup[BIAS_CODE + i])
        bias = biases[i] + deviation[3 + i]
        if code == BIAS_SPEED_SCALE:
            speed_scale += bias
        elif code == BIAS_STEERING_SCALE or code == BIAS_TURN_RATE_SCALE:
            turn_scale += bias
        elif code == BIAS_STEERING_OFFSET or code == BIAS_TURN_RATE_OFFSET:
            turn_offset += bias
    return speed_scale, turn_scale, turn_offset


@njit(cache=True, nogil=True, error_model="numpy")
def increment(setup, first, second, turn, dt):
    """Body increment (dx, dy, dtheta) of one sample from its corrected control, and nothing else of the model.

    first, turn: speed and steering or turn rate; `second` is read by increments only (dx, dy, dtheta).
    Velocity-steering: Bailey's front-wheel point, one Euler step. Ackermann and unicycle: the exact arc of
    a constant twist. Ackermann's speed is taken from the encoder's wheel to the axle centre first.
    """
    kind = int(setup[MOTION])
    if kind == MOTION_INCREMENTS:
        return first, second, turn
    distance = first * dt
    if kind == MOTION_VELOCITY_STEERING:
        lateral = distance * math.sin(turn)
        return distance * math.cos(turn), lateral, lateral / setup[WHEELBASE]
    if kind == MOTION_ACKERMANN:
        tangent = math.tan(turn)
        distance /= 1.0 - setup[ENCODER_OFFSET] / setup[WHEELBASE] * tangent
        angle = distance * tangent / setup[WHEELBASE]
    else:
        angle = turn * dt
    s, c = left_jacobian(angle)
    return distance * s, distance * c, angle


@njit(cache=True, nogil=True, error_model="numpy")
def sample_increment(setup, control, noise, biases, deviation, dt):
    """Increment of a control deviated by `noise`, with biases deviated by `deviation`, corrected first.

    control, noise: triples (first, second, turn). Nothing is deviated where both hold zeros.
    """
    speed_scale, turn_scale, turn_offset = control_corrections(setup, biases, deviation)
    return increment(
        setup,
        speed_scale * (control[0] + noise[0]),
        speed_scale * (control[1] + noise[1]),
        turn_scale * (control[2] + noise[2]) + turn_offset,
        dt,
    )


@njit(cache=True, nogil=True, error_model="numpy")
def increment_jacobian(setup, control, dt, out):
    """d increment / d corrected control: (3, c)."""
    kind = int(setup[MOTION])
    if kind == MOTION_INCREMENTS:
        out[:, :] = 0.0
        for i in range(3):
            out[i, i] = 1.0
        return
    v, g = control[0], control[1]
    if kind == MOTION_VELOCITY_STEERING:
        sine, cosine, base = math.sin(g), math.cos(g), setup[WHEELBASE]
        out[0, 0], out[0, 1] = dt * cosine, -v * dt * sine
        out[1, 0], out[1, 1] = dt * sine, v * dt * cosine
        out[2, 0], out[2, 1] = dt * sine / base, v * dt * cosine / base
        return
    if kind == MOTION_ACKERMANN:
        base, offset = setup[WHEELBASE], setup[ENCODER_OFFSET]
        tangent = math.tan(g)
        share = 1.0 / (1.0 - offset / base * tangent)
        secant2 = 1.0 + tangent * tangent
        distance = v * dt * share
        distance_v = dt * share
        distance_g = v * dt * share * share * offset / base * secant2
        turn = distance * tangent / base
        turn_v = distance_v * tangent / base
        turn_g = (distance_g * tangent + distance * secant2) / base
    else:
        distance, turn = v * dt, g * dt
        distance_v, distance_g, turn_v, turn_g = dt, 0.0, 0.0, dt
    s, c = left_jacobian(turn)
    if abs(turn) < 1e-4:
        s_turn, c_turn = -turn / 3.0, 0.5 - turn * turn / 8.0
    else:
        s_turn, c_turn = (math.cos(turn) - s) / turn, (math.sin(turn) - c) / turn
    out[0, 0] = distance_v * s + distance * s_turn * turn_v
    out[0, 1] = distance_g * s + distance * s_turn * turn_g
    out[1, 0] = distance_v * c + distance * c_turn * turn_v
    out[1, 1] = distance_g * c + distance * c_turn * turn_g
    out[2, 0], out[2, 1] = turn_v, turn_g


@njit(cache=True, nogil=True, error_model="numpy")
def bias_jacobian(setup, control, c, out):
    """d corrected control / d biases: (c, nb)."""
    out[:, :] = 0.0
    for i in range(int(setup[BIAS_COUNT])):
        code = int(setup[BIAS_CODE + i])
        if code == BIAS_SPEED_SCALE:
            out[0, i] = control[0]
            if c == 3:
                out[1, i] = control[1]
        elif code == BIAS_STEERING_SCALE or code == BIAS_TURN_RATE_SCALE:
            out[c - 1, i] = control[c - 1]
        else:
            out[c - 1, i] = 1.0


@njit(cache=True, nogil=True, error_model="numpy")
def control_covariance(setup, control, dt, out):
    """The noise of one sample (first, second, turn), from the sensor class's sigmas."""
    out[:, :] = 0.0
    if setup[EXACT_STANDSTILL] != 0.0 and control[0] == 0.0 and control[1] == 0.0 and control[2] == 0.0:
        return
    if int(setup[MOTION]) == MOTION_INCREMENTS:
        distance2 = control[0] ** 2 + control[1] ** 2
        out[0, 0] = setup[RATIO_DISTANCE] ** 2 * distance2
        out[1, 1] = out[0, 0]
        out[2, 2] = setup[SIGMA_ROTATION] ** 2 + (setup[RATIO_ROTATION] * control[2]) ** 2
        return
    scale = 1.0
    if setup[SAMPLE_TIME] > 0.0 and dt > 0.0:
        scale = setup[SAMPLE_TIME] / dt
    out[0, 0] = scale * (setup[SIGMA_SPEED] ** 2 + (setup[RATIO_SPEED] * control[0]) ** 2)
    out[1, 1] = scale * (setup[SIGMA_TURN] ** 2 + (setup[RATIO_TURN] * control[2]) ** 2)


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
def _write_turn(heading, step, matrix):
    """The pose's own columns: the next pose turns about the present one."""
    cosine, sine = heading
    for r in range(3):
        for k in range(3):
            matrix[r, k] = 1.0 if r == k else 0.0
    matrix[0, 2] = -(sine * step[0] + cosine * step[1])
    matrix[1, 2] = cosine * step[0] - sine * step[1]


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
def _step_by_jacobian(setup, heading, step0, control, biases, c, dt, matrix, scratch):
    """d next pose / d (pose, biases, control), analytically, at the mean. scratch: (10, 5)."""
    nb = len(biases)
    jac, by_bias, none = scratch[:3], scratch[3:6], scratch[9]
    speed_scale, turn_scale, turn_offset = control_corrections(setup, biases, none)
    raw, corrected = scratch[6], scratch[7]
    raw[0], raw[1], raw[c - 1] = control[0], control[1], control[2]
    corrected[0], corrected[1] = speed_scale * raw[0], speed_scale * raw[1]
    corrected[c - 1] = turn_scale * raw[c - 1] + turn_offset
    increment_jacobian(setup, corrected, dt, jac)
    bias_jacobian(setup, raw, c, by_bias)
    cosine, sine = heading
    matrix[:, :] = 0.0
    _write_turn(heading, step0, matrix)
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


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
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
