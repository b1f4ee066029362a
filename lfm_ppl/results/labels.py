"""Names of dimensions and coordinates of a result, from plates, outputs and the user's labels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from lfm_ppl.results.series import SERIES, plate_dimension
from lfm_ppl.utils import checks

if TYPE_CHECKING:
    from lfm_ppl.inference.bound_model import BoundModel

OUTPUT = "output"


@dataclass(frozen=True)
class Labels:
    """Names of dimensions, and of what stands along them.

    Attributes:
        dims: site -> a name, or None where there is none, for each axis of its value.
        coords: dimension -> labels.
        derived: names of the deterministic sites.
        series: dimension of the series of a panel, the name of its plate; None for one series.
    """

    dims: Mapping[str, tuple[str | None, ...]]
    coords: Mapping[str, list]
    derived: frozenset[str] = frozenset()
    series: str | None = None

    @classmethod
    def of(cls, bound: BoundModel, dims: Mapping[str, Sequence[str]] | None = None,
           coords: Mapping[str, Sequence[Any]] | None = None, y: Any = None) -> Labels:
        """Return the names that a model and its user give.

        A site's own dimensions come from ``dims``, else from ``event_dims`` of its ``infer`` and from the plates that
        it stands in. The plate of a panel is the dimension of the series in all groups, with the labels of the data or
        the numbers from zero.

        Args:
            bound: the model.
            dims: site -> names of the axes of its value.
            coords: dimension -> labels.
            y: the data as they were given, whose column names, or labels of the first dimension, are kept.

        Raises:
            ValueError: a site that the model has not; a number of names or labels that does not fit.
        """
        trace = bound.trace()
        site = bound.site
        series = plate_dimension(bound)
        plates = [frame.name for frame in trace[site.name].get("cond_indep_stack", ())]
        renamed = {plates[0]: series} if series is not None and len(plates) == 1 else {}
        likelihoods = {likelihood.name for likelihood in bound.unbound.likelihoods}
        dimensions = {name: _axes(site_trace, renamed) for name, site_trace in trace.items()
                      if name not in likelihoods and site_trace["type"] in ("sample", "deterministic")}
        derived = frozenset(name for name in dimensions if trace[name]["type"] == "deterministic")
        for name, requested_dims in (dims or {}).items():
            names: list[str] = [requested_dims] if isinstance(requested_dims, str) else list(requested_dims)
            if name not in dimensions:
                raise ValueError(f"dims: {checks.unknown('parameter', name, dimensions)}")
            if len(names) != len(dimensions[name]):
                raise ValueError(f"dims: {name!r} has {len(dimensions[name])} dimensions, of shape "
                                 f"{np.shape(trace[name]['value'])}, and {len(names)} names: {', '.join(names)}.")
            dimensions[name] = tuple(str(text) for text in names)
        sizes = {OUTPUT: len(site.example.ssm.model.output_names)}
        sizes |= {} if series is None else {series: np.shape(bound.y)[0]}
        for name, axes in dimensions.items():
            for text, size in zip(axes, np.shape(trace[name]["value"]), strict=True):
                if text is not None and sizes.setdefault(text, size) != size:
                    raise ValueError(f"the dimension {text!r} has {sizes[text]} entries elsewhere and {size} in "
                                     f"{name!r}; give them different names.")
        if series is not None:
            renamed = {SERIES: series, **renamed}
        labels = {renamed.get(text, text): list(values) for text, values in (coords or {}).items()}
        if series is not None and series not in labels:
            has_labels = getattr(y, "dims", None) and y.dims[0] in y.coords  # an array of xarray
            labels[series] = y[y.dims[0]].values.tolist() if has_labels else list(range(sizes[series]))
        if OUTPUT not in labels and hasattr(y, "columns"):
            labels[OUTPUT] = [str(column) for column in y.columns]
        for text, values in labels.items():
            if text not in sizes:
                raise ValueError(f"coords: {checks.unknown('dimension', text, sizes)}")
            if len(values) != sizes[text] or len(set(values)) < len(values):
                raise ValueError(f"coords: the dimension {text!r} needs {sizes[text]} labels, each of them once; got "
                                 f"{len(values)}: {', '.join(map(str, values))}.")
        return cls(dimensions, labels, derived, series)


def _axes(site: Mapping[str, Any], renamed: Mapping[str, str]) -> tuple[str | None, ...]:
    """Return a name for each axis of the value of a site in a trace."""
    ndim = np.ndim(site["value"])
    events = site["fn"].event_dim if site["type"] == "sample" else 0
    names: list[str | None] = [None] * ndim
    event_dims = tuple((site.get("infer") or {}).get("event_dims", ()))
    if event_dims:
        names[ndim - len(event_dims):] = [str(text) for text in event_dims]
    frames = site.get("cond_indep_stack") or ()
    if site["type"] == "sample" or len(frames) == ndim:
        for frame in frames:
            axis = ndim - events + frame.dim
            if 0 <= axis < ndim:
                names[axis] = renamed.get(frame.name, frame.name)
    return tuple(names)
