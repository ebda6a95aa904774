"""DLR / Bremen: a robot in an office building, circles on the floor (Kurlbaum and Frese, 2009).

`corrected_data_circles.mat` (identities corrected by S. Huang) or the original `map.circles`. Without
time stamps: step k ends at k seconds, and its image was taken then.

The files' robot frame has -Y forward. Here everything (positions, movements, covariances, the batch
solution and its start frame) is turned by +90 degrees, (x, y) = (-Y, X), so that x is forward. The
heading is unchanged by that. The header of `map.circles` calls X "right"; taken literally its frame is
left-handed seen from above, and the map is then a mirror image of the building. Nothing in the numbers
tells, and no error, covariance or residual depends on it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from kalmap.data.blocks import StreamEvents
from kalmap.data.mat import load_mat, matrix
from kalmap.data.streams import Malformed, OdometryStream, SightingStream, Streams, identities
from kalmap.data.text import parse_rows, read_text
from kalmap.data.victoria_park import batch_solution
from kalmap.records import AssociationConfig, Log, MotionConfig, Reference, RunConfig, SensorConfig

CORRECTED, ORIGINAL = "corrected_data_circles.mat", "map.circles"
BATCH = "LS_result_DLR_original_cov_global_minimum.mat"

DEFAULTS = RunConfig(
    motion=MotionConfig(model="increments"),
    sensor=SensorConfig(sigma_range=0.08, sigma_bearing_deg=1.5, max_range=5.0, field_of_view_deg=180.0),
    association=AssociationConfig(method="known", management="trial", confirm=2),
)
"""The log states a covariance for every step and sighting; the sigmas serve only where it is not used."""

STEP = -100.0
"""First column of an odometry row in the MATLAB file."""
TURN = np.array([[0.0, -1.0], [1.0, 0.0]])
STEP_COLUMNS = ("dX", "dY", "dPhi", "cXX", "cXY", "cYY", "cXPhi", "cYPhi", "cPhiPhi")
LANDMARK_COLUMNS = ("x", "y", "quality", "cXX", "cXY", "cYY", "id")


def open_dlr(path: Path) -> Log:
    """The log in a `corrected_data_circles.mat` or in a `map.circles`, with its batch solution beside it."""
    batch = path.with_name(BATCH)
    references = (_batch(batch),) if batch.is_file() else ()
    return Log(
        name="dlr",
        source=str(path),
        defaults=DEFAULTS,
        open=StreamEvents(lambda: _from_mat(path) if path.suffix == ".mat" else _from_text(path)),
        references=references,
        files=(str(path),),
    )


def _batch(path: Path) -> Reference:
    poses, ids, landmarks = batch_solution(path)
    # The solution counts one pose more than there are steps; it repeats the last one.
    if len(poses) > 1 and np.allclose(poses[-1], poses[-2], rtol=0.0, atol=1e-6):
        poses = poses[:-1]
    return Reference(
        kind="batch",
        times=np.arange(len(poses), dtype=np.float64),
        positions=poses[:, :2] @ TURN.T,
        headings=poses[:, 2].copy(),
        landmark_ids=ids,
        landmarks=landmarks @ TURN.T,
    )


def _from_mat(path: Path) -> Streams:
    rows = matrix(load_mat(path, (path.stem,)), path.stem, path, columns=10)
    is_step = rows[:, 0] == STEP
    records = np.arange(1, len(rows) + 1)
    step_of = np.cumsum(is_step)
    steps, seen = rows[is_step, 1:], rows[~is_step, :7]
    return Streams(
        odometry=_odometry(path, steps, records[is_step], {}),
        sightings=_sightings(path, seen, records[~is_step], {}, step_of[~is_step], step_of[is_step]),
    )


def _from_text(path: Path) -> Streams:
    """Lines `STEP image dX ...` and `LANDMARK_C x y ...`; the latter belong to the step before them."""
    steps: tuple[list[list[str]], list[int]] = ([], [])
    seen: tuple[list[list[str]], list[int]] = ([], [])
    step_of = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if words[0] == "STEP":
            steps[0].append(words[2:])
            steps[1].append(number)
        else:
            # Anything else that is not a landmark has no numbers to read, and is reported as that.
            seen[0].append(words[1:] if words[0].startswith("LANDMARK") else words[:1])
            seen[1].append(number)
            step_of.append(len(steps[0]))
    moved = parse_rows(steps[0], np.array(steps[1], dtype=np.int64), STEP_COLUMNS)
    found = parse_rows(seen[0], np.array(seen[1], dtype=np.int64), LANDMARK_COLUMNS)
    all_steps = np.arange(1, len(steps[0]) + 1)
    return Streams(
        odometry=_odometry(path, moved.values, moved.records, moved.malformed),
        sightings=_sightings(
            path,
            found.values,
            found.records,
            found.malformed,
            np.array(step_of, dtype=np.int64),
            all_steps,
        ),
    )


def _odometry(
    path: Path, rows: np.ndarray, records: np.ndarray, malformed: dict[int, Malformed]
) -> OdometryStream:
    """rows: (n, 9) dX dY dPhi cXX cXY cYY cXPhi cYPhi cPhiPhi, in this order."""
    turn = np.eye(3)
    turn[:2, :2] = TURN
    covariance = rows[:, 3:][:, [0, 1, 3, 1, 2, 4, 3, 4, 5]].reshape(-1, 3, 3)
    return OdometryStream(
        file=str(path),
        times=np.arange(1.0, len(rows) + 1.0),
        records=records,
        malformed=malformed,
        names=("dx", "dy", "dtheta"),
        values=rows[:, :3] @ turn.T,
        covariance=turn @ covariance @ turn.T,
        durations=np.ones(len(rows)),
    )


def _sightings(
    path: Path,
    rows: np.ndarray,
    records: np.ndarray,
    malformed: dict[int, Malformed],
    step_of: np.ndarray,
    steps: np.ndarray,
) -> SightingStream:
    """rows: (n, 7) x y quality cXX cXY cYY id, seen after step `step_of`; steps without any become empty."""
    values, covariance = _polar(rows[:, :2] @ TURN.T, rows[:, 3:6])
    ids = identities(rows[:, 6])
    blind = np.setdiff1d(steps, step_of)
    order = np.argsort(np.concatenate([step_of, blind]), kind="stable")
    place = np.argsort(order)
    gap = np.full(len(blind), np.nan)
    return SightingStream(
        file=str(path),
        times=np.concatenate([step_of, blind])[order].astype(np.float64),
        records=np.concatenate([records, np.zeros(len(blind), dtype=np.int64)])[order],
        malformed={int(place[row]): why for row, why in malformed.items()},
        values=np.vstack([values, np.full((len(blind), 2), np.nan)])[order],
        ids=np.concatenate([ids, np.full(len(blind), -1)])[order],
        covariance=np.vstack([covariance, np.full((len(blind), 2, 2), np.nan)])[order],
        attributes={"quality": np.concatenate([rows[:, 2], gap])[order]},
        empty=np.concatenate([np.zeros(len(rows), dtype=bool), np.ones(len(blind), dtype=bool)])[order],
    )


def _polar(points: np.ndarray, terms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Range and bearing (n, 2) of points (n, 2), and their covariance J C J' to first order (n, 2, 2).

    terms: (n, 3) cXX cXY cYY in the files' frame. J is the exact Jacobian of (range, bearing).
    """
    covariance = TURN @ terms[:, [0, 1, 1, 2]].reshape(-1, 2, 2) @ TURN.T
    x, y = points.T
    distance = np.hypot(x, y)
    # A point at the sensor itself has no bearing: its covariance comes out as not finite and is refused.
    with np.errstate(divide="ignore", invalid="ignore"):
        jacobian = np.stack(
            [
                np.stack([x, y], axis=1) / distance[:, None],
                np.stack([-y, x], axis=1) / distance[:, None] ** 2,
            ],
            axis=1,
        )
        polar = jacobian @ covariance @ np.swapaxes(jacobian, 1, 2)
    # Symmetric to the last bit, which the product is not.
    return np.column_stack([distance, np.arctan2(y, x)]), (polar + np.swapaxes(polar, 1, 2)) / 2
