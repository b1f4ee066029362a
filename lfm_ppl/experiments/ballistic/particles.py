"""The same by a bootstrap particle filter, and by tracing the ancestors of its particles.

Backward simulation, the usual remedy where traced paths meet in few particles, is none here: the state of a Matern-5/2
force hardly has noise over a short step, so that a particle's own ancestor is nearly the only one that it can have.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments.ballistic import problem
from lfm_ppl.experiments.ballistic.tracking import judged, rmse
from lfm_ppl.experiments.timing import timed
from lfm_ppl.particles.particle_filter import particle_filter
from lfm_ppl.particles.particle_smoother import TRACING, particle_smoother

STEPS = 2
"""Runge-Kutta steps between two measurements, of strong order 1.5."""

DRAWS = 4_000
"""Paths that are traced: enough that the error of their mean adds less than a thousandth to the RMSE."""


def tasks(settings: Any) -> list[Task]:
    """Return one task for each target and number of particles."""
    return [Task(f"particles/{count}/{index:04d}", settings.seed,
                 {"experiment": "ballistic", "what": "particles", "particles": count, "index": index, "steps": STEPS,
                  "draws": DRAWS})
            for count in settings.particles for index in range(min(settings.runs, settings.particle_runs))]


def compute(task: Task) -> Result:
    """Return errors, coverage, log likelihood and CPU times of a target, named as in `tracking.compute`.

    ``distinct`` (T,) is the number of different particles that the traced paths pass through.
    """
    target = problem.target(task.settings["index"], task.seed)
    given = problem.true_likelihood().model
    options = {"particles": task.settings["particles"], "steps": task.settings["steps"]}
    keys = jax.random.split(task.key)

    def filtering(key: jax.Array) -> Any:
        return particle_filter(key, given, target.times, target.y, **options)

    def smoothing(key: jax.Array) -> Any:
        return particle_smoother(key, given, target.times, target.y, draws=task.settings["draws"], method=TRACING,
                                 **options)

    if options["particles"] not in _compiled:
        jax.block_until_ready((filtering(keys[0]).mean, smoothing(keys[1]).draws))
        _compiled.add(options["particles"])
    filter_s, filtered = timed(filtering, keys[0])
    smoother_s, smoothed = timed(smoothing, keys[1])
    paths = [smoothed.state("altitude"), smoothed.state("speed"), smoothed.force("u")]
    mean, sd = np.stack([one.mean for one in paths]), np.stack([one.sd for one in paths])
    # A Matern force is the first entry of its own state, which follows altitude and speed.
    return {"filter_rmse": rmse(np.asarray(filtered.mean)[:, :3].T, target),
            "log_likelihood": float(jnp.sum(filtered.log_likelihood)), "filter_seconds": filter_s,
            "smoother_seconds": smoother_s, "distinct": np.asarray(smoothed.distinct), "mean": mean, "sd": sd,
            **judged("smoother", mean, sd, target)}


_compiled: set[int] = set()
