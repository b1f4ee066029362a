"""The studies that can be run by name."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the import takes a second
    from .declaration import Study

_STUDIES = {
    "ginzburg-landau": ("ginzburg_landau.study",
                        "double well: EKF, CKF, GHKF, particle filter and exact grid, in states and parameters"),
    "gps": ("gps.study",
            "orbits of GPS and others, predicted for days with and without latent forces, from SP3 files or simulated"),
    "home-heating": ("home_heating.study", "home heating: a day ahead with residual heat that nearly repeats, "
                     "under a thermostat and in a real house"),
    "transcription": ("transcription.study", "transcription factors: Laplace, elliptical slice sampling and "
                      "Gaussian smoothers, eight links, table 1"),
    "transcription-parameters": ("transcription.parameters_study", "transcription factors with unknown rates: the "
                                 "marginal posterior against that of the force as latent sites"),
    "ballistic": ("ballistic.study",
                  "target on reentry: Gaussian smoothers against particles, and the posterior of the drag"),
    "periodic-kernels": ("periodic_kernels.study",
                         "periodic kernels as forces: eigenfunctions against random frequencies and resonators"),
    "call-centre": ("call_centre.study", "queues of a call centre tracked by forces that nearly repeat, from real "
                    "counts (--data) or simulated"),
    "constrained": ("constrained.study",
                    "forces that cannot be negative: moving horizon, full information and bands, also of TRH"),
    "counts": ("counts.study",
               "counts, gross errors, yes and no: EP, variational and Laplace against exact draws"),
}
"""Name -> module and summary; texts, since the modules take seconds to import."""


@dataclass(frozen=True)
class CatalogueEntry:
    """Entry of the catalogue for a study.

    Attributes:
        name: name on the command line.
        summary: summary in one line.
    """

    name: str
    summary: str

    @property
    def study(self) -> Study:
        """The study; its module is imported at the first access."""
        return importlib.import_module(f".{_STUDIES[self.name][0]}", __package__).STUDY


def names() -> tuple[str, ...]:
    """Return the names of the studies."""
    return tuple(_STUDIES)


def entry(name: str) -> CatalogueEntry:
    """Return the catalogue entry of a study by name, with dashes or underscores.

    Raises:
        ValueError: no study has this name; the message suggests the most similar ones.

    Example:
        >>> entry("ginzburg_landau").name
        'ginzburg-landau'
    """
    canonical = name.replace("_", "-")
    if canonical not in _STUDIES:
        from lfm_ppl.utils import checks  # which imports JAX, for which the help of the command line would wait

        raise ValueError(checks.unknown("study", name, _STUDIES))
    return CatalogueEntry(canonical, _STUDIES[canonical][1])
