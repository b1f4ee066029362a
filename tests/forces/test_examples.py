"""The examples in the docstrings run and show what they say."""

import doctest
import importlib
import pkgutil

import pytest

import lfm_ppl.forces

MODULES = [module.name for module in pkgutil.iter_modules(lfm_ppl.forces.__path__)]


@pytest.mark.parametrize("name", MODULES)
def test_examples(name):
    result = doctest.testmod(importlib.import_module(f"lfm_ppl.forces.{name}"))
    assert result.failed == 0
