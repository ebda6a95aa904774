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
BiasName = Literal[
    "steering_offset", "steering_scale", "speed_scale", "turn_rate_offset", "turn_rate_scale", "course_offset"
]
FilterName = Literal["ekf", "ukf", "cdkf", "ckf", "cr-ukf", "cr-cdkf", "cr-ckf"]
Scope = Literal["full", "reduced"]
Coordinates = Literal["additive", "invariant"]
Use = Literal["joint", "sequential"]
AssociationName = Literal["known", "nearest", "likelihood", "jcbb", "mda", "djnn", "pmb"]
DetectorName = Literal["reflectors", "trees"]
ManagementName = Literal["keep", "trial", "counter", "existence"]
Share = Annotated[float, msgspec.Meta(ge=0, le=1)]
SetMethod = Literal["rb-phd", "srckf-phd", "mh-fastslam", "pmb", "pmbm"]
Proposal = Literal["motion", "sightings"]
Weighting = Literal["empty", "single-feature", "single-cluster", "multi-feature"]


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
    biases: which constant errors are estimated as states; "course_offset" is the angle between the way that the
        vehicle goes and the sensor's straight ahead, which a sensor mounted askew has. prior_*: their standard
        deviations before the run; mean_*: what a vehicle of this class is known to have, usually 0. Scales are
        shares: -0.1 makes the reading a tenth shorter.
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
    prior_course_offset_deg: Positive = 1.0
    mean_steering_offset_deg: float = 0.0
    mean_steering_scale: float = 0.0
    mean_speed_scale: float = 0.0
    mean_turn_rate_offset_deg: float = 0.0
    mean_turn_rate_scale: float = 0.0
    mean_course_offset_deg: float = 0.0


class SensorConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Where the range-bearing sensor sits, how far and wide it sees, and how noisy it is.

    mount_x, mount_y: m, mount_heading_deg: the sensor in the vehicle's frame (forward, left).
    sigma_range: m; sigma_range_ratio: share of the range; the variances add. sigma_bearing_deg: deg.
    min_range, max_range: m, what is nearer or farther is not seen. field_of_view_deg: the full angle, centred ahead
    of the sensor.
    beam_time: s from one beam of a scan to the next, in the order of the scan; 0: the sweep takes no time.
    outlier_gate: probability; a sighting whose innovation lies outside it has its noise inflated until it lies
        on it, so that a gross error does little. None: every sighting is taken at its word.
    """

    mount_x: float = 0.0
    mount_y: float = 0.0
    mount_heading_deg: float = 0.0
    sigma_range: Positive = 0.1
    sigma_range_ratio: NonNegative = 0.0
    sigma_bearing_deg: Positive = 1.0
    min_range: NonNegative = 0.0
    max_range: Positive = 30.0
    field_of_view_deg: Annotated[float, msgspec.Meta(gt=0, le=360)] = 180.0
    beam_time: float = 0.0
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


class AttributeConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A further measurement that tells landmarks apart (trunk diameter, reflectivity, colour, class).

    name: of the sightings' attribute. sigma, ratio: standard deviation of one measurement, absolute and as a
    share of the value. classes: the values are labels, and a sighting shows its landmark's with probability
    `sure`.
    """

    name: str
    sigma: NonNegative = 0.1
    ratio: NonNegative = 0.0
    classes: bool = False
    sure: Probability = 0.95


class AssociationConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How sightings find their landmarks.

    method: "known" takes the log's ids; the others go by place: "nearest" (each sighting for itself),
        "likelihood" (best one-to-one), "jcbb" (largest jointly compatible set), "mda" (assignment over several
        frames), "djnn" (nearest neighbour with the frame's common offset, tentative landmarks and a local
        region).
    gate: probability inside which a pair is possible. new_gate: probability beyond which, from every landmark,
        a sighting founds a new one; between the two it is left unused. joint_gate: probability of the joint
        test (jcbb).
    extent: m, how far apart sightings of one landmark from different sides are, as a standard deviation, beside
        the sensor's noise: the size of what is no point. It widens the gates; mergers force no more than that.
    ambiguity: a match is taken only if the next best landmark's nu' S^-1 nu + ln det S is larger by this (4.6:
        ten times less likely), given the frame's other matches; 0: the best is taken.
    one_to_one: nearest only: no two sightings of a frame take the same landmark.
    management: "keep" believes every landmark; "trial" those with `confirm` sightings in `confirm_window`
        frames that could see them; "counter" counts sightings up and misses down, believes from `confirm` on
        and removes at 0, also from the map; "existence" keeps a probability for each, and believes from
        `existence` on. None: what the method has by itself (djnn: counter; the others: existence).
    confirm: sightings (trial) or counter (counter) from which a landmark is believed; 1 believes at once.
    merge: landmarks that turn out to be the same become one.
    local: only landmarks near what the sensor sees take part. reliable_range: m, up to which a landmark that is
        there is seen as a rule; None takes the sensor's range.
    interference, widen: djnn only: cases 1 to 3, and the factor on the gate of case 4 (0: never).
    window: mda only: frames decided together. detection: probability that a landmark in view is seen (mda;
        "existence" and "counter" start from it and learn it as they go). false_rate: expected false sightings a
        frame, new_rate: new landmarks a frame (mda only).
    work: jcbb only: most nodes of a search.
    attributes: used as an extra likelihood; by jcbb to say which pairs are possible, not in its joint distance.
    """

    method: AssociationName = "known"
    gate: Share = 0.999
    new_gate: Share = 0.999999
    joint_gate: Share = 0.999
    extent: NonNegative = 0.0
    ambiguity: NonNegative = 0.0
    one_to_one: bool = False
    management: ManagementName | None = None
    confirm: Annotated[int, msgspec.Meta(ge=1)] = 2
    confirm_window: Annotated[int, msgspec.Meta(ge=1)] = 30
    existence: Probability = 0.97
    merge: bool = True
    local: bool = True
    reliable_range: Positive | None = None
    interference: bool = True
    widen: NonNegative = 3.0
    window: Annotated[int, msgspec.Meta(ge=2, le=5)] = 2
    detection: Probability = 0.9
    false_rate: Positive = 0.5
    new_rate: Positive = 0.2
    work: Annotated[int, msgspec.Meta(ge=1)] = 20_000
    attributes: tuple[AttributeConfig, ...] = ()


class PerceptionConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How landmarks are found in laser scans, where a log has scans.

    detector: "reflectors" (by intensity) or "trees" (round trunks by shape). max_range: m, beyond which nothing
    is looked for. clearance: m, trees only: how far around a trunk nothing else may stand. None: the detector's
    own.
    """

    detector: DetectorName = "reflectors"
    max_range: Positive | None = None
    clearance: NonNegative | None = None


class FiniteSetConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """SLAM by random finite sets: particles, each with a map that needs no association. It takes no ids of a log.

    method: None leaves the run to `filter` and `association`. "rb-phd": probability hypothesis density, EKF components
        (Mullane, Vo & Adams 2011). "srckf-phd": the same by square-root cubature filters (Yan et al. 2015).
        "mh-fastslam": landmarks by most likely association, `branches` hypotheses a particle. "pmb": Poisson
        multi-Bernoulli, landmarks with identity and probability of existence. "pmbm": the mixture of these in which
        up to `particles` explanations of the run have a joint Gaussian each, by `filter` and `association`.
    particles: how many. threads: None for one a processor; the answer does not depend on it.
    proposal: "sightings" draws a pose that the frame makes likely, "motion" from odometry alone (as published).
    weighting: what of the map weighs a particle ("rb-phd", "srckf-phd"); None: what the method has by itself.
    detection: probability that a landmark well in view is sighted; detection_far: the same at the sensor's greatest
        range, falling straight from `detection` at the sensor (None: it does not fall). clutter: expected false
        sightings a frame, uniform in range and bearing. new_rate: expected first sightings a frame. estimate: detection
        and clutter are where to start, the filter learns them as it goes, detection in rings of range.
    gate: probability inside which a pair counts. prune: weight below which a component is dropped. merge: squared
        Mahalanobis distance within which two are one. cap: most components of a particle's map.
    feature: weight or existence from which a component is a landmark of the result. forgive: "rb-phd" and "srckf-phd":
        misses in a row that do not take away a landmark which was sighted three times (0: as published).
    resample: share of the particles below which the effective sample size brings resampling.
    occlusion: m, how far behind a beam's end a landmark counts as hidden, where a log has scans.
    """

    method: SetMethod | None = None
    particles: Annotated[int, msgspec.Meta(ge=1, le=100_000)] = 10
    threads: Annotated[int, msgspec.Meta(ge=1)] | None = None
    proposal: Proposal = "sightings"
    weighting: Weighting | None = None
    detection: Share = 0.9
    detection_far: Share | None = None
    clutter: NonNegative = 1.0
    new_rate: Positive = 0.2
    estimate: bool = True
    gate: Probability = 0.99999
    prune: Probability = 1e-3
    merge: Positive = 4.0
    cap: Annotated[int, msgspec.Meta(ge=16, le=1_000_000)] = 20_000
    feature: Probability = 0.6
    forgive: Annotated[int, msgspec.Meta(ge=0, le=10)] = 1
    resample: Share = 0.5
    branches: Annotated[int, msgspec.Meta(ge=1, le=64)] = 4
    occlusion: Positive = 1.0


ContourMethod = Literal["slasem", "dc-slasem"]


class ContourConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Mapping from raw scans by sampled contours (Sun et al. 2010), for logs that hold scans.

    method: "slasem" keeps one map, "dc-slasem" closes local maps and joins them, loops included. None: the log's
        landmarks are mapped instead.
    update_distance, update_angle_deg: m and deg, how far the vehicle moves between two scans that are used.
    close_samples, close_distance: a local map is closed when it holds so many samples, or after so many metres.
    spacing: m between samples on a straight contour; it shrinks with curvature.
    sigma_offset, sigma_askew_deg: m and deg, by how much a whole piece of one scan is off beyond its points' noise: the
        scan is taken on the move, and surfaces reflect unevenly.
    sigma_bearing_scale, sigma_range_offset: share and m, how far the scanner's angles and ranges may be off as a whole,
        which the map estimates; 0: they are right.
    sigma_lever: m, on either axis, how far the point that the odometry speaks of may be from where the log has it.
    sigma_way_scale, sigma_turn_scale: share, by how much the wheels' ways and turns may be too long or too short as a
        whole, which the map estimates; of odometry of increments, other odometry is taken at its word.
    sigma_latency: s, how much later or earlier than it was taken a scan may be stamped; estimated as well. Odometry of
        increments only, with stamps that tell how fast the vehicle goes; readers of laser logs look whether they do.
    sigma_stamp: s, by how much each stamp is off by chance, beside that.
    clear_range: m, how far the way of a beam that brought nothing back counts as free, for samples that would stand in
        it and in the occupancy grid.
    background: closed maps are joined in a thread of low priority that the live filter does not wait for; the answer in
        the end is the same, only the pose on the way may come by a join later.
    """

    method: ContourMethod | None = None
    update_distance: Positive = 0.1
    update_angle_deg: Positive = 10.0
    close_samples: Annotated[int, msgspec.Meta(ge=20, le=5_000)] = 300
    close_distance: Positive = 10.0
    spacing: Positive = 0.3
    sigma_offset: NonNegative = 0.01
    sigma_askew_deg: NonNegative = 0.3
    sigma_bearing_scale: NonNegative = 0.003
    sigma_range_offset: NonNegative = 0.03
    sigma_lever: NonNegative = 0.1
    sigma_way_scale: Annotated[float, msgspec.Meta(ge=0, le=0.3)] = 0.01
    sigma_turn_scale: Annotated[float, msgspec.Meta(ge=0, le=0.3)] = 0.03
    sigma_latency: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.0
    sigma_stamp: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.0
    clear_range: NonNegative = 5.0
    background: bool = True


class DivideConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Divide and conquer (Paz, Tardos & Neira 2008): local maps of landmarks, closed when full, joined in a forest.

    on: else one filter holds the whole map. close_landmarks, close_distance: a local map is closed when it holds so
    many landmarks, or after so many metres. dense_limit: numbers in a joined state from which on joins keep sparse
    information instead of the full covariance. gate: probability that the joint distance of a right join stays
    inside; beyond it the join is refused and both maps stay side by side. None: what suits the association (known
    identities are taken at their word). background: joins run in a thread of low priority and the filter does not
    wait for them; the answer is the same.
    """

    on: bool = False
    close_landmarks: Annotated[int, msgspec.Meta(ge=3, le=5_000)] = 30
    close_distance: Positive = 50.0
    dense_limit: Annotated[int, msgspec.Meta(ge=0, le=20_000)] = 1500
    gate: Annotated[float, msgspec.Meta(gt=0, le=1)] | None = None
    background: bool = False


class RunConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Everything that a run depends on, beside the log itself."""

    motion: MotionConfig = MotionConfig()
    sensor: SensorConfig = SensorConfig()
    filter: FilterConfig = FilterConfig()
    association: AssociationConfig = AssociationConfig()
    perception: PerceptionConfig = PerceptionConfig()
    finite_set: FiniteSetConfig = FiniteSetConfig()
    contour: ContourConfig = ContourConfig()
    divide: DivideConfig = DivideConfig()
    seed: Annotated[int, msgspec.Meta(ge=0)] = 1
    tolerant: bool = False

    @property
    def by_ids(self) -> bool:
        """Whether the log's own identities say which sighting belongs to which landmark."""
        return self.finite_set.method is None and self.association.method == "known"

    @property
    def by_place(self) -> bool:
        """Whether the run itself says which landmark each sighting belongs to; most sets say nothing of the kind."""
        if self.finite_set.method is not None:
            return self.finite_set.method == "pmbm"
        return self.association.method != "known"
