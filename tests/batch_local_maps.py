"""The oracle for map joining: one sparse least squares over all local maps, nothing eliminated.

Unknowns: the end pose of every map and every landmark, in the frame of the first map (the formulation of iterated
SLSJF: Huang, Wang, Dissanayake & Frese 2008). Damped Gauss-Newton on whitened residuals, SciPy's sparse LU.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import splu


def batch(maps: list) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """maps: with ids, mean, covariance. Returns ids (N,), landmarks (N, 2), end (3,), sum of squares."""
    ids = np.unique(np.concatenate([each.ids for each in maps]))
    whiten = [np.linalg.inv(np.linalg.cholesky(each.covariance)) for each in maps]
    x = _guess(maps, ids)
    residual, jacobian = _system(maps, ids, whiten, x)
    damping = 1e-6
    for _ in range(500):
        normal = (jacobian.T @ jacobian).tocsc()
        normal = normal + damping * _diagonal(normal)
        step = -splu(normal.tocsc()).solve(jacobian.T @ residual)
        after, slope = _system(maps, ids, whiten, x + step)
        if after @ after > residual @ residual * (1 + 1e-12):
            damping *= 10.0
            continue
        x, residual, jacobian, damping = x + step, after, slope, max(damping / 10.0, 1e-12)
        if np.abs(step).max() < 1e-9:
            break
    count = 3 * len(maps)
    return ids, x[count:].reshape(-1, 2), x[count - 3 : count], float(residual @ residual)


def _diagonal(matrix):
    from scipy.sparse import diags

    return diags(matrix.diagonal())


def _guess(maps: list, ids: np.ndarray) -> np.ndarray:
    pose, poses, points = np.zeros(3), [], np.full((len(ids), 2), np.nan)
    for each in maps:
        turn = np.array([[np.cos(pose[2]), -np.sin(pose[2])], [np.sin(pose[2]), np.cos(pose[2])]])
        rows = np.searchsorted(ids, each.ids)
        fresh = np.isnan(points[rows, 0])
        points[rows[fresh]] = (pose[:2] + each.mean[3:].reshape(-1, 2) @ turn.T)[fresh]
        pose = np.array([*(pose[:2] + turn @ each.mean[:2]), pose[2] + each.mean[2]])
        poses.append(pose)
    return np.concatenate([np.ravel(poses), points.ravel()])


def _system(maps: list, ids: np.ndarray, whiten: list[np.ndarray], x: np.ndarray):
    """Whitened residuals of all maps and their Jacobian."""
    residuals, rows, columns, values, first = [], [], [], [], 0
    for number, each in enumerate(maps):
        start = x[3 * number - 3 : 3 * number] if number else np.zeros(3)
        at = 3 * len(maps) + 2 * np.searchsorted(ids, each.ids)
        index = np.concatenate([3 * number + np.arange(3), (at[:, None] + np.arange(2)).ravel()])
        c, s = np.cos(start[2]), np.sin(start[2])
        back, turned_back = np.array([[c, s], [-s, c]]), np.array([[-s, c], [-c, -s]])
        n = len(index)
        local, jacobian = np.empty(n), np.zeros((n, n + 3))
        for row in (0, *range(3, n, 2)):
            apart = x[index[row : row + 2]] - start[:2]
            local[row : row + 2] = back @ apart
            jacobian[row : row + 2, row : row + 2] = back
            jacobian[row : row + 2, n : n + 2] = -back
            jacobian[row : row + 2, n + 2] = turned_back @ apart
        local[2] = x[index[2]] - start[2]
        jacobian[2, 2], jacobian[2, n + 2] = 1.0, -1.0
        gone = local - each.mean
        gone[2] = (gone[2] + np.pi) % (2.0 * np.pi) - np.pi
        residuals.append(whiten[number] @ gone)
        jacobian = whiten[number] @ jacobian
        index = np.concatenate([index, 3 * number - 3 + np.arange(3)])
        if number == 0:
            jacobian, index = jacobian[:, :n], index[:n]
        grid = np.meshgrid(first + np.arange(n), index, indexing="ij")
        rows.append(grid[0].ravel())
        columns.append(grid[1].ravel())
        values.append(jacobian.ravel())
        first += n
    entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    return np.concatenate(residuals), coo_matrix(entries, shape=(first, len(x))).tocsr()
