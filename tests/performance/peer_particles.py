"""The double well in the `particles` package: prints seconds for a scheme. It needs NumPy 1, so it runs alone.

    python peer_particles.py srk 40000 25 100
"""

import sys
import time

import numpy as np
import particles
from particles import distributions, state_space_models

SCHEME, PARTICLES, OBSERVATIONS, STEPS = sys.argv[1], *map(int, sys.argv[2:])
H, SIGMA = 2.0 / STEPS, 2.0


def drift(x):
    return x - 0.1 * x * x * x


class Transition(distributions.ProbDist):
    """The state at the next observation, drawn in substeps."""

    def __init__(self, x):
        self.x = x

    def rvs(self, size=None):
        x = self.x
        for _ in range(STEPS):
            change = np.sqrt(H) * np.random.standard_normal(x.shape)
            if SCHEME == "euler":
                x = x + H * drift(x) + SIGMA * change
                continue
            mean = 0.5 * change + np.sqrt(H / 12) * np.random.standard_normal(x.shape)
            first = drift(x)
            x = x + H / 3 * (first + 2 * drift(x + 0.75 * H * first + 1.5 * SIGMA * mean)) + SIGMA * change
        return x


class ObservedDoubleWell(state_space_models.StateSpaceModel):
    """dx = (x - 0.1 x^3) dt + 2 dB, observed with noise of standard deviation 0.1."""

    def PX0(self):  # noqa: N802 (names of the package)
        return distributions.Normal(0.0, np.sqrt(10.0))

    def PX(self, t, xp):  # noqa: N802
        return Transition(xp)

    def PY(self, t, xp, x):  # noqa: N802
        return distributions.Normal(x, 0.1)


y = 3.0 * np.sign(np.sin(0.4 * np.arange(OBSERVATIONS) + 0.1))
model = state_space_models.Bootstrap(ssm=ObservedDoubleWell(), data=y)
best = np.inf
for _ in range(3):
    run = particles.SMC(fk=model, N=PARTICLES, resampling="systematic")
    start = time.perf_counter()
    run.run()
    best = min(best, time.perf_counter() - start)
print(best, run.logLt)
