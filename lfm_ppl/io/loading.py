"""Find, load and check model files: shipped ones by name, others by path.

1. Execute the file as a module of its own.
2. Check the functions and constants that it defines, with the reason of a failure in one line.
3. Call its functions with the arguments that they take.

A model file is an ordinary Python file. It must define

    model(times, y=None, **options)     the NumPyro model, with one site ``y``

and may define, each with a sensible default,

    simulate(seed=0, **options) -> lfm.Data     its default data
    prepare(data) -> lfm.Data                   converts the data of a file for ``model``
    anchors(data) -> dict                       parameters that are fixed for such data unless freed
    OUTPUTS      names of the outputs; None: the columns of the data file
    INPUTS       known inputs: name -> "previous", "linear" or "zero", how they are read, see `lfm_ppl.read_csv`
    UNITS        name -> unit
    OPTIONS      option -> (default, tuple of choices or a type, help)
    PARAMETERS   name of a sample site -> help, with its unit
    TARGET_ACCEPT    target acceptance of NUTS, if the default makes its steps too long

A ``model`` with an argument ``outputs`` or ``units`` gets the names of the outputs and the
units of the data, for ``LatentForceModel(..., output_names=outputs, units=units)``. One that has an argument ``inputs``
gets the known inputs of the data: name -> `lfm.Input`, a function of time.
"""

from __future__ import annotations

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

from lfm_ppl.io.data_set import INTERPOLATIONS, Data
from lfm_ppl.utils import checks

_MODULE = "_lfm_ppl_model_"
"""Begins the names of the modules that model files become."""


@dataclass(frozen=True)
class ModelFile:
    """A model file that has been loaded and checked.

    Attributes:
        name: ``ginzburg-landau`` for ``ginzburg_landau.py``.
        path: where it is.
        summary: the first line of its docstring.
        description: the whole docstring.
        model: the NumPyro model function.
        outputs: names of the outputs, or None for any number of them.
        units: name -> unit.
        options: option -> (default, tuple of choices or a type, help).
        parameters: name of a sample site -> help.
        inputs: known inputs that the model takes: name -> interpolation.
        target_accept: acceptance that NUTS aims at; None for its own.
    """

    name: str
    path: Path
    summary: str
    description: str
    model: Callable[..., None]
    outputs: tuple[str, ...] | None
    units: Mapping[str, str]
    options: Mapping[str, tuple[Any, Any, str]]
    parameters: Mapping[str, str]
    inputs: Mapping[str, str] = field(default_factory=dict)
    target_accept: float | None = None
    _simulate: Callable[..., Data] | None = None
    _prepare: Callable[[Data], Data] | None = None
    _anchors: Callable[[Data], Mapping[str, float]] | None = None
    _names: Mapping[str, Any] = field(default_factory=dict, repr=False, compare=False)

    @property
    def definitions(self) -> Mapping[str, Any]:
        """Functions and constants of the file, and whatever else it names, by name.

        Example:
            >>> load("epidemic").definitions["FORCE"]
            'log transmission'
        """
        return MappingProxyType(self._names)

    @property
    def can_simulate(self) -> bool:
        """Whether the file has data of its own."""
        return self._simulate is not None

    def simulate(self, seed: int | None = None, **options: Any) -> Data:
        """Return simulated data with its truth; the model's default data where seed is None.

        Raises:
            ValueError: if the file defines no ``simulate``.
        """
        if self._simulate is None:
            raise ValueError(
                f"{self.path} defines no simulate(seed=0, **options), so it has no data of its "
                "own. Give a data file with --data FILE, or add the function."
            )
        seeded = {} if seed is None else {"seed": seed}
        _check_call(self.path, "simulate", self._simulate, "seed and the names in OPTIONS", **seeded, **options)
        data = self._simulate(**seeded, **options)
        if not isinstance(data, Data):
            raise TypeError(f"simulate in {self.path} must return lfm.Data, got {_type(data)}.")
        return self._completed("simulate", data)

    def prepare(self, data: Data) -> Data:
        """Return a user's data in the form that the model takes; ``note`` says what was done."""
        if self._prepare is not None:
            _check_call(self.path, "prepare", self._prepare, "the data", data)
            data = self._prepare(data)
            if not isinstance(data, Data):
                raise TypeError(f"prepare in {self.path} must return lfm.Data, got {_type(data)}.")
        return self._completed("prepare", data)

    def anchors(self, data: Data) -> dict[str, float]:
        """Return the parameters that are fixed for this data unless the user frees them."""
        if self._anchors is None:
            return {}
        _check_call(self.path, "anchors", self._anchors, "the data", data)
        anchors = self._anchors(data)
        if not isinstance(anchors, Mapping):
            raise TypeError(f"anchors in {self.path} must return a mapping of names of parameters to values, got "
                            f"{_type(anchors)}.")
        return dict(anchors)

    def keywords(self, data: Data, options: Mapping[str, Any]) -> dict[str, Any]:
        """Return the keyword arguments of ``model`` for this data and these options."""
        keywords = {name: default for name, (default, _, _) in self.options.items()} | dict(options)
        parameters = inspect.signature(self.model).parameters
        from_data = {"outputs": data.outputs, "units": dict(data.units), "inputs": data.known_inputs()}
        if data.inputs and "inputs" not in parameters:
            raise ValueError(f"{self.path}: the data have the known input {next(iter(data.inputs))!r}, and model(...) "
                             "has no argument `inputs` to take it by.")
        if lacking := [name for name in self.inputs if name not in data.inputs]:
            raise ValueError(f"{self.name} needs the known input {lacking[0]!r}, which the data do not have.")
        return keywords | {name: value for name, value in from_data.items() if name in parameters}

    def option(self, name: str, text: str) -> Any:
        """Return the value of option ``name`` that ``text`` stands for.

        Raises:
            ValueError: for an unknown option, or a value that it does not take.
        """
        if name not in self.options:
            raise ValueError(checks.unknown(f"option of {self.name}", name, self.options))
        _, accepted, _ = self.options[name]
        if isinstance(accepted, tuple):
            choices = {str(choice): choice for choice in accepted}
            if text not in choices:
                raise ValueError(checks.unknown(f"value of option {name}", text, choices))
            return choices[text]
        try:
            return _convert(accepted, text)
        except ValueError:
            raise ValueError(
                f"option {name} of {self.name} takes a value of type {accepted.__name__}, "
                f"got {text!r}."
            ) from None

    def _completed(self, function: str, data: Data) -> Data:
        """Return data with the units of the model."""
        if self.outputs is not None and data.outputs != self.outputs:
            raise ValueError(f"{function} in {self.path} returns data of {', '.join(data.outputs)}, but the file has "
                             f"OUTPUTS = {self.outputs}; make them the same.")
        return replace(data, units={**self.units, **data.units})


def models_folder() -> Path:
    """Return the folder of the shipped model files: in a wheel, or in the checkout."""
    package = Path(__file__).resolve().parent.parent
    installed = package / "_models"
    return installed if installed.is_dir() else package.parent / "models"


def available() -> dict[str, Path]:
    """Return the shipped models: name -> file."""
    files = sorted(models_folder().glob("*.py"))
    return {_name(path): path for path in files if not path.name.startswith("_")}


def load(name: str) -> ModelFile:
    """Load a model by name or by path, and check what it defines.

    Args:
        name: a shipped model (``ginzburg-landau``, dashes or underscores), or the path of a Python
            file (anything that ends in .py or contains a path separator).

    Returns:
        The model file.

    Raises:
        ValueError: for an unknown name (with the nearest ones), a file that is missing, does not
            run, or lacks what it must define.

    Example:
        >>> load("ginzburg-landau").name
        'ginzburg-landau'
    """
    if name.endswith(".py") or os.sep in name:
        path = Path(name).expanduser()
        if not path.is_file():
            raise ValueError(f"there is no model file {name}.")
        return _checked(path.resolve(), _execute(path.resolve()))
    shipped = available()
    normalized = name.replace("_", "-")
    if normalized not in shipped and Path(f"{name}.py").is_file():
        raise ValueError(f"unknown model {name!r}. Did you mean the file {name}.py?")
    if normalized not in shipped:
        message = checks.unknown("model", name, shipped)
        raise ValueError(f"{message} A model of your own is given by its path, as in ./{name}.py.")
    return _checked(shipped[normalized], _execute(shipped[normalized]))


def _execute(path: Path) -> ModuleType:
    """Run a file as a module of its own, named so that it cannot hide another module."""
    name = f"{_MODULE}{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ValueError(f"{path} is not a Python file.")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # a dataclass or an equinox Module looks itself up there
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        del sys.modules[name]
        raise ValueError(f"{path} does not run: {_where(error, path)}") from error
    return module


def _checked(path: Path, module: ModuleType) -> ModelFile:
    functions = {
        key: value
        for key, value in vars(module).items()
        if callable(value) and getattr(value, "__module__", "") == module.__name__
    }
    if "model" not in functions:
        raise ValueError(
            f"{path} defines no function model(times, y=None, **options); its own functions are: "
            f"{', '.join(functions) or 'none'}. Rename the NumPyro model function to `model`."
        )
    for name in ("simulate", "prepare", "anchors"):
        if not callable(getattr(module, name, print)):
            raise ValueError(f"{path}: {name} must be a function, got {getattr(module, name)!r}.")
    description = (module.__doc__ or "").strip()
    outputs = getattr(module, "OUTPUTS", None)
    named = isinstance(outputs, (tuple, list)) and all(isinstance(name, str) for name in outputs)
    if outputs is not None and not (named and outputs):
        example = outputs if isinstance(outputs, str) else "x"
        raise ValueError(f'{path}: OUTPUTS must be a tuple of names, as in ("{example}",), got {outputs!r}.')
    for name in ("UNITS", "PARAMETERS", "OPTIONS"):
        if not isinstance(getattr(module, name, {}), Mapping):
            raise ValueError(f"{path}: {name} must be a mapping, a dict, got {getattr(module, name)!r}.")
    target_accept = getattr(module, "TARGET_ACCEPT", None)
    if target_accept is not None and not (isinstance(target_accept, int | float) and 0 < target_accept < 1):
        raise ValueError(f"{path}: TARGET_ACCEPT must lie between 0 and 1, got {target_accept!r}.")
    loaded = ModelFile(
        name=_name(path),
        path=path,
        summary=description.partition("\n")[0],
        description=description,
        model=functions["model"],
        outputs=None if outputs is None else tuple(outputs),
        units=dict(getattr(module, "UNITS", {})),
        options=_checked_options(path, getattr(module, "OPTIONS", {})),
        parameters=dict(getattr(module, "PARAMETERS", {})),
        inputs=_checked_inputs(path, getattr(module, "INPUTS", {})),
        target_accept=target_accept,
        _simulate=getattr(module, "simulate", None),
        _prepare=getattr(module, "prepare", None),
        _anchors=getattr(module, "anchors", None),
        _names=vars(module),
    )
    parameters = inspect.signature(loaded.model).parameters
    keywords = {name: None for name in ("outputs", "units", "inputs") if name in parameters}
    _check_call(path, "model", loaded.model, "(times, y=None) and the names in OPTIONS", None, None,
                **{name: None for name in loaded.options}, **keywords)
    return loaded


def _check_call(path: Path, name: str, function: Callable, form: str, *arguments: Any, **keywords: Any) -> None:
    """Raise ValueError unless a function of a model file takes these arguments; ``form`` says which it must take."""
    try:
        inspect.signature(function).bind(*arguments, **keywords)
    except TypeError as error:
        raise ValueError(f"{path}: {name} must take {form}: {error}.") from None


def _checked_options(path: Path, options: Mapping[str, Any]) -> dict[str, tuple[Any, Any, str]]:
    for name, entry in options.items():
        valid = isinstance(entry, tuple) and len(entry) == 3 and isinstance(entry[1], tuple | type)
        if not valid:
            raise ValueError(
                f"{path}: OPTIONS[{name!r}] must be (default, tuple of choices or a type, help), "
                f"got {entry!r}."
            )
        if isinstance(entry[1], tuple) and entry[0] not in entry[1]:
            raise ValueError(f"{path}: the default of OPTIONS[{name!r}] must be one of its choices {entry[1]!r}, got "
                             f"{entry[0]!r}.")
    return dict(options)


def _checked_inputs(path: Path, inputs: Any) -> dict[str, str]:
    valid = isinstance(inputs, Mapping) and all(way in INTERPOLATIONS for way in inputs.values())
    if not valid:
        raise ValueError(f"{path}: INPUTS must be a mapping of names to one of {', '.join(INTERPOLATIONS)}, as in "
                         f'{{"heater": "previous"}}, got {inputs!r}.')
    return dict(inputs)


def _convert(kind: type, text: str) -> Any:
    if kind is bool:
        booleans = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}
        if text.lower() not in booleans:
            raise ValueError(text)
        return booleans[text.lower()]
    return kind(text)


@dataclass(frozen=True)
class SourceLocation:
    """A line of a model file.

    Attributes:
        file: its path.
        line: counted from 1.
        shipped: whether the file comes with the library.
    """

    file: str
    line: int
    shipped: bool


def place_in_model(error: BaseException) -> SourceLocation | None:
    """Return the last line of a model file that led to an error, or to its cause; None where none did."""
    location = None
    cause: BaseException | None = error
    while cause is not None:
        for frame, line in traceback.walk_tb(cause.__traceback__):
            module = str(frame.f_globals.get("__name__", ""))
            if module.startswith(_MODULE):
                file = frame.f_code.co_filename
                location = SourceLocation(file, line, Path(file).parent == models_folder())
            elif module.startswith("lfm_ppl.inference.handlers."):  # an option of the user is at fault
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


def _where(error: BaseException, path: Path) -> str:
    """Return the error in one line, with the last line of ``path`` that led to it."""
    lines = [f.lineno for f in traceback.extract_tb(error.__traceback__) if f.filename == str(path)]
    line = error.lineno if isinstance(error, SyntaxError) else (lines[-1] if lines else None)
    prefix = f"line {line}: " if line else ""
    return f"{prefix}{type(error).__name__}: {error}"


def _name(path: Path) -> str:
    return path.stem.replace("_", "-")


def _type(value: Any) -> str:
    return type(value).__name__
