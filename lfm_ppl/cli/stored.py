"""From a stored result to the model that it was made with, in the words of the command line."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any, NamedTuple

from lfm_ppl import data, loading
from lfm_ppl.cli import choices


class StoredModel(NamedTuple):
    """A result with its model.

    Attributes:
        posterior: the result.
        name: of the model.
        model: the NumPyro model, with the settings of the fit.
        keywords: its keyword arguments.
        observed: the data that were fitted.
        file: the model file.
    """

    posterior: Any
    name: str
    model: Callable
    keywords: dict[str, Any]
    observed: data.Data
    file: loading.ModelFile


def model_of(posterior: Any, model_file: str | None) -> StoredModel:
    """Rebuild the model from what the result remembers of it.

    Args:
        posterior: the stored result.
        model_file: of the user; None: the one that the result names.

    Raises:
        ValueError: the file is not known or has changed; the result is of a panel, of other outputs or options.
    """
    from lfm_ppl.inference.handlers.settings import approximate
    from lfm_ppl.results import arviz_data, rebuilding
    from lfm_ppl.results.scalars import unit_of

    attrs = arviz_data.attributes(posterior)
    chosen = model_file or attrs.get("model_file")
    if not chosen:
        raise ValueError(f"the result does not say which file its model {attrs.get('model', '')!r} comes from, as of "
                         "one that lfm.fit made. Name the file with --model FILE, or call lfm.check_accuracy(result, "
                         "model) or lfm.forecast(result, model, times) in Python.")
    try:
        model = loading.load(chosen)
    except ValueError as error:
        remedy = "" if model_file else " The result was made with this file; if it has moved, name it with --model."
        raise ValueError(f"{error}{remedy}") from error
    times, y = rebuilding.observations(posterior)
    if y.ndim != 2 or times.ndim != 1:
        raise ValueError("the result is of a panel of series; use lfm.check_accuracy or lfm.forecast in Python.")
    group = arviz_data.group(posterior, "observed_data")
    outputs = tuple(str(name) for name in group["output"].values)
    if model.outputs is not None and model.outputs != outputs:
        raise ValueError(f"the result is of the outputs {', '.join(outputs)}; {model.path} has "
                         f"{', '.join(model.outputs)}. Give the file that it was made with.")
    (variable,) = (group[name] for name in group.data_vars)
    units = {name: unit for name in outputs if (unit := unit_of(variable, name))}
    observed = data.Data(times, y, outputs, units={**model.units, **units})
    options = json.loads(attrs.get("options") or "{}")
    unknown = sorted(set(options) - set(model.options))
    if unknown:
        raise ValueError(f"the result was made with the option {unknown[0]!r}, which {model.path} no longer has.")
    settings = json.loads(attrs.get("settings") or "{}")
    settings["rule"] = choices.rule(settings.get("rule"))
    numpyro_model = approximate(model.model, **settings)
    return StoredModel(posterior, model.name, numpyro_model, model.keywords(observed, options), observed, model)
