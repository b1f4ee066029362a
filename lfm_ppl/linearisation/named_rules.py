"""From the name of a rule, as a result records it, back to the rule."""

from __future__ import annotations

import ast

from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.linearisation.sigma_points import CentralDifference, Cubature, GaussHermite, MonteCarlo, Unscented
from lfm_ppl.linearisation.taylor import Taylor

_RULES = {rule.__name__: rule for rule in (Taylor, Unscented, Cubature, GaussHermite, CentralDifference, MonteCarlo)}


def named_rule(name: str) -> Rule | None:
    """Return the rule whose `Rule.name` this is; None for a rule that is not of this library."""
    call = ast.parse(name, mode="eval").body
    if not isinstance(call, ast.Call) or not isinstance(call.func, ast.Name) or call.func.id not in _RULES:
        return None
    return _RULES[call.func.id](**{str(keyword.arg): ast.literal_eval(keyword.value) for keyword in call.keywords})
