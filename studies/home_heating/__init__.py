"""Home heating: the temperature a day ahead, with a residual heat that nearly repeats every day.

Source: S. Reece, S. Ghosh, A. Rogers, S. Roberts and N. R. Jennings, Efficient state-space inference of periodic latent
force models, Journal of Machine Learning Research 15 (2014), section 9.
"""
