"""What a control sample says: corrected for constant errors, as a body increment, with its noise.

All motion models are a pose composed with an increment Delta(u, b, dt), b the constant biases; they differ in
Delta alone, which stands here.
"""

import math

from kalmap.kernels.compiled import compiled
from kalmap.kernels.layout import (
    BIAS_CODE,
    BIAS_COUNT,
    BIAS_COURSE_OFFSET,
    BIAS_SPEED_SCALE,
    BIAS_STEERING_OFFSET,
    BIAS_STEERING_SCALE,
    BIAS_TURN_RATE_OFFSET,
    BIAS_TURN_RATE_SCALE,
    ENCODER_OFFSET,
    EXACT_STANDSTILL,
    MOTION,
    MOTION_ACKERMANN,
    MOTION_INCREMENTS,
    MOTION_VELOCITY_STEERING,
    RATIO_DISTANCE,
    RATIO_ROTATION,
    RATIO_SPEED,
    RATIO_TURN,
    SAMPLE_TIME,
    SIGMA_ROTATION,
    SIGMA_SPEED,
    SIGMA_TURN,
    WHEELBASE,
)
from kalmap.kernels.regression import left_jacobian


@compiled
def control_corrections(setup, biases, deviation):
    """(speed scale, turn scale, turn offset, course offset) that the errors biases + deviation[3:] amount to."""
    speed_scale, turn_scale, turn_offset, course = 1.0, 1.0, 0.0, 0.0
    for i in range(len(biases)):
        code = int(setup[BIAS_CODE + i])
        bias = biases[i] + deviation[3 + i]
        if code == BIAS_SPEED_SCALE:
            speed_scale += bias
        elif code == BIAS_STEERING_SCALE or code == BIAS_TURN_RATE_SCALE:
            turn_scale += bias
        elif code == BIAS_STEERING_OFFSET or code == BIAS_TURN_RATE_OFFSET:
            turn_offset += bias
        elif code == BIAS_COURSE_OFFSET:
            course += bias
    return speed_scale, turn_scale, turn_offset, course


@compiled
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


@compiled
def sample_increment(setup, control, noise, biases, deviation, dt):
    """Increment of a control deviated by `noise`, with biases deviated by `deviation`, corrected first.

    control, noise: triples (first, second, turn). Nothing is deviated where both hold zeros.
    """
    speed_scale, turn_scale, turn_offset, course = control_corrections(setup, biases, deviation)
    dx, dy, turn = increment(
        setup,
        speed_scale * (control[0] + noise[0]),
        speed_scale * (control[1] + noise[1]),
        turn_scale * (control[2] + noise[2]) + turn_offset,
        dt,
    )
    if course != 0.0:
        sine, cosine = math.sin(course), math.cos(course)
        dx, dy = cosine * dx - sine * dy, sine * dx + cosine * dy
    return dx, dy, turn


@compiled
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


@compiled
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
        elif code != BIAS_COURSE_OFFSET:  # which turns the increment, and not the control
            out[c - 1, i] = 1.0


@compiled
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
