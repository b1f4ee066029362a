"""Parameters whose posterior contradicts the prior: wrong units, doses or models show here first."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from lfm_ppl.likelihoods.priors import central_interval


def prior_conflicts(trace: Mapping[str, Any], medians: Mapping[str, np.ndarray]) -> list[str]:
    """Return a message on the parameters whose posterior median lies outside of the central 99% of the prior.

    A prior that depends on other parameters is that at their posterior medians. Parameters in a plate are left out:
    among many of them some lie far out.

    Args:
        trace: NumPyro's trace of the model at the posterior medians.
        medians: site name -> posterior median.
    """
    conflicts = []
    for name, median in medians.items():
        site = trace.get(name)
        interval = None if site is None or site["cond_indep_stack"] else central_interval(site["fn"])
        if interval is None:
            continue
        low, high = (np.broadcast_to(end, median.shape) for end in interval)
        for index in np.argwhere((median < low) | (median > high)):
            entry = tuple(index)
            label = name + "".join(f"[{number}]" for number in entry)
            conflicts.append(f"{label} (median {median[entry]:.3g}, prior {low[entry]:.3g} to {high[entry]:.3g})")
    if not conflicts:
        return []
    return [f"the posterior lies outside of the central 99% of the prior: {', '.join(conflicts)}. Check the units, the "
            "number and the sum of the doses, and the prior."]
