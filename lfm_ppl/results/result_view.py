"""What is read of a result: groups, settings, labels, units, known inputs and truth, each looked up once.

1. `ResultView.of` takes the groups of an ArviZ object as xarray datasets: an ``InferenceData`` of ArviZ 0.23, or an
   ``xarray.DataTree`` of ArviZ 1.x.
2. What several readers need of the groups is computed when it is first asked for, and kept.
3. Figures, tables, scores, the report and the accuracy check read a result through a view. A view does not change, nor
   does it see groups that are added to the result later.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import xarray as xr

from lfm_ppl.io.input_table import InputTable
from lfm_ppl.results import inputs
from lfm_ppl.results.scalars import scalar_draws, scalar_truth, unit_of

ENTRY = "observation"
"""Dimension of the observed entries, with the coordinates time, output and series, in the groups that ArviZ reads."""

DIMENSIONS = (ENTRY, "chain", "draw", "time", "output", "state", "force", "deterministic",
              "statistic", "parameter")
"""Dimensions of a result besides that of the series of a panel."""

LIKELIHOODS = "likelihood_sites"
"""Attribute of a result with several likelihood sites: name -> its attributes that differ between sites, as JSON."""

SELECTED_SERIES = "selected_series"
"""Attribute of a selected series: what `lfm_ppl.results.series.panel_of` needs besides its groups, as JSON."""

SELECTED_SITE = "selected_site"
"""Attribute of a selected site: its name and the settings of all sites, as JSON."""

_HOW_TO_GET = {
    "posterior": "lfm.fit",
    "sample_stats": "lfm.fit",
    "log_likelihood": "lfm.fit",
    "log_prior": "lfm.fit",
    "one_step_ahead": "lfm.fit",
    "posterior_predictive": "lfm.fit",
    "trajectories": "lfm.fit with trajectory_draws above zero",
    "predictions": "lfm.forecast(result, model, times), or lfm.fit with `at`",
    "data": "lfm.fit",
    "observed_data": "lfm.fit",
    "accuracy": "lfm.check_accuracy, or `lfm-ppl check`",
    "truth": "lfm.fit on data that were simulated and carry their truth (lfm.Data.truth)",
}


@dataclass(frozen=True, eq=False)
class ResultView:
    """Groups and attributes of a result, and what follows from them.

    Attributes:
        groups: name -> dataset.
        attrs: attributes of the result as a whole: model, rule, seed, versions...
    """

    groups: Mapping[str, xr.Dataset]
    attrs: Mapping[str, Any]

    @classmethod
    def of(cls, result: Any) -> ResultView:
        """Return the view of an ArviZ object; a view itself is returned as it is.

        Raises:
            TypeError: ``result`` is no ArviZ object.

        Example:
            >>> draws = xr.Dataset({"decay": (("chain", "draw"), np.ones((4, 9)))})
            >>> view = ResultView.of(xr.DataTree.from_dict({"/posterior": draws}))
            >>> list(view.groups), view.posterior["decay"].sizes["draw"]
            (['posterior'], 9)
        """
        if isinstance(result, cls):
            return result
        if isinstance(result, xr.DataTree):
            groups = {str(name): node.to_dataset() for name, node in result.children.items()}
        elif hasattr(result, "groups") and callable(result.groups):
            groups = {name: result[name] for name in result.groups()}
        else:
            raise TypeError(f"result must be what lfm.fit or lfm.load returned, got {type(result).__name__}.")
        return cls(groups, {str(name): value for name, value in result.attrs.items()})

    def with_groups(self, groups: Mapping[str, xr.Dataset], attrs: Mapping[str, Any] | None = None) -> ResultView:
        """Return a view of these groups, without those that hold no variables; attributes stay where None is given."""
        return ResultView({name: dataset for name, dataset in groups.items() if dataset.data_vars},
                          self.attrs if attrs is None else attrs)

    def group(self, name: str) -> xr.Dataset:
        """Return a group as a dataset.

        Raises:
            ValueError: there is no such group; the message says how to get it.
        """
        if name in self.groups:
            return self.groups[name]
        if any(f"{name}_{site.replace('/', '.')}" in self.groups for site in self.likelihood_sites):
            self.refuse_several_sites()
        remedy = f" {name!r} comes from {_HOW_TO_GET[name]}." if name in _HOW_TO_GET else ""
        raise ValueError(f"the result has no group {name!r}; it has {', '.join(self.groups) or 'none'}.{remedy}")

    @property
    def posterior(self) -> xr.Dataset:
        """The draws of the parameters; a ValueError where there are none."""
        return self.group("posterior")

    def decoded(self, name: str) -> Any:
        """Return the value of an attribute that holds JSON; an empty dict where the result does not have it."""
        return json.loads(str(self.attrs.get(name) or "{}"))

    @cached_property
    def likelihood_sites(self) -> dict[str, dict[str, Any]]:
        """The likelihood sites with their attributes; none where times and data were not by site."""
        return self.decoded(LIKELIHOODS)

    def refuse_several_sites(self) -> None:
        """Raise ValueError for a result with several likelihood sites, of which one has to be selected."""
        if names := list(self.likelihood_sites):
            raise ValueError(f"the result has the likelihood sites {', '.join(names)}, and this takes one; select it: "
                             f"lfm.select_series(result, {names[0]!r}).")

    @property
    def is_part(self) -> bool:
        """Whether it is one series of a panel, or one of several likelihood sites."""
        return SELECTED_SERIES in self.attrs or SELECTED_SITE in self.attrs

    @property
    def is_about_mode(self) -> bool:
        """Whether the draws are independent ones of a Laplace approximation, not of chains."""
        return self.attrs.get("sampler") == "map" and "effective_draws" not in self.attrs

    @cached_property
    def series_dimension(self) -> str | None:
        """The dimension of the series of a panel; None where the result is of one series."""
        if "data" not in self.groups or self.likelihood_sites:
            return None
        return next((str(name) for name in self.groups["data"].dims if name not in DIMENSIONS), None)

    @cached_property
    def series_labels(self) -> list[Any]:
        """The labels of the series of a panel, or their positions where it has none; none of one series."""
        dimension = self.series_dimension
        return [] if dimension is None else self.groups["data"][dimension].values.tolist()

    @cached_property
    def inputs(self) -> dict[str, InputTable]:
        """The known inputs that the result was made with, by name."""
        return inputs.from_dataset(self.groups.get(inputs.GROUP, xr.Dataset()))

    @cached_property
    def forecast_inputs(self) -> dict[str, InputTable]:
        """The known inputs of a forecast, by name, where it has some of its own."""
        return inputs.from_dataset(self.groups.get(inputs.FORECAST, xr.Dataset()))

    def input_unit(self, name: str) -> str:
        """Return the unit of a known input, empty where the result does not know it."""
        return unit_of(self.groups[inputs.GROUP][name]) if name in self.inputs else ""

    @cached_property
    def time_unit(self) -> str:
        """The unit of time, empty where the result does not know it."""
        for name, coordinate in (("data", "time"), ("data", "times"), ("trajectories", "time")):
            if name in self.groups and coordinate in self.groups[name].coords:
                if unit := unit_of(self.groups[name][coordinate]):
                    return unit
        return ""

    @property
    def time_origin(self) -> str:
        """The calendar time of t = 0, empty where times are plain numbers."""
        return str(self.attrs.get(inputs.ORIGIN, ""))

    @property
    def clock(self) -> tuple[str | None, str]:
        """The calendar time of t = 0 and the unit that times count, for `calendar_time.in_messages`."""
        return self.time_origin or None, self.time_unit

    @cached_property
    def draws(self) -> dict[str, np.ndarray]:
        """The draws (chain, draw) of each scalar parameter, by label such as ``decay[CDKN1A]``."""
        return scalar_draws(self.posterior)

    @cached_property
    def truth(self) -> dict[str, float]:
        """The true values of scalar parameters, by label; empty where none are known."""
        return scalar_truth(self.posterior, self.groups["truth"]) if "truth" in self.groups else {}

    @cached_property
    def units(self) -> dict[str, str]:
        """The unit of each scalar parameter, by label; empty where it is not known."""
        return {label: unit_of(variable, label.partition("[")[2].removesuffix("]"))
                for name, variable in self.posterior.data_vars.items()
                for label in scalar_draws(self.posterior[[name]])}

    @property
    def divergences(self) -> np.ndarray:
        """Which draws (chain, draw) ended a divergent transition."""
        if "diverging" in (stats := self.groups.get("sample_stats", xr.Dataset())):
            return stats["diverging"].transpose("chain", "draw", ...).values.astype(bool)
        return np.zeros((self.posterior.sizes["chain"], self.posterior.sizes["draw"]), bool)

    def trajectory_names(self, kind: str) -> list[str]:
        """Return the names of the forces, states, deterministics or outputs that there are trajectories of."""
        trajectories = self.groups.get("trajectories", xr.Dataset())
        return [str(name) for name in trajectories[kind].values] if kind in trajectories.dims else []
