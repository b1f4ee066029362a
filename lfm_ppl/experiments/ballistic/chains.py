"""The posterior of a few targets by NUTS and RAM, which the weighted draws of all targets must agree with."""

from __future__ import annotations

from typing import Any

from numpyro.infer import MCMC, init_to_uniform

from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments import chains
from lfm_ppl.experiments.ballistic import problem
from lfm_ppl.inference.kernels.ram import RAM

SAMPLERS = ("NUTS", "RAM")


def tasks(settings: Any) -> list[Task]:
    """Return one task for each target and sampler."""
    found = []
    for index in range(min(settings.runs, settings.chain_runs)):
        for sampler in SAMPLERS:
            count, warmup, draws, thin = getattr(settings, sampler.lower())
            found.append(Task(f"chains/{sampler}/{index:04d}", settings.seed, {
                "experiment": "ballistic", "what": "chains", "sampler": sampler, "index": index, "chains": count,
                "warmup": warmup, "draws": draws, "thin": thin}))
    return found


def compute(task: Task) -> Result:
    """Return ``draws`` of z (3, chains, draws), their diagnostics, ``divergences`` and CPU ``seconds``."""
    settings, target = task.settings, problem.target(task.settings["index"], task.seed)
    strategy = init_to_uniform(radius=1.0)  # chains start apart, or R-hat would say nothing
    if settings["sampler"] == "RAM":
        kernel: Any = RAM(problem.model(), init_strategy=strategy)
    else:
        kernel = chains.nuts(problem.model(), init_strategy=strategy)
    thin = settings["thin"]
    mcmc = MCMC(kernel, num_warmup=settings["warmup"] * thin, num_samples=settings["draws"] * thin, thinning=thin,
                num_chains=settings["chains"], progress_bar=False,
                chain_method="vectorized" if settings["sampler"] == "RAM" else "sequential")
    return chains.sample(mcmc, problem.NAMES, task.key, target.times, target.y)
