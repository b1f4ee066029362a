"""Every example in a docstring runs and prints what it says."""

import doctest
import importlib
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "lfm_ppl"
MODULES = sorted(
    ".".join(("lfm_ppl", *path.relative_to(PACKAGE).with_suffix("").parts))
    for path in PACKAGE.rglob("*.py")
    if path.name not in ("__init__.py", "__main__.py") and ">>> " in path.read_text("utf-8")
)


COSTLY = tuple(f"lfm_ppl.{name}" for name in (
    "backtesting", "conversion", "fokker_planck_grid.fokker_planck", "forecasting", "inference.bound_model",
    "inference.handlers.on_latent_grid", "inference.handlers.settings", "inference.kernels.elliptical_slice",
    "inference.kernels.particle_marginal", "latent_grid.laplace", "latent_grid.latent_grid", "orbits.deviations",
    "results.accuracy", "results.calibration", "switching.rao_blackwellised", "switching.switched_simulation"))
"""Modules whose examples take several seconds to compile; these are run with -m slow."""


@pytest.mark.parametrize("name", [
    pytest.param(name, marks=[pytest.mark.slow] if name in COSTLY else []) for name in MODULES])
def test_examples(name):
    module = importlib.import_module(name)
    outcome = doctest.testmod(module, optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE)
    assert outcome.attempted > 0
    assert outcome.failed == 0, f"see the output above: {outcome.failed} examples of {name}"
