"""The samplers of `lfm_ppl.fit` by name: one list for `fit`, the command line and the check of a result.

Their arguments are in `lfm_ppl.inference.kernels.options`, their algorithms in `lfm_ppl.inference.bound_samplers`, and
their starting points in `lfm_ppl.workflows.fit_starts`.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Sampler:
    """Properties of a sampler.

    Attributes:
        steps_per_draw: steps of one draw, for each parameter; 0: every step is a draw.
        has_gaussian_filter: whether its likelihood is that of the Gaussian filter, not of a particle filter.
    """

    steps_per_draw: int = 0
    has_gaussian_filter: bool = True


# The autocorrelation time of a random walk in d dimensions is proportional to d. A step of particle-marginal RAM takes
# about a hundred times as long as one of RAM, so that it makes fewer: 4,000 draws of the double well with one step for
# each parameter had 350 effective draws.
SAMPLERS = {
    "nuts": Sampler(),
    "ram": Sampler(steps_per_draw=5),
    "pmmh": Sampler(steps_per_draw=2, has_gaussian_filter=False),
    "map": Sampler(),
}
GAUSSIAN_FILTER_SAMPLERS = tuple(name for name, sampler in SAMPLERS.items() if sampler.has_gaussian_filter)
