"""Landmarks eliminated give the steps of the whole system; weighted rows the gradient of the robust cost."""

import numpy as np

from rig_calib.normal_equations import Groups, eliminate, landmark_steps, reweight, robust_cost

CAMERAS, SIZE, LANDMARKS = 3, 4, 5
RNG = np.random.default_rng(0)


def problem() -> tuple[Groups, np.ndarray, np.ndarray, np.ndarray]:
    """Every landmark in two or three cameras, groups of one to five rows."""
    cameras, first_row, first_group = [], [0], [0]
    for p in range(LANDMARKS):
        seeing = sorted(RNG.choice(CAMERAS, 2 + p % 2, replace=False))
        cameras += seeing
        first_row += [first_row[-1] + int(n) for n in np.cumsum(RNG.integers(1, 6, len(seeing)))]
        first_group.append(len(cameras))
    N = first_row[-1]
    groups = Groups(np.array(cameras), np.array(first_row), np.array(first_group))
    return groups, RNG.normal(size=N), RNG.normal(size=(N, SIZE)), RNG.normal(size=(N, 3))


def whole_jacobian(groups: Groups, by_state: np.ndarray, by_landmark: np.ndarray) -> np.ndarray:
    """Derivatives (N, C·S + 3L) of the rows by everything."""
    J = np.zeros((len(by_state), CAMERAS * SIZE + 3 * LANDMARKS))
    for p in range(LANDMARKS):
        for g in range(groups.first_group[p], groups.first_group[p + 1]):
            rows, c = slice(groups.first_row[g], groups.first_row[g + 1]), groups.camera[g]
            J[rows, c * SIZE : (c + 1) * SIZE] = by_state[rows]
            at = CAMERAS * SIZE + 3 * p
            J[rows, at : at + 3] = by_landmark[rows]
    return J


def test_eliminated_landmarks_give_the_step_of_the_whole_system() -> None:
    groups, residual, by_state, by_landmark = problem()
    J = whole_jacobian(groups, by_state, by_landmark)
    H = J.T @ J
    H[: CAMERAS * SIZE, : CAMERAS * SIZE] += np.eye(CAMERAS * SIZE)
    expected = -np.linalg.solve(H, J.T @ residual)

    normal = np.eye(CAMERAS * SIZE).reshape(CAMERAS, SIZE, CAMERAS, SIZE).copy()
    gradient = np.zeros((CAMERAS, SIZE))
    known = eliminate(groups, residual, by_state, by_landmark, 0.0, normal, gradient)
    lower = np.tril(normal.reshape(CAMERAS * SIZE, -1))
    steps = -np.linalg.solve(lower + np.tril(lower, -1).T, gradient.ravel()).reshape(CAMERAS, SIZE)
    by_landmark_step = np.empty((LANDMARKS, 3))
    landmark_steps(groups.camera, groups.first_group, *known, steps, by_landmark_step)
    np.testing.assert_allclose(np.concatenate([steps.ravel(), by_landmark_step.ravel()]), expected, rtol=1e-8)


def test_a_landmark_of_which_nothing_is_known_stays_where_it_is() -> None:
    groups, residual, by_state, by_landmark = problem()
    by_landmark[: groups.first_row[groups.first_group[1]]] = 0.0
    normal, gradient = np.zeros((CAMERAS, SIZE, CAMERAS, SIZE)), np.zeros((CAMERAS, SIZE))
    known = eliminate(groups, residual, by_state, by_landmark, 0.0, normal, gradient)
    step = np.empty((LANDMARKS, 3))
    landmark_steps(groups.camera, groups.first_group, *known, np.ones((CAMERAS, SIZE)), step)
    assert not step[0].any()
    assert step[1:].all()
    assert np.isfinite(normal).all()


def test_weighted_rows_have_the_gradient_of_the_robust_cost() -> None:
    first_row, bend = np.array([0, 2, 3, 6]), 5.7
    residual, by_state, by_landmark = (
        3 * RNG.normal(size=6),
        RNG.normal(size=(6, SIZE)),
        RNG.normal(size=(6, 3)),
    )

    def cost(state: np.ndarray, landmark: np.ndarray) -> float:
        return robust_cost(first_row, residual + by_state @ state + by_landmark @ landmark, bend)

    step = 1e-6
    of_state = [(cost(d, np.zeros(3)) - cost(-d, np.zeros(3))) / (2 * step) for d in step * np.eye(SIZE)]
    of_landmark = [
        (cost(np.zeros(SIZE), d) - cost(np.zeros(SIZE), -d)) / (2 * step) for d in step * np.eye(3)
    ]
    for least_curvature in (0.2, 1.0):
        r, J, K = residual.copy(), by_state.copy(), by_landmark.copy()
        reweight(first_row, r, J, K, bend, least_curvature)
        np.testing.assert_allclose(J.T @ r, of_state, rtol=1e-6)
        np.testing.assert_allclose(K.T @ r, of_landmark, rtol=1e-6)


def test_weighted_rows_near_the_minimum_have_the_curvature_of_the_robust_cost() -> None:
    first_row, bend = np.array([0, 2]), 5.7
    residual, by_state = np.array([0.7, -0.4]), RNG.normal(size=(2, 2))

    def cost(x: float, y: float) -> float:
        return robust_cost(first_row, residual + by_state @ (x, y), bend)

    h = 1e-4
    second = (cost(h, 0) - 2 * cost(0, 0) + cost(-h, 0)) / h**2
    mixed = (cost(h, h) - cost(h, -h) - cost(-h, h) + cost(-h, -h)) / (4 * h**2)
    r, J, K = residual.copy(), by_state.copy(), np.zeros((2, 3))
    reweight(first_row, r, J, K, bend, 0.2)
    np.testing.assert_allclose((J.T @ J)[0], (second, mixed), rtol=1e-5)
