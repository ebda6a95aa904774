"""Settings: frozen, typed, in SI units; angles in degrees only where the name ends in `_deg`.

Unknown keys are refused when a configuration is decoded (`forbid_unknown_fields`). The resolved
configuration is saved beside every result, so that a run can be repeated from its manifest.
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

Positive = Annotated[float, msgspec.Meta(gt=0)]
NonNegative = Annotated[float, msgspec.Meta(ge=0)]
Probability = Annotated[float, msgspec.Meta(gt=0, lt=1)]

MotionName = Literal["velocity-steering", "ackermann", "unicycle", "increments"]
BiasName = Literal["steering_offset", "steering_scale", "speed_scale", "turn_rate_offset", "turn_rate_scale"]
FilterName = Literal["ekf", "ukf", "cdkf", "ckf", "cr-ukf", "cr-cdkf", "cr-ckf"]
Scope = Literal["full", "reduced"]
Coordinates = Literal["additive", "invariant"]
Use = Literal["joint", "sequential"]
AssociationName = Literal["known", "likelihood"]


class MotionConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How the vehicle moves and how noisy its odometry is.

    model: "velocity-steering" (Bailey: front-wheel point), "ackermann" (rear-axle pose, encoder on
        one rear wheel), "unicycle" (speed, turn rate) or "increments" (dx, dy, dtheta).
    wheelbase: m. encoder_offset: m, rear-axle centre to the encoder's wheel, positive to the left.
    sigma_speed, sigma_speed_ratio: m/s and share of the speed; the variances add.
    sigma_steering_deg, sigma_turn_rate_deg: deg and deg/s; sigma_turn_rate_ratio: share of the turn rate.
    sigma_distance_ratio, sigma_rotation_deg, sigma_rotation_ratio: for increments whose log gives no
        covariance: share of the distance; deg a step; share of the turn.
    sample_time: s. The sigmas hold for samples of this length and a sample of length dt gets the
        variance times sample_time / dt (white noise in time). 0: they hold for every sample as it is.
    exact_standstill: a sample that reads exactly no motion is believed and adds no noise.
    biases: which constant errors are estimated as states. prior_*: their standard deviations before the run;
        mean_*: what a vehicle of this class is known to have, usually 0. Scales are shares: -0.1 makes the
        reading a tenth shorter.
    """

    model: MotionName = "velocity-steering"
    wheelbase: Positive = 4.0
    encoder_offset: float = 0.0
    sigma_speed: NonNegative = 0.3
    sigma_speed_ratio: NonNegative = 0.0
    sigma_steering_deg: NonNegative = 3.0
    sigma_turn_rate_deg: NonNegative = 3.0
    sigma_turn_rate_ratio: NonNegative = 0.0
    sigma_distance_ratio: NonNegative = 0.1
    sigma_rotation_deg: NonNegative = 0.5
    sigma_rotation_ratio: NonNegative = 0.1
    sample_time: NonNegative = 0.0
    exact_standstill: bool = False
    biases: tuple[BiasName, ...] = ()
    prior_steering_offset_deg: Positive = 1.0
    prior_steering_scale: Positive = 0.05
    prior_speed_scale: Positive = 0.05
    prior_turn_rate_offset_deg: Positive = 1.0
    prior_turn_rate_scale: Positive = 0.1
    mean_steering_offset_deg: float = 0.0
    mean_steering_scale: float = 0.0
    mean_speed_scale: float = 0.0
    mean_turn_rate_offset_deg: float = 0.0
    mean_turn_rate_scale: float = 0.0


class SensorConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Where the range-bearing sensor sits, how far and wide it sees, and how noisy it is.

    mount_x, mount_y: m, mount_heading_deg: the sensor in the vehicle's frame (forward, left).
    sigma_range: m; sigma_range_ratio: share of the range; the variances add. sigma_bearing_deg: deg.
    max_range: m. field_of_view_deg: the full angle, centred ahead of the sensor.
    outlier_gate: probability; a sighting whose innovation lies outside it has its noise inflated until it lies on
        it, so that a gross error does little. None: every sighting is taken at its word.
    """

    mount_x: float = 0.0
    mount_y: float = 0.0
    mount_heading_deg: float = 0.0
    sigma_range: Positive = 0.1
    sigma_range_ratio: NonNegative = 0.0
    sigma_bearing_deg: Positive = 1.0
    max_range: Positive = 30.0
    field_of_view_deg: Annotated[float, msgspec.Meta(gt=0, le=360)] = 180.0
    outlier_gate: Probability | None = None


class FilterConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Which filter: its short name fixes the lineariser and, unless given, the scope.

    scope: None takes what the name says ("cr-" means reduced; "ekf" is reduced; the others full).
    use: a frame's sightings in one joint update, or one after the other.
    """

    name: FilterName = "cr-cdkf"
    scope: Scope | None = None
    coordinates: Coordinates = "invariant"
    use: Use = "joint"


class AssociationConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How sightings find their landmarks.

    method: "known" takes the log's ids; "likelihood" gates by Mahalanobis distance and takes the
        one-to-one assignment of least normalised distance.
    gate: probability inside which a pair is possible.
    new_gate: probability beyond which, from every landmark, a sighting founds a new one; between
        the two it is left unused.
    confirm: sightings that a new landmark needs within `confirm_window` frames that could see it, or
        it is removed again as spurious. 1 keeps all.
    """

    method: AssociationName = "known"
    gate: Probability = 0.999
    new_gate: Probability = 0.999999
    confirm: Annotated[int, msgspec.Meta(ge=1)] = 1
    confirm_window: Annotated[int, msgspec.Meta(ge=1)] = 30


class RunConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Everything that a run depends on, beside the log itself."""

    motion: MotionConfig = MotionConfig()
    sensor: SensorConfig = SensorConfig()
    filter: FilterConfig = FilterConfig()
    association: AssociationConfig = AssociationConfig()
    seed: Annotated[int, msgspec.Meta(ge=0)] = 1
    tolerant: bool = False
