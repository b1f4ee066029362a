"""Periodic kernels as forces: eigenfunctions against random frequencies and resonators.

Source: S. Reece, S. Ghosh, A. Rogers, S. Roberts and N. Jennings, Efficient state-space inference of periodic latent
force models, Journal of Machine Learning Research 15 (2014), section 5.
"""
