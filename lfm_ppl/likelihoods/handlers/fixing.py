"""Fix parameters of a NumPyro model: a whole site, or single elements of a vector site.

1. Names such as ``decay[CDKN1A]`` are split into site and element; labels are positions, or names of outputs.
2. A whole site is conditioned on, as by ``numpyro.handlers.condition``.
3. Otherwise the site keeps its name and shape, and its distribution is conditioned on the fixed elements (`pinned`).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from numpy.typing import ArrayLike

from lfm_ppl.likelihoods.handlers.likelihood_handler import Handler
from lfm_ppl.likelihoods.handlers.pinned import Pinned, elementwise
from lfm_ppl.likelihoods.priors import support as in_words
from lfm_ppl.utils import checks

_ELEMENT = re.compile(r"^(?P<site>[^\[\]]+)\[(?P<label>[^\[\]]+)\]$")


class fix(Handler):  # noqa: N801 (an effect handler, named as NumPyro names its handlers)
    """Effect handler that fixes parameters.

    Args:
        numpyro_model: the NumPyro model.
        fixed: name -> value. ``decay`` fixes the whole site (a number is repeated to its shape);
            ``decay[CDKN1A]`` or ``decay[2]`` fixes one element of a vector site, by label or by
            index from zero.
        labels: the names of the elements of every vector site of this length, as a rule the names
            of the outputs.

    Raises:
        ValueError: when the model runs, for a site, a label or an index that does not exist (with
            the nearest names), a value outside the support, and a site whose elements cannot be
            fixed one by one.

    Example:
        >>> import jax, numpyro
        >>> def model():
        ...     return numpyro.sample("decay", dist.LogNormal(0.0, 1.0).expand([3]).to_event(1))
        >>> fixed = fix(model, {"decay[b]": 0.8}, labels=("a", "b", "c"))
        >>> decay = numpyro.handlers.seed(fixed, jax.random.key(0))()
        >>> f"{decay[1]:.1f}"
        '0.8'
    """

    def __init__(
        self,
        numpyro_model: Callable[..., Any] | None = None,
        fixed: Mapping[str, ArrayLike] | None = None,
        labels: Sequence[str] = (),
    ) -> None:
        self.whole, self.elements = _split(fixed or {})
        self.labels = tuple(labels)
        self.sites: dict[str, bool] = {}
        super().__init__(numpyro_model)

    def begin(self) -> None:
        """Forget the sites of the run before."""
        self.sites = {}

    def complaint(self) -> str:
        """Return what is wrong with a name that the model never sampled."""
        free = [name for name, observed in self.sites.items() if not observed]
        missing = [name for name in (*self.whole, *self.elements) if name not in free]
        return checks.unknown("parameter to fix", missing[0], free) if missing else ""

    def process_message(self, msg: dict[str, Any]) -> None:
        """Condition a site that is fixed as a whole, pin the elements of the others."""
        if msg["type"] != "sample":
            return
        name = msg["name"]
        self.sites[name] = msg["is_observed"]
        if msg["is_observed"]:
            return
        if name in self.whole:
            shape = msg["fn"].batch_shape + msg["fn"].event_shape
            value = _broadcast(name, self.whole[name], shape)
            _check_support(name, msg["fn"].support, value)
            msg["value"] = value
            msg["is_observed"] = True
        elif name in self.elements:
            msg["fn"] = pin(name, msg["fn"], self.elements[name], self.labels)


def pin(
    name: str, base: dist.Distribution, elements: Mapping[str, float], labels: Sequence[str] = ()
) -> Pinned:
    """Return ``base`` given that some of its elements have known values.

    Args:
        name: what to call the site in an error.
        base: a distribution over a vector, as batch or as event, whose support is elementwise.
        elements: label or index (from zero, as text) -> value.
        labels: the names of the elements, used where their number is that of the elements.

    Returns:
        The conditional distribution, up to its constant.

    Raises:
        ValueError: see :class:`fix`.
    """
    shape = base.batch_shape + base.event_shape
    if len(shape) != 1:
        raise ValueError(
            f"{name} has shape {shape}; single elements can be fixed of a vector only. "
            f"Fix it as a whole, as in {name}=VALUE."
        )
    elementwise(name, base.support)
    element_labels = [str(label) for label in labels] if len(labels) == shape[0] else []
    element_labels = element_labels or [str(index) for index in range(shape[0])]
    indices = {_index(name, label, element_labels): value for label, value in elements.items()}
    order = sorted(indices)
    pinned = Pinned(base, tuple(order), jnp.array([float(indices[i]) for i in order]),
                    tuple(element_labels[index] for index in order))
    _check_support(name, base.support, pinned.insert(base.support.feasible_like(jnp.zeros(shape))))
    return pinned


def _split(fixed: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, dict[str, float]]]:
    """Sort ``fixed`` into whole sites and single elements."""
    sites: dict[str, Any] = {}
    elements: dict[str, dict[str, float]] = {}
    for name, value in fixed.items():
        match = _ELEMENT.match(name)
        if match:
            elements.setdefault(match["site"], {})[match["label"].strip()] = value
        else:
            sites[name] = value
    duplicates = sorted(set(sites) & set(elements))
    if duplicates:
        raise ValueError(f"{duplicates[0]} is fixed as a whole and by element; give one of the two.")
    return sites, elements


def _index(name: str, label: str, labels: list[str]) -> int:
    if label in labels:
        return labels.index(label)
    if re.fullmatch(r"\d+", label) and int(label) < len(labels):
        return int(label)
    raise ValueError(checks.unknown(f"element of {name}", label, labels))


def _broadcast(name: str, value: Any, shape: tuple[int, ...]) -> jax.Array:
    value = jnp.asarray(value, dtype=float)
    if value.shape != shape and value.size not in (1, math.prod(shape)):
        raise ValueError(
            f"{name} has shape {shape}, got a value of shape {value.shape} to fix it at."
        )
    return jnp.broadcast_to(value, shape) if value.size == 1 else value.reshape(shape)


def _check_support(name: str, support: Any, value: jax.Array) -> None:
    """Raise ValueError unless ``value`` lies in ``support``; traced bounds are left to the log density."""
    is_inside = checks.concrete(support(value))
    if is_inside is not None and not np.all(is_inside):
        raise ValueError(
            f"{name} cannot be fixed at {np.asarray(value)}: its prior allows {in_words(support)}."
        )
