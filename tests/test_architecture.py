"""Imports point one way, models use the public API alone, and importing has no side effects."""

import ast
import graphlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

import lfm_ppl

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "lfm_ppl"

# Lower layers first. A module belongs to the longest name here that is a prefix of its own, and may
# import from its own layer and from the layers below.
LAYERS = (
    ("utils", "io.table"),
    ("forces",),
    ("linearisation",),
    ("model",),
    ("orbits", "io"),
    ("filtering",),
    ("particles", "fokker_planck_grid", "latent_grid", "constrained"),
    ("switching",),
    ("inference",),
    ("orbits.training", "orbits.learning", "orbits.prediction"),
    ("results", "parallel"),
    ("workflows",),
    ("io.loading",),
    ("experiments",),
    ("cli", "__main__"),
)
RANK = {name: rank for rank, layer in enumerate(LAYERS) for name in layer}
PUBLIC = "lfm_ppl"  # the public API stands above the library and below the command line


def modules() -> dict[str, Path]:
    """Return the library's modules, named below the package: ``forces.matern``."""
    result = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        if parts[0] != "_models":
            result[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return result


def imports(path: Path) -> list[tuple[int, str]]:
    """Return (line, module) of every import of lfm_ppl in a file, also inside functions."""
    result = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            result += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: write imports from the root, lfm_ppl..."
            base = node.module or ""
            # `from lfm_ppl.inference import fit` may name a module or a member of the package.
            result += [
                (node.lineno, f"{base}.{a.name}" if is_module(f"{base}.{a.name}") else base)
                for a in node.names
            ]
    return [(line, name) for line, name in result if name.split(".")[0] == PUBLIC]


def is_module(name: str) -> bool:
    """Return whether ``lfm_ppl.a.b`` is a module or package of this library."""
    path = ROOT.joinpath(*name.split("."))
    return path.with_suffix(".py").is_file() or (path / "__init__.py").is_file()


def rank(module: str) -> int:
    """Return the layer of a module named below the package."""
    parts = module.split(".")
    for length in range(len(parts), 0, -1):
        if (name := ".".join(parts[:length])) in RANK:
            return RANK[name]
    raise AssertionError(f"lfm_ppl.{module} belongs to no layer; add it to LAYERS in {__file__}")


@pytest.mark.parametrize("module", [name for name in modules() if name])
def test_imports_point_down(module):
    path = modules()[module]
    for line, imported in imports(path):
        where = f"lfm_ppl/{path.relative_to(PACKAGE)}:{line} imports {imported}"
        if imported == PUBLIC:
            assert rank(module) >= RANK["io.loading"], (
                f"{where}: the library never imports its own API"
            )
            continue
        below = imported.removeprefix(f"{PUBLIC}.")
        assert rank(below) <= rank(module), f"{where}: imports point down only"


def test_no_circles_of_imports():
    """Modules can be sorted so that each imports earlier ones only; imports inside functions count."""
    names = modules()
    graph = {name: {imported.removeprefix(f"{PUBLIC}.") for _, imported in imports(path)} & set(names) - {name}
             for name, path in names.items()}
    try:
        list(graphlib.TopologicalSorter(graph).static_order())
    except graphlib.CycleError as error:
        pytest.fail(f"imports in a circle: {error.args[1]}")


def test_the_package_itself_is_the_public_api_and_nothing_else():
    assert [name for name in lfm_ppl.__all__ if not hasattr(lfm_ppl, name)] == []
    stub = ast.parse((PACKAGE / "__init__.pyi").read_text(encoding="utf-8"))
    aliases = [alias for node in stub.body if isinstance(node, ast.ImportFrom) for alias in node.names]
    assert [alias.name for alias in aliases if alias.asname != alias.name] == [], "export names as `name as name`"


@pytest.mark.parametrize("path", sorted((ROOT / "models").glob("*.py")), ids=lambda path: path.stem)
def test_models_import_only_the_public_api(path):
    for line, imported in imports(path):
        assert imported == PUBLIC, (
            f"{path.name}:{line} imports {imported}; use `import lfm_ppl as lfm`"
        )
    tree = ast.parse(path.read_text(encoding="utf-8"))
    private = [
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Name)
        and node.value.id == "lfm"
        and node.attr.startswith("_")
    ]
    assert not private, f"{path.name} uses the private names {private}"


@pytest.mark.parametrize("path", sorted((ROOT / "models").glob("*.py")), ids=lambda path: path.stem)
def test_models_do_nothing_when_imported(path):
    allowed = (ast.Import, ast.ImportFrom, ast.FunctionDef, ast.ClassDef, ast.Assign, ast.AnnAssign)
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        docstring = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        assert docstring or isinstance(node, allowed), f"{path.name}:{node.lineno} runs at import"


def test_no_private_names_across_modules():
    for name, path in modules().items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(PUBLIC):
                private = [a.name for a in node.names if a.name.startswith("_")]
                assert not private, f"lfm_ppl.{name} line {node.lineno} imports {private}"


def run(code: str) -> str:
    """Run code in a fresh interpreter that sees this checkout, and return what it printed."""
    command = [sys.executable, "-c", code]
    result = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=300)
    assert result.returncode == 0, result.stderr
    return result.stdout.strip()


def test_importing_the_library_changes_no_global_setting():
    code = (
        "import jax; before = dict(jax.config.values); import lfm_ppl; "
        "print([k for k, v in jax.config.values.items() if before.get(k) != v])"
    )
    assert run(code) == "[]"


def test_importing_the_library_imports_nothing_else():
    """Neither its own parts, nor what they stand on: each comes with the first name that needs it."""
    code = (
        "import sys; before = set(sys.modules); import lfm_ppl; "
        "print(sorted({name.split('.')[0] for name in set(sys.modules) - before} - {'lfm_ppl'}), "
        "sorted(name for name in sys.modules if name.startswith('lfm_ppl.')))"
    )
    own = run(code)
    assert own.endswith("] []"), own
    assert not re.search("jax|numpyro|arviz|matplotlib|scipy|equinox", own), own


def test_a_model_and_its_filter_import_no_satellites_figures_or_experiments():
    code = (
        "import sys; import lfm_ppl as lfm; lfm.Matern, lfm.LatentForceModel, lfm.filter, lfm.MarginalLikelihood; "
        "print(sorted(name for name in sys.modules if name.startswith('lfm_ppl.') and name.count('.') == 1), "
        "'matplotlib.pyplot' in sys.modules, 'arviz' in sys.modules)"
    )
    result = run(code)
    assert result.endswith("False False") and "lfm_ppl.filtering" in result
    for part in ("orbits", "particles", "fokker_planck_grid", "results", "parallel", "experiments", "switching", "cli"):
        assert f"lfm_ppl.{part}" not in result


def test_names_imported_when_asked_for_are_ordinary_names():
    """``import *``, pickling, isinstance, tab completion, the parts of the package, and a name that is none."""
    code = """
import pickle
from lfm_ppl import *
import lfm_ppl as lfm
assert smooth is lfm.smooth and fit is lfm.fit and orbits is lfm.orbits
force = lfm.Matern(1.0, 2.0)
assert isinstance(pickle.loads(pickle.dumps(force)), lfm.Force) and pickle.loads(pickle.dumps(lfm.Matern)) is lfm.Matern
assert set(lfm.__all__) <= set(dir(lfm))
assert lfm.forces.CQM.__module__ == "lfm_ppl.forces.weights" and lfm.orbits.read_sp3
try:
    lfm.matern
except AttributeError as error:
    print(error)
"""
    assert "matern" in run(code)
