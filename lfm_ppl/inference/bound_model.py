"""A NumPyro model with its times bound: one log density, compiled once, whatever the data."""

from __future__ import annotations

import re
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import jaxpr_as_fun
from jax.flatten_util import ravel_pytree
from numpyro import handlers
from numpyro.distributions import biject_to
from numpyro.infer import init_to_median, init_to_sample
from numpyro.infer.util import constrain_fn, potential_energy
from numpyro.infer.util import log_density as constrained_log_density

from lfm_ppl import checks
from lfm_ppl.filtering.filter import FilterResult, check_observations
from lfm_ppl.filtering.smoother import SmootherResult
from lfm_ppl.inference.fingerprint import Recording, portable, record, signature
from lfm_ppl.inference.handlers.fixing import fix
from lfm_ppl.inference.handlers.likelihood_handler import LikelihoodHandler
from lfm_ppl.inference.handlers.settings import approximate
from lfm_ppl.inference.marginal_likelihood import MarginalLikelihood, Panel
from lfm_ppl.inference.optimise import Objective, value_and_gradient
from lfm_ppl.inference.random_keys import split_keys
from lfm_ppl.inference.unconstrained import check_latent, coordinate_names, latent_sites

FORWARD_MODE_LIMIT = 10
"""Most unconstrained parameters for which forward-mode gradients are the faster ones."""

_ATTEMPTS = 20
"""Points that are drawn before the search for one of finite density is given up."""

_MOST_PROGRAMS = 8
"""Models whose compiled programs are kept for the next data set."""

_MOST_COMPILED = 64
"""Functions that are kept of one model, such as smoothers with different requested times."""

_COMPILED = (init_to_median, init_to_sample)
"""Strategies that are functions of a site alone."""

_NAMED_TWICE = re.compile("unique names but got `(.*)` duplicated")
"""What NumPyro asserts of a model with two sites of one name."""

_lock = threading.RLock()
"""Held while programs are looked up and made, so that threads share them.

NumPyro's stack of handlers is one for all threads: a function that runs the model, as each does when it is called for
the first time, must not do so in two threads at once."""


class LikelihoodSite(NamedTuple):
    """The likelihood site of a NumPyro model.

    Attributes:
        name: of the site.
        distribution: the `MarginalLikelihood` or the panel.
        observed: what it was given, (T, D) or (B, T, D); None where that differs from data set to data set.
    """

    name: str
    distribution: MarginalLikelihood | Panel
    observed: Any = None

    @property
    def example(self) -> MarginalLikelihood:
        """The distribution of one series."""
        if isinstance(self.distribution, Panel):
            return self.distribution.first
        return self.distribution


def likelihood_site(model: Callable, arguments: tuple, keywords: Mapping[str, Any], key: jax.Array,
                    parameters: Mapping[str, Any] | None = None) -> LikelihoodSite:
    """Run a NumPyro model and return its one likelihood site.

    Raises:
        ValueError: the model has no such site, or several.
    """
    seeded = handlers.seed(handlers.substitute(model, data=dict(parameters or {})), key)
    return _only(_likelihoods(handlers.trace(seeded).get_trace(*arguments, **keywords)))


def _likelihoods(trace: Mapping[str, Any]) -> list[LikelihoodSite]:
    """Return the likelihood sites of a trace."""
    found = []
    for name, site in trace.items():
        distribution = site.get("fn")
        # Masks and expansions wrap the distribution.
        while hasattr(distribution, "base_dist") and not isinstance(distribution, (MarginalLikelihood, Panel)):
            distribution = distribution.base_dist
        if isinstance(distribution, (MarginalLikelihood, Panel)):
            found.append(LikelihoodSite(name, distribution, site["value"]))
    return found


def _only(found: list[LikelihoodSite]) -> LikelihoodSite:
    if len(found) != 1:
        names = ", ".join(site.name for site in found) or "none"
        raise ValueError("the model must have exactly one site numpyro.sample(name, lfm.MarginalLikelihood(...), "
                         f"obs=y) (or lfm.panel); found {names}.")
    return found[0]


class _at_known_times(LikelihoodHandler):  # noqa: N801 (an effect handler, named as NumPyro names its handlers)
    """Gives a likelihood its times as numbers, where the model's own arithmetic made tracers of them."""

    def __init__(self, fn: Callable[..., Any], times: Any) -> None:
        self.times = times
        super().__init__(fn)

    def replacement(self, likelihood: MarginalLikelihood | Panel, site: dict[str, Any]) -> Any:
        """Return the likelihood at times that are known."""
        return likelihood.with_times(self.times) if checks.traced(likelihood.times) else likelihood


class _without_likelihood(LikelihoodHandler):  # noqa: N801 (an effect handler, see above)
    """Leaves the prior alone."""

    def missing(self) -> str:
        """Return what to say of a likelihood that cannot be told from the prior."""
        return "the likelihood stands inside a mask or an expansion, so that the prior cannot be told from it."


class _Program:
    """What data sets of one shape share: the model without its data, and all that was compiled for it.

    Several threads may ask for its functions at once. The first call of each traces the model: make it in one thread.

    Args:
        model: a NumPyro model.
        arguments: its positional arguments; None in the place of the data.
        place: index of the data among them; None: no argument is data, or the model asks the data for values, and they
            are among the arguments.
        keywords: its keyword arguments.
        data: the first data set; an example of its shape for what is traced.
        user: who asks, for messages.
    """

    def __init__(self, model: Callable, arguments: tuple, place: int | None, keywords: Mapping[str, Any], data: Any,
                 user: str):
        self.model, self.arguments, self.place, self.keywords = model, arguments, place, dict(keywords)
        self.key = jax.random.key(0)
        self.fingerprint: Hashable = None  # that of a program which serves other data too
        self.compiled: OrderedDict[Hashable, Any] = OrderedDict()
        self._seeded = handlers.seed(model, self.key)
        self.user = user
        trace = self._trace(data, self.key, init_to_median)
        found = _likelihoods(trace)
        self.given_times = [site.name for site in found if arguments and _are(site.observed, arguments[0])
                            and not _hold(data, arguments[0])]
        self._likelihoods = [site._replace(observed=None) for site in found]
        position = _unconstrained(latent_sites(trace))
        self.sites = tuple(position)
        self.names = coordinate_names(position)
        flat, self.unravel = ravel_pytree(position)
        self.size = int(flat.size)

    def call(self, y: Any) -> tuple:
        """Return the positional arguments with the data in their place."""
        if self.place is None:
            return self.arguments
        return (*self.arguments[:self.place], y, *self.arguments[self.place + 1:])

    def _trace(self, y: Any, key: jax.Array, strategy: Callable) -> dict[str, Any]:
        drawn = handlers.substitute(handlers.seed(self.model, key), substitute_fn=strategy)
        try:
            trace = handlers.trace(drawn).get_trace(*self.call(y), **self.keywords)
        except AssertionError as error:
            if (twice := _NAMED_TWICE.search(str(error))) is None:
                raise
            raise ValueError(f"two sites of the model are called {twice[1]!r}; each numpyro.sample and "
                             "numpyro.deterministic needs a name of its own.") from error
        check_latent(latent_sites(trace), self.user)
        return trace

    @property
    def site(self) -> LikelihoodSite:
        """The likelihood site at the prior's medians."""
        return _only(self._likelihoods)

    def trace(self, y: Any) -> dict[str, Any]:
        """Return NumPyro's trace of the model at the prior's medians."""
        return self._trace(y, self.key, init_to_median)

    def record(self, y: Any) -> Recording:
        """Return what a run of the model with all its parameters and data traced leaves."""
        with jax.ensure_compile_time_eval():  # compiled code may be the first to ask
            return record(lambda z, y: potential_energy(self._seeded, self.call(y), self.keywords, self.unravel(z)),
                          self.size, y)

    def portable(self, y: Any) -> str:
        """Return a digest of what the model computes."""
        return portable(lambda z, y: potential_energy(self._seeded, self.call(y), self.keywords, self.unravel(z)),
                        self.size, y)

    def draw(self, y: Any, key: jax.Array, strategy: Callable) -> jax.Array:
        """Return unconstrained values of the latent sites, (d,), by a NumPyro strategy."""
        def run(key: jax.Array, y: Any) -> jax.Array:
            return ravel_pytree(_unconstrained(latent_sites(self._trace(y, key, strategy))))[0]

        if strategy not in _COMPILED or self.place is None or checks.traced(y):
            return run(key, y)
        # Many data sets of one shape are drawn for; a run of the model takes longer than all else that a draw needs.
        return self.once(("draw", strategy), lambda: jax.jit(run))(key, y)

    def prepared(self, wrap: Callable[[Callable], Callable] | None, times: Any) -> Callable:
        model = self._seeded if times is None else _at_known_times(self._seeded, times)
        return model if wrap is None else wrap(model)

    def potential(self, z: jax.Array, y: Any, times: Any, wrap: Callable[[Callable], Callable] | None = None) -> Any:
        """Return minus the log density of the unconstrained parameters, Jacobian included."""
        return potential_energy(self.prepared(wrap, times), self.call(y), self.keywords, self.unravel(z))

    def constrained_potential(self, z: jax.Array, y: Any, times: Any) -> jax.Array:
        """Return minus the log density of the constrained parameters, without the Jacobian."""
        model = self.prepared(None, times)
        values = constrain_fn(model, self.call(y), self.keywords, self.unravel(z))
        return -constrained_log_density(model, self.call(y), self.keywords, values)[0]

    def constrain(self, z: jax.Array, y: Any) -> dict[str, jax.Array]:
        """Return the values of the latent and of the deterministic sites."""
        return constrain_fn(self._seeded, self.call(y), self.keywords, self.unravel(z), return_deterministic=True)

    def once(self, name: Hashable, make: Callable[[], Any]) -> Any:
        """Return what ``make`` returned when the name was first asked for; the latest of them are kept."""
        with _lock:
            if name in self.compiled:
                self.compiled.move_to_end(name)
                return self.compiled[name]
            made = self.compiled[name] = make()
            while len(self.compiled) > _MOST_COMPILED:
                self.compiled.popitem(last=False)
            return made


_programs: OrderedDict[Hashable, _Program] = OrderedDict()


class BoundModel:
    r"""A NumPyro model with its times bound: its log density as a function of one vector, and of the data.

    With unconstrained parameters z in R^d, theta = T(z),

        log_density(z) = log p(y | T(z)) + log p(T(z)) + log |dT/dz|.

    The model is traced once. Times are held as numbers and decide what is compiled; the data are an ARGUMENT of the
    compiled functions, so that another data set of the same shape compiles nothing, and many data sets are a vmap.
    Everything in the library that needs a posterior stands on this class. Made by `lfm_ppl.bind`.

    Every method of z and y can be traced (``jax.jit``, ``jax.grad``, ``jax.vmap``); z is a vector (d,) in the order of
    ``names``, and ``y`` is by default the data that were bound.

    Attributes:
        y: the data.
        names: of the d unconstrained coordinates: sites sorted by name, elements in C order.
        size: d.
        sites: names of the latent sites.
    """

    def __init__(self, program: _Program, y: Any) -> None:
        self._program, self.y = program, y
        self._trace: dict[str, Any] | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the unconstrained coordinates."""
        return self._program.names

    @property
    def size(self) -> int:
        """Number of unconstrained coordinates."""
        return self._program.size

    @property
    def sites(self) -> tuple[str, ...]:
        """Names of the latent sites."""
        return self._program.sites

    @property
    def times(self) -> np.ndarray:
        """Times of the observations, (T,), or (B, T) for a panel whose series have times of their own."""
        return np.asarray(self._program.arguments[0], float)

    @property
    def given_times(self) -> list[str]:
        """Names of likelihood sites that observe the times in the place of the data."""
        return self._program.given_times

    @property
    def model(self) -> Callable:
        """The NumPyro model."""
        return self._program.model

    @property
    def fingerprint(self) -> str | None:
        """Equal for models that compute the same, in every process; None where it cannot be told.

        That is where the model asks its data for values.
        """
        if self._program.place is None:
            return None
        return self._program.once("fingerprint", lambda: self._program.portable(self.y))

    @property
    def forward_mode(self) -> bool:
        """Whether gradients are taken in forward mode, which is faster for up to ten parameters."""
        return self.size <= FORWARD_MODE_LIMIT

    @property
    def site(self) -> LikelihoodSite:
        """The likelihood site, at the prior's medians; its times, settings and names are those of every draw.

        Raises:
            ValueError: the model has no such site, or several.
        """
        return self._program.site

    @property
    def has_likelihood(self) -> bool:
        """Whether the model has one likelihood site: a filter."""
        try:
            return self.site is not None
        except ValueError:
            return False

    @property
    def _known_times(self) -> Any:
        """Times of the likelihood site as numbers; None for a model without one, or whose times differ."""
        def find() -> Any:
            if not self.has_likelihood:
                return None
            recording = self._program.once("recording", lambda: self._program.record(self.y))
            return None if recording.times_follow else self.site.distribution.times

        return self._program.once("times", find)

    def __repr__(self) -> str:
        """Return the model's name and its parameters."""
        name = getattr(self._program.model, "__name__", type(self._program.model).__name__)
        return f"BoundModel({name}: {', '.join(self.names)})"

    def with_data(self, y: Any) -> BoundModel:
        """Return the same model bound to other data of the same shape; nothing is compiled again.

        Raises:
            ValueError: another shape; an infinite entry.
        """
        program = self._program
        y = self._checked(y)
        if program.place is None:
            return BoundModel(_Program(program.model, (*program.arguments[:-1], y), None, program.keywords, y,
                                       program.user), y)
        return BoundModel(program, y)

    def data(self, y: Any = None) -> Any:
        """Return the data that a function of this model is given: ``y``, or those that were bound.

        Raises:
            ValueError: another shape, an infinite entry; the model asks its data for values.
        """
        if y is None or y is self.y:
            return self.y
        if self._program.place is None:
            raise ValueError("the model asks its data for values, so that they cannot be an argument of compiled code; "
                             "bind it to these data, bound.with_data(y).")
        return self._checked(y)

    @property
    def argument(self) -> Any:
        """What compiled functions get as their data: the data, or None where these are a part of the model."""
        return None if self._program.place is None else self.y

    def _argument(self, y: Any) -> Any:
        data = self.data(y)  # which raises where the data are a part of the model, and others are given
        return None if self._program.place is None else data

    def _checked(self, y: Any) -> Any:
        if _shapes(y) != _shapes(self.y):
            raise ValueError(f"y must have the shape that was bound, {_shapes(self.y)}, got {_shapes(y)}; bind the "
                             "model again.")
        y = jax.tree_util.tree_map(lambda new, old: jnp.asarray(checks.unmask(new), jnp.result_type(old)), y, self.y)
        for leaf in jax.tree_util.tree_leaves(y):
            if (known := checks.concrete(leaf)) is not None and np.isinf(known).any():
                raise ValueError("y has infinite entries; use NaN for a missing entry.")
        return y

    def _position(self, z: Any) -> jax.Array:
        if np.shape(z) != (self.size,):
            raise ValueError(f"z must have shape ({self.size},), one entry for each of {', '.join(self.names)}; got "
                             f"{np.shape(z)}.")
        return jnp.asarray(z, float)

    # --- densities

    def log_density(self, z: Any, y: Any = None) -> jax.Array:
        """Return the log density of the unconstrained parameters, Jacobian included; -inf where a filter breaks down.

        Args:
            z: (d,).
            y: data of the shape that was bound; None: the data that were.
        """
        program, times = self._program, self._known_times
        run = program.once("log density", lambda: _traced_once(
            lambda z, y: -program.potential(z, y, times), jnp.zeros(self.size), self.argument))
        return run(self._position(z), self._argument(y))

    def log_density_gradient(self, z: Any, y: Any = None) -> tuple[jax.Array, jax.Array]:
        """Return the log density and its gradient (d,); arguments as `log_density`."""
        return self.gradient(self.forward_mode)(self._position(z), self._argument(y))

    def gradient(self, forward_mode: bool, jacobian: bool = True) -> Any:
        """Return the compiled function from z and y to the log density and its gradient, by either mode."""
        target = self._target(jacobian)
        example = jnp.zeros(self.size), self.argument
        return self._program.once(("gradient", jacobian, forward_mode),
                                  lambda: _traced_once(value_and_gradient(target, forward_mode), *example))

    def log_likelihood(self, z: Any, y: Any = None) -> jax.Array:
        """Return log p(y | T(z)), summed over the series of a panel; arguments as `log_density`."""
        def log_likelihood(z: jax.Array, y: Any) -> jax.Array:
            site = self._site_at(z, y)
            return site.distribution.log_prob(site.observed).sum()

        run = self._program.once("log likelihood", lambda: jax.jit(log_likelihood))
        return run(self._position(z), self._argument(y))

    def log_prior(self, z: Any, y: Any = None) -> jax.Array:
        """Return the log prior density of the unconstrained parameters, Jacobian included."""
        program, times = self._program, self._known_times
        run = program.once("log prior", lambda: jax.jit(
            lambda z, y: -program.potential(z, y, times, _without_likelihood)))
        return run(self._position(z), self._argument(y))

    def objective(self, jacobian: bool = True, forward_mode: bool | None = None,
                  exact_hessian: bool = False) -> Objective:
        """Return MINUS the log density as the objective of a search for its mode.

        Args:
            jacobian: whether it is the density of the unconstrained parameters, or that of the constrained ones.
            forward_mode: how derivatives are taken; None: the faster way.
            exact_hessian: differentiate twice, instead of taking differences of the gradient.
        """
        program, target = self._program, self._target(jacobian)
        forward = self.forward_mode if forward_mode is None else forward_mode
        # The same programs as of `log_density_gradient`, and the sign changed outside of them.
        both = self.gradient(forward, jacobian)

        def minus(z: Any) -> tuple[Any, Any]:
            value, gradient = both(jnp.asarray(z, float), self.argument)
            return -value, -gradient

        hessian = None
        if exact_hessian:
            inner = jax.jacfwd if forward else jax.jacrev
            twice = program.once(("hessian", jacobian, forward), lambda: jax.jit(jax.jacfwd(inner(target))))
            hessian = lambda z: -twice(jnp.asarray(z, float), self.argument)  # noqa: E731
        return Objective(minus, hessian)

    def _target(self, jacobian: bool) -> Callable[[jax.Array, Any], jax.Array]:
        if jacobian:
            return lambda z, y: self.log_density(z, y if self._program.place is not None else None)
        program, times = self._program, self._known_times
        return program.once("constrained log density",
                            lambda: jax.jit(lambda z, y: -program.constrained_potential(z, y, times)))

    def log_density_with(self, handler: Callable[[Callable], Callable], z: Any, y: Any = None) -> jax.Array:
        """Return the log density with another likelihood in the place of the filter's; not compiled by itself.

        Args:
            handler: maps a NumPyro model to one with another likelihood; see `LikelihoodHandler`.
            z: (d,).
            y: as in `log_density`.
        """
        return -self._program.potential(jnp.asarray(z, float), self.data(y), self._known_times, handler)

    # --- parameters

    def unravel(self, z: Any) -> dict[str, jax.Array]:
        """Return the unconstrained values of each site: what ``init_params`` of ``MCMC.run`` takes."""
        return self._program.unravel(jnp.asarray(z, float))

    def constrain(self, z: Any, y: Any = None) -> dict[str, jax.Array]:
        """Return site name -> value of the latent and the deterministic sites at z (d,)."""
        program = self._program
        return program.once("constrain", lambda: jax.jit(program.constrain))(self._position(z), self._argument(y))

    def constrain_draws(self, z: Any) -> dict[str, np.ndarray]:
        """Return site name -> values (..., *shape) at draws z (..., d)."""
        program, lead = self._program, np.shape(z)[:-1]
        constrain = program.once("constrain draws", lambda: jax.jit(jax.vmap(program.constrain, in_axes=(0, None))))
        sites = constrain(jnp.asarray(z, float).reshape(-1, self.size), self.argument)
        return {name: np.asarray(value).reshape(*lead, *value.shape[1:]) for name, value in sites.items()}

    def unconstrain(self, values: Mapping[str, Any]) -> jax.Array:
        """Return z (d,) where every latent site has its value.

        Args:
            values: site name -> value in the support of its prior.

        Raises:
            ValueError: an unknown site, or one without a value; a shape that is not the site's.
        """
        for name in values:
            if name not in self.sites:
                raise ValueError(checks.unknown("site in values", name, self.sites))
        for name in self.sites:
            if name not in values:
                raise ValueError(f"values has no value of {name!r}; it needs one for each of {', '.join(self.sites)}.")
        program = self._program
        given = handlers.substitute(program.prepared(None, None),
                                    data={name: jnp.asarray(value, float) for name, value in values.items()})
        trace = latent_sites(handlers.trace(given).get_trace(*program.call(self.y), **program.keywords))
        for name, site in trace.items():
            expected = tuple(site["fn"].batch_shape) + tuple(site["fn"].event_shape)
            if np.shape(values[name]) != expected:
                raise ValueError(f"the value of {name!r} must have shape {expected}, got {np.shape(values[name])}.")
        z = ravel_pytree(_unconstrained(trace))[0]
        if (known := checks.concrete(z)) is not None and not np.isfinite(known).all():
            wrong = self.names[int(np.argmin(np.isfinite(known)))]
            raise ValueError(f"values lie outside of the support of the prior, or at its edge, at {wrong!r}.")
        return z

    def draw(self, key: jax.Array, strategy: Callable = init_to_median) -> np.ndarray:
        """Return a point z (d,) by a NumPyro initialisation strategy."""
        return np.asarray(self._program.draw(self.y, key, strategy), float)

    def start(self, key: jax.Array, strategy: Callable = init_to_median, attempts: int = _ATTEMPTS,
              evaluate: Callable[[np.ndarray], Any] | None = None) -> np.ndarray:
        """Return a point z (d,) by a NumPyro strategy at which everything that ``evaluate`` gives is finite.

        Args:
            key: a JAX random key.
            strategy: such as ``init_to_median``.
            attempts: points that are drawn before the search is given up.
            evaluate: of z; None: the log density and its gradient.

        Raises:
            ValueError: there is none among so many attempts.
        """
        keys = split_keys(key, attempts)
        for attempt in range(attempts):
            z = self.draw(keys(attempt), strategy)
            found = jax.tree_util.tree_leaves((evaluate or self.log_density_gradient)(z))
            if all(np.all(np.isfinite(one)) for one in found):
                return z
        raise ValueError(f"found no point of finite density to start from in {attempts} attempts. Give a starting "
                         "point, or check the model: its log density or the gradient of it is not finite.")

    def trace(self) -> dict[str, Any]:
        """Return NumPyro's trace of the model at the prior medians: its sites with their priors, plates and values."""
        if self._trace is not None:
            return self._trace
        with jax.ensure_compile_time_eval():  # compiled code may be the first to ask
            trace = self._program.trace(self.y)
        if not checks.traced(self.y):
            self._trace = trace
        return trace

    # --- the filter and the smoother

    def likelihood(self, z: Any, y: Any = None) -> MarginalLikelihood | Panel:
        """Return the likelihood under parameters, in compiled code too.

        Args:
            z: (d,), or site name -> value.
            y: as in `log_density`; the likelihood itself does not hold data.
        """
        return self._site_at(z, self.data(y)).distribution

    def _site_at(self, z: Any, y: Any) -> LikelihoodSite:
        """Return the likelihood site under parameters, with what it observes of the data."""
        program = self._program
        values = z if isinstance(z, Mapping) else program.constrain(jnp.asarray(z, float), y)
        values = {name: values[name] for name in self.sites if name in values}
        found = likelihood_site(program.model, program.call(y), program.keywords, program.key, values)
        if self._known_times is not None and checks.traced(found.distribution.times):
            found = found._replace(distribution=found.distribution.with_times(self._known_times))
        return found

    def filter(self, z: Any, y: Any = None) -> FilterResult:
        """Return what the Gaussian filter says at parameters z (d,), or site name -> value; see `lfm_ppl.filter`.

        Raises:
            ValueError: the model is a panel, whose series are filtered one by one.
        """
        self._check_single("filter")
        run = self._program.once("filter", lambda: eqx.filter_jit(lambda z, y: self._run(z, y, "filter")))
        return run(_arrays(z), self._argument(y))

    def smooth(self, z: Any, at: Any = None, y: Any = None) -> SmootherResult:
        """Return what the smoother says at parameters z (d,), or site name -> value; see `lfm_ppl.smooth`.

        Args:
            z: (d,), or site name -> value.
            at: (K,) times; None: those of the data.
            y: as in `log_density`.

        Raises:
            ValueError: the model is a panel, whose series are smoothed one by one.
        """
        self._check_single("smooth")
        checks.refuse_dates("at", at)
        at = None if at is None else np.atleast_1d(np.asarray(at, float))
        run = self._program.once(("smooth", signature(at)), lambda: eqx.filter_jit(
            lambda z, y: self._run(z, y, "smooth", at)))
        return run(_arrays(z), self._argument(y))

    def _run(self, z: Any, y: Any, what: str, *settings: Any) -> Any:
        site = self._site_at(z, y)
        return getattr(site.distribution, what)(site.observed, *settings)

    def _check_single(self, name: str) -> None:
        if isinstance(self.site.distribution, Panel):
            raise ValueError(f"{name} takes one series; of a panel use bound.likelihood(z).series(index).")

    # --- the same data under another model

    def fix(self, values: Mapping[str, Any] | None) -> BoundModel:
        """Return the model with parameters fixed; see `lfm_ppl.fix`, with the outputs as labels."""
        if not values:
            return self
        labels = self.site.example.ssm.model.output_names
        return self._changed(("fixed", signature(dict(values))), lambda model: fix(model, values, labels=labels))

    def approximate(self, **settings: Any) -> BoundModel:
        """Return the model with other settings of its likelihood, such as ``steps``."""
        return self._changed(("settings", signature(settings)), lambda model: approximate(model, **settings))

    def _changed(self, name: tuple[str, Hashable], change: Callable[[Callable], Callable]) -> BoundModel:
        program = self._program
        make = lambda: _Program(change(program.model), program.arguments, program.place,  # noqa: E731
                                program.keywords, self.y, program.user)
        with jax.ensure_compile_time_eval():  # compiled code may be the first to ask
            passing = name[1] is None or checks.traced(self.y)
            return BoundModel(make() if passing else program.once(name, make), self.y)

    def compiled(self, name: Hashable, make: Callable[[], Callable]) -> Callable:
        """Return a function that was made for this model under this name, for any data; made when first asked for.

        Args:
            name: everything that the function depends on besides the model and its arguments.
            make: makes it; the data must be an argument of the function.
        """
        return self._program.once(name, make)


def bind(model: Callable, times: Any, y: Any, **keywords: Any) -> BoundModel:
    """Bind a NumPyro model to its times and data: its log posterior as a plain function, for any sampler.

    Args:
        model: ``model(times, y=None, **keywords)`` with one site ``numpyro.sample(name, lfm.MarginalLikelihood(...),
            obs=y)``, or a `lfm_ppl.panel` in a plate.
        times: (T,), or (B, T) for a panel.
        y: (T, D), or (B, T, D) for a panel; NaN where missing. A tracer within compiled code.
        **keywords: further arguments of the model; they decide what is compiled.

    Returns:
        The bound model, with ``log_density``, ``log_density_gradient``, ``constrain``, ``unconstrain``, ``names``,
        ``filter`` and ``smooth``. A model that was bound before with times, keywords and a shape of data that are equal
        is not compiled again, unless what it computes has changed, because it reads a variable that has.

    Raises:
        ValueError, TypeError: wrong shapes, times that are not known, a discrete parameter or none at all, no or
            several likelihood sites.

    Example:
        >>> import jax, jax.numpy as jnp, numpy as np, numpyro, numpyro.distributions as dist, lfm_ppl as lfm
        >>> def model(times, y=None):
        ...     rate = numpyro.sample("rate", dist.LogNormal(0.0, 0.5))
        ...     system = lfm.LatentForceModel(
        ...         lambda x, u, t: u - rate * x, {"u": lfm.Matern(1.0, 1.0)},
        ...         lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])),
        ...         lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
        ...     numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)
        >>> times = np.arange(5.0)
        >>> bound = lfm.bind(model, times, np.sin(times)[:, None])
        >>> z = bound.unconstrain({"rate": 1.0})
        >>> bound.names, z.tolist(), float(bound.constrain(z)["rate"])
        (('rate',), [0.0], 1.0)

        Many data sets side by side:

        >>> sets = jnp.stack([bound.y, 2 * bound.y])
        >>> jax.vmap(bound.log_density, in_axes=(None, 0))(z, sets).shape
        (2,)

        blackjax's NUTS:

        >>> import blackjax
        >>> nuts = blackjax.nuts(bound.log_density, step_size=0.5, inverse_mass_matrix=jnp.ones(bound.size))
        >>> state, info = jax.jit(nuts.step)(jax.random.key(0), nuts.init(z))
        >>> state.position.shape
        (1,)

        A posterior mode by optax:

        >>> import optax
        >>> optimiser = optax.adam(0.1)
        >>> state = optimiser.init(z)
        >>> for _ in range(100):
        ...     value, gradient = bound.log_density_gradient(z)
        ...     updates, state = optimiser.update(-gradient, state)
        ...     z = optax.apply_updates(z, updates)
        >>> bool(jnp.abs(bound.log_density_gradient(z)[1]).max() < 0.1)
        True
    """
    if not callable(model):
        raise TypeError(f"model must be a NumPyro model, a function of times and y, got {type(model).__name__}.")
    if checks.traced(times):
        raise TypeError("times decide what is compiled, so they must be numbers, but they are traced; bind the model "
                        "outside of jit, and pass only y into it.")
    if y is None:
        raise ValueError("y must be the observations, (T, D) or (B, T, D) for a panel, got None.")
    checks.refuse_dates("times", times)
    times = np.array(checks.unmask(times), float)
    given = jnp.asarray(checks.unmask(y), float)
    y = given[:, None] if given.ndim == times.ndim == 1 else given
    bound = bind_arguments(model, (times, y), keywords)
    if bound.site.name in bound.sites:
        raise ValueError(f"the model does not use the data: its likelihood site {bound.site.name!r} is not observed. "
                         f"Write numpyro.sample({bound.site.name!r}, ..., obs=y), with the argument y of the model.")
    if bound.given_times:
        raise ValueError(f"the likelihood site {bound.given_times[0]!r} observes the times, not the data. Write "
                         f"numpyro.sample({bound.given_times[0]!r}, ..., obs=y), with the argument y of the model.")
    distribution = bound.site.distribution
    if isinstance(distribution, Panel):
        distribution.checked(given)
    else:
        rows, outputs = distribution.event_shape
        check_observations(given, rows, outputs, model=distribution.model)
    return bound


def bind_arguments(model: Callable, arguments: tuple, keywords: Mapping[str, Any],
                   user: str = "lfm.bind") -> BoundModel:
    """Bind any NumPyro model to its arguments, of which the last is its data where it is made of arrays of numbers.

    Args:
        model: a NumPyro model whose latent sites are continuous.
        arguments: its positional arguments. The data may be an array, or a pytree of arrays: whatever differs between
            data sets, such as measurements with the values that are known of each series.
        keywords: its keyword arguments.
        user: who asks, for messages.
    """
    place = len(arguments) - 1 if arguments and _numeric(arguments[-1]) else None
    data = None if place is None else _as_data(arguments[place])
    static = tuple(None if index == place else value for index, value in enumerate(arguments))
    key = signature((model, static, dict(keywords), jax.tree_util.tree_map(lambda leaf: (leaf.shape, str(leaf.dtype)),
                                                                           data)))
    kept = key is not None and not checks.traced(data)  # what is made of tracers must not outlive them
    with _lock, jax.ensure_compile_time_eval():  # compiled code may be the first to bind the model
        program = _programs.pop(key, None) if kept else None
        if program is None or not _unchanged(program, data):
            program = _made(model, arguments, place, keywords, data, user)
        if kept and program.fingerprint is not None:
            _programs[key] = program
            while len(_programs) > _MOST_PROGRAMS:
                _programs.popitem(last=False)
    return BoundModel(program, data)


_REFUSALS = (TypeError, ValueError, IndexError, AttributeError)
"""What is raised by code that asks a tracer for its value: JAX's errors for Python branches, NumPy functions and masks,
attributes that NumPy's arrays alone have, and errors of this library, for times that are data and must be known."""


def _unchanged(program: _Program, data: Any) -> bool:
    """Whether a model, the same function as before, still computes what it did."""
    try:
        return program.record(data).fingerprint == program.fingerprint
    except _REFUSALS:  # of a variable that the model reads; what is wrong with it is told where it is made anew
        return False


def _made(model: Callable, arguments: tuple, place: int | None, keywords: Mapping[str, Any], data: Any,
          user: str) -> _Program:
    """Return a program in two runs of the model, one with numbers and one with tracers."""
    static = tuple(None if index == place else value for index, value in enumerate(arguments))
    try:
        program = _Program(model, static, place, keywords, data, user)
        program.fingerprint = program.once("recording", lambda: program.record(data)).fingerprint
    except _REFUSALS:
        # The model asks its last argument for values, which therefore is part of it; an error of its own is told now.
        return _Program(model, arguments, None, keywords, data, user)
    return program


def _unconstrained(sites: Mapping[str, Any]) -> dict[str, jax.Array]:
    return {name: biject_to(site["fn"].support).inv(site["value"]) for name, site in sites.items()}


def _traced_once(function: Callable, *example: Any) -> Callable:
    """Return the compiled function, traced now: once also where chains run in parallel, on a mesh of devices."""
    traced, shape = jax.make_jaxpr(function, return_shape=True)(*example)
    run, structure = jaxpr_as_fun(traced), jax.tree_util.tree_structure(shape)
    return jax.jit(lambda *arguments: jax.tree_util.tree_unflatten(
        structure, run(*jax.tree_util.tree_leaves(arguments))))


def _arrays(z: Any) -> Any:
    return jax.tree_util.tree_map(lambda leaf: jnp.asarray(leaf, float), z)


def _are(observed: Any, times: Any) -> bool:
    """Return whether what a site observes are the times, known numbers, whatever their shape."""
    if not all(isinstance(value, (np.ndarray, jax.Array)) and not checks.traced(value) for value in (observed, times)):
        return False
    return np.size(observed) == np.size(times) > 1 and np.array_equal(np.ravel(observed), np.ravel(times))


def _hold(data: Any, times: Any) -> bool:
    """Return whether a column of the data holds the times, so that observing them may be meant; True if not known."""
    if checks.traced(data):
        return True
    columns = [np.moveaxis(np.atleast_1d(leaf), -1, 0) for leaf in jax.tree_util.tree_leaves(data)]
    return any(_are(np.asarray(one), times) for leaf in columns for one in (leaf, *leaf))


def _numeric(value: Any) -> bool:
    """Return whether an argument may be data: a pytree whose leaves are all arrays of real numbers."""
    leaves = jax.tree_util.tree_leaves(value)
    return bool(leaves) and all(isinstance(leaf, (np.ndarray, jax.Array)) and jnp.issubdtype(leaf.dtype, jnp.floating)
                                for leaf in leaves)


def _as_data(y: Any) -> Any:
    """Return the data as arrays; whole numbers stay so, for models that are not of this library."""
    return jax.tree_util.tree_map(lambda leaf: jnp.asarray(checks.unmask(leaf)), y)


def _shapes(y: Any) -> Any:
    """Return the data with their shapes in the place of arrays."""
    return jax.tree_util.tree_map(np.shape, y)
