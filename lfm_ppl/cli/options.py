"""Options of the commands as frozen dataclasses, whose docstrings are the help texts.

Fields of nested dataclasses are options as well: ``FitArguments().data.truth`` is ``--truth``. This module imports
nothing that takes long, so that the help of a command appears at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from cyclopts import Group, Parameter

from lfm_ppl.cli.option_types import (
    Count,
    CountOrZero,
    File,
    Folder,
    Fraction,
    Name,
    Names,
    Pairs,
    Positive,
    Text,
    TimeUnit,
    check_method,
    integer_at_least,
)
from lfm_ppl.inference.samplers import SAMPLERS

# Value of --rule -> class in lfm_ppl, which is used with its defaults.
RULES = {
    "cubature": "Cubature",
    "taylor": "Taylor",
    "unscented": "Unscented",
    "gauss-hermite": "GaussHermite",
    "central-difference": "CentralDifference",
    "monte-carlo": "MonteCarlo",
}
MOST_JOBS = 4
"""Default largest number of processes; each takes one or two GiB."""


def _options_of(title: str) -> Parameter:
    """Return the decorator of a dataclass whose options have a common title in the help."""
    return Parameter(name="*", group=Group.create_ordered(title))


GENERAL = Group.create_ordered("options")
_GENERAL = Parameter(name="*", group=GENERAL)


@_GENERAL
@dataclass(frozen=True)
class Debug:
    """Option of every command."""

    debug: Annotated[bool, Parameter(group=GENERAL)] = False
    """show where an error comes from"""


@_GENERAL
@dataclass(frozen=True)
class Session(Debug):
    """Options of commands that compute."""

    no_cache: Annotated[bool, Parameter(group=GENERAL)] = False
    """do not use the cache of compiled programs in ~/.cache/lfm_ppl"""


@_GENERAL
@dataclass(frozen=True)
class Output(Session):
    """Options of commands that write files."""

    out: Folder | None = None
    overwrite: bool = False
    """replace existing files"""
    quiet: bool = False
    """do not show the progress"""


@_GENERAL
@dataclass(frozen=True)
class ResumableOutput(Output):
    """Options of commands whose computation can be resumed."""

    resume: bool = False
    """resume a run that was stopped or killed, with identical draws"""

    def __post_init__(self) -> None:
        """Refuse to resume and to replace at once."""
        if self.resume and self.overwrite:
            raise ValueError("--resume continues a run, --overwrite starts a new one; give one of them.")


@dataclass(frozen=True)
class Columns:
    """Columns of a data file."""

    time_column: Name | None = None
    """the time column, of numbers or dates (default: time, t or time_h, else one of dates)"""
    outputs: Names | None = None
    """output columns (default: the outputs of the model)"""
    inputs: Annotated[Text, Parameter(metavar="A,B:linear,...")] | None = None
    """columns of known inputs, in the order of the model: constant until the next row, with :linear linear between
    rows; blank cells are interpolated, with :zero they are zero (default: columns with the names of the model's
    inputs)"""
    events: Annotated[Text, Parameter(metavar="COLUMN:STATE,...")] | None = None
    """columns of doses, and the states that receive them at the times of rows with a number; STATE,STATE in the order
    of a column CMT, STATE:once where the column repeats one dose. Columns EVID, MDV, ADDL, II, CMT, RATE and DUR are
    read as in NONMEM; COLUMN:CMT names such a column (default: columns with the names of the model's doses)"""

    def refuse_without(self, flag: str, file: str | None, **more: str | None) -> None:
        """Raise ValueError for a column, or another option about a data file, if there is no file."""
        for name, value in {**vars(self), **more}.items():
            if value is not None and file is None:
                raise ValueError(f"--{name.replace('_', '-')} is about a data file; give one with {flag}.")


@_options_of("data")
@dataclass(frozen=True)
class DataOptions:
    """Data to fit."""

    data: File | None = None
    """CSV: a time column, one column per output, empty cells missing, repeated times for replicates (default: the
    model's simulated data); with --each a pattern in quotes"""
    each: bool = False
    """fit each file of the pattern --data separately"""
    series: Name | None = None
    """fit each series separately: the rows with the same value in this column; all together if the model is a panel"""
    columns: Annotated[Columns, Parameter(name="*")] = Columns()
    time_unit: TimeUnit | None = None
    """unit of the times in the file: ms, s, min, h, d, weeks, years (default: the model's; of dates else by the gaps);
    they are converted to the unit of the model, which --until, --at and the results have"""
    truth: File | None = None
    """true values for the figures and tables: the file that `simulate` wrote, or a JSON file with "times" and "forces",
    "state" or "parameters\""""

    def __post_init__(self) -> None:
        """Refuse files that are series at the same time."""
        if self.each and self.series is not None:
            raise ValueError("--each is for one series in each file, --series for several in one file; give one of "
                             "them.")


@_options_of("inference")
@dataclass(frozen=True)
class Inference:
    """Parameters and the sampler of their posterior."""

    sampler: Annotated[str, Parameter(choices=tuple(SAMPLERS), metavar="NAME")] = "nuts"
    """method; pmmh is ram on the likelihood of a particle filter: exact, but slow"""
    chains: Count = 4
    """number of chains"""
    warmup: CountOrZero | None = None
    """warm-up steps of each chain (default: 300 for nuts from the posterior mode, else 1000)"""
    samples: Count | None = None
    """draws of each chain (default: 1000); with map, of the Laplace approximation (default: 400)"""
    trajectory_draws: CountOrZero = 400
    """number of trajectories of forces and states; 0: none"""
    thin: Count | None = None
    """steps per stored draw (default: 1 for nuts, 5 per parameter for ram, 2 per parameter for pmmh)"""
    seed: CountOrZero = 0
    """random seed of the sampler"""
    init: Annotated[str, Parameter(choices=("map", "median"), metavar="NAME")] | None = None
    """starting points: draws about the posterior mode, whose covariance is the mass matrix of nuts, or the prior
    median (default: map; nuts falls back to the median, with a message, if the mode is unusable)"""
    target_accept: Annotated[Fraction, Parameter(metavar="P")] | None = None
    """target acceptance probability (default: nuts 0.9 or the model's, 0.8 from the prior median; ram 0.234, 0.44 for
    one parameter; pmmh half of these)"""
    particles: Count | None = None
    """number of particles of pmmh (default: so that the sd of the log likelihood is about 1)"""
    set: Pairs = ()
    """fix a parameter, `decay=0.8`, or an element of it, `decay[CDKN1A]=0.8`; `NAME=free` frees a parameter that the
    model fixes; may be repeated"""
    option: Pairs = ()
    """an option of the model (see `lfm-ppl models MODEL`); may be repeated"""

    def __post_init__(self) -> None:
        """Refuse settings of another sampler."""
        chains = tuple(name for name in SAMPLERS if name != "map")
        for flag, value, samplers in (("--target-accept", self.target_accept, chains), ("--init", self.init, chains),
                                      ("--particles", self.particles, ("pmmh",))):
            if value is not None and self.sampler not in samplers:
                raise ValueError(f"{flag} is for {', '.join(samplers)}, not for the sampler {self.sampler}.")


@_options_of("approximation (default: the model's, else as below)")
@dataclass(frozen=True)
class Approximation:
    """Settings of the likelihood; None: the model's."""

    rule: Annotated[str, Parameter(choices=tuple(RULES), metavar="RULE")] | None = None
    """linearisation rule (default: cubature)"""
    steps: Count | None = None
    """integration steps between observations (default: 10)"""
    max_step: Annotated[Positive, Parameter(metavar="TIME")] | None = None
    """longest integration step (default: twice the median step)"""
    tolerance: Annotated[Positive, Parameter(metavar="SD")] | None = None
    """adaptive steps: largest error of an integration step, in standard deviations; excludes --iterations (default:
    equal steps)"""
    method: Annotated[str, Parameter(metavar="METHOD", validator=check_method)] | None = None
    """method of integration: runge-kutta, or exponential for stiff dynamics (default: runge-kutta)"""
    iterations: CountOrZero | None = None
    """iterations of posterior linearisation; 0: a single pass (default: 3, or as many as nuts and ram find to suffice;
    0 for linear models, observation families and --tolerance)"""
    lower: Pairs = ()
    """lower bound of a state, force or output, such as "transcription factor=0"; may be repeated; each likelihood then
    costs some hundred times as much"""
    upper: Pairs = ()
    """upper bound"""
    grid: Annotated[int, Parameter(metavar="N", converter=integer_at_least(2))] | None = None
    """number of equidistant times at which --lower and --upper hold; cost and error grow with it (default: the times
    of the data, with more in gaps above 1/20 of the record; 100 if the data have more)"""


@dataclass(frozen=True)
class Times:
    """Times of predictions."""

    until: Annotated[Text, Parameter(metavar="TIME")] | None = None
    """predict new data, with their noise, up to this time, a number or a date, at the median spacing of the data"""
    at: Annotated[Text, Parameter(metavar="T1,T2,...")] | None = None
    """times or dates at which new data are predicted, between or after the observations"""


@_options_of("results")
@dataclass(frozen=True)
class FitOutput(ResumableOutput):
    """Results of a fit."""

    out: Folder | None = None
    """folder of the results (default: lfm-results/MODEL-001, -002, ...; with --each or --series
    lfm-results/MODEL-many, whose stored results are used)"""
    times: Annotated[Times, Parameter(name="*")] = Times()


@_options_of("many data sets or tasks")
@dataclass(frozen=True)
class Workers:
    """Processes that share the work."""

    jobs: Count | None = None
    """number of processes (default: one per core, at most 4; 1 without Dask)"""
    scheduler: Annotated[Text, Parameter(metavar="tcp://HOST:PORT")] | None = None
    """address of a Dask scheduler, whose workers may run on other machines"""

    @property
    def workers(self) -> int | str:
        """Argument of `lfm_ppl.parallel.run.run_tasks`."""
        from lfm_ppl.parallel.cluster import available, check_workers

        if self.scheduler is None:
            return self.jobs or min(available(), MOST_JOBS)
        if self.jobs is not None:
            raise ValueError("--jobs is the number of processes on this machine; a scheduler has workers of its own. "
                             "Give one of --jobs and --scheduler.")
        check_workers(self.scheduler)
        return self.scheduler


@Parameter(name="*")
@dataclass(frozen=True)
class FitArguments:
    """Options of ``lfm-ppl fit``."""

    data: DataOptions = DataOptions()
    inference: Inference = Inference()
    approximation: Approximation = Approximation()
    output: FitOutput = FitOutput()
    processes: Workers = Workers()

    def __post_init__(self) -> None:
        """Refuse predictions without trajectories."""
        if self.inference.trajectory_draws == 0 and self.output.times != Times():
            raise ValueError("--until and --at need trajectories; --trajectory-draws 0 draws none.")


@_GENERAL
@dataclass(frozen=True)
class SimulateOptions(Session):
    """Options of ``lfm-ppl simulate``."""

    out: File | None = None
    """CSV file to write (default: MODEL.csv)"""
    seed: CountOrZero | None = None
    """random seed (default: that of the model's default data)"""
    option: Pairs = ()
    """an option of the model (see `lfm-ppl models MODEL`); may be repeated"""
    overwrite: bool = False
    """replace files that exist"""


@_GENERAL
@dataclass(frozen=True)
class ForecastOptions(Output):
    """Options of ``lfm-ppl forecast``."""

    out: Folder | None = None
    """folder for the result with its predictions, table and figure (default: RESULT's)"""
    times: Annotated[Times, Parameter(name="*")] = Times()
    held_out: File | None = None
    """CSV file of data that the fit did not use; they are predicted and scored; its known inputs and doses (--inputs,
    --events) continue the fit's, and with them the outputs may all be empty"""
    columns: Annotated[Columns, Parameter(name="*")] = Columns()
    time_unit: TimeUnit | None = None
    """unit of the times in that file (default: that of the fit)"""
    draws: Count = 400
    """number of posterior draws"""
    seed: CountOrZero = 0
    """random seed of paths and noise"""
    model: File | None = None
    """the model file, if it is not stored in the result"""


@_GENERAL
@dataclass(frozen=True)
class CheckOptions(ResumableOutput):
    """Options of ``lfm-ppl check``."""

    out: Folder | None = None
    """folder of the corrected result (default: RESULT/corrected)"""
    reference: Annotated[str, Parameter(choices=("auto", "grid", "particles"), metavar="NAME")] = "auto"
    """method for the exact likelihood; auto: the grid for one state, else particles"""
    draws: Count | None = None
    """number of posterior draws (default: 200; with --correct 1000, or 0 if an earlier check found that new chains are
    needed)"""
    particles: Count | None = None
    """number of particles (default: chosen for low noise)"""
    seed: CountOrZero = 0
    """random seed of the particle filter"""
    correct: bool = False
    """write the corrected result: resampled draws, or exact chains if the weights are too uneven"""
    delayed: bool = False
    """delayed acceptance: the Gaussian filter screens half of the proposals of such chains; useful if it is nearly
    exact and the particle filter slow"""
    model: File | None = None
    """the model file, if it is not stored in the result"""

    def __post_init__(self) -> None:
        """Refuse settings of the corrected result without --correct."""
        super().__post_init__()
        for flag, value in (("--out", self.out), ("--delayed", self.delayed)):
            if value and not self.correct:
                raise ValueError(f"{flag} is about the corrected result; add --correct.")


@_GENERAL
@dataclass(frozen=True)
class StudyOptions(Output):
    """Options of every study."""

    out: Folder | None = None
    """folder to write; results of the same settings that it holds are used again (default: lfm-results/compare/NAME)"""
    quick: bool = False
    """a few small tasks, to test that the study runs"""
    processes: Annotated[Workers, Parameter(name="*")] = Workers()


@_GENERAL
@dataclass(frozen=True)
class PlotOptions(Debug):
    """Options of ``lfm-ppl plot``."""

    out: Folder | None = None
    """folder for the figures (default: RESULT's)"""
    format: Annotated[str, Parameter(choices=("png", "pdf", "svg"), metavar="NAME")] = "png"
    """format of the figures"""
    overwrite: bool = False
    """replace figures that exist"""
