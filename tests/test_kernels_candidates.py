"""What the map expects of a frame, against numpy on the flushed, dense belief of a filter with motion waiting."""

from __future__ import annotations

import numpy as np
import pytest

from kalmap.geometry.angles import wrap
from kalmap.kernels import candidates as kernel
from kalmap.kernels import layout
from kalmap.models import RangeBearing, VelocitySteering
from kalmap.records import Scan, Sightings
from kalmap.slam import LandmarkSlam
from kalmap.slam.engines import GeneralEngine
from kalmap.slam.predicted import PredictedMap
from slam_problems import LINEARISERS, STEERING_BIASES, circle_events, copy_belief, feed

EVENTS = circle_events(3, frames=14)
SENSOR = RangeBearing(mount=(0.8, -0.3, 0.2))
RULES = pytest.mark.parametrize("rule", ["jacobian", "unscented", "central", "cubature"])
BOTH = pytest.mark.parametrize("coordinates", ["additive", "invariant"])


def waiting(rule="central", coordinates="invariant", biases=0, **settings) -> LandmarkSlam:
    """A filter in the middle of a drive, right after odometry: the motion has not reached the map yet."""
    slam = LandmarkSlam(
        VelocitySteering(biases=STEERING_BIASES[:biases]),
        SENSOR,
        LINEARISERS[rule],
        coordinates=coordinates,
        start_covariance=np.diag([0.04, 0.05, 0.001]),
        **settings,
    )
    feed(slam, EVENTS[:-1])
    assert slam._belief.pending and not np.array_equal(slam._belief.phi, np.eye(3 + biases))
    return slam


def predicted(slam: LandmarkSlam, values=None, noises=None, scan=None) -> PredictedMap:
    values = EVENTS[-1].values if values is None else np.array(values, float).reshape(-1, 2)
    noises = SENSOR.covariance(values) if noises is None else noises
    frame = Sightings(9.0, values, scan=scan)
    return PredictedMap(slam._engine, slam._belief, SENSOR, slam._index, frame, noises)


def dense(slam: LandmarkSlam) -> tuple[np.ndarray, np.ndarray]:
    """(mean, covariance) of the whole state, from a copy, so that the filter's own motion still waits."""
    twin = copy_belief(slam._belief)
    return twin.mean[: twin.n].copy(), twin.covariance()


def read(slam: LandmarkSlam, index: int) -> np.ndarray:
    begin = slam._belief.robot + 2 * index
    return np.array([0, 1, 2, begin, begin + 1])


class Seen:
    """The sensor as a function of the (pose, landmark) error; in invariant coordinates of a twist about the robot."""

    def __init__(self, mean: np.ndarray, invariant: bool) -> None:
        self.mean, self.invariant = mean, invariant
        self.z = SENSOR.predict(mean[:3], mean[3:])

    def __call__(self, x):
        pose, landmark = self.mean[:3] + x[..., :3], self.mean[3:] + x[..., 3:]
        if self.invariant:
            turn = x[..., 2]
            s, v = np.sinc(turn / np.pi), np.sin(turn / 2) * np.sinc(turn / 2 / np.pi)

            def v_times(u):
                return np.stack([s * u[..., 0] - v * u[..., 1], v * u[..., 0] + s * u[..., 1]], -1)

            arm = self.mean[3:] - self.mean[:2]
            c, w = np.cos(turn), np.sin(turn)
            turned = np.stack([c * arm[0] - w * arm[1], w * arm[0] + c * arm[1]], -1)
            pose = np.concatenate([self.mean[:2] + v_times(x[..., :2]), pose[..., 2:]], -1)
            landmark = self.mean[:2] + turned + v_times(x[..., 3:])
        z = SENSOR.predict(pose, landmark)
        return np.stack([z[..., 0] - self.z[0], wrap(z[..., 1] - self.z[1])], -1)

    def minus(self, a, b):
        return a - b

    def jacobian(self, x):
        steps = 1e-6 * np.eye(5)
        return ((self(x + steps) - self(x - steps)) / 2e-6).T


@BOTH
@RULES
@pytest.mark.parametrize("biases", [0, 2])
def test_regressions_equal_numpys_on_the_flushed_belief(rule, coordinates, biases):
    """Oracle: the sensor's function, written out here, through the numpy lineariser on the dense (5, 5) block."""
    slam = waiting(rule, coordinates, biases)
    mean, p = dense(slam)
    which = np.arange(slam.landmark_count)
    expected = predicted(slam).expect(which)
    tol = 1e-6 if rule == "jacobian" else 1e-9
    for index in which:
        at = read(slam, index)
        change = np.eye(5)
        if coordinates == "invariant":  # xi_l = d_l - J (l - r) d_theta
            dx, dy = mean[at[3:]] - mean[:2]
            change[3, 2], change[4, 2] = dy, -dx
        block = change @ p[np.ix_(at, at)] @ change.T
        f = Seen(mean[at], coordinates == "invariant")
        regression = LINEARISERS[rule](f, np.zeros(5), 0.5 * (block + block.T))
        np.testing.assert_allclose(expected.z[index], f.z + regression.mean, rtol=tol)
        np.testing.assert_allclose(expected.matrices[index], regression.matrix @ change, atol=tol)
        np.testing.assert_allclose(expected.spreads[index], regression.covariance, rtol=tol, atol=tol * 1e-3)
    assert slam._belief.pending  # asking carries nothing anywhere


@BOTH
@RULES
def test_expected_sightings_hang_together_as_the_joint_matrix_says(rule, coordinates):
    """Oracle: H P H' with every candidate's matrix as rows of one H over the whole state; own blocks hold
    Lambda too."""
    slam = waiting(rule, coordinates, 1)
    _, p = dense(slam)
    view = predicted(slam)
    expected = view.expect(np.array([4, 0, 2, 1]))
    h = np.zeros((8, len(p)))
    for k, index in enumerate(expected.indices):
        h[2 * k : 2 * k + 2, read(slam, index)] = expected.matrices[k]
    joint = (h @ p @ h.T).reshape(4, 2, 4, 2).swapaxes(1, 2)
    got = view.cross(expected)
    for c in range(4):
        for d in range(4):
            if c == d:
                residual = got[c, c] - joint[c, c]
                assert np.linalg.eigvalsh(residual).min() > -1e-12
                assert (rule == "jacobian") == bool(np.abs(residual).max() < 1e-12)
                np.testing.assert_array_equal(got[c, c], expected.spreads[c])
            else:
                np.testing.assert_allclose(got[c, d], joint[c, d], rtol=1e-9, atol=1e-13)
                np.testing.assert_array_equal(got[c, d], got[d, c].T)


@BOTH
def test_distances_are_solved_linear_equations(coordinates):
    """Oracle: numpy.linalg.solve and slogdet for every pair, with a noise that the frame itself states."""
    rng = np.random.default_rng(0)
    slam = waiting("central", coordinates)
    noises = np.array([(a := rng.normal(0, 0.1, (2, 2))) @ a.T + 1e-4 * np.eye(2) for _ in EVENTS[-1].values])
    view = predicted(slam, noises=noises)
    expected = view.expect(np.arange(slam.landmark_count))
    squared, log_volume = view.distances(expected)
    for m, z in enumerate(EVENTS[-1].values):
        for c in range(len(expected.indices)):
            s = expected.spreads[c] + noises[m]
            nu = z - expected.z[c]
            nu[1] = np.angle(np.exp(1j * nu[1]))
            np.testing.assert_allclose(squared[m, c], nu @ np.linalg.solve(s, nu), rtol=1e-9)
            np.testing.assert_allclose(log_volume[m, c], np.linalg.slogdet(s)[1], rtol=1e-9)


def test_distances_refuse_what_is_no_covariance():
    """Oracle: the status code, whatever is wrong with S."""
    z, expected, out = np.zeros((1, 2)), np.zeros((1, 2)), np.empty((1, 1))
    for noise in (-np.eye(2), np.full((2, 2), np.nan), np.array([[1.0, 2.0], [2.0, 1.0]]), np.zeros((2, 2))):
        status = kernel.distances(z, noise[None], expected, np.zeros((1, 2, 2)), out, out.copy())
        assert status == layout.NOT_POSITIVE


@BOTH
@RULES
@pytest.mark.parametrize("biases", [0, 2])
def test_the_general_engine_expects_the_same(rule, coordinates, biases):
    """Oracle: GeneralEngine in numpy on a copy of the belief, motion waiting in both."""
    slam = waiting(rule, coordinates, biases)
    general = GeneralEngine(
        slam.motion, SENSOR, LINEARISERS[rule], coordinates == "invariant", False, full=False
    )
    begin = slam._belief.robot + 2 * np.array([3, 0, 1])
    tol = 1e-6 if rule == "jacobian" else 1e-9
    twin = copy_belief(slam._belief)
    for got, wanted in zip(
        slam._engine.expect(slam._belief, begin), general.expect(twin, begin), strict=True
    ):
        assert got.shape == wanted.shape
        np.testing.assert_allclose(got, wanted, rtol=tol, atol=tol)
    for engine in (slam._engine, general):
        shapes = [each.shape for each in engine.expect(slam._belief, np.zeros(0, dtype=np.int64))]
        assert shapes == [(0, 2), (0, 2, 5), (0, 2, 2)]


@BOTH
@pytest.mark.parametrize("extent", [0.0, 0.4])
def test_separations_of_landmarks(coordinates, extent):
    """Oracle: d' (G P G' + 2 extent^2 I)^-1 d with G = [.. I .. -I ..] over the dense covariance."""
    slam = waiting("central", coordinates)
    mean, p = dense(slam)
    first, second = np.array([0, 3, 2, 1]), np.array([1, 0, 4, 2])
    got = predicted(slam).separations(first, second, extent)
    for k, (i, j) in enumerate(zip(first, second, strict=True)):
        g = np.zeros((2, len(p)))
        g[:, read(slam, i)[3:]], g[:, read(slam, j)[3:]] = np.eye(2), -np.eye(2)
        s, d = g @ p @ g.T + 2 * extent**2 * np.eye(2), g @ mean
        np.testing.assert_allclose(got[k], d @ np.linalg.solve(s, d), rtol=1e-9)
    np.testing.assert_allclose(predicted(slam).separations(second, first, extent), got, rtol=1e-12)


@BOTH
def test_the_joint_of_some_landmarks(coordinates):
    """Oracle: slices of the dense mean and covariance, in the order asked for."""
    slam = waiting("central", coordinates, 1)
    mean, p = dense(slam)
    some = np.array([3, 0, 2])
    entries = np.concatenate([read(slam, i)[3:] for i in some])
    got_mean, got = predicted(slam).joint(some)
    np.testing.assert_array_equal(got_mean, mean[entries])
    np.testing.assert_array_equal(got, p[np.ix_(entries, entries)])


def test_a_landmark_is_no_twin_of_itself():
    """Oracle: the difference of a landmark and itself is known exactly: nothing to merge."""
    slam = waiting()
    same = np.array([2])
    assert predicted(slam).separations(same, same, 0.0)[0] == np.inf


# --- what stands in the way ---------------------------------------------------------------------------


def test_hidden_by_sightings_equals_the_geometry():
    """Oracle: the distance of the landmark's ray from what is seen, small angles, with a loop over all pairs."""
    rng = np.random.default_rng(1)
    for _ in range(100):
        z = np.c_[rng.uniform(0, 20, 4), rng.uniform(-3.1, 3.1, 4)]
        landmarks = np.c_[rng.uniform(0, 25, 6), rng.uniform(-3.1, 3.1, 6)]
        landmarks[:3, 1] = wrap(z[:3, 1] + rng.normal(0, 0.05, 3))
        out = np.empty(6, bool)
        kernel.hidden_by_sightings(z, landmarks, 0.3, 1.0, out)
        for c, (distance, bearing) in enumerate(landmarks):
            gaps = np.abs(np.angle(np.exp(1j * (z[:, 1] - bearing))))
            assert out[c] == any((distance - z[:, 0] > 1.0) & (gaps * z[:, 0] < 0.3))


def test_hidden_by_beams_equals_the_geometry():
    """Oracle: the beam of least angular distance by argmin; outside the swept sector nothing is known: hidden. A beam
    that did not come back hides nothing."""
    rng = np.random.default_rng(2)
    for _ in range(100):
        bearings = np.sort(rng.uniform(-1.5, 1.5, 40))
        ranges = np.where(rng.random(40) < 0.3, np.inf, rng.uniform(1, 20, 40))
        ranges[rng.random(40) < 0.2] = 0.0  # no return
        landmarks = np.c_[rng.uniform(0, 25, 9), rng.uniform(-1.8, 1.8, 9)]
        out = np.empty(9, bool)
        kernel.hidden_by_beams(ranges, bearings, landmarks, 1.0, out)
        for c, (distance, bearing) in enumerate(landmarks):
            inside = bearings[0] < bearing <= bearings[-1]
            beam = np.abs(bearings - bearing).argmin()
            assert out[c] == (not inside or 0.0 < ranges[beam] < distance - 1.0)


def test_the_map_takes_the_scan_if_there_is_one():
    """Oracle: by hand: landmark 0 lies behind a wall that the sightings do not tell of; a landmark hides not itself."""
    slam = waiting()
    expected = predicted(slam).expect(np.arange(slam.landmark_count))
    near = expected.z[[0]]
    bearings = np.linspace(-np.pi, np.pi, 721)
    clear, wall = np.full(721, 30.0), np.full(721, 30.0)
    wall[np.abs(wrap(bearings - near[0, 1])) < 0.02] = near[0, 0] - 2.0
    assert not predicted(slam, near).hidden(expected)[0]
    assert not predicted(slam, near, scan=Scan(9.0, clear, bearings)).hidden(expected)[0]
    assert predicted(slam, near, scan=Scan(9.0, wall, bearings)).hidden(expected)[0]
    assert predicted(slam, near - [[2.0, 0.0]]).hidden(expected)[0]
    assert not predicted(slam, np.zeros((0, 2))).hidden(expected).any()


# --- the view as a whole ------------------------------------------------------------------------------


def test_the_view_says_where_sensor_and_robot_are():
    """Oracle: the mount carried by hand; the largest eigenvalue of the position's covariance; the sensor's limits."""
    slam = waiting()
    view, (x, y, heading) = predicted(slam), slam.pose
    c, s = np.cos(heading), np.sin(heading)
    np.testing.assert_allclose(
        view.sensor_pose, [x + 0.8 * c + 0.3 * s, y + 0.8 * s - 0.3 * c, heading + 0.2]
    )
    np.testing.assert_array_equal(view.pose, slam.pose)
    widest = np.sqrt(np.linalg.eigvalsh(slam.pose_covariance[:2, :2])[-1])
    np.testing.assert_allclose(view.position_sigma, widest, rtol=1e-12)
    assert (view.max_range, view.half_view) == (30.0, np.pi / 2)
    np.testing.assert_array_equal(
        view.positions(np.array([2, 0])), slam.estimate().landmarks.positions[[2, 0]]
    )


def test_wider_landmarks_have_wider_spreads():
    """Oracle: extent^2 on the range, (extent / range)^2 on the bearing; nothing else, and the original stays."""
    expected = predicted(waiting()).expect(np.arange(3))
    before = expected.spreads.copy()
    wide = expected.widened(0.5)
    add = np.zeros((3, 2, 2))
    add[:, 0, 0], add[:, 1, 1] = 0.25, (0.5 / expected.z[:, 0]) ** 2
    np.testing.assert_allclose(wide.spreads, before + add, rtol=1e-12)
    np.testing.assert_array_equal(expected.spreads, before)
    assert expected.widened(0.0) is expected
    some = expected.take(np.array([2, 0]))
    assert some.indices.tolist() == [2, 0]
    np.testing.assert_array_equal(some.matrices, expected.matrices[[2, 0]])
