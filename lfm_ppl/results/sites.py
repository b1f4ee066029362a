"""Results of models with several likelihood sites: their layout, and the view of one site as a result of one site.

1. Parameters, statistics of the sampler and the accuracy check are common to all sites.
2. Groups of observed entries hold one variable for each site, with a dimension of its own: ``y`` over
   ``y_observation``. There the log likelihood has no coordinates, which ArviZ cannot stack across variables; the
   observed data have them.
3. Every other group belongs to one site and has its name: ``trajectories_y``.
4. `site_view` keeps the groups of the data of other sites, which the model needs for a forecast.
"""

from __future__ import annotations

import json
from collections.abc import Mapping

import xarray as xr

from lfm_ppl.results import inputs
from lfm_ppl.results.result_view import LIKELIHOODS, SELECTED_SITE, ResultView
from lfm_ppl.utils import checks

_COMMON = ("posterior", "sample_stats", "log_prior", "accuracy")
"""Groups that do not depend on the site."""

_OBSERVED = ("observed_data", "log_likelihood", "posterior_predictive")
"""Groups with one variable for each site."""

_OF_SITE = ("data", "one_step_ahead", "trajectories", "predictions", "truth", "constant_data",
            "predictions_constant_data", "held_out_data")
"""Groups that each site has for itself."""

_DATA = "data"
"""Group of the observations of a site."""

_VARIABLE = "y"
"""Name of the observations in the view of a site."""


def merge_sites(sites: Mapping[str, Mapping[str, xr.Dataset]]) -> dict[str, xr.Dataset]:
    """Return the groups of a result with several sites, from the groups of each site by name."""
    merged: dict[str, xr.Dataset] = {}
    for name, groups in sites.items():
        stored = name.replace("/", ".")
        for group, dataset in groups.items():
            if group in _COMMON:
                merged.setdefault(group, dataset)
            elif group in _OBSERVED:
                if group == "log_likelihood":
                    dataset = dataset.drop_vars([label for label in dataset.coords if label not in ("chain", "draw")])
                labels = {*dataset.dims, *dataset.coords} - {"chain", "draw"}
                names = {label: f"{stored}_{label}" for label in labels} | {name: stored}
                merged[group] = merged.get(group, xr.Dataset()).merge(dataset.rename(names))
            else:
                merged[f"{group}_{stored}"] = dataset
    return merged


def site_view(view: ResultView, name: str) -> ResultView:
    """Return the view of one likelihood site of several, see `lfm_ppl.select_series`."""
    settings = view.likelihood_sites
    if name not in settings:
        raise ValueError(checks.unknown("likelihood site", name, settings) if settings else
                         f"the result has one likelihood site, so that {name!r} cannot be selected; take the result "
                         "itself.")
    stored = name.replace("/", ".")
    groups = {}
    for group, dataset in view.groups.items():
        kind = group.removesuffix(f"_{stored}")
        if group in _COMMON:
            groups[group] = dataset
        elif group in _OBSERVED and stored in dataset:
            part = dataset[[stored]]
            names = {label: str(label).removeprefix(f"{stored}_") for label in (*part.variables, *part.dims)}
            groups[group] = part.rename(names | {stored: _VARIABLE})
        elif group != kind and kind in _OF_SITE:
            groups[kind] = dataset.rename({stored: _VARIABLE}) if stored in dataset else dataset
            if "observed" in dataset.attrs:
                groups[kind] = groups[kind].assign_attrs(observed=_VARIABLE)
        elif group.startswith((f"{inputs.GROUP}_", f"{_DATA}_")):
            groups[group] = dataset
    if {"log_likelihood", "observed_data"} <= set(groups):
        groups["log_likelihood"] = groups["log_likelihood"].assign_coords(groups["observed_data"].coords)
    attributes = {key: value for key, value in view.attrs.items() if key != LIKELIHOODS}
    selected = json.dumps({"name": name, "sites": settings})
    return view.with_groups(groups, attributes | settings[name] | {SELECTED_SITE: selected})


def all_sites_of(view: ResultView) -> tuple[ResultView, str]:
    """Return the view of all sites with the parameters and the data that a model needs, and the selected site."""
    selected = view.decoded(SELECTED_SITE)
    name, settings = selected["name"], selected["sites"]
    groups_of_site = {group: view.groups[group] for group in ("posterior", _DATA, "one_step_ahead", inputs.GROUP)
                      if group in view.groups}
    groups_of_site[_DATA] = groups_of_site[_DATA].rename({_VARIABLE: name})
    groups = merge_sites({name: groups_of_site})
    groups |= {group: dataset for group, dataset in view.groups.items()
               if group.startswith((f"{inputs.GROUP}_", f"{_DATA}_")) and group not in groups}
    differing = {key for site in settings.values() for key in site}
    attributes = {key: value for key, value in view.attrs.items() if key not in (SELECTED_SITE, *differing)}
    return view.with_groups(groups, {**attributes, LIKELIHOODS: json.dumps(settings)}), name
