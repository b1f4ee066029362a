"""Find, load and check model files: shipped ones by name, others by path.

A model file is an ordinary Python file, executed as a module of its own. It must define

    model(times, y=None, **options)     the NumPyro model, with one site ``y``

and may define, each with a sensible default,

    simulate(seed=0, **options) -> lfm.Data     its default data
    prepare(data) -> lfm.Data                   converts the data of a file for ``model``
    anchors(data) -> dict                       parameters that are fixed for such data unless freed
    fields(data, **options) -> dict             fields in space that are drawn: name -> keywords of `lfm.evaluate_field`
    OUTPUTS      names of the outputs; None: the columns of the data file
    INPUTS       known inputs: name -> how they are read, "previous", "linear", "zero" or "dose:STATE", see
                 `lfm_ppl.read_csv`
    UNITS        name -> unit
    OPTIONS      option -> (default, tuple of choices or a type, help)
    PARAMETERS   name of a sample site -> help, with its unit
    TARGET_ACCEPT    target acceptance of NUTS, if the default makes its steps too long

A file that calls `lfm.panel` is fitted to several series together: ``model`` gets times (B, T) and y (B, T, D), where
shorter series are padded.

A ``model`` with an argument ``outputs``, ``units``, ``inputs`` or ``events`` gets the names of the outputs, the units,
the known inputs (name -> `lfm.Input`) or the doses (a list of `lfm.Dose`, `lfm.Infusion` and `lfm.Reset`) of the data.
"""

from __future__ import annotations

import ast
import importlib.util
import inspect
import os
import sys
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any

from lfm_ppl.io.data_set import Data
from lfm_ppl.io.input_table import DOSE, INTERPOLATIONS, OF_SERIES
from lfm_ppl.utils import checks
from lfm_ppl.utils.shipped_files import shipped_folder

_MODULE = "_lfm_ppl_model_"  # prefix of the names of the modules of model files


@dataclass(frozen=True)
class ModelFile:
    """A model file that has been loaded and checked.

    Attributes:
        name: ``ginzburg-landau`` for ``ginzburg_landau.py``.
        summary: the first line of the docstring.
        description: the docstring.
        path: the file.
        definitions: functions and constants of the file, and other names in it.
        model: the NumPyro model function.
        outputs: names of the outputs, or None for any number of them.
        inputs: known inputs that the model takes: name -> interpolation.
        units: name -> unit.
        options: option -> (default, tuple of choices or a type, help).
        parameters: name of a sample site -> help.
        target_accept: target acceptance of NUTS; None for its default.
    """

    name: str
    summary: str
    description: str
    path: Path
    definitions: Mapping[str, Any] = field(repr=False, compare=False)
    model: Callable[..., None]
    outputs: tuple[str, ...] | None
    inputs: Mapping[str, str]
    units: Mapping[str, str]
    options: Mapping[str, tuple[Any, Any, str]]
    parameters: Mapping[str, str]
    target_accept: float | None

    @property
    def can_simulate(self) -> bool:
        """Whether the file has data of its own."""
        return "simulate" in self.definitions

    def simulate(self, seed: int | None = None, **options: Any) -> Data:
        """Return simulated data with its truth; the model's default data where seed is None."""
        if not self.can_simulate:
            raise ValueError(f"{self.path} defines no simulate(seed=0, **options), so it has no data of its own. Give "
                             "a data file with --data FILE, or add the function.")
        return self._data("simulate", **({} if seed is None else {"seed": seed}), **options)

    def prepare(self, data: Data) -> Data:
        """Return a user's data in the form that the model takes; ``note`` says what was done."""
        return self._data("prepare", data)

    def anchors(self, data: Data) -> dict[str, float]:
        """Return the parameters that are fixed for this data unless the user frees them."""
        return dict(self._call("anchors", Mapping, data))

    def fields(self, data: Data, options: Mapping[str, Any]) -> dict[str, Any]:
        """Return the fields in space of this data: name -> keyword arguments of `lfm_ppl.evaluate_field`."""
        return dict(self._call("fields", Mapping, data, **options))

    def keywords(self, data: Data, options: Mapping[str, Any]) -> dict[str, Any]:
        """Return the keyword arguments of ``model`` for this data and these options."""
        keywords = {name: default for name, (default, _, _) in self.options.items()} | dict(options)
        parameters = inspect.signature(self.model).parameters
        from_data = {"outputs": data.outputs, "units": dict(data.units), "inputs": data.known_inputs(),
                     "events": data.doses()}
        for name, table in data.inputs.items():
            argument, kind = ("events", "doses") if table.is_dose else ("inputs", "known input")
            if argument not in parameters:
                raise ValueError(f"{self.path}: the data have the {kind} {name!r}, and model(...) has no argument "
                                 f"`{argument}` to take {'them' if table.is_dose else 'it'} by.")
        names = {key.partition(OF_SERIES)[0] for key in data.inputs}
        has_doses = any(table.is_dose for table in data.inputs.values())
        for name, way in self.inputs.items():
            # Doses to other states than usual: where there is no such state the model names those that exist.
            if name not in names and not (way.startswith(DOSE) and has_doses):
                raise ValueError(f"{self.name} needs the known input {name!r}, which the data do not have.")
        return keywords | {name: value for name, value in from_data.items() if name in parameters}

    def option(self, name: str, text: str) -> Any:
        """Return the value of an option that a text stands for; ValueError where it does not take it."""
        checks.one_of(f"option of {self.name}", name, self.options)
        _, accepted, _ = self.options[name]
        choices = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}
        if isinstance(accepted, tuple):
            choices = {str(choice): choice for choice in accepted}
            checks.one_of(f"value of option {name}", text, choices)
            return choices[text]
        try:
            return choices[text.lower()] if accepted is bool else accepted(text)
        except (ValueError, KeyError):
            raise ValueError(f"option {name} of {self.name} takes a value of type {accepted.__name__}, got "
                             f"{text!r}.") from None

    def _data(self, name: str, *arguments: Any, **keywords: Any) -> Data:
        """Return the data of ``simulate`` or ``prepare``, with the units of the model."""
        data = self._call(name, Data, *arguments, **keywords)
        if self.outputs is not None and data.outputs != self.outputs:
            raise ValueError(f"{name} in {self.path} returns data of {', '.join(data.outputs)}, but the file has "
                             f"OUTPUTS = {self.outputs}; make them the same.")
        return replace(data, units={**self.units, **data.units})

    def _call(self, name: str, result_type: type, *arguments: Any, **keywords: Any) -> Any:
        """Return the result of a function of the file; without it, the data of ``prepare`` or an empty mapping."""
        if name not in self.definitions:
            return arguments[0] if name == "prepare" else {}
        _check_signature(self.path, self.definitions, name, *arguments, **keywords)
        result = self.definitions[name](*arguments, **keywords)
        if not isinstance(result, result_type):
            expected = "lfm.Data" if result_type is Data else "a mapping"
            raise TypeError(f"{name} in {self.path} must return {expected}, got {type(result).__name__}.")
        return result


def models_folder() -> Path:
    """Return the folder of the shipped model files: in a wheel, or in the checkout."""
    return shipped_folder("models")


def available() -> dict[str, Path]:
    """Return the shipped models: name -> file."""
    return {_name(path): path for path in sorted(models_folder().glob("*.py")) if not path.name.startswith("_")}


def load(name: str) -> ModelFile:
    """Load a shipped model (``ginzburg-landau``, dashes or underscores) or the file at a path, and check it.

    A path ends in .py or contains a separator. Raises ValueError for an unknown name, and for a file that is missing,
    does not run, or does not define a model.
    """
    if name.endswith(".py") or os.sep in name:
        path = Path(name).expanduser().resolve()
        if not path.is_file():
            raise ValueError(f"there is no model file {name}.")
        return _checked(path, _execute(path))
    shipped, shipped_name = available(), name.replace("_", "-")
    if shipped_name not in shipped:
        if Path(f"{name}.py").is_file():
            raise ValueError(f"unknown model {name!r}. Did you mean the file {name}.py?")
        raise ValueError(f"{checks.unknown('model', name, shipped)} A model of your own has a path, as ./{name}.py.")
    return _checked(shipped[shipped_name], _execute(shipped[shipped_name]))


def is_panel(name: str) -> bool:
    """Return whether a model file calls `lfm_ppl.panel`, so that series are fitted together; the file is not run."""
    path = available().get(name.replace("_", "-"), Path(name).expanduser())
    try:
        tree = ast.parse(path.read_text(encoding="utf-8"))
    except (OSError, SyntaxError):  # `load` reports them
        return False
    functions = [node.func for node in ast.walk(tree) if isinstance(node, ast.Call)]
    return any(getattr(function, "attr", getattr(function, "id", "")) == "panel" for function in functions)


def _execute(path: Path) -> ModuleType:
    """Run a file as a module of its own, whose name cannot hide another module."""
    spec = importlib.util.spec_from_file_location(f"{_MODULE}{path.stem}", path)
    if spec is None or spec.loader is None:
        raise ValueError(f"{path} is not a Python file.")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # a dataclass or an equinox Module looks itself up there
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        del sys.modules[spec.name]
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
        line = error.lineno if isinstance(error, SyntaxError) else lines[-1] if lines else None
        prefix = f"line {line}: " if line else ""
        raise ValueError(f"{path} does not run: {prefix}{type(error).__name__}: {error}") from error
    return module


_FORMS: dict[str, tuple[str, Callable[[Any], bool]]] = {
    **dict.fromkeys(("simulate", "prepare", "anchors", "fields"), ("a function", callable)),
    **dict.fromkeys(("UNITS", "PARAMETERS", "OPTIONS"), ("a mapping", lambda value: isinstance(value, Mapping))),
    "OUTPUTS": ('a tuple of names, as in ("x",)', lambda value: (
        isinstance(value, (tuple, list)) and len(value) > 0 and all(isinstance(name, str) for name in value))),
    "INPUTS": (f"a mapping of names to one of {', '.join(INTERPOLATIONS)} or {DOSE}STATE", lambda value: (
        isinstance(value, Mapping) and all(way in INTERPOLATIONS or str(way).startswith(DOSE)
                                           for way in value.values()))),
    "TARGET_ACCEPT": ("between 0 and 1", lambda value: isinstance(value, int | float) and 0 < value < 1)}
"""Definition of a model file -> its form, and whether a value has it."""


def _checked(path: Path, module: ModuleType) -> ModelFile:
    """Return a model file; ValueError names a definition of a wrong form."""
    definitions = {name: value for name, value in vars(module).items() if name not in _FORMS or value is not None}
    functions = {name: value for name, value in definitions.items()
                 if callable(value) and getattr(value, "__module__", "") == module.__name__}
    if "model" not in functions:
        raise ValueError(f"{path} defines no function model(times, y=None, **options); its functions are: "
                         f"{', '.join(functions) or 'none'}. Rename the NumPyro model function to `model`.")
    for name, (form, is_valid) in _FORMS.items():
        if name in definitions and not is_valid(definitions[name]):
            raise ValueError(f"{path}: {name} must be {form}, got {definitions[name]!r}.")
    options = definitions.get("OPTIONS", {})
    for name, option in options.items():
        has_form = isinstance(option, tuple) and len(option) == 3 and isinstance(option[1], tuple | type)
        if not has_form or isinstance(option[1], tuple) and option[0] not in option[1]:
            raise ValueError(f"{path}: OPTIONS[{name!r}] must be (default, tuple of choices or a type, help), with the "
                             f"default among the choices, got {option!r}.")
    parameters = inspect.signature(functions["model"]).parameters
    _check_signature(path, definitions, "model", None, None, **dict.fromkeys(options),
                     **{name: None for name in ("outputs", "units", "inputs", "events") if name in parameters})
    description = (module.__doc__ or "").strip()
    return ModelFile(
        _name(path), description.partition("\n")[0], description, path, MappingProxyType(definitions),
        functions["model"],
        outputs=tuple(definitions["OUTPUTS"]) if "OUTPUTS" in definitions else None, options=options,
        **{name.lower(): definitions.get(name, {}) for name in ("INPUTS", "UNITS", "PARAMETERS")},
        target_accept=definitions.get("TARGET_ACCEPT"))


_ARGUMENTS = {"model": "(times, y=None) and the names in OPTIONS", "simulate": "seed and the names in OPTIONS",
              "prepare": "the data", "anchors": "the data", "fields": "the data and the names in OPTIONS"}


def _check_signature(path: Path, definitions: Mapping[str, Any], name: str, *arguments: Any, **keywords: Any) -> None:
    """Raise ValueError unless a function of a model file takes these arguments."""
    try:
        inspect.signature(definitions[name]).bind(*arguments, **keywords)
    except TypeError as error:
        raise ValueError(f"{path}: {name} must take {_ARGUMENTS[name]}: {error}.") from None


@dataclass(frozen=True)
class SourceLocation:
    """A line of a model file, and whether the file comes with the library."""

    file: str
    line: int
    shipped: bool


def location_in_model(error: BaseException) -> SourceLocation | None:
    """Return the last line of a model file that led to an error, or to its cause; None where none did."""
    location = None
    cause: BaseException | None = error
    while cause is not None:
        for frame, line in traceback.walk_tb(cause.__traceback__):
            module = str(frame.f_globals.get("__name__", ""))
            if module.startswith(_MODULE):
                file = frame.f_code.co_filename
                location = SourceLocation(file, line, Path(file).parent == models_folder())
            elif module.startswith("lfm_ppl.likelihoods.handlers."):  # an option of the user is at fault
                location = None
        cause = cause.__cause__
    return location


def known_inputs(error: KeyError) -> tuple[str, ...] | None:
    """Return the names of the known inputs where a model file asked for one that is not there; None elsewhere."""
    for frame, _ in traceback.walk_tb(error.__traceback__):
        inputs = frame.f_locals.get("inputs")
        if (str(frame.f_globals.get("__name__", "")).startswith(_MODULE) and isinstance(inputs, Mapping)
                and error.args and error.args[0] not in inputs):
            return tuple(map(str, inputs))
    return None


def _name(path: Path) -> str:
    return path.stem.replace("_", "-")
