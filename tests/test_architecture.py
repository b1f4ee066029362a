"""Imports point one way, models use the public API alone, and importing has no side effects."""

import ast
import collections
import graphlib
import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import lfm_ppl

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "lfm_ppl"

# Lower layers first. A module belongs to the longest name here that is a prefix of its own, and may
# import from its own layer and from the layers below.
LAYERS = (
    ("utils",),
    ("forces",),
    ("linearisation",),
    ("model",),
    ("orbits", "io", "space"),
    ("filtering",),
    ("particles", "fokker_planck_grid", "latent_grid", "constrained"),
    ("likelihoods",),
    ("switching",),
    ("inference",),
    ("storage",),
    ("orbits.training", "orbits.learning", "orbits.prediction"),
    ("results", "parallel"),
    ("accuracy",),
    ("plots",),
    ("report",),
    ("workflows",),
    ("",),  # the public API
    ("studies",),
    ("cli", "__main__"),
)
RANK = {name: rank for rank, layer in enumerate(LAYERS) for name in layer}
PUBLIC = "lfm_ppl"
MODULES = {".".join(path.relative_to(root).with_suffix("").parts).removesuffix("__init__").removesuffix("."): path
           for root, folder in ((ROOT, ROOT / "studies"), (PACKAGE, PACKAGE)) for path in sorted(folder.rglob("*.py"))}
"""Name below the package, such as ``forces.matern``, -> file; ``studies/`` is the package ``lfm_ppl.studies``."""


def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def imports(path: Path, package: str = "") -> list[tuple[int, str, str]]:
    """Return (line, module below lfm_ppl, name) of every import of it, also inside functions of a module of package."""
    result = []
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            result += [(node.lineno, alias.name, "") for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
            # `from lfm_ppl.inference import bind` names a module or a member of the package.
            result += [(node.lineno, f"{base}.{a.name}" if f"{base}.{a.name}".removeprefix(f"{PUBLIC}.") in MODULES
                        else base, a.name) for a in node.names]
    return [(line, module.removeprefix(PUBLIC).removeprefix("."), name) for line, module, name in result
            if module.split(".")[0] == PUBLIC]


def imports_of(module: str) -> list[tuple[int, str, str]]:
    """Return the imports of a module named below the package."""
    path = MODULES[module]
    package = module if path.stem == "__init__" else module.rpartition(".")[0]
    return imports(path, f"{PUBLIC}.{package}".removesuffix("."))


def rank(module: str) -> int:
    """Return the layer of a module named below the package."""
    parts = module.split(".")
    return next((RANK[name] for length in range(len(parts), 0, -1)
                 if (name := ".".join(parts[:length])) in RANK), len(LAYERS))


def test_imports_point_down_without_circles_and_without_private_names():
    violations = [f"{module} belongs to no layer" for module in MODULES if rank(module) == len(LAYERS)]
    graph = collections.defaultdict(set)
    for module, path in MODULES.items():
        for line, imported, name in imports_of(module):
            if name.startswith("_") or rank(imported) > rank(module):
                violations.append(f"{path.relative_to(ROOT)}:{line} imports {imported or PUBLIC} {name}")
            if imported and imported != module:
                graph[module].add(imported)
    assert violations == []
    list(graphlib.TopologicalSorter(graph).static_order())  # raises CycleError


def test_models_use_the_public_api_and_do_nothing_when_imported():
    allowed = (ast.Import, ast.ImportFrom, ast.FunctionDef, ast.ClassDef, ast.Assign, ast.AnnAssign)
    violations = []
    for path in (ROOT / "models").glob("*.py"):
        lines = [line for line, imported, _ in imports(path) if imported]
        lines += [node.lineno for node in ast.walk(tree(path)) if isinstance(node, ast.Attribute)
                  and isinstance(node.value, ast.Name) and node.value.id == "lfm" and node.attr.startswith("_")]
        lines += [node.lineno for node in tree(path).body[1:] if not isinstance(node, allowed)]
        violations += [f"{path.name}:{line}" for line in lines]
    assert violations == []


def test_studies_import_public_names_as_a_user_does():
    public = {*lfm_ppl.__all__, *lfm_ppl.forces.__all__, *lfm_ppl.orbits.__all__}
    modules = [module for module in MODULES if module.startswith("studies.")]
    violations = [f"{MODULES[module].relative_to(ROOT)}:{line} imports {name} from {imported}"
                  for module in modules for line, imported, name in imports_of(module)
                  if name in public and imported not in ("", "forces", "orbits") and not imported.startswith("studies.")
                  and imported.rpartition(".")[2] != name]
    assert violations == []


def test_public_classes_have_names_of_their_own():
    names = collections.Counter(
        node.name for module, path in MODULES.items() if not module.startswith("studies")
        for node in tree(path).body if isinstance(node, ast.ClassDef) and not node.name.startswith("_"))
    assert [name for name, count in names.items() if count > 1] == []


def test_importing_has_no_side_effects():
    """No setting is changed, and what a name stands on is imported with the name; names are ordinary otherwise."""
    code = """
import json, pickle, sys
import lfm_ppl as lfm
alone = sorted(name for name in sys.modules if name.startswith("lfm_ppl.") or name in ("jax", "numpyro", "arviz"))
import jax
settings = dict(jax.config.values)
lfm.Matern, lfm.LatentForceModel, lfm.filter, lfm.MarginalLikelihood
parts = sorted(name for name in sys.modules if name.startswith("lfm_ppl.") and name.count(".") == 1)
others = [name for name in ("matplotlib.pyplot", "arviz") if name in sys.modules]
from lfm_ppl import *
assert smooth is lfm.smooth and set(lfm.__all__) <= set(dir(lfm)) and not hasattr(lfm, "matern")
assert isinstance(pickle.loads(pickle.dumps(lfm.Matern(1.0, 2.0))), lfm.Force)
changed = [name for name, value in jax.config.values.items() if settings.get(name) != value]
print(json.dumps([alone, parts, others, changed]))
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, timeout=300)
    assert run.returncode == 0, run.stderr
    alone, parts, plotting, changed = json.loads(run.stdout)
    assert alone == plotting == changed == []
    assert "lfm_ppl.filtering" in parts and not {
        f"lfm_ppl.{name}" for name in ("orbits", "particles", "results", "studies", "cli")} & set(parts)
    assert [name for name in lfm_ppl.__all__ if not hasattr(lfm_ppl, name)] == []
