"""Random latent force models: every force, several dynamics, links, observations and rules, on awkward times."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import lfm_ppl as lfm
from lfm_ppl.forces import Sum
from lfm_ppl.studies.periodic_kernels.resonators import resonators
from lfm_ppl.studies.periodic_kernels.sparse_spectrum import SparseSpectrum

ROWS = 7
AHEAD = np.array([0.3, 1.0, 2.5, 2.5])
CHANGES = (0.9, 2.1)

TERMS = {
    "none": lambda c, x, u, t: jnp.zeros_like(x),
    "forcing": lambda c, x, u, t: c * jnp.cos(t),
    "sine": lambda c, x, u, t: c * jnp.sin(x),
    "cubic": lambda c, x, u, t: -jnp.abs(c) * x**3,
    "bilinear": lambda c, x, u, t: c * x * u[0],
    "varying rate": lambda c, x, u, t: c * jnp.cos(t) * x,
    "saturation": lambda c, x, u, t: -jnp.abs(c) * x / (1 + x**2),
}
"""What is added to linear dynamics."""

LINKS = {
    "linear": lambda v: v,
    "softplus": jax.nn.softplus,
    "exponential": lambda v: jnp.exp(jnp.minimum(v, 20.0)),
    "square": lambda v: v * v,
    "sigmoid": jax.nn.sigmoid,
}
"""How a force enters the dynamics."""

OUTPUTS = {
    "linear": lambda v: v,
    "sine": lambda v: jnp.sin(v) + 0.3 * v,
    "square": lambda v: v + 0.2 * v**2,
    "arctangent": jnp.arctan,
}
"""How a linear combination of states and forces is observed."""

RULES = (lfm.Taylor(), lfm.Unscented(), lfm.Cubature(), lfm.GaussHermite(3), lfm.CentralDifference())


def _kernel(scale, length, rate):
    return lfm.forces.PeriodicMatern(scale, jnp.clip(length, 0.3, 3.0), 1.0 + rate, order=2)


FORCES = {
    **{f"Matern {order}": lambda s, n, r, order=order: lfm.Matern(s, n, order=order) for order in (0, 1, 2, 3, 5)},
    "squared exponential 4": lambda s, n, r: lfm.SquaredExponential(s, n, order=4),
    "squared exponential 6": lambda s, n, r: lfm.SquaredExponential(s, n, order=6),
    "constant": lambda s, n, r: lfm.Constant(s),
    "Wiener velocity": lambda s, n, r: lfm.WienerVelocity(s, r),
    "random walk": lambda s, n, r: lfm.forces.RandomWalk(s, r),
    "periodic": lambda s, n, r: lfm.Periodic(
        lfm.forces.PeriodicSquaredExponential(s, jnp.clip(n, 0.3, 3.0), 1.0 + r), functions=5),
    "CQM": lambda s, n, r: lfm.QuasiPeriodic(_kernel(s, n, r), lfm.forces.CQM(n), functions=5),
    "Matern weights": lambda s, n, r: lfm.QuasiPeriodic(_kernel(s, n, r), lfm.Matern(1.0, n, order=1), functions=3),
    "SQM": lambda s, n, r: lfm.QuasiPeriodic(_kernel(s, n, r), lfm.forces.SQM(1.0 + r, CHANGES), functions=3),
    "WQM": lambda s, n, r: lfm.QuasiPeriodic(_kernel(s, n, r), lfm.forces.WQM(r, CHANGES), functions=3),
    "resonator": lambda s, n, r: lfm.Resonator(1.0 + r, s, r, 0.1 * r),
    "resonators": lambda s, n, r: resonators(_kernel(s, n, r), functions=3, noise=0.1 * r, damping=0.1),
    "sparse spectrum": lambda s, n, r: SparseSpectrum(s, jnp.array([1.0, 2.3]) * (1 + r)),
    "sum": lambda s, n, r: Sum((lfm.Matern(s, n, order=1), lfm.Constant(r), lfm.Matern(s, r + 0.1, order=0))),
    "sum with CQM": lambda s, n, r: Sum((lfm.Matern(s, n, order=2),
                                         lfm.QuasiPeriodic(_kernel(s, n, r), lfm.forces.CQM(n), functions=3))),
}
"""Name -> force of a scale, a length and a rate."""

_JUMPING = {"SQM", "WQM"}


class Dynamics(eqx.Module):
    """system @ x + coupling @ link(u), and one of `TERMS`."""

    system: Any
    coupling: Any
    strength: Any
    term: str = eqx.field(static=True)
    links: tuple[str, ...] = eqx.field(static=True)

    def __call__(self, x, u, t):
        linked = jnp.stack([LINKS[link](u[index]) for index, link in enumerate(self.links)])
        return self.system @ x + self.coupling @ linked + TERMS[self.term](self.strength, x, u, t)


class Observed(eqx.Module):
    """One of `OUTPUTS` of matrix @ (x, u)."""

    matrix: Any
    output: str = eqx.field(static=True)

    def __call__(self, x, u, t):
        return OUTPUTS[self.output](self.matrix @ jnp.concatenate([x, u]))


class Structure(NamedTuple):
    """What is compiled: everything but the numbers."""

    seed: int
    states: int
    outputs: int
    term: str
    links: tuple[str, ...]
    forces: tuple[str, ...]
    output: str
    rule: Any
    process_noise: bool
    steps: int

    @property
    def linear(self) -> bool:
        return self.term in ("none", "forcing") and {*self.links, self.output} == {"linear"}

    @property
    def jumps(self) -> bool:
        return bool(_JUMPING & set(self.forces))


class Series(NamedTuple):
    """Numbers of one model, and data that it need not have made."""

    parameters: dict[str, Any]
    times: Any
    y: Any


def structure(seed: int) -> Structure:
    """Draw a structure; seeds in a row go through all forces."""
    generator = np.random.default_rng(1000 + seed)
    count = int(generator.choice([1, 2, 3], p=[0.5, 0.35, 0.15]))
    names = np.random.default_rng(3).permutation(list(FORCES))
    forces = [names[seed % len(names)], *generator.choice(names, count - 1)]
    linear = generator.random() < 0.45

    def any_of(choices):
        return str(generator.choice(list(choices)))

    return Structure(
        seed, states=int(generator.integers(1, 5)), outputs=int(generator.integers(1, 3)),
        term=any_of(["none", "forcing"] if linear else TERMS),
        links=tuple("linear" if linear else any_of(LINKS) for _ in forces), forces=tuple(map(str, forces)),
        output="linear" if linear or generator.random() < 0.5 else any_of(OUTPUTS),
        rule=RULES[generator.integers(len(RULES))], process_noise=bool(generator.random() < 0.35),
        steps=int(generator.integers(2, 5)))


def series(spec: Structure, generator: np.random.Generator) -> Series:
    """Draw numbers over several orders of magnitude, and times with replicates and, now and then, a long gap."""
    states, forces, outputs = spec.states, len(spec.forces), spec.outputs
    parameters = {
        "system": 0.5 * generator.normal(size=(states, states)) - generator.uniform(0.3, 1.5) * np.eye(states),
        "coupling": generator.normal(size=(states, forces)),
        "strength": 0.7 * generator.normal(size=states),
        "matrix": generator.normal(size=(outputs, states + forces)),
        "scale": 10 ** generator.uniform(-1.0, 0.5, forces),
        "length": 10 ** generator.uniform(-1.5, 1.5, forces),
        "rate": generator.uniform(0.05, 1.0, forces),
        "noise": 10 ** generator.uniform(-8.0, 0.0, outputs),
        "variance": np.where(generator.random(states) < 0.3, 0.0, 10 ** generator.uniform(-2.0, 1.0, states)),
        "mean": generator.normal(size=states),
        "dispersion": 0.3 * generator.random(states),
    }
    gaps = 10 ** generator.uniform(-2.0, 0.3, ROWS)
    gaps[generator.random(ROWS) < 0.25] = 0.0
    if generator.random() < 0.3:
        gaps[generator.integers(1, ROWS)] = 10 ** generator.uniform(1.5, 4.0)
    times = np.cumsum(gaps)
    times[-1] = max(times[-1], 3.0)
    y = generator.normal(size=(ROWS, outputs))
    y[generator.random(y.shape) < 0.2] = np.nan
    y[0, 0] = 0.0
    return Series(parameters, times, y)


def batch(spec: Structure, count: int) -> Series:
    """Draw ``count`` series side by side; times are shared where forces jump, which need them known."""
    generator = np.random.default_rng(77 + spec.seed)
    members = [series(spec, generator) for _ in range(count)]
    if spec.jumps:
        members = [single._replace(times=members[0].times) for single in members]
    return jax.tree_util.tree_map(lambda *leaves: np.stack(leaves), *members)


def build(spec: Structure, parameters: dict[str, Any]) -> lfm.LatentForceModel:
    """Return the model; its parameters may be traced."""
    p = {name: jnp.asarray(value) for name, value in parameters.items()}
    forces = {f"{index} {name}": FORCES[name](p["scale"][index], p["length"][index], p["rate"][index])
              for index, name in enumerate(spec.forces)}
    return lfm.LatentForceModel(
        Dynamics(p["system"], p["coupling"], p["strength"], spec.term, spec.links), forces,
        lfm.GaussianObservation(Observed(p["matrix"], spec.output), p["noise"]),
        lfm.Gaussian(p["mean"], jnp.diag(p["variance"])),
        process_noise=jnp.diag(p["dispersion"]) if spec.process_noise else None, initial_time=0.0)
