"""Data simulated from a model: what filters, smoothers and samplers find of paths and parameters whose truth is known.

A study of such data has a problem (`lfm_ppl.experiments.simulated.problem.Problem`), makes its tasks of the functions
here, each of which takes the problem and a task, and adds tables and figures; `lfm_ppl.experiments.ballistic` is one.
"""
