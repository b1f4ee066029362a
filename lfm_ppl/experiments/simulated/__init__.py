"""Studies of simulated data: filters, smoothers and samplers against known paths and parameters.

Such a study defines a `lfm_ppl.experiments.simulated.problem.SimulationProblem`, computes its tasks with the functions
of ``states`` and ``parameters``, which take the problem and a task, and adds tables and figures;
`lfm_ppl.experiments.ballistic` is an example.
"""
