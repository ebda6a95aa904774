"""Made-up runs for the tests of pictures, pages and result folders: a loop driven past landmarks."""

from __future__ import annotations

import numpy as np

from kalmap.records import Estimate, Landmarks, Manifest, RunConfig, Trace
from kalmap.view import Aligned, Errors, RunView


def loop_run(
    landmarks: int = 35, size: float = 40.0, frames: int = 400, seed: int = 3, method: str = "cr-cdkf"
) -> RunView:
    """A loop of a quarter more than one lap, with errors that fit the covariances."""
    rng = np.random.default_rng(seed)
    times = 1.0e3 + 0.2 * np.arange(frames)
    angle = np.linspace(0.0, 2.5 * np.pi, frames)
    radius = size * (1.0 + 0.25 * np.cos(3 * angle))
    truth = np.column_stack([radius * np.cos(angle), 0.7 * radius * np.sin(angle), angle + np.pi / 2])
    sigma = 0.02 + 0.012 * size * np.minimum(angle, 2 * np.pi - np.minimum(angle, 2 * np.pi)) / np.pi
    sigmas = np.column_stack([sigma, 0.8 * sigma, 0.3 * sigma / size + 1e-3])
    values = _smooth(rng, frames) * sigmas
    covariances = np.array([np.diag(row**2) for row in sigmas])
    dof = 2 * rng.integers(0, 6, frames)
    nis = np.where(dof > 0, rng.chisquare(np.maximum(dof, 1)), np.nan)
    trace = Trace(
        times=times,
        poses=truth + values,
        covariances=covariances,
        nis=nis,
        nis_dof=dof,
        landmarks=np.minimum(np.arange(frames), landmarks),
        sightings=dof // 2,
        step_seconds=rng.gamma(6.0, 5e-5, 4 * frames) * np.linspace(0.5, 1.5, 4 * frames),
        step_times=1.0e3 + 0.05 * np.arange(4 * frames),
    )
    places = rng.uniform(-1.4, 1.4, (landmarks, 2)) * (size, 0.7 * size)
    joint = _joint(rng, trace.poses[-1], places, 0.5 * size)
    errors = Errors(times=times, values=values, sigmas=sigmas, nees=((values / sigmas) ** 2).sum(axis=1))
    estimate = _estimate(float(times[-1]), *joint, rng.integers(1, 90, landmarks))
    reference = Aligned(kind="truth", path=truth[:, :2], landmarks=places)
    return RunView(method, f"course-{landmarks}", estimate, trace, reference, errors)


def empty_run(frames: int = 0) -> RunView:
    """A run that saw nothing and is compared with nothing: an empty map, and `frames` frames at rest."""
    nothing = np.zeros(0)
    trace = Trace(
        times=np.arange(float(frames)),
        poses=np.zeros((frames, 3)),
        covariances=np.zeros((frames, 3, 3)),
        nis=np.full(frames, np.nan),
        nis_dof=np.zeros(frames, dtype=np.int64),
        landmarks=np.zeros(frames, dtype=np.int64),
        sightings=np.zeros(frames, dtype=np.int64),
        step_seconds=nothing,
        step_times=nothing,
    )
    estimate = _estimate(0.0, np.zeros(3), np.zeros((3, 3)), np.zeros(0, dtype=np.int64))
    return RunView("ekf", "nothing", estimate, trace)


def manifest(**changes: object) -> Manifest:
    """A manifest of a run that went well, with changes."""
    fields: dict[str, object] = {
        "kalmap": "0.1.0",
        "python": "3.11.2",
        "platform": "Linux",
        "packages": {"numpy": "2.0", "scipy": "1.14"},
        "command": "kalmap run course-35",
        "log": "course-35",
        "source": "world course-35, seed 1",
        "data_sha256": {"course.csv": "ab" * 32},
        "seed": 1,
        "config": RunConfig(),
        "started": "2024-05-01T10:00:00Z",
        "finished": "2024-05-01T10:00:09Z",
        "completed": True,
        "interrupted": False,
        "error": None,
        "skipped": [],
        "skipped_total": 0,
    }
    return Manifest(**{**fields, **changes})  # type: ignore[arg-type]


def _smooth(rng: np.random.Generator, frames: int) -> np.ndarray:
    """Three courses of unit variance that change slowly, as errors of a filter do."""
    noise = rng.standard_normal((frames + 40, 3))
    kernel = np.ones(41) / np.sqrt(41)
    return np.column_stack([np.convolve(noise[:, column], kernel, mode="valid") for column in range(3)])


def _joint(
    rng: np.random.Generator, pose: np.ndarray, places: np.ndarray, scale: float
) -> tuple[np.ndarray, np.ndarray]:
    """A joint mean with a positive definite covariance whose landmarks grow unsure with distance."""
    n = 3 + 2 * len(places)
    weights = np.concatenate([[0.01, 0.01, 0.002], np.repeat(0.02 + 0.01 * rng.random(len(places)), 2)])
    half = rng.standard_normal((n, 6)) * weights[:, None] * scale
    covariance = half @ half.T + np.diag((0.3 * weights * scale) ** 2)
    mean = np.concatenate([pose, places.ravel()])
    mean[3:] += half[3:] @ rng.standard_normal(6)
    return mean, covariance


def _estimate(time: float, mean: np.ndarray, covariance: np.ndarray, sightings: np.ndarray) -> Estimate:
    count = len(sightings)
    rows = 3 + 2 * np.arange(count)[:, None] + np.arange(2)
    landmarks = Landmarks(
        ids=np.arange(count) + 100,
        positions=mean[rows],
        covariances=covariance[rows[:, :, None], rows[:, None, :]],
        sightings=sightings,
        existence=np.ones(count),
    )
    return Estimate(
        time, mean[:3], covariance[:3, :3], landmarks, {}, lambda: (mean, covariance), "invariant"
    )


def test_the_made_up_errors_fit_their_covariances():
    nees = np.concatenate([loop_run(1, seed=seed).errors.nees for seed in range(20)])
    assert 2.0 < nees.mean() < 4.0
