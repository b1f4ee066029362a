"""The most probable trajectory under constraints by other means: Clarabel on dense Gaussian algebra, IPOPT on a
transcription of the state-space model by SciPy and CasADi; none of the library's code in here."""

from __future__ import annotations

from collections.abc import Callable

import casadi
import clarabel
import numpy as np
import scipy.sparse as sparse
from scipy.integrate import solve_ivp
from scipy.linalg import block_diag, solve_continuous_lyapunov


def quadratic_program(mean, covariance, matrix, offset):
    """Minimise (w - mean)' covariance^-1 (w - mean) / 2 subject to matrix w + offset >= 0; return w, multipliers, J."""
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-12
    size, count = root.shape[1], matrix.shape[0]
    solver = clarabel.DefaultSolver(
        sparse.csc_matrix(np.eye(size)), np.zeros(size), sparse.csc_matrix(-matrix @ root), matrix @ mean + offset,
        [clarabel.NonnegativeConeT(count)], settings)
    result = solver.solve()
    e = np.asarray(result.x)
    return mean + root @ e, np.asarray(result.z), 0.5 * e @ e


def matern_sde(scale, lengthscale, order):
    """F, the stationary covariance, and the diffusion of a Matern process as a companion form."""
    rate, size = np.sqrt(2 * order + 1) / lengthscale, order + 1
    feedback = np.diag(np.ones(size - 1), 1)
    feedback[-1] = -np.poly(-rate * np.ones(size))[:0:-1]
    noise = np.zeros((size, size))
    noise[-1, -1] = 1.0
    stationary = solve_continuous_lyapunov(feedback, -noise)
    factor = scale**2 / stationary[0, 0]
    return feedback, factor * stationary, factor * noise


class Transcribed:
    """min over trajectories of the state-space model with one Matern force, observed at every row.

    Attributes:
        drift: f(x, u), of CasADi or NumPy columns and scalars, as a list of M entries.
        observe: h(x), as a list of D entries.
        bounds: (index in (x, u), sign, bound) for sign * (w[index] - bound) >= 0.
    """

    def __init__(self, drift: Callable, observe: Callable, force, diffusion, mean, covariance, noise, bounds,
                 substeps=8):
        self.size = len(mean)
        self.drift, self.observe, self.bounds, self.substeps = drift, observe, bounds, substeps
        self.feedback, stationary, force_noise = matern_sde(*force)
        self.total = self.size + len(self.feedback)
        self.mean = np.append(mean, np.zeros(len(self.feedback)))
        self.covariance = block_diag(covariance, stationary)
        self.diffusion = block_diag(diffusion, force_noise)
        self.noise = np.asarray(noise)
        state = casadi.SX.sym("s", self.total)
        rate = self.rate(state)
        self.jacobian = casadi.Function("A", [state], [casadi.jacobian(rate, state)])
        self.rate_of = casadi.Function("f", [state], [rate])

    def rate(self, state):
        state_rate = casadi.vertcat(*self.drift(state, state[self.size]))
        return casadi.vertcat(state_rate, casadi.mtimes(self.feedback, state[self.size:]))

    def flow(self, length):
        state, step = casadi.SX.sym("s", self.total), length / self.substeps
        current_state = state
        for _ in range(self.substeps):
            k1 = self.rate(current_state)
            k2 = self.rate(current_state + step / 2 * k1)
            k3 = self.rate(current_state + step / 2 * k2)
            k4 = self.rate(current_state + step * k3)
            current_state = current_state + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return casadi.Function("F", [state], [current_state])

    def process_cov(self, state, length):
        """Covariance gained over an interval, by the moment equations along the path from ``state``."""
        n = self.total

        def rates(_, z):
            a = np.asarray(self.jacobian(z[:n]))
            p = z[n:].reshape(n, n)
            return np.concatenate([np.asarray(self.rate_of(z[:n])).ravel(), (a @ p + p @ a.T + self.diffusion).ravel()])

        start = np.concatenate([state, np.zeros(n * n)])
        end = solve_ivp(rates, (0.0, length), start, method="DOP853", rtol=1e-10, atol=1e-13).y[:, -1]
        return end[n:].reshape(n, n)

    def solve(self, times, y, guess, rounds=4):
        """Return nodes (T, n) and J, with the process covariances at the solution."""
        flows = {length: self.flow(length) for length in np.unique(np.round(np.diff(times), 12))}
        nodes = guess
        for _ in range(rounds):
            roots = [_root(self.process_cov(state, length))
                     for state, length in zip(nodes[:-1], np.diff(times), strict=True)]
            nodes, objective = self._solve(times, y, nodes, roots, flows)
        return nodes, objective

    def _solve(self, times, y, guess, roots, flows):
        n, first = self.total, _root(self.covariance)
        scale = np.maximum(np.abs(guess).max(axis=0), 1e-3)
        variables, start, equal, low = [], [], [], []
        cost = 0.0
        noise = casadi.MX.sym("e0", n)
        variables.append(noise)
        start.append(np.linalg.lstsq(first, guess[0] - self.mean, rcond=None)[0])
        cost += casadi.sumsqr(noise)
        scaled = []
        for k in range(len(times)):
            scaled.append(casadi.MX.sym(f"s{k}", n))
            variables.append(scaled[k])
            start.append(guess[k] / scale)
        state = [scale * s for s in scaled]
        equal.append((state[0] - self.mean - casadi.mtimes(first, noise)) / scale)
        for k, length in enumerate(np.diff(times)):
            noise = casadi.MX.sym(f"e{k + 1}", n)
            variables.append(noise)
            start.append(np.zeros(n))
            cost += casadi.sumsqr(noise)
            flow = flows[np.round(length, 12)]
            equal.append((state[k + 1] - flow(state[k]) - casadi.mtimes(roots[k], noise)) / scale)
        for k in range(len(times)):
            residual = (y[k] - casadi.vertcat(*self.observe(state[k]))) / np.sqrt(self.noise)
            cost += casadi.sumsqr(residual)
            low += [sign * (state[k][index] - bound) / scale[index] for index, sign, bound in self.bounds]
        conditions = casadi.vertcat(*equal, *low)
        problem = {"x": casadi.vertcat(*variables), "f": 0.5 * cost, "g": conditions}
        solver = casadi.nlpsol("solver", "ipopt", problem, {
            "print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-10,
            "ipopt.max_iter": 500})
        count = n * len(equal)
        result = solver(x0=np.concatenate(start), lbg=np.zeros(conditions.shape[0]),
                       ubg=np.concatenate([np.zeros(count), np.full(len(low), np.inf)]))
        assert solver.stats()["success"], solver.stats()["return_status"]
        values = np.asarray(result["x"]).ravel()[n: n * (len(times) + 1)].reshape(len(times), n)
        return values * scale, float(result["f"])


def _root(covariance):
    values, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(np.maximum(values, 0.0))
