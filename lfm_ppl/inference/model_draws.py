"""A bound model at draws of its parameters: what accuracy checks, forecasts and rebuilt results compute with."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.inference.draw_batches import BatchStore
from lfm_ppl.likelihoods.series_likelihood import SeriesLikelihood


@dataclass(frozen=True)
class ModelDraws:
    """A bound model, and draws of its parameters.

    Attributes:
        bound: the model with its times and data.
        draws: site name -> (S, ...).
        stores: function from the name of a computation to the store of its batches; None: no stores.
    """

    bound: BoundModel
    draws: Mapping[str, np.ndarray]
    stores: Callable[[str], BatchStore] | None = None

    def batch_store(self, name: str) -> BatchStore | None:
        """Return the store of the batches of a computation."""
        return None if self.stores is None else self.stores(name)

    @property
    def example(self) -> SeriesLikelihood:
        """The likelihood of one series at parameters from the prior; of several sites, the first that is not exact."""
        examples = [bound.site.example for bound in self.bound.site_models.values()]
        return next((example for example in examples if not example.ssm.has_exact_likelihood), examples[0])

    @property
    def y(self) -> np.ndarray:
        """The data, (T, D), or (B, T, D) for a panel."""
        return np.asarray(self.bound.y)

    @property
    def sites(self) -> dict[str, ModelDraws]:
        """The same draws with one likelihood site selected, by name of the site."""
        if not self.bound.is_by_site:
            return {self.bound.site.name: self}
        return {name: replace(self, bound=bound).rename_stores(suffix=f" of site {name}")
                for name, bound in self.bound.site_models.items()}

    @property
    def size(self) -> int:
        """S, the number of draws."""
        return len(next(iter(self.draws.values())))

    @property
    def series(self) -> int:
        """Number of series."""
        return len(self.bound.site.members)

    def select(self, rows: Any) -> ModelDraws:
        """Return the same model with some of the draws."""
        return replace(self, draws={name: value[rows] for name, value in self.draws.items()})

    def rename_stores(self, prefix: str = "", suffix: str = "") -> ModelDraws:
        """Return the same draws, whose computations are stored under other names."""
        stores = self.stores
        return self if stores is None else replace(self, stores=lambda name: stores(f"{prefix}{name}{suffix}"))
