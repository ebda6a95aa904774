"""Problems that several test files solve: random beliefs, motions with controls, small worlds,
a linear sensor."""

from __future__ import annotations

import copy

import numpy as np

from kalmap.gaussian import Belief, CentralDifference, Cubature, Jacobian, Unscented
from kalmap.kernels import packed as packed_kernel
from kalmap.models import Ackermann, Bias, Increments, RangeBearing, Unicycle, VelocitySteering
from kalmap.records import Log, Odometry, RunConfig, Sightings

LINEARISERS = {
    "jacobian": Jacobian(),
    "unscented": Unscented(),
    "unscented-scaled": Unscented(alpha=0.8, beta=2.0, kappa=1.0),
    "central": CentralDifference(),
    "central-2": CentralDifference(h=2.0),
    "cubature": Cubature(),
}

STEERING_BIASES = (
    Bias("steering_offset", 0.02),
    Bias("speed_scale", 0.05),
    Bias("steering_scale", 0.04),
    Bias("course_offset", 0.03),
)
TURN_BIASES = (Bias("turn_rate_offset", 0.02), Bias("speed_scale", 0.05), Bias("turn_rate_scale", 0.04))

MOUNTED = RangeBearing(mount=(1.2, -0.4, 0.3), sigma_range=0.15, ratio_range=0.01, sigma_bearing=0.02)


def motions(biases: int) -> dict[str, object]:
    """The four motion models with the first `biases` of their constant errors estimated."""
    return {
        "velocity-steering": VelocitySteering(
            biases=STEERING_BIASES[:biases], ratio_speed=0.05, sample_time=0.05
        ),
        "ackermann": Ackermann(biases=STEERING_BIASES[:biases], encoder_offset=0.76, sigma_steering=0.04),
        "unicycle": Unicycle(biases=TURN_BIASES[:biases], sigma_turn_rate=0.1, ratio_turn_rate=0.05),
        "increments": Increments(biases=TURN_BIASES[:biases], sigma_rotation=0.02),
    }


def controls(rng: np.random.Generator, motion: object, count: int) -> tuple[np.ndarray, np.ndarray]:
    """`count` random samples (count, c) that suit the model, and their durations."""
    durations = rng.uniform(0.02, 0.2, count)
    if motion.control_size == 3:
        return rng.normal([0.4, 0.02, 0.03], [0.1, 0.05, 0.05], (count, 3)), durations
    return rng.normal([3.0, 0.1], [0.5, 0.2], (count, 2)), durations


def random_covariance(
    rng: np.random.Generator, n: int, scale: float = 1.0, rank: int | None = None
) -> np.ndarray:
    """A dense random covariance (n, n) of the given rank; eigenvalues of the order of scale^2."""
    factor = rng.standard_normal((n, n if rank is None else rank)) * scale / np.sqrt(n)
    return factor @ factor.T


def belief_of(mean: np.ndarray, covariance: np.ndarray, robot: int) -> Belief:
    """A belief with this joint mean and covariance, the first `robot` entries the robot's."""
    n = len(mean)
    belief = Belief(mean[:robot], covariance[:robot, :robot])
    belief.reserve(n)
    belief.mean[:n] = mean
    packed_kernel.pack(np.ascontiguousarray(covariance), n, belief.packed)
    belief.n = n
    return belief


def random_belief(
    rng: np.random.Generator, biases: int = 0, landmarks: int = 5, scale: float = 0.3
) -> Belief:
    """A belief with a dense random prior, landmarks 4 to 25 m around a robot somewhere in the plane."""
    robot, n = 3 + biases, 3 + biases + 2 * landmarks
    mean = np.zeros(n)
    mean[:3] = [*rng.uniform(-20, 20, 2), rng.uniform(-np.pi, np.pi)]
    mean[3:robot] = rng.normal(0, 0.02, biases)
    radius, angle = rng.uniform(4, 25, landmarks), rng.uniform(-np.pi, np.pi, landmarks)
    mean[robot:] = (mean[:2] + np.c_[radius * np.cos(angle), radius * np.sin(angle)]).ravel()
    widths = np.full(n, scale)
    widths[2], widths[3:robot] = 0.3 * scale, 0.05 * scale
    covariance = random_covariance(rng, n) + 0.05 * np.eye(n)
    return belief_of(mean, covariance * np.outer(widths, widths), robot)


def copy_belief(belief: Belief) -> Belief:
    """The same belief in buffers of its own."""
    twin = belief_of(belief.mean[: belief.n].copy(), np.zeros((belief.n, belief.n)), belief.robot)
    twin.packed[: belief.n * (belief.n + 1) // 2] = belief.packed[: belief.n * (belief.n + 1) // 2]
    twin.phi[:], twin.pending = belief.phi, belief.pending
    return twin


class XYSensor:
    """A user-defined sensor: values are the landmark's (forward, left) m,
    linear where the heading is known."""

    compiled = False

    def __init__(self, noise: np.ndarray) -> None:
        self.noise = noise

    def predict(self, pose: np.ndarray, landmark: np.ndarray) -> np.ndarray:
        c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
        dx, dy = landmark[..., 0] - pose[..., 0], landmark[..., 1] - pose[..., 1]
        return np.stack([c * dx + s * dy, c * dy - s * dx], axis=-1)

    def locate(self, pose: np.ndarray, z: np.ndarray) -> np.ndarray:
        c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
        x, y = z[..., 0], z[..., 1]
        return np.stack([pose[..., 0] + c * x - s * y, pose[..., 1] + s * x + c * y], axis=-1)

    def covariance(self, z: np.ndarray) -> np.ndarray:
        return np.repeat(self.noise[None], len(z), axis=0)


def circle_events(seed: int, frames: int = 40, landmarks: int = 12, samples: int = 4) -> list:
    """A noisy drive on a circle among landmarks: odometry blocks (speed, steering) and frames, alternating.

    Velocity-steering with wheelbase 4 m, sensor at the vehicle's origin, range 30 m and half plane ahead.
    """
    rng = np.random.default_rng(seed)
    angles = np.linspace(0, 2 * np.pi, landmarks, endpoint=False)
    world = np.c_[18 * np.cos(angles), 14 + 18 * np.sin(angles)] + rng.normal(0, 2, (landmarks, 2))
    pose, dt, events = np.zeros(3), 0.1, []
    for k in range(frames):
        exact = np.tile([3.0, 0.3], (samples, 1))
        for v, g in exact:
            pose = pose + dt * v * np.array([np.cos(g + pose[2]), np.sin(g + pose[2]), np.sin(g) / 4.0])
        time = (k + 1) * samples * dt
        noisy = exact + rng.normal(0, [0.3, np.radians(3)], exact.shape)
        events.append(Odometry(time, noisy, np.full(samples, dt), record=k * samples + 1))
        d = world - pose[:2]
        z = np.c_[np.hypot(*d.T), (np.arctan2(d[:, 1], d[:, 0]) - pose[2] + np.pi) % (2 * np.pi) - np.pi]
        seen = np.flatnonzero((z[:, 0] < 30) & (np.abs(z[:, 1]) < np.pi / 2))
        values = z[seen] + rng.normal(0, [0.1, np.radians(1)], (len(seen), 2))
        values[:, 1] = (values[:, 1] + np.pi) % (2 * np.pi) - np.pi
        events.append(
            Sightings(
                time, np.abs(values) * np.c_[np.ones(len(seen)), np.sign(values[:, 1])], seen, record=k + 1
            )
        )
    return events


def feed(slam: object, events: list) -> object:
    """Step the filter through the events and hand it back."""
    for event in events:
        slam.step(event)
    return slam


def log_of(events: list, **changes: object) -> Log:
    """A log of events that are at hand."""
    return Log(name="test", source="memory", defaults=RunConfig(), open=lambda skip: iter(events), **changes)


def state_of(slam: object) -> tuple:
    """Everything that a refused event must leave alone, as comparable values."""
    belief = slam._belief
    return (
        slam.time,
        slam.step_number,
        belief.n,
        belief.covariance().tobytes(),
        belief.mean[: belief.n].tobytes(),
        (list(slam._ids), list(slam._counts), sorted(slam._on_trial)),
        copy.deepcopy(slam._memory),
        (dict(slam.merged), sorted(slam.rejected), slam._frames),
    )
