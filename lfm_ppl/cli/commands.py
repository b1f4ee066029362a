"""The commands of ``lfm-ppl``: their arguments, options and examples.

1. Each command is a function whose signature cyclopts reads; `lfm_ppl.cli.options` has the options.
2. `parse` reads the words of a command line. For ``compare NAME`` it registers the study NAME first, whose options come
   from its settings.
3. A command imports the module that does its work when it is called, so that the help appears at once.
"""
# ruff: noqa: B008  defaults of options are frozen dataclasses

from __future__ import annotations

import inspect
import platform
import shlex
from collections.abc import Callable, Sequence
from importlib import metadata, resources
from pathlib import Path
from typing import Annotated, Any, get_args

from cyclopts import App, Group, Parameter

import lfm_ppl
from lfm_ppl.cli import session
from lfm_ppl.cli.help_format import TwoColumnFormatter
from lfm_ppl.cli.option_types import Line, Model, Result, Text
from lfm_ppl.cli.options import (
    GENERAL,
    CheckOptions,
    Debug,
    FitArguments,
    ForecastOptions,
    PlotOptions,
    SimulateOptions,
    StudyOptions,
)
from lfm_ppl.studies import catalogue

NewFile = Annotated[Text, Parameter(help="Python file to write; an existing file is an error")]
Study = Annotated[Text, Parameter(help="name of a study; `lfm-ppl compare NAME --help` shows its options")]
STUDY_EXAMPLES = (
    "ginzburg-landau --quick",
    "transcription --datasets 10",
    "gps --data shared/data/gps --satellites G05 G20 --train-days 3",
    "ballistic --runs 20 --jobs 2",
    "call-centre --data shared/data/calls",
    "ginzburg-landau --realisations 50 --out wells",
)

app = App(
    name="lfm-ppl",
    help="Latent force models: from a model and data to a posterior.",
    help_epilogue="Start with: lfm-ppl fit room",
    help_format="plaintext",
    help_formatter=TwoColumnFormatter(),
    version=f"lfm_ppl {lfm_ppl.__version__}",
    default_parameter=Parameter(negative=()),
    group_arguments=Group.create_default_arguments("arguments"),
    group_commands=Group.create_default_commands("commands"),
)
for flag in ("--help", "--version"):
    app[flag].group = GENERAL


def _examples(*lines: str) -> str:
    return "\n".join(["examples:", *(f"  lfm-ppl {line}".rstrip() for line in lines)])


def parse(line: Sequence[str]) -> tuple[Callable[..., int | None], inspect.BoundArguments]:
    """Return the command of a command line and its arguments.

    Raises:
        CycloptsError, ValueError: a word has no meaning, or a value is not permitted.
    """
    words = list(line)
    if not words:
        raise ValueError("name a command; `lfm-ppl --help` lists them.")
    if words[0] == "compare":
        # A folder may have the name of a study. Study options may stand before the name, so that no parser finds it.
        positions = [index for index, word in enumerate(words) if word.replace("_", "-") in catalogue.names()
                     and words[index - 1] not in ("--out", "--data")]
        if positions:  # options may stand before the name
            name = words.pop(positions[0]).replace("_", "-")
            words.insert(1, name)
            _add_study(name, "--no-cache" not in words)
    command, arguments, unparsed = app.parse_args(words, print_error=False, exit_on_error=False)
    if "line" in unparsed:
        arguments.arguments["line"] = tuple(line)
    return command, arguments


@app.command(help_epilogue=_examples("models", "models transcription", "models my_model.py"))
def models(model: Model | None = None, /, *, options: Debug = Debug()) -> None:
    """List the models, or describe one: its parameters and their priors, forces, outputs."""
    from lfm_ppl.cli.models import describe_model, list_models

    list_models() if model is None else describe_model(model)


@app.command(help_epilogue=_examples("new my_model.py && lfm-ppl fit my_model.py"))
def new(file: NewFile, /, *, options: Debug = Debug()) -> None:
    """Write a commented model file to start from, which runs as it is."""
    from lfm_ppl.cli.folders import check_writable

    path = Path(file)
    if path.suffix != ".py" or not path.stem.isidentifier():
        raise ValueError(f"a model file is a Python file that can be imported, such as my_model.py, got {path.name!r}.")
    if path.exists():
        raise FileExistsError(f"{path} already exists; choose another name.")
    check_writable(path.parent)
    text = resources.files("lfm_ppl.cli").joinpath("template.py").read_text(encoding="utf-8")
    with open(path, "x", encoding="utf-8") as stream:  # fails if another process has made it meanwhile
        stream.write(text)
    name = shlex.quote(file)
    print(f"wrote {path}\n\n"
          f"  lfm-ppl models {name}                 what is in it\n"
          f"  lfm-ppl fit {name}                    fit it to the data that it simulates\n"
          f"  lfm-ppl fit {name} --data mine.csv    fit it to your own")


@app.command(help_epilogue=_examples("simulate transcription --seed 3 --out genes.csv",
                                     "fit transcription --data genes.csv --truth genes.truth.json"))
def simulate(model: Model, /, *, options: SimulateOptions = SimulateOptions()) -> None:
    """Write a model's simulated data as a CSV file, with the truth beside it."""
    from lfm_ppl.cli.simulate import run

    run(model, options)


@app.command(help_epilogue=_examples(
    "fit room",
    "fit transcription --data genes.csv --option link=saturation",
    "fit transcription --data p53.csv --set 'decay[CDKN1A]=0.8'",
    "fit spring --until 40 --target-accept 0.95",
    "fit spring --out result --resume",
    "fit my_model.py --data 'patients/*.csv' --each --sampler map --jobs 2",
    "fit my_model.py --data mine.csv --rule gauss-hermite --steps 20",
))
def fit(model: Model, /, *, options: FitArguments = FitArguments(), line: Line = ()) -> int:
    """Infer parameters and forces, and write posterior, summary, figures and a report."""
    from lfm_ppl.cli.fit import run

    return run(model, options, line)


@app.command(help_epilogue=_examples("forecast lfm-results/spring-001 --until 40",
                                     "forecast lfm-results/my-model-001 --held-out next_week.csv --out next"))
def forecast(result: Result, /, *, options: ForecastOptions = ForecastOptions(), line: Line = ()) -> int:
    """Forecast new data, with their noise, from a saved result, and score it."""
    from lfm_ppl.cli.forecast import run

    return run(result, options, line)


@app.command(help_epilogue=_examples(
    "check lfm-results/ginzburg-landau-001",
    "check lfm-results/spring-001 --reference particles --draws 100",
    "check lfm-results/ginzburg-landau-001 --correct --overwrite",
))
def check(result: Result, /, *, options: CheckOptions = CheckOptions(), line: Line = ()) -> int:
    """Measure the error of the Gaussian filter in a saved posterior, and correct it."""
    from lfm_ppl.cli.check import run

    return run(result, options, line)


compare = App(name="compare", group_commands=Group.create_default_commands("studies, each with options of its own"),
              help_epilogue=_examples("compare", *(f"compare {example}" for example in STUDY_EXAMPLES)))
app.command(compare)
for study in catalogue.names():
    compare.command(App(name=study, help=catalogue.entry(study).summary))


@compare.default
def list_studies(name: Study | None = None, /, *, options: StudyOptions = StudyOptions()) -> None:
    """Run a published study again, or go on with one that was stopped; without a name, list them."""
    if name is not None:
        catalogue.entry(name)  # raises ValueError: studies have commands of their own
    width = max(map(len, catalogue.names()))
    print("\n".join(f"{name:<{width}}  {catalogue.entry(name).summary}" for name in catalogue.names()))
    print("\n`lfm-ppl compare NAME` runs a study; `--quick` is a short run of a few minutes.")


def _add_study(name: str, keep_programs: bool) -> None:
    """Add the command of a study, whose options are the fields of its settings."""
    session.start(1, keep_programs, one_thread=True)  # so that one process finds the numbers of several
    if compare[name].default_command is not None:
        return
    from lfm_ppl.studies.declaration import option_fields

    entry, group = catalogue.entry(name), Group.create_ordered(f"options of {name}")

    def run_study(*, options: StudyOptions = StudyOptions(), line: Line = (), **settings: Any) -> int:
        from lfm_ppl.cli.compare import run

        return run(entry, settings, options, line)

    parameters = list(inspect.signature(run_study).parameters.values())[:-1]
    for field, value_type in option_fields(entry.study.settings):
        declaration, is_variadic = field.metadata["declaration"], Ellipsis in get_args(value_type)
        metavar = " ".join(declaration.parts).upper() if declaration.parts else declaration.metavar or (
            "N" if "int" in str(value_type) else "NAME")
        annotation: Any = Annotated[value_type, Parameter(
            alias=declaration.aliases, choices=declaration.choices, show_choices=field.default != declaration.choices,
            consume_multiple=is_variadic, metavar=metavar + "..." * is_variadic, group=group, help=declaration.help,
            show_default=_default)]
        parameters.append(inspect.Parameter(field.name, inspect.Parameter.KEYWORD_ONLY, default=field.default,
                                            annotation=annotation))
    run_study.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run_study.__annotations__ |= {parameter.name: parameter.annotation for parameter in parameters}
    compare[name].default(run_study)
    examples = [example for example in STUDY_EXAMPLES if example.startswith(f"{name} ")] or [f"{name} --quick"]
    compare[name].help_epilogue = _examples(*(f"compare {example}" for example in examples))


def _default(value: Any) -> str:
    """Return the default value of a setting as a user types it."""
    return shlex.join(map(str, value if isinstance(value, tuple) else (value,)))


@app.command(help_epilogue=_examples("plot lfm-results/spring-001 --overwrite",
                                     "plot posterior.nc --out figures --format pdf"))
def plot(result: Result, /, *, options: PlotOptions = PlotOptions()) -> None:
    """Draw the figures of a saved result again."""
    from lfm_ppl import plots
    from lfm_ppl.cli.folders import check_writable
    from lfm_ppl.results import arviz_data
    from lfm_ppl.storage import files

    path = files.locate(result)
    target = Path(options.out) if options.out else path.parent
    check_writable(target)
    for written in plots.save_figures(arviz_data.load(path), target, (options.format,), overwrite=options.overwrite):
        print(f"wrote {written}")


@app.command(help_epilogue=_examples("version"))
def version(*, options: Debug = Debug()) -> None:
    """Print the versions of lfm_ppl and its dependencies."""
    print(f"lfm_ppl {lfm_ppl.__version__}")
    for name in ("jax", "numpyro", "arviz", "equinox", "numpy"):
        print(f"{name} {metadata.version(name)}")
    print(f"python {platform.python_version()}")
