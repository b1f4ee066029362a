"""The samplers of `lfm_ppl.fit` by name: one list for `fit`, the command line and the check of a result.

Their arguments are in `lfm_ppl.inference.kernels.options`, their steps in `lfm_ppl.inference.sampling`, and where their
chains start in `lfm_ppl.fitting`.
"""

from __future__ import annotations

from typing import NamedTuple


class Sampler(NamedTuple):
    """What is asked of a sampler by its name.

    Attributes:
        steps_a_draw: steps for each parameter that make one draw; 0: every step is a draw.
        filtered: whether its posterior is that of the Gaussian filter, and not of a particle filter.
    """

    steps_a_draw: int = 0
    filtered: bool = True


# A random walk in d dimensions forgets in some multiple of d. A step of particle-marginal RAM takes some hundred times
# as long as one of RAM, so that it makes fewer: of the double well, 4,000 draws of one step a parameter were worth 350.
SAMPLERS = {
    "nuts": Sampler(),
    "ram": Sampler(steps_a_draw=5),
    "pmmh": Sampler(steps_a_draw=2, filtered=False),
    "map": Sampler(),
}
FILTERED = tuple(name for name, sampler in SAMPLERS.items() if sampler.filtered)
