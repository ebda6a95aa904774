"""Finite-set filters in plain numpy, slow and by the book: what several test files check the kernels against."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.stats import multivariate_normal, norm

from kalmap.kernels import layout
from kalmap.kernels import set_layout as sets

NO_BEAMS = np.zeros((0, 2))
NO_NOISE = np.array([-1.0, -1.0, -1.0, 0.0])
CENTRED = (0.0, 0.0, 0.0)
MOUNTED = (1.2, -0.4, 0.3)

RULES = {
    "jacobian": (layout.JACOBIAN, 0.0),
    "central": (layout.CENTRAL_DIFFERENCE, 3**0.5),
    "central-2": (layout.CENTRAL_DIFFERENCE, 2.0),
    "cubature": (layout.CUBATURE, 0.0),
}


def wrap(angle):
    return (np.asarray(angle) + np.pi) % (2.0 * np.pi) - np.pi


def setup_of(rule: str = "jacobian", mount=CENTRED, sigma_range=0.1, ratio_range=0.0, sigma_bearing=0.02):
    """The numbers that the sensor's kernels read."""
    setup = np.zeros(layout.SETUP_LENGTH)
    setup[layout.RULE], setup[layout.RULE_A] = RULES[rule]
    setup[layout.MOUNT_X : layout.MOUNT_HEADING + 1] = mount
    setup[layout.SIGMA_RANGE], setup[layout.RATIO_RANGE] = sigma_range, ratio_range
    setup[layout.SIGMA_BEARING] = sigma_bearing
    return setup


def rules_of(**changed: float) -> np.ndarray:
    """Rules of a filter that sees all around as far as 50 m and drops or merges nothing, unless told otherwise."""
    values = {
        "CLUTTER": 1e-3,
        "CLUTTER_RATE": 0.3,
        "GATE": 1e3,
        "BIRTH": 0.1,
        "PRUNE": 0.0,
        "MERGE": 0.0,
        "CAP": 10_000,
        "FEATURE": 0.5,
        "WEIGHTING": sets.SINGLE_CLUSTER,
        "MAX_RANGE": 50.0,
        "HALF_VIEW": np.pi,
        "MIN_RANGE": 0.0,
        "RINGS": 1,
        "DEPTH": 1.0,
        "BRANCHES": 1,
    }
    rules = np.zeros(sets.RULES)
    for name, value in (values | changed).items():
        rules[getattr(sets, name)] = value
    return rules


def component(weight: float, mean, cov, number: float = 0.0, seen: float = 1.0) -> np.ndarray:
    """One row of a map."""
    root = np.linalg.cholesky(np.asarray(cov, dtype=float))
    return np.array([weight, *mean, root[0, 0], root[1, 0], root[1, 1], number, seen])


def covariance(row: np.ndarray) -> np.ndarray:
    """(2, 2) of a map's row."""
    root = np.array([[row[sets.L11], 0.0], [row[sets.L21], row[sets.L22]]])
    return root @ root.T


def random_spread(rng: np.random.Generator, n: int, scale: float) -> np.ndarray:
    """A random covariance (n, n) with standard deviations of the order of `scale`."""
    factor = rng.standard_normal((n, n)) * scale / np.sqrt(n) + 0.2 * scale * np.eye(n)
    return factor @ factor.T


def random_row(
    rng: np.random.Generator, pose, near: float, far: float, scale: float, weight=None
) -> np.ndarray:
    """A component around the pose, near to far metres away in any direction."""
    distance, angle = rng.uniform(near, far), rng.uniform(-np.pi, np.pi)
    mean = pose[:2] + distance * np.array([np.cos(angle), np.sin(angle)])
    weight = rng.uniform(0.1, 0.95) if weight is None else weight
    return component(weight, mean, random_spread(rng, 2, scale), rng.integers(1000))


# --- the sensor -------------------------------------------------------------------------------------------------


def sight(mount, pose, place) -> np.ndarray:
    """(range, bearing) by complex numbers."""
    from_vehicle = complex(place[0] - pose[0], place[1] - pose[1]) * np.exp(-1j * pose[2])
    from_sensor = (from_vehicle - complex(mount[0], mount[1])) * np.exp(-1j * mount[2])
    return np.array([abs(from_sensor), np.angle(from_sensor)])


def locate(mount, pose, z) -> np.ndarray:
    """(2,) where a sighting lies."""
    turn = pose[2]
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    angle = z[1] + mount[2]
    return pose[:2] + rotation @ (mount[:2] + z[0] * np.array([np.cos(angle), np.sin(angle)]))


def slopes(f, x, angles=False, step=1e-3) -> np.ndarray:
    """Jacobian by differences of fourth order; angles: the second output is one."""

    def change(d):
        difference = f(x + d) - f(x - d)
        if angles:
            difference[1] = wrap(difference[1])
        return difference

    return np.array([(8.0 * change(d) - change(2.0 * d)) / (12.0 * step) for d in step * np.eye(len(x))]).T


def noise_of(setup, noise, distance) -> np.ndarray:
    """(2, 2) of a sighting at that distance."""
    if noise[0] >= 0.0:
        root = np.array([[noise[0], 0.0], [noise[1], noise[2]]])
        return root @ root.T
    sigma = np.array(
        [
            setup[layout.SIGMA_RANGE] ** 2 + (setup[layout.RATIO_RANGE] * distance) ** 2,
            setup[layout.SIGMA_BEARING] ** 2,
        ]
    )
    if noise[3] > 0.0:
        sigma = sigma + np.array([noise[3] ** 2, (noise[3] / max(distance, noise[3])) ** 2])
    return np.diag(sigma)


@dataclass
class Look:
    """How a component should look: predicted (2,), innovation covariance, gain and covariance after, all (2, 2)."""

    predicted: np.ndarray
    innovation: np.ndarray
    gain: np.ndarray
    after: np.ndarray
    detection: float = 1.0

    def density(self, z) -> float:
        off = np.array([z[0] - self.predicted[0], wrap(z[1] - self.predicted[1])])
        squared = off @ np.linalg.solve(self.innovation, off)
        return float(np.exp(-0.5 * squared) / (2.0 * np.pi * np.sqrt(np.linalg.det(self.innovation))))

    def moved(self, row, z) -> np.ndarray:
        off = np.array([z[0] - self.predicted[0], wrap(z[1] - self.predicted[1])])
        return row[[sets.X, sets.Y]] + self.gain @ off


def look_by_jacobian(setup, mount, pose, spread, row, noise=NO_NOISE) -> Look:
    """The extended Kalman filter over (pose, feature), the pose not corrected, with Joseph's form."""
    joint = np.zeros((5, 5))
    joint[:3, :3], joint[3:, 3:] = spread, covariance(row)
    point = np.array([*pose, row[sets.X], row[sets.Y]])
    predicted = sight(mount, pose, point[3:])
    matrix = slopes(lambda v: sight(mount, v[:3], v[3:]), point, angles=True)
    noises = noise_of(setup, noise, predicted[0])
    innovation = matrix @ joint @ matrix.T + noises
    gain = joint[3:] @ matrix.T @ np.linalg.inv(innovation)
    whole = np.vstack([np.zeros((3, 2)), gain])
    rest = np.eye(5) - whole @ matrix
    after = (rest @ joint @ rest.T + whole @ noises @ whole.T)[3:, 3:]
    return Look(predicted, innovation, gain, after)


def look_by_points(setup, mount, pose, spread, row, rule, noise=NO_NOISE) -> Look:
    """Cubature (Arasaratnam & Haykin) or central differences (Norgaard et al.) with their textbook weights."""
    n = 5
    root = np.zeros((5, 5))
    root[:3, :3], root[3:, 3:] = spread, [[row[sets.L11], 0.0], [row[sets.L21], row[sets.L22]]]
    point = np.array([*pose, row[sets.X], row[sets.Y]])
    step = np.sqrt(n) if rule == "cubature" else RULES[rule][1]
    points = np.vstack([point, point + step * root.T, point - step * root.T])
    centre = sight(mount, pose, point[3:])
    values = np.array([sight(mount, p[:3], p[3:]) for p in points])
    values[:, 1] = centre[1] + wrap(values[:, 1] - centre[1])
    plus, minus = values[1 : n + 1], values[n + 1 :]
    deviations = points[1:, 3:] - point[3:]
    if rule == "cubature":
        mean = values[1:].mean(axis=0)
        errors = values[1:] - mean
        second, cross = errors.T @ errors / (2 * n), deviations.T @ errors / (2 * n)
    else:
        h2 = step**2
        mean = (h2 - n) / h2 * centre + (plus + minus).sum(axis=0) / (2.0 * h2)
        odd, even = plus - minus, plus + minus - 2.0 * centre
        second = odd.T @ odd / (4.0 * h2) + (h2 - 1.0) / (4.0 * h2**2) * even.T @ even
        cross = root[3:] @ odd / (2.0 * step)
    innovation = second + noise_of(setup, noise, mean[0])
    gain = cross @ np.linalg.inv(innovation)
    mean[1] = wrap(mean[1])
    return Look(mean, innovation, gain, covariance(row) - gain @ innovation @ gain.T)


def detection(rules, profile, look: Look) -> float:
    """Ring by ring and soft at the edges of the view, without occlusion."""
    rings = int(rules[sets.RINGS])
    middles = (np.arange(rings) + 0.5) * rules[sets.MAX_RANGE] / rings
    share = np.interp(look.predicted[0], middles, profile)
    sigma = np.sqrt(np.diag(look.innovation))
    share *= norm.cdf((rules[sets.MAX_RANGE] - look.predicted[0]) / sigma[0])
    if rules[sets.MIN_RANGE] > 0.0:
        share *= norm.cdf((look.predicted[0] - rules[sets.MIN_RANGE]) / sigma[0])
    if rules[sets.HALF_VIEW] < np.pi:
        share *= norm.cdf((rules[sets.HALF_VIEW] - abs(look.predicted[1])) / sigma[1])
    return float(share)


def look_of(rule, setup, mount, pose, root, row, noise=NO_NOISE) -> Look:
    """By whichever rule; root (3, 3) of the pose's covariance."""
    if rule == "jacobian":
        return look_by_jacobian(setup, mount, pose, root @ root.T, row, noise)
    return look_by_points(setup, mount, pose, root, row, rule, noise)


# --- associations -----------------------------------------------------------------------------------------------


def matchings(possible: np.ndarray, taken: tuple[int, ...] = ()):
    """Every way of giving each sighting a feature of its own or none: tuples of feature or -1 per sighting.

    possible (M, F): which pairs there are.
    """
    if len(taken) == len(possible):
        yield taken
        return
    yield from matchings(possible, (*taken, -1))
    for j in np.flatnonzero(possible[len(taken)]).tolist():
        if j not in taken:
            yield from matchings(possible, (*taken, j))


def sum_over_matchings(odds: np.ndarray) -> float:
    """Sum over all matchings of the product of the odds of their pairs."""
    return sum(
        np.prod([odds[i, j] for i, j in enumerate(choice) if j >= 0]) for choice in matchings(odds > 0.0)
    )


def pairs_over_matchings(odds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Probability of every pair (M, F) and of every feature to stay alone (F,)."""
    pairs = np.zeros(odds.shape)
    for choice in matchings(odds > 0.0):
        chosen = [(i, j) for i, j in enumerate(choice) if j >= 0]
        weight = np.prod([odds[i, j] for i, j in chosen])
        for i, j in chosen:
            pairs[i, j] += weight
    pairs /= sum_over_matchings(odds)
    return pairs, 1.0 - pairs.sum(axis=0)


def set_likelihood(clutter, rate, detections, densities) -> float:
    """g(Z | M): densities (M, F) of sighting i from feature j, each hypothesis written out."""
    total = 0.0
    for choice in matchings(densities > 0.0):
        value = np.exp(-rate)
        for i, j in enumerate(choice):
            value *= clutter if j < 0 else detections[j] * densities[i, j]
        for j, seen in enumerate(detections):
            value *= 1.0 if j in choice else 1.0 - seen
        total += value
    return total


# --- a frame ----------------------------------------------------------------------------------------------------


@dataclass
class Scene:
    """Everything that an update of a map takes. rows (C, COLUMNS), z (M, 2), root (3, 3) of the pose's covariance."""

    rows: np.ndarray
    z: np.ndarray
    rules: np.ndarray
    rule: str = "jacobian"
    mount: tuple[float, float, float] = MOUNTED
    pose: np.ndarray = field(default_factory=lambda: np.array([2.0, -1.0, 0.7]))
    root: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    profile: np.ndarray = field(default_factory=lambda: np.array([0.9]))
    noise: np.ndarray = field(default_factory=NO_NOISE.copy)
    beams: np.ndarray = field(default_factory=NO_BEAMS.copy)
    room: int = 500

    @property
    def setup(self) -> np.ndarray:
        return setup_of(self.rule, self.mount)

    def looks(self) -> list[Look]:
        """How each component looks, with its probability of detection."""
        looks = []
        for row in self.rows:
            look = look_of(self.rule, self.setup, self.mount, self.pose, self.root, row, self.noise)
            look.detection = detection(self.rules, self.profile, look)
            looks.append(look)
        return looks

    def densities(self, looks) -> np.ndarray:
        """(M, C)."""
        return np.array([[look.density(z) for look in looks] for z in self.z]).reshape(
            len(self.z), len(looks)
        )

    def within_gate(self, looks) -> np.ndarray:
        """(M, C): whether a sighting is near enough to a component to be its."""
        near = np.zeros((len(self.z), len(looks)), bool)
        for j, look in enumerate(looks):
            off = self.z - look.predicted
            off[:, 1] = wrap(off[:, 1])
            squared = np.einsum("mi,ij,mj->m", off, np.linalg.inv(look.innovation), off)
            near[:, j] = squared <= self.rules[sets.GATE]
        return near

    def update(self, kernel, number: int = 7) -> Outcome:
        """What a kernel makes of it."""
        block = np.full((self.room, sets.COLUMNS), np.nan)
        block[: len(self.rows)] = self.rows
        explained, tally = np.full(len(self.z), np.nan), np.zeros((2, int(self.rules[sets.RINGS])))
        count, log_weight = kernel(
            self.setup,
            self.rules,
            self.profile,
            self.beams,
            self.pose,
            self.root,
            self.noise,
            block,
            len(self.rows),
            self.z,
            number,
            explained,
            tally,
        )
        return Outcome(block[:count].copy(), log_weight, explained, tally)


@dataclass
class Outcome:
    rows: np.ndarray
    log_weight: float
    explained: np.ndarray
    tally: np.ndarray


def random_scene(
    rng, components: int, sightings: int, rules, scale=0.2, weight=None, near=None, **other
) -> Scene:
    """Components around the pose, sightings of the first of them and anywhere; near: all within so many metres."""
    scene = Scene(np.zeros((0, sets.COLUMNS)), np.zeros((0, 2)), rules, **other)
    rows = [random_row(rng, scene.pose, 5.0, 30.0, scale, weight) for _ in range(components)]
    if near is not None:
        for row in rows[1:]:
            row[[sets.X, sets.Y]] = rows[0][[sets.X, sets.Y]] + rng.uniform(-near, near, 2)
    scene.rows = np.array(rows).reshape(components, sets.COLUMNS)
    z = []
    for i in range(sightings):
        if components:
            row = rows[i % components]
            place = row[[sets.X, sets.Y]] + np.linalg.cholesky(covariance(row)) @ rng.standard_normal(2)
            z.append(sight(scene.mount, scene.pose, place) + rng.standard_normal(2) * [0.1, 0.02])
        else:
            z.append([rng.uniform(2.0, 40.0), rng.uniform(-np.pi, np.pi)])
    scene.z = np.array(z).reshape(sightings, 2)
    scene.z[:, 1] = wrap(scene.z[:, 1])
    return scene


def behind(scene: Scene) -> Scene:
    """The same scene with everything right behind the sensor, a landmark on this and its sighting on that side of
    where the bearing wraps."""
    sides = np.array([1.0, -1.0])
    for j, row in enumerate(scene.rows):
        row[[sets.X, sets.Y]] = locate(
            scene.mount, scene.pose, [12.0 + 0.3 * j, np.pi - 0.004 * sides[j % 2]]
        )
    for i in range(len(scene.z)):
        scene.z[i] = 12.05 + 0.3 * i, sides[i % 2] * (0.006 - np.pi)
    return scene


def heaviest_first(rows, least: float = 1e-12) -> np.ndarray:
    rows = rows[rows[:, sets.WEIGHT] >= least]
    return rows[np.argsort(-rows[:, sets.WEIGHT], kind="stable")]


def density_of(rows, place) -> float:
    """A mixture's value at a place."""
    return sum(
        row[sets.WEIGHT] * multivariate_normal.pdf(place, row[[sets.X, sets.Y]], covariance(row))
        for row in rows
    )
