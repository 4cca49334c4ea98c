"""Light through six dielectric cells (FDFD), by the package's adjoint."""

import autograd.numpy as np
import ceviche

about = {
    "package": "ceviche",
    "python": "plain",
    "requires": "ceviche",
    "examine": "grad=gradient calls=1500",
    "derivative": "right",
    "how": "own dense solve and sensitivity",
}
N, DL, OMEGA = 20, 5e-8, 2 * np.pi * 3e8 / 1.5e-6
EPS, MU = 8.854187817620389e-12, 1.2566370614359173e-06
theta = np.array([2.0, 3.0, 2.5, 4.0, 2.2, 3.1])
SOURCE, PLACE = np.zeros((N, N)), np.zeros((N, N))
SOURCE[5, 9] = 1e3
PLACE[14:17, 8:10] = 1.0  # the six cells


def permittivity(p):
    """Return the permittivity of each cell."""
    return 1.0 + sum((p[k] - 1.0) * (np.arange(N * N).reshape(N, N) == i) for k, i in enumerate(np.flatnonzero(PLACE)))


def cost(p):
    """Return the mean intensity on the right."""
    return np.mean(np.abs(ceviche.fdfd_ez(OMEGA, DL, permittivity(p), [0, 0]).solve(SOURCE)[2][18]) ** 2)


gradient = lambda p: ceviche.jacobian(cost, mode="reverse")(p)[0]


def truth():
    """Return the derivative of an own discretisation, periodic as without absorbing layers."""
    one = np.roll(np.eye(N), 1, 0) + np.roll(np.eye(N), -1, 0) - 2 * np.eye(N)
    laplace = (np.kron(one, np.eye(N)) + np.kron(np.eye(N), one)) / DL**2 / MU
    solve = lambda b: np.linalg.solve(laplace + np.diag(OMEGA**2 * EPS * permittivity(theta).ravel()), b)
    field = solve(1j * OMEGA * SOURCE.ravel())
    moved = [solve(-(OMEGA**2) * EPS * np.eye(N * N)[i] * field[i])[18 * N : 19 * N] for i in np.flatnonzero(PLACE)]
    return [np.mean(2 * np.real(np.conj(field[18 * N : 19 * N]) * m)) for m in moved]
