"""A NumPyro model with its times and data bound: its log posterior as a plain function, compiled once.

1. `bind` checks times and data and runs the model (`lfm_ppl.inference.unbound_model`), which gives a `Problem`: data,
   times, known inputs and time grids.
2. Methods of `BoundModel` are functions of z and a problem, traced when first called and kept by name. Models of one
   structure have programs of one text, which are compiled once (`lfm_ppl.utils.programs`).
3. What a model needs the values of is a constant of its programs: it belongs to the structure of the problem.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike
from numpyro.infer import init_to_median, init_to_sample

from lfm_ppl.filtering.breakdown import warn_of_iterations
from lfm_ppl.filtering.filter import FilterResult
from lfm_ppl.filtering.iterated import Anchor
from lfm_ppl.filtering.smoother import SmootherResult
from lfm_ppl.filtering.stiffness import ExplicitSteps, long_step_message, warn_of_message
from lfm_ppl.inference.optimise import Objective, value_and_gradient
from lfm_ppl.inference.problem import Partition, Problem, signature
from lfm_ppl.inference.unbound_model import Programs, UnboundModel, model_and_problems
from lfm_ppl.likelihoods.handlers.approximate import approximate
from lfm_ppl.likelihoods.handlers.binding import remove_likelihood
from lfm_ppl.likelihoods.handlers.fixing import fix
from lfm_ppl.likelihoods.likelihood import Likelihood
from lfm_ppl.likelihoods.likelihood_site import LikelihoodSite, likelihood_sites, single_site
from lfm_ppl.likelihoods.marginal_likelihood import MarginalLikelihood
from lfm_ppl.likelihoods.panel import Panel
from lfm_ppl.utils import checks
from lfm_ppl.utils.programs import Program
from lfm_ppl.utils.random_keys import split_keys

_FORWARD_MODE_LIMIT = 3
"""Largest number of unconstrained parameters for which forward-mode gradients are faster."""

_SITEWISE_STRATEGIES = (init_to_median, init_to_sample)
"""Initialisation strategies that depend on a site alone, so that they can be compiled."""

_LARGEST_CHANGE_OF_ANCHOR = 1e-6
"""Change of the means of an anchor in its last iteration, in standard deviations, above which it has not settled."""

_PROBE_DISTANCE = 0.1
"""Distance of the second probe from the prior medians, in each unconstrained coordinate."""

_ATTEMPTS = 20
"""Points that are drawn in the search for one of finite density."""


class StartError(ValueError):
    """No point of finite density was found to start from."""


class BoundModel:
    r"""A NumPyro model with its times bound: its log density as a function of one vector and of the data.

    With unconstrained parameters z in R^d, theta = T(z),

        log_density(z) = log p(y | T(z)) + log p(T(z)) + log |dT/dz|.

    Data are arguments of the compiled functions, and times and real arrays, too, where the model allows it
    (`Problem.has_traced_inputs`). Another data set of the same shape then compiles nothing, and many data sets are a
    `jax.vmap`. Made by `lfm_ppl.bind`, which reads the model function, and each
    method reads it once more at the first call, as `jax.jit` does: where a function that it calls or a variable that it
    reads has changed, bind it again.

    Every method of z and y can be traced (``jax.jit``, ``jax.grad``, ``jax.vmap``); z is a vector (d,) in the order of
    ``names``, and ``y`` defaults to the bound data.

    A model with several likelihood sites has times and data by name of the site. `site_models` holds the same model
    with one site selected. Times, data, ``log_likelihood``, ``likelihood``, ``filter`` and ``smooth`` then belong to
    the site, densities and parameters to the whole model.

    Attributes:
        names: names of the d unconstrained coordinates: sites sorted by name, elements in C order.
        size: d.
        sites: names of the latent sites.
        model: the NumPyro model.
        unbound: the model after its run with numbers, without its data.
        problem: data, times and inputs as the argument of each program.
        model_data: the data of all sites.
        constants: the same with times and inputs as constants, for functions that need their values.
        anchor_point: (d,), unconstrained parameters at whose smoothed moments the iterations start, see `anchored`;
            None: they start from the filter's.
    """

    anchor_point: np.ndarray | None = None

    def __init__(self, unbound: UnboundModel, constants: Problem, problem: Problem, programs: Programs,
                 selected: str | None = None) -> None:
        self.unbound, self.constants, self.problem, self.programs = unbound, constants, problem, programs
        self.names, self.size, self.sites, self.model = unbound.names, unbound.size, unbound.sites, unbound.model
        # One object: data that are constants are built anew by each call of `observations`.
        self.model_data: Any = problem.observations
        self._selected = selected
        self._trace: dict[str, Any] | None = None
        self._kind = problem.kind
        # Shared with the same model of other data or another selected site.
        self._modifications: dict[Hashable, BoundModel] = {}
        self._layouts: dict[Hashable, Partition] = {}

    @classmethod
    def of(cls, model: Callable, arguments: tuple, keywords: Mapping[str, Any], caller: str,
           programs: Programs | None = None, selected: str | None = None) -> BoundModel:
        """Bind a NumPyro model to its arguments, the last of which is its data; see `model_and_problems`."""
        programs = programs or Programs()
        unbound, constants, problem = model_and_problems(model, arguments, keywords, caller, programs)
        # Programs of constants serve no other data set, and end with the bound model.
        bound = cls(unbound, constants, problem, programs if problem.has_traced_inputs else Programs(), selected)
        bound._trace = None if checks.traced(bound.model_data) else unbound.at_medians
        return bound

    @property
    def y(self) -> Any:
        """The data: of all sites, or of the selected site."""
        return self._of_selected(self.model_data)

    def _of_selected(self, data: Any) -> Any:
        return data if self._selected is None else data[self._selected]

    @property
    def is_by_site(self) -> bool:
        """Whether times and data are dictionaries by name of a likelihood site."""
        arguments, _ = self.constants.call()
        times = arguments[0] if arguments else None
        return isinstance(times, Mapping) and set(times) == {site.name for site in self.unbound.likelihoods}

    @property
    def site_models(self) -> dict[str, BoundModel]:
        """The model with one likelihood site selected, by name of the site.

        Raises:
            ValueError: the model has several sites, and times and data are not given by site.
        """
        if not self.is_by_site or self._selected is not None:
            return {self.site.name: self}
        return {name: self._copy(self.constants, self.problem, name) for name in self.constants.call()[0][0]}

    def _copy(self, constants: Problem, problem: Problem, selected: str | None) -> BoundModel:
        """Return the same model with other data or another selected site."""
        bound = BoundModel(self.unbound, constants, problem, self.programs, selected)
        bound._modifications, bound._layouts = self._modifications, self._layouts
        bound.anchor_point = self.anchor_point
        return bound

    @property
    def times(self) -> Any:
        """Times of the observations, (T,), or (B, T) for a panel whose series have different times; a dict by site."""
        times = self.constants.call()[0][0]
        if self.is_by_site:
            return times if self._selected is None else times[self._selected]
        return np.asarray(times, float)

    @property
    def forward_mode(self) -> bool:
        """Whether gradients are taken in forward mode, which is faster for few parameters."""
        return self.size <= _FORWARD_MODE_LIMIT

    @property
    def site(self) -> LikelihoodSite:
        """The likelihood site at the prior medians; times, settings and names do not depend on the draw.

        Raises:
            ValueError: the model has no such site, or several.
        """
        site = single_site(self.unbound.likelihoods, self._selected)
        anchor = self.constants.anchors.get(site.name)
        return site if anchor is None else site._replace(distribution=site.distribution.with_about(anchor))

    @property
    def has_likelihood(self) -> bool:
        """Whether the model has one likelihood site."""
        return self._selected is not None or len(self.unbound.likelihoods) == 1

    def __repr__(self) -> str:
        """Return the model's name and its parameters."""
        name = getattr(self.model, "__name__", type(self.model).__name__)
        return f"BoundModel({name}: {', '.join(self.names)})"

    def with_data(self, y: ArrayLike) -> BoundModel:
        """Return the same model bound to other data of the same shape; nothing is compiled again.

        Raises:
            ValueError: another shape; an infinite entry.
        """
        y = self._checked(self._of_all_sites(y))
        if self.problem.data is not None:
            return self._with_checked_data(y)
        arguments, keywords = self.constants.call()
        return BoundModel.of(self.model, (*arguments[:-1], y), keywords, self.unbound.caller, self.programs,
                             self._selected)._anchored_as(self)

    def _with_checked_data(self, y: Any) -> BoundModel:
        """Return the same model with other data that are an argument of its programs."""
        return self._copy(self.constants.with_data(y), self.problem.with_data(y), self._selected)

    def data(self, y: ArrayLike | Mapping[str, Any] | Problem | None = None) -> Any:
        """Return the data: ``y`` after checking it, or the bound data; where a site is selected, the part of the site.

        Raises:
            ValueError: another shape, an infinite entry; the model needs the values of its data.
        """
        return self._of_selected(self.problem_of(y).observations)

    def problem_of(self, y: ArrayLike | Mapping[str, Any] | Problem | None = None) -> Problem:
        """Return the problem with these data, after checking them; a `Problem` as it is."""
        return self._with_data(self.problem, y)

    def _with_data(self, problem: Problem, y: Any) -> Problem:
        if isinstance(y, Problem):
            return y
        y = self._of_all_sites(y)
        if y is None or y is self.model_data:
            return problem
        if problem.data is None:
            raise ValueError("the model needs the values of its data, so that they cannot be an argument of compiled "
                             "code; bind the model to these data, bound.with_data(y).")
        return problem.with_data(self._checked(y))

    def _of_all_sites(self, y: Any) -> Any:
        """Return data of all sites; data of the selected one replace its bound data."""
        is_of_one = self._selected is not None and y is not None and not isinstance(y, Mapping)
        return {**self.model_data, self._selected: y} if is_of_one else y

    def _checked(self, y: Any) -> Any:
        shapes, expected = (jax.tree.map(np.shape, value) for value in (y, self.model_data))
        if shapes != expected:
            raise ValueError(f"y must have the shape that was bound, {expected}, got {shapes}; bind the model again.")
        y = jax.tree.map(lambda new, old: jnp.asarray(checks.unmask(new), jnp.result_type(old)), y,
                         self.model_data)
        for leaf in jax.tree.leaves(y):
            if (values := checks.concrete(leaf)) is not None and np.isinf(values).any():
                raise ValueError("y has infinite entries; use NaN for a missing entry.")
        return y

    def _position(self, z: Any) -> jax.Array:
        if np.shape(z) != (self.size,):
            raise ValueError(f"z must have shape ({self.size},), one entry for each of {', '.join(self.names)}; got "
                             f"{np.shape(z)}.")
        return jnp.asarray(z, float)

    # --- densities

    def log_density(self, z: ArrayLike, y: ArrayLike | None = None) -> jax.Array:
        """Return the log density of the unconstrained parameters, Jacobian included; -inf where a filter breaks down.

        Args:
            z: (d,).
            y: data of the shape that was bound, or a `Problem`, as samplers pass; None: the bound data.
        """
        run = self.program("log density", lambda: Program(self._target(True)))
        return run(self._position(z), self.problem_of(y))

    def log_density_gradient(self, z: ArrayLike, y: ArrayLike | None = None) -> tuple[jax.Array, jax.Array]:
        """Return the log density and its gradient (d,); arguments as `log_density`."""
        return self.gradient(self.forward_mode)(self._position(z), y)

    def gradient(self, forward_mode: bool, jacobian: bool = True) -> Any:
        """Return the compiled function from z and y to the log density and its gradient, by either mode."""
        run = self.program(("gradient", jacobian, forward_mode),
                           lambda: Program(value_and_gradient(self._target(jacobian), forward_mode)))
        return lambda z, y: run(z, self.problem_of(y))

    def log_likelihood(self, z: ArrayLike, y: ArrayLike | None = None) -> jax.Array:
        """Return log p(y | T(z)), summed over all sites and the series of a panel; arguments as `log_density`."""
        def log_likelihood(z: jax.Array, problem: Problem) -> jax.Array:
            sites = [model._site_at(z, problem) for model in self.site_models.values()]
            return jnp.stack([site.distribution.log_prob(site.observed).sum() for site in sites]).sum()

        run = self.program("log likelihood", lambda: Program(log_likelihood))
        return run(self._position(z), self.problem_of(y))

    def log_prior(self, z: ArrayLike, y: ArrayLike | None = None) -> jax.Array:
        """Return the log prior density of the unconstrained parameters, Jacobian included."""
        unbound = self.unbound
        run = self.program("log prior", lambda: Program(
            lambda z, problem: unbound.log_density(z, problem, remove_likelihood)))
        return run(self._position(z), self.problem_of(y))

    def site_log_priors(self, trace: Mapping[str, Any]) -> dict[str, jax.Array]:
        """Return the log prior density of each site, conditional on the sites that it depends on.

        Args:
            trace: the result of `trace_at`.
        """
        densities = {name: trace[name]["fn"].log_prob(trace[name]["value"]).sum() for name in self.sites}
        return {name: density if (scale := trace[name]["scale"]) is None else scale * density
                for name, density in densities.items()}

    def objective(self, jacobian: bool = True, forward_mode: bool | None = None,
                  exact_hessian: bool = False) -> Objective:
        """Return MINUS the log density as the objective of a search for its mode.

        Args:
            jacobian: whether it is the density of the unconstrained parameters, or that of the constrained ones.
            forward_mode: whether derivatives are taken in forward mode; None: the faster mode.
            exact_hessian: differentiate twice instead of taking differences of the gradient.
        """
        is_forward = self.forward_mode if forward_mode is None else forward_mode
        # The sign changes outside, so that the program is that of `log_density_gradient`.
        density_and_gradient = self.gradient(is_forward, jacobian)

        def minus(z: Any) -> tuple[Any, Any]:
            value, gradient = density_and_gradient(jnp.asarray(z, float), self.problem)
            return -np.asarray(value), -np.asarray(gradient)  # no further programs

        if not exact_hessian:
            return Objective(minus)
        first_derivative = jax.jacfwd if is_forward else jax.jacrev
        hessian = self.program(("hessian", jacobian, is_forward),
                               lambda: Program(jax.jacfwd(first_derivative(self._target(jacobian)))))

        def minus_hessian(z: Any) -> Any:
            return -hessian(jnp.asarray(z, float), self.problem)

        return Objective(minus, minus_hessian)

    def _target(self, jacobian: bool) -> Callable[[jax.Array, Any], jax.Array]:
        """Return the log density of unconstrained or of constrained parameters, a function of z and a `Problem`."""
        unbound = self.unbound
        if jacobian:
            return unbound.log_density
        return unbound.constrained_log_density

    def log_density_with(self, handler: Callable[[Callable], Callable], z: ArrayLike,
                         y: ArrayLike | None = None) -> jax.Array:
        """Return the log density with another likelihood instead of the filter's; not compiled.

        Args:
            handler: maps a NumPyro model to one with another likelihood; see `LikelihoodHandler`.
            z: (d,).
            y: as in `log_density`.
        """
        return self.unbound.log_density(jnp.asarray(z, float), self._with_data(self.constants, y), handler)

    # --- parameters

    def unravel(self, z: ArrayLike) -> dict[str, jax.Array]:
        """Return the unconstrained values of each site: the ``init_params`` of ``MCMC.run``."""
        return self.unbound.unravel(jnp.asarray(z, float))

    def constrain(self, z: ArrayLike, y: ArrayLike | None = None) -> dict[str, jax.Array]:
        """Return site name -> value of the latent and the deterministic sites at z (d,)."""
        run = self.program("constrain", lambda: Program(self.unbound.constrain))
        return run(self._position(z), self.problem_of(y))

    def constrain_draws(self, z: ArrayLike) -> dict[str, np.ndarray]:
        """Return site name -> values (..., *shape) at draws z (..., d)."""
        unbound = self.unbound
        run = self.program("constrain draws", lambda: Program(jax.vmap(unbound.constrain, in_axes=(0, None))))
        values = run(jnp.asarray(z, float).reshape(-1, self.size), self.problem)
        return {name: np.asarray(value).reshape(*np.shape(z)[:-1], *value.shape[1:]) for name, value in values.items()}

    def unconstrain(self, values: Mapping[str, Any]) -> jax.Array:
        """Return z (d,) at values of the latent sites.

        Args:
            values: site name -> value in the support of its prior, for every latent site.

        Raises:
            ValueError: an unknown site, or one without a value; a shape that is not the site's.
        """
        for name in values:
            if name not in self.sites:
                raise ValueError(checks.unknown("site in values", name, self.sites))
        for name in self.sites:
            if name not in values:
                raise ValueError(f"values has no value of {name!r}; it needs one for each of {', '.join(self.sites)}.")
        z, trace = self.unbound.unconstrain(values, self.constants)
        for name, site in trace.items():
            expected = tuple(site["fn"].batch_shape) + tuple(site["fn"].event_shape)
            if np.shape(values[name]) != expected:
                raise ValueError(f"the value of {name!r} must have shape {expected}, got {np.shape(values[name])}.")
        if (coordinates := checks.concrete(z)) is not None and not np.isfinite(coordinates).all():
            wrong = self.names[int(np.argmin(np.isfinite(coordinates)))]
            raise ValueError(f"values lie outside of the support of the prior, or at its edge, at {wrong!r}.")
        return z

    def draw(self, key: jax.Array, strategy: Callable = init_to_median) -> np.ndarray:
        """Return a point z (d,) by a NumPyro initialisation strategy."""
        unbound, problem = self.unbound, self.problem
        if strategy not in _SITEWISE_STRATEGIES or problem.data is None or checks.traced(problem):
            return np.asarray(unbound.draw(key, self.constants, strategy), float)
        # With many data sets of one shape, running the model in Python would take longer than everything else.
        run = self.program(("draw", strategy), lambda: Program(
            lambda key, problem: unbound.draw(key, problem, strategy)))
        return np.asarray(run(key, problem), float)

    def probes(self) -> tuple[np.ndarray, np.ndarray]:
        """Return two points z (d,), the prior medians and one beside them; what is equal at both is taken as equal."""
        medians = self.draw(jax.random.key(0))
        return medians, medians + _PROBE_DISTANCE

    def start(self, key: jax.Array, strategy: Callable = init_to_median, attempts: int = _ATTEMPTS,
              evaluate: Callable[[np.ndarray], Any] | None = None) -> np.ndarray:
        """Return a point z (d,) by a NumPyro strategy at which all values of ``evaluate`` are finite.

        Args:
            key: a JAX random key.
            strategy: such as ``init_to_median``.
            attempts: number of points that are tried.
            evaluate: function of z; None: the log density and its gradient.

        Raises:
            StartError: no point has finite values.
        """
        keys = split_keys(key, attempts)
        for attempt in range(attempts):
            z = self.draw(keys(attempt), strategy)
            values = jax.tree.leaves((evaluate or self.log_density_gradient)(z))
            if all(np.all(np.isfinite(value)) for value in values):
                return z
        raise StartError(f"found no point of finite density to start from in {attempts} attempts. Give a starting "
                         "point, or check the model: its log density or the gradient of it is not finite.")

    def trace(self) -> dict[str, Any]:
        """Return NumPyro's trace of the model at the prior medians: its sites with their priors, plates and values."""
        if self._trace is not None:
            return self._trace
        with jax.ensure_compile_time_eval():  # the call may come from compiled code
            trace = self.unbound.trace(self.constants)
        if not checks.traced(self.model_data):
            self._trace = trace
        return trace

    def trace_at(self, values: Mapping[str, Any], y: Any = None) -> dict[str, Any]:
        """Return NumPyro's trace of the model at values of its sites; ``y`` as in `log_density`."""
        return self.unbound.trace_at(values, self._with_data(self.constants, y))

    def site_of(self, trace: Mapping[str, Any]) -> LikelihoodSite:
        """Return the likelihood site of a result of `trace_at`, with its observations."""
        return single_site(likelihood_sites(trace), self._selected)

    # --- the filter and the smoother

    def likelihood(self, z: ArrayLike | Mapping[str, Any],
                   y: ArrayLike | Problem | None = None) -> Likelihood:
        """Return the likelihood at parameters, in compiled code too.

        Args:
            z: (d,), or site name -> value.
            y: as in `log_density`; the likelihood itself does not hold data.
        """
        return self._site_at(z, self._with_data(self.constants, y)).distribution

    def _site_at(self, z: Any, problem: Problem) -> LikelihoodSite:
        """Return the likelihood site at parameters, with its observations."""
        unbound = self.unbound
        values = z if isinstance(z, Mapping) else unbound.constrain(jnp.asarray(z, float), problem)
        return self.site_of(unbound.trace_at({name: values[name] for name in self.sites if name in values}, problem))

    def filter(self, z: ArrayLike | Mapping[str, Any], y: ArrayLike | None = None) -> FilterResult:
        """Return the result of the Gaussian filter at parameters z (d,), or site name -> value; see `lfm_ppl.filter`.

        It is a single pass, also where `log_density` iterates posterior linearisation.

        Raises:
            ValueError: the model is a panel, whose series are filtered one by one.

        Warns:
            FilterWarning: a step is too long for a fast decay, as in `lfm_ppl.filter`.
        """
        self._check_single("filter")

        def run(z: Any, problem: Problem) -> FilterResult:
            site = self._site_at(z, problem)
            return site.distribution.filter(site.observed)

        result = self.program("filter", lambda: Program(run))(_as_arrays(z), self.problem_of(y))
        self._warn_of_long_steps(result.log_likelihood, z, y)
        return result

    def smooth(self, z: ArrayLike | Mapping[str, Any], at: ArrayLike | None = None,
               y: ArrayLike | None = None) -> SmootherResult:
        """Return the result of the smoother at parameters z (d,), or site name -> value; see `lfm_ppl.smooth`.

        Args:
            z: (d,), or site name -> value.
            at: (K,) times; None: the times of the data.
            y: as in `log_density`.

        Raises:
            ValueError: the model is a panel, whose series are smoothed one by one.

        Warns:
            FilterWarning: the iterations have not settled, or a step is too long for a fast decay, as in
                `lfm_ppl.smooth`.
        """
        self._check_single("smooth")
        checks.refuse_dates("at", at)
        result = self._run_at("smooth", lambda site, times: site.distribution.smooth(site.observed, times), z, y, at)
        if isinstance(result, SmootherResult) and not self.site.example.is_family:
            warn_of_iterations(result.change, result.log_likelihood_change)
        self._warn_of_long_steps(result.log_likelihood, z, y, at)
        return result

    def anchor(self, z: ArrayLike | Mapping[str, Any], y: ArrayLike | None = None) -> Anchor:
        """Return the converged smoothed moments at parameters, ``about`` of `lfm_ppl.MarginalLikelihood`.

        Those of the series of a panel have a leading axis (B,), as `lfm_ppl.panel` takes them.

        Args:
            z: (d,), or site name -> value; best the posterior mode.
            y: as in `log_density`.

        Raises:
            ValueError: an observation family, a tolerance, constraints or regimes, which take no such moments.
        """
        if not isinstance(self.site.example, MarginalLikelihood):
            raise ValueError("smoothed moments to start from are for lfm.MarginalLikelihood and lfm.panel, without "
                             "constraints and regimes.")
        return self._run_at("anchor", lambda site, _: site.distribution.mapped(
            lambda series, y: series.anchor(y), site.observed), z, y, None)

    def anchored(self, z: ArrayLike, sites: Collection[str] | None = None) -> BoundModel:
        """Return the same model whose iterations start from the converged smoothed moments at z (d,), see `anchor`.

        They do so where these moments have settled, also for other data and settings. The moments are arguments of all
        programs. A likelihood inside of a mask or an expansion, and one whose known inputs or events are at times that
        depend on the parameters, start from the filter's moments.

        Args:
            z: (d,).
            sites: names of likelihood sites; None: all that take iterations.
        """
        anchors = {name: model.anchor(z) for name, model in self.site_models.items()
                   if (model.site.example.settings.iterations > 0 and model.site.example.is_iterated
                       and self._has_fixed_grid(name) if sites is None else name in sites)}
        finite = {name: anchor for name, anchor in anchors.items()
                  if all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(anchor))
                  and np.max(anchor.change) < _LARGEST_CHANGE_OF_ANCHOR}
        if not finite:
            return self
        return self._with_anchors(finite, np.asarray(z, float))

    def _has_fixed_grid(self, site: str) -> bool:
        """Whether no time of the grid of a likelihood depends on the parameters, as far as that is known."""
        layout = self.problem.grids[site].layout if site in self.problem.grids else None
        is_wrapped = not isinstance(self.unbound.at_medians[site]["fn"], Likelihood)
        return not is_wrapped and not (layout is not None and any(layout.is_lagged + layout.is_event_lagged))

    def with_all_sites(self) -> BoundModel:
        """Return the same model with no likelihood site selected."""
        return self if self._selected is None else self._copy(self.constants, self.problem, None)

    def _anchored_as(self, bound: BoundModel) -> BoundModel:
        """Return the same model whose iterations start from the moments of another one, at sites of the same names."""
        anchors = bound.problem.anchors
        return self._with_anchors(anchors, bound.anchor_point) if anchors else self

    def _with_anchors(self, anchors: Mapping[str, Anchor], point: np.ndarray | None) -> BoundModel:
        """Return the same model with the smoothed moments at a point (d,)."""
        bound = self._copy(self.constants.with_anchors(anchors), self.problem.with_anchors(anchors), self._selected)
        bound.anchor_point = point
        return bound

    def explicit_steps(self, z: Any, y: Any = None, requested_times: Any = None) -> ExplicitSteps:
        """Return what limits the explicit steps of the filter; series of a panel, or regimes, are a leading axis.

        Args:
            z: (d,), or site name -> value.
            y: as in `log_density`.
            requested_times: (K,), of a single series; None: the times of the data.
        """
        def steps(site: LikelihoodSite, times: Any) -> Any:
            return site.distribution.mapped(lambda series, y: series.explicit_steps(y, times), site.observed)

        return self._run_at("explicit steps", steps, z, y, requested_times)

    def _run_at(self, name: str, function: Callable[[LikelihoodSite, Any], Any], z: Any, y: Any,
                requested_times: Any) -> Any:
        """Return a function, compiled, of the likelihood site at z and of requested times (K,) or None."""
        times = None if requested_times is None else np.atleast_1d(np.asarray(requested_times, float))
        problem, requested = self.problem_of(y), self.requested(times)

        def run(z: Any, problem: Problem, requested: Partition) -> Any:
            return function(self._site_at(z, problem), requested.value)

        return self.program(name, lambda: Program(run), problem)(_as_arrays(z), problem, requested)

    def requested(self, times: np.ndarray | None) -> Partition:
        """Return requested times (K,) as an argument of a program: their layout where grids are arguments, too."""
        if times is None or not self.problem.has_traced_inputs:
            return Partition.of_constants(times)
        # The layout runs the model.
        key = self.site.name, times.tobytes()
        if key not in self._layouts:
            with jax.ensure_compile_time_eval():  # the call may come from compiled code
                self._layouts[key] = Partition.of_layout(self.unbound.lay_out(self.site.name, self.constants, times))
        return self._layouts[key]

    def _warn_of_long_steps(self, log_likelihood: Any, z: Any, y: Any, requested_times: Any = None) -> None:
        """Warn where a step is too long for a fast decay; nothing happens in compiled code."""
        if not checks.traced(log_likelihood) and np.isfinite(log_likelihood).all():
            warn_of_message(self.long_step_message(z, y, requested_times))

    def long_step_message(self, z: Any, y: Any = None, requested_times: Any = None,
                          has_method: bool = True) -> str | None:
        """Return a sentence on an explicit step that is too long for a fast decay at z; None where no step is.

        Args:
            z: (d,), or site name -> value, concrete.
            y: as in `log_density`.
            requested_times: as in `explicit_steps`.
            has_method: whether ``method`` is a remedy, if the likelihood has it; not so for particles.
        """
        example = self.site.example
        if not example.has_explicit_steps:
            return None
        explicit = self.explicit_steps(z, y, requested_times)
        return long_step_message(explicit, example.ssm.model.state_names, example.settings.integration_steps,
                                 has_method and "method" in example.accepted, example.regime_names)

    def _check_single(self, name: str) -> None:
        if isinstance(self.site.distribution, Panel):
            raise ValueError(f"{name} takes one series; of a panel use bound.likelihood(z).series(index).")

    # --- the same data under another model

    def fix(self, values: Mapping[str, Any] | None) -> BoundModel:
        """Return the model with fixed parameters; see `lfm_ppl.fix`, with the outputs as labels."""
        if not values:
            return self
        # Elements are named by outputs, which differ between sites.
        labels = () if self.is_by_site else self.site.example.ssm.model.output_names
        return self._modified(("fix", signature(dict(values))), lambda model: fix(model, values, labels=labels))

    def approximate(self, **settings: Any) -> BoundModel:
        """Return the model with other settings of its likelihood, such as ``steps``; only of the selected site."""
        def modify(model: Callable) -> Callable:
            handler = approximate(model, **settings)
            handler.only_site = self._selected
            return handler

        return self._modified(("approximate", signature(settings)), modify)

    def _modified(self, name: tuple[str, Hashable], modify: Callable[[Callable], Callable]) -> BoundModel:
        key = self._selected, *name
        if (modified := self._modifications.get(key)) is not None:
            if modified.model_data is not self.model_data:
                modified = modified._with_checked_data(self.model_data)
            return modified._anchored_as(self)
        programs = Programs() if name[1] is None else self.programs.of_modified(key)
        modified = BoundModel.of(modify(self.model), *self.constants.call(), self.unbound.caller, programs,
                                 self._selected)
        if name[1] is not None and modified.problem.data is not None and not checks.traced(self.problem):
            self._modifications[key] = modified
        return modified._anchored_as(self)

    def program(self, name: Hashable, make: Callable[[], Any], problem: Problem | None = None) -> Any:
        """Return the function of this name, made at the first call for problems of this structure and these shapes.

        Args:
            name: everything that the function depends on besides the model and its arguments.
            make: returns the function, which takes a problem as an argument.
            problem: that problem; None: `problem`.
        """
        key = self._selected, name, self._kind if problem is None or problem is self.problem else problem.kind
        if key not in self.programs.by_name:
            self.programs.by_name[key] = make()
        return self.programs.by_name[key]


def _as_arrays(z: Any) -> Any:
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, float), z)
