"""The model and the data of a stored result, rebuilt from its attributes."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lfm_ppl.cli import choices
from lfm_ppl.io import loading
from lfm_ppl.io.data_set import Data
from lfm_ppl.results.result_view import SELECTED_SERIES, SELECTED_SITE, ResultView
from lfm_ppl.utils import checks


@dataclass(frozen=True)
class StoredFit:
    """What is read of a stored result, its model with keyword arguments, its data and its model file."""

    view: ResultView
    name: str
    model: Callable
    keywords: dict[str, Any]
    observed: Data
    file: loading.ModelFile


def rebuild_fit(posterior: Any, model_file: str | None, path: Path) -> StoredFit:
    """Rebuild the model from what the result in a file remembers of it."""
    from lfm_ppl.likelihoods.handlers.approximate import approximate
    from lfm_ppl.results import rebuilding
    from lfm_ppl.results.scalars import unit_of
    from lfm_ppl.results.series import TIMES, panel_of, times_of

    view = ResultView.of(posterior)
    view.refuse_several_sites()
    attrs = view.attrs
    model_path = model_file or attrs.get("model_file")
    if not model_path:
        raise ValueError(f"{path} does not say which file its model {attrs.get('model', '')!r} comes from, as of one "
                         "that lfm.fit made. Name the file with --model FILE, or call lfm.check_accuracy(result, "
                         "model) in Python.")
    try:
        model = loading.load(model_path)
    except ValueError as error:
        remedy = "" if model_file else " The result was made with this file; if it has moved, name it with --model."
        raise ValueError(f"{error}{remedy}") from error
    try:
        times, y = rebuilding.observations(view)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    group = view.group("data")
    outputs = tuple(str(name) for name in group["output"].values)
    if model.outputs is not None and model.outputs != outputs:
        raise ValueError(f"{path} is of the outputs {', '.join(outputs)}; {model.path} has "
                         f"{', '.join(model.outputs)}. Give the file that it was made with.")
    (variable,) = (group[name] for name in group.data_vars if name != TIMES)
    units = {name: unit for name in outputs if (unit := unit_of(variable, name))}
    if clock := unit_of(times_of(group)):
        units["time"] = clock
    observed = Data(np.broadcast_to(times, y.shape[:-1]), y, outputs, units={**model.units, **units},
                    inputs=view.inputs, origin=view.clock[0], series=tuple(map(str, view.series_labels)))
    options = _json_attribute(attrs, "options", path)
    unknown = sorted(set(options) - set(model.options))
    if unknown:
        raise ValueError(f"{path} was made with the option {unknown[0]!r}, which {model.path} no longer has. Give the "
                         "file as it was then, with --model.")
    settings = _json_attribute(attrs, "settings", path)
    if settings.get("rule") not in (None, *choices.RULES):
        raise ValueError(f"{path}, attribute settings: {checks.unknown('rule', settings['rule'], choices.RULES)}")
    settings["rule"] = choices.rule(settings.get("rule"))
    numpyro_model = approximate(model.model, **settings)
    # The model of a panel gets the known inputs of all series.
    tables = panel_of(view)[0].inputs if SELECTED_SERIES in attrs else observed.inputs
    keywords = model.keywords(replace(observed, inputs=tables), options)
    if SELECTED_SITE in attrs:  # the result has them by site
        keywords = {name: value for name, value in keywords.items() if name not in ("inputs", "events")}
    return StoredFit(view, model.name, numpyro_model, keywords, observed, model)


def _json_attribute(attrs: Mapping[str, Any], name: str, path: Path) -> dict[str, Any]:
    """Return a mapping that an attribute of a result holds as JSON."""
    with contextlib.suppress(ValueError):
        if isinstance(value := json.loads(attrs.get(name) or "{}"), dict):
            return value
    raise ValueError(f"{path}: its attribute {name} cannot be read; the file was changed since `lfm-ppl fit` wrote it.")
