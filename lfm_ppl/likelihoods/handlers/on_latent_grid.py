"""The forces of a NumPyro model as latent sites: what samplers without a filter work on."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from numpy.typing import ArrayLike
from numpyro.distributions import constraints

from lfm_ppl.latent_grid.latent_grid import QUADRATURES, LatentGrid
from lfm_ppl.likelihoods.handlers.likelihood_handler import LikelihoodHandler
from lfm_ppl.likelihoods.likelihood import Likelihood
from lfm_ppl.likelihoods.panel import Panel
from lfm_ppl.likelihoods.series_likelihood import repeat_draw
from lfm_ppl.utils import checks


class GridLikelihood(dist.Distribution):
    """Distribution of the observations given the forces on a grid.

    Args:
        latent: the grid.
        u: (R, G), forces.
        start: (M,), state at the initial time.
    """

    support = constraints.real_matrix
    pytree_data_fields = ("latent", "u", "start")

    def __init__(self, latent: LatentGrid, u: jax.Array, start: jax.Array) -> None:
        self.latent, self.u, self.start = latent, u, start
        super().__init__((), (len(latent.times), latent.ssm.output_dim), validate_args=False)

    def log_prob(self, value: Any) -> jax.Array:
        """Return log p(value | u, start)."""
        return self.latent.log_likelihood(self.u, jnp.asarray(checks.unmask(value), float), self.start)

    def sample(self, key: jax.Array, sample_shape: tuple[int, ...] = ()) -> jax.Array:
        """Draw observations given the forces: (*sample_shape, T, D)."""
        return repeat_draw(lambda k: self.latent.observe(k, self.u, self.start), key, sample_shape)


class on_latent_grid(LikelihoodHandler):  # noqa: N801 (an effect handler, named as NumPyro names its handlers)
    """Effect handler that keeps the forces of a model as latent sites on a grid, in place of filtering them out.

    A site ``y`` with ``lfm.MarginalLikelihood`` becomes: ``y_white`` (R, G), independent standard normal; ``y_start``
    (M,) likewise, for the initial state, on which nothing depends where that is known; ``y_forces`` (R, G),
    deterministic; and ``y`` given these. The posterior of all other sites is that of the model itself, without a
    Gaussian filter's approximation and up to the quadrature's error, but in hundreds of dimensions. Use it with
    `numpyro.infer.MCMC`; `lfm_ppl.EllipticalSlice` works on it where all other sites are conditioned on.

    Args:
        numpyro_model: a NumPyro model with a site ``lfm.MarginalLikelihood``.
        points: number of points, or the grid; as in `lfm_ppl.LatentGrid`.
        quadrature: "riemann", "trapezoid" or "linear".

    Raises:
        ValueError: what `lfm_ppl.LatentGrid` raises; no such site; a panel.

    Example:
        >>> import jax, jax.numpy as jnp, numpyro, lfm_ppl as lfm
        >>> def model(times, y=None):
        ...     system = lfm.LatentForceModel(
        ...         lambda x, u, t: jnp.exp(u) - x, {"u": lfm.Matern(1.0, 2.0, order=1)},
        ...         lfm.GaussianObservation(lambda x, u, t: x, sd=0.1),
        ...         lfm.Gaussian(jnp.zeros(1), jnp.zeros(1)))
        ...     numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)
        >>> latent = lfm.on_latent_grid(model, points=21)
        >>> seeded = numpyro.handlers.seed(latent, 0)
        >>> trace = numpyro.handlers.trace(seeded).get_trace(jnp.arange(3.0), jnp.ones((3, 1)))
        >>> trace["y_forces"]["value"].shape
        (1, 21)
    """

    supports_all_likelihoods = False

    def __init__(self, numpyro_model: Callable[..., Any] | None = None, points: ArrayLike = 363,
                 quadrature: str = "linear") -> None:
        checks.one_of("quadrature", quadrature, QUADRATURES)
        self.points, self.quadrature = points, quadrature
        super().__init__(numpyro_model)

    def missing(self) -> str:
        """Return the error of a model without forces that could be put on a grid."""
        return ("the model has no site numpyro.sample(name, lfm.MarginalLikelihood(...), obs=y) without constraints, "
                "mask, expand or plate, whose forces could be put on a grid.")

    def replacement(self, likelihood: Likelihood, site: dict[str, Any]) -> GridLikelihood:
        """Sample the forces, and return the distribution of the observations given them."""
        if isinstance(likelihood, Panel):
            raise ValueError(f"the site {site['name']!r} is a panel; put one series at a time on a grid.")
        if checks.traced(likelihood.times):
            raise ValueError("times must be known when the grid is built, but they are traced; run with "
                             "jit_model_args=False.")
        name = site["name"]
        if site["is_observed"] and np.shape(site["value"]) != likelihood.event_shape:
            raise ValueError(f"the observations of {name!r} must have shape (T, D) = {likelihood.event_shape}, "
                             f"got {np.shape(site['value'])}.")
        latent = LatentGrid(likelihood.model, likelihood.times, self.points, self.quadrature)
        shape = latent.mean.shape
        u = latent.force(numpyro.sample(f"{name}_white", dist.Normal().expand(shape).to_event(2)))
        numpyro.deterministic(f"{name}_forces", u)
        # Also where the initial state is known: in compiled code nobody can tell, and the sites must be the same ones.
        white = numpyro.sample(f"{name}_start", dist.Normal().expand([latent.ssm.physical_dim]).to_event(1))
        return GridLikelihood(latent, u, latent.start(white))
