"""Commands and options of ``lfm-ppl``.

1. `parser` builds a subparser for each command; related options share a function (`_add_data`, `_add_inference`, ...).
2. For ``compare NAME`` the options of the study are added before parsing, from its settings.
3. `parsed` parses; an unknown or empty option ends with one line that names similar options.
"""

from __future__ import annotations

import argparse
import difflib
import sys
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

import lfm_ppl
from lfm_ppl.cli import (
    check,
    compare,
    fit,
    forecast,
    models,
    new,
    plot,
    session,
    simulate,
    study_options,
    values,
    version,
)
from lfm_ppl.cli.choices import REFERENCES, RULES
from lfm_ppl.experiments import catalogue
from lfm_ppl.inference.samplers import SAMPLERS
from lfm_ppl.utils import calendar_time, checks

MODEL_HELP = "a shipped model (see `lfm-ppl models`) or the path of a Python file"
OPTION_HELP = "an option of the model (see `lfm-ppl models MODEL`); may be repeated"


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        """Print the error and end the process."""
        print(f"lfm-ppl: error: {message} (see `{self.prog} --help`)", file=sys.stderr)
        raise SystemExit(2)


def parsed(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Return the arguments; an unknown or empty option is an error that suggests similar options."""
    words = sys.argv[1:] if argv is None else list(argv)
    top = parser()
    (commands,) = (action for action in top._actions if isinstance(action, argparse._SubParsersAction))
    if words[:1] == ["compare"]:
        _add_study(commands.choices["compare"], words[1:])
    arguments, unknown = top.parse_known_args(words)
    command = commands.choices[arguments.command]
    if unknown:
        flag = unknown[0].partition("=")[0]
        similar_flags = (
            difflib.get_close_matches(flag, command._option_string_actions, n=2) if flag.startswith("-") else []
        )
        hint = f". Did you mean {' or '.join(similar_flags)}?" if similar_flags else ""
        study = command.get_default("study")
        if study is not None and flag.startswith("-"):
            command.error(f"{study.name} does not take {flag}; leave it out{hint}")
        command.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")
    for action in command._actions:
        value = getattr(arguments, action.dest, None)
        if isinstance(value, str) and not value.strip():
            name = "/".join(action.option_strings) or action.metavar
            command.error(f"{name}: expected {action.metavar}, got {value!r}")
    return arguments


def parser() -> argparse.ArgumentParser:
    """Return the parser of the whole command line."""
    top = Parser(
        prog="lfm-ppl",
        description="Latent force models: from a model and data to a posterior.",
        epilog="Start with: lfm-ppl fit ginzburg-landau",
    )
    top.set_defaults(debug=False)
    top.add_argument("--version", action="version", version=f"lfm_ppl {lfm_ppl.__version__}",
                     help="print the version of lfm_ppl (`lfm-ppl version`: of its dependencies, too)")
    commands = top.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for add in (_add_models, _add_new, _add_simulate, _add_fit, _add_forecast, _add_check, _add_compare, _add_plot,
                _add_version):
        add(commands)
    return top


def _command(commands: Any, name: str, run: Callable[..., int], help_: str, examples: str,
             computes: bool = False) -> Any:
    command = commands.add_parser(
        name,
        help=help_,
        description=help_[0].upper() + help_[1:] + ".",
        epilog=f"examples:\n{examples}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    command.set_defaults(run=run)
    command.add_argument("--debug", action="store_true", help="show where an error comes from")
    if computes:
        command.add_argument("--no-cache", action="store_true",
                             help="do not use the cache of compiled programs in ~/.cache/lfm_ppl")
    return command


def _add_models(commands: Any) -> None:
    examples = "  lfm-ppl models\n  lfm-ppl models transcription\n  lfm-ppl models my_model.py"
    help_ = "list the models, or describe one: its parameters and their priors, forces, outputs"
    command = _command(commands, "models", models.run, help_, examples)
    command.add_argument("model", nargs="?", metavar="MODEL", help=MODEL_HELP)


def _add_new(commands: Any) -> None:
    help_ = "write a commented model file to start from, which runs as it is"
    command = _command(commands, "new", new.run, help_, "  lfm-ppl new my_model.py && lfm-ppl fit my_model.py")
    command.add_argument("file", metavar="FILE", help="Python file to write; an existing file is an error")


def _add_simulate(commands: Any) -> None:
    examples = (
        "  lfm-ppl simulate transcription --seed 3 --out genes.csv\n"
        "  lfm-ppl fit transcription --data genes.csv --truth genes.truth.json"
    )
    help_ = "write a model's simulated data as a CSV file, with the truth beside it"
    command = _command(commands, "simulate", simulate.run, help_, examples, computes=True)
    command.add_argument("model", metavar="MODEL", help=MODEL_HELP)
    command.add_argument("--out", metavar="FILE", help="CSV file to write (default: MODEL.csv)")
    command.add_argument(
        "--seed", type=values.integer(0), help="random seed (default: that of the model's default data)"
    )
    command.add_argument("--option", action="append", default=[], metavar="NAME=VALUE", help=OPTION_HELP)
    command.add_argument("--overwrite", action="store_true", help="replace files that exist")


def _add_plot(commands: Any) -> None:
    examples = (
        "  lfm-ppl plot lfm-results/spring-001 --overwrite\n  lfm-ppl plot posterior.nc --out figures --format pdf"
    )
    help_ = "draw the figures of a saved result again"
    command = _command(commands, "plot", plot.run, help_, examples)
    command.add_argument("result", metavar="RESULT", help="a results folder or a posterior.nc")
    command.add_argument("--out", metavar="DIR", help="folder for the figures (default: RESULT's)")
    command.add_argument(
        "--format",
        choices=("png", "pdf", "svg"),
        default="png",
        help="format of the figures (default: png)",
    )
    command.add_argument("--overwrite", action="store_true", help="replace figures that exist")


def _add_check(commands: Any) -> None:
    examples = (
        "  lfm-ppl check lfm-results/ginzburg-landau-001\n"
        "  lfm-ppl check lfm-results/spring-001 --reference particles --particles 5000 --draws 100\n"
        "  lfm-ppl check lfm-results/ginzburg-landau-001 --correct --overwrite"
    )
    help_ = "measure the error of the Gaussian filter in a saved posterior, and correct it"
    command = _command(commands, "check", check.run, help_, examples, computes=True)
    command.add_argument("result", metavar="RESULT", help="a results folder or a posterior.nc")
    command.add_argument(
        "--reference",
        type=values.one_of("reference", REFERENCES),
        default="auto",
        metavar="|".join(REFERENCES),
        help="method for the exact likelihood (default: auto, the grid for one state, else particles)",
    )
    command.add_argument(
        "--draws", type=values.integer(1), metavar="N",
        help="number of posterior draws (default: 200; with --correct 1000, or 0 if an earlier check found that "
        "new chains are needed)"
    )
    command.add_argument("--particles", type=values.integer(1), metavar="N",
                         help="number of particles (default: chosen for low noise)")
    command.add_argument(
        "--seed", type=values.integer(0), default=0, help="random seed of the particle filter (default: 0)"
    )
    command.add_argument(
        "--correct",
        action="store_true",
        help="write the corrected result: resampled draws, or exact chains if the weights are too uneven",
    )
    command.add_argument(
        "--delayed",
        action="store_true",
        help="delayed acceptance: the Gaussian filter screens half of the proposals of such chains; useful if it is "
        "nearly exact and the particle filter slow",
    )
    command.add_argument("--model", metavar="FILE", help="the model file, if it is not stored in the result")
    command.add_argument("--out", metavar="DIR", help="folder of the corrected result (default: RESULT/corrected)")
    command.add_argument("--overwrite", action="store_true", help="replace an earlier report and corrected result")
    command.add_argument("--resume", action="store_true", help="resume a check that was stopped or killed")
    command.add_argument("--quiet", action="store_true",
                         help="do not show the progress")


_COMPARE_EXAMPLES = (
    "ginzburg-landau --quick",
    "transcription --datasets 10",
    "gps --data shared/data/gps --satellites G05 G20 --train-days 3",
    "ballistic --runs 20 --jobs 2",
    "call-centre --data shared/data/calls",
    "ginzburg-landau --realisations 50 --conditional 200 --out double-well",
)


def _add_compare(commands: Any) -> None:
    examples = "  lfm-ppl compare\n" + "".join(f"  lfm-ppl compare {example}\n" for example in _COMPARE_EXAMPLES) + (
        f"\nstudies, each with options of its own, which `lfm-ppl compare NAME --help` shows:\n{compare.listed()}")
    help_ = "run a published experiment again, or go on with one that was stopped; without a name, list them"
    command = _command(commands, "compare", compare.run, help_, examples, computes=True)
    command.set_defaults(study=None)
    command.add_argument("experiment", nargs="?", metavar="EXPERIMENT", help="see `lfm-ppl compare`")
    _add_shared(command)


def _add_shared(command: Any) -> None:
    """Add the options that all studies share."""
    command.add_argument("--quick", action="store_true", help="few and small: it shows that it runs, and no more")
    command.add_argument(
        "--out",
        metavar="DIR",
        help="folder to write; what it holds already is kept and used (default: lfm-results/compare/EXPERIMENT)",
    )
    command.add_argument("--overwrite", action="store_true", help="replace results that were made with other settings")
    _add_workers(command)
    command.add_argument("--quiet", action="store_true", help="do not show the progress")


def _add_study(command: Any, words: Sequence[str]) -> None:
    """Add the options of the study that is named among the words after ``compare``."""
    shared = Parser(prog=command.prog, add_help=False, allow_abbrev=False)
    for flag in ("--help", "-h", "--debug", "--no-cache"):
        shared.add_argument(flag, action="store_true")
    _add_shared(shared)
    name = study_options.name_in(words, shared, catalogue.names())
    if name is None:
        return
    try:
        study = catalogue.experiment(name)
    except ValueError as error:
        command.error(str(error).rstrip("."))
    session.start(1, "--no-cache" not in words, one_thread=True)  # so that one process finds the numbers of several
    command.set_defaults(study=study)
    command.prog, command.description = f"{command.prog} {study.name}", f"{study.summary}."
    examples = [example for example in _COMPARE_EXAMPLES if example.startswith(f"{study.name} ")] or [
        f"{study.name} --quick"
    ]
    command.epilog = "examples:\n" + "\n".join(f"  lfm-ppl compare {example}" for example in examples)
    next(action for action in command._actions if action.dest == "experiment").help = argparse.SUPPRESS
    study_options.add(command, study.study.settings, study.name)


def _add_workers(group: Any) -> None:
    group.add_argument(
        "--jobs",
        type=values.integer(1),
        metavar="N",
        help="number of processes (default: one per core, at most 4; 1 without Dask)",
    )
    group.add_argument(
        "--scheduler",
        metavar="tcp://HOST:PORT",
        help="address of a Dask scheduler, whose workers may run on other machines",
    )


def _add_version(commands: Any) -> None:
    help_ = "print the versions of lfm_ppl and its dependencies"
    _command(commands, "version", version.run, help_, "  lfm-ppl version")


def _add_fit(commands: Any) -> None:
    examples = (
        "  lfm-ppl fit ginzburg-landau\n"
        "  lfm-ppl fit transcription --data genes.csv --option link=saturation\n"
        "  lfm-ppl fit transcription --data p53.csv --set 'decay[CDKN1A]=0.8'\n"
        "  lfm-ppl fit spring --until 40 --target-accept 0.95\n"
        "  lfm-ppl fit spring --out result --resume\n"
        "  lfm-ppl fit my_model.py --data 'patients/*.csv' --each --sampler map --jobs 2\n"
        "  lfm-ppl fit my_model.py --data mine.csv --rule gauss-hermite --steps 20 --out result"
    )
    help_ = "infer parameters and forces, and write posterior, summary, figures and a report"
    command = _command(commands, "fit", fit.run, help_, examples, computes=True)
    command.add_argument("model", metavar="MODEL", help=MODEL_HELP)
    _add_data(command.add_argument_group("data"))
    _add_inference(command.add_argument_group("inference"))
    _add_approximation(command.add_argument_group("approximation (default: the model's own)"))
    out = command.add_argument_group("results")
    out.add_argument(
        "--out",
        metavar="DIR",
        help="folder of the results (default: lfm-results/MODEL-001, -002, ...; with "
        "--each or --series lfm-results/MODEL-many, whose stored results are used)",
    )
    _add_times(out)
    out.add_argument("--overwrite", action="store_true", help="replace the files of a folder")
    out.add_argument("--resume", action="store_true",
                     help="resume the stopped or killed run in --out, with identical draws")
    out.add_argument("--quiet", action="store_true",
                     help="do not show the progress")
    _add_workers(command.add_argument_group("many data sets (--each, --series)"))


def _add_times(group: Any) -> None:
    group.add_argument("--until", metavar="TIME",
                       help="predict new data, with their noise, up to this time, a number or a date (default: none)")
    group.add_argument("--at", metavar="T1,T2,...",
                       help="times or dates at which new data are predicted, between or after the observations")


def _add_forecast(commands: Any) -> None:
    examples = (
        "  lfm-ppl forecast lfm-results/spring-001 --until 40\n"
        "  lfm-ppl forecast lfm-results/my-model-001 --held-out next_week.csv --out next-week"
    )
    help_ = "forecast new data, with their noise, from a saved result, and score it"
    command = _command(commands, "forecast", forecast.run, help_, examples, computes=True)
    command.add_argument("result", metavar="RESULT", help="a results folder or a posterior.nc")
    _add_times(command)
    command.add_argument("--held-out", metavar="FILE",
                         help="CSV file of data that the fit did not use; they are predicted and scored")
    command.add_argument(
        "--time-column",
        metavar="NAME",
        help="time column of that file, of numbers or dates (default: time, t or time_h, else one of dates)",
    )
    command.add_argument(
        "--outputs", metavar="A,B,...", help="output columns of that file (default: the outputs of the result)"
    )
    command.add_argument(
        "--inputs",
        metavar="A,B,...",
        help="columns of known inputs of that file, in the order of the result, NAME:zero if blank cells "
        "are zero (default: columns of these names); the outputs may then all be empty",
    )
    command.add_argument("--draws", type=values.integer(1), default=400, metavar="N",
                         help="number of posterior draws (default: 400)")
    command.add_argument(
        "--seed", type=values.integer(0), default=0, help="random seed of paths and noise (default: 0)"
    )
    command.add_argument("--model", metavar="FILE", help="the model file, if it is not stored in the result")
    command.add_argument("--out", metavar="DIR",
                         help="folder for the result with its predictions, table and figure (default: RESULT's)")
    command.add_argument("--overwrite", action="store_true", help="replace an earlier forecast")
    command.add_argument("--quiet", action="store_true", help="do not show the progress")


def _add_data(group: Any) -> None:
    group.add_argument(
        "--data",
        metavar="FILE",
        help="CSV: a time column, one column per output, empty cells missing, repeated times for "
        "replicates (default: the model's simulated data); with --each a pattern in quotes",
    )
    many = group.add_mutually_exclusive_group()
    many.add_argument("--each", action="store_true", help="fit each file of the pattern --data separately")
    many.add_argument(
        "--series", metavar="NAME", help="fit each series separately: the rows with the same value in this column"
    )
    group.add_argument("--time-column", metavar="NAME",
                       help="the time column, of numbers or dates (default: time, t or time_h, else one of dates)")
    group.add_argument("--time-unit", type=values.one_of("unit of time", calendar_time.SECONDS), metavar="UNIT",
                       help=f"unit of times that are dates: {', '.join(calendar_time.USUAL)} (default: the "
                       "model's, else by the gaps)")
    group.add_argument("--outputs", metavar="A,B,...", help="output columns (default: the outputs of the model)")
    group.add_argument(
        "--inputs",
        metavar="A,B:linear,...",
        help="columns of known inputs, in the order of the model: constant until the next row, with :linear "
        "linear between rows; blank cells are interpolated, with :zero they are zero, as for doses "
        "(default: columns with the names of the model's inputs)",
    )
    group.add_argument(
        "--truth",
        metavar="FILE",
        help="true values, drawn in the figures: the file that `simulate` wrote, "
        'or a JSON file with "times" and "forces", "state" or "parameters"',
    )


def _add_inference(group: Any) -> None:
    group.add_argument(
        "--sampler",
        type=values.one_of("sampler", SAMPLERS, likeness=checks.ABBREVIATIONS),
        default="nuts",
        metavar="|".join(SAMPLERS),
        help="default: nuts; pmmh is ram with the likelihood of a particle filter, exact and slow",
    )
    group.add_argument("--chains", type=values.integer(1), default=4, help="number of chains (default: 4)")
    group.add_argument("--warmup", type=values.integer(0),
                       help="warm-up steps of each chain (default: 300 for nuts from the posterior mode, else 1000)")
    group.add_argument(
        "--samples",
        type=values.integer(1),
        metavar="N",
        help="draws of each chain (default: 1000); with map, of the Laplace approximation (default: 400)",
    )
    group.add_argument("--trajectory-draws", type=values.integer(0), default=400, metavar="N",
                       help="number of trajectories of forces and states (default: 400; 0: none)")
    group.add_argument(
        "--thin",
        type=values.integer(1),
        help="steps per stored draw (default: 1 for nuts, 5 per parameter for ram, 2 per parameter for pmmh)",
    )
    group.add_argument("--seed", type=values.integer(0), default=0, help="random seed of the sampler (default: 0)")
    group.add_argument(
        "--init",
        type=values.one_of("init", ("map", "median")),
        metavar="map|median",
        help="starting points: draws about the posterior mode, whose covariance is the mass matrix of nuts, "
        "or the prior median (default: map; nuts falls back to the median, with a message, if the "
        "mode is unusable)",
    )
    group.add_argument(
        "--target-accept",
        type=values.fraction,
        metavar="P",
        help="target acceptance probability (default: nuts 0.9 or the model's, 0.8 from the prior median; ram 0.234, "
        "0.44 for one parameter; pmmh half of these)",
    )
    group.add_argument(
        "--particles",
        type=values.integer(1),
        metavar="N",
        help="number of particles of pmmh (default: so that the sd of the log likelihood is about 1)",
    )
    group.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="fix a parameter, `decay=0.8`, or an element of it, `decay[CDKN1A]=0.8`; "
        "`NAME=free` frees a parameter that the model fixes; may be repeated",
    )
    group.add_argument("--option", action="append", default=[], metavar="NAME=VALUE", help=OPTION_HELP)


def _add_approximation(group: Any) -> None:
    group.add_argument(
        "--rule",
        type=values.one_of("rule", RULES),
        metavar="RULE",
        help=f"linearisation rule: {', '.join(RULES)}",
    )
    group.add_argument("--steps", type=values.integer(1), metavar="N", help="integration steps between observations")
    group.add_argument("--max-step", type=values.positive, metavar="TIME", help="longest integration step")
    group.add_argument("--tolerance", type=values.positive, metavar="SD",
                       help="adaptive steps: largest error of an integration step, in standard deviations; "
                            "excludes --iterations")
    group.add_argument("--iterations", type=values.integer(0), metavar="N",
                       help="iterations of posterior linearisation; 0: a single pass (default: the model's)")
    group.add_argument("--lower", action="append", default=[], metavar="NAME=VALUE",
                       help="lower bound of a state, force or output, such as \"transcription factor=0\"; may be "
                            "repeated; each likelihood then costs some hundred times as much")
    group.add_argument("--upper", action="append", default=[], metavar="NAME=VALUE", help="upper bound")
    group.add_argument("--grid", type=values.integer(2), metavar="N",
                       help="number of equidistant times at which --lower and --upper hold; cost and error grow with "
                            "it (default: the times of the data, with more in gaps above 1/20 of the record; 100 if "
                            "the data have more)")
